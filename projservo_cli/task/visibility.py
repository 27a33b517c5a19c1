"""Visibility of the face (self-occlusion), and the sense in which to turn it: [RH00] section 4.2.

The margin of a camera is a·O, with H⁻ᵀ moving the face; it changes sign exactly where the camera loses or
gains sight of the face. Signs are relative to the face at the start.
"""

import math

import numpy as np

from projservo_cli.geometry.algebra import Mat4, Vec4, apply, dot, incidence_angles, vec
from projservo_cli.geometry.jit import internal, merged, njit, separate
from projservo_cli.records import FloatArray
from projservo_cli.task.face import Task

# Angle from half a turn, rad, within which the previous sense is kept, so that noise makes no axis chatter.
CONTINUITY_BAND = 0.5
# Angle from half a turn, rad, within which it is one.
HALF_TURN_TOLERANCE = 1e-9


@njit
def margin_coefficients(a: Vec4, H_hat: Mat4, O: Vec4) -> tuple[float, float, float]:
    """Coefficients of the margin (H(θ)⁻ᵀ a)·O = c_0 + c_s sin θ + c_c cos θ, [RH00] eqs. (13), (14)."""
    first = apply(H_hat, O)
    second = apply(H_hat, first)
    return dot(a, O) + dot(a, second), -dot(a, first), -dot(a, second)


@merged
def arc_minimum(c_0: float, c_s: float, c_c: float, theta: float) -> float:
    """Minimum of c_0 + c_s sin t + c_c cos t for t between 0 and θ, |θ| ≤ 2π."""
    minimum = min(c_0 + c_c, c_0 + c_s * math.sin(theta) + c_c * math.cos(theta))
    if c_s == 0.0 and c_c == 0.0:
        return minimum
    trough = math.atan2(-c_s, -c_c)
    if theta >= 0.0 and trough < 0.0:
        trough += 2.0 * math.pi
    if theta < 0.0 and trough > 0.0:
        trough -= 2.0 * math.pi
    if abs(trough) <= abs(theta):
        minimum = min(minimum, c_0 - math.sqrt(c_s * c_s + c_c * c_c))
    return minimum


@merged
def limited_translation(a: Vec4, H_t: Mat4, amount: float, delta: float, task: Task) -> float:
    """Amplitude of a pure translation within δ τ_0 of all cameras, [RH00] section 4.2.

    ``amount`` ≥ 0 is the desired amplitude; the more conservative camera decides. A translated face changes
    visibility at τ_0, [RH00] eq. (11) on the optical centre.
    """
    for view in range(task.O.shape[0]):
        O = vec(task.O[view])
        rate = dot(a, apply(H_t, O))
        tau_0 = dot(a, O) / rate if rate != 0.0 else 0.0
        if task.visible[view] * dot(a, O) > 0.0 and tau_0 > 0.0:
            amount = min(amount, delta * tau_0)
    return amount


@merged
def _violations(a: Vec4, H_r: Mat4, theta: float, task: Task) -> tuple[int, float]:
    """Number of cameras that lose sight of the face while it turns by θ, and the worst margin ratio."""
    lost = 0
    worst = math.inf
    for view in range(task.O.shape[0]):
        sign = float(task.visible[view])
        c_0, c_s, c_c = margin_coefficients(a, H_r, vec(task.O[view]))
        start = abs(c_0 + c_c)
        minimum = arc_minimum(sign * c_0, sign * c_s, sign * c_c, theta)
        if minimum <= 0.0:
            lost += 1
        if start > 0.0:
            worst = min(worst, minimum / start)
    return lost, worst


@separate
@internal
def choose_sense(a: Vec4, a_t: Vec4, H_r: Mat4, theta: float, task: Task, against_previous: bool) -> float:
    """Sense of the rotation onto the target plane, [RH00] section 4.2: θ or θ − 2π, 0 ≤ θ ≤ π.

    Both senses bring the front onto the front. The choice is the sense in which fewer cameras lose sight;
    between equals, near half a turn the previous sense, otherwise the larger worst margin. The axis lies in
    the face, so a camera that sees the face at both ends of the shorter arc sees it throughout, and that
    common case needs no search.
    """
    visible = True
    for view in range(task.O.shape[0]):
        O = vec(task.O[view])
        sign = float(task.visible[view])
        visible = visible and sign * dot(a, O) > 0.0 and sign * dot(a_t, O) > 0.0
    near_half_turn = math.pi - theta < CONTINUITY_BAND
    if visible and math.pi - theta > HALF_TURN_TOLERANCE:
        return theta
    other = theta - 2.0 * math.pi
    lost, worst = _violations(a, H_r, theta, task)
    lost_other, worst_other = _violations(a, H_r, other, task)
    if lost != lost_other:
        return theta if lost < lost_other else other
    if near_half_turn:
        return other if against_previous else theta
    if lost > 0 and worst_other > worst:
        return other
    return theta


def visibility_translation(a: FloatArray, H_hat_t: FloatArray, O: FloatArray) -> float | None:
    """Amplitude τ_0 at which a translated face changes visibility, [RH00] section 4.2.

    a : (4,) plane of the face; H_hat_t : (4, 4) translation operator; O : (4,) optical centre.
    Returns τ_0 in the unit of the operator, or None if the translation never changes visibility.
    """
    rate = float(a @ H_hat_t @ O)
    if abs(rate) <= 1e-14 * float(np.linalg.norm(H_hat_t) * np.linalg.norm(a) * np.linalg.norm(O)):
        return None
    return float(a @ O) / rate


def visibility_angles(a: FloatArray, H_hat: FloatArray, O: FloatArray) -> tuple[float, float] | None:
    """Angles θ_0± at which a rotated face changes visibility, [RH00] section 4.2.

    a : (4,) plane of the face; H_hat : (4, 4) revolute operator; O : (4,) optical centre.
    Returns θ_0⁺ and θ_0⁻ in (−π, π], rad, or None if the rotation never changes visibility.
    """
    first = H_hat @ O
    second = H_hat @ first
    changes, plus, minus = incidence_angles(
        float(a @ (O + second)), float(-(a @ first)), float(-(a @ second))
    )
    return (plus, minus) if changes else None
