"""The simulated truth a configuration describes: robot, rig, markers, start and goal."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from projservo_cli.calibration import predict
from projservo_cli.geometry.kinematics import project
from projservo_cli.geometry.stereo import optical_centers
from projservo_cli.records import (
    PRISMATIC,
    REVOLUTE,
    Calibration,
    FloatArray,
    InputError,
    IntArray,
    Model,
    WorkFailed,
)
from projservo_cli.robots.simulated import NEVER, Disturbance, Plant
from projservo_cli.robots.truth import (
    METRIC_A_INF,
    Robot,
    dh_robot,
    inverse_kinematics,
    look_at_camera,
    rigid,
    roll_axis,
    rotation_about_axis,
    twist,
)
from projservo_cli.stages.motion import joints_of
from projservo_cli.task.body import Body, body_of
from projservo_cli.task.face import MIDPOINT, Task, center_of, cyclic_order, face_plane, task_from_images
from projservo_cli.task.target import task_from_body

if TYPE_CHECKING:
    from projservo_cli.config import Config
    from projservo_cli.config.models import Perturbation
    from projservo_cli.config.models import Task as TaskSettings
    from projservo_cli.config.robot import Camera, Markers, Rig
    from projservo_cli.config.robot import Robot as DescribedRobot

# Independent streams of random numbers, each a child of the configuration's seed.
CALIBRATION_NOISE, TARGET_NOISE, SERVO_NOISE, SUGGESTIONS, PIN_TARGET_NOISE, PIN_NOISE = range(6)


@dataclass(frozen=True, eq=False)
class Truth:
    """Robot, rig and markers as they are.

    Attributes
    ----------
    robot : true kinematics.
    P : (2, 3, 4) true cameras, px.
    M : (m, 4) all markers at the robot's reference, m.
    number : (m,) their numbers.
    face : indices of the face markers; none where the configuration has no face.
    center : position of the centre marker within the face, or ``MIDPOINT``.
    image_size : (2,) px.
    """

    robot: Robot
    P: FloatArray
    M: FloatArray
    number: tuple[int, ...]
    face: tuple[int, ...]
    center: int
    image_size: FloatArray

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

    def images(self, q: FloatArray, M: FloatArray) -> FloatArray:
        """True pixels (2, k, 2) of markers M (k, 4), given at the reference, at the joints q (n,)."""
        return project(self.P, M @ self.displacement(q).T)

    def displacement(self, q: FloatArray) -> FloatArray:
        """True displacement (4, 4) of the face from the reference at the joints q (n,)."""
        return self.robot.pose(q) @ self._from_tool

    @cached_property
    def _from_tool(self) -> FloatArray:
        return np.asarray(np.linalg.inv(self.robot.base_tool), dtype=np.float64)


def generator(config: "Config", *stream: int) -> np.random.Generator:
    """Random numbers of one stream of the configuration's seed."""
    return stream_of(config.seed, *stream)


def stream_of(seed: int, *stream: int) -> np.random.Generator:
    """Random numbers of one stream of a seed."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=stream))


def calibration_seed(config: "Config") -> int:
    """Seed of the trial motions and of all that is random in their evaluation."""
    return config.seed if config.calibration.seed is None else config.calibration.seed


def calibration_generator(config: "Config") -> np.random.Generator:
    """Random numbers of the noise of the trial motions."""
    seed = calibration_seed(config)
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(CALIBRATION_NOISE,)))


def face_numbers(config: "Config") -> tuple[int, ...]:
    """Numbers of the face markers."""
    if config.markers is None or config.markers.face is None:
        raise InputError(
            "this stage needs to know the face: set markers.face to three marker numbers or more"
        )
    return config.markers.face


def center_index(config: "Config") -> int:
    """Position of the centre marker within the face, or ``MIDPOINT``."""
    assert config.markers is not None
    center = config.markers.center
    return MIDPOINT if center == "midpoint" else face_numbers(config).index(center)


def truth_of(config: "Config") -> Truth:
    """Build the truth, or find it again where it was built for another seed or task.

    Raises
    ------
    InputError
        If the configuration lacks a part of it, naming the key to set.
    """
    if config.robot is None:
        raise InputError("this stage drives a simulated robot: set robot.dh or robot.screws")
    if config.rig is None:
        raise InputError("this stage needs a simulated rig: set rig.left, rig.right and rig.image_size_px")
    if config.markers is None or config.markers.positions_m is None:
        raise InputError("this stage needs the markers of the simulated robot: set markers.positions_m")
    return _built(config.robot, config.rig, config.markers)


@lru_cache(maxsize=16)
def _built(described: "DescribedRobot", rig: "Rig", markers: "Markers") -> Truth:
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


def robot_of(described: "DescribedRobot") -> Robot:
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


@dataclass(frozen=True, eq=False)
class Reach:
    """Start and goal of the simulated task.

    Attributes
    ----------
    q_start : (n,) rad or m, with the offset of the start if there is one.
    goal_pose : (4, 4) true pose of the tool at the goal, m; None where only images are known.
    s_start, s_star : (2, m, 2) measured pixels of the face, px.
    pins_start, pins_star : (2, p, 2) measured pixels of the other markers, px, NaN where unknown.
    """

    q_start: FloatArray
    goal_pose: FloatArray | None
    s_start: FloatArray
    s_star: FloatArray
    pins_start: FloatArray
    pins_star: FloatArray


def reach_of(config: "Config", truth: Truth) -> Reach:
    """Start, goal and their images, with the servo noise of the configuration.

    Raises
    ------
    InputError
        If the configuration has no task.
    WorkFailed
        If the goal cannot be reached.
    """
    return shown_at(start_and_goal(config, truth), config.seed, shown_px(config))


def shown_px(config: "Config") -> float:
    """Noise of the images of the start and of the goal, which are averages, px."""
    return config.noise.servo_px / math.sqrt(config.noise.shown_frames)


def shown_at(ends: Reach, seed: int, sigma: float) -> Reach:
    """Start and goal as a seed shows them, with noise σ, px."""
    if sigma == 0.0:
        return ends
    rng = stream_of(seed, TARGET_NOISE)
    s_start = ends.s_start + sigma * rng.standard_normal(ends.s_start.shape)
    pins_noise: FloatArray = np.zeros((2, *ends.pins_start.shape))
    if pins_noise.size > 0:
        pins_noise = stream_of(seed, PIN_TARGET_NOISE).standard_normal(pins_noise.shape)
    pins_start = ends.pins_start + sigma * pins_noise[0]
    if ends.goal_pose is None:
        return Reach(ends.q_start, None, s_start, ends.s_star, pins_start, ends.pins_star)
    s_star = ends.s_star + sigma * rng.standard_normal(ends.s_star.shape)
    pins_star = ends.pins_star + sigma * pins_noise[1]
    return Reach(ends.q_start, ends.goal_pose, s_start, s_star, pins_start, pins_star)


def start_and_goal(config: "Config", truth: Truth) -> Reach:
    """Start and goal of the simulated task without noise.

    Raises
    ------
    InputError
        If the configuration has no task.
    WorkFailed
        If the goal cannot be reached.
    """
    if config.task is None:
        raise InputError("this stage needs a task: set task.start and task.goal")
    face_numbers(config)
    return _ends(config.task, config.robot.joint_types if config.robot is not None else "", truth)


@lru_cache(maxsize=2048)
def _ends(task: "TaskSettings", types: str, truth: Truth) -> Reach:
    """What the ends of a task look like, for any seed and noise."""
    q_from = np.array(task.start.values(types))
    _require_limits(truth.robot, q_from, "task.start")
    q_start = q_from
    if task.start_offset is not None:
        q_start = q_from + np.array(task.start_offset.values(types))
        _require_limits(truth.robot, q_start, "task.start_offset")
    M_pins = truth.M[list(truth.pins)]
    s_start, pins_start = truth.images(q_start, truth.M_face), truth.images(q_start, M_pins)
    if task.goal.images is not None:
        s_star = np.array([task.goal.images.left, task.goal.images.right])
        return Reach(q_start, None, s_start, s_star, pins_start, np.full(pins_start.shape, math.nan))
    q_goal = goal_joints(task, types, truth, q_from)
    _require_limits(truth.robot, q_goal, "task.goal")
    return Reach(
        q_start,
        truth.robot.pose(q_goal),
        s_start,
        truth.images(q_goal, truth.M_face),
        pins_start,
        truth.images(q_goal, M_pins),
    )


def goal_joints(task: "TaskSettings", types: str, truth: Truth, q_start: FloatArray) -> FloatArray:
    """Joints (n,) of a goal that is given by them or by a turn of the true robot, rad or m."""
    if task.goal.joints is not None:
        return np.array(task.goal.joints.values(types))
    assert task.goal.turn_deg is not None
    return _turned(truth, q_start, task.goal.turn_deg, task.goal.perturbation)


def _turned(
    truth: Truth, q_start: FloatArray, turn_deg: float, perturbation: "Perturbation | None"
) -> FloatArray:
    """Joints after a turn about the roll axis of the rig and a small displacement of the tool."""
    point, direction = roll_axis(truth.P)
    goal = rotation_about_axis(point, direction, math.radians(turn_deg)) @ truth.robot.pose(q_start)
    if perturbation is not None:
        v = np.array(perturbation.rotation_rad)
        t = np.array(perturbation.translation_m)
        angle = float(np.linalg.norm(v))
        turn = rotation_about_axis(np.zeros(3), v, angle) if angle > 0.0 else np.eye(4)
        goal = goal @ rigid(np.eye(3), t) @ turn
    return inverse_kinematics(truth.robot, goal, q_start)


def _require_limits(robot: Robot, q: FloatArray, where: str) -> None:
    """Refuse joints outside the limits."""
    for i, value in enumerate(q):
        if not robot.lower[i] <= value <= robot.upper[i]:
            raise WorkFailed(
                f"{where}: joint {i + 1} would be at {value:.4g}, outside its limits "
                f"{robot.lower[i]:.4g} to {robot.upper[i]:.4g} (rad or m): choose others or wider limits"
            )


def plant_of(config: "Config", truth: Truth, q_start: FloatArray) -> Plant:
    """The truth as the compiled loop sees it.

    Raises
    ------
    WorkFailed
        If a camera sees the face edge-on at the start.
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


@dataclass(frozen=True, eq=False)
class Sight:
    """The body as it is watched: the markers of the face first, then the pins.

    Attributes
    ----------
    body : as calibrated.
    pins : (p, 4) true pins at the robot's reference, m.
    s_start, s_star : (2, m + p, 2) measured pixels at the start and at the goal, NaN where unseen.
    """

    body: Body
    pins: FloatArray
    s_start: FloatArray
    s_star: FloatArray


def by_points(config: "Config", calibration: Calibration) -> bool:
    """Whether the face is measured point by point: as configured, else where no body is calibrated well.

    A body of a calibration that is not usable is worse than no body.
    """
    if config.control.observation is None:
        return not calibration.usable
    return config.control.observation == "points"


def known_pins(calibration: Calibration, truth: Truth) -> list[int]:
    """Indices of the markers beside the face that the calibration knows."""
    known = calibration.marker.tolist()
    return [i for i in truth.pins if truth.number[i] in known]


def sight_of(config: "Config", calibration: Calibration, truth: Truth, reach: Reach) -> Sight | None:
    """The body of the markers that the calibration knows; None where the face is measured point by point.

    Raises
    ------
    WorkFailed
        If the displacements of the body cannot be told from the calibration.
    """
    found = watched_body(config, calibration, truth)
    if found is None:
        return None
    return Sight(
        found.body,
        found.pins,
        np.concatenate([reach.s_start, reach.pins_start[:, found.which]], axis=1),
        np.concatenate([reach.s_star, reach.pins_star[:, found.which]], axis=1),
    )


class Watched(NamedTuple):
    """The body of a calibration: its pins (p, 4) at the robot's reference, m, and which of the true ones."""

    body: Body
    pins: FloatArray
    which: list[int]


def watched_body(config: "Config", calibration: Calibration, truth: Truth) -> Watched | None:
    """The body by which the simulated face is measured, as of ``sight_of``; it is the same for every run."""
    if by_points(config, calibration):
        return None
    known, pins = calibration.marker.tolist(), known_pins(calibration, truth)
    body = _body(calibration, tuple(known.index(truth.number[index]) for index in (*truth.face, *pins)))
    return Watched(body, np.ascontiguousarray(truth.M[pins]), [truth.pins.index(i) for i in pins])


@lru_cache(maxsize=64)
def _body(calibration: Calibration, indices: tuple[int, ...]) -> Body:
    """Body of markers of a calibration, by their indices in it, the same for every run with it."""
    return body_of(calibration.model(), calibration.M[list(indices)])


def measured_task(
    model: Model,
    q_start: FloatArray,
    s_start: FloatArray,
    s_star: FloatArray,
    center: int,
    sight: Sight | None,
) -> Task:
    """The task as the images at start and goal show it, by the body or point by point.

    Parameters
    ----------
    q_start : (n,) joint readings at the start, rad or m.
    s_start, s_star : (2, m, 2) pixels of the face.
    center : index of the centre marker, or ``MIDPOINT``.

    Raises
    ------
    WorkFailed
        If the images do not show where the face or its body is.
    """
    if sight is None:
        return task_from_images(model, s_start, s_star, center)
    m = s_star.shape[1]
    return task_from_body(model, sight.body, q_start, sight.s_start, sight.s_star, center, m)


def reach_for(config: "Config", calibration: Calibration) -> Reach:
    """Start, goal and their images, of the simulated robot or of the one in ``plant.use``.

    Raises
    ------
    InputError
        If the configuration lacks a part of it, naming the key to set.
    WorkFailed
        If the goal cannot be reached or seen.
    """
    if config.plant.use is None:
        return reach_of(config, truth_of(config))
    return _predicted(config, calibration)


def observed(config: "Config", calibration: Calibration) -> list[int]:
    """Numbers of the markers that a robot in ``plant.use`` observes, in its order."""
    known = config.markers.known if config.markers is not None else None
    numbers = list(known) if known is not None else calibration.marker.tolist()
    for number in face_numbers(config):
        if number not in numbers:
            raise InputError(f"markers.face: marker {number} is not among those observed, {numbers}")
    return numbers


def watched(config: "Config", calibration: Calibration) -> list[int]:
    """Numbers of the observed markers that the calibration knows, the face first, then the pins."""
    face, known = face_numbers(config), calibration.marker.tolist()
    pins = [number for number in observed(config, calibration) if number in known and number not in face]
    return [*face, *pins]


def sight_for(config: "Config", calibration: Calibration, reach: Reach) -> Sight | None:
    """The body to measure with, of the simulated robot or of the one in ``plant.use``."""
    if config.plant.use is None:
        return sight_of(config, calibration, truth_of(config), reach)
    if by_points(config, calibration):
        return None
    M = calibration.M[_indices(calibration, watched(config, calibration))]
    return Sight(
        body_of(calibration.model(), M),
        M[reach.s_star.shape[1] :],
        np.concatenate([reach.s_start, reach.pins_start], axis=1),
        np.concatenate([reach.s_star, reach.pins_star], axis=1),
    )


def _indices(calibration: Calibration, numbers: Sequence[int]) -> IntArray:
    known = calibration.marker.tolist()
    return np.array([known.index(number) for number in numbers])


def face_of(config: "Config", calibration: Calibration) -> IntArray:
    """Indices of the face markers among those of the calibration."""
    return _indices(calibration, face_numbers(config))


def _predicted(config: "Config", calibration: Calibration) -> Reach:
    """Start and goal of a robot whose truth nobody knows."""
    if config.task is None:
        raise InputError("this stage needs a task: set task.start and task.goal")
    joints = joints_of(config, calibration.joint_types)
    start, goal = config.task.start, config.task.goal
    for vector, key in ((start, "task.start"), (goal.joints, "task.goal.joints")):
        if vector is not None and len(vector.joints) != len(joints.types):
            raise InputError(f"{key}: {len(vector.joints)} values for {len(joints.types)} joints")
    q_from = np.array(start.values(joints.types))
    q_start = q_from
    if config.task.start_offset is not None:
        q_start = q_from + np.array(config.task.start_offset.values(joints.types))
    joints.require_inside(q_start, "task.start")
    s_start, pins_start = _images(config, calibration, q_start, "task.start")
    if goal.images is not None:
        s_star = np.array([goal.images.left, goal.images.right])
        return Reach(q_start, None, s_start, s_star, pins_start, np.full(pins_start.shape, np.nan))
    if goal.joints is not None:
        q_goal = np.array(goal.joints.values(joints.types))
    elif config.robot is None:
        raise InputError("task.goal.turn_deg needs the model of the robot: give joints or images instead")
    else:
        q_goal = goal_joints(config.task, joints.types, truth_of(config), q_from)
    joints.require_inside(q_goal, "task.goal")
    s_star, pins_star = _images(config, calibration, q_goal, "task.goal")
    return Reach(q_start, None, s_start, s_star, pins_start, pins_star)


def _images(
    config: "Config", calibration: Calibration, q: FloatArray, where: str
) -> tuple[FloatArray, FloatArray]:
    """Predicted pixels (2, k, 2) of the face and (2, p, 2) of the pins at the joints q (n,)."""
    s = predict(calibration, q[None])[0][:, _indices(calibration, watched(config, calibration))]
    k = len(face_numbers(config))
    if np.isnan(s[:, :k]).any():
        raise WorkFailed(f"{where}: by the calibration, the face is not in front of both cameras there")
    return np.ascontiguousarray(s[:, :k]), s[:, k:]


def disturbance_of(config: "Config", n: int) -> Disturbance:
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


def lose_markers(config: "Config", noise: FloatArray, numbers: Sequence[int]) -> None:
    """Make the noise of lost markers NaN, in place, by which they are unseen.

    Parameters
    ----------
    noise : (k, 2, m, 2) at every instant, px.
    numbers : (m,) of the markers.
    """
    lost = config.disturbance.lost_markers
    if lost is None:
        return
    those = [i for i, number in enumerate(numbers) if lost.markers is None or number in lost.markers]
    noise[lost.from_step : _end(lost.from_step, lost.steps), :, those] = np.nan


def servo_noise(config: "Config", m: int, pins: int = 0) -> FloatArray:
    """Pixel noise of m face markers and of pins at every instant, the same for every law, px."""
    return noise_of(config.seed, config.noise.servo_px, config.stop.max_steps + 1, m, pins)


def noise_of(seed: int, sigma: float, instants: int, m: int, pins: int) -> FloatArray:
    """Pixel noise (instants, 2, m + pins, 2) of a seed, px; fewer instants are the first of more."""
    noise = np.zeros((instants, 2, m + pins, 2))
    if sigma > 0.0:
        for these, count, stream in ((slice(m), m, SERVO_NOISE), (slice(m, None), pins, PIN_NOISE)):
            if count > 0:
                drawn = stream_of(seed, stream).standard_normal((instants, 2, count, 2))
                np.multiply(sigma, drawn, out=noise[:, :, these])
    return noise
