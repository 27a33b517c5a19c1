"""The robot of ``plant.use``: made, checked against the calibration, and driven to given joints."""

import math
from typing import TYPE_CHECKING

import numpy as np

from projservo_cli.calibration import WINDOW, Innovation
from projservo_cli.records import FloatArray, InputError, WorkFailed
from projservo_cli.robots import plugins
from projservo_cli.robots.simulated import Plant
from projservo_cli.robots.yours import METHODS, DrivenRobot, ForeignRobot, Robot
from projservo_cli.stages.scenario import Scenario, noise_px, observed
from projservo_cli.stages.world import Joints

if TYPE_CHECKING:
    from projservo_cli.config import Config

ARRIVED = 1e-3  # rad or m: a robot this near to where it was sent is there
SETTLE = 10  # further commands for what rounding or a controller left at the end of a motion


def foreign_robot(config: "Config", joints: Joints, markers: int) -> ForeignRobot:
    """Make the robot of ``plant.use``.

    Raises InputError if there is no such class, or a joint has no speed limit; WorkFailed if it cannot be
    made.
    """
    target = config.plant.use
    assert target is not None
    for kind, key in (("R", "joint_speed_limit_deg_s"), ("P", "prismatic_speed_limit_m_s")):
        if kind in joints.types and getattr(config.control, key) is None:
            raise InputError(
                f"plant {target}: a robot that is not simulated needs a limit: set control.{key}"
            )
    robot: Robot = plugins.make("plant", target, METHODS, (), config.plant.options)
    return ForeignRobot(robot, f"plant {target}", len(joints.types), markers, config.plant.timeout_s)


def drive_to(robot: Robot, target: FloatArray, limit: FloatArray, period: float, what: str = "record") -> int:
    """Move along a straight line in joint space, each command within the limit; the number of commands.

    robot : what is driven.
    target : (n,) joints to arrive at, rad or m.
    limit : (n,) largest step of each joint, rad or m.
    period : control period, s.
    what : the command it is for, in messages.
    Raises WorkFailed if the robot is farther than ``ARRIVED`` from the target in the end.
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


def step_limit(config: "Config", joints: Joints) -> FloatArray:
    """Largest joint step (n,) in one control period, rad or m; infinite without a speed limit."""
    return joints.speed * config.control.period_s * config.plant.speed_scale


def connected(scenario: Scenario, law: str) -> tuple[ForeignRobot, DrivenRobot]:
    """The robot, and as the loop of a law sees it: beside the plant that the calibration takes it for."""
    numbers, plant = observed(scenario.config, scenario.calibration), _believed_plant(scenario)
    innovation = None
    if not untested(scenario):
        noise = scenario.config.stop.innovation_factor * noise_px(scenario.config, scenario.calibration)
        innovation = Innovation(scenario.calibration, noise, scenario.limits.max_steps + 1 + WINDOW)
    known = scenario.calibration.marker.tolist()
    shown = np.array([numbers.index(number) for number in scenario.numbers_of(law)])
    order = np.array([numbers.index(number) if number in numbers else -1 for number in known])
    robot = foreign_robot(scenario.config, scenario.joints, len(numbers))
    return robot, DrivenRobot(robot, plant, shown, order, innovation)


def _believed_plant(scenario: Scenario) -> Plant:
    """The calibrated robot and face as the plant that the loop takes it for."""
    config, calibration = scenario.config, scenario.calibration
    model, known = calibration.model(), calibration.marker.tolist()
    task = scenario.ends.by_points().task(model)
    size = config.rig.image_size_px if config.rig is not None else (math.inf, math.inf)
    return Plant(
        model,
        np.ascontiguousarray(calibration.M[[known.index(n) for n in scenario.numbers[: scenario.m]]]),
        task.order,
        task.center,
        task.O,
        task.visible,
        np.array(size, dtype=np.float64),
        scenario.joints.lower,
        scenario.joints.upper,
        False,
    )


def untested(scenario: Scenario) -> str:
    """Why images in the loop are not tested against the calibration; empty where they are."""
    if scenario.config.stop.innovation_factor == 0.0:
        return "stop.innovation_factor is 0"
    if not np.isfinite(scenario.calibration.covariance).all():
        return "the calibration has no covariance, which the method refined gives"
    return ""
