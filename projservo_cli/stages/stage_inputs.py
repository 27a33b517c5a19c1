"""Inputs of each stage: records of the values that it reads, of which its key is a hash."""

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from projservo_cli.detection.finders import Board
from projservo_cli.image_size import ImageSize
from projservo_cli.records import TOOL, Calibration, FloatArray, InputError, JointLimits, StatedBoard
from projservo_cli.result_hashes import File, digest, encoded
from projservo_cli.robots.contract import Bounds
from projservo_cli.robots.joint_limits import Joints
from projservo_cli.settings.cameras import Cameras
from projservo_cli.settings.control import LawSettings, SpeedLimits
from projservo_cli.settings.disturbance import EachView, Events
from projservo_cli.settings.markers import Markers
from projservo_cli.settings.noise_and_data import LoopNoise
from projservo_cli.settings.objects import Objects, ObjectSettings
from projservo_cli.settings.plant import Rest, RunConditions, ServoLimits
from projservo_cli.settings.robot_and_rig import LimitSettings
from projservo_cli.settings.sections import JointVector
from projservo_cli.settings.stop_and_report import ReportSettings, Stop
from projservo_cli.settings.task import GoalImages, TaskSettings, Trajectory
from projservo_cli.simulation.arm import SerialArm
from projservo_cli.simulation.ground_truth import SceneObject, Truth
from projservo_cli.simulation.rendering import RenderedScene
from projservo_cli.simulation.robot_with_faults import SimulatedRobot
from projservo_cli.store.display import About
from projservo_cli.task.incidences import Incidence
from projservo_cli.task.stand_off import StandOff


class JointSettings(NamedTuple):
    """Joints as far as they are configured; data give the rest."""

    types: str  # one letter a joint, R or P; empty if only a table gives them
    ranges: tuple[tuple[float, float], ...] | None  # lowest and highest readings of an arm, rad or m
    limits: LimitSettings | None  # limits of a robot without kinematics
    unit: str  # unit of the given readings of revolute joints, deg or rad
    known: int  # number of joints with given readings
    speeds: SpeedLimits = SpeedLimits()
    flange_chart: FloatArray | None = None  # (2, 4, 4) of readings that are poses of the flange

    def joints(self, default_types: str = "", calibration: Calibration | None = None) -> Joints:
        """Joints of the robot; of ``default_types``, otherwise revolute ones, if their types are unknown.

        calibration : whose data give limits if they are taken from there; without, none are.
        """
        types, pace = self.types or default_types or "R" * self.known, self.speeds
        lower, upper = self._limits(types, calibration)
        slides = [kind == "P" for kind in types]
        speed = np.where(slides, pace.prismatic, pace.revolute)
        acceleration = np.where(slides, pace.sliding, pace.turning)
        units = tuple("m" if kind == "P" else self.unit for kind in types)
        return Joints(types, JointLimits(lower, upper, speed, acceleration), units)

    def _limits(self, types: str, calibration: Calibration | None) -> tuple[FloatArray, FloatArray]:
        """Lower and upper limits (n,), rad or m; infinite where unknown."""
        limits, pairs = self.limits, self.ranges
        if limits is not None and limits.from_data is not None and calibration is not None:
            share, span = limits.from_data, calibration.excitation
            return calibration.joint_min - share * span, calibration.joint_min + (1.0 + share) * span
        if limits is not None and limits.joints is not None:
            if len(limits.joints) != len(types):
                raise InputError(f"robot.limits.joints: give a pair for each of {len(types)} joints")
            pairs = limits.values(types)
        rows = pairs or ((-math.inf, math.inf),) * len(types)
        lower, upper = np.array(rows, dtype=np.float64).reshape(-1, 2).T.copy()
        return lower, upper


class Following(NamedTuple):
    """Pace of commands to a robot of the contract, and limits of its servos."""

    period: float  # period of commands, s
    speed_scale: float  # factor of every command
    servos: ServoLimits

    def bounds(self, joints: Joints) -> Bounds:
        """Return the bounds of commands, and limits of the servos."""
        servos, speed = self.servos, joints.limits.speed * self.speed_scale
        sag = joints.length_of(servos.max_steady_state_error_deg)
        lead = speed * (servos.max_servo_lag_s + self.period) + sag
        if servos.max_relative_target_deg is not None:
            lead = joints.length_of(servos.max_relative_target_deg)
        limits = joints.limits._replace(speed=speed)
        return Bounds(limits, lead, self.period, servos.max_servo_lag_s, sag, joints.units)


class OwnRobot(NamedTuple):
    """The user's robot."""

    target: str  # its class, module:Class
    options: dict[str, Any]  # arguments that the class is made with
    dictionary: str | None  # dictionary of tags, passed to a class that takes it
    timeout_s: float  # most time an answer may take
    open_s: float  # most time that opening may take
    image_size: ImageSize | None  # width and height of its images, px, if known
    cameras: Cameras | None = None  # cameras of an arm that reads joints alone
    board: Board | None = None  # whose corners these show; None for tags
    flange_chart: FloatArray | None = None  # (2, 4, 4) of poses that it takes and reads; None for joints


class Drive(NamedTuple):
    """A robot of the contract and how it is driven."""

    robot: SimulatedRobot | OwnRobot
    following: Following
    endless: bool  # whether a simulated one goes beyond its limits
    further: tuple[int, ...] = ()  # numbers of the markers of objects, which it observes after its own


class Motions(NamedTuple):
    """Trial motions: every joint alone about a reference, then all joints at once."""

    reference: JointVector
    amplitude: tuple[float, float]  # farthest trial to each side, revolute joints, rad, and prismatic ones, m
    frames_per_joint: int
    random_poses: int  # number of poses of all joints at once
    # rad by which trials are spread at most, so that no reading repeats its error; 0 if none has any
    spread: float
    seed: int


def of_simulation(truth: Truth | None) -> Truth:
    """Return the truth of a simulated robot. Raises InputError for a user's robot."""
    if truth is None:
        raise InputError("this needs a simulated robot: describe robot, rig and markers, without plant.use")
    return truth


@dataclass(frozen=True, eq=False)
class Trials:
    """Trial motions, and the robot that is driven through them."""

    motions: Motions
    joints: JointSettings
    truth: Truth | None  # robot, rig and markers as they are; None for a user's robot
    driven: Drive | None  # drive by the contract; None for one that reaches every set-point
    noise_px: float  # standard deviation of simulated pixels
    rest: Rest  # at each pose, of a robot that is driven


@dataclass(frozen=True, eq=False)
class RecordingInputs:
    """Inputs of a recording."""

    trials: Trials
    numbers: tuple[int, ...]  # numbers of the markers
    face: tuple[int, ...]  # numbers of the markers that must stay visible; may be empty
    dictionary: str | None  # dictionary of the tags; None if not configured
    tagged: bool  # whether markers are corners of tags
    mount: str  # mount of the cameras, world or tool
    max_steady_state_error_deg: float  # how far a joint at rest may stay from its set-point

    @property
    def key(self) -> str:
        """The plant, and a hash of the inputs of the pixels except the joints, which are in the table.

        The settings that drive an external robot may change during a recording.
        """
        trials, own = self.trials, self.own
        robot = (
            own._replace(timeout_s=0.0, open_s=0.0, cameras=None) if own else (trials.truth, trials.driven)
        )
        how = trials.motions.seed, trials.noise_px, trials.rest.averaged_frames, trials.rest.settle_s
        key = digest(encoded((robot, how, self.numbers, self.dictionary)))
        return f"{own.target if own else 'simulated'} {key[:16]}"

    @property
    def own(self) -> OwnRobot | None:
        """The user's robot that is driven."""
        robot = self.trials.driven.robot if self.trials.driven is not None else None
        return robot if isinstance(robot, OwnRobot) else None


class Table(NamedTuple):
    """A recorded table and its settings."""

    file: File
    readings: File | None  # table of joints for a list of detections
    joint_types: str | None  # one letter a joint, R or P; None for R
    # unit of revolute joints, deg or rad; None for rad unless readings look like degrees
    joint_unit: str | None
    image_size: ImageSize | None  # width and height, px, of both images or of one each, if known
    noise_px: float | None  # standard deviation of a coordinate; None to estimate it
    seed: int  # seed of random starts
    mount: str | None  # mount of the cameras, world or tool; None as the table states
    order_stated: bool  # whether the user stated the order of the joints
    flange_chart: FloatArray | None = (
        None  # (2, 4, 4) in which poses of the flange are read; None for their own
    )


@dataclass(frozen=True)
class Estimation:
    """Settings of the estimation of a calibration."""

    lens: bool = False  # whether to estimate radial distortion, two coefficients a camera, and its centre
    init: File | None = None  # JSON of a robot and rig that are tried first as a start
    cross_validate: int | None = None  # parts into which poses are divided to predict each from the others
    max_predicted_px: float | None = None  # error by deviations from the model that is accepted, px
    joint_model: str | tuple[str, ...] | None = None  # auto, or curves of joints to fit
    boards: tuple[StatedBoard, ...] = ()  # boards whose corners are markers, of known shape
    intrinsics: tuple[tuple[str, File], ...] = ()  # file of each camera that is known, by its name
    focal_std_fraction: float = 0.005  # standard deviation of their focal lengths, over these
    center_std_fraction: float = 0.01  # the same of their centres, over the size of the image


@dataclass(frozen=True, eq=False)
class CalibrationInputs:
    """Inputs of a calibration."""

    source: Table | Trials
    estimation: Estimation
    joint_noise: float | None  # standard deviation of joint readings, rad; None for the noise of the source


@dataclass(frozen=True, eq=False)
class RefitInputs:
    """Inputs of a calibration of which one camera is fitted again."""

    before: "CalibrationInputs | RefitInputs"
    view: str  # name of the camera
    file: File  # table of images by it
    readings: File | None  # table of joints for a list of detections
    joint_unit: str | None  # unit of revolute joints, deg or rad; None for rad
    image_size: ImageSize | None  # width and height, px, of all images or of one each, if known
    max_predicted_px: float | None = None  # error of predictions that is accepted, px


class SuggestionInputs(NamedTuple):
    """Inputs of a suggestion of further poses, except observations and calibration."""

    joints: JointSettings
    image_size: ImageSize | None  # width and height, px, of both images or of one each, if known
    recorded: bool  # whether the robot may not go farther than it was
    unit: str  # unit of revolute joints in the list
    seed: int


@dataclass(frozen=True, eq=False)
class TeachInputs:
    """Inputs of teaching a pose."""

    driven: Drive
    joints: JointSettings
    numbers: tuple[int, ...]  # numbers of the markers
    noise_px: float  # standard deviation of simulated pixels
    settle_s: float  # time for which joints and images have been at rest before
    seed: int
    objects: Objects


@dataclass(frozen=True, eq=False)
class PreflightInputs:
    """Inputs of a preflight, which needs neither reference nor task."""

    driven: Drive
    joints: JointSettings
    numbers: tuple[int, ...]  # numbers of the markers
    markers: Markers
    dictionary: str | None  # dictionary of the tags; None if not configured
    mount: str  # mount of the cameras, world or tool
    noise_px: float  # noise of the images of a run, with the factor of its test


@dataclass(frozen=True, eq=False)
class Described:
    """Robot and rig, as far as they are described."""

    truth: Truth | None  # robot, rig and markers as they are; None for a robot that is not simulated
    arm: SerialArm | None  # kinematics as they are described, if they are
    # (V, 3, 4) described cameras, px, if any: from the frame of their mount
    P: FloatArray | None
    mount: str  # mount of the cameras, world or tool
    scene: RenderedScene | None  # where cameras are rendered

    def cameras_at(self, q: FloatArray) -> FloatArray | None:
        """Cameras (V, 3, 4) from the base frame at joints (n,), rad or m, px; None if not described."""
        if self.arm is None or self.P is None:
            return None
        return self.P @ np.linalg.inv(self.arm.pose(q)) if self.mount == TOOL else self.P


@dataclass(frozen=True, eq=False)
class ToolMarkers:
    """Numbers of the markers of the tool."""

    face: tuple[int, ...]  # numbers of the markers that must stay visible
    center: int  # position of the centre marker within the face, or ``MIDPOINT``
    known: tuple[int, ...] | None  # numbers of all markers; None for the markers of the calibration
    tags: tuple[tuple[int, ...], ...]  # numbers of the corners of each tag among them


@dataclass(frozen=True, eq=False)
class PlanInputs:
    """Inputs of a plan, except the calibration."""

    task: TaskSettings | None
    seed: int  # seed of the noise of start and goal
    described: Described
    markers: ToolMarkers
    joints: JointSettings
    image_size: ImageSize | None  # width and height, px, of both images or of one each, if known
    noise: LoopNoise  # noise of simulated pixels
    features: str | None  # points, body, or None for body if the calibration is usable
    tests_images: bool  # whether images are tested against the calibration
    trajectory: Trajectory
    lengths: FloatArray  # (m, m) distances between the markers of the face, m; NaN if unknown
    # that are to hold at the goal, by numbers of markers; none for the pose
    incidences: tuple[Incidence, ...] = ()
    # Width and height to which recorded images reach at least, px, if their size is not known.
    seen_px: ImageSize | None = None
    # Objects that the goal was taught on; none for a fixed goal.
    carriers: "tuple[CarryingObject, ...]" = ()
    displaced: StandOff | None = None  # displacement of the goal, or of the start instead
    q_current: FloatArray | None = None  # (n,) present joints of the arm, rad or m, once that is known

    @property
    def required_task(self) -> TaskSettings:
        """Return the task. Raises InputError without one, naming the keys to set."""
        if self.task is None:
            raise InputError("this stage needs a task: set task.start and task.goal")
        return self.task

    @property
    def of_taught_pose(self) -> "PlanInputs":
        """Return the inputs of the whole pose that was taught, wherever objects are now."""
        return replace(self, incidences=(), carriers=())


class Contract(NamedTuple):
    """Further inputs of a run by the contract."""

    driven: Drive
    events: Events  # events of a simulated robot
    timeout_s: float  # most time that an answer may take
    time_offset_s: EachView | None  # time offset of the images of the cameras; None to estimate them
    settle_s: float | None  # time for which a user's robot has been at rest at the start
    identity: str = ""  # identity of the robot in the calibration's recording; may be empty
    ideal: bool = False  # whether it is a simulated one whose images come with its readings


@dataclass(frozen=True, eq=False)
class ServoInputs:
    """Inputs of the run of a law, except calibration and plan."""

    plan: PlanInputs  # inputs of the plan
    laws: LawSettings
    stop: Stop
    conditions: RunConditions
    contract: Contract | None  # None for the ideal plant

    @property
    def required_contract(self) -> Contract:
        """Return the contract. Raises InputError for the ideal plant."""
        if self.contract is None:
            raise InputError("this needs a robot of the contract: set plant.use")
        return self.contract


class KnownLengths(NamedTuple):
    """Measured lengths on the tool."""

    numbers: tuple[int, ...]  # numbers of the markers
    apart: FloatArray  # (m, m) distances between them, m; NaN if unknown
    tag_size_m: float | None  # side of tags whose places are not known; None without such
    face: tuple[int, ...]  # numbers of the markers whose frame the tool has; may be empty


@dataclass(frozen=True, eq=False)
class CarryingObject:
    """Object that a goal was taught on, and is carried by."""

    name: str
    objects: Objects  # all of them, how far they may have moved, and how uncertain the goal may be
    taught: GoalImages | None  # its images when the goal was taught; None for images of a simulation
    placed: SceneObject | None  # where it is in a simulation
    at_first: RenderedScene | None  # scene with it where it was when the goal was taught
    driven: Drive | None  # robot that looks at it; None where images are simulated by themselves
    rest: Rest  # rest of such a robot
    lengths: KnownLengths

    @property
    def settings(self) -> ObjectSettings:
        """Its section of the configuration."""
        return self.objects.named[self.name]

    @property
    def numbers(self) -> tuple[int, ...]:
        """Numbers of its markers."""
        return self.settings.numbers


@dataclass(frozen=True, eq=False)
class ReportInputs:
    """Inputs of a report, except calibration, plan and runs."""

    about: About
    files: ReportSettings
    extra: ServoInputs | None  # inputs of laws by themselves on the ideal plant; None if there is no task
    trajectory: Trajectory  # requested motion of the plan
    lengths: KnownLengths


class Scenery(NamedTuple):
    """Scene of the runs."""

    name: str  # name of the configuration
    truth: Truth  # robot, rig and face as they are described
    opaque: bool  # whether the face hides its markers from a camera behind it
    simulated: bool  # whether joints are simulated; otherwise a robot reported them
