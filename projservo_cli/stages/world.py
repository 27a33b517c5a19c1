"""The world of a simulated experiment: robot, rig and markers as a configuration describes them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from projservo_cli.geometry.kinematics import project
from projservo_cli.loop.summary import Ends
from projservo_cli.records import PRISMATIC, REVOLUTE, FloatArray, InputError, Model
from projservo_cli.robots.truth import (
    Robot,
    dh_robot,
    inverse_kinematics,
    look_at_camera,
    rigid,
    roll_axis,
    rotation_about_axis,
    twist,
)
from projservo_cli.task.face import MIDPOINT, center_of

if TYPE_CHECKING:
    from projservo_cli.config import Config
    from projservo_cli.config.models import Goal
    from projservo_cli.config.robot import Camera, JointVector, Markers, Rig, RobotSettings


class Joints(NamedTuple):
    """What a configuration says of the joints."""

    types: str  # one letter a joint, R or P
    lower: FloatArray
    upper: FloatArray  # lower, upper: (n,) limits, rad or m; infinite where none is set
    speed: FloatArray  # (n,) most motion per second, rad/s or m/s; infinite for none


def outside(q: FloatArray, lower: FloatArray, upper: FloatArray) -> str:
    """Which of the readings (n,) lies beyond its limits, in words; empty where none does."""
    for i in np.flatnonzero((q < lower) | (q > upper)):
        limits = f"{lower[i]:.6g} to {upper[i]:.6g} (rad or m)"
        return f"joint {i + 1} would be at {q[i]:.6g}, beyond its limits {limits}"
    return ""


def reference_of(config: "Config") -> "JointVector | None":
    """Joints around which the trial motions are made."""
    start = config.task.start if config.task is not None else None
    return config.calibration.reference or start


def joints_of(config: "Config", default_types: str = "") -> Joints:
    """Joints of the robot; of the calibration's ``default_types`` where the configuration does not tell."""
    vector = reference_of(config)
    types = config.joint_types or default_types or "R" * (len(vector.joints) if vector is not None else 0)
    robot = config.robot
    bounds = robot.limits if robot is not None else ((-math.inf, math.inf),) * len(types)
    c = config.control
    revolute = math.inf if c.joint_speed_limit_deg_s is None else math.radians(c.joint_speed_limit_deg_s)
    prismatic = math.inf if c.prismatic_speed_limit_m_s is None else c.prismatic_speed_limit_m_s
    lower, upper = np.array(bounds, dtype=np.float64).reshape(-1, 2).T.copy()
    speed = np.array([prismatic if kind == "P" else revolute for kind in types])
    return Joints(types, lower, upper, speed)


def has_task(config: "Config") -> bool:
    """Whether there is a robot with a task; a recorded run may be reported on without."""
    return not config.recorded or None not in (config.robot, config.rig, config.markers, config.task)


def image_size_of(config: "Config") -> tuple[int, int] | None:
    """Width and height of the images, px, if they are known."""
    if config.data is not None and config.data.image_size_px is not None:
        return config.data.image_size_px
    return config.rig.image_size_px if config.rig is not None else None


@dataclass(frozen=True, eq=False)
class Truth:
    """Robot, rig and markers as they are."""

    robot: Robot  # true kinematics
    P: FloatArray  # (2, 3, 4) true cameras, px
    M: FloatArray  # (m, 4) all markers at the robot's reference, m
    number: tuple[int, ...]  # (m,) their numbers
    face: tuple[int, ...]  # indices of the face markers; none where the configuration has no face
    center: int  # position of the centre marker within the face, or ``MIDPOINT``
    image_size: FloatArray  # (2,) px

    @cached_property
    def model(self) -> Model:
        """Metric model, for the plant and for the law that is given one."""
        return self.robot.model(self.P)

    @cached_property
    def M_face(self) -> FloatArray:
        """Face markers (k, 4) at the robot's reference, m."""
        return np.ascontiguousarray(self.M[list(self.face)])

    @cached_property
    def pins(self) -> tuple[int, ...]:
        """Indices of the markers that are not on the face."""
        return tuple(i for i in range(len(self.M)) if i not in self.face)

    def of(self, numbers: Sequence[int]) -> FloatArray:
        """Markers (k, 4) of some numbers at the robot's reference, m."""
        return np.ascontiguousarray(self.M[[self.number.index(number) for number in numbers]])

    def ends(self, q_goal: FloatArray) -> Ends:
        """Where the robot holds the tool at its reference and at the goal joints (n,)."""
        base_tool, pose = self.robot.base_tool, self.robot.pose(q_goal)
        middle = np.array(center_of(self.M_face, self.center))
        return Ends(base_tool, pose, pose @ np.linalg.solve(base_tool, middle))

    def images(self, q: FloatArray, M: FloatArray) -> FloatArray:
        """True pixels (2, k, 2) of markers M (k, 4), given at the reference, at the joints q (n,)."""
        return project(self.P, M @ self.displacement(q).T)

    def displacement(self, q: FloatArray) -> FloatArray:
        """True displacement (4, 4) of the face from the reference at the joints q (n,)."""
        return self.robot.pose(q) @ self._from_tool

    @cached_property
    def _from_tool(self) -> FloatArray:
        return np.asarray(np.linalg.inv(self.robot.base_tool), dtype=np.float64)


def face_numbers(config: "Config") -> tuple[int, ...]:
    """Numbers of the face markers."""
    if config.markers is None or config.markers.face is None:
        raise InputError(
            "this stage needs to know the face: set markers.face to three marker numbers or more"
        )
    return config.markers.face


def center_index(config: "Config") -> int:
    """Position of the centre marker within the face, or ``MIDPOINT``."""
    face = face_numbers(config)
    assert config.markers is not None
    center = config.markers.center
    return MIDPOINT if center == "midpoint" else face.index(center)


def truth_of(config: "Config") -> Truth:
    """Build the truth, or find it again where it was built for another seed or task.

    Raises InputError if the configuration lacks a part of it, naming the key to set.
    """
    if config.robot is None:
        raise InputError("this stage drives a simulated robot: set robot.dh or robot.screws")
    if config.rig is None:
        raise InputError("this stage needs a simulated rig: set rig.left, rig.right and rig.image_size_px")
    if config.markers is None or config.markers.positions_m is None:
        raise InputError("this stage needs the markers of the simulated robot: set markers.positions_m")
    return _built(config.robot, config.rig, config.markers)


@lru_cache(maxsize=16)
def _built(described: "RobotSettings", rig: "Rig", markers: "Markers") -> Truth:
    robot = robot_of(described)
    numbers = markers.known
    assert numbers is not None
    points = np.c_[np.array(markers.positions_m), np.ones(len(numbers))]
    face = markers.face or ()
    return Truth(
        robot,
        np.array([camera_of(rig.left), camera_of(rig.right)]),
        points @ robot.base_tool.T,
        numbers,
        tuple(numbers.index(number) for number in face),
        face.index(markers.center) if face and markers.center != "midpoint" else MIDPOINT,
        np.array(rig.image_size_px, dtype=np.float64),
    )


def robot_of(described: "RobotSettings") -> Robot:
    """Robot of a DH table or of screws."""
    limits = described.limits
    if described.dh is not None:
        table = described.dh
        rows = [
            (j.type == "P", math.radians(j.theta_deg), j.d_m, j.a_m, math.radians(j.alpha_deg))
            for j in table.joints
        ]
        return dh_robot(rows, table.convention == "modified", np.array(table.tool), limits)
    screws = described.screws
    assert screws is not None
    types = described.joint_types
    bounds = np.array(limits)
    return Robot(
        np.array([twist(j.w, j.v) for j in screws.joints]),
        np.array([PRISMATIC if t == "P" else REVOLUTE for t in types], dtype=np.int64),
        np.array(screws.reference.values(types)),
        np.array(screws.base_tool),
        np.ascontiguousarray(bounds[:, 0]),
        np.ascontiguousarray(bounds[:, 1]),
    )


def camera_of(camera: "Camera") -> FloatArray:
    """Camera (3, 4) to px of its matrix or its look-at description."""
    if camera.matrix is not None:
        P = np.array(camera.matrix)
        # A camera is given up to scale; the loop needs the scale that makes depths positive metres.
        scale = float(np.sign(np.linalg.det(P[:, :3])) * np.linalg.norm(P[2, :3]))
        if scale == 0.0:
            raise InputError("rig: a camera matrix needs an invertible left 3×3 block: a finite camera")
        return P / scale if abs(scale - 1.0) > 1e-12 else P
    assert camera.focal_px is not None
    assert camera.principal_point_px is not None
    assert camera.position_m is not None
    assert camera.target_m is not None
    return look_at_camera(
        camera.focal_px, camera.principal_point_px, camera.position_m, camera.target_m, camera.up
    )


def turned(truth: Truth, q_start: FloatArray, goal: "Goal") -> FloatArray:
    """Joints after a turn about the roll axis of the rig and a small displacement of the tool, rad or m."""
    assert goal.turn_deg is not None
    point, direction = roll_axis(truth.P)
    pose = rotation_about_axis(point, direction, math.radians(goal.turn_deg)) @ truth.robot.pose(q_start)
    if goal.perturbation is not None:
        v = np.array(goal.perturbation.rotation_rad)
        t = np.array(goal.perturbation.translation_m)
        angle = float(np.linalg.norm(v))
        turn = rotation_about_axis(np.zeros(3), v, angle) if angle > 0.0 else np.eye(4)
        pose = pose @ rigid(np.eye(3), t) @ turn
    return inverse_kinematics(truth.robot, pose, q_start)
