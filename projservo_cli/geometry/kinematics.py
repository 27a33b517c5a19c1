"""Forward kinematics and image Jacobian in projective space: [RH00] equations (6), (7) and (19)."""

import math

import numpy as np

from projservo_cli.geometry.algebra import (
    IDENTITY,
    Mat4,
    Vec4,
    as_array,
    combine,
    mat,
    mat_into,
    mul,
    multiple,
)
from projservo_cli.geometry.displacements import rotation, rotation_and_inverse, translation
from projservo_cli.geometry.jit import inline, internal, merged, njit
from projservo_cli.geometry.joint_curve import bend, slope
from projservo_cli.geometry.lens import distort_visible
from projservo_cli.image_size import BEHIND
from projservo_cli.records import FloatArray, JointLimits, Model


@internal
def _joint_displacement(H_hat: Mat4, prismatic: bool, q: float) -> Mat4:
    """Displacement exp(q Ĥ) of one joint, [RH00] eqs. (4), (5)."""
    if prismatic:
        return translation(H_hat, q)
    return rotation(H_hat, q)


@inline
def _in_order(model: Model, j: int) -> int:
    """Joint at place j of the product of [RH00] eq. (6); of cameras on the tool the last one is first."""
    return model.q_reference.shape[0] - 1 - j if model.on_tool else j


@inline
def _true(model: Model, q: FloatArray, i: int) -> float:
    """Value of joint i from the reference, of which its reading may differ, rad or m."""
    amount = float(q[i]) - float(model.q_reference[i])
    if model.curve.terms.shape[0] > 0:
        amount += bend(model, q, q, 0.0, i)
    return amount


@njit
def forward(model: Model, q: FloatArray) -> Mat4:
    """Forward kinematics, the product of exponentials of [RH00] eq. (6), q rad or m."""
    H = IDENTITY
    for j in range(q.shape[0]):
        i = _in_order(model, j)
        amount = _true(model, q, i)
        H = mul(H, _joint_displacement(mat(model.H_hat_0[i]), model.prismatic[i], amount))
    return H


@njit
def backward(model: Model, q: FloatArray) -> Mat4:
    """Inverse of the forward kinematics, the reversed product of [RH00] eq. (6)."""
    H = IDENTITY
    for j in range(q.shape[0]):
        i = _in_order(model, j)
        amount = _true(model, q, i)
        H = mul(_joint_displacement(mat(model.H_hat_0[i]), model.prismatic[i], -amount), H)
    return H


@internal
def forward_between(model: Model, q: FloatArray, i: int, x: float) -> Mat4:
    """Forward kinematics, [RH00] eq. (6), interpolated by x from row i of joints (k, n) to the next."""
    H = IDENTITY
    for j in range(q.shape[1]):
        l = _in_order(model, j)
        amount = (1.0 - x) * float(q[i, l]) + x * float(q[i + 1, l]) - float(model.q_reference[l])
        if model.curve.terms.shape[0] > 0:
            amount += bend(model, q[i], q[i + 1], x, l)
        H = mul(H, _joint_displacement(mat(model.H_hat_0[l]), model.prismatic[l], amount))
    return H


@njit
def operators_at(model: Model, q: FloatArray, H_hat: FloatArray) -> Mat4:
    """Joint operators at q, [RH00] eq. (19) with the truncated product H̄_i of (6); returns the whole product.

    Ĥ_i(q) = H̄_i Ĥ_i⁰ H̄_i⁻¹ undoes the joint, moves it about its reference and redoes it. The joint's own
    factor of H̄_i commutes with Ĥ_i⁰ and is omitted. By readings that joints do not follow they are sums of
    these over joints, weighted with the derivatives of the curve.
    """
    n = q.shape[0]
    H = IDENTITY
    H_inverse = IDENTITY
    for j in range(n):
        i = _in_order(model, j)
        operator = mat(model.H_hat_0[i])
        moved = mul(mul(H, operator), H_inverse)
        if model.curve.terms.shape[0] > 0:
            for l in range(n):  # a reading moves all joints that bend by it
                before = multiple(0.0, operator) if j == 0 else mat(H_hat[l])
                mat_into(H_hat[l], combine(1.0, before, slope(model, q, i, l), moved))
        else:
            mat_into(H_hat[i], moved)
        amount = _true(model, q, i)
        if j == n - 1:
            H = mul(H, _joint_displacement(operator, model.prismatic[i], amount))
        elif model.prismatic[i]:
            H = mul(H, translation(operator, amount))
            H_inverse = mul(translation(operator, -amount), H_inverse)
        else:
            turn, turn_back = rotation_and_inverse(operator, amount)
            H = mul(H, turn)
            H_inverse = mul(turn_back, H_inverse)
    return H


@merged
def limit_distance(limits: JointLimits, q: FloatArray, i: int) -> float:
    """Distance of joint i of q (n,) from its nearer limit, rad or m; negative beyond it."""
    return min(float(q[i]) - float(limits.lower[i]), float(limits.upper[i]) - float(q[i]))


@merged
def beyond_limits(limits: JointLimits, q: FloatArray, slack: float) -> int:
    """First joint of q (n,) that is beyond its limits by more than a slack, rad or m; or −1."""
    for i in range(q.shape[0]):
        if not limit_distance(limits, q, i) >= -slack:
            return i
    return -1


@njit
def image_velocity(P: FloatArray, A: Vec4, D: Vec4) -> tuple[float, float, float, float]:
    """Pixel u, v of a point A in one camera, and its velocity for a velocity D of the point.

    [RH00] eq. (7), corrected. The point must not lie in the camera's principal plane.
    """
    m = (row(P, 0, A), row(P, 1, A), row(P, 2, A))
    d = (row(P, 0, D), row(P, 1, D), row(P, 2, D))
    u = m[0] / m[2]
    v = m[1] / m[2]
    return u, v, (d[0] - u * d[2]) / m[2], (d[1] - v * d[2]) / m[2]


@merged
def from_border(image_size: FloatArray, u: float, v: float) -> float:
    """Distance of a pixel from the border of an image, px; negative outside, ``BEHIND`` of none.

    The compiled twin of ``image_size.border_distance``, for one image of a width and height (2,).
    """
    if not math.isfinite(u + v):
        return BEHIND
    return min(u + 0.5, v + 0.5, float(image_size[0]) - 0.5 - u, float(image_size[1]) - 0.5 - v)


@inline
def row(P: FloatArray, i: int, A: tuple[float, float, float, float]) -> float:
    """Product of row i of a camera with a point, [RH00] eq. (1)."""
    return (float(P[i, 0]) * A[0] + float(P[i, 1]) * A[1]) + (float(P[i, 2]) * A[2] + float(P[i, 3]) * A[3])


def forward_kinematics(model: Model, q: FloatArray) -> FloatArray:
    """Displacement (4, 4) of the end-effector from the reference at joints (n,), rad or m: [RH00] eq. (6)."""
    return as_array(forward(model, np.array(q, dtype=np.float64)))  # a copy: of one layout, and writable


def joint_operators(model: Model, q: FloatArray) -> FloatArray:
    """Joint operators (n, 4, 4) at joints q (n,), rad or m: [RH00] eq. (19)."""
    H_hat = np.empty_like(model.H_hat_0)
    operators_at(model, np.array(q, dtype=np.float64), H_hat)
    return H_hat


def project(P: FloatArray, M: FloatArray, lens: FloatArray | None = None) -> FloatArray:
    """Pixels (V, ..., 2) of points (..., 4) by cameras (V, 3, 4) and lenses (V, 5), [RH00] eq. (1)."""
    m = np.einsum("vij,...j->v...i", P, M)
    pixels: FloatArray = m[..., :2] / m[..., 2:]
    if lens is None:
        return pixels
    return distort_visible(lens.reshape(len(lens), *(1,) * (m.ndim - 2), 5), pixels)


def image_jacobian(P: FloatArray, M: FloatArray, H_hat: FloatArray) -> FloatArray:
    """Interaction matrix (V, m, 2, n), joint to image velocities, px per rad or m: [RH00] eq. (7), corrected.

    For cameras (V, 3, 4), points (m, 4) and the operators (n, 4, 4) at the current joints. The vectorised
    twin of ``image_velocity``.
    """
    m = np.einsum("vij,kj->vki", P, M)[..., None]
    d = P[:, None] @ (H_hat @ M.T).transpose(2, 1, 0)
    return np.asarray((d[..., :2, :] - m[..., :2, :] / m[..., 2:, :] * d[..., 2:, :]) / m[..., 2:, :])
