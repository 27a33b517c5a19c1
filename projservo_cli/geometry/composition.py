"""Composition of two rotations about one point, and the angles that reach a plane."""

import math

from projservo_cli.geometry.algebra import Mat4, combine, mul
from projservo_cli.geometry.displacement import as_array, as_mat
from projservo_cli.geometry.jit import merged, njit
from projservo_cli.records import FloatArray, WorkFailed


@njit
def wrap(theta: float) -> float:
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

    Returns
    -------
    False and zeros where |p_0| exceeds the amplitude: the point never meets the plane.
    """
    amplitude = math.sqrt(p_s * p_s + p_c * p_c)
    if not abs(p_0) <= amplitude or not amplitude > 0.0:
        return False, 0.0, 0.0
    middle = math.atan2(p_s, p_c)
    spread = math.acos(-p_0 / amplitude)
    return True, wrap(middle + spread), wrap(middle - spread)


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

    Returns
    -------
    False where the rotation is the identity and has no axis.
    """
    sine = math.sqrt(cbh_a * cbh_a + cbh_b * cbh_b + cbh_c * cbh_c)
    if not sine > 0.0:
        return False, H_r
    bracket = combine(1.0, mul(H_r, H_p), -1.0, mul(H_p, H_r))
    H = combine(cbh_a, H_r, cbh_b, H_p)
    return True, combine(1.0 / sine, H, cbh_c / sine, bracket)


def compose_rotations(
    H_hat_r: FloatArray, H_hat_p: FloatArray, theta_r: float, theta_p: float
) -> tuple[float, FloatArray]:
    """Single rotation equal to exp(θ_r Ĥ_r) exp(θ_p Ĥ_p), [RH00] eqs. (24), (25) as corrected.

    Parameters
    ----------
    H_hat_r, H_hat_p : (4, 4) operators of rotations about perpendicular axes through one point.
    theta_r, theta_p : angles, rad.

    Returns
    -------
    theta_s : angle in [0, 2π), rad.
    H_hat_s : (4, 4) operator.

    Raises
    ------
    WorkFailed
        If the composition is the identity, which has no axis.
    """
    theta_s, a, b, c = composed_angle(float(theta_r), float(theta_p))
    found, H_s = composed_operator(as_mat(H_hat_r), as_mat(H_hat_p), a, b, c)
    if not found:
        raise WorkFailed("two rotations by 0° compose to the identity, which has no axis")
    return theta_s, as_array(H_s)


def angles_onto_plane(a: FloatArray, H_hat: FloatArray, A: FloatArray) -> tuple[float, float] | None:
    """Angles that rotate a point onto a plane, [RH00] eqs. (13)–(15) as corrected.

    Parameters
    ----------
    a : (4,) plane.
    H_hat : (4, 4) revolute operator.
    A : (4,) point.

    Returns
    -------
    θ⁺ and θ⁻ in (−π, π], rad; None where the point never meets the plane.
    """
    p_0, p_s, p_c = incidence_coefficients(a, H_hat, A)
    found, plus, minus = incidence_angles(p_0, p_s, p_c)
    return (plus, minus) if found else None


def incidence_coefficients(a: FloatArray, H_hat: FloatArray, A: FloatArray) -> tuple[float, float, float]:
    """Coefficients p_0, p_s, p_c of [RH00] eq. (14) for aᵀ H(θ) A.

    Parameters
    ----------
    a : (4,) plane.
    H_hat : (4, 4) revolute operator.
    A : (4,) point.
    """
    first = H_hat @ A
    second = H_hat @ first
    return float(a @ (A + second)), float(a @ first), float(-(a @ second))
