"""True joints by readings: curves of gears and encoders, coupling, deflection under weights."""

import math
from collections.abc import Callable
from itertools import accumulate

import numpy as np

from projservo_cli.deviations import BASIS
from projservo_cli.geometry.algebra import add, apply, dot, mat, vec
from projservo_cli.geometry.displacements import displacements, rotation, translation
from projservo_cli.geometry.jit import inline, internal
from projservo_cli.records import BoolArray, FloatArray, JointCurve, Model

# Step of the differences by which a curve is differentiated, rad or m: third derivatives leave 1e-11 of it.
_STEP = 1e-5
_SQUARE, _CUBE, _SINE, _VERSINE, _TORQUE, _SINE_OF_TWICE, _VERSINE_OF_TWICE = range(1, len(BASIS))
_EVEN = [_SQUARE, _VERSINE, _VERSINE_OF_TWICE]
# Functions of a reading from the reference, rad or m; a torque is one of all readings.
OF_READING: dict[str, Callable[[FloatArray], FloatArray]] = {
    "linear": lambda x: x,
    "square": lambda x: x**2,
    "cube": lambda x: x**3,
    "sine": np.sin,
    "versine": lambda x: 2.0 * np.sin(0.5 * x) ** 2,
    "sine of twice": lambda x: np.sin(2.0 * x),
    "versine of twice": lambda x: 2.0 * np.sin(x) ** 2,
}


def basis(curve: JointCurve, prismatic: BoolArray, x: FloatArray) -> FloatArray:
    """Return φ (K, T) of each term at readings (K, n) from the reference, rad or m."""
    kind, joint, by = curve.terms[:, :3].astype(np.int64).T
    x_by, values = x[:, by], np.zeros((len(x), len(kind)))
    for name, phi in OF_READING.items():
        of = kind == BASIS.index(name)
        values[:, of] = phi(x_by[:, of])
    if (kind == _TORQUE).any():
        there = torques(curve.arm[:-1, :4], prismatic, curve.arm[:, 4], np.vstack([x, 0.0 * x[:1]]))
        down = (there[:-1] - there[-1]) @ curve.arm[-1, 0, :3]
        values = np.where(kind == _TORQUE, down[:, joint], values)
    return np.asarray(values)


def true_joints(curve: JointCurve, prismatic: BoolArray, x: FloatArray) -> FloatArray:
    """Return the true joints (K, n) at readings (K, n), both from the reference, rad or m."""
    joint = curve.terms[:, 1].astype(np.int64)
    moved = basis(curve, prismatic, x) * curve.terms[:, 3]
    return np.asarray(x + moved @ (joint[:, None] == np.arange(x.shape[1])))


def slopes(curve: JointCurve, prismatic: BoolArray, x: FloatArray) -> FloatArray:
    """Return the derivatives (K, n, n) of true joints by readings, at readings (K, n) from the reference."""
    steps = _STEP * np.eye(x.shape[1])
    ends = [true_joints(curve, prismatic, x + sign * step) for step in steps for sign in (1.0, -1.0)]
    return np.stack([(a - b) / (2.0 * _STEP) for a, b in zip(ends[::2], ends[1::2], strict=True)], axis=2)


def backwards(curve: JointCurve, n: int) -> JointCurve:
    """Return the curve of n joints in reverse order and of opposite sign, without torques."""
    terms = curve.terms.copy()
    terms[:, 1:3] = n - 1 - terms[:, 1:3]
    terms[np.isin(terms[:, 0], _EVEN), 3] *= -1.0
    return JointCurve(terms, curve.arm)


def torques(twists: FloatArray, prismatic: BoolArray, weights: FloatArray, q: FloatArray) -> FloatArray:
    """Return torques (K, n, 3) about each joint by the components of gravity.

    The torque of joint i is the velocity of all weights under it, H̄_i Ĥ_i H̄_i⁻¹ applied to them, along
    gravity. For twists (n, 4, 4), a weight on each axis and at the tool (n + 1, 4), each a point times its
    mass, and joints (K, n) from the reference, rad or m.
    """
    E, n = displacements(twists, prismatic, q), q.shape[1]
    before = list(accumulate(E, np.matmul, initial=np.broadcast_to(np.eye(4), E.shape[1:])))
    loads, behind = np.empty((*q.shape, 3)), np.broadcast_to(weights[n], (len(q), 4))
    for i in range(n - 1, -1, -1):
        behind = (E[i] @ behind[..., None])[..., 0] + weights[i]
        loads[:, i] = (before[i] @ (behind @ twists[i].T)[..., None])[:, :3, 0]
    return loads


@inline
def _reading(model: Model, q: FloatArray, ahead: FloatArray, share: float, i: int) -> float:
    """Reading of joint i from the reference, interpolated by a share from joints q (n,) to those ahead."""
    return (1.0 - share) * float(q[i]) + share * float(ahead[i]) - float(model.q_reference[i])


@internal
def _torque(
    model: Model, q: FloatArray, ahead: FloatArray, share: float, i: int, j: int, step: float, moved: float
) -> float:
    """Torque about joint i with joint j a step farther, and all readings times ``moved``."""
    arm = model.curve.arm
    n = q.shape[0]
    v = vec(arm[n, 4])
    for k in range(n - 1, -1, -1):
        twist = mat(arm[k])
        amount = moved * _reading(model, q, ahead, share, k)
        if k == j:
            amount += step
        v = apply(translation(twist, amount), v) if model.prismatic[k] else apply(rotation(twist, amount), v)
        if k == i:
            v = apply(twist, add(v, vec(arm[k, 4])))
        elif k > i:
            v = add(v, vec(arm[k, 4]))
    return dot((float(arm[n, 0, 0]), float(arm[n, 0, 1]), float(arm[n, 0, 2]), 0.0), v)


@inline
def _value_and_slope(kind: int, x: float) -> tuple[float, float]:
    """Value of a function of a reading, by its index in ``BASIS``, and its derivative."""
    if kind == _SQUARE:
        return x * x, 2.0 * x
    if kind == _CUBE:
        return x * x * x, 3.0 * x * x
    if kind == _SINE:
        return math.sin(x), math.cos(x)
    if kind == _VERSINE:
        half = math.sin(0.5 * x)
        return 2.0 * half * half, math.sin(x)
    if kind == _SINE_OF_TWICE:
        return math.sin(2.0 * x), 2.0 * math.cos(2.0 * x)
    if kind == _VERSINE_OF_TWICE:
        return 2.0 * math.sin(x) ** 2, 2.0 * math.sin(2.0 * x)
    return x, 1.0


@internal
def bend(model: Model, q: FloatArray, ahead: FloatArray, share: float, i: int) -> float:
    """True joint i less its reading, interpolated by a share from joints q (n,) to those ahead, rad or m."""
    terms = model.curve.terms
    total = 0.0
    for t in range(terms.shape[0]):
        if int(terms[t, 1]) != i:
            continue
        if int(terms[t, 0]) == _TORQUE:
            value = _torque(model, q, ahead, share, i, -1, 0.0, 1.0)
            value -= _torque(model, q, ahead, share, i, -1, 0.0, 0.0)
        else:
            value = _value_and_slope(int(terms[t, 0]), _reading(model, q, ahead, share, int(terms[t, 2])))[0]
        total += float(terms[t, 3]) * value
    return total


@internal
def slope(model: Model, q: FloatArray, i: int, j: int) -> float:
    """Derivative of true joint i by the reading of joint j, at joints q (n,)."""
    terms = model.curve.terms
    total = 1.0 if i == j else 0.0
    for t in range(terms.shape[0]):
        kind = int(terms[t, 0])
        if int(terms[t, 1]) != i or (int(terms[t, 2]) != j and kind != _TORQUE):
            continue
        if kind == _TORQUE:
            farther = _torque(model, q, q, 0.0, i, j, _STEP, 1.0)
            by_reading = (farther - _torque(model, q, q, 0.0, i, j, -_STEP, 1.0)) / (2.0 * _STEP)
        else:
            by_reading = _value_and_slope(kind, _reading(model, q, q, 0.0, j))[1]
        total += float(terms[t, 3]) * by_reading
    return total
