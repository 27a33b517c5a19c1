"""The robot of ``plant.use``: made, checked against the calibration, and driven to given joints."""

import math

import numpy as np

from projservo_cli.calibration import WINDOW, Innovation
from projservo_cli.config import Config
from projservo_cli.records import FloatArray, InputError, WorkFailed
from projservo_cli.robots import plugins
from projservo_cli.robots.simulated import Plant
from projservo_cli.robots.yours import DrivenRobot, ForeignRobot, Robot
from projservo_cli.stages.scenario import Scenario
from projservo_cli.stages.world import Joints

ARRIVED = 1e-3  # rad or m: a robot this near to where it was sent is there
SETTLE = 10  # further commands for what rounding or a controller left at the end of a motion


def foreign_robot(config: Config, joints: Joints, markers: int) -> ForeignRobot:
    """Make the robot of ``plant.use``; an InputError where a joint has no speed limit."""
    target = config.plant.use
    assert target is not None
    for kind, key in (("R", "joint_speed_limit_deg_s"), ("P", "prismatic_speed_limit_m_s")):
        if kind in joints.types and getattr(config.control, key) is None:
            raise InputError(
                f"plant {target}: a robot that is not simulated needs a limit: set control.{key}"
            )
    robot: Robot = plugins.make("plant", target, (), config.plant.options)
    return ForeignRobot(robot, f"plant {target}", len(joints.types), markers, config.plant.timeout_s)


def drive_to(robot: Robot, target: FloatArray, config: Config, joints: Joints, what: str) -> int:
    """Move to joints (n,) along a straight line, each command within the speed limit; how many there were.

    what : the command it is for, in messages. Raises WorkFailed if the robot does not arrive.
    """
    period = config.control.period_s
    limit = joints.speed * period * config.plant.speed_scale  # (n,) rad or m a period; infinite for none
    gap = target - robot.joints()
    most = math.ceil(float(np.max(np.abs(gap) / limit))) + SETTLE
    count = 0
    while gap.any() and count < most:
        robot.command(gap / np.max(np.abs(gap) / limit, initial=1.0), period)
        count += 1
        gap = target - robot.joints()
    i = int(np.argmax(np.abs(gap)))
    if not abs(gap[i]) <= ARRIVED:
        raise WorkFailed(
            f"{what}: joint {i + 1} was sent to {target[i]:.6g} and stands at {target[i] - gap[i]:.6g} (rad "
            "or m): look what holds the robot, then run the command again"
            + (" to continue" if what == "record" else "")
        )
    return count


def connected(scenario: Scenario, law: str) -> tuple[ForeignRobot, DrivenRobot]:
    """The robot, and as the loop of a law sees it: beside the plant that the calibration takes it for."""
    assert scenario.calibration is not None
    known, numbers = scenario.calibration.marker.tolist(), scenario.observed
    face = [known.index(number) for number in scenario.numbers[: scenario.m]]
    shown = np.array([numbers.index(number) for number in scenario.numbers_of(law)])
    order = np.array([numbers.index(number) if number in numbers else -1 for number in known])
    task, rig = scenario.ends.by_points().task(scenario.model), scenario.config.rig
    plant = Plant(
        scenario.model,
        np.ascontiguousarray(scenario.calibration.M[face]),
        task.order,
        task.center,
        task.O,
        task.visible,
        np.array(rig.image_size_px if rig is not None else (math.inf, math.inf), dtype=np.float64),
        scenario.joints.lower,
        scenario.joints.upper,
        False,
    )
    robot = foreign_robot(scenario.config, scenario.joints, len(numbers))
    return robot, DrivenRobot(robot, plant, shown, order, innovation_of(scenario))


def innovation_of(scenario: Scenario) -> Innovation | None:
    """What tests the images of a run against the calibration; None where that is not done."""
    if scenario.calibration is None or untested(scenario):
        return None
    noise = scenario.config.stop.innovation_factor * scenario.noise_px
    return Innovation(scenario.calibration, noise, scenario.limits.max_steps + 1 + WINDOW)


def untested(scenario: Scenario) -> str:
    """Why images in the loop are not tested against the calibration; empty where they are."""
    if scenario.config.stop.innovation_factor == 0.0:
        return "stop.innovation_factor is 0"
    assert scenario.calibration is not None
    if not np.isfinite(scenario.calibration.covariance).all():
        return "the calibration has no covariance, which the method refined gives"
    return ""
