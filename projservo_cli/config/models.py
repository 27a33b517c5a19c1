"""The configuration as a whole; every key has its unit in its name."""

import inspect
import json
import math
from collections.abc import Callable, Iterator, Mapping
from typing import Annotated, Any, Literal, Self, cast

import numpy as np
from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    StrictBool,
    StrictInt,
    StringConstraints,
    WithJsonSchema,
)
from pydantic_core import PydanticCustomError

from projservo_cli.config.cameras import Cameras
from projservo_cli.config.markers import Markers
from projservo_cli.config.robot import (
    Count,
    Finding,
    JointVector,
    NotNegative,
    Positive,
    Rig,
    RobotSettings,
    Root,
    Section,
    Sizes,
    Whole,
    are_degrees,
)
from projservo_cli.config.task import TaskSettings, Trajectory
from projservo_cli.display import Printed
from projservo_cli.image_size import ImageSize
from projservo_cli.laws import LAW_SPECS, LAWS, REGULATE, mode_in
from projservo_cli.nominal import Number, Vector3
from projservo_cli.records import LIMITS_MISSING, InputError
from projservo_cli.robots import plugins


class LostMarkers(Section):
    """Markers that both cameras lose for some steps."""

    from_step: Whole = Field(description="first step at which the markers are unseen")
    steps: Count | None = Field(None, description="number of steps; null: until the end of the run")
    markers: Annotated[tuple[Whole, ...], Field(min_length=1)] | None = Field(
        None, description="numbers of the markers; null: all markers"
    )


class _JointMoved(Section):
    """A joint that is displaced, or slips on its encoder."""

    at_step: Count = Field(description="step at which the joint moves")
    joint: Count = Field(description="number of the joint, from 1")
    by_deg: Number | None = Field(None, description="angle of a revolute joint")
    by_m: Number | None = Field(None, description="distance of a prismatic joint")
    encoder_slip: StrictBool = Field(
        False, description="whether the link slips on its encoder, so that the reading stays the same"
    )

    def contradictions(self) -> Iterator[Finding]:
        """An angle and a distance, or neither."""
        if (self.by_deg is None) == (self.by_m is None):
            yield (), "give exactly one of by_deg and by_m"


class StuckEncoder(Section):
    """An encoder whose reading stays constant while its joint moves."""

    joint: Count = Field(description="number of the joint, from 1")
    from_step: Whole = Field(description="first step of the constant reading")
    steps: Count | None = Field(None, description="number of steps; null: until the end of the run")


class _CameraMoved(Section):
    """A camera that moves, which shifts its image."""

    at_step: Whole = Field(description="first step at which the image is shifted")
    view: Literal["left", "right"] = Field(description="the camera that moves")
    by_px: Number | tuple[Number, Number] = Field(description="shift of its image along u, or along u and v")

    def by_view(self) -> tuple[tuple[float, float], ...]:
        """Return the shift along u and v, left and right."""
        given = self.by_px if isinstance(self.by_px, tuple) else (self.by_px, 0.0)
        return tuple(given if self.view == view else (0.0, 0.0) for view in ("left", "right"))


class _MarkerMoved(Section):
    """A marker that moves on the tool."""

    at_step: Whole = Field(description="first step at the new position")
    marker: Whole = Field(description="number of the marker")
    by_m: Vector3 = Field(description="displacement in the frame of the tool")


class _Delays(Section):
    """Latency of both cameras, s."""

    left: NotNegative = Field(0.0, description="latency of the left camera")
    right: NotNegative = Field(0.0, description="latency of the right camera")


def _of_both(value: Any) -> Any:
    """One number stands for both cameras."""
    return {"left": value, "right": value} if isinstance(value, int | float) else value


class Disturbance(Section):
    """Faults of the simulated robot and its cameras, permanent ones and events in a run."""

    camera_latency_s: Annotated[
        _Delays, BeforeValidator(_of_both, json_schema_input_type=NotNegative | _Delays)
    ] = Field(
        _Delays(),
        description="time from the middle of an exposure to the joint readings that arrive with its "
        "image, at least half the exposure; a number for both cameras, or {left, right}",
    )
    exposure_s: NotNegative = Field(0.0, description="exposure time, over which an image is averaged")
    jitter_s: NotNegative = Field(
        0.0, description="standard deviation of the exposure times of single images"
    )
    frame_rate_hz: Positive | None = Field(
        None, description="frame rate of free-running cameras; null: each reading triggers an image"
    )
    frame_offset_s: Number = Field(
        0.0, description="delay of the right camera behind the left one, with frame_rate_hz"
    )
    stamps: StrictBool = Field(
        False, description="whether images carry the time of mid-exposure, each camera by its own clock"
    )
    encoder_counts_per_turn: Count | None = Field(
        None,
        description="resolution of the joint readings, counts per turn, or per 1.885 m of a prismatic "
        "joint; null: continuous",
    )
    quantize_setpoints: StrictBool = Field(
        False, description="whether set-points are rounded to encoder counts as well"
    )
    servo_time_constant_s: NotNegative = Field(
        0.0, description="time constant of the first-order lag of the servos"
    )
    gravity_sag_deg: NotNegative = Field(
        0.0, description="steady-state error under gravity at full reach; the encoders read it"
    )
    link_deflection_deg: NotNegative = Field(
        0.0, description="deflection of a link under gravity at full reach; no encoder reads it"
    )
    backlash_deg: NotNegative = Field(
        0.0, description="backlash between each encoder and its link, from end to end"
    )
    lost_markers: LostMarkers | None = None
    joint_moved: _JointMoved | None = None
    stuck_encoder: StuckEncoder | None = None
    camera_moved: _CameraMoved | None = None
    marker_moved: _MarkerMoved | None = None

    def contradictions(self) -> Iterator[Finding]:
        """Yield keys without effect because another is missing."""
        if self.frame_offset_s and self.frame_rate_hz is None:
            yield ("frame_offset_s",), "is that of cameras that run freely: set frame_rate_hz as well"
        if self.quantize_setpoints and self.encoder_counts_per_turn is None:
            yield ("quantize_setpoints",), "takes the ticks of encoders: set encoder_counts_per_turn as well"


def _law(name: str) -> str:
    target = name if name in LAWS else plugins.target_of("law", name)
    if target is None and ":" in name:
        raise ValueError("must be module:Class, such as my_laws:Law")
    if target is None:
        if remedy := mode_in(name):
            raise ValueError(remedy)
        valid = ", ".join(map(repr, (*LAWS, *plugins.registered("law"))))
        raise PydanticCustomError("literal_error", "is not one of them", {"expected": valid})
    return target


RENDERED = "mujoco"
"""The plant that is simulated and rendered by MuJoCo."""


def _plant(name: str) -> str:
    target = name if name == RENDERED else plugins.target_of("plant", name)
    if target is None:
        names = ", ".join((RENDERED, *plugins.registered("plant")))
        raise ValueError(f"must be module:Class, such as my_robot:Robot, or one of {names}")
    return target


_TARGET = {"type": "string", "pattern": plugins.TARGET}


# A registered name is stored as the class it stands for, so that a run can be read where it is not installed.
Law = Annotated[str, AfterValidator(_law), WithJsonSchema({"anyOf": [{"enum": list(LAWS)}, _TARGET]})]
PlantClass = Annotated[str, AfterValidator(_plant), WithJsonSchema({"type": "string"})]


def _plain(value: Any) -> Any:
    try:
        json.dumps(value, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ValueError("takes text, finite numbers, true, false, null, lists and mappings") from error
    return value


Plain = Annotated[Any, AfterValidator(_plain)]


def one_or_more(value: Any) -> Any:
    """Some text stands for a list of it alone."""
    return [value] if isinstance(value, str) else value


_Mode = Literal["regulate", "track", "image_track"]
_Modes = Annotated[tuple[_Mode, ...], Field(min_length=1)]


class _Noise(Section):
    """Standard deviation of simulated pixel noise, per coordinate."""

    calibration_px: NotNegative = Field(0.5, description="pixel noise of the trial motions")
    servo_px: NotNegative = Field(
        0.0, description="pixel noise of the closed loop, and of the images of start and goal"
    )
    averaged_frames: Count = Field(
        1, description="number of images averaged at the start and at the goal, where the robot rests"
    )


class _CalibrationSettings(Section):
    """Trial motions of one joint each around a reference, and the method that evaluates them."""

    method: Literal["bundle_adjustment", "closed_form"] = Field(
        "bundle_adjustment",
        description="bundle_adjustment is maximum likelihood; closed_form has the closed forms of the paper",
    )
    frames_per_joint: StrictInt = Field(
        8, ge=0, le=10_000, description="trial poses of each joint, in addition to the reference"
    )
    amplitude_deg: Number = Field(
        30.0, ge=0, lt=180, description="maximum trial motion to each side, revolute joints"
    )
    amplitude_m: NotNegative = Field(0.15, description="maximum trial motion to each side, prismatic joints")
    reference: JointVector | None = Field(
        None, description="joint readings of the reference pose; null: task.start"
    )
    cross_validate: StrictInt | None = Field(
        None,
        ge=2,
        le=10_000,
        description="number of folds of the poses, each predicted from the others; null: no cross-validation",
    )
    max_predicted_px: Positive | None = Field(
        None,
        description="error of predictions by deviations of arm and rig from the model above which the "
        "calibration is not usable, px; null: 1 % of the image size",
    )
    init: Annotated[str, StringConstraints(min_length=1)] | None = Field(
        None, description="JSON file of a known robot and rig, the first initial guess of the fit"
    )
    random_poses: StrictInt | None = Field(
        None,
        ge=0,
        le=10_000,
        description="trial poses of all joints at once, within the amplitudes, after those of single "
        "joints; null: 12 if readings or images may have faults, 0 for the ideal plant",
    )
    joint_noise_deg: NotNegative | None = Field(
        None,
        description="standard deviation of joint readings (prismatic joints: × 0.3 m/rad); null: "
        "estimated, 0 for the ideal plant",
    )
    seed: Whole | None = Field(
        None, description="seed of the noise of the trial motions; null: seed of the run"
    )
    lens: StrictBool = Field(
        False,
        description="whether to estimate radial distortion: two coefficients a camera, and its centre",
    )

    def contradictions(self) -> Iterator[Finding]:
        """Yield keys of another method."""
        for key in ("cross_validate", "init"):
            if getattr(self, key) is not None and self.method != "bundle_adjustment":
                yield (key,), f"belongs to the method bundle_adjustment, not to {self.method}"


class _Data(Section):
    """A recorded run: the observation table that stands in for simulated trial motions."""

    table: Annotated[str, StringConstraints(min_length=1)] = Field(
        description="path of the table, relative to the configuration"
    )
    joints: Annotated[str, StringConstraints(pattern=r"^[RrPp]+$"), AfterValidator(str.upper)] | None = Field(
        None,
        description="joint types, one letter R or P for each column q1 ... qN; null: those of robot, "
        "else all R",
    )
    joint_unit: Literal["deg", "rad"] | None = Field(
        None,
        description="unit of revolute joints; null: rad, and readings that look like degrees are refused",
    )
    joint_order: Literal["stated"] | None = Field(
        None,
        description="stated: q1 ... qN are known to follow each other from base to tool; null: servo drives "
        "an external robot only if poses show it",
    )
    noise_px: Positive | None = Field(None, description="pixel noise per coordinate; null: estimated")
    image_size_px: Sizes | None = Field(
        None, description="width and height of both images, or those of each; null: those of cameras or rig"
    )


class _Control(Section):
    """Control laws, their modes and gains, and the speed limits of the joints."""

    laws: tuple[Law, ...] = Field(
        tuple(law for law, spec in LAW_SPECS.items() if spec.paper),
        min_length=1,
        description="control laws to run, each from the start; module:Class for a plug-in law",
    )
    mode: Annotated[_Modes, BeforeValidator(one_or_more, json_schema_input_type=_Mode | _Modes)] = Field(
        ("regulate",),
        description="regulate moves to the goal by the present images in each step; track and "
        "image_track follow the plan; a list runs each law in those of the modes that it "
        "has",
    )
    on_plan_failure: Literal["regulate", "refuse"] = Field(
        "regulate",
        description="if no joints follow the plan: regulate runs the law without it, refuse does not "
        "run the law",
    )
    max_replan_attempts: Whole = Field(
        3,
        description="maximum number of replanning attempts of a run, profiles joint_space and auto",
    )
    must_converge: tuple[Law, ...] | None = Field(
        None,
        description="laws that fail the call (exit code 1) if they do not converge; null: "
        "direct_three, direct_two, exact and plug-in laws",
    )
    period_s: Positive = Field(0.04, description="control period")
    gain_t: Positive = Field(2.5, description="gain of the translation, 1/s")
    gain_r: Positive = Field(2.5, description="gain of the rotation onto the plane, 1/s")
    gain_p: Positive = Field(2.5, description="gain of the rotation within the plane, 1/s")
    gain_s: Positive = Field(
        2.5, description="gain of both rotations together, laws direct_two and exact, 1/s"
    )
    ratio_rp: Positive = Field(1.0, description="ratio λ_r/λ_p of both rotations in direct_two")
    gain: Positive = Field(2.5, description="gain of the classical laws, 1/s")
    joint_speed_limit_deg_s: Positive | None = Field(
        125.0, description="speed limit of revolute joints; null: none"
    )
    prismatic_speed_limit_m_s: Positive | None = Field(
        None, description="speed limit of prismatic joints; null: none"
    )
    joint_acceleration_limit_deg_s2: Positive | None = Field(
        None, description="acceleration limit of revolute joints, profile joint_space; null: 500"
    )
    prismatic_acceleration_limit_m_s2: Positive | None = Field(
        None, description="acceleration limit of prismatic joints, profile joint_space; null: 2"
    )
    substeps: Literal["none", "auto"] = Field(
        "auto", description="auto lets the law exact send long steps in parts, none in one"
    )
    features: Literal["points", "body"] | None = Field(
        None,
        description="image features of the direct laws: points of the face, or the body of all "
        "visible markers; null: body if the calibration is usable",
    )

    def contradictions(self) -> Iterator[Finding]:
        """Gains that overshoot."""
        for name in ("gain_t", "gain_r", "gain_p", "gain_s", "gain"):
            product = getattr(self, name) * self.period_s
            if product >= 1:
                yield (
                    (name,),
                    f"gain · period_s is {product:.3g}; it must stay below 1 for the loop to be stable "
                    f"(below {1 / self.period_s:.3g} 1/s at this period)",
                )


class _EachView(Section):
    """A number for each camera."""

    left: Number = Field(description="time offset of the left camera")
    right: Number = Field(description="time offset of the right camera")


class RenderedOptions(Section):
    """Options of the plant mujoco."""

    servo: Literal["own", "position", "velocity"] = Field(
        "own",
        description="actuators: position or velocity servos; own for those of robot.mjcf, else position",
    )
    grey_noise: NotNegative = Field(
        2.0, description="standard deviation of the image noise, grey levels of 255"
    )
    blur_px: NotNegative = Field(0.7, description="standard deviation of the blur of the lens")
    k1: Number = Field(
        0.0, gt=-1, lt=1, description="radial distortion r (1 + k1 r²), r in units of the focal length"
    )
    light: Literal["soft", "side"] = Field(
        "soft", description="soft light from all around, or hard light from one side"
    )


class _PlantSettings(Section):
    """The robot to drive, and the behaviour of a simulated one at its limits.

    ``use`` names the class of an external robot and ``options`` its arguments. The loop never commands an
    external robot beyond its joint limits.
    """

    use: PlantClass | None = Field(
        None,
        description="class of an external robot (module:Class), or mujoco for a simulated arm with "
        "rendered cameras; null for a simulated arm whose points are projected",
    )
    options: dict[str, Plain] = Field({}, description="keyword arguments of the class")
    timeout_s: Positive = Field(1.0, description="maximum time of one answer of the robot")
    open_s: Positive = Field(30.0, description="maximum time to open the robot")
    max_relative_target_deg: Positive | None = Field(
        None,
        description="maximum distance of a set-point from the reading; null: from max_servo_lag_s, "
        "max_steady_state_error_deg and the speed limit",
    )
    max_servo_lag_s: NotNegative = Field(0.15, description="maximum lag of a joint behind its set-point")
    max_steady_state_error_deg: NotNegative = Field(
        1.0,
        description="maximum distance of a joint at rest from its set-point; prismatic joints: 5.24 mm "
        "per degree",
    )
    time_offset_s: Annotated[
        _EachView | None, BeforeValidator(_of_both, json_schema_input_type=Number | _EachView | None)
    ] = Field(
        None,
        description="time from the middle of an exposure to the joint readings that arrive with its "
        "image; a number for both cameras, or {left, right}; null: estimated",
    )
    averaged_frames: StrictInt = Field(
        1, ge=1, le=1000, description="number of images of each pose that record averages"
    )
    settle_s: Positive = Field(
        0.5, description="time for which joints and images rest before a pose is recorded"
    )
    speed_scale: Number = Field(1.0, gt=0, le=1, description="factor of all commanded velocities")
    self_occlusion: Literal["transparent", "opaque"] = Field(
        "transparent",
        description="whether a camera behind the face sees its markers (transparent) or not (opaque)",
    )
    joint_limits: Literal["report", "stop"] = Field(
        "report", description="a joint limit is reported, or stops the run"
    )
    image_border: Literal["report", "stop"] = Field(
        "report", description="a marker outside an image is reported, or stops the run"
    )

    @property
    def simulated(self) -> bool:
        """Whether the robot is a simulated one, whose truth is known."""
        return self.use in (None, RENDERED)

    @property
    def rendered(self) -> RenderedOptions | None:
        """Options of the plant mujoco; None where another one is driven."""
        return RenderedOptions.model_validate(self.options) if self.use == RENDERED else None


class _Stop(Section):
    """Stopping rules of the closed loop."""

    image_error_px: Positive = Field(0.01, description="image error below which a run has converged, rms")
    noise_factor: NotNegative = Field(2.0, description="image_error_px grows by this factor × noise.servo_px")
    max_steps: Count = Field(2000, description="maximum number of commands")
    diverged_factor: Number = Field(
        10.0, gt=1, description="growth of the image error or the distance at which a run has diverged"
    )
    stall_periods: Count = Field(
        20, description="periods in which the error must fall by 1 %, else the run makes no progress"
    )
    max_lost_periods: Whole = Field(
        25, description="periods for which the robot holds while markers are lost"
    )
    innovation_threshold: NotNegative = Field(
        1.0,
        description="fault detection: a fault is an innovation beyond chance and beyond this factor × "
        "the noise; 0: no detection",
    )


class _ReportSettings(Section):
    """Files of the report."""

    formats: tuple[Literal["svg", "pdf", "png"], ...] = Field(
        ("svg",), min_length=1, description="file formats of each figure; the page shows SVG, else PNG"
    )


def _folder_name(name: str) -> str:
    """A name that can be that of a folder; else ValueError."""
    if name != name.strip() or name in {"", ".", ".."} or any(c in '/\\:*?"<>|' or c < " " for c in name):
        raise ValueError("must be usable as the name of a folder: no path separators, no surrounding spaces")
    return name


FolderName = Annotated[str, StringConstraints(max_length=100), AfterValidator(_folder_name)]


def _joint_types(robot: RobotSettings | None, data: _Data | None) -> str:
    """One letter a joint, R or P; empty if only the table has their number."""
    if data is not None and data.joints is not None:
        return data.joints
    return robot.joint_types if robot is not None else ""


def _limits_in_joint_space(
    plant: _PlantSettings, trajectory: Trajectory, robot: RobotSettings | None
) -> Iterator[Finding]:
    bounded = robot is not None and (robot.limits is not None or np.isfinite(robot.ranges).all())
    if trajectory.profile == "joint_space" and not plant.simulated and not bounded:
        yield ("robot",), f"the profile joint_space needs the limits of all joints: {LIMITS_MISSING}"


def _same_joints(robot: RobotSettings | None, data: _Data | None) -> Iterator[Finding]:
    given = _joint_types(robot, data)
    if robot is not None and robot.joints and given != robot.joint_types:
        yield ("data", "joints"), f"{given} are not the joints of the robot, {robot.joint_types}"


def _joint_vectors(
    robot: RobotSettings | None,
    data: _Data | None,
    calibration: _CalibrationSettings,
    task: TaskSettings | None,
) -> Iterator[Finding]:
    """Vectors that are not of the robot's joints, and poses beyond their limits."""
    types = _joint_types(robot, data)
    vectors: dict[tuple[str, ...], JointVector | None] = {("calibration", "reference"): calibration.reference}
    pairs = robot.limits.joints if robot is not None and robot.limits is not None else None
    if types and pairs is not None and len(pairs) != len(types):
        yield ("robot", "limits", "joints"), f"{len(pairs)} pairs for {len(types)} joints ({types})"
    elif pairs is not None and robot is not None and robot.limits is not None and robot.limits.unit == "rad":
        for i, ((low, high), letter) in enumerate(zip(pairs, types or "R" * len(pairs), strict=True)):
            if letter == "R" and are_degrees(low, high):
                what = f"{low:g} to {high:g} rad is more than two turns to a side: degrees? set unit: deg"
                yield ("robot", "limits", "joints", i), what
    if task is not None:
        vectors["task", "start"] = task.start
        vectors["task", "start_offset"] = task.start_offset
        vectors["task", "goal", "joints"] = task.goal.joints
        if task.goal.images is not None:
            vectors["task", "goal", "images", "joints"] = task.goal.images.joints
    for path, vector in vectors.items():
        if vector is not None and types:
            yield from vector.miscounted(types, *path)
            if path[-1] in ("reference", "start") and robot is not None and robot.joint_types == types:
                yield from _beyond_limits(robot, vector, *path)


def _beyond_limits(robot: RobotSettings, vector: JointVector, *path: str) -> Iterator[Finding]:
    values = vector.values(robot.joint_types) if len(vector.joints) == len(robot.joints) else ()
    for i, (value, joint) in enumerate(zip(values, robot.joints, strict=False)):
        low, high = joint.limits
        if not low <= value <= high and not any(joint.contradictions()):
            turn, unit = (math.degrees, "deg") if joint.type == "R" else (float, "m")
            what = f"{turn(value):.6g} {unit} is outside the limits of joint {i + 1}"
            yield (*path, "joints", i), f"{what}, {turn(low):.6g} to {turn(high):.6g} {unit}"


def _goal_images(task: TaskSettings | None, markers: Markers | None) -> Iterator[Finding]:
    if task is None or task.goal.images is None:
        return
    path, images = ("task", "goal", "images"), task.goal.images
    if markers is None or markers.front is None:
        yield path, "needs markers.face, whose markers these pixels are"
        return
    numbers = images.markers or markers.front
    yield from markers.unknown(images.markers or (), *path, "markers")
    if len(set(numbers)) < len(numbers):
        yield (*path, "markers"), "a number stands here twice"
    for key in ("left", "right", "sigma_left_px", "sigma_right_px"):
        given = getattr(images, key)
        if given is not None and len(given) != len(numbers):
            yield (*path, key), f"{len(given)} entries for {len(numbers)} markers"
        elif key in ("left", "right"):
            seen = [number for number, pixel in zip(numbers, given, strict=True) if pixel is not None]
            for number in [number for number in markers.front if number not in seen][:1]:
                yield (*path, key), f"marker {number} of the face is not seen; show the whole face"


def _simulated_alone(disturbance: Disturbance, plant: _PlantSettings) -> Iterator[Finding]:
    if not plant.simulated and disturbance != Disturbance():
        yield ("disturbance",), "disturbs the simulated robot; leave it out where plant.use names another"


def _rendered(
    plant: _PlantSettings, noise: _Noise, markers: Markers | None, rig: Rig | None
) -> Iterator[Finding]:
    """Yield keys without effect for rendered images."""
    if plant.use != RENDERED:
        return
    if rig is not None and np.ndim(rig.image_size_px) > 1:
        yield ("rig", "image_size_px"), "rendered cameras have one size; give one width and height"
    for key in ("calibration_px", "servo_px"):
        if getattr(noise, key) != getattr(_Noise(), key):
            yield (
                ("noise", key),
                "is that of projected points; images of plant mujoco have options.grey_noise",
            )
    if markers is not None and markers.tags is None:
        yield ("markers",), "plant mujoco shows tags: set markers.tags, such as roof"


def _dictionary(plant: _PlantSettings, markers: Markers | None) -> Iterator[Finding]:
    """Yield a dictionary of tags that is given twice."""
    if markers is not None and markers.dictionary is not None and "dictionary" in plant.options:
        yield ("markers", "dictionary"), "plant.options gives the class its dictionary as well; keep one"


def _cameras(plant: _PlantSettings, markers: Markers | None, cameras: Cameras | None) -> Iterator[Finding]:
    """Cameras of nobody, or with nothing to find."""
    if cameras is None:
        return
    if plant.simulated:
        yield (
            ("cameras",),
            "are those of a robot that is not simulated: set plant.use to its class, or leave them out",
        )
    if markers is None or (markers.tags is None and markers.numbers is None):
        yield ("cameras",), "find tags: set markers.tags, or markers.numbers of their corners (4 t + k)"


def _disturbed_joints(disturbance: Disturbance, robot: RobotSettings | None) -> Iterator[Finding]:
    if robot is None or not robot.joints:
        return
    types, moved = robot.joint_types, disturbance.joint_moved
    for name, event in (("joint_moved", moved), ("stuck_encoder", disturbance.stuck_encoder)):
        if event is not None and event.joint > len(types):
            yield ("disturbance", name, "joint"), f"the robot has {len(types)} joints, counted from 1"
    if moved is not None and moved.joint <= len(types) and not any(moved.contradictions()):
        letter = types[moved.joint - 1]
        fitting = "by_deg" if letter == "R" else "by_m"
        if getattr(moved, fitting) is None:
            yield ("disturbance", "joint_moved"), f"joint {moved.joint} is of type {letter}: give {fitting}"


def _disturbed_markers(disturbance: Disturbance, markers: Markers | None) -> Iterator[Finding]:
    lost, moved = disturbance.lost_markers, disturbance.marker_moved
    if lost is not None and lost.markers is not None and markers is not None:
        yield from markers.unknown(lost.markers, "disturbance", "lost_markers", "markers")
    if moved is not None and markers is not None:
        for _, what in markers.unknown((moved.marker,)):
            yield ("disturbance", "marker_moved", "marker"), what


def _plan_to_follow(control: _Control, trajectory: Trajectory) -> Iterator[Finding]:
    limits = (control.joint_speed_limit_deg_s, control.prismatic_speed_limit_m_s)
    if any(mode != REGULATE for mode in control.mode) and {*limits, trajectory.duration_s} == {None}:
        yield (
            ("control", "mode"),
            "follows the plan in time, and nothing gives it one: set trajectory.duration_s, or a limit with "
            "control.joint_speed_limit_deg_s",
        )


def _keeping_out(control: _Control, trajectory: Trajectory) -> Iterator[Finding]:
    if trajectory.keep_out and REGULATE in control.mode:
        yield (
            ("control", "mode"),
            "regulate follows no plan, and only plans keep out of trajectory.keep_out: set track or "
            "image_track",
        )


def _speed_in_joint_space(
    control: _Control, trajectory: Trajectory, robot: RobotSettings | None, data: _Data | None
) -> Iterator[Finding]:
    types = _joint_types(robot, data)
    for letter, key in (("R", "joint_speed_limit_deg_s"), ("P", "prismatic_speed_limit_m_s")):
        if trajectory.profile == "joint_space" and letter in types and getattr(control, key) is None:
            yield ("control", key), "the profile joint_space goes as fast as joints can: give their limit"


_RULES: dict[Callable[..., Iterator[Finding]], set[str]] = {  # with the sections that each takes
    rule: {*inspect.signature(rule).parameters}
    for rule in (
        *(_same_joints, _joint_vectors, _goal_images, _simulated_alone, _rendered),
        *(_dictionary, _cameras, _disturbed_joints, _disturbed_markers, _plan_to_follow, _keeping_out),
        *(_speed_in_joint_space, _limits_in_joint_space),
    )
}


def _missing(sections: Mapping[str, Any]) -> Iterator[Finding]:
    """Yield the missing parts of a simulated run."""
    reason = "is missing; a simulated run needs it"
    for key in ("robot", "rig"):
        if sections.get(key, "broken") is None:
            yield (key,), f"{reason} (a recorded one sets data.table)"
    robot = sections.get("robot")
    if robot is not None and robot.limits is not None and not robot.joints:
        yield ("robot",), "a simulated run needs dh or screws (a recorded one sets data.table)"
    if "markers" in sections and getattr(sections["markers"], "points", None) is None:
        yield ("markers", "positions_m"), f"{reason} (a recorded one sets data.table)"
    calibration = sections.get("calibration")
    if sections.get("task", "broken") is None and calibration and calibration.reference is None:
        yield ("task",), f"{reason}, or calibration.reference"


class Settings(Printed, Root):
    """Values of all sections, and what follows from them."""

    name: FolderName = Field(description="name of the run and of its folder; default: name of the file")
    seed: Whole = Field(0, description="seed of all random numbers; the same seed gives the same run")
    robot: RobotSettings | None = None
    rig: Rig | None = None
    markers: Markers | None = None
    noise: _Noise = _Noise()
    calibration: _CalibrationSettings = _CalibrationSettings()
    data: _Data | None = None
    task: TaskSettings | None = None
    trajectory: Trajectory = Trajectory()
    control: _Control = _Control()
    plant: _PlantSettings = _PlantSettings()
    cameras: Cameras | None = None
    disturbance: Disturbance = Disturbance()
    stop: _Stop = _Stop()
    report: _ReportSettings = _ReportSettings()

    def between(self, sound: Mapping[str, Any]) -> Iterator[Finding]:
        """Yield the missing parts of a simulated run, and contradictions between sections."""
        if sound.get("data", "broken") is None:
            yield from _missing(sound)
        for rule, wanted in _RULES.items():
            if wanted <= sound.keys():
                yield from rule(**{name: sound[name] for name in wanted})

    def summary(self) -> dict[str, str]:
        """Return a summary in words, by name."""
        sections = ("robot", "rig", "markers", "data", "task")
        return {
            "name": self.name,
            "sections": ", ".join(name for name in sections if getattr(self, name) is not None),
            "plant": self.plant.use or "simulated",
            "laws": ", ".join(self.control.laws),
        }

    @property
    def arm(self) -> RobotSettings | None:
        """The robot where its kinematics are given."""
        return self.robot if self.robot is not None and self.robot.joints else None

    @property
    def recorded(self) -> bool:
        """Whether the calibration comes from an observation table."""
        return self.data is not None

    @property
    def joint_types(self) -> str | None:
        """One letter a joint, R or P; None if only the table has their number."""
        return _joint_types(self.robot, self.data) or None

    @property
    def reference(self) -> JointVector | None:
        """Joints around which the trial motions are made."""
        return self.calibration.reference or (self.task.start if self.task is not None else None)

    @property
    def idealized(self) -> Self:
        """Configuration of the simulated robot without noise and faults in the loop."""
        noise = self.noise.model_copy(update={"servo_px": 0.0})
        plant = self.plant.model_copy(update={"use": None, "options": {}})
        return self.model_copy(update={"noise": noise, "plant": plant, "disturbance": Disturbance()})

    @property
    def has_task(self) -> bool:
        """Whether there is a robot that may do a task; its calibration may be reported on without."""
        if self.joint_types is not None and len(self.joint_types) == 1:
            return False  # which reaches no pose
        return not self.recorded or None not in (self.arm, self.rig, self.markers, self.task)

    @property
    def joint_names(self) -> tuple[str | None, ...]:
        """Names of the joints as far as they are given."""
        return tuple(joint.name for joint in self.robot.joints) if self.robot is not None else ()

    @property
    def face_numbers(self) -> tuple[int, ...]:
        """Numbers of the face markers; InputError if they are unknown."""
        if self.markers is None or self.markers.front is None:
            raise InputError(
                "this stage needs to know the face: set markers.face to three marker numbers or more"
            )
        return self.markers.front

    @property
    def image_size_px(self) -> ImageSize | None:
        """Width and height of both images, or those of each, if they are known."""
        if self.data is not None and self.data.image_size_px is not None:
            return cast(ImageSize, self.data.image_size_px)
        if self.cameras is not None:
            left, right = self.cameras.left.size_px, self.cameras.right.size_px
            return None if left is None or right is None else left if left == right else (left, right)
        return cast(ImageSize, self.rig.image_size_px) if self.rig is not None else None
