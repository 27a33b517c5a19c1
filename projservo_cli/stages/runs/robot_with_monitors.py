"""A robot of the contract as the loop of a law drives it: with its monitors and known data."""

import math
from functools import partial

import numpy as np

from projservo_cli.calibration.prediction import predict
from projservo_cli.monitoring.image_monitor import ImageMonitor
from projservo_cli.monitoring.innovation_tests import WINDOW
from projservo_cli.records import Calibration, Plan
from projservo_cli.robots.contract import Robot
from projservo_cli.robots.latency_compensation import DrivenRobot, Known, Tracked
from projservo_cli.robots.latency_estimation import DelayPrior
from projservo_cli.robots.object_watch import ObjectWatch
from projservo_cli.robots.session import Session
from projservo_cli.stages.scenario import RunScenario
from projservo_cli.stages.stage_inputs import Contract
from projservo_cli.task.objects.displaced_object import images_by_motion


def connected_robot(
    scenario: RunScenario,
    law: str,
    session: Session,
    given: Robot | None = None,
    plan: Plan | None = None,
    tracked: Tracked | None = None,
) -> DrivenRobot:
    """Return the robot, open, as the loop of a law sees it: with its truth, or with the calibrated model.

    session : which it is opened in, unless it is.
    given : an object of the contract instead of one of a class.
    plan : of which the objects that carry its goal are watched, all but the tracked one.
    """
    contract, world, plant = scenario.servo.required_contract, scenario.world, scenario.plant_of(law)
    calibration = world.calibration
    steered = world.opened(session, contract, scenario.exact.q_start, plant, given)
    monitor = None
    if not scenario.untested:
        noise = scenario.servo.stop.innovation_threshold * scenario.world.noise_px
        visible = np.flatnonzero(np.isin(calibration.marker, scenario.world.observed))
        readings = scenario.termination.max_steps + 1 + WINDOW
        monitor = ImageMonitor(calibration, noise, readings, visible, plant.image_size)
    watches = list[ObjectWatch]()
    for carried in () if plan is None else plan.carried:
        name, numbers = carried.object_name, carried.object_marker.tolist()
        indices = np.array([contract.driven.further.index(number) for number in numbers])
        follows = tracked is not None and tracked.name == name
        if not follows and name not in session.held.values():  # else it moves with the tool
            s, sigma = carried.s_object, carried.sigma_object
            sigma = np.full(s.shape[:2], np.nan) if sigma is None else sigma
            watches.append(ObjectWatch(name, numbers, indices, s, sigma, images_by_motion(calibration, s)))
    alone = len(watches) == 1 and scenario.world.inputs.displaced is None
    session.followed = None
    session.at = watches[0] if alone else None  # if there are several, an action may take any
    return DrivenRobot(
        steered, plant, _known_of(scenario, contract, calibration, law), monitor, watches, tracked
    )


def _known_of(scenario: RunScenario, contract: Contract, calibration: Calibration, law: str) -> Known:
    """Return the knowledge of a robot and its images before a law drives it."""
    numbers, views, given = scenario.world.observed, calibration.view, contract.time_offset_s
    return Known(
        predicted=partial(predict, calibration),
        visible=np.array([numbers.index(number) for number in scenario.numbers_of(law)]),
        order=np.array([numbers.index(k) if k in numbers else -1 for k in calibration.marker.tolist()]),
        sigma_px=scenario.world.noise_px,
        sigma_scale=calibration.sigma_scale or 1.0,
        sigma_q=scenario.world.joints.length_of(math.degrees(calibration.sigma_q or 0.0)),
        delays=DelayPrior.of(
            calibration, None if given is None else [given.of(name) for name in views], even=contract.ideal
        ),
        timeout_s=contract.timeout_s,
        max_force_n=scenario.servo.stop.max_force_n,
    )
