"""The configuration as a whole; every key has its unit in its name."""

import json
import math
from collections.abc import Callable, Iterator
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    Strict,
    StringConstraints,
    WithJsonSchema,
    model_validator,
)
from pydantic_core import PydanticCustomError

from projservo_cli.config.robot import (
    Count,
    JointVector,
    Markers,
    Modes,
    NotNegative,
    Number,
    Positive,
    Rig,
    Robot,
    Section,
    Vector2,
    Vector3,
    Whole,
)
from projservo_cli.records import LAWS, REPLAN
from projservo_cli.robots import plugins


class LostMarkers(Section):
    """Markers that neither camera sees for a while; all of them where none is named."""

    from_step: Whole = Field(description="first step at which they are unseen")
    steps: Count | None = Field(None, description="for how many steps; null for ever")
    markers: Annotated[tuple[Whole, ...], Field(min_length=1)] | None = Field(
        None, description="their numbers; null for all markers"
    )


class Bump(Section):
    """A joint knocked aside; ``read: false`` for a joint that slips on its encoder."""

    at_step: Count = Field(description="step at which it is knocked")
    joint: Count = Field(description="the joint, counted from 1")
    by_deg: Number | None = Field(None, description="how far, a revolute joint")
    by_m: Number | None = Field(None, description="how far, a prismatic joint")
    read: Annotated[bool, Strict()] = Field(True, description="whether its reading follows")


class FrozenJoint(Section):
    """A joint whose reading stands still while it moves."""

    joint: Count = Field(description="the joint, counted from 1")
    from_step: Whole = Field(description="first step at which its reading stands still")
    steps: Count | None = Field(None, description="for how many steps; null for ever")


class Disturbance(Section):
    """Everything that befalls the simulated robot and its images."""

    lost_markers: LostMarkers | None = None
    bump: Bump | None = None
    frozen_joint: FrozenJoint | None = None
    delay_periods: Annotated[int, Strict(), Field(ge=0, le=1000)] = Field(
        0, description="by how many periods images are late"
    )


Path = tuple[str | int, ...]
Finding = tuple[Path, str]
Check = Callable[[Any], Iterator[Finding]]

_CHECKS: list[tuple[tuple[str, ...], Check]] = []
TOLERANCE = 1e-6  # of rotations and unit axes written with seven digits or more


def _needs(*sections: str) -> Callable[[Check], Check]:
    def register(check: Check) -> Check:
        _CHECKS.append((sections, check))
        return check

    return register


def problems(config: Any, broken: frozenset[str] = frozenset()) -> list[Finding]:
    """Everything inconsistent in ``config``, leaving out checks that read a ``broken`` section."""
    return [
        finding for sections, check in _CHECKS if broken.isdisjoint(sections) for finding in check(config)
    ]


@_needs("robot")
def _robot(config: Any) -> Iterator[Finding]:
    robot = config.robot
    if robot is None:
        return
    if (robot.dh is None) == (robot.screws is None):
        yield ("robot",), "give exactly one of dh and screws"
        return
    kind = "dh" if robot.dh is not None else "screws"
    for i, joint in enumerate(robot.joints):
        yield from _limits(("robot", kind, "joints", i), joint)
    if robot.dh is not None:
        yield from _rigid(("robot", "dh", "tool"), robot.dh.tool)
        return
    yield from _rigid(("robot", "screws", "base_tool"), robot.screws.base_tool)
    for i, joint in enumerate(robot.screws.joints):
        yield from _screw(("robot", "screws", "joints", i), joint)


def _limits(path: Path, joint: Any) -> Iterator[Finding]:
    given = [name for name in ("limits_deg", "limits_rad", "limits_m") if getattr(joint, name) is not None]
    if len(given) > 1:
        yield (*path, given[1]), f"{given[0]} is set as well; keep one"
    for name in given:
        if (name == "limits_m") != (joint.type == "P"):
            units = "limits_m" if joint.type == "P" else "limits_deg or limits_rad"
            yield (*path, name), f"a joint of type {joint.type} takes {units}"
        low, high = getattr(joint, name)
        if not low < high:
            yield (*path, name), f"the lower limit {low:g} must be below the upper limit {high:g}"


def _rigid(path: Path, matrix: Any) -> Iterator[Finding]:
    rows = [row[:3] for row in matrix[:3]]
    products = [[sum(a * b for a, b in zip(u, v, strict=True)) for u in rows] for v in rows]
    apart = max(abs(products[i][j] - (i == j)) for i in range(3) for j in range(3))
    if tuple(matrix[3]) != (0, 0, 0, 1):
        yield path, "the last row must be [0, 0, 0, 1]"
    elif apart > TOLERANCE or _determinant(rows) < 0:
        yield path, "the upper left 3×3 block must be a rotation, written with seven digits or more"


def _determinant(rows: Any) -> float:
    (a, b, c), (d, e, f), (g, h, i) = rows
    return float(a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g))


def _screw(path: Path, joint: Any) -> Iterator[Finding]:
    axis = "w" if joint.type == "R" else "v"
    length = math.hypot(*getattr(joint, axis))
    if abs(length - 1) > TOLERANCE:
        yield (*path, axis), f"must be of unit length for a joint of type {joint.type}, it is {length:g}"
    if joint.type == "P" and math.hypot(*joint.w) > TOLERANCE:
        yield (*path, "w"), "must be zero for a joint of type P"
    if joint.type == "R" and abs(sum(a * b for a, b in zip(joint.w, joint.v, strict=True))) > TOLERANCE:
        yield (*path, "v"), "must be orthogonal to w: a revolute joint has no pitch"


@_needs("rig")
def _rig(config: Any) -> Iterator[Finding]:
    if config.rig is None:
        return
    if 0 in config.rig.image_size_px:
        yield ("rig", "image_size_px"), "width and height must be greater than 0"
    for side in ("left", "right"):
        yield from _camera(("rig", side), getattr(config.rig, side))


def _camera(path: Path, camera: Any) -> Iterator[Finding]:
    wanted = ("focal_px", "principal_point_px", "position_m", "target_m")
    given = [name for name in wanted if getattr(camera, name) is not None]
    if camera.matrix is not None:
        if given:
            yield (*path, given[0]), "matrix is set as well; keep one description of the camera"
        scale = max(abs(value) for row in camera.matrix for value in row)
        if scale == 0 or abs(_determinant([row[:3] for row in camera.matrix])) < 1e-12 * scale**3:
            yield (*path, "matrix"), "its left 3×3 block is singular: no finite pinhole camera"
        return
    if len(given) < len(wanted):
        missing = ", ".join(name for name in wanted if name not in given)
        yield (
            path,
            f"give matrix, or all of {', '.join(wanted)}" + (f" (missing: {missing})" if given else ""),
        )
        return
    sight = [b - a for a, b in zip(camera.position_m, camera.target_m, strict=True)]
    length, up = math.hypot(*sight), math.hypot(*camera.up)
    if length == 0:
        yield (*path, "target_m"), "is the position of the camera; it must look somewhere"
    elif up == 0 or abs(sum(a * b for a, b in zip(sight, camera.up, strict=True))) > (1 - 1e-9) * length * up:
        yield (*path, "up"), "must not be zero or along the line of sight"


@_needs("markers")
def _markers(config: Any) -> Iterator[Finding]:
    markers = config.markers
    if markers is None:
        return
    known = markers.known
    if known is not None:
        if markers.positions_m is not None and len(known) != len(markers.positions_m):
            yield ("markers", "numbers"), f"{len(known)} numbers for {len(markers.positions_m)} positions_m"
        if len(set(known)) < len(known):
            yield ("markers", "numbers"), "a number stands here twice"
        for i, number in enumerate(markers.face or ()):
            if number not in known:
                yield ("markers", "face", i), f"there is no marker {number}; markers: {_listed(known)}"
    if markers.face is not None and markers.center not in ("midpoint", *markers.face):
        yield (
            ("markers", "center"),
            f"marker {markers.center} is not on the face; face: {_listed(markers.face)}",
        )
    if markers.face is not None and len(set(markers.face)) < len(markers.face):
        yield ("markers", "face"), "a marker stands here twice"


def _listed(numbers: Any) -> str:
    shown = ", ".join(map(str, numbers[:20]))
    return shown + (" …" if len(numbers) > 20 else "")


@_needs("robot", "rig", "markers", "task", "calibration", "data")
def _enough(config: Any) -> Iterator[Finding]:
    if config.data is not None:
        return
    reason = "is missing; a simulated run needs it (a recorded one sets data.table)"
    if config.robot is None:
        yield ("robot",), reason
    if config.rig is None:
        yield ("rig",), reason
    if config.markers is None or config.markers.positions_m is None:
        yield ("markers", "positions_m"), reason
    if config.task is None and config.calibration.reference is None:
        yield ("task",), "is missing; a simulated run needs it, or calibration.reference"


@_needs("calibration")
def _only_refined(config: Any) -> Iterator[Finding]:
    settings = config.calibration
    for key in ("cross_validate", "init"):
        if getattr(settings, key) is not None and settings.method != "refined":
            yield ("calibration", key), f"belongs to the method refined, not to {settings.method}"


@_needs("robot", "data")
def _same_joints(config: Any) -> Iterator[Finding]:
    if config.data is None or config.data.joints is None or config.robot is None:
        return
    types = config.robot.joint_types
    if types and types != config.data.joints:
        yield ("data", "joints"), f"{config.data.joints} are not the joints of the robot, {types}"


@_needs("robot", "data", "calibration", "task")
def _joint_vectors(config: Any) -> Iterator[Finding]:
    types = config.data.joints if config.data and config.data.joints else None
    if types is None and config.robot is not None:
        types = config.robot.joint_types
    vectors: list[tuple[Path, Any, bool]] = [
        (("calibration", "reference"), config.calibration.reference, True),
    ]
    if config.robot is not None and config.robot.screws is not None:
        vectors.append((("robot", "screws", "reference"), config.robot.screws.reference, False))
    if config.task is not None:
        vectors.append((("task", "start"), config.task.start, True))
        vectors.append((("task", "start_offset"), config.task.start_offset, False))
        vectors.append((("task", "goal", "joints"), config.task.goal.joints, False))
    for path, vector, limited in vectors:
        if vector is None or not types:
            continue
        if len(vector.joints) != len(types):
            yield (*path, "joints"), f"{len(vector.joints)} values for {len(types)} joints ({types})"
        elif limited and config.robot is not None and config.robot.joint_types == types:
            yield from _within(path, vector.values(types), config.robot)


def _within(path: Path, values: tuple[float, ...], robot: Any) -> Iterator[Finding]:
    for i, (value, joint) in enumerate(zip(values, robot.joints, strict=True)):
        low, high = joint.limits
        if low <= value <= high or any(_limits((), joint)):  # limits that are wrong themselves limit nothing
            continue
        turn, unit = (math.degrees, "deg") if joint.type == "R" else (float, "m")
        yield (
            (*path, "joints", i),
            f"{turn(value):.6g} {unit} is outside the limits of joint {i + 1}, "
            f"{turn(low):.6g} to {turn(high):.6g} {unit}",
        )


@_needs("task")
def _goal(config: Any) -> Iterator[Finding]:
    if config.task is None:
        return
    goal = config.task.goal
    kinds = [name for name in ("joints", "turn_deg", "images") if getattr(goal, name) is not None]
    if len(kinds) != 1:
        given = f", not {' and '.join(kinds)}" if kinds else ""
        yield ("task", "goal"), f"give exactly one of joints, turn_deg and images{given}"
    if goal.perturbation is not None and goal.turn_deg is None:
        yield ("task", "goal", "perturbation"), "belongs to a goal given by turn_deg"


@_needs("task", "markers")
def _goal_images(config: Any) -> Iterator[Finding]:
    if config.task is None or config.task.goal.images is None:
        return
    path = ("task", "goal", "images")
    if config.markers is None or config.markers.face is None:
        yield path, "needs markers.face, whose markers these pixels are"
        return
    for side in ("left", "right"):
        pixels = getattr(config.task.goal.images, side)
        if len(pixels) != len(config.markers.face):
            yield (
                (*path, side),
                f"{len(pixels)} pixels for the {len(config.markers.face)} markers of the face",
            )


@_needs("disturbance", "plant", "robot", "markers")
def _disturbance(config: Any) -> Iterator[Finding]:
    given = config.disturbance
    wanted = [name for name in ("lost_markers", "bump", "frozen_joint") if getattr(given, name) is not None]
    if config.plant.use is not None and (wanted or given.delay_periods):
        yield ("disturbance",), "disturbs the simulated robot; leave it out where plant.use names another"
    types = config.robot.joint_types if config.robot is not None else None
    for name in ("bump", "frozen_joint"):
        if name in wanted and types and getattr(given, name).joint > len(types):
            yield ("disturbance", name, "joint"), f"the robot has {len(types)} joints, counted from 1"
    if given.bump is not None:
        yield from _bump(given.bump, types)
    known = config.markers.known if config.markers is not None else None
    lost = given.lost_markers.markers if given.lost_markers is not None else None
    for i, number in enumerate(lost or ()):
        if known is not None and number not in known:
            yield (
                ("disturbance", "lost_markers", "markers", i),
                f"there is no marker {number}; markers: {_listed(known)}",
            )


def _bump(bump: Any, types: str | None) -> Iterator[Finding]:
    if (bump.by_deg is None) == (bump.by_m is None):
        yield ("disturbance", "bump"), "give exactly one of by_deg and by_m"
    elif types and bump.joint <= len(types):
        fitting = "by_deg" if types[bump.joint - 1] == "R" else "by_m"
        if getattr(bump, fitting) is None:
            yield (
                ("disturbance", "bump"),
                f"joint {bump.joint} is of type {types[bump.joint - 1]}: give {fitting}",
            )


@_needs("control", "trajectory")
def _plan_to_follow(config: Any) -> Iterator[Finding]:
    control = config.control
    limits = (control.joint_speed_limit_deg_s, control.prismatic_speed_limit_m_s)
    if any(mode != REPLAN for mode in control.mode) and {*limits, config.trajectory.duration_s} == {None}:
        yield (
            ("control", "mode"),
            "follows the plan in time, and nothing gives it one: set trajectory.duration_s, or a limit with "
            "control.joint_speed_limit_deg_s",
        )


@_needs("control")
def _gains(config: Any) -> Iterator[Finding]:
    control = config.control
    for name in ("gain_t", "gain_r", "gain_p", "gain_s", "gain"):
        product = getattr(control, name) * control.period_s
        if product >= 1:
            yield (
                ("control", name),
                f"gain · period_s is {product:.3g}; it must stay below 1 for the loop to be stable "
                f"(below {1 / control.period_s:.3g} 1/s at this period)",
            )


def _law(name: str) -> str:
    target = name if name in LAWS else plugins.target_of("law", name)
    if target is None and ":" in name:
        raise ValueError("must be module:Class, such as my_laws:Law")
    if target is None:
        valid = ", ".join(map(repr, (*LAWS, *plugins.registered("law"))))
        raise PydanticCustomError("literal_error", "is not one of them", {"expected": valid})
    return target


def _plant(name: str) -> str:
    target = plugins.target_of("plant", name)
    if target is None:
        names = ", ".join(plugins.registered("plant"))
        raise ValueError(
            "must be module:Class, such as my_robot:Robot" + (f", or one of {names}" if names else "")
        )
    return target


_TARGET = {"type": "string", "pattern": plugins.TARGET}
# A registered name is stored as the class it stands for, so that a run can be read where it is not installed.
Law = Annotated[str, AfterValidator(_law), WithJsonSchema({"anyOf": [{"enum": list(LAWS)}, _TARGET]})]
PlantClass = Annotated[str, AfterValidator(_plant), WithJsonSchema({"type": "string"})]


class Options(BaseModel):
    """What the class of a plant is made with: any keys, any plain values."""

    model_config = ConfigDict(frozen=True, extra="allow")

    @model_validator(mode="after")
    def _plain(self) -> "Options":
        try:
            json.dumps(self.values(), allow_nan=False)
        except ValueError as error:
            raise ValueError("takes text, finite numbers, true, false, null, lists and mappings") from error
        return self

    def values(self) -> dict[str, Any]:
        """The options by name."""
        return dict(self.model_extra or {})


def written_out(values: dict[str, Any]) -> None:
    """Replace ``plant: module:Class`` and ``law: module:Class`` by the keys they stand for."""
    if isinstance(values.get("plant"), str):
        values["plant"] = {"use": values["plant"]}
    control = values.setdefault("control", {}) if isinstance(values.get("law"), str) else None
    if isinstance(control, dict) and "laws" not in control:
        control["laws"] = [values.pop("law")]


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
        ("svg",), min_length=1, description="files of each figure; the page shows SVG, else PNG"
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
