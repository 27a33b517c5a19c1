"""Inverse kinematics of a simulated arm: joints that put its tool at a pose."""

import math

import numpy as np
from scipy.spatial.transform import Rotation

from projservo_cli.geometry.kinematics import forward_kinematics, joint_operators
from projservo_cli.records import PRISMATIC, FloatArray, WorkFailed
from projservo_cli.simulation.arm import Arm


def inverse_kinematics(robot: Arm, goal: FloatArray, q_start: FloatArray) -> FloatArray:
    """Joints within the limits that put the tool at a pose, as near to the start as found.

    Damped Newton steps on the pose from the start and from 30 seeded places within the limits; the
    solution with the minimum joint motion wins. goal : (4, 4) pose of the tool, m; q_start : (n,) rad or m.
    """
    rng = np.random.default_rng(0)
    span_lower = np.maximum(robot.limits.lower, q_start - 2 * math.pi)
    span_upper = np.minimum(robot.limits.upper, q_start + 2 * math.pi)
    found = []
    for trial in range(31):
        q = _newton(robot, goal, q_start if trial == 0 else rng.uniform(span_lower, span_upper))
        if q is not None:
            q = _unwind(robot, q, q_start)
            if np.all(q >= robot.limits.lower) and np.all(q <= robot.limits.upper):
                found.append(q)
    if not found:
        x, y, z = goal[:3, 3]
        raise WorkFailed(
            f"task.goal: the robot cannot put its tool at ({x:.3f}, {y:.3f}, {z:.3f}) m with this rotation "
            "within its joint limits: choose a nearer goal, another start or wider limits"
        )
    return min(found, key=lambda q: float(np.linalg.norm(q - q_start)))


def _newton(robot: Arm, goal: FloatArray, q: FloatArray) -> FloatArray | None:
    """Damped Newton steps to a pose; None where they do not arrive."""
    model = robot.model(np.zeros((2, 3, 4)))
    for _ in range(40):
        pose = forward_kinematics(model, q) @ robot.base_tool
        gap = goal @ np.linalg.inv(pose)
        error = np.r_[Rotation.from_matrix(gap[:3, :3]).as_rotvec(), goal[:3, 3] - pose[:3, 3]]
        if np.abs(error).max() < 1e-13:
            return q
        H_hat = joint_operators(model, q)
        tip = H_hat @ pose[:, 3]
        J = np.stack([H_hat[:, 2, 1], H_hat[:, 0, 2], H_hat[:, 1, 0], *tip.T[:3]])
        damping = 1e-9 * float(error @ error)
        if len(q) > len(error):  # of minimum norm
            step = J.T @ np.linalg.solve(J @ J.T + damping * np.eye(len(error)), error)
        else:
            step = np.linalg.solve(J.T @ J + damping * np.eye(len(q)), J.T @ error)
        q = q + step / max(1.0, float(np.abs(step).max()) / 0.5)
    return q if np.abs(error).max() < 1e-10 else None


def _unwind(robot: Arm, q: FloatArray, near: FloatArray) -> FloatArray:
    """Shift revolute joints by whole turns to within half a turn of ``near`` where limits allow."""
    turned = q.copy()
    for i, kind in enumerate(robot.joint_types):
        if kind == PRISMATIC:
            continue
        candidates = q[i] + 2 * math.pi * np.arange(-4, 5)
        inside = candidates[(candidates >= robot.limits.lower[i]) & (candidates <= robot.limits.upper[i])]
        if len(inside):
            turned[i] = inside[np.argmin(np.abs(inside - near[i]))]
    return turned
