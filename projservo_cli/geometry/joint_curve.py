"""True joints by readings: curves of gears and encoders, coupling, deflection under a weight at the tool."""

from functools import reduce

import numpy as np

from projservo_cli.geometry.displacements import displacements
from projservo_cli.records import BASIS, BoolArray, FloatArray, JointCurve

# Step of the differences by which a curve is differentiated, rad or m: third derivatives leave 1e-11 of it.
_STEP = 1e-5
_TORQUE = BASIS.index("torque")
_EVEN = [BASIS.index("square"), BASIS.index("versine")]


def basis(curve: JointCurve, prismatic: BoolArray, x: FloatArray) -> FloatArray:
    """Return φ (K, T) of each term at readings (K, n) from the reference, rad or m."""
    kind, joint, by = curve.terms[:, :3].astype(np.int64).T
    x_by, values = x[:, by], np.zeros((len(x), len(kind)))
    for index, phi in enumerate((x_by, x_by**2, x_by**3, np.sin(x_by), 1.0 - np.cos(x_by))):
        values = np.where(kind == index, phi, values)
    if (kind == _TORQUE).any():
        weight, twists = curve.arm[-1][:, 3], curve.arm[:-1]
        there = torques(twists, prismatic, weight, np.vstack([x, np.zeros((1, x.shape[1]))]))
        down = (there[:-1] - there[-1]) @ curve.arm[-1][:3, 0]
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


def torques(H_hat: FloatArray, prismatic: BoolArray, weight: FloatArray, q: FloatArray) -> FloatArray:
    """Return torques (K, n, 3) of a weight (4,) about each joint by the components of gravity.

    The torque of joint i is the velocity of the weight under it, H̄_i Ĥ_i H̄_i⁻¹ applied to the weight, along
    gravity. For twists (n, 4, 4) and joints (K, n) from the reference, rad or m.
    """
    joints, loads = np.arange(q.shape[1]), np.empty((*q.shape, 3))
    truncated = [
        reduce(np.matmul, displacements(H_hat, prismatic, np.where(joints <= i, q, 0.0))) for i in joints
    ]
    for i, H_bar in enumerate(truncated):
        behind = np.linalg.solve(H_bar, truncated[-1] @ weight[:, None])
        loads[:, i] = (H_bar @ (H_hat[i] @ behind))[:, :3, 0]
    return loads
