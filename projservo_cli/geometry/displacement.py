"""Projective displacements between the group and its algebra: [RH00] equations (2), (4), (5), and (24)."""

import math

import numpy as np

from projservo_cli.geometry.algebra import Mat4, combine, mul
from projservo_cli.geometry.jit import inline, merged, njit
from projservo_cli.records import FloatArray, WorkFailed

IDENTITY: Mat4 = (1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)


@inline
def rotation(H_hat: Mat4, theta: float) -> Mat4:
    """Projective rotation I + sin θ Ĥ + (1 − cos θ) Ĥ² of [RH00] eq. (4), θ in rad."""
    half = math.sin(0.5 * theta)
    return _turned(H_hat, mul(H_hat, H_hat), 2.0 * half * math.cos(0.5 * theta), 2.0 * half * half)


@inline
def rotation_and_inverse(H_hat: Mat4, theta: float) -> tuple[Mat4, Mat4]:
    """Projective rotation of [RH00] eq. (4), θ in rad, and its inverse."""
    half = math.sin(0.5 * theta)
    sine, versine = 2.0 * half * math.cos(0.5 * theta), 2.0 * half * half
    squared = mul(H_hat, H_hat)
    return _turned(H_hat, squared, sine, versine), _turned(H_hat, squared, -sine, versine)


@inline
def _turned(H_hat: Mat4, H_hat_squared: Mat4, sine: float, versine: float) -> Mat4:
    """Sum I + sin θ Ĥ + (1 − cos θ) Ĥ²."""
    H = combine(sine, H_hat, versine, H_hat_squared)
    return (
        1.0 + H[0], H[1], H[2], H[3],
        H[4], 1.0 + H[5], H[6], H[7],
        H[8], H[9], 1.0 + H[10], H[11],
        H[12], H[13], H[14], 1.0 + H[15],
    )  # fmt: skip


@inline
def translation(H_hat: Mat4, tau: float) -> Mat4:
    """Projective translation I + τ Ĥ of [RH00] eq. (5)."""
    return combine(1.0, IDENTITY, tau, H_hat)


def exp_rotation(H_hat: FloatArray, theta: float) -> FloatArray:
    """Projective rotation (4, 4) of a revolute operator (4, 4) by an angle, rad: [RH00] eq. (4)."""
    return as_array(rotation(as_mat(H_hat), float(theta)))


def normalize_displacement(H: FloatArray, A: FloatArray, a_inf: FloatArray) -> FloatArray:
    """Scale a 4×4 homography to a displacement with det H = 1, [RH00] eq. (2).

    The determinant leaves ±H (4, 4); the sign is the one that keeps that of a_inf·A for points A (..., 4).

    Raises WorkFailed if det H is not positive: then H is no displacement.
    """
    determinant = float(np.linalg.det(H))
    if not determinant > 0.0:
        raise WorkFailed(
            f"a homography with determinant {determinant:.3g} is no displacement: check the correspondences"
        )
    result: FloatArray = H / determinant**0.25
    if np.sum((A @ a_inf) * (A @ result.T @ a_inf)) < 0.0:
        result = -result
    return result


def as_mat(H: FloatArray) -> Mat4:
    """(4, 4) array as the tuple of sixteen floats the kernels take."""
    return tuple(H.ravel().tolist())  # type: ignore[return-value]  # the type knows any number


def as_array(H: Mat4) -> FloatArray:
    """Tuple of sixteen floats as a (4, 4) array."""
    return np.array(H, dtype=np.float64).reshape(4, 4)


@inline
def twist_exponential(X: Mat4) -> Mat4:
    """Displacement exp(X) of any twist, rotation and translation together.

    Rodrigues' formula with the cubic term, I + X + (1 − cos θ)/θ² X² + (θ − sin θ)/θ³ X³ with
    θ² = −trace(X²)/2; below θ = 1e-4 the coefficients are their series, exact to 1e-18.
    """
    X2 = mul(X, X)
    square = max(-0.5 * (X2[0] + X2[5] + X2[10] + X2[15]), 0.0)
    theta = math.sqrt(square)
    if theta < 1e-4:
        second = 0.5 - square / 24.0
        third = 1.0 / 6.0 - square / 120.0
    else:
        half = math.sin(0.5 * theta)
        second = 2.0 * half * half / square
        third = (theta - math.sin(theta)) / (square * theta)
    H = combine(1.0, X, second, X2)
    return combine(1.0, IDENTITY, 1.0, combine(1.0, H, third, mul(X2, X)))


@njit
def _wrap(theta: float) -> float:
    """Equal angle in (−π, π], rad."""
    turns = math.floor((theta + math.pi) / (2.0 * math.pi))
    wrapped = theta - 2.0 * math.pi * turns
    if wrapped <= -math.pi:
        wrapped += 2.0 * math.pi
    return wrapped


@njit
def incidence_angles(p_0: float, p_s: float, p_c: float) -> tuple[bool, float, float]:
    """Solutions of p_0 + p_s sin θ + p_c cos θ = 0, [RH00] eqs. (14), (15) as corrected.

    θ± = atan2(p_s, p_c) ± arccos(−p_0 / √(p_s² + p_c²)), each in (−π, π]. The printed
    θ⁻ = π − θ⁺ holds only where p_c = 0.

    Returns false and zeros where |p_0| exceeds the amplitude: the point never meets the plane.
    """
    amplitude = math.sqrt(p_s * p_s + p_c * p_c)
    if not abs(p_0) <= amplitude or not amplitude > 0.0:
        return False, 0.0, 0.0
    middle = math.atan2(p_s, p_c)
    spread = math.acos(-p_0 / amplitude)
    return True, _wrap(middle + spread), _wrap(middle - spread)


@njit
def composed_angle(theta_r: float, theta_p: float) -> tuple[float, float, float, float]:
    """Angle θ_s in [0, 2π) and coefficients a, b, c of [RH00] eqs. (24), (25), c as corrected.

    The axes are perpendicular, so cos(θ_s/2) = cos(θ_r/2) cos(θ_p/2).
    """
    sr = math.sin(0.5 * theta_r)
    cr = math.cos(0.5 * theta_r)
    sp = math.sin(0.5 * theta_p)
    cp = math.cos(0.5 * theta_p)
    cbh_a = sr * cp
    cbh_b = cr * sp
    cbh_c = sp * sr
    sine = math.sqrt(cbh_a * cbh_a + cbh_b * cbh_b + cbh_c * cbh_c)
    return 2.0 * math.atan2(sine, cr * cp), cbh_a, cbh_b, cbh_c


@merged
def composed_operator(H_r: Mat4, H_p: Mat4, cbh_a: float, cbh_b: float, cbh_c: float) -> tuple[bool, Mat4]:
    """Operator Ĥ_s of the single rotation equal to both, [RH00] eq. (24).

    Returns false where the rotation is the identity and has no axis.
    """
    sine = math.sqrt(cbh_a * cbh_a + cbh_b * cbh_b + cbh_c * cbh_c)
    if not sine > 0.0:
        return False, H_r
    bracket = combine(1.0, mul(H_r, H_p), -1.0, mul(H_p, H_r))
    H = combine(cbh_a, H_r, cbh_b, H_p)
    return True, combine(1.0 / sine, H, cbh_c / sine, bracket)
