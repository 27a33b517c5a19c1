"""Partition of a reaching task into a translation and two rotations: [RH00] section 4.1."""

import math
from typing import NamedTuple

from projservo_cli.geometry.algebra import (
    Mat4,
    Vec4,
    add,
    apply,
    apply_transposed,
    axpy,
    dot,
    dual_pencil,
    incidence_angles,
    meet,
    mul,
    multiple,
    scale,
    sub,
    unit,
    vec,
    vec_into,
)
from projservo_cli.geometry.displacements import rotation
from projservo_cli.geometry.jit import merged, njit, separate
from projservo_cli.geometry.mechanisms import (
    NO_OPERATOR,
    Work,
    planar_mechanism,
    rotation_mechanism,
    translation_mechanism,
)
from projservo_cli.records import FloatArray
from projservo_cli.task.face import Task, center_of, face_plane
from projservo_cli.task.visibility import CONTINUITY_BAND, HALF_TURN_TOLERANCE, choose_sense

# Distance of two unit vectors below which they are equal to working precision.
_COINCIDENT = 1e-14


class Split(NamedTuple):
    """Arrays for the partition of a task."""

    work: Work  # the operators at the current joints in ``H_hat``
    A: FloatArray  # (m, 4) current points of the face, a_inf·A = 1
    A_t: FloatArray  # (m, 4) on return the target without the translation
    A_r: FloatArray  # (m, 4) on return the target without translation and rotation r
    q_hat: FloatArray  # (≥3, n) on return joint motions t, r, p; (≥3, 6) coordinates in the span of an arm
    driven: FloatArray  # (2, n) joint motions of the last rotations r and p in their sense, a law's memory


class Parts(NamedTuple):
    """Partition of the task at one instant; the joint motions are in rows t, r, p of ``q_hat``."""

    found: bool  # False if an operator kernel is not unique
    tau: float  # amplitude of the translation, ≥ 0, in the unit of ``H_t``
    theta_r: float  # angle onto the plane, rad
    theta_p: float  # angle within the plane, rad
    H_t: Mat4  # operators, zero if the part is zero
    H_r: Mat4
    H_p: Mat4
    a: Vec4  # oriented plane of the face
    a_t: Vec4  # oriented plane of the translated target
    A_c: Vec4  # centre of the face


# Point or plane that is not known.
_NOWHERE: Vec4 = (0.0, 0.0, 0.0, 0.0)
# Partition of a task that could not be measured.
NO_PARTS = Parts(
    found=False,
    tau=0.0,
    theta_r=0.0,
    theta_p=0.0,
    H_t=NO_OPERATOR,
    H_r=NO_OPERATOR,
    H_p=NO_OPERATOR,
    a=_NOWHERE,
    a_t=_NOWHERE,
    A_c=_NOWHERE,
)


class _Face(NamedTuple):
    """Points (m, 4) of the face, its oriented plane and its centre."""

    A: FloatArray
    a: Vec4
    A_c: Vec4


@merged
def _negate(q_hat: FloatArray) -> None:
    """Reverse a joint motion."""
    for i in range(q_hat.shape[0]):
        q_hat[i] = -q_hat[i]


@merged
def _agreement(q_hat: FloatArray, previous: FloatArray) -> float:
    """Product of a joint motion with the previous one: positive in the same sense, 0 if there was none."""
    total = 0.0
    for i in range(q_hat.shape[0]):
        total += q_hat[i] * previous[i]
    return total


@merged
def translation_part(work: Work, A_c: Vec4, A_cs: Vec4, q_hat: FloatArray) -> tuple[bool, float, Mat4]:
    """Translation of the centre onto its target, [RH00] eqs. (8), (11).

    The plane of (11) goes through the target centre, perpendicular to it as a vector within the span of both
    centres, hence as transversal as the coordinates allow. The sense has τ ≥ 0; for equal centres τ = 0.
    """
    D = sub(A_cs, A_c)
    if dot(D, D) <= _COINCIDENT * _COINCIDENT * dot(A_cs, A_cs):
        q_hat[:] = 0.0
        return True, 0.0, NO_OPERATOR
    unique, H_t = translation_mechanism(work, A_c, D, q_hat)
    a_cs = axpy(-dot(D, A_cs) / dot(A_cs, A_cs), A_cs, D)
    rate = dot(a_cs, apply(H_t, A_c))
    if not unique or rate == 0.0:
        return False, 0.0, NO_OPERATOR
    tau = -dot(a_cs, A_c) / rate
    if tau < 0.0:
        _negate(q_hat)
        return True, -tau, multiple(-1.0, H_t)
    return True, tau, H_t


@merged
def onto_plane_part(
    work: Work, task: Task, face: _Face, a_t: Vec4, q_hat: FloatArray, driven: FloatArray
) -> tuple[bool, float, Mat4]:
    """Rotation of the face onto the translated target plane, [RH00] eqs. (9), (13)–(15).

    The axis is the intersection of both planes, or for opposite planes the line through the centre and the
    first marker. A_d is the marker farthest from the axis.
    """
    A, a, A_c = face.A, face.a, face.A_c
    same = dot(a, a_t)
    D = sub(a_t, a) if same >= 0.0 else add(a_t, a)
    # Both planes contain the centre: keep round-off of its distance from displacing the axis of nearly equal
    # planes.
    D = axpy(-dot(D, A_c) / dot(A_c, A_c), A_c, D)
    if dot(D, D) <= _COINCIDENT * _COINCIDENT:
        if same >= 0.0:
            q_hat[:] = 0.0
            return True, 0.0, NO_OPERATOR
        first = sub(vec(A[task.order[0]]), A_c)
        if dot(first, first) <= _COINCIDENT * _COINCIDENT * dot(A_c, A_c):
            first = sub(vec(A[task.order[1]]), A_c)
        unique, H_r = rotation_mechanism(work, unit(A_c), unit(first), q_hat)
    else:
        A_1, A_2 = dual_pencil(a, D)
        unique, H_r = rotation_mechanism(work, A_1, A_2, q_hat)
    if not unique:
        return False, 0.0, NO_OPERATOR
    unique, theta = _oriented_angle(A, a, a_t, H_r)
    if not unique:
        return False, 0.0, NO_OPERATOR
    if theta < 0.0:
        _negate(q_hat)
        H_r = multiple(-1.0, H_r)
        theta = -theta
    theta = choose_sense(a, a_t, H_r, theta, task, _agreement(q_hat, driven) < 0.0)
    return True, theta, H_r


@merged
def _oriented_angle(A: FloatArray, a: Vec4, a_t: Vec4, H_r: Mat4) -> tuple[bool, float]:
    """Angle of [RH00] eq. (15), in (−π, π], that brings the front of a onto the front of a_t.

    A_d is the marker farthest from the axis, projected onto the plane of the face: the distance of a measured
    marker from it must not count as an angle between the planes.
    """
    p_0 = 0.0
    p_s = 0.0
    p_c = 0.0
    largest = -1.0
    for k in range(A.shape[0]):
        A_d = vec(A[k])
        A_d = axpy(-dot(a, A_d), a, A_d)
        first = apply(H_r, A_d)
        second = apply(H_r, first)
        s = dot(a_t, first)
        c = -dot(a_t, second)
        if s * s + c * c > largest:
            largest = s * s + c * c
            p_0 = dot(a_t, A_d) - c
            p_s = s
            p_c = c
    meets, plus, minus = incidence_angles(p_0, p_s, p_c)
    if not meets:
        return False, 0.0
    turned = apply_transposed(rotation(H_r, -plus), a)
    return True, plus if dot(turned, a_t) > 0.0 else minus


@merged
def _within_plane_part(
    work: Work, face: _Face, A_r: FloatArray, q_hat: FloatArray, driven: FloatArray
) -> tuple[bool, float, Mat4]:
    """Rotation of the face within its plane, [RH00] eqs. (10), (13)–(15).

    A_e is the marker farthest from the axis. It meets the plane through its target and the axis twice; the
    solution on the target's side counts. The operator turns the oriented plane in one fixed sense, so that
    θ_p is comparable between steps; half a turn counts as +π unless the previous step had the other sense.
    """
    A, a, A_c = face.A, face.a, face.A_c
    unique, H_p = planar_mechanism(work, a, unit(A_c), q_hat)
    if not unique:
        return False, 0.0, NO_OPERATOR
    H_p2 = mul(H_p, H_p)
    e = 0
    largest = -1.0
    for k in range(A.shape[0]):
        radius = apply(H_p2, vec(A[k]))
        if dot(radius, radius) > largest:
            largest = dot(radius, radius)
            e = k
    A_e = vec(A[e])
    A_er = vec(A_r[e])
    # The plane's coefficients, read as a point, never lie on it; their foot is on the axis.
    A_c2 = add(a, apply(H_p2, a))
    velocity = apply(H_p, A_e)
    if dot(meet(A_e, A_c, A_c2), velocity) < 0.0:
        _negate(q_hat)
        H_p = multiple(-1.0, H_p)
        velocity = scale(-1.0, velocity)
    a_i = meet(A_er, A_c, A_c2)
    second = apply(H_p2, A_e)
    # Along the operator, a_iᵀ A_e grows where A_e passes its target, and falls beyond the axis: of
    # both solutions θ⁻ grows.
    unique, _, theta = incidence_angles(
        dot(a_i, A_e) + dot(a_i, second), dot(a_i, velocity), -dot(a_i, second)
    )
    if not unique:
        return False, 0.0, NO_OPERATOR
    if math.pi - abs(theta) <= HALF_TURN_TOLERANCE:
        theta = abs(theta)
    if math.pi - abs(theta) < CONTINUITY_BAND:
        previous = _agreement(q_hat, driven)
        if theta > 0.0 and previous < 0.0:
            theta -= 2.0 * math.pi
        elif theta < 0.0 and previous > 0.0:
            theta += 2.0 * math.pi
    return True, theta, H_p


@separate
@njit
def partition(task: Task, split: Split) -> Parts:
    """Partition of the remaining task, [RH00] eqs. (8)–(16).

    task : target and visibility; split : operators, face and the sense of the last rotations, updated.
    """
    work, A, q_hat = split.work, split.A, split.q_hat
    A_c = center_of(A, task.center)
    A_cs = center_of(task.A_star, task.center)
    a = face_plane(A, task.order, A_c)
    a_star = face_plane(task.A_star, task.order, A_cs)
    unique, tau, H_t = translation_part(work, A_c, A_cs, q_hat[0])
    a_t = unit(axpy(tau, apply_transposed(H_t, a_star), a_star))
    for k in range(A.shape[0]):
        A_ks = vec(task.A_star[k])
        vec_into(split.A_t[k], axpy(-tau, apply(H_t, A_ks), A_ks))
    face = _Face(A, a, A_c)
    theta_r, theta_p = 0.0, 0.0
    H_r, H_p = NO_OPERATOR, NO_OPERATOR
    if unique:
        unique, theta_r, H_r = onto_plane_part(work, task, face, a_t, q_hat[1], split.driven[0])
    if unique:
        back = rotation(H_r, -theta_r)
        for k in range(A.shape[0]):
            vec_into(split.A_r[k], apply(back, vec(split.A_t[k])))
        unique, theta_p, H_p = _within_plane_part(work, face, split.A_r, q_hat[2], split.driven[1])
    if unique:
        for i in range(q_hat.shape[1]):
            split.driven[0, i] = q_hat[1, i] if theta_r >= 0.0 else -q_hat[1, i]
            split.driven[1, i] = q_hat[2, i] if theta_p >= 0.0 else -q_hat[2, i]
    return Parts(
        found=unique,
        tau=tau,
        theta_r=theta_r,
        theta_p=theta_p,
        H_t=H_t,
        H_r=H_r,
        H_p=H_p,
        a=a,
        a_t=a_t,
        A_c=A_c,
    )
