"""Ground truth (workspace) of a simulated experiment: the true robot, rig and markers."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from projservo_cli.geometry.kinematics import project
from projservo_cli.geometry.rigid import rigid
from projservo_cli.records import NO_LENS, BoolArray, FloatArray, Model
from projservo_cli.simulation.arm import Arm, about_axis, camera_center, roll_axis
from projservo_cli.simulation.ideal import Ends
from projservo_cli.simulation.inverse_kinematics import inverse_kinematics
from projservo_cli.task.face import center_of

_EDGE_ON = math.cos(math.radians(70.0))  # of the angle to a camera from which tags are not found


@dataclass(frozen=True, eq=False)
class Truth:
    """Robot, rig and markers as they are."""

    robot: Arm  # true kinematics
    P: FloatArray  # (2, 3, 4) true cameras, px
    M: FloatArray  # (m, 4) all markers at the robot's reference, m
    number: tuple[int, ...]  # (m,) their numbers
    face: tuple[int, ...]  # indices of the face markers; none where the configuration has no face
    center: int  # position of the centre marker within the face, or ``MIDPOINT``
    image_size: FloatArray  # (2, 2) width and height of each image, px
    lens: FloatArray = field(default_factory=NO_LENS.copy)  # (2, 5) true lenses
    # (m, 3) directions that markers look in at the robot's reference; zero where they are seen from anywhere
    normals: FloatArray = field(default_factory=lambda: np.zeros(3))

    @cached_property
    def model(self) -> Model:
        """Metric model, for the plant and for the law that is given one."""
        return self.robot.model(self.P)._replace(lens=self.lens)

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
        """Return the poses of the tool at the reference and at the goal joints (n,)."""
        base_tool, pose = self.robot.base_tool, self.robot.pose(q_goal)
        middle = np.array(center_of(self.M_face, self.center))
        return Ends(base_tool, pose, pose @ np.linalg.solve(base_tool, middle))

    def images(self, q: FloatArray, M: FloatArray) -> FloatArray:
        """True pixels (2, k, 2) of markers M (k, 4), given at the reference, at the joints q (n,)."""
        return project(self.P, M @ self.displacement(q).T, self.lens)

    def faces(self, q: FloatArray) -> BoolArray:
        """Whether markers look towards each camera (2, m) at the joints q (n,), and are not seen edge-on."""
        H = self.displacement(q)
        away = np.array([camera_center(camera) for camera in self.P])[:, None] - (self.M @ H.T)[:, :3]
        towards = (away * (self.normals @ H[:3, :3].T)).sum(axis=2) / np.linalg.norm(away, axis=2)
        return np.asarray((towards > _EDGE_ON) | ~self.normals.any(axis=-1))

    def within(self, pixels: FloatArray, view: int | slice = slice(None)) -> FloatArray:
        """Pixels (..., 2, m, 2), or (m, 2) of a view, NaN outside an image: centres reach to size − ½."""
        inside = (pixels >= -0.5) & (pixels <= self.image_size[view, ..., None, :] - 0.5)
        return np.where(inside.all(axis=-1, keepdims=True), pixels, np.nan)

    def displacement(self, q: FloatArray) -> FloatArray:
        """True displacement (4, 4) of the face from the reference at the joints q (n,)."""
        return self.robot.pose(q) @ self._from_tool

    @cached_property
    def _from_tool(self) -> FloatArray:
        return np.asarray(np.linalg.inv(self.robot.base_tool), dtype=np.float64)


class Turn(NamedTuple):
    """A goal that is a turn of the tool about the roll axis of the rig, perhaps displaced a little."""

    angle: float  # rad
    # translation along the axes of the tool, m, and rotation vector in them, rad; None for neither
    displacement: tuple[tuple[float, float, float], tuple[float, float, float]] | None

    def joints(self, arm: Arm, P: FloatArray, q_start: FloatArray) -> FloatArray:
        """Joints (n,) of an arm before cameras (2, 3, 4) after the turn from joints (n,), rad or m."""
        point, direction = roll_axis(P)
        pose = about_axis(point, direction, self.angle) @ arm.pose(q_start)
        if self.displacement is not None:
            t, v = (np.array(part) for part in self.displacement)
            angle = float(np.linalg.norm(v))
            turn = about_axis(np.zeros(3), v, angle) if angle > 0.0 else np.eye(4)
            pose = pose @ rigid(Rotation.identity(), t) @ turn
        return inverse_kinematics(arm, pose, q_start)


def metric_camera(P: FloatArray) -> FloatArray:
    """Camera (3, 4) in the scale that makes depths positive metres, which a given one is only up to."""
    scale = float(np.sign(np.linalg.det(P[:, :3])) * np.linalg.norm(P[2, :3]))
    return P / scale if abs(scale - 1.0) > 1e-12 else P


def look_at(
    K: FloatArray, position: Sequence[float], target: Sequence[float], up: Sequence[float]
) -> FloatArray:
    """Camera (3, 4) to px with intrinsics K (3, 3) at a position that looks at a target, m."""
    z = np.subtract(target, position)
    x = np.cross(z, up)
    z = z / np.linalg.norm(z)
    x = x / np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    return np.asarray(K @ np.c_[R, -R @ np.asarray(position)])
