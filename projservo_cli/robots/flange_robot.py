"""A robot whose controller takes poses of the flange, as a robot with six joints.

Its class says ``readings = "flange"``: it gives poses (4, 4) where others give joints, and takes one in
``command``. The controller finds the joints; a pose that it refuses ends the run in its words.
"""

from typing import Any, TypeVar, cast

import numpy as np

from projservo_cli.geometry.flange import FlangeChart, require_poses
from projservo_cli.records import FloatArray, InputError, WorkFailed, coordinate_names

# Value of ``readings`` of a class that takes poses.
_FLANGE = "flange"


class PoseRefused(Exception):  # noqa: N818  # a controller's answer and no error of a program
    """A controller refuses a pose, which its words explain."""


class FlangeRobot:
    """A robot of poses (4, 4) of the flange, m, by the contract of one of joints, in a chart.

    All other methods and attributes are the robot's own.
    """

    def __init__(self, robot: Any, chart: FlangeChart) -> None:
        self._robot, self._chart = robot, chart
        self.coordinates = coordinate_names(chart.record)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._robot, name)

    def read(self) -> tuple[Any, ...]:
        """Look once; poses become their six coordinates."""
        pose, *rest = self._robot.read()
        return self._coordinates(pose), *rest

    def joints(self) -> Any:
        """Coordinates (6,) of the pose of a robot without pixels, perhaps with their time, s."""
        found = self._robot.joints()
        if isinstance(found, tuple):
            return self._coordinates(found[0]), *found[1:]
        return self._coordinates(found)

    def command(self, target: FloatArray, speed: FloatArray, due: float) -> None:
        """Be at coordinates ``target`` (6,) at a time: the robot takes the pose, and its twist in the base.

        The twist (6,) is the velocity of the flange, m/s, then its angular velocity, rad/s.
        Raises WorkFailed, in the words of the controller, if it refuses the pose.
        """
        T = self._chart.poses(target[None])[0]
        rates = self._chart.turn_axes(target) @ speed[3:]
        try:
            self._robot.command(T, np.concatenate([speed[:3], rates]), due)
        except PoseRefused as refusal:
            at = ", ".join(f"{1e3 * value:.0f}" for value in T[:3, 3])
            raise WorkFailed(f"the controller refused the pose at ({at}) mm: {refusal}") from refusal

    def _coordinates(self, pose: Any) -> FloatArray:
        T = np.array(pose, dtype=np.float64)
        if T.shape != (4, 4):
            raise WorkFailed(
                f"a reading has the shape {T.shape}, not (4, 4), a pose of the flange in the base, m"
            )
        try:
            require_poses(T[None], ["a reading"])
        except InputError as error:
            raise WorkFailed(str(error)) from error
        return np.asarray(self._chart.coordinates(T[None])[0])


_Robot = TypeVar("_Robot")


def by_joints(robot: _Robot, name: str, chart: FloatArray | None) -> _Robot:
    """Return a robot of joints: itself, or one of poses of the flange in a chart (2, 4, 4).

    Raises InputError if one is of joints and the other of poses.
    """
    takes_poses = getattr(robot, "readings", "joints") == _FLANGE
    if chart is None:
        if takes_poses:
            raise InputError(f'{name}: takes poses of the flange (readings = "flange"): set robot.flange')
        return robot
    if not takes_poses:
        raise InputError(
            f"{name}: takes joints, and robot.flange is of a class with readings = 'flange': leave it out, "
            "or let the class take poses"
        )
    return cast(_Robot, FlangeRobot(robot, FlangeChart.from_record(chart)))
