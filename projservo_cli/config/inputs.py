"""From a configuration to the inputs of each stage: the values that it reads, and no others.

Every function returns a record, of which the key of the result is a hash. Units, defaults that depend on
other values, and descriptions of robot and rig are resolved here and nowhere below.
"""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from projservo_cli.config.loading import Config, stored_yaml
from projservo_cli.config.settings_and_rules import carriers_of, truth_of
from projservo_cli.records import ANGLE, MEET, MM, PARALLEL, PERPENDICULAR, TOOL, FloatArray, InputError
from projservo_cli.result_hashes import File
from projservo_cli.settings.control import LawSettings, SpeedLimits
from projservo_cli.settings.disturbance import Disturbance, EachView, Events, Faults
from projservo_cli.settings.features import Feature, Pair
from projservo_cli.settings.markers import Markers
from projservo_cli.settings.noise_and_data import LoopNoise
from projservo_cli.settings.objects import ObjectSettings
from projservo_cli.settings.plant import Rest, RunConditions, ServoLimits
from projservo_cli.settings.task import Goal as GoalSettings
from projservo_cli.simulation.from_settings import (
    arm_of,
    cameras_of,
    center_in_face,
    described_scene,
    scene_object,
)
from projservo_cli.simulation.ground_truth import SceneObject, Truth
from projservo_cli.simulation.mjcf import files_named
from projservo_cli.simulation.rendering import RenderedScene
from projservo_cli.simulation.robot_with_faults import SimulatedRobot
from projservo_cli.stages.stage_inputs import (
    CalibrationInputs,
    CarryingObject,
    Contract,
    Described,
    Drive,
    Estimation,
    Following,
    JointSettings,
    KnownLengths,
    Motions,
    OwnRobot,
    PlanInputs,
    PreflightInputs,
    RecordingInputs,
    RefitInputs,
    ReportInputs,
    Scenery,
    ServoInputs,
    SuggestionInputs,
    Table,
    TeachInputs,
    ToolMarkers,
    Trials,
)
from projservo_cli.store.display import About
from projservo_cli.store.observation_tables import identity_in
from projservo_cli.task.incidences import Incidence
from projservo_cli.task.stand_off import StandOff

_RANDOM_POSES = 12  # number in trials whose joints or images may have faults
_NO_LATENCY = EachView(left=0.0, right=0.0, others=0.0)  # of the ideal plant
_TICKS = 4096  # counts per turn of the coarsest encoders
_EXPECTED = {
    "table": "a table, which projservo record calibrate makes",
    "readings": "a table of joints: pose, q1 ... qN",
    "init": "JSON with screws, cameras and markers",
    "mjcf": "a model of MuJoCo",
}
Files = Mapping[str, File]  # by their roles; read from disk if not given


def calibration_inputs(config: Config, files: Files | None = None) -> CalibrationInputs | RefitInputs:
    """Return the inputs of a calibration: a table, or trials of the simulated robot; then its refits."""
    settings, data, size = config.calibration, config.data, config.image_size_px
    source: Table | Trials
    if data is not None:
        table, readings = _file("table", data.table, files), _file_if("readings", data.readings, files)
        kind, stated = (config.joint_types, data.joint_unit), data.joint_order == "stated"
        mount = data.mount or (None if config.rig is None else config.rig.mount)
        source = Table(
            table, readings, *kind, size, data.noise_px, _seed(config), mount, stated, _flange_chart(config)
        )
    else:
        # A factor of commands to a robot that may do harm; simulated trials do not depend on it.
        at_full_speed = {"plant": config.plant.model_copy(update={"speed_scale": 1.0})}
        source = _trials(config.model_copy(update=at_full_speed), truth_of(config, face=False), files)
    how = Estimation(
        settings.lens,
        _file_if("init", settings.init, files),
        settings.cross_validate,
        settings.max_predicted_px,
        settings.joint_model,
        config.markers.stated_boards if config.markers is not None else (),
        tuple(
            (name, _file(f"camera {name}", file, files)) for name, file in (settings.intrinsics or {}).items()
        ),
        settings.focal_std_fraction,
        settings.center_std_fraction,
    )
    inputs: CalibrationInputs | RefitInputs = CalibrationInputs(source, how, settings.joint_noise)
    for i, one in enumerate(settings.refits):
        inputs = RefitInputs(
            before=inputs,
            view=one.view,
            file=_file(f"refit {i}", one.table, files),
            readings=_file_if(f"refit readings {i}", one.readings, files),
            joint_unit=one.joint_unit or (None if data is None else data.joint_unit),
            image_size=size,
            max_predicted_px=settings.max_predicted_px,
        )
    return inputs


def recording_inputs(config: Config) -> RecordingInputs:
    """Return the inputs of a recording."""
    markers, plant = _markers(config), config.plant
    truth = truth_of(config, face=False) if plant.simulated else None
    numbers = _numbers(config, "record")
    # A robot that a caller brings along takes the place of the ideal plant too.
    trials = replace(_trials(config, truth), rest=plant.part(Rest))
    return RecordingInputs(
        trials=trials,
        numbers=numbers,
        face=markers.front or (),
        dictionary=_dictionary(config),
        tagged=(config.cameras is not None and markers.board is None)
        or (markers.tags, markers.tag_size_m, markers.dictionary) != (None, None, None),
        mount=config.mount,
        max_steady_state_error_deg=plant.max_steady_state_error_deg,
    )


def teach_inputs(config: Config) -> TeachInputs:
    """Return the inputs of teaching a pose."""
    numbers = _numbers(config, "teach")
    _require_one_numbering(config, "teach")
    driven = _drive(config, truth_of(config) if config.plant.simulated else None, shows=True)
    noise, settle_s = config.noise.servo_px, config.plant.settle_s
    return TeachInputs(driven, joints_of(config), numbers, noise, settle_s, config.seed, config.objects)


def preflight_inputs(config: Config) -> PreflightInputs:
    """Return the inputs of a preflight. Raises InputError for a simulated robot."""
    if config.plant.simulated:
        raise InputError(
            "doctor -c checks a robot and its cameras, and this one is simulated: set plant.use and cameras"
        )
    return PreflightInputs(
        driven=_drive(config, None),
        joints=joints_of(config),
        numbers=_numbers(config, "doctor"),
        markers=_markers(config),
        dictionary=_dictionary(config),
        mount=config.mount,
        noise_px=(config.stop.innovation_threshold or 1.0) * config.noise.servo_px,
    )


def _markers(config: Config) -> Markers:
    """Return the markers as far as they are given."""
    return config.markers or Markers()


def _numbers(config: Config, command: str) -> tuple[int, ...]:
    """Numbers of the markers that a robot observes. Raises InputError if they are unknown."""
    if not (numbers := _markers(config).known):
        raise InputError(f"{command} needs to know which markers the robot observes: set markers.numbers")
    return numbers


def _dictionary(config: Config) -> str | None:
    """Dictionary of the tags: from the options of a robot's class, otherwise from the markers."""
    given = config.plant.options.get("dictionary", _markers(config).tag_dictionary)
    return None if given is None else str(given)


def _require_one_numbering(config: Config, command: str) -> None:
    """Refuse a board on the tool of which an image may number the corners from another end than the goal."""
    board = _markers(config).pattern
    if board is not None and board.symmetric and config.cameras is not None and not config.plant.simulated:
        raise InputError(
            f"markers.board: a {board} looks the same turned by 180°, so that images of {command} may number "
            "its corners from either end: take one with an odd and an even side, or charuco (record and "
            "calibrate turn its numbering right)"
        )


def suggestion_inputs(config: Config) -> SuggestionInputs:
    """Return the inputs of a suggestion of further poses."""
    unit = config.data.joint_unit if config.data is not None else None
    joints, size = joints_of(config), config.image_size_px
    return SuggestionInputs(joints, size, config.recorded, unit or "rad", config.seed)


def plan_inputs(config: Config, files: Files | None = None, *, predicted: bool = False) -> PlanInputs:
    """Return the inputs of a plan.

    predicted : whether a calibration predicts start and goal of a simulated robot, which is not described.
    """
    face, markers = config.face_numbers, _markers(config)
    simulated = config.plant.simulated and not predicted
    pairs, carriers = () if config.task is None else config.task.goal.incidences, _carriers(config, files)
    names = [one.name for one in carriers]
    displaced = _displacement(config)
    return PlanInputs(
        task=config.task,
        seed=config.seed,
        described=Described(
            truth_of(config) if simulated else None,
            None if config.arm is None else arm_of(config.arm),
            None if config.rig is None else cameras_of(config.rig),
            config.mount,
            scene_of(config, files, config.objects.named) if simulated else None,
        ),
        markers=ToolMarkers(
            face,
            center_in_face(markers),
            markers.known or None,
            tuple(tag.numbers for tag in markers.all_tags),
        ),
        joints=joints_of(config),
        image_size=config.image_size_px,
        noise=config.noise.part(LoopNoise),
        features=config.control.features,
        tests_images=config.stop.innovation_threshold > 0.0,
        trajectory=config.trajectory,
        lengths=markers.lengths(face),
        incidences=tuple(_incidence(pair, config.features, displaced, names) for pair in pairs),
        carriers=carriers,
        displaced=displaced,
    )


def _incidence(
    pair: Pair, features: Mapping[str, Feature], displaced: StandOff | None, carriers: Sequence[str]
) -> Incidence:
    """Return a pair of features, as messages and figures write it, with the numbers of its markers.

    displaced : whether the goal is displaced, so that an approach is not taken for the arrival.
    carriers : names of the objects of the goal.
    """
    back = "" if displaced is None else f" ({displaced.words})"
    relation = pair[2] if len(pair) == 3 else MEET
    tool, scene = (features[name].flat(features) for name in pair[:2])
    on = features[pair[1]].on
    carrier = carriers.index(on) + 1 if on in carriers else 0
    if not isinstance(relation, str):
        name = f"{pair[0]} at {relation:g}° to {pair[1]}{back}"
        return Incidence(name, tool, scene, ANGLE, float(relation), carrier)
    between = {MEET: "on", PARALLEL: "parallel to", PERPENDICULAR: "perpendicular to"}[relation]
    name = f"{pair[0]} {between} {pair[1]}{back}"
    return Incidence(name, tool, scene, relation, carrier=carrier)


def _displacement(config: Config) -> StandOff | None:
    """Return the displacement of the goal, with the numbers of its markers; None without."""
    along = None if config.task is None else config.task.goal.displaced
    if config.task is None or along is None:
        return None
    scenes = {pair[1]: config.features[pair[1]] for pair in config.task.goal.incidences}
    for name, one in scenes.items():
        if not isinstance(one.source, str):
            raise InputError(
                f"task.goal.displaced: {name} is of markers of {one.on}, which are not displaced: teach the "
                "approach as a separate goal"
            )
    on = {one.on for one in scenes.values()}
    if len(on) > 1:
        raise InputError(
            f"task.goal.displaced: the incidences of the goal are on {' and '.join(sorted(on))}, so teach "
            "the approach as a separate goal"
        )
    if config.mount == TOOL:
        raise InputError(
            "task.goal.displaced: goals of cameras on the tool are not displaced: teach the other goal"
        )
    flat, of_start = config.features[along.along].flat(config.features), config.task.goal.of_start
    return StandOff(along.along, flat, along.by_m, along.by_px, of_start)


def servo_inputs(config: Config, files: Files | None = None) -> ServoInputs:
    """Return the inputs of the run of a law."""
    plan, conditions = plan_inputs(config, files), config.plant.part(RunConditions)
    _require_one_numbering(config, "servo")
    if not config.plant.simulated:  # such a robot is never driven beyond a limit
        conditions = conditions.model_copy(update={"joint_limits": "stop"})
    return ServoInputs(
        plan=plan,
        laws=config.control.part(LawSettings),
        stop=config.stop,
        conditions=conditions,
        contract=_contract(config, plan, files),
    )


def _carriers(config: Config, files: Files | None) -> tuple[CarryingObject, ...]:
    """Return the objects that the goal is carried by; none for a fixed goal."""
    if config.task is None:
        return ()
    names = carriers_of(config.task.goal, config.features)
    return tuple(_carrier(config, files, name, config.task.goal) for name in names)


def _carrier(config: Config, files: Files | None, name: str, goal: GoalSettings) -> CarryingObject:
    """Return an object that a goal is carried by."""
    rendered, simulated = config.plant.rendered is not None, config.plant.simulated
    return CarryingObject(
        name=name,
        objects=config.objects,
        taught=goal.objects.of(name),
        placed=next((one for one in objects_of(config) if one.name == name), None) if simulated else None,
        at_first=scene_of(config, files, dict.fromkeys(config.objects.named)) if rendered else None,
        driven=None if simulated else _drive(config, None, files),
        rest=config.plant.part(Rest),
        lengths=_known_lengths(config),
    )


def objects_of(config: Config) -> tuple[SceneObject, ...]:
    """Objects of the simulated scene; those without places are left out."""
    placed = ((name, one) for name, one in config.objects.named.items() if one.is_placed)
    return tuple(scene_object(name, one) for name, one in placed)


def _contract(config: Config, plan: PlanInputs, files: Files | None) -> Contract | None:
    """Return the settings of a robot of the contract; None for the ideal plant."""
    plant = config.plant
    moves = any(one.follow or one.motion is not None for one in config.objects.named.values())
    ideal = plant.use is None and config.disturbance == Disturbance()
    if ideal and not moves:
        return None
    driven = _drive(config, plan.described.truth, files, shows=True)
    settle_s = plant.settle_s if plan.described.truth is None else None
    offset_s = _NO_LATENCY if ideal and plant.time_offset_s is None else plant.time_offset_s
    table = config.data.table if config.data is not None and plan.described.truth is None else ""
    identity = identity_in(table) if table and Path(table).is_file() else ""
    return Contract(
        driven, config.disturbance.part(Events), plant.timeout_s, offset_s, settle_s, identity, ideal
    )


def report_inputs(config: Config, files: Files | None = None) -> ReportInputs:
    """Return the inputs of a report: the whole configuration, which its page prints, and the extra runs."""
    files = files_of(config) if files is None else files
    about, lengths = about_of(config, files.values()), _known_lengths(config)
    if not config.has_task or config.steps:
        return ReportInputs(about, config.report, None, config.trajectory, lengths)
    alone = {
        "control": config.control.model_copy(update={"features": "points"}),
        "trajectory": config.trajectory.model_copy(update={"keep_out": ()}),
    }
    extra = servo_inputs(config.idealized.model_copy(update=alone), files)
    return ReportInputs(about, config.report, extra, config.trajectory, lengths)


def _known_lengths(config: Config) -> KnownLengths:
    """Return the lengths on the tool that the configuration knows."""
    markers = _markers(config)
    numbers = markers.known
    side = markers.tag_size_m if markers.points is None else None
    return KnownLengths(numbers, markers.lengths(numbers), side, markers.front or ())


def about_of(config: Config, read: Iterable[File] = ()) -> About:
    """Return the part of a configuration for the page; paths of its files may change."""
    files = {file.path: file for file in read}
    named = {f"__file_{i}__": file for i, file in enumerate(files.values())}
    text = stored_yaml(config, {file.path: name for name, file in named.items()})
    pieces = re.split(f"({'|'.join(named)})", text) if named else [text]
    return About(
        name=config.name,
        seed=config.seed,
        recorded=config.recorded,
        estimates_noise=config.data is not None and config.data.noise_px is None,
        joints=config.joint_names,
        required=config.control.must_converge,
        text=tuple(named.get(piece, piece) for piece in pieces),
    )


def scenery_of(config: Config) -> Scenery:
    """Return the scene of runs; InputError if robot, rig and markers are not described."""
    return Scenery(config.name, truth_of(config), config.plant.opaque, config.plant.simulated)


def files_of(config: Config, gone: Mapping[str, str] | None = None) -> Files:
    """Read the input files, by their roles; InputError if one cannot be read.

    gone : hashes that files had, by their paths, which hold if the files are gone.
    """
    rendered = config.plant.rendered is not None
    paths = {
        "table": None if config.data is None else config.data.table,
        "readings": None if config.data is None else config.data.readings,
        "init": config.calibration.init,
        "mjcf": config.arm.mjcf if config.arm is not None and rendered else None,
    }
    paths |= {f"camera {name}": file for name, file in (config.calibration.intrinsics or {}).items()}
    for i, one in enumerate(config.calibration.refits):
        paths |= {f"refit {i}": one.table, f"refit readings {i}": one.readings}
    return {role: _read(role, path, gone) for role, path in paths.items() if path is not None}


def _file(role: str, path: str, files: Files | None) -> File:
    """The file at a path: of ``files``, otherwise as it is read now."""
    return _read(role, path) if files is None else files[role]


def _file_if(role: str, path: str | None, files: Files | None) -> File | None:
    """The file at a path, likewise; None if the configuration names none."""
    return None if path is None else _file(role, path, files)


def _read(role: str, path: str, gone: Mapping[str, str] | None = None) -> File:
    """Read the file of a role; an InputError if it cannot be read."""
    of_camera = "a YAML file of a camera by OpenCV or ROS"
    expected = _EXPECTED.get(
        role, of_camera if role.startswith("camera ") else "a table of a camera that moved"
    )
    return File.of(path, expected, (gone or {}).get(path, ""), files_named(path) if role == "mjcf" else ())


# Robot, rig and markers.


def scene_of(
    config: Config, files: Files | None = None, objects: Mapping[str, ObjectSettings | None] | None = None
) -> RenderedScene | None:
    """Return the scene of rendered cameras; None for cameras that see points.

    objects : in the scene; with None in place of their sections, as goals were taught.
    """
    options = config.plant.rendered
    if options is None or config.arm is None or config.rig is None:
        return None
    tags = [
        tag.at(np.eye(4) if now is None else now.moved)
        for name, now in (objects or {}).items()
        for tag in config.objects.named[name].placed
    ]
    mjcf = _file_if("mjcf", config.arm.mjcf, files)
    moving = tuple((name, now) for name, now in (objects or {}).items() if now and now.motion is not None)
    return described_scene(config.arm, config.rig, _markers(config), options, mjcf, tuple(tags), moving)


# Values that drive a robot.


def joints_of(config: Config, *, paced: bool = True) -> JointSettings:
    """Joints as far as they are configured; ``paced`` with their speeds."""
    arm, vector = config.arm, config.reference
    limits = config.robot.limits if config.robot is not None else None
    return JointSettings(
        types=config.joint_types or "",
        ranges=None if arm is None else arm.ranges,
        limits=limits,
        unit=(limits.unit if limits is not None else None) or ("rad" if vector is None else vector.unit),
        known=0 if vector is None else len(vector.joints),
        speeds=_speeds(config) if paced else SpeedLimits(),
        flange_chart=_flange_chart(config),
    )


def _flange_chart(config: Config) -> FloatArray | None:
    """Chart (2, 4, 4) of readings that are poses of the flange; None for joints."""
    flange = None if config.robot is None else config.robot.flange
    return None if flange is None else flange.chart.record


def _speeds(config: Config) -> SpeedLimits:
    """Speed limits of the joints, or those of poses of the flange, unless the control sets lower ones."""
    limits, flange = config.control.speed_limits, None if config.robot is None else config.robot.flange
    if flange is None:
        return limits
    slide, turn = flange.max_speed_mm_s / MM, math.radians(flange.max_turn_deg_s)
    return limits._replace(revolute=min(limits.revolute, turn), prismatic=min(limits.prismatic, slide))


def _drive(config: Config, truth: Truth | None, files: Files | None = None, *, shows: bool = False) -> Drive:
    """Return how a robot of the contract is driven: the simulated one of a truth, or the user's.

    shows : whether cameras of a simulated one show objects, as cameras of the user's robot do.
    """
    plant, period, robot, objects = config.plant, config.control.period_s, None, config.objects.named
    further = tuple(number for one in objects.values() for number in one.numbers)
    if truth is not None:
        faults, scene = config.disturbance.part(Faults), scene_of(config, files, objects if shows else None)
        robot = SimulatedRobot(truth, faults, scene, period, objects_of(config) if shows else ())
    following = Following(period, plant.speed_scale, plant.part(ServoLimits))
    endless, seen = plant.simulated and plant.joint_limits == "report", truth is None or shows
    return Drive(robot or _own(config), following, endless, further if seen else ())


def _own(config: Config) -> OwnRobot:
    """The user's robot."""
    plant, markers = config.plant, _markers(config)
    return OwnRobot(
        target=plant.target,
        options=dict(plant.options),
        dictionary=markers.tag_dictionary,
        timeout_s=plant.timeout_s,
        open_s=plant.open_s,
        image_size=config.image_size_px,
        cameras=config.cameras,
        board=markers.pattern,
        flange_chart=_flange_chart(config),
    )


# Trials.


def _seed(config: Config) -> int:
    """Seed of the trial motions and of all that is random in their evaluation."""
    return config.seed if config.calibration.seed is None else config.calibration.seed


def _trials(config: Config, truth: Truth | None, files: Files | None = None) -> Trials:
    """Trial motions and the robot driven through them: the simulated one of a truth, or the user's."""
    settings, plant, reference = config.calibration, config.plant, config.reference
    if reference is None:
        raise InputError("trial motions need a reference: set calibration.reference or task.start")
    # The ideal plant reaches every set-point.
    driven = truth is None or plant.rendered is not None or config.disturbance.part(Faults) != Faults()
    poses = settings.random_poses
    if poses is None:
        poses = _RANDOM_POSES if driven else 0
    motions = Motions(
        reference,
        settings.amplitudes,
        settings.frames_per_joint,
        poses,
        2.0 * math.pi / (config.disturbance.encoder_counts_per_turn or _TICKS) if driven else 0.0,
        _seed(config),
    )
    return Trials(
        motions=motions,
        joints=joints_of(config, paced=driven),
        truth=truth,
        driven=_drive(config, truth, files) if driven else None,
        noise_px=config.noise.calibration_px,
        rest=plant.part(Rest) if driven else Rest(),
    )
