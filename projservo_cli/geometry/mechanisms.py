"""Visual mechanisms: one-parameter motions defined by what they leave still, [RH00] section 3.

Every mechanism is the kernel of a stack of operator velocities. The generic functions return
``Mechanism(q_hat, H_hat)``; the compiled ones write the joint motion into a row of the workspace.
"""

import math
from typing import NamedTuple

import numpy as np

from projservo_cli.geometry.algebra import (
    Mat4,
    Vec4,
    apply,
    apply_transposed,
    as_vec,
    dual_pencil,
    inner,
    mat,
    multiple,
    sub,
)
from projservo_cli.geometry.displacement import as_array
from projservo_cli.geometry.jit import internal, merged, njit
from projservo_cli.geometry.kernels import kernel_vector
from projservo_cli.records import FloatArray, IntArray, WorkFailed

# A kernel vector whose operator is smaller than this share of its terms moves nothing.
NULL_MOTION = 1e-9
NO_OPERATOR: Mat4 = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


COORDINATES = 6


class Span(NamedTuple):
    """Six operators that span all displacements; none where those of the joints do.

    Attributes
    ----------
    H_hat : (6, 4, 4) the operators, or (0, 4, 4).
    dual : (6, 16) by which an operator, read row by row, has its coordinates.
    """

    H_hat: FloatArray
    dual: FloatArray


# Six joints span the displacements by themselves.
OWN = Span(np.zeros((0, 4, 4)), np.zeros((COORDINATES, 16)))


class Work(NamedTuple):
    """Arrays the compiled functions write to, so that nothing is allocated in a loop.

    Attributes
    ----------
    H_hat : (n, 4, 4) operators at the current joints.
    B : (≥ n, rows) columns of the matrix being factorised.
    rhs : (rows,) right-hand side.
    z, pivot : (≥ n,) of the factorisation.
    span : of an arm of n ≠ 6.
    basis : operators whose sums the mechanisms are: of the span, else ``H_hat`` itself.
    columns : independent operators for least squares: of the span of n > 6 joints, else ``H_hat`` itself.
    J : (6, n) coordinates of the operators in the span.
    norms, xi : (6,) of a factorisation, and coordinates of a displacement.
    """

    H_hat: FloatArray
    B: FloatArray
    rhs: FloatArray
    z: FloatArray
    pivot: IntArray
    span: Span
    basis: FloatArray
    columns: FloatArray
    J: FloatArray
    norms: FloatArray
    xi: FloatArray


class Mechanism(NamedTuple):
    """One-parameter motion of the robot.

    Attributes
    ----------
    q_hat : (n,) joint motion.
    H_hat : (4, 4) operator Σ q̂_i Ĥ_i.
    """

    q_hat: FloatArray
    H_hat: FloatArray


def workspace(n: int, rows: int, span: Span = OWN) -> Work:
    """Arrays for n joints and matrices of at most ``rows`` rows, with the span of an arm of n ≠ 6."""
    columns = max(n, COORDINATES)
    width = max((n + 3) // 4 * 4, 8, (rows + 3) // 4 * 4)
    H_hat = np.zeros((n, 4, 4))
    own = len(span.H_hat) == 0
    return Work(
        H_hat,
        np.zeros((columns, width)),
        np.zeros(width),
        np.zeros(columns),
        np.zeros(columns, dtype=np.int64),
        span,
        H_hat if own else span.H_hat,
        H_hat if own or n < COORDINATES else span.H_hat,
        np.zeros((COORDINATES, n)),
        np.zeros(COORDINATES),
        np.zeros(COORDINATES),
    )


@merged
def put_rows(work: Work, i: int, first: int, A: Vec4) -> None:
    """Write a velocity into four rows of column i."""
    work.B[i, first] = A[0]
    work.B[i, first + 1] = A[1]
    work.B[i, first + 2] = A[2]
    work.B[i, first + 3] = A[3]


@internal
def kernel_of_eight(work: Work, q_hat: FloatArray) -> bool:
    """Kernel of the eight rows in ``work.B``, compiled once for that number."""
    return kernel_vector(work.B, 8, q_hat.shape[0], q_hat, work.pivot, work.z, work.rhs)


@merged
def operator_of(work: Work, q_hat: FloatArray) -> Mat4:
    """Operator Σ q̂_i Ĥ_i of a joint motion."""
    operators = work.basis
    H = multiple(float(q_hat[0]), mat(operators[0]))
    for i in range(1, q_hat.shape[0]):
        K = mat(operators[i])
        k = float(q_hat[i])
        H = (
            H[0] + k * K[0], H[1] + k * K[1], H[2] + k * K[2], H[3] + k * K[3],
            H[4] + k * K[4], H[5] + k * K[5], H[6] + k * K[6], H[7] + k * K[7],
            H[8] + k * K[8], H[9] + k * K[9], H[10] + k * K[10], H[11] + k * K[11],
            H[12] + k * K[12], H[13] + k * K[13], H[14] + k * K[14], H[15] + k * K[15],
        )  # fmt: skip
    return H


@merged
def translation_mechanism(work: Work, A: Vec4, D: Vec4, q_hat: FloatArray) -> tuple[bool, Mat4]:
    """Translation along the line through A and A + D, [RH00] eq. (8).

    The joint motion of unit norm under which two planes through the line have no velocity.
    """
    a_1, a_2 = dual_pencil(A, D)
    operators = work.basis
    n = q_hat.shape[0]
    for i in range(n):
        operator = mat(operators[i])
        put_rows(work, i, 0, sub((0.0, 0.0, 0.0, 0.0), apply_transposed(operator, a_1)))
        put_rows(work, i, 4, sub((0.0, 0.0, 0.0, 0.0), apply_transposed(operator, a_2)))
    if not kernel_of_eight(work, q_hat):
        return False, NO_OPERATOR
    return moving(work, q_hat)


@njit
def rotation_mechanism(work: Work, A_1: Vec4, A_2: Vec4, q_hat: FloatArray) -> tuple[bool, Mat4]:
    """Revolution around the axis through two points, [RH00] eq. (9), scaled to radians."""
    operators = work.basis
    n = q_hat.shape[0]
    for i in range(n):
        operator = mat(operators[i])
        put_rows(work, i, 0, apply(operator, A_1))
        put_rows(work, i, 4, apply(operator, A_2))
    if not kernel_of_eight(work, q_hat):
        return False, NO_OPERATOR
    return to_radians(work, q_hat)


@merged
def planar_mechanism(work: Work, a: Vec4, A: Vec4, q_hat: FloatArray) -> tuple[bool, Mat4]:
    """Revolution around a point within a plane, [RH00] eq. (10), scaled to radians."""
    operators = work.basis
    n = q_hat.shape[0]
    for i in range(n):
        operator = mat(operators[i])
        put_rows(work, i, 0, sub((0.0, 0.0, 0.0, 0.0), apply_transposed(operator, a)))
        put_rows(work, i, 4, apply(operator, A))
    if not kernel_of_eight(work, q_hat):
        return False, NO_OPERATOR
    return to_radians(work, q_hat)


@internal
def moving(work: Work, q_hat: FloatArray) -> tuple[bool, Mat4]:
    """Operator of a kernel vector, refused where it moves nothing.

    At a kinematic singularity the kernel is the null motion of the robot: joints move, the face does
    not. Then Σ q̂_i Ĥ_i vanishes against its terms.
    """
    H = operator_of(work, q_hat)
    operators = work.basis
    terms = 0.0
    for i in range(q_hat.shape[0]):
        operator = mat(operators[i])
        terms += q_hat[i] * q_hat[i] * inner(operator, operator)
    if not inner(H, H) > NULL_MOTION * NULL_MOTION * terms:
        return False, NO_OPERATOR
    return True, H


@internal
def to_radians(work: Work, q_hat: FloatArray) -> tuple[bool, Mat4]:
    """Scale ν of [RH00] eqs. (9), (10): eigenvalues ±i, which is trace(Ĥ²) = −2."""
    found, H = moving(work, q_hat)
    if not found:
        return False, NO_OPERATOR
    # Entries with dynamic indices would have to be looked up: the sum is written out.
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


def _mechanism(kind: str, H_hat: FloatArray, first: FloatArray, second: FloatArray) -> Mechanism:
    """Run one compiled mechanism on plain arrays."""
    n = len(H_hat)
    work = workspace(n, 8)
    work.H_hat[:] = H_hat
    q_hat = np.zeros(n)
    compiled = {
        "translation": translation_mechanism,
        "rotation": rotation_mechanism,
        "planar rotation": planar_mechanism,
    }[kind]
    found, H = compiled(work, as_vec(first), as_vec(second), q_hat)
    if not found:
        raise WorkFailed(
            f"the robot has no unique {kind} of this kind here: its operators are near a singularity"
        )
    return Mechanism(q_hat, as_array(H))


def translation_along(H_hat: FloatArray, A_1: FloatArray, A_2: FloatArray) -> Mechanism:
    """Translation along the line through two points, [RH00] eq. (8).

    Parameters
    ----------
    H_hat : (n, 4, 4) operators at the current joints.
    A_1, A_2 : (4,) points of equal scale a_inf·A.

    Returns
    -------
    Mechanism of unit joint norm; only the products with its amplitude have a meaning.

    Raises
    ------
    WorkFailed
        If the motion is not unique.
    """
    return _mechanism("translation", H_hat, A_1, A_2 - A_1)


def rotation_about(H_hat: FloatArray, A_1: FloatArray, A_2: FloatArray) -> Mechanism:
    """Revolution around the axis through two points, [RH00] eq. (9).

    Parameters
    ----------
    H_hat : (n, 4, 4) operators at the current joints.
    A_1, A_2 : (4,) points on the axis.

    Returns
    -------
    Mechanism per rad; the sense of rotation is arbitrary.

    Raises
    ------
    WorkFailed
        If the motion is not unique.
    """
    return _mechanism("rotation", H_hat, A_1, A_2)


def rotation_within(H_hat: FloatArray, a: FloatArray, A: FloatArray) -> Mechanism:
    """Revolution around a point within a plane, [RH00] eq. (10).

    Parameters
    ----------
    H_hat : (n, 4, 4) operators at the current joints.
    a : (4,) plane.
    A : (4,) point.

    Returns
    -------
    Mechanism per rad; the sense of rotation is arbitrary.

    Raises
    ------
    WorkFailed
        If the motion is not unique.
    """
    return _mechanism("planar rotation", H_hat, a, A)
