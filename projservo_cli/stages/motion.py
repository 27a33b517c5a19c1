"""Joints, their limits and driving them to given readings, simulated or not."""

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from projservo_cli.records import FloatArray, InputError, WorkFailed
from projservo_cli.robots import plugins
from projservo_cli.robots.yours import METHODS, ForeignRobot, Robot

if TYPE_CHECKING:
    from projservo_cli.config import Config
    from projservo_cli.config.robot import JointVector

ARRIVED = 1e-3  # rad or m: a robot this near to where it was sent is there
SETTLE = 10  # further commands for what rounding or a controller left at the end of a motion


class Joints(NamedTuple):
    """What a configuration says of the joints.

    Attributes
    ----------
    types : one letter a joint, R or P.
    lower, upper : (n,) limits, rad or m; infinite where none is set.
    speed : (n,) most motion per second, rad/s or m/s; infinite for none.
    """

    types: str
    lower: FloatArray
    upper: FloatArray
    speed: FloatArray

    def require_inside(self, q: FloatArray, where: str) -> None:
        """Refuse readings (n,) outside the limits."""
        for i in np.flatnonzero((q < self.lower) | (q > self.upper)):
            raise InputError(
                f"{where} puts joint {i + 1} at {q[i]:.6g}, beyond its limits {self.lower[i]:.6g} to "
                f"{self.upper[i]:.6g} (rad or m): choose another"
            )


def joints_of(config: "Config", default_types: str = "") -> Joints:
    """Joints of the robot, or of the table where the configuration has no model of the robot.

    Parameters
    ----------
    default_types : one letter a joint, where the configuration does not tell; else all revolute.
    """
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


def reference_of(config: "Config") -> "JointVector | None":
    """Joints around which the trial motions are made."""
    start = config.task.start if config.task is not None else None
    return config.calibration.reference or start


def foreign_robot(config: "Config", joints: Joints, markers: int) -> ForeignRobot:
    """Make the robot of ``plant.use``.

    Raises
    ------
    InputError
        If there is no such class, or a joint has no speed limit.
    WorkFailed
        If it cannot be made.
    """
    target = config.plant.use
    assert target is not None
    for kind, key in (("R", "joint_speed_limit_deg_s"), ("P", "prismatic_speed_limit_m_s")):
        if kind in joints.types and getattr(config.control, key) is None:
            raise InputError(
                f"plant {target}: a robot that is not simulated needs a limit: set control.{key}"
            )
    robot: Robot = plugins.make("plant", target, METHODS, (), config.plant.options.values())
    return ForeignRobot(robot, f"plant {target}", len(joints.types), markers, config.plant.timeout_s)


def drive_to(robot: Robot, target: FloatArray, limit: FloatArray, period: float, what: str = "record") -> int:
    """Move along a straight line in joint space, each command within the limit; the number of commands.

    Parameters
    ----------
    robot : what is driven.
    target : (n,) joints to arrive at, rad or m.
    limit : (n,) largest step of each joint, rad or m.
    period : control period, s.
    what : the command it is for, in messages.

    Raises
    ------
    WorkFailed
        If the robot is farther than ``ARRIVED`` from the target in the end.
    """
    gap = target - robot.joints()
    most = math.ceil(float(np.max(np.abs(gap) / limit))) + SETTLE
    count = 0
    while gap.any() and count < most:
        robot.command(gap / max(1.0, float(np.max(np.abs(gap) / limit))), period)
        count += 1
        gap = target - robot.joints()
    if not near(target - gap, target):
        i = int(np.argmax(np.abs(gap)))
        raise WorkFailed(
            f"{what}: joint {i + 1} was sent to {target[i]:.6g} and stands at {target[i] - gap[i]:.6g} (rad "
            "or m): look what holds the robot, then run the command again"
            + (" to continue" if what == "record" else "")
        )
    return count


def near(q: FloatArray, target: FloatArray) -> bool:
    """Whether a robot with readings q (n,) is where it was sent."""
    return bool(np.abs(q - target).max() <= ARRIVED)
