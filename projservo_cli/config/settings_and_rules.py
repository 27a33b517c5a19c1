"""The configuration as a whole; every key has its unit in its name."""

import inspect
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Annotated, Any, Self, cast

import numpy as np
from pydantic import AfterValidator, Field, StringConstraints

from projservo_cli.image_size import ImageSize
from projservo_cli.laws import IMAGE_TRACK, REGULATE
from projservo_cli.records import LIMITS_MISSING, TOOL, WORLD, InputError, in_unit
from projservo_cli.settings.calibration_and_refits import CalibrationSettings
from projservo_cli.settings.cameras import Cameras
from projservo_cli.settings.control import Control
from projservo_cli.settings.disturbance import Disturbance
from projservo_cli.settings.features import Feature, Name, misplaced
from projservo_cli.settings.markers import Markers
from projservo_cli.settings.noise_and_data import Data, Noise
from projservo_cli.settings.objects import WORLD_AND_TOOL, Objects
from projservo_cli.settings.plant import RENDERED, PlantSettings
from projservo_cli.settings.robot_and_rig import Rig, RobotSettings, like_degrees
from projservo_cli.settings.sections import JointVector, Note, Root, Whole
from projservo_cli.settings.stop_and_report import ReportSettings, Stop
from projservo_cli.settings.task import Goal, GoalImages, TaskSettings, TaskStep, Trajectory, sigma_key
from projservo_cli.simulation.from_settings import described_truth
from projservo_cli.simulation.ground_truth import Truth
from projservo_cli.simulation.random_streams import NORMAL, NoiseShape
from projservo_cli.store.display import Printed


def _folder_name(name: str) -> str:
    """A name that a folder can have; otherwise ValueError."""
    if name != name.strip() or name in {"", ".", ".."} or any(c in '/\\:*?"<>|' or c < " " for c in name):
        raise ValueError("must be usable as the name of a folder: no path separators, no surrounding spaces")
    return name


FolderName = Annotated[str, StringConstraints(max_length=100), AfterValidator(_folder_name)]


_Rule = Callable[..., Iterator[Note]]
_RULES: dict[_Rule, set[str]] = {}  # sections that each rule takes


def _between(rule: _Rule) -> _Rule:
    """Mark a rule between sections: those that its arguments name, asked if all of them are sound."""
    _RULES[rule] = {*inspect.signature(rule).parameters}
    return rule


def _joint_types(robot: RobotSettings | None, data: Data | None) -> str:
    """One letter a joint, R or P; empty if only the table has their number."""
    if data is not None and data.joints is not None:
        return data.joints
    return robot.joint_types if robot is not None else ""


@_between
def _limits_in_joint_space(
    plant: PlantSettings, trajectory: Trajectory, robot: RobotSettings | None
) -> Iterator[Note]:
    bounded = robot is not None and (robot.limits is not None or np.isfinite(robot.ranges).all())
    if trajectory.profile == "joint_space" and not plant.simulated and not bounded:
        yield ("robot",), f"the profile joint_space needs the limits of all joints: {LIMITS_MISSING}"


@_between
def _same_joints(robot: RobotSettings | None, data: Data | None) -> Iterator[Note]:
    given = _joint_types(robot, data)
    if robot is not None and robot.joints and given != robot.joint_types:
        yield ("data", "joints"), f"{given} are not the joints of the robot, {robot.joint_types}"


@_between
def _joint_vectors(
    robot: RobotSettings | None,
    data: Data | None,
    calibration: CalibrationSettings,
    task: TaskSettings | None,
) -> Iterator[Note]:
    """Vectors that are not of the robot's joints, and poses beyond their limits."""
    types = _joint_types(robot, data)
    vectors: dict[tuple[str, ...], JointVector | None] = {("calibration", "reference"): calibration.reference}
    pairs = robot.limits.joints if robot is not None and robot.limits is not None else None
    if types and pairs is not None and len(pairs) != len(types):
        yield ("robot", "limits", "joints"), f"{len(pairs)} pairs for {len(types)} joints ({types})"
    elif pairs is not None and robot is not None and robot.limits is not None and robot.limits.unit == "rad":
        for i, ((low, high), letter) in enumerate(zip(pairs, types or "R" * len(pairs), strict=True)):
            if letter == "R" and (what := like_degrees(low, high)):
                yield ("robot", "limits", "joints", i), f"{what} set unit: deg"
    if task is not None:
        vectors["task", "start"] = task.start_joints
        vectors["task", "start_offset"] = task.start_offset
        for path, goal in task.each_goal.items():
            vectors[("task", *path, "joints")] = goal.joints
            if goal.images is not None:
                vectors[("task", *path, "images", "joints")] = goal.images.joints
    for place, vector in vectors.items():
        if vector is not None and types:
            yield from vector.miscounted(types, *place)
            if place[-1] in ("reference", "start") and robot is not None and robot.joint_types == types:
                yield from _beyond_limits(robot, vector, *place)


def _beyond_limits(robot: RobotSettings, vector: JointVector, *path: str) -> Iterator[Note]:
    values = vector.values(robot.joint_types).tolist() if len(vector.joints) == len(robot.joints) else ()
    for i, (value, joint) in enumerate(zip(values, robot.joints, strict=False)):
        low, high = joint.limits
        if not low <= value <= high and not any(joint.contradictions()):
            unit = vector.unit if joint.type == "R" else "m"
            at, least, most = (in_unit(x, unit) for x in (value, low, high))
            yield (*path, "joints", i), f"{at} is outside the limits of joint {i + 1}, {least} to {most}"


@_between
def _goal_images(
    task: TaskSettings | None, markers: Markers | None, trajectory: Trajectory
) -> Iterator[Note]:
    for path, goal in ({} if task is None else task.each_goal).items():
        if goal.images is not None:
            yield from _images_of(("task", *path, "images"), goal.images, markers, trajectory)


def _images_of(
    path: tuple[str, ...], images: GoalImages, markers: Markers | None, trajectory: Trajectory
) -> Iterator[Note]:
    if markers is None or markers.front is None:
        yield path, "needs markers.face, whose markers these pixels are"
        return
    numbers = images.markers or markers.front
    yield from markers.unknown(images.markers or (), *path, "markers")
    counts = Counter[int]()  # number of cameras that see each marker
    for key in (*images.view, *map(sigma_key, images.view)):
        given = images.side(key)
        if given is not None and len(given) != len(numbers):
            yield (*path, key), f"{len(given)} entries for {len(numbers)} markers"
        elif key in images.view:
            counts.update(number for number, at in zip(numbers, given or (), strict=True) if at is not None)
    enough = trajectory.min_views or len(images.view)
    for key in images.view:
        pixels = dict(zip(numbers, images.side(key) or (), strict=False))
        whole = len(pixels) == len(numbers) == len(images.side(key) or ())
        for number in [k for k in markers.front if whole and counts[k] < enough and pixels[k] is None][:1]:
            yield (*path, key), f"marker {number} of the face is not seen; show the whole face"


@_between
def _incidences(
    features: Mapping[str, Feature], task: TaskSettings | None, markers: Markers | None, control: Control
) -> Iterator[Note]:
    for name, feature in features.items():
        source = None if any(feature.contradictions()) else feature.source
        if isinstance(source, tuple) and markers is not None and feature.on == "tool":
            yield from markers.unknown(source, "features", name, feature.kind)
        elif isinstance(source, str):
            of = features.get(source)
            if of is None or of.on != "tool" or of.given(feature.kind) == []:
                yield ("features", name, feature.kind), f"there is no {feature.kind} {source} of the tool"
    goals, measured = {} if task is None else task.each_goal, False
    for path, goal in goals.items():
        measured |= bool(goal.incidences) or goal.displaced is not None
        for i, pair in enumerate(goal.incidences):
            if what := misplaced(pair, features):
                yield ("task", *path, "incidences", i), what
        if goal.displaced is not None and (what := goal.displaced.misplaced(features)):
            yield ("task", *path, "displaced", "along"), what
    for k, step in enumerate(() if task is None else task.steps):
        along = step.approach or step.retreat
        measured |= along is not None
        if along is not None and (what := along.misplaced(features)):
            yield ("task", "steps", k, step.kind, "along"), what
    if measured and control.features == "points":
        yield ("control", "features"), "incidences are measured with the body: leave points out"


@_between
def _objects(
    objects: Objects, markers: Markers | None, rig: Rig | None, data: Data | None, plant: PlantSettings
) -> Iterator[Note]:
    """Objects before cameras on the tool, with markers of the tool, or nowhere in a simulation."""
    if objects.named and TOOL in (rig and rig.mount, data and data.mount):
        yield ("objects",), "cameras on the tool see the scene that the goal is on: its images carry the goal"
    for name, one in objects.named.items():
        for number in (n for n in one.numbers if markers is not None and n in markers.known):
            yield (
                ("objects", name),
                f"marker {number} is on the tool: each marker belongs to one object or the tool",
            )
            break
        if plant.use == RENDERED and not one.placed:
            yield ("objects", name), "plant mujoco shows tags: give number, size_m and pose of each"
        elif plant.simulated and data is None and not one.is_placed:
            yield ("objects", name), "is nowhere: give size_m and pose of its tags, or positions_m"


def carriers_of(goal: Goal, features: Mapping[str, Feature]) -> tuple[str, ...]:
    """Names of the objects that a goal was taught on; none for a fixed goal, or a retreat."""
    if goal.of_start:
        return ()
    if goal.on is not None:
        return (goal.on,)
    on = (features[pair[1]].on for pair in goal.incidences if pair[1] in features)
    return tuple(name for name in dict.fromkeys(on) if name not in WORLD_AND_TOOL)


@_between
def _carried(
    objects: Objects, features: Mapping[str, Feature], task: TaskSettings | None, plant: PlantSettings
) -> Iterator[Note]:
    """Unknown objects, a goal that would be torn, and a goal whose object was not seen."""
    known = f"objects: {', '.join(objects.named) or 'none'}"
    for name, feature in features.items():
        if feature.on not in (*WORLD_AND_TOOL, *objects.named):
            yield ("features", name, "on"), f"there is no object {feature.on}; {known}"
        elif feature.on in objects.named and not isinstance(feature.source, str):
            numbers = objects.named[feature.on].numbers
            others = [number for point in feature.flat(features) for number in point if number not in numbers]
            if others:
                yield (
                    ("features", name, feature.kind),
                    f"marker {others[0]} is not of {feature.on}: name some of its own, "
                    f"{', '.join(map(str, numbers))}, or a feature of the tool that was there when taught",
                )
    for path, goal in ({} if task is None else task.each_goal).items():
        for carrier in carriers_of(goal, features):
            if carrier in objects.named:
                numbers = objects.named[carrier].numbers
                yield from _carried_by(carrier, numbers, ("task", *path), goal, features, plant)
            elif goal.on is not None:
                yield ("task", *path, "on"), f"there is no object {carrier}; {known}"


def followed_carriers(
    objects: Objects, features: Mapping[str, Feature], task: TaskSettings | None
) -> list[tuple[str, ...]]:
    """Objects that carry each goal of which one is followed."""
    followed = {name for name, one in objects.named.items() if one.follow}
    carriers = [carriers_of(goal, features) for goal in ({} if task is None else task.each_goal).values()]
    return [names for names in carriers if followed & {*names}]


@_between
def _followed(
    objects: Objects,
    features: Mapping[str, Feature],
    task: TaskSettings | None,
    control: Control,
    stop: Stop,
) -> Iterator[Note]:
    """Goals that cannot be followed, and laws that cannot be led to them by one time."""
    for names in followed_carriers(objects, features, task):
        if len(names) > 1:
            what = f"a goal that is followed is on one object, and this one on {' and '.join(names)}"
            yield ("task",), what
        if IMAGE_TRACK in control.mode:
            what = "planned images are of the goal where it was: a goal is followed by regulate and track"
            yield ("control", "mode"), what
        gains = {name: getattr(control, name) for name in ("gain_t", "gain_r", "gain_p", "gain_s", "gain")}
        if len({*gains.values()}) > 1:
            unlike = ", ".join(f"{name} {value:g}" for name, value in gains.items())
            what = f"a goal that is followed is led by 1/gain: make the gains the same, and not {unlike}"
            yield ("control",), what
        if stop.follow_s > (longest := stop.max_steps * control.period_s):
            what = f"is longer than a run, stop.max_steps × control.period_s: {longest:g} s"
            yield ("stop", "follow_s"), what
        return


def _carried_by(
    carrier: str,
    numbers: Sequence[int],
    path: tuple[str, ...],
    goal: Goal,
    features: Mapping[str, Feature],
    plant: PlantSettings,
) -> Iterator[Note]:
    """Features that are not on the object that a goal at a path names, and images without one."""
    for i, pair in enumerate(goal.incidences if goal.on is not None else ()):
        if pair[1] in features and (on := features[pair[1]].on) != carrier:
            yield (
                (*path, "incidences", i),
                f"{pair[1]} is on {on}, and the goal on {carrier}: put {pair[1]} on {carrier}, or leave on "
                "out, for features on others as well",
            )
    carried = goal.objects.of(carrier)
    if carried is None and (goal.images is not None or not plant.simulated):
        yield path, f"does not show where {carrier} was: teach it again, projservo teach"
    elif carried is not None and {*(carried.markers or ())} - {*numbers}:
        yield (*path, "objects", carrier), f"has markers that are not of {carrier}: teach it again"


@_between
def _simulated_alone(disturbance: Disturbance, plant: PlantSettings) -> Iterator[Note]:
    if not plant.simulated and disturbance != Disturbance():
        yield ("disturbance",), "disturbs the simulated robot; leave it out where plant.use names another"


@_between
def _force(plant: PlantSettings, stop: Stop) -> Iterator[Note]:
    if plant.use is None and stop.max_force_n is not None:
        yield (
            ("stop", "max_force_n"),
            "nothing touches points that are projected: set plant.use, or leave it out",
        )


@_between
def _rendered(plant: PlantSettings, noise: Noise, markers: Markers | None, rig: Rig | None) -> Iterator[Note]:
    """Yield keys without effect for rendered images."""
    if plant.use != RENDERED:
        return
    if rig is not None and np.ndim(rig.image_size_px) > 1:
        yield ("rig", "image_size_px"), "rendered cameras have one size; give one width and height"
    for key in ("calibration_px", "servo_px"):
        if getattr(noise, key) != getattr(Noise(), key):
            yield (
                ("noise", key),
                "applies to projected points; images of plant mujoco have options.grey_noise",
            )
    if markers is not None and markers.tags is None:
        yield ("markers",), "plant mujoco shows tags: set markers.tags, such as roof"


@_between
def _dictionary(plant: PlantSettings, markers: Markers | None) -> Iterator[Note]:
    """Yield a dictionary of tags that is given twice."""
    if markers is not None and markers.dictionary is not None and "dictionary" in plant.options:
        yield ("markers", "dictionary"), "plant.options gives the class its dictionary as well; keep one"


@_between
def _cameras(plant: PlantSettings, markers: Markers | None, cameras: Cameras | None) -> Iterator[Note]:
    """Cameras without a robot, or without markers."""
    if cameras is None:
        return
    if plant.simulated:
        yield (
            ("cameras",),
            "belong to a robot that is not simulated: set plant.use to its class, or leave them out",
        )
    if markers is None or not markers.given("tags", "numbers", "board"):
        yield (
            ("cameras",),
            "find tags: set markers.tags, markers.numbers of their corners (4 t + k), or markers.board",
        )


@_between
def _same_mount(rig: Rig | None, data: Data | None) -> Iterator[Note]:
    """Yield a mount that rig and table state otherwise."""
    if rig is not None and data is not None and data.mount not in (None, rig.mount):
        yield ("data", "mount"), f"is {data.mount} where rig.mount is {rig.mount}: keep one"


@_between
def _moving_images(rig: Rig | None, trajectory: Trajectory) -> Iterator[Note]:
    """Yield regions of images that move with the tool."""
    if rig is not None and rig.mount == TOOL and trajectory.keep_out:
        yield ("trajectory", "keep_out"), "are regions of fixed images; cameras on the tool move"


@_between
def _disturbed_joints(disturbance: Disturbance, robot: RobotSettings | None) -> Iterator[Note]:
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


@_between
def _disturbed_markers(disturbance: Disturbance, markers: Markers | None) -> Iterator[Note]:
    lost, moved = disturbance.lost_markers, disturbance.marker_moved
    if lost is not None and lost.markers is not None and markers is not None:
        yield from markers.unknown(lost.markers, "disturbance", "lost_markers", "markers")
    if moved is not None and markers is not None:
        for _, what in markers.unknown((moved.marker,)):
            yield ("disturbance", "marker_moved", "marker"), what


@_between
def _disturbed_objects(disturbance: Disturbance, objects: Objects, plant: PlantSettings) -> Iterator[Note]:
    moved = disturbance.object_moved
    if moved is None:
        return
    placed = [name for name, one in objects.named.items() if one.is_placed]
    if moved.name not in placed:
        known = ", ".join(placed) or "none"
        what = f"there is no object {moved.name} with places under objects; objects: {known}"
        yield ("disturbance", "object_moved", "name"), what
    elif plant.use == RENDERED:
        yield ("disturbance", "object_moved"), "moves no object before rendered cameras; leave plant.use out"


@_between
def _followed_plan(control: Control, trajectory: Trajectory) -> Iterator[Note]:
    """Yield modes that follow a plan without a time, or no plan if one has to keep out of regions."""
    limits = (control.joint_speed_limit_deg_s, control.prismatic_speed_limit_m_s)
    if any(mode != REGULATE for mode in control.mode) and {*limits, trajectory.duration_s} == {None}:
        yield (
            ("control", "mode"),
            "follows the plan in time, and nothing gives it one: set trajectory.duration_s, or a limit with "
            "control.joint_speed_limit_deg_s",
        )
    if trajectory.keep_out and REGULATE in control.mode:
        yield (
            ("control", "mode"),
            "regulate follows no plan, and only plans keep out of trajectory.keep_out: set track or "
            "image_track",
        )


@_between
def _speed_in_joint_space(
    control: Control, trajectory: Trajectory, robot: RobotSettings | None, data: Data | None
) -> Iterator[Note]:
    types = _joint_types(robot, data)
    for letter, key in (("R", "joint_speed_limit_deg_s"), ("P", "prismatic_speed_limit_m_s")):
        if trajectory.profile == "joint_space" and letter in types and getattr(control, key) is None:
            yield ("control", key), "the profile joint_space goes as fast as joints can: give their limit"


def _missing(sections: Mapping[str, Any]) -> Iterator[Note]:
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
    """Values of all sections, and values derived from them."""

    name: FolderName = Field(description="name of the run and of its folder; default: name of the file")
    seed: Whole = Field(0, description="seed of all random numbers; the same seed gives the same run")
    robot: RobotSettings | None = None
    rig: Rig | None = None
    markers: Markers | None = None
    noise: Noise = Noise()
    calibration: CalibrationSettings = CalibrationSettings()
    data: Data | None = None
    features: dict[Name, Feature] = Field({}, description="points, lines and planes, by their names")
    objects: Objects = Objects()
    task: TaskSettings | None = None
    trajectory: Trajectory = Trajectory()
    control: Control = Control()
    plant: PlantSettings = PlantSettings()
    cameras: Cameras | None = None
    disturbance: Disturbance = Disturbance()
    stop: Stop = Stop()
    report: ReportSettings = ReportSettings()

    def between(self, sound: Mapping[str, Any]) -> Iterator[Note]:
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
    def followed(self) -> tuple[str, ...]:
        """Names of the objects that carry the first goal which is followed; none without one."""
        return next(iter(followed_carriers(self.objects, self.features, self.task)), ())

    @property
    def arm(self) -> RobotSettings | None:
        """The robot if its kinematics are given."""
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
        return self.calibration.reference or (self.task.start_joints if self.task is not None else None)

    @property
    def steps(self) -> dict[str, TaskStep]:
        """Steps of the task by their names; none if it is a single motion."""
        return {} if self.task is None else self.task.named_steps

    def at_step(self, name: str) -> Self:
        """Return the configuration of one step of the task; of no name, this one."""
        assert self.task is not None or not name
        if not name or self.task is None:
            return self
        seconds, trajectory = self.steps[name].duration_s, self.trajectory
        if seconds is not None:
            trajectory = trajectory.model_copy(update={"duration_s": seconds})
        return self.model_copy(update={"task": self.task.at_step(name), "trajectory": trajectory})

    @property
    def idealized(self) -> Self:
        """Configuration of the simulated robot without noise and faults in the loop."""
        noise = self.noise.model_copy(update={"servo_px": 0.0})
        plant = self.plant.model_copy(update={"use": None, "options": {}})
        return self.model_copy(update={"noise": noise, "plant": plant, "disturbance": Disturbance()})

    @property
    def mount(self) -> str:
        """Mount of the cameras: world, or tool."""
        stated = None if self.data is None else self.data.mount
        return stated or (WORLD if self.rig is None else self.rig.mount)

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
        """Width and height of both images, or of each, if they are known."""
        if self.data is not None and self.data.image_size_px is not None:
            return cast(ImageSize, self.data.image_size_px)
        if self.cameras is not None:
            sizes = [one.size_px for one in self.cameras.sources.values()]
            known = tuple(size for size in sizes if size is not None)
            return None if len(known) < len(sizes) else known[0] if len({*known}) == 1 else known
        return cast(ImageSize, self.rig.image_size_px) if self.rig is not None else None


def truth_of(config: Settings, *, face: bool = True) -> Truth:
    """Robot, rig and markers as they are; an InputError if a part of it is missing.

    The same values give the same object, so that derived results are kept.
    face : whether it has the face, of which a calibration knows nothing.
    """
    if config.arm is None:
        raise InputError("this stage drives a simulated robot: set robot.dh or robot.screws")
    if config.rig is None:
        raise InputError("this stage needs a simulated rig: set rig.left, rig.right and rig.image_size_px")
    if config.markers is None or config.markers.points is None:
        raise InputError("this stage needs the markers of the simulated robot: set markers.positions_m")
    rendered, n = config.plant.rendered, config.noise
    if rendered is not None and any(any(camera.lens) for camera in config.rig.cameras.values()):
        raise InputError(
            "rig: lens applies to cameras that see points: for rendered ones set plant.options.k1"
        )
    factor = n.outlier_factor if n.outlier_share else NORMAL.outlier_factor
    noise = NoiseShape(math.inf if n.tail_dof is None else n.tail_dof, n.outlier_share, factor)
    markers = config.markers if face else config.markers.model_copy(update={"center": "midpoint"})
    return described_truth(
        config.arm, config.rig, markers, noise, face, 0.0 if rendered is None else rendered.k1
    )
