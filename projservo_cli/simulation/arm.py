"""The true serial arm: its screws, forward and inverse kinematics, and the geometry of the rig before it."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from projservo_cli.geometry.displacements import rigid, twists
from projservo_cli.geometry.kinematics import forward_kinematics, joint_operators
from projservo_cli.records import BoolArray, FloatArray, JointLimits, Model, WorkFailed, no_lenses

METRIC_A_INF = np.array([0.0, 0.0, 0.0, 1.0])
# Mean of the viewing directions of a rig that has a roll axis, at least.
_COMMON = 0.1
# Screws of a shift along z and of a turn about it.
_Z_SHIFT, _Z_TURN = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0]), np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])


class SerialArm(NamedTuple):
    """True kinematics of a serial robot in its base frame."""

    H_hat_0: FloatArray  # (n, 4, 4) twists at the reference, per rad or m
    prismatic: BoolArray  # (n,) whether a joint is prismatic; otherwise it is revolute
    q_reference: FloatArray  # (n,) rad or m
    base_tool: FloatArray  # (4, 4) pose of the tool at the reference, m
    limits: JointLimits  # limits of the joints

    def model(self, P: FloatArray, lens: FloatArray | None = None, *, on_tool: bool = False) -> Model:
        """Metric model of the robot seen by the cameras P (V, 3, 4) with lenses (V, 5).

        on_tool : whether they are on the tool; P is then from the base frame at the reference.
        """
        return Model(
            P=np.ascontiguousarray(P, dtype=np.float64),
            H_hat_0=-self.H_hat_0 if on_tool else self.H_hat_0,
            prismatic=self.prismatic,
            q_reference=self.q_reference,
            a_inf=METRIC_A_INF.copy(),
            lens=no_lenses(len(P)) if lens is None else lens,
            on_tool=on_tool,
        )

    def pose(self, q: FloatArray) -> FloatArray:
        """Pose (4, 4) of the tool at the joints q (n,), m."""
        result: FloatArray = forward_kinematics(self.model(np.zeros((1, 3, 4))), q) @ self.base_tool
        return result


def camera_center(camera: FloatArray) -> FloatArray:
    """Optical centre (3,) of a metric camera (3, 4), m."""
    return np.asarray(-np.linalg.solve(camera[:, :3], camera[:, 3]))


def _optical_axis(camera: FloatArray) -> FloatArray:
    """Unit viewing direction (3,) of a metric camera (3, 4)."""
    forward_direction = np.linalg.det(camera[:, :3]) * camera[2, :3]
    return np.asarray(forward_direction / np.linalg.norm(forward_direction))


def roll_axis(P: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Roll axis of a rig: the point amid the optical centres, m, and the mean direction.

    P : (V, 3, 4) metric cameras. Raises WorkFailed if they look in directions that cancel.
    """
    point = np.sum([camera_center(camera) for camera in P], axis=0) / len(P)
    direction = np.sum([_optical_axis(camera) for camera in P], axis=0)
    if not np.linalg.norm(direction) > _COMMON * len(P):
        raise WorkFailed(
            "task.goal.roll_deg turns about the common direction of the cameras, and these look in "
            "directions that cancel: give task.goal.joints"
        )
    return point, direction / np.linalg.norm(direction)


class Link(NamedTuple):
    """A row of the table; the joint reading adds to theta (R) or d (P)."""

    type: str  # R or P
    theta: float  # turn about z, rad
    d: float  # shift along z, m
    a: float  # shift along x, m
    alpha: float  # turn about x, rad


def dh_twists(links: Sequence[Link], tool: FloatArray, *, modified: bool) -> tuple[FloatArray, FloatArray]:
    """Return the twists (n, 4, 4) of the joints at the reference, all joints zero, and the pose of the tool.

    tool : (4, 4) pose of the tool in the frame of the last joint, m.
    modified : in Craig's convention a and α come before θ and d.
    Source: P. Corke, Robotics, Vision and Control, 2nd ed., section 7.1.
    """
    T, H_hat = np.eye(4), []
    for link in links:
        turn = rigid(Rotation.from_rotvec([0.0, 0.0, link.theta]), [0.0, 0.0, link.d])
        tilt = rigid(Rotation.from_rotvec([link.alpha, 0.0, 0.0]), [link.a, 0.0, 0.0])
        if modified:
            T, tilt = T @ tilt, np.eye(4)
        axis = twists(_Z_SHIFT if link.type == "P" else _Z_TURN)
        H_hat.append(T @ axis @ np.linalg.inv(T))
        T = T @ turn @ tilt
    return np.array(H_hat), T @ tool


def inverse_kinematics(robot: SerialArm, goal: FloatArray, q_start: FloatArray) -> FloatArray:
    """Joints within the limits that put the tool at a pose, as near to the start as found.

    Damped Newton steps on the pose from the start and from 30 seeded places within the limits; the
    solution with the minimum joint motion wins. goal : (4, 4) pose of the tool, m; q_start : (n,) rad or m.
    """
    rng = np.random.default_rng(0)
    span_lower = np.maximum(robot.limits.lower, q_start - 2 * math.pi)
    span_upper = np.minimum(robot.limits.upper, q_start + 2 * math.pi)
    solutions = []
    for trial in range(31):
        q = _newton(robot, goal, q_start if trial == 0 else rng.uniform(span_lower, span_upper))
        if q is not None:
            q = _unwind(robot, q, q_start)
            if np.all(q >= robot.limits.lower) and np.all(q <= robot.limits.upper):
                solutions.append(q)
    if not solutions:
        x, y, z = goal[:3, 3]
        raise WorkFailed(
            f"task.goal: the robot cannot put its tool at ({x:.3f}, {y:.3f}, {z:.3f}) m with this rotation "
            "within its joint limits: choose a nearer goal, another start or wider limits"
        )
    return min(solutions, key=lambda q: float(np.linalg.norm(q - q_start)))


def _newton(robot: SerialArm, goal: FloatArray, q: FloatArray) -> FloatArray | None:
    """Damped Newton steps to a pose; None if they do not arrive.

    The truth of a simulation is a metric pose, to 1e-13, whereas planning has images of a face alone.
    """
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
        if len(q) > len(error):  # step of minimum norm
            step = J.T @ np.linalg.solve(J @ J.T + damping * np.eye(len(error)), error)
        else:
            step = np.linalg.solve(J.T @ J + damping * np.eye(len(q)), J.T @ error)
        q = q + step / max(1.0, float(np.abs(step).max()) / 0.5)
    return q if np.abs(error).max() < 1e-10 else None


def _unwind(robot: SerialArm, q: FloatArray, near: FloatArray) -> FloatArray:
    """Shift revolute joints by whole turns to within half a turn of ``near`` where limits allow."""
    turned = q.copy()
    for i, slides in enumerate(robot.prismatic):
        if slides:
            continue
        candidates = q[i] + 2 * math.pi * np.arange(-4, 5)
        inside = candidates[(candidates >= robot.limits.lower[i]) & (candidates <= robot.limits.upper[i])]
        if len(inside):
            turned[i] = inside[np.argmin(np.abs(inside - near[i]))]
    return turned
