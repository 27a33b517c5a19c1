"""The simulated robot as robots are: what a configuration says is wrong with it, and what befalls it."""

import math
from collections.abc import Callable

import numpy as np

from projservo_cli.config import Config
from projservo_cli.geometry.algebra import as_mat
from projservo_cli.geometry.kinematics import project
from projservo_cli.records import FloatArray
from projservo_cli.robots.faulty import NEVER, Events, Faults, FaultyRobot, World
from projservo_cli.robots.simulated import Plant, observe
from projservo_cli.stages.scenario import CALIBRATION_NOISE, SERVO_NOISE, TAUGHT_NOISE, Scenario, generator
from projservo_cli.stages.world import Truth

# From how far, rad or m, a robot comes to where it is put, and how long it then rests, s.
_BESIDE, _AT_REST_S = 0.02, 3
_Numbers = Callable[[int, int], np.random.Generator]


def robot_in_the_loop(scenario: Scenario) -> FaultyRobot:
    """The simulated robot of a scenario at the start of the task, which observes all markers."""
    config, truth = scenario.config, scenario.truth
    assert truth is not None
    plant = scenario.plant_of("exact")
    world = World(
        truth.robot,
        scenario.exact.q_start,
        truth.M,
        _sight(truth, plant),
        config.noise.servo_px,
        config.control.period_s,
        _numbers_of_frames(config.seed, SERVO_NOISE),
    )
    return FaultyRobot(world, faults_of(config), events_of(config, truth))


def robot_in_trials(config: Config, truth: Truth, q_start: FloatArray, seed: int) -> FaultyRobot:
    """The simulated robot at joints (n,), rad or m, whose trials are recorded; nothing befalls it there."""
    numbers = _numbers_of_frames(seed, CALIBRATION_NOISE)
    return _by_itself(config, truth, q_start, config.noise.calibration_px, numbers)


def robot_at(config: Config, truth: Truth, q: FloatArray) -> FaultyRobot:
    """The simulated robot at rest at joints (n,), rad or m, come to from beside, so that play tells."""
    aside = generator(config.seed, TAUGHT_NOISE).choice((-_BESIDE, _BESIDE), len(q))
    beside = np.clip(q + aside, truth.robot.lower, truth.robot.upper)
    numbers = _numbers_of_frames(config.seed, TAUGHT_NOISE)
    robot = _by_itself(config, truth, beside, config.noise.servo_px, numbers)
    for second in range(1, 1 + _AT_REST_S):
        robot.command(q, np.zeros_like(q), float(second))
    return robot


def _by_itself(
    config: Config, truth: Truth, q_start: FloatArray, sigma_px: float, numbers: _Numbers
) -> FaultyRobot:
    """The simulated robot at joints (n,), rad or m, that nothing befalls and whose images have borders."""
    world = World(
        truth.robot,
        q_start,
        truth.M,
        lambda H, M: project(truth.P, M @ H.T),
        sigma_px,
        config.control.period_s,
        numbers,
        (float(truth.image_size[0]), float(truth.image_size[1])),
    )
    return FaultyRobot(world, faults_of(config), Events())


def _numbers_of_frames(seed: int, stream: int) -> _Numbers:
    """Random numbers of a frame of a view, by both their numbers."""
    return lambda view, k: np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(stream, view, k)))


def _sight(truth: Truth, plant: Plant) -> Callable[[FloatArray, FloatArray], FloatArray]:
    """What both cameras see of markers (m, 4) after a displacement (4, 4), as the loop has it."""
    face, others, workspace = list(truth.face), list(truth.pins), np.zeros_like(plant.M)

    def see(H: FloatArray, M: FloatArray) -> FloatArray:
        s, ordered = np.zeros((2, len(M), 2)), np.zeros((2, len(M), 2))
        observe(plant._replace(M=M[face], pins=M[others]), as_mat(H), workspace, ordered, np.zeros(2))
        s[:, face + others] = ordered
        return s

    return see


def faults_of(config: Config) -> Faults:
    """What is wrong with joints and time of the simulated robot."""
    given = config.disturbance
    return Faults(
        (given.delay_s.left, given.delay_s.right),
        given.exposure_s,
        given.jitter_s,
        0.0 if given.frame_rate_hz is None else 1.0 / given.frame_rate_hz,
        given.frame_offset_s,
        given.stamps,
        given.encoder_ticks or 0,
        given.setpoint_ticks,
        given.lag_s,
        math.radians(given.sag_deg),
        math.radians(given.flex_deg),
        math.radians(given.play_deg),
    )


def events_of(config: Config, truth: Truth) -> Events:
    """What befalls the simulated robot and its images while it is driven."""
    given, events = config.disturbance, Events()
    if given.bump is not None:
        by = np.zeros(len(truth.robot.lower))
        turn, slide = given.bump.by_deg, given.bump.by_m or 0.0
        by[given.bump.joint - 1] = slide if turn is None else math.radians(turn)
        events = events._replace(bump_at=given.bump.at_step, bump=by, slips=not given.bump.read)
    if (frozen := given.frozen_joint) is not None:
        until = _end(frozen.from_step, frozen.steps)
        events = events._replace(frozen=frozen.joint - 1, frozen_at=frozen.from_step, frozen_until=until)
    if given.camera_moved is not None:
        by = np.array(given.camera_moved.by_view())
        events = events._replace(camera_at=given.camera_moved.at_step, camera=by)
    if (moved := given.marker_moved) is not None:
        marker = truth.number.index(moved.marker)
        events = events._replace(marker_at=moved.at_step, marker=marker, marker_by=moved.by_m)
    if (lost := given.lost_markers) is not None:
        those = tuple(truth.number.index(number) for number in lost.markers or truth.number)
        until = _end(lost.from_step, lost.steps)
        events = events._replace(lost_at=lost.from_step, lost_until=until, lost=those)
    return events


def _end(first: int, count: int | None) -> int:
    """First instant after so many from the first; None for ever."""
    return NEVER if count is None else first + count
