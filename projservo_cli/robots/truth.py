"""True robots and cameras from published dimensions."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from projservo_cli.geometry.kinematics import forward_kinematics, joint_operators
from projservo_cli.records import (
    PRISMATIC,
    REVOLUTE,
    FloatArray,
    InputError,
    IntArray,
    Model,
    WorkFailed,
)

METRIC_A_INF = np.array([0.0, 0.0, 0.0, 1.0])


class Robot(NamedTuple):
    """True kinematics of a serial robot in its base frame.

    Attributes
    ----------
    H_hat_0 : (n, 4, 4) twists at the reference, per rad or m.
    joint_types : (n,) ``REVOLUTE`` or ``PRISMATIC``.
    q_reference : (n,) rad or m.
    base_tool : (4, 4) pose of the tool at the reference, m.
    lower, upper : (n,) joint limits, rad or m.
    """

    H_hat_0: FloatArray
    joint_types: IntArray
    q_reference: FloatArray
    base_tool: FloatArray
    lower: FloatArray
    upper: FloatArray

    def model(self, P: FloatArray) -> Model:
        """Metric model of the robot seen by the cameras P (2, 3, 4)."""
        return Model(
            np.ascontiguousarray(P, dtype=np.float64),
            self.H_hat_0,
            self.joint_types,
            self.q_reference,
            METRIC_A_INF.copy(),
        )

    def pose(self, q: FloatArray) -> FloatArray:
        """Pose (4, 4) of the tool at the joints q (n,), m."""
        result: FloatArray = forward_kinematics(self.model(np.zeros((2, 3, 4))), q) @ self.base_tool
        return result


def twist(w: Sequence[float], v: Sequence[float]) -> FloatArray:
    """4×4 twist of an angular velocity w (rad) and a velocity v of the origin (m)."""
    return np.array([[0.0, -w[2], w[1], v[0]], [w[2], 0.0, -w[0], v[1]], [-w[1], w[0], 0.0, v[2]], [0.0] * 4])


def rigid(R: FloatArray, t: FloatArray) -> FloatArray:
    """4×4 displacement of a rotation (3, 3) and a translation (3,), m."""
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = t
    return T


def rotation_about_axis(point: FloatArray, direction: FloatArray, theta: float) -> FloatArray:
    """4×4 rotation by θ, rad, about the axis through a point (3,), m, along a direction (3,)."""
    R = Rotation.from_rotvec(theta * direction / np.linalg.norm(direction)).as_matrix()
    return rigid(R, point - R @ point)


def dh_robot(
    rows: Sequence[tuple[bool, float, float, float, float]],
    modified: bool,
    tool: FloatArray,
    limits: Sequence[tuple[float, float]],
) -> Robot:
    """Robot of a Denavit–Hartenberg table; its reference is all joints zero.

    rows : prismatic?, θ (rad), d (m), a (m), α (rad) of each joint; the joint variable is added to d or θ.
    modified : whether the table is in Craig's convention (a, α before θ, d) or the standard one.
    tool : (4, 4) pose of the tool in the last frame.
    limits : lower and upper limit of each joint, rad or m.
    Source: P. Corke, Robotics, Vision and Control, 2nd ed., section 7.1.
    """
    T = np.eye(4)
    twists = []
    for prismatic, theta, d, a, alpha in rows:
        turn = rigid(Rotation.from_rotvec([0.0, 0.0, theta]).as_matrix(), np.array([0.0, 0.0, d]))
        tilt = rigid(Rotation.from_rotvec([alpha, 0.0, 0.0]).as_matrix(), np.array([a, 0.0, 0.0]))
        if modified:
            T = T @ tilt
        axis = twist([0, 0, 0], [0, 0, 1]) if prismatic else twist([0, 0, 1], [0, 0, 0])
        twists.append(T @ axis @ np.linalg.inv(T))
        T = T @ turn if modified else T @ turn @ tilt
    types = np.array([PRISMATIC if row[0] else REVOLUTE for row in rows], dtype=np.int64)
    bounds = np.array(limits, dtype=np.float64)
    return Robot(
        np.array(twists),
        types,
        np.zeros(len(rows)),
        T @ tool,
        np.ascontiguousarray(bounds[:, 0]),
        np.ascontiguousarray(bounds[:, 1]),
    )


def look_at_camera(
    focal: Sequence[float],
    principal: Sequence[float],
    position: Sequence[float],
    target: Sequence[float],
    up: Sequence[float],
) -> FloatArray:
    """Camera (3, 4) to px at a position, m, with its optical axis through a target, m.

    ``up`` is a direction that appears upward in the image.

    Raises InputError if the camera sits on its target or looks along ``up``.
    """
    z = np.subtract(target, position)
    x = np.cross(z, up)
    if not np.linalg.norm(z) > 0 or not np.linalg.norm(x) > 1e-9 * np.linalg.norm(z):
        raise InputError("a camera must not sit at its target nor look along `up`")
    z = z / np.linalg.norm(z)
    x = x / np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    K = np.array([[focal[0], 0.0, principal[0]], [0.0, focal[1], principal[1]], [0.0, 0.0, 1.0]])
    camera: FloatArray = K @ np.c_[R, -R @ np.asarray(position)]
    return camera


def camera_center(camera: FloatArray) -> FloatArray:
    """Optical centre (3,) of a metric camera (3, 4), m."""
    return np.asarray(-np.linalg.solve(camera[:, :3], camera[:, 3]))


def _optical_axis(camera: FloatArray) -> FloatArray:
    """Unit viewing direction (3,) of a metric camera (3, 4)."""
    forward_direction = np.linalg.det(camera[:, :3]) * camera[2, :3]
    return np.asarray(forward_direction / np.linalg.norm(forward_direction))


def roll_axis(P: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Roll axis of a rig: the point midway between the optical centres, m, and the mean direction.

    P : (2, 3, 4) metric cameras.
    """
    point = 0.5 * (camera_center(P[0]) + camera_center(P[1]))
    direction = _optical_axis(P[0]) + _optical_axis(P[1])
    return point, direction / np.linalg.norm(direction)


def inverse_kinematics(robot: Robot, goal: FloatArray, q_start: FloatArray) -> FloatArray:
    """Joints within the limits that put the tool at a pose, as near to the start as found.

    Damped Newton steps on the pose from the start and from 30 seeded places within the limits; the
    solution with the least joint motion wins.

    goal : (4, 4) pose of the tool, m; q_start : (n,) rad or m.
    Raises WorkFailed if none of the starts reaches the goal within the limits.
    """
    rng = np.random.default_rng(0)
    span_lower = np.maximum(robot.lower, q_start - 2 * math.pi)
    span_upper = np.minimum(robot.upper, q_start + 2 * math.pi)
    best: FloatArray | None = None
    nearest = math.inf
    for trial in range(31):
        q = q_start if trial == 0 else rng.uniform(span_lower, span_upper)
        found = _newton(robot, goal, q)
        if found is None:
            continue
        found = _unwind(robot, found, q_start)
        if np.any(found < robot.lower) or np.any(found > robot.upper):
            continue
        distance = float(np.linalg.norm(found - q_start))
        if distance < nearest:
            nearest, best = distance, found
    if best is None:
        x, y, z = goal[:3, 3]
        raise WorkFailed(
            f"task.goal: the robot cannot put its tool at ({x:.3f}, {y:.3f}, {z:.3f}) m with this rotation "
            "within its joint limits: choose a nearer goal, another start or wider limits"
        )
    return best


def _newton(robot: Robot, goal: FloatArray, q: FloatArray) -> FloatArray | None:
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
        if len(q) > len(error):  # of least norm
            step = J.T @ np.linalg.solve(J @ J.T + damping * np.eye(len(error)), error)
        else:
            step = np.linalg.solve(J.T @ J + damping * np.eye(len(q)), J.T @ error)
        q = q + step / max(1.0, float(np.abs(step).max()) / 0.5)
    return q if np.abs(error).max() < 1e-10 else None


def _unwind(robot: Robot, q: FloatArray, near: FloatArray) -> FloatArray:
    """Shift revolute joints by whole turns to within half a turn of ``near`` where limits allow."""
    turned = q.copy()
    for i, kind in enumerate(robot.joint_types):
        if kind == PRISMATIC:
            continue
        candidates = q[i] + 2 * math.pi * np.arange(-4, 5)
        inside = candidates[(candidates >= robot.lower[i]) & (candidates <= robot.upper[i])]
        if len(inside):
            turned[i] = inside[np.argmin(np.abs(inside - near[i]))]
    return turned
