"""The configuration as a whole; every key has its unit in its name."""

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, Strict, StringConstraints, model_validator

from projservo_cli.config.checks import problems
from projservo_cli.config.disturbance import Disturbance
from projservo_cli.config.fields import (
    Count,
    JointVector,
    Modes,
    NotNegative,
    Positive,
    Section,
    Vector2,
    Vector3,
    Whole,
)
from projservo_cli.config.foreign import Law, Options, PlantClass
from projservo_cli.config.robot import Markers, Rig, Robot

Profile = Literal[
    "linear", "exponential", "rotation_first", "translation_first", "planar_first", "constrained"
]


class Noise(Section):
    """Standard deviation of simulated pixel noise, per coordinate."""

    calibration_px: NotNegative = Field(0.5, description="in the images of trial motions")
    servo_px: NotNegative = Field(0.0, description="in the images of the closed loop")
    shown_frames: Count = Field(
        1, description="images averaged of the start and of the goal, where the robot rests"
    )


class CalibrationSettings(Section):
    """Trial motions of one joint each around a reference, and the method that evaluates them."""

    method: Literal["refined", "linear", "closed_form"] = Field(
        "refined", description="bundle adjustment; linear multi-frame; the paper's closed forms"
    )
    frames_per_joint: Annotated[int, Strict(), Field(ge=0, le=10_000)] = Field(
        8, description="trial poses of each joint, beside the reference"
    )
    amplitude_deg: Annotated[float, Strict(), Field(ge=0, lt=180, allow_inf_nan=False)] = Field(
        30.0, description="farthest trial to each side, revolute joints"
    )
    amplitude_m: NotNegative = Field(0.15, description="farthest trial to each side, prismatic joints")
    reference: JointVector | None = Field(
        None, description="joint readings at the reference pose; null for those of task.start"
    )
    cross_validate: Annotated[int, Strict(), Field(ge=2, le=10_000)] | None = Field(
        None, description="parts into which poses are divided to predict each from the others; null for none"
    )
    init: Annotated[str, StringConstraints(min_length=1)] | None = Field(
        None, description="JSON file of a robot and rig known beforehand, tried first as a start"
    )
    seed: Whole | None = Field(None, description="seed of the noise of the trials; null for that of the run")
    lens: Annotated[bool, Strict()] = Field(
        False, description="whether to estimate two coefficients of radial distortion a camera"
    )


class Data(Section):
    """A recorded run: the observation table that stands in for simulated trial motions."""

    table: Annotated[str, StringConstraints(min_length=1)] = Field(
        description="file of the table, relative to the configuration"
    )
    joints: Annotated[str, StringConstraints(pattern=r"^[RrPp]+$"), AfterValidator(str.upper)] | None = Field(
        None, description="one letter a column q1 ... qN, R or P; null for those of robot, else all R"
    )
    joint_unit: Literal["deg", "rad"] | None = Field(
        None, description="unit of revolute joints; null for rad, unless readings look like degrees"
    )
    noise_px: Positive | None = Field(None, description="pixel noise per coordinate; null to estimate it")
    image_size_px: tuple[Count, Count] | None = Field(
        None, description="width and height of the images; null for that of rig, else from the readings"
    )


class Perturbation(Section):
    """A small displacement of the goal pose, in the tool frame."""

    translation_m: Vector3 = Field((0.0, 0.0, 0.0), description="along the axes of the tool")
    rotation_rad: Vector3 = Field((0.0, 0.0, 0.0), description="rotation vector in the axes of the tool")


class GoalImages(Section):
    """Pixels of the face at the goal, in the order of ``markers.face``."""

    left: tuple[Vector2, ...] = Field(description="u and v of each marker in the left image, px")
    right: tuple[Vector2, ...] = Field(description="u and v of each marker in the right image, px")


class Goal(Section):
    """The goal: joint readings, a turn about the rig's roll axis, or the face's goal images."""

    joints: JointVector | None = Field(None, description="joint readings at the goal")
    turn_deg: Annotated[float, Strict(), Field(ge=-360, le=360, allow_inf_nan=False)] | None = Field(
        None, description="turn from the start about the roll axis of the rig"
    )
    perturbation: Perturbation | None = Field(
        None, description="small displacement of a goal given by turn_deg, in the tool frame"
    )
    images: GoalImages | None = Field(None, description="pixels of the face, recorded at the goal")


class Task(Section):
    """A reaching task from ``start`` to ``goal``.

    ``start_offset`` moves the start alone: a goal that is a turn stays that of the start without it.
    """

    start: JointVector = Field(description="joint readings at the start")
    start_offset: JointVector | None = Field(
        None, description="added to the start alone; the goal stays what it is without"
    )
    goal: Goal


class Trajectory(Section):
    """How the planned motion is spread over σ in [0, 1], and what the profile ``constrained`` keeps to."""

    profile: Profile = Field("linear", description="which part is driven when")
    delta: Annotated[float, Strict(), Field(gt=0, le=1, allow_inf_nan=False)] = Field(
        0.9, description="share of the translation at which visibility changes that is kept to"
    )
    samples: Annotated[int, Strict(), Field(ge=2, le=100_001)] = Field(
        101, description="points of the path that are stored"
    )
    duration_s: Positive | None = Field(
        None, description="time the motion is given; null for as little as the joint-speed limit lets it take"
    )
    ramp_s: NotNegative = Field(
        0.4, description="time in which a planned motion comes up to its pace, and to rest again at its end"
    )
    border_px: NotNegative = Field(
        5.0, description="in the profile constrained: least distance of a marker from the border of an image"
    )
    least_condition: Annotated[float, Strict(), Field(ge=0, lt=1, allow_inf_nan=False)] = Field(
        0.001,
        description="in the profile constrained: least reciprocal condition of the face's image Jacobian",
    )
    most_miss_px: NotNegative = Field(
        5.0,
        description="in the profile constrained, where no path keeps everything: least_condition is "
        "given up, and joints may stay behind the planned images by less than this; 0 gives up neither",
    )


class Control(Section):
    """The laws to run, in which modes, their gains in 1/s, and how fast the joints may move."""

    laws: tuple[Law, ...] = Field(
        ("direct_three", "direct_two", "stacked", "blockwise", "euclidean_points"),
        min_length=1,
        description="laws to run, each from the start; module:Class for a law of yours",
    )
    mode: Modes = Field(
        ("replan",),
        description="whether each step plans anew or the plan is followed; with a list, each law in those "
        "of the modes that it has",
    )
    without_plan: Literal["replan", "refuse"] = Field(
        "replan", description="whether a law that no joints could follow the plan with replans, or is not run"
    )
    must_converge: tuple[Law, ...] = Field(
        ("direct_three", "direct_two"), description="laws whose failure is that of the call, exit code 1"
    )
    period_s: Positive = Field(0.04, description="control period")
    gain_t: Positive = Field(2.5, description="gain of the translation, 1/s")
    gain_r: Positive = Field(2.5, description="gain of the rotation onto the plane, 1/s")
    gain_p: Positive = Field(2.5, description="gain of the rotation within the plane, 1/s")
    gain_s: Positive = Field(2.5, description="gain of both rotations as one, in direct_two and exact, 1/s")
    ratio_rp: Positive = Field(1.0, description="λ_r/λ_p, how direct_two composes both rotations into one")
    gain: Positive = Field(2.5, description="gain of the classical laws, 1/s")
    joint_speed_limit_deg_s: Positive | None = Field(125.0, description="of revolute joints; null for none")
    prismatic_speed_limit_m_s: Positive | None = Field(None, description="of prismatic joints; null for none")
    substeps: Literal["none", "auto"] = Field(
        "auto", description="whether the law exact sends long steps in parts"
    )
    observation: Literal["points", "body"] | None = Field(
        None,
        description="what direct laws measure with: the face's points or all visible markers; "
        "null for body where the calibration is usable",
    )


class PlantSettings(Section):
    """What is driven, and what the simulated robot does at its borders.

    ``use`` names the class of a robot that is not simulated, ``options`` are what it is made with;
    such a robot is never sent beyond its joint limits.
    """

    use: PlantClass | None = Field(
        None, description="class of a robot of yours, module:Class; null for the simulated one"
    )
    options: Options = Field(Options(), description="arguments that the class is made with")
    timeout_s: Positive = Field(1.0, description="most time an answer of the robot may take")
    speed_scale: Annotated[float, Strict(), Field(gt=0, le=1, allow_inf_nan=False)] = Field(
        1.0, description="factor of every command to the robot"
    )
    self_occlusion: Literal["transparent", "opaque"] = Field(
        "transparent", description="whether the face hides its markers from a camera behind it"
    )
    joint_limits: Literal["report", "stop"] = Field(
        "report", description="whether a joint limit is noted or ends the run"
    )
    image_border: Literal["report", "stop"] = Field(
        "report", description="whether a marker beyond the image is noted or ends the run"
    )


class Stop(Section):
    """When a closed loop ends."""

    image_px: Positive = Field(0.01, description="converged within this image error, rms")
    noise_factor: NotNegative = Field(2.0, description="widens image_px by so many times noise.servo_px")
    max_steps: Count = Field(2000, description="commands after which a run ends")
    diverged_factor: Annotated[float, Strict(), Field(gt=1, allow_inf_nan=False)] = Field(
        10.0, description="diverged where the image error or the distance grows so many times"
    )
    plateau_steps: Count = Field(20, description="stands still where the error falls < 1 % in so many steps")
    lost_steps: Whole = Field(25, description="periods for which lost markers are waited for")
    innovation_factor: NotNegative = Field(
        1.0,
        description="a robot of yours is disturbed where images are off the prediction by more than chance "
        "and so many times the noise; 0 tests nothing",
    )


class ReportSettings(Section):
    """What the report writes."""

    formats: tuple[Literal["svg", "pdf", "png"], ...] = Field(
        ("svg", "pdf", "png"), min_length=1, description="files of each figure"
    )


def folder_name(name: str) -> str:
    """A name that can be that of a folder; else ValueError."""
    if name != name.strip() or name in {"", ".", ".."} or any(c in '/\\:*?"<>|' or c < " " for c in name):
        raise ValueError("must be usable as the name of a folder: no path separators, no surrounding spaces")
    return name


class Config(Section):
    """Everything a run depends on.

    ``robot``, ``rig``, ``markers`` and ``task`` may be absent in a recorded run (``data`` set) as
    far as the stages asked for do without them.
    """

    name: Annotated[str, StringConstraints(max_length=100), AfterValidator(folder_name)] = Field(
        description="of the run and its folder; by default that of the file"
    )
    seed: Whole = Field(0, description="of all random numbers; the same seed gives the same run")
    robot: Robot | None = None
    rig: Rig | None = None
    markers: Markers | None = None
    noise: Noise = Noise()
    calibration: CalibrationSettings = CalibrationSettings()
    data: Data | None = None
    task: Task | None = None
    trajectory: Trajectory = Trajectory()
    control: Control = Control()
    plant: PlantSettings = PlantSettings()
    disturbance: Disturbance = Disturbance()
    stop: Stop = Stop()
    report: ReportSettings = ReportSettings()

    @model_validator(mode="after")
    def _consistent(self) -> "Config":
        found = [f"{'.'.join(map(str, path))}: {what}" for path, what in problems(self)]
        if found:
            raise ValueError("; ".join(found))
        return self

    @property
    def recorded(self) -> bool:
        """Whether the calibration comes from an observation table."""
        return self.data is not None

    @property
    def joint_types(self) -> str | None:
        """One letter a joint, R or P; None where only the table tells how many there are."""
        if self.data is not None and self.data.joints is not None:
            return self.data.joints
        return self.robot.joint_types if self.robot is not None else None
