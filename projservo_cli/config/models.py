"""The configuration as a whole; every key has its unit in its name."""

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, Strict, StringConstraints, model_validator

from projservo_cli.config.checks import problems
from projservo_cli.config.fields import (
    Count,
    JointVector,
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

    calibration_px: NotNegative = 0.5
    servo_px: NotNegative = 0.0


class CalibrationSettings(Section):
    """Trial motions of one joint each around a reference, and the method that evaluates them."""

    method: Literal["refined", "linear", "closed_form"] = "refined"
    frames_per_joint: Annotated[int, Strict(), Field(ge=0, le=10_000)] = 8
    amplitude_deg: Annotated[float, Strict(), Field(ge=0, lt=180, allow_inf_nan=False)] = 30.0
    amplitude_m: NotNegative = 0.15
    reference: JointVector | None = None
    cross_validate: Annotated[int, Strict(), Field(ge=2, le=10_000)] | None = None
    init: Annotated[str, StringConstraints(min_length=1)] | None = None
    lens: Annotated[bool, Strict()] = False


class Data(Section):
    """A recorded run: the observation table that stands in for simulated trial motions."""

    table: Annotated[str, StringConstraints(min_length=1)]
    joints: Annotated[str, StringConstraints(pattern=r"^[RrPp]+$"), AfterValidator(str.upper)] | None = None
    joint_unit: Literal["deg", "rad"] | None = None  # None: rad, unless readings look like degrees
    noise_px: Positive | None = None
    image_size_px: tuple[Count, Count] | None = None


class Perturbation(Section):
    """A small displacement of the goal pose, in the tool frame."""

    translation_m: Vector3 = (0.0, 0.0, 0.0)
    rotation_rad: Vector3 = (0.0, 0.0, 0.0)


class GoalImages(Section):
    """Pixels of the face at the goal, in the order of ``markers.face``."""

    left: tuple[Vector2, ...]
    right: tuple[Vector2, ...]


class Goal(Section):
    """The goal: joint readings, a turn about the rig's roll axis, or the face's goal images."""

    joints: JointVector | None = None
    turn_deg: Annotated[float, Strict(), Field(ge=-360, le=360, allow_inf_nan=False)] | None = None
    perturbation: Perturbation | None = None
    images: GoalImages | None = None


class Task(Section):
    """A reaching task from ``start`` to ``goal``."""

    start: JointVector
    goal: Goal


class Trajectory(Section):
    """How the planned motion is spread over σ in [0, 1], and what the profile ``constrained`` keeps to."""

    profile: Profile = "linear"
    delta: Annotated[float, Strict(), Field(gt=0, le=1, allow_inf_nan=False)] = 0.9
    samples: Annotated[int, Strict(), Field(ge=2, le=100_001)] = 101
    border_px: NotNegative = 5.0
    least_condition: Annotated[float, Strict(), Field(ge=0, lt=1, allow_inf_nan=False)] = 0.001


class Control(Section):
    """The laws to run, their gains in 1/s, and how fast the joints may move."""

    laws: tuple[Law, ...] = Field(
        ("direct_three", "direct_two", "stacked", "blockwise", "euclidean_points"), min_length=1
    )
    must_converge: tuple[Law, ...] = ("direct_three", "direct_two")
    period_s: Positive = 0.04
    gain_t: Positive = 2.5
    gain_r: Positive = 2.5
    gain_p: Positive = 2.5
    gain_s: Positive = 2.5
    ratio_rp: Positive = 1.0
    gain: Positive = 2.5
    joint_speed_limit_deg_s: Positive | None = 125.0
    prismatic_speed_limit_m_s: Positive | None = None
    substeps: Literal["none", "auto"] = "auto"
    observation: Literal["points", "body"] | None = None  # None: body, if the calibration is usable


class PlantSettings(Section):
    """What is driven, and what the simulated robot does at its borders.

    ``use`` names the class of a robot that is not simulated, ``options`` are what it is made with;
    such a robot is never sent beyond its joint limits.
    """

    use: PlantClass | None = None
    options: Options = Options()
    timeout_s: Positive = 1.0
    speed_scale: Annotated[float, Strict(), Field(gt=0, le=1, allow_inf_nan=False)] = 1.0
    self_occlusion: Literal["transparent", "opaque"] = "transparent"
    joint_limits: Literal["report", "stop"] = "report"
    image_border: Literal["report", "stop"] = "report"


class Stop(Section):
    """When a closed loop ends."""

    image_px: Positive = 0.01
    noise_factor: NotNegative = 2.0
    max_steps: Count = 2000
    diverged_factor: Annotated[float, Strict(), Field(gt=1, allow_inf_nan=False)] = 10.0
    plateau_steps: Count = 20
    lost_steps: Whole = 25
    innovation_factor: NotNegative = 1.0


class ReportSettings(Section):
    """What the report writes."""

    formats: tuple[Literal["svg", "pdf", "png"], ...] = Field(("svg", "pdf", "png"), min_length=1)


def _folder_name(name: str) -> str:
    if name != name.strip() or name in {"", ".", ".."} or any(c in '/\\:*?"<>|' or c < " " for c in name):
        raise ValueError("must be usable as the name of a folder: no path separators, no surrounding spaces")
    return name


class Config(Section):
    """Everything a run depends on.

    ``robot``, ``rig``, ``markers`` and ``task`` may be absent in a recorded run (``data`` set) as
    far as the stages asked for do without them.
    """

    name: Annotated[str, StringConstraints(max_length=100), AfterValidator(_folder_name)]
    seed: Whole = 0
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
