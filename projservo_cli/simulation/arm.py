"""The true kinematics of a serial arm, and the geometry of the rig before it."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from projservo_cli.geometry.displacements import rigid
from projservo_cli.geometry.kinematics import forward_kinematics
from projservo_cli.records import FloatArray, IntArray, JointLimits, Model

METRIC_A_INF = np.array([0.0, 0.0, 0.0, 1.0])


class Arm(NamedTuple):
    """True kinematics of a serial robot in its base frame."""

    H_hat_0: FloatArray  # (n, 4, 4) twists at the reference, per rad or m
    joint_types: IntArray  # (n,) ``REVOLUTE`` or ``PRISMATIC``
    q_reference: FloatArray  # (n,) rad or m
    base_tool: FloatArray  # (4, 4) pose of the tool at the reference, m
    limits: JointLimits  # of the joints

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


def twist(w: Sequence[float], v: Sequence[float]) -> FloatArray:
    """4×4 twist of an angular velocity w (rad) and a velocity v of the origin (m)."""
    return np.array([[0.0, -w[2], w[1], v[0]], [w[2], 0.0, -w[0], v[1]], [-w[1], w[0], 0.0, v[2]], [0.0] * 4])


def about_axis(point: FloatArray, direction: FloatArray, theta: float) -> FloatArray:
    """4×4 rotation by θ, rad, about the axis through a point (3,), m, along a direction (3,)."""
    R = Rotation.from_rotvec(theta * direction / np.linalg.norm(direction))
    return rigid(R, point - R.as_matrix() @ point)
