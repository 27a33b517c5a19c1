"""Visual mechanisms: one-parameter motions defined by the points or planes they fix, [RH00] section 3.

A mechanism is the kernel of a stack of operator velocities: a joint motion q̂ (n,), in an array of the
caller, and its operator Σ q̂_i Ĥ_i.
"""

import math
from typing import NamedTuple

import numpy as np

from projservo_cli.geometry.algebra import (
    Mat4,
    Vec4,
    apply,
    apply_transposed,
    combine,
    dual_pencil,
    inner,
    mat,
    mul,
    multiple,
    sub,
    vec,
    vec_into,
)
from projservo_cli.geometry.displacements import invariant_rotations
from projservo_cli.geometry.jit import internal, merged, separate
from projservo_cli.geometry.kinematics import joint_operators, operators_at
from projservo_cli.geometry.null_space import (
    COORDINATES,
    System,
    kernel_vector,
    least_squares,
    minimum_norm,
    new_system,
)
from projservo_cli.records import FloatArray, Model

# Norm of an operator, over the norm of its terms, below which a kernel vector moves no point.
_NULL_MOTION = 1e-9
# Operator returned with a failure.
NO_OPERATOR: Mat4 = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
# Maximum number of Newton steps to a displacement.
_MAX_NEWTON_STEPS = 6
# Newton step, rad or m, that is the last: the next would be its square, below round-off.
SETTLED = 1e-8


class Span(NamedTuple):
    """Six operators that span all displacements; none if the operators of the joints do."""

    H_hat: FloatArray  # (6, 4, 4) the operators, or (0, 4, 4)
    dual: FloatArray  # (6, 16) maps an operator, read row by row, to its coordinates


# Span of six joints, whose own operators span the displacements.
OWN = Span(np.zeros((0, 4, 4)), np.zeros((COORDINATES, 16)))


class Work(NamedTuple):
    """Workspaces of the compiled functions, which do not allocate."""

    H_hat: FloatArray  # (n, 4, 4) operators at the current joints
    system: System  # system of n unknowns, or of six
    span: Span  # span of an arm of n ≠ 6
    basis: FloatArray  # operators that mechanisms combine: of the span, otherwise ``H_hat`` itself
    # independent operators for least squares: of the span if n > 6, otherwise ``H_hat`` itself
    columns: FloatArray
    J: FloatArray  # (6, n) coordinates of the operators in the span
    xi: FloatArray  # (6,) coordinates of a displacement
    newton: FloatArray  # (n,) one Newton step


def rows_of(views: int, m: int) -> int:
    """Most rows of a matrix of m points: their four coordinates, or two for each of the views."""
    return max(4, 2 * views) * m


def workspace(n: int, rows: int, span: Span = OWN) -> Work:
    """Arrays for n joints and matrices of at most ``rows`` rows, with the span of an arm of n ≠ 6."""
    H_hat = np.zeros((n, 4, 4))
    own = len(span.H_hat) == 0
    return Work(
        H_hat=H_hat,
        system=new_system(max(n, COORDINATES), max(n, 8, rows)),
        span=span,
        basis=H_hat if own else span.H_hat,
        columns=H_hat if own or n < COORDINATES else span.H_hat,
        J=np.zeros((COORDINATES, n)),
        xi=np.zeros(COORDINATES),
        newton=np.zeros(n),
    )


@merged
def translation_mechanism(work: Work, A: Vec4, D: Vec4, q_hat: FloatArray) -> tuple[bool, Mat4]:
    """Translation along the line through A and A + D, [RH00] eq. (8).

    The joint motion of unit norm under which two planes through the line have no velocity.
    """
    a_1, a_2 = dual_pencil(A, D)
    for i in range(q_hat.shape[0]):
        operator = mat(work.basis[i])
        vec_into(work.system.B[i, 0:4], sub((0.0, 0.0, 0.0, 0.0), apply_transposed(operator, a_1)))
        vec_into(work.system.B[i, 4:8], sub((0.0, 0.0, 0.0, 0.0), apply_transposed(operator, a_2)))
    return _moving(work, q_hat)


@internal
def rotation_mechanism(work: Work, A_1: Vec4, A_2: Vec4, q_hat: FloatArray) -> tuple[bool, Mat4]:
    """Revolution around the axis through two points, [RH00] eq. (9), scaled to radians."""
    for i in range(q_hat.shape[0]):
        operator = mat(work.basis[i])
        vec_into(work.system.B[i, 0:4], apply(operator, A_1))
        vec_into(work.system.B[i, 4:8], apply(operator, A_2))
    return _to_radians(work, q_hat)


@merged
def planar_mechanism(work: Work, a: Vec4, A: Vec4, q_hat: FloatArray) -> tuple[bool, Mat4]:
    """Revolution around a point within a plane, [RH00] eq. (10), scaled to radians."""
    for i in range(q_hat.shape[0]):
        operator = mat(work.basis[i])
        vec_into(work.system.B[i, 0:4], sub((0.0, 0.0, 0.0, 0.0), apply_transposed(operator, a)))
        vec_into(work.system.B[i, 4:8], apply(operator, A))
    return _to_radians(work, q_hat)


@internal
def _moving(work: Work, q_hat: FloatArray) -> tuple[bool, Mat4]:
    """Kernel vector of the eight rows of the system, and its operator, unless it is a null motion.

    At a kinematic singularity the kernel is a null motion of the robot: joints move and the face does not.
    Then Σ q̂_i Ĥ_i vanishes against its terms.
    """
    if not kernel_vector(work.system, 8, q_hat):
        return False, NO_OPERATOR
    H = multiple(float(q_hat[0]), mat(work.basis[0]))
    for i in range(1, q_hat.shape[0]):
        H = combine(1.0, H, float(q_hat[i]), mat(work.basis[i]))
    terms = 0.0
    for i in range(q_hat.shape[0]):
        operator = mat(work.basis[i])
        terms += q_hat[i] * q_hat[i] * inner(operator, operator)
    if not inner(H, H) > _NULL_MOTION * _NULL_MOTION * terms:
        return False, NO_OPERATOR
    return True, H


@internal
def _to_radians(work: Work, q_hat: FloatArray) -> tuple[bool, Mat4]:
    """Kernel vector and operator with the scale ν of [RH00] eqs. (9), (10): trace(Ĥ²) = −2."""
    unique, H = _moving(work, q_hat)
    if not unique:
        return False, NO_OPERATOR
    # The sum is written out, since dynamic indices of a tuple need memory.
    trace = (H[0] * H[0] + H[5] * H[5]) + (H[10] * H[10] + H[15] * H[15])
    trace += 2.0 * ((H[1] * H[4] + H[2] * H[8]) + (H[3] * H[12] + H[6] * H[9]))
    trace += 2.0 * (H[7] * H[13] + H[11] * H[14])
    size = inner(H, H)
    if not -trace > 1e-12 * size:
        return False, NO_OPERATOR
    nu = math.sqrt(-2.0 / trace)
    for i in range(q_hat.shape[0]):
        q_hat[i] *= nu
    return True, multiple(nu, H)


def make_span(model: Model, A: FloatArray) -> Span:
    """Six operators that span the displacements of the calibrated frame; ``OWN`` for six joints.

    Rotations are about the middle of the points A (m, 4), a_inf·A = 1, per rad. A unit of translation moves
    them about as far as a rad of rotation.

    Raises WorkFailed if the joints preserve no metric of the frame, as with a wrong calibration.
    """
    if len(model.q_reference) == COORDINATES:
        return OWN
    D = np.linalg.svd(model.a_inf[None])[2][1:]
    middle = A.mean(axis=0)
    turns = (
        D.T @ invariant_rotations(D @ model.H_hat_0 @ D.T) @ D @ (np.eye(4) - np.outer(middle, model.a_inf))
    )
    size = float(np.sqrt(np.mean(np.sum((turns @ A.T) ** 2, axis=1))))
    shifts = size * D[:, :, None] * model.a_inf
    H_hat = np.concatenate([shifts, turns])
    dual = np.linalg.pinv(H_hat.reshape(COORDINATES, 16).T)
    return Span(np.ascontiguousarray(H_hat), np.ascontiguousarray(dual))


def in_span(span: Span, model: Model, q: FloatArray, q_hat: FloatArray) -> FloatArray:
    """Coordinates (k, 6) in the span of joint motions q̂ (k, n) at the joints q (n,); q̂ for six joints."""
    if len(span.H_hat) == 0:
        return q_hat
    H_hat = np.einsum("kn,nab->kab", q_hat, joint_operators(model, q))
    return np.asarray(H_hat.reshape(len(q_hat), 16) @ span.dual.T)


@separate
@internal
def joint_motion(work: Work, xi: FloatArray, q_hat: FloatArray) -> bool:
    """Joint motion of a displacement with coordinates ξ (6,), from the operators in ``work.H_hat``.

    Of minimum norm with more than six joints, by least squares with fewer. False at a singularity.
    """
    # A variable, as the compiler would compile the functions called again for the constant.
    n, rows = q_hat.shape[0], work.J.shape[0]
    for i in range(n):
        for a in range(COORDINATES):
            total = 0.0
            for j in range(16):
                total += work.span.dual[a, j] * work.H_hat[i, j // 4, j % 4]
            work.J[a, i] = total
    if n < COORDINATES:
        for a in range(COORDINATES):
            work.system.rhs[a] = xi[a]
            for i in range(n):
                work.system.B[i, a] = work.J[a, i]
        return least_squares(work.system, rows, q_hat)
    return minimum_norm(work.system, work.J, xi, q_hat)


class MeasuredFace(NamedTuple):
    """A measured face and the joints at its measurement."""

    A: FloatArray  # (m, 4) its points
    H_back: Mat4  # inverse of the forward kinematics


@separate
@internal
def reach(model: Model, face: MeasuredFace, goal: Mat4, q: FloatArray, work: Work, settled: float) -> bool:
    """Newton steps on the joints ``q``, in place, until they displace a measured face by ``goal``.

    Steps have minimum norm with more than six joints; fewer bring the face as near as they can. It runs in
    every period from joints nearby, so it has neither the damping nor the starts of
    ``planning.goal_configurations``, which knows no joints nearby.

    work : for n joints and 4m rows or more.
    settled : maximum joint motion of the last step, rad or m.
    Returns false if the steps did not settle or the operators are singular.
    """
    n = q.shape[0]
    m = face.A.shape[0]
    B, rhs, newton, columns = work.system.B, work.system.rhs, work.newton, work.columns
    redundant = columns.shape[0] < n
    x = work.xi if redundant else newton
    for _ in range(_MAX_NEWTON_STEPS):
        H = mul(operators_at(model, q, work.H_hat), face.H_back)
        for k in range(m):
            reached = apply(H, vec(face.A[k]))
            vec_into(rhs[4 * k : 4 * k + 4], sub(apply(goal, vec(face.A[k])), reached))
            for i in range(columns.shape[0]):
                vec_into(B[i, 4 * k : 4 * k + 4], apply(mat(columns[i]), reached))
        if not least_squares(work.system, 4 * m, x):
            return False
        if redundant and not joint_motion(work, x, newton):
            return False
        largest = 0.0
        for i in range(n):
            q[i] += newton[i]
            largest = max(largest, abs(newton[i]))
        if largest <= settled:
            return True
    return False
