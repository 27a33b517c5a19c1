"""The experiment a configuration describes: robot, rig, markers, start and goal, noise, disturbances.

A ``Scenario`` is made once from configuration and calibration; every run of a law takes place in one.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from projservo_cli.calibration import predict
from projservo_cli.control.law import Gains
from projservo_cli.geometry.stereo import optical_centers
from projservo_cli.loop.step import Limits
from projservo_cli.loop.summary import Ends
from projservo_cli.records import (
    BODY_LAWS,
    METRIC_LAWS,
    Calibration,
    FloatArray,
    InputError,
    Model,
    WorkFailed,
)
from projservo_cli.robots.simulated import NEVER, NO_PINS, UNDISTURBED, Disturbance, Plant
from projservo_cli.robots.truth import (
    METRIC_A_INF,
)
from projservo_cli.stages.world import (
    Joints,
    Truth,
    center_index,
    face_numbers,
    goal_joints,
    joints_of,
    require_limits,
    truth_of,
)
from projservo_cli.task.body import Body, body_of
from projservo_cli.task.face import Task, center_of, cyclic_order, face_plane, task_from_images
from projservo_cli.task.target import task_from_body

if TYPE_CHECKING:
    from projservo_cli.config import Config
    from projservo_cli.config.models import Task as TaskSettings

# Independent streams of random numbers, each a child of a seed.
CALIBRATION_NOISE, TARGET_NOISE, SERVO_NOISE, SUGGESTIONS, PIN_TARGET_NOISE, PIN_NOISE = range(6)


def generator(seed: int, stream: int) -> np.random.Generator:
    """Random numbers of one stream of a seed."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(stream,)))


def calibration_seed(config: "Config") -> int:
    """Seed of the trial motions and of all that is random in their evaluation."""
    return config.seed if config.calibration.seed is None else config.calibration.seed


@dataclass(frozen=True, eq=False)
class StartAndGoal:
    """Start and goal of a task, and what images show of them."""

    q_start: FloatArray  # (n,) rad or m, with the offset of the start if there is one
    goal_pose: FloatArray | None  # (4, 4) true pose of the tool at the goal, m; None where nobody knows it
    # s_start, s_star: (2, b, 2) pixels of the face, then of the other markers that are watched, px, NaN where
    # unknown
    s_start: FloatArray
    s_star: FloatArray

    def first(self, m: int) -> tuple[FloatArray, FloatArray]:
        """Pixels (2, m, 2) of the first m markers at the start and at the goal."""
        return np.ascontiguousarray(self.s_start[:, :m]), np.ascontiguousarray(self.s_star[:, :m])


class Watched(NamedTuple):
    """The markers by which a face is measured."""

    face: int  # how many of them are on the face
    numbers: tuple[int, ...]  # of all of them, those of the face first, then the pins
    # that they belong to, as calibrated; None where the face is measured point by point
    body: Body | None = None
    # (p, 4) pins at the robot's reference, m; of a robot that is not simulated as calibrated
    pins: FloatArray = NO_PINS
    which: tuple[int, ...] = ()  # (p,) the pins among all true markers beside the face


@dataclass(frozen=True, eq=False)
class Scenario:
    """What the runs of a configuration with a calibration take place in."""

    config: "Config"
    calibration: Calibration
    truth: Truth | None  # robot, rig and markers as they are; None for a robot that is not simulated
    joints: Joints  # as the laws take them
    watched: Watched  # the markers by which the face is measured
    exact: StartAndGoal
    ends: StartAndGoal  # exact, ends: start and goal without noise, and as they are shown to the laws
    gains: Gains
    limits: Limits  # gains, limits: of the laws, and when a run ends
    ideal: bool = False  # without noise and disturbances in the loop

    def body_of(self, law: str) -> Body | None:
        """The body that a law measures with; None for one that measures point by point."""
        return self.watched.body if law in BODY_LAWS else None

    def numbers_of(self, law: str) -> tuple[int, ...]:
        """Numbers of the markers that a law observes."""
        return self.watched.numbers if self.body_of(law) else self.watched.numbers[: self.watched.face]

    def believed_by(self, law: str) -> Model:
        """The model that a law is given: the calibrated one, or for a metric law the true one."""
        if law not in METRIC_LAWS:
            return self.calibration.model()
        if None in (self.config.robot, self.config.rig):
            raise InputError(
                f"{law} is given the metric model of robot and rig: set robot and rig, or leave it out of "
                "control.laws"
            )
        return truth_of(self.config).model

    def task_of(self, model: Model, body: Body | None) -> Task:
        """The task as start and goal show it to a model, by the body or point by point.

        Raises WorkFailed if the images do not show where the face or its body is.
        """
        ends, sight = self.ends, None if body is None else Sight(body, self.ends.s_start, self.ends.s_star)
        center = center_index(self.config)
        return measured_task(model, ends.q_start, *ends.first(self.watched.face), center, sight)

    def plant_of(self, law: str) -> Plant:
        """The simulated robot as a law sees it, and what befalls it.

        Raises WorkFailed if a camera sees the face edge-on at the start.
        """
        assert self.truth is not None
        plant = plant_of(self.config, self.truth, self.exact.q_start)
        pins = self.watched.pins if self.body_of(law) else NO_PINS
        disturbance = UNDISTURBED if self.ideal else _disturbance(self.config, len(self.exact.q_start))
        return plant._replace(pins=pins, disturbance=disturbance)

    def noise_of(self, law: str, seed: int, instants: int) -> FloatArray:
        """Pixel noise (instants, 2, markers, 2) of a seed as a law observes it, px; NaN where unseen.

        It is the same for every law; fewer instants are the first of more.
        """
        numbers, m = self.numbers_of(law), self.watched.face
        noise = np.zeros((instants, 2, len(numbers), 2))
        if self.ideal:
            return noise
        sigma = self.config.noise.servo_px
        if sigma > 0.0:
            for these, stream in ((slice(m), SERVO_NOISE), (slice(m, None), PIN_NOISE)):
                if noise[:, :, these].size > 0:
                    drawn = generator(seed, stream).standard_normal(noise[:, :, these].shape)
                    np.multiply(sigma, drawn, out=noise[:, :, these])
        _lose_markers(self.config, noise, numbers)
        return noise

    def shown_at(self, seed: int) -> StartAndGoal:
        """Start and goal as the images of a seed show them, which are averages."""
        sigma = self.config.noise.servo_px / math.sqrt(self.config.noise.shown_frames)
        if sigma == 0.0 or self.truth is None:
            return self.exact
        m, exact = self.watched.face, self.exact
        ends = (
            [exact.s_start.copy()] if exact.goal_pose is None else [exact.s_start.copy(), exact.s_star.copy()]
        )
        rng = generator(seed, TARGET_NOISE)
        for s in ends:
            s[:, :m] += sigma * rng.standard_normal((2, m, 2))
        if self.watched.which:
            pins = generator(seed, PIN_TARGET_NOISE).standard_normal((2, 2, len(self.truth.pins), 2))
            for s, of_pins in zip(ends, pins, strict=False):
                s[:, m:] += sigma * of_pins[:, list(self.watched.which)]
        return StartAndGoal(exact.q_start, exact.goal_pose, ends[0], ends[1] if ends[1:] else exact.s_star)

    def true_ends(self) -> Ends:
        """Where the true robot holds the tool at its reference and at the goal; NaN where nobody knows."""
        return true_ends(self.truth, self.exact.goal_pose)


def true_ends(truth: Truth | None, goal_pose: FloatArray | None) -> Ends:
    """Where a robot holds the tool at its reference and at a goal (4, 4), m; NaN where nobody knows."""
    base_tool = np.full((4, 4), np.nan) if truth is None else truth.robot.base_tool
    if truth is None or goal_pose is None:
        return Ends(base_tool, np.full((4, 4), np.nan), np.full(4, np.nan))
    middle = np.array(center_of(truth.M_face, truth.center))
    return Ends(base_tool, goal_pose, goal_pose @ np.linalg.solve(base_tool, middle))


class Sense(NamedTuple):
    """All of a plan that a law needs that plans anew in each step: which way to turn."""

    motions: FloatArray  # (2, n) joint motions of the rotations r and p in the sense they are planned
    task: Task | None  # measured as the plan is; None where the whole plan was made

    def rotation_sense(self) -> FloatArray:
        """Joint motions (2, n) of the rotations r and p in the sense they are planned."""
        return self.motions


class Sight(NamedTuple):
    """A body to measure with: its calibration, and its pixels (2, b, 2) at the start and at the goal."""

    body: Body
    s_start: FloatArray
    s_star: FloatArray


def sight_of(scenario: Scenario) -> Sight | None:
    """The body to measure with; None where the face is measured point by point."""
    body = scenario.watched.body
    return None if body is None else Sight(body, scenario.ends.s_start, scenario.ends.s_star)


def measured_task(
    model: Model,
    q_start: FloatArray,
    s_start: FloatArray,
    s_star: FloatArray,
    center: int,
    sight: Sight | None,
) -> Task:
    """The task as the images (2, m, 2) of the face or of its body at start and goal show it.

    Raises WorkFailed if the images do not show where the face or its body is.
    """
    if sight is None:
        return task_from_images(model, s_start, s_star, center)
    return task_from_body(model, sight.body, q_start, sight.s_start, sight.s_star, center, s_star.shape[1])


def scenario_of(config: "Config", calibration: Calibration) -> Scenario:
    """Make the scenario of a configuration, of its simulated robot or of the one in ``plant.use``.

    Raises InputError if the configuration lacks a part of it, naming the key to set; WorkFailed if the goal
    cannot be reached or seen, or the body not be measured with.
    """
    if config.plant.use is not None:
        return _scenario_of_own_robot(config, calibration)
    truth, joints = truth_of(config), joints_of(config, calibration.joint_types)
    watched = _watched(config, calibration, truth)
    exact = start_and_goal(config, truth, watched.which)
    scenario = Scenario(
        config, calibration, truth, joints, watched, exact, exact, gains_of(config), limits_of(config)
    )
    return replace(scenario, ends=scenario.shown_at(config.seed))


def idealized(scenario: Scenario) -> Scenario:
    """A scenario without noise, disturbances and body; a goal known by its images alone stays as shown."""
    m = scenario.watched.face
    exact = scenario.exact
    ends = StartAndGoal(exact.q_start, exact.goal_pose, *exact.first(m))
    watched = Watched(m, scenario.watched.numbers[:m])
    return replace(scenario, watched=watched, exact=ends, ends=ends, ideal=True)


def gains_of(config: "Config") -> Gains:
    """Gains and limits of the laws."""
    c, joints = config.control, joints_of(config)
    endless = np.full(len(joints.types), math.inf)
    stop = config.plant.joint_limits == "stop"
    return Gains(
        c.gain_t,
        c.gain_r,
        c.gain_p,
        c.gain_s,
        c.ratio_rp,
        c.gain,
        c.period_s,
        config.trajectory.delta,
        joints.speed,
        c.substeps == "auto",
        joints.lower if stop else -endless,
        joints.upper if stop else endless,
    )


def limits_of(config: "Config") -> Limits:
    """When a run ends and what bounds its commands; noise widens the tolerance of the image error."""
    noise_px = config.stop.noise_factor * config.noise.servo_px
    return Limits(
        joints_of(config).speed,
        config.stop.image_px + noise_px,
        config.stop.diverged_factor,
        config.stop.plateau_steps,
        config.stop.max_steps,
        config.plant.joint_limits == "stop",
        config.plant.image_border == "stop",
        config.stop.lost_steps,
        noise_px,
    )


def noise_px(config: "Config", calibration: Calibration) -> float:
    """Pixel noise of a robot that is not simulated: as configured, but no less than the calibration left."""
    return max(config.noise.servo_px, calibration.sigma_fitted_px)


def _by_points(config: "Config", calibration: Calibration) -> bool:
    """Whether the face is measured point by point: as configured, else where no body is calibrated well."""
    if config.control.observation is None:
        return not calibration.usable  # such a body is worse than none
    return config.control.observation == "points"


def _watched(config: "Config", calibration: Calibration, truth: Truth) -> Watched:
    """The markers by which the simulated face is measured: those of the body that the calibration knows."""
    face = tuple(truth.number[i] for i in truth.face)
    if _by_points(config, calibration):
        return Watched(len(face), face)
    known = calibration.marker.tolist()
    pins = [i for i in truth.pins if truth.number[i] in known]
    numbers = (*face, *(truth.number[i] for i in pins))
    body = _body(calibration, tuple(known.index(number) for number in numbers))
    which = tuple(truth.pins.index(i) for i in pins)
    return Watched(len(face), numbers, body, np.ascontiguousarray(truth.M[pins]), which)


@lru_cache(maxsize=64)
def _body(calibration: Calibration, indices: tuple[int, ...]) -> Body:
    """Body of markers of a calibration, by their indices in it, the same for every run with it."""
    return body_of(calibration.model(), calibration.M[list(indices)])


def start_and_goal(config: "Config", truth: Truth, pins: Sequence[int] = ()) -> StartAndGoal:
    """Start and goal of the simulated task without noise, seen by the face and some of the other markers.

    Raises InputError if the configuration has no task; WorkFailed if the goal cannot be reached.
    """
    if config.task is None:
        raise InputError("this stage needs a task: set task.start and task.goal")
    face_numbers(config)
    types = config.robot.joint_types if config.robot is not None else ""
    return _ends(config.task, types, truth, tuple(pins))


@lru_cache(maxsize=2048)
def _ends(task: "TaskSettings", types: str, truth: Truth, pins: tuple[int, ...]) -> StartAndGoal:
    """What the ends of a task look like, for any seed and noise."""
    q_from = np.array(task.start.values(types))
    require_limits(truth.robot, q_from, "task.start")
    q_start = q_from
    if task.start_offset is not None:
        q_start = q_from + np.array(task.start_offset.values(types))
        require_limits(truth.robot, q_start, "task.start_offset")
    M_pins = truth.M[[truth.pins[i] for i in pins]]

    def images(q: FloatArray) -> FloatArray:
        """Both apart, so that the face has the same bits with any pins."""
        return np.concatenate([truth.images(q, truth.M_face), truth.images(q, M_pins)], axis=1)

    s_start = images(q_start)
    if task.goal.images is not None:
        s_star = np.full(s_start.shape, math.nan)
        s_star[:, : len(truth.face)] = task.goal.images.left, task.goal.images.right
        return StartAndGoal(q_start, None, s_start, s_star)
    q_goal = goal_joints(task, types, truth, q_from)
    require_limits(truth.robot, q_goal, "task.goal")
    return StartAndGoal(q_start, truth.robot.pose(q_goal), s_start, images(q_goal))


def observed(config: "Config", calibration: Calibration) -> list[int]:
    """Numbers of the markers that a robot in ``plant.use`` observes, in its order."""
    known = config.markers.known if config.markers is not None else None
    numbers = list(known) if known is not None else calibration.marker.tolist()
    for number in face_numbers(config):
        if number not in numbers:
            raise InputError(f"markers.face: marker {number} is not among those observed, {numbers}")
    return numbers


def _scenario_of_own_robot(config: "Config", calibration: Calibration) -> Scenario:
    """The scenario of a robot whose truth nobody knows, by its calibration; never beyond its limits."""
    if config.task is None:
        raise InputError("this stage needs a task: set task.start and task.goal")
    joints = joints_of(config, calibration.joint_types)
    watched = _watched_of_own_robot(config, calibration)
    exact = _predicted_ends(config, calibration, joints, watched)
    gains = gains_of(config)._replace(speed=joints.speed, lower=joints.lower, upper=joints.upper)
    noise = config.stop.noise_factor * noise_px(config, calibration)
    limits = limits_of(config)._replace(
        speed=joints.speed,
        image_px=config.stop.image_px + noise,
        noise_px=noise,
        stop_at_joint_limit=True,
    )
    return Scenario(config, calibration, None, joints, watched, exact, exact, gains, limits)


def _watched_of_own_robot(config: "Config", calibration: Calibration) -> Watched:
    """The markers of the body that robot and calibration both know, as calibrated."""
    face, known = face_numbers(config), calibration.marker.tolist()
    seen = observed(config, calibration)
    if _by_points(config, calibration):
        return Watched(len(face), face)
    numbers = (*face, *(number for number in seen if number in known and number not in face))
    M = calibration.M[[known.index(number) for number in numbers]]
    return Watched(len(face), numbers, body_of(calibration.model(), M), M[len(face) :])


def _predicted_ends(
    config: "Config", calibration: Calibration, joints: Joints, watched: Watched
) -> StartAndGoal:
    """Start and goal as the calibration predicts their images."""
    assert config.task is not None
    start, goal = config.task.start, config.task.goal
    for vector, key in ((start, "task.start"), (goal.joints, "task.goal.joints")):
        if vector is not None and len(vector.joints) != len(joints.types):
            raise InputError(f"{key}: {len(vector.joints)} values for {len(joints.types)} joints")
    q_from = np.array(start.values(joints.types))
    q_start = q_from
    if config.task.start_offset is not None:
        q_start = q_from + np.array(config.task.start_offset.values(joints.types))
    joints.require_inside(q_start, "task.start")
    s_start = _predicted_images(calibration, watched, q_start, "task.start")
    if goal.images is not None:
        s_star = np.full(s_start.shape, np.nan)
        s_star[:, : watched.face] = goal.images.left, goal.images.right
        return StartAndGoal(q_start, None, s_start, s_star)
    if goal.joints is not None:
        q_goal = np.array(goal.joints.values(joints.types))
    elif config.robot is None:
        raise InputError("task.goal.turn_deg needs the model of the robot: give joints or images instead")
    else:
        q_goal = goal_joints(config.task, joints.types, truth_of(config), q_from)
    joints.require_inside(q_goal, "task.goal")
    return StartAndGoal(q_start, None, s_start, _predicted_images(calibration, watched, q_goal, "task.goal"))


def _predicted_images(calibration: Calibration, watched: Watched, q: FloatArray, where: str) -> FloatArray:
    """Predicted pixels (2, b, 2) of the watched markers at the joints q (n,)."""
    known = calibration.marker.tolist()
    s = predict(calibration, q[None])[0][:, [known.index(number) for number in watched.numbers]]
    if np.isnan(s[:, : watched.face]).any():
        raise WorkFailed(f"{where}: by the calibration, the face is not in front of both cameras there")
    return np.ascontiguousarray(s)


def plant_of(config: "Config", truth: Truth, q_start: FloatArray) -> Plant:
    """The truth as the loop sees it from the joints q_start (n,), undisturbed.

    Raises WorkFailed if a camera sees the face edge-on there.
    """
    return _plant(truth, q_start.tobytes(), config.plant.self_occlusion == "opaque")


@lru_cache(maxsize=2048)
def _plant(truth: Truth, start_bytes: bytes, opaque: bool) -> Plant:
    q_start = np.frombuffer(start_bytes)
    M = truth.M_face
    start = M @ truth.displacement(q_start).T
    order = cyclic_order(start)
    O = optical_centers(truth.P, METRIC_A_INF)
    sides = O @ np.array(face_plane(start, order, center_of(start, truth.center)))
    if np.abs(sides).min() < 1e-9 or sides[0] * sides[1] < 0.0:
        raise WorkFailed(
            "task.start: the cameras see different sides of the face, or one sees it edge-on: "
            "turn the face towards both"
        )
    return Plant(
        truth.model,
        M,
        order,
        truth.center,
        O,
        np.where(sides > 0.0, 1.0, -1.0),
        truth.image_size,
        truth.robot.lower,
        truth.robot.upper,
        opaque,
    )


def _disturbance(config: "Config", n: int) -> Disturbance:
    """What befalls the joints and the images of a robot of n joints."""
    given = config.disturbance
    bump, frozen = given.bump, given.frozen_joint
    step = np.zeros(n)
    if bump is not None:
        step[bump.joint - 1] = math.radians(bump.by_deg) if bump.by_deg is not None else bump.by_m
    return Disturbance(
        given.delay_periods,
        -1 if bump is None else bump.at_step,
        step,
        bump is None or bump.read,
        -1 if frozen is None else frozen.joint - 1,
        0 if frozen is None else frozen.from_step,
        _end(frozen.from_step, frozen.steps) if frozen is not None else NEVER,
    )


def _end(first: int, count: int | None) -> int:
    """First instant after so many from the first; None for ever."""
    return NEVER if count is None else first + count


def _lose_markers(config: "Config", noise: FloatArray, numbers: Sequence[int]) -> None:
    """Make the noise of lost markers NaN, in place, by which they are unseen.

    noise : (k, 2, m, 2) at every instant, px; numbers : (m,) of the markers.
    """
    lost = config.disturbance.lost_markers
    if lost is None:
        return
    those = [i for i, number in enumerate(numbers) if lost.markers is None or number in lost.markers]
    noise[lost.from_step : _end(lost.from_step, lost.steps), :, those] = np.nan
