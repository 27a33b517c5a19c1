"""The stages of an experiment as functions: from a configuration or arrays to arrays, without files."""

import ast
import multiprocessing
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from projservo_cli import plugins
from projservo_cli.chain.execution import require_simulated
from projservo_cli.chain.progress import Listener
from projservo_cli.config import Config, Override, checked_values, overridden, to_yaml
from projservo_cli.config.inputs import (
    calibration_inputs,
    joints_of,
    plan_inputs,
    recording_inputs,
    servo_inputs,
)
from projservo_cli.config.sweep import SweepConfig
from projservo_cli.experiment import Experiment, law_target, plan_scene_of
from projservo_cli.laws import CODES, REGULATE, law_and_mode, run_name, run_names
from projservo_cli.loop.jit_notice import compilation
from projservo_cli.messages import sentence
from projservo_cli.observations import Observations, require_observations
from projservo_cli.records import Calibration, FloatArray, InputError, JointList, Plan, StatedBoard
from projservo_cli.result_hashes import File
from projservo_cli.results import ImageModel, MotionPlan, RunTrace
from projservo_cli.settings.calibration_and_refits import CalibrationSettings
from projservo_cli.settings.sections import Positive
from projservo_cli.stages import Progress
from projservo_cli.stages import calibrate as calibrating
from projservo_cli.stages import plan as planning
from projservo_cli.stages import record as recording
from projservo_cli.stages import servo as driving
from projservo_cli.stages.stage_inputs import Estimation, RefitInputs, Trials
from projservo_cli.store.display import checked_array, numbers_in, require_radians
from projservo_cli.store.files_and_locks import working_in, writing
from projservo_cli.store.run_file import load as stored_run
from projservo_cli.store.run_file import run_path
from projservo_cli.store.sweep_table import TABLE, SweepTable
from projservo_cli.sweeps.design import Design, require_sound
from projservo_cli.sweeps.folder import Folder, run_sweep
from projservo_cli.sweeps.statistics import Study
from projservo_cli.sweeps.workers import Engine

_WITHOUT_TASKS = 20  # default runs of a cell
_NO_LAW = "law {!r:.40}: expected a name, or a class or function that makes a law"


def simulate(
    config: Config,
    q: npt.ArrayLike | None = None,
    *,
    seed: int | None = None,
    noise_px: float | None = None,
    progress: Progress | bool = True,
) -> Observations:
    """Show the simulated robot of a configuration to its cameras.

    Parameters
    ----------
    config : with a simulated robot: of points, with faults, or rendered by MuJoCo.
    q : (K, n) joint readings of the poses, rad or m; by default the trial motions of the configuration.
    seed : of the noise; by default the seed of the trials. Given poses have a separate stream, so
        that they share no noise with trials.
    noise_px : standard deviation of a coordinate, px, where points are simulated; by default
        ``noise.calibration_px``.
    progress : called as ``progress(what, done, total)``; True for a bar in a terminal, False for none.

    Returns
    -------
    Observations
        Images of the trial motions, NaN where unseen, with the values that ``calibrate`` needs.

    Raises
    ------
    InputError
        When the configuration describes no simulated robot, or a pose is beyond a joint limit.
    WorkFailed
        When a robot with faults does not come to rest at a pose.
    """
    _require_config("simulate", config)
    if noise_px is not None:
        if config.plant.rendered is not None:
            raise InputError("noise_px: rendered images have plant.options.grey_noise instead")
        config = overridden(config, [Override("simulate: noise_px", "noise.calibration_px", noise_px)])
    if seed is not None:
        seeded = overridden(config, [Override("simulate: seed", "calibration.seed", seed)])
        config, seed = (seeded, None) if q is None else (config, seed)
    with Listener(progress) as listener:
        require_simulated(config)
        inputs = calibration_inputs(config.model_copy(update={"data": None}))
        while isinstance(inputs, RefitInputs):
            inputs = inputs.before
        trials = inputs.source
        assert isinstance(trials, Trials)
        if q is None:
            return calibrating.simulated(trials, progress=listener.progress)
        joints = joints_of(config).joints()
        poses = _rows_of(q, len(joints.types))
        require_radians("q", poses, joints.types)
        for k, pose in enumerate(poses):
            if wrong := joints.limit_passed(pose):
                raise InputError(f"q: pose {k}: {sentence(wrong)}: choose another")
        return calibrating.simulated(trials, poses, seed, progress=listener.progress)


def record(
    config: Config,
    robot: Any = None,
    *,
    path: str | Path | None = None,
    motions: npt.ArrayLike | None = None,
    force: bool = False,
    progress: Progress | bool = True,
) -> Observations:
    """Drive a robot through the trial motions of a configuration and look at each.

    Parameters
    ----------
    config : with ``markers`` and the limits of the motion; of an external robot also ``robot.limits``.
    robot : an object of the contract; by default the robot of ``plant.use``, or the simulated one.
    path : table (CSV) that grows as the robot goes, and from which an interrupted recording is continued.
    motions : (K, n) further poses after the trial motions, rad or m.
    force : whether to start again, although the table has rows.
    progress : called as ``progress(what, done, total)``; True for a bar in a terminal, False for none.

    Returns
    -------
    Observations
        All poses, and frames in motion for the time offset of the images.

    Raises
    ------
    InputError
        If the configuration lacks a key, or the table is of another one.
    WorkFailed
        When the robot fails, or its images show too little; the recorded poses stay in the table.
    """
    _require_config("record", config)
    asked = config if robot is None else _with_robot(config, robot)
    given, further = recording_inputs(asked), None
    joints = given.trials.joints.joints()
    if motions is not None:
        rows = _rows_of(motions, len(joints.types))
        further = JointList(np.arange(len(rows)), rows, numbered=False)
    table = None if path is None else Path(path)
    with ExitStack() as stack:
        listener = stack.enter_context(Listener(progress))
        if table is not None:
            stack.enter_context(writing(table))
        made = recording.new_recording(given, table, motions=further, force=force)
        if not (made.pending or asked.plant.simulated):
            listener.say(f"record: {table} is up to date, and the robot is not moved: use force=True")
        recording.record_poses(given, made, given=robot, kept=table is not None, progress=listener.progress)
    return Observations.of(
        made.observation(),
        joint_types=asked.joint_types,
        image_size=asked.image_size_px,
        seed=given.trials.motions.seed,
        mount=given.mount,
    )


class _CalibrationArguments(CalibrationSettings):
    """Arguments of ``calibrate``, which are keys of its section, and the noise of observations at hand."""

    noise_px: Positive | None = None


def calibrate(
    observations: Observations,
    *,
    method: str = "bundle_adjustment",
    lens: bool = False,
    init: str | Path | None = None,
    cross_validate: int | None = None,
    joint_noise_deg: float | None = None,
    max_predicted_px: float | None = None,
    joint_model: str | Sequence[str] | None = None,
    boards: Sequence[Sequence[float]] = (),
    noise_px: float | None = None,
    seed: int | None = None,
    progress: Progress | bool = True,
) -> ImageModel:
    """Learn the projective kinematics of a robot from its images, [RH00] section 2.

    Settings are as in the section ``calibration`` of a configuration, with the same defaults.

    Parameters
    ----------
    observations : of ``simulate``, ``record``, or of your arrays and tables.
    method : ``bundle_adjustment``, maximum likelihood, the only one.
    lens : whether to estimate radial distortion: two coefficients a camera, and its centre if it shows.
    init : JSON file of a robot and rig known beforehand, tried first as a start.
    cross_validate : parts into which poses are divided to predict each from the others; the held-out errors
        are in ``cross_validation``.
    joint_noise_deg : rms of joint readings less true angles (of prismatic joints × 0.3 m/rad); by default
        as the observations state, otherwise estimated.
    max_predicted_px : error of predictions by deviations of arm and rig from the model, px, above which the
        calibration is not usable; by default 1 % of the image size.
    joint_model : curves of the joints to fit: ``auto`` for those that the images show, or kinds such as
        ``scale``, of all or of one: ``scale:2``; a list, or a text with commas.
    boards : boards of known shape whose corners are markers, numbered row by row, each with the number of the
        marker at its first corner, columns, rows, perhaps their distance, m, and 1 if odd rows are staggered.
    noise_px : standard deviation of a coordinate, px; by default as the observations state, otherwise
        estimated.
    seed : of the random starts; by default the seed of the observations.
    progress : called as ``progress(what, done, total)``; True for a bar in a terminal, False for none.

    Returns
    -------
    ImageModel
        The calibration; one that is not ``usable`` says why in ``reason``.

    Raises
    ------
    InputError
        When a setting makes no sense.
    WorkFailed
        When the observations do not support a calibration: which joint or marker, and why.
    """
    require_observations("calibrate", observations)
    if isinstance(joint_model, str) and joint_model != "auto":
        joint_model = joint_model.split(",")
    given = {
        "method": method,
        "lens": lens,
        "init": init,
        "cross_validate": cross_validate,
        "joint_noise_deg": joint_noise_deg,
        "max_predicted_px": max_predicted_px,
        "joint_model": joint_model,
        "noise_px": noise_px,
        "seed": seed,
    }
    settings = checked_values("calibrate", _CalibrationArguments, given)
    noise = observations.noise
    if settings.joint_noise is not None:
        noise = noise._replace(joint=settings.joint_noise)
    if settings.noise_px is not None:
        noise = noise._replace(px=settings.noise_px)
    seed = observations.seed if settings.seed is None else settings.seed
    seen = replace(observations, noise=noise, seed=seed)
    start = None if settings.init is None else str(Path(settings.init).resolve())
    file = None if start is None else File.of(start, "JSON with screws, cameras and markers")
    asked = Estimation(
        settings.lens,
        file,
        settings.cross_validate,
        settings.max_predicted_px,
        settings.joint_model,
        tuple(StatedBoard.of(one) for one in boards),
    )
    with Listener(progress) as listener:
        screened, calibration, held_out = calibrating.estimate(seen, asked, progress=listener.progress)
        return ImageModel.of(calibration, held_out, screened)


def plan(
    config: Config, calibration: Calibration, *, q_start: npt.ArrayLike | None = None, goal: Any = None
) -> MotionPlan:
    """Split a task into a translation and two rotations and plan its motion, [RH00] section 4.

    Parameters
    ----------
    config : whose ``trajectory`` and ``control`` set the constraints of the motion; of a robot that is not
        described, the calibration predicts start and goal.
    calibration : of the same robot and rig.
    q_start : (n,) joint readings at the start, rad or m; by default ``task.start``.
    goal : (n,) joint readings, (V, m, 2) pixels of ``markers.face`` in the views of the calibration, or
        the file that ``projservo teach`` wrote, a path or a mapping; by default ``task.goal``.

    Returns
    -------
    MotionPlan
        One that is not ``feasible`` says why in ``reason``.

    Raises
    ------
    InputError
        When an array has another shape, the start is beyond a limit, or the size of the images is not known.
    WorkFailed
        When the task cannot be measured or split: which marker, and why.
    """
    _require_config("plan", config, calibration)
    asked = _with_task(config, calibration, q_start, goal)
    _say_compilation()
    described = asked.arm is not None and asked.rig is not None
    described = described and asked.markers is not None and asked.markers.points is not None
    given = plan_inputs(asked, predicted=asked.plant.simulated and not described)
    return MotionPlan.of(planning.run(given, calibration), plan_scene_of(asked, calibration), (q_start, goal))


def servo(
    config: Config,
    calibration: Calibration,
    plan: Plan,
    law: str | Callable[[Any], Any] = "exact",
    *,
    mode: str | None = None,
    robot: Any = None,
    blind: bool = False,
) -> RunTrace:
    """Drive a law in closed loop from the start of a task to its verdict.

    Parameters
    ----------
    config : of the robot that is driven, and of when a run ends.
    calibration : result of ``calibrate``.
    plan : result of ``plan``; its start and goal are the task.
    law : the name of a law, ``module:Class``, or a class or function that makes one of its setup.
    mode : ``regulate``, ``track`` or ``image_track``; by default the mode in the name, such as
        ``exact_track``, else ``regulate``.
    robot : an object of the contract to drive, instead of the robot of the configuration.
    blind : whether a robot may move although cameras show no marker of the calibration.

    Returns
    -------
    RunTrace
        With the verdict, and its reason.

    Raises
    ------
    InputError
        When there is no such law, it has no such mode, the configuration lacks a key, or the plan is of
        another task.
    WorkFailed
        When the run could not begin: the goal is out of reach, or the images of a robot disagree with the
        calibration.
    """
    _require_config("servo", config, calibration)
    if not isinstance(plan, Plan):
        raise InputError(f"servo: plan of type {type(plan).__name__}: make one with plan")
    if not (isinstance(law, str) or callable(law)):
        raise InputError(_NO_LAW.format(law))
    if isinstance(law, str):
        name, of_name = law_and_mode(law)
        if mode not in (None, of_name) and of_name != REGULATE:
            raise InputError(f"servo: law {law} is {name} in mode {of_name}, not {mode!r}: leave mode out")
        factory, name = None, law_target(name)
    else:
        factory, name, of_name = law, plugins.class_name(law), REGULATE
    if isinstance(plan, MotionPlan):
        config = _with_task(config, calibration, *plan.asked)
    modes = [of_name if mode is None else mode]
    asked = overridden(config, [Override("servo: mode", "control.mode", modes)])
    (name,) = run_names((name,), asked.control.mode)
    if robot is not None:
        asked = _with_robot(asked, robot)
    _say_compilation(name)
    brought = {"factory": factory, "robot": robot, "blind": blind}
    trace = driving.run(servo_inputs(asked), calibration, plan, name, **brought)
    return RunTrace.of(trace, asked.face_numbers)


def sweep(
    config: Config,
    laws: Sequence[str | type],
    *,
    tasks: int | Mapping[str, Any] | Sequence[Any] | None = None,
    runs: int | None = None,
    calibrations: int = 1,
    grid: Mapping[str, Any] | None = None,
    random: Mapping[str, Any] | None = None,
    seed: int = 0,
    workers: int = 1,
    path: str | Path | None = None,
    force: bool = False,
    progress: Progress | bool = True,
) -> Study:
    """Run laws on the same tasks, with the same calibrations and noise, over a grid of values.

    Parameters
    ----------
    config : of a simulated robot with a task.
    laws : names, ``module:Class`` or classes; a name may contain its mode, such as ``exact_track``.
    tasks : number of random tasks within sight of the cameras; or a list of tasks, each joints (n,) at start
        and goal, rad or m, or a mapping of keys of ``task``; or the section ``tasks`` of a sweep; by default
        the task of the configuration alone.
    runs : number per cell; by default one per task, or twenty.
    calibrations : of a cell, from noisy trials; run r is made with number r mod this.
    grid : lists of values by key, such as ``{"noise.servo_px": [0.0, 0.5]}``.
    random : distributions of keys, such as ``{"noise.servo_px": {"uniform": [0, 1]}}``.
    seed : of all that is drawn.
    workers : processes; with more than one, laws must be importable there.
    path : folder of the sweep, which is continued there; by default all is kept in memory.
    force : whether to start again, although the folder has runs.
    progress : called as ``progress(what, done, total)``; True for a bar in a terminal, False for none.

    Returns
    -------
    Study
        Its table, rates of success with Wilson intervals, and laws compared in pairs.

    Raises
    ------
    InputError
        When a value does not fit, or a law cannot be imported by other processes.
    WorkFailed
        When there are not enough tasks within sight, or workers were lost.
    """
    _require_config("sweep", config)
    if not (isinstance(workers, int) and workers > 0):
        raise InputError(f"workers={workers!r}: give a whole number of one or more")
    if isinstance(laws, (str, type)) or not np.iterable(laws):
        raise InputError(f"sweep: laws {laws!r:.40}: give a list of them, such as laws=['exact']")
    named = [(_law_of_sweep(one, workers), one if isinstance(one, str) else one.__name__) for one in laws]
    if not named:
        raise InputError("sweep: name one law or more")
    _require_guard(workers)
    axes = {**(grid or {}), "law": [target for target, _ in named]}
    values = {
        "name": config.name,
        "base": [f"{config.name}.yaml"],
        "seed": seed,
        "runs": _WITHOUT_TASKS if runs is None else runs,
        "grid": axes,
        "random": dict(random or {}),
        "calibrations": calibrations,
        "tasks": _tasks(tasks),
    }
    asked = checked_values("sweep", SweepConfig, values)
    if runs is None and asked.tasks is not None:
        asked = asked.model_copy(update={"runs": asked.tasks.count})
    design = Design(asked, ((config.name, to_yaml(config)),))
    require_sound(design)
    # A law without source has no key: its stored results cannot be matched to it.
    begin = force or not all(design.sources.values())
    with ExitStack() as stack:
        folder = Folder(stack.enter_context(tempfile.TemporaryDirectory()) if path is None else path)
        listener = stack.enter_context(Listener(progress))
        stack.enter_context(working_in(folder.path, "parts", "calibrations"))
        say = listener.say if path is not None else listener.detail
        run_sweep(design, folder, Engine(workers), listener.progress, say, force=begin)
        table, names = SweepTable(folder.table), dict(named)
        for law, failure in table.failures.items():
            listener.say(f"law {names.get(law, law)}: {failure.words}")
        study = Study(table, names)
    study.path = None if path is None else folder.table
    return study


def load(path: str | Path) -> Experiment | Study:
    """Open a stored run or sweep.

    Parameters
    ----------
    path : folder of a run or of a sweep, or its ``run.h5`` or ``sweep.h5``.

    Returns
    -------
    Experiment or Study
        The experiment with its finished stages, which ``make`` continues; no code of others that a
        stored run names is started by it. Of a sweep, the runs that are done.

    Raises
    ------
    InputError
        When there is none, it is cut short, or another version made it.
    """
    if not isinstance(path, (str, Path)):
        raise InputError(
            f"load: a path of type {type(path).__name__}: give the folder of a run or of a sweep"
        )
    target = Path(path)
    if target.suffix in (".yaml", ".yml"):
        raise InputError(f"{path}: a configuration, which Config.load reads; load opens the folder of a run")
    table = target if target.name == TABLE else target / TABLE
    if table == target or (table.is_file() and not run_path(target).is_file()):
        return Study(SweepTable(table))
    return Experiment.of(stored_run(target))


def _require_config(what: str, config: Any, calibration: Calibration | None = None) -> None:
    """Raise InputError unless a configuration is of the robot of a calibration."""
    if not isinstance(config, Config):
        raise InputError(f"{what}: config of type {type(config).__name__}: read one with Config.load")
    if calibration is None:
        return
    if not isinstance(calibration, Calibration):
        raise InputError(f"{what}: calibration of type {type(calibration).__name__}: make one with calibrate")
    if (config.joint_types or calibration.joint_types) != calibration.joint_types:
        raise InputError(
            f"{what}: the calibration is of joints {calibration.joint_types}, the configuration of "
            f"{config.joint_types}: take one of the same robot"
        )


def _rows_of(q: npt.ArrayLike, n: int) -> FloatArray:
    """Joint readings (K, n), rad or m, from rows or from one; an InputError for other values."""
    said = f"(K, {n}), rad or m"
    return checked_array("q", np.atleast_2d(numbers_in("q", q, said)), (None, n), said, finite=True)


def _say_compilation(*laws: str) -> None:
    """Say that the following steps take as long as the compiler does."""
    if told := compilation(laws):
        print(told, file=sys.stderr, flush=True)


def _with_robot(config: Config, robot: Any) -> Config:
    """The configuration with an object of the contract in place of its robot."""
    name = plugins.class_name(robot)
    plugins.require_object("plant", name, robot)
    plant = config.plant.model_copy(update={"use": name, "options": {}})
    return config.model_copy(update={"plant": plant})


def _with_task(config: Config, calibration: Calibration, q_start: npt.ArrayLike | None, goal: Any) -> Config:
    """The configuration with another start (n,) or goal."""
    joint_types = calibration.joint_types
    changes, n = [], len(joint_types)
    if q_start is not None:
        start = checked_array("q_start", q_start, (n,), f"({n},), rad or m", finite=True)
        require_radians("q_start", start, joint_types)
        of_joints = {"joints": start.tolist(), "unit": "rad"}
        changes += [Override("plan: q_start", "task.start", of_joints)]
        changes += [Override("plan: q_start", "task.start_offset", None)]
    if goal is not None:
        changes += [Override("plan: goal", "task.goal", _goal(config, calibration, goal))]
    return overridden(config, changes) if changes else config


def _goal(config: Config, calibration: Calibration, goal: Any) -> Any:
    """A goal as a configuration has it."""
    joint_types, view = calibration.joint_types, calibration.view
    n, V = len(joint_types), len(view)
    if isinstance(goal, (str, Path)):
        return str(Path(goal).resolve())
    if isinstance(goal, Mapping):
        return dict(goal)
    m = len(config.face_numbers)
    shape = f"({n},) joint readings, or ({V}, {m}, 2) pixels of markers.face"
    if numbers_in("goal", goal, shape).ndim == 1:
        joints = checked_array("goal", goal, (n,), f"({n},) joint readings, rad or m", finite=True)
        require_radians("goal", joints, joint_types)
        return {"joints": {"joints": joints.tolist(), "unit": "rad"}}
    pixels = checked_array("goal", goal, (V, m, 2), shape, finite=True).tolist()
    return {"images": dict(zip(view, pixels, strict=True))}


def _tasks(tasks: Any) -> Any:
    """Tasks as a sweep has them."""
    if tasks is None or isinstance(tasks, Mapping):
        return tasks
    if isinstance(tasks, str) or not np.iterable(tasks):
        return {"random": tasks}
    return {"listed": [task if isinstance(task, Mapping) else _task_between(task) for task in tasks]}


def _task_between(ends: npt.ArrayLike) -> dict[str, Any]:
    """Return the task from joints (n,) to joints (n,), rad or m, given as (2, n)."""
    said = "(2, n), joint readings at start and goal"
    q = checked_array("tasks", ends, (2, None), said, finite=True)
    start, goal = ({"joints": row, "unit": "rad"} for row in q.tolist())
    return {"start": start, "start_offset": None, "goal": {"joints": goal}}


def _law_of_sweep(law: str | type, workers: int) -> str:
    """A law as the grid of a sweep names it; classes of this process are found again by that name."""
    if not (isinstance(law, str) or hasattr(law, "__qualname__")):
        raise InputError(_NO_LAW.format(law))
    if isinstance(law, str):
        name, mode = law_and_mode(law)
        return law if name in CODES else run_name(law_target(name), mode)
    target = plugins.bring("law", law)
    if workers > 1 and not plugins.importable(law):
        raise InputError(
            f"sweep: other processes cannot import {plugins.class_name(law)}: put it into a module, or use "
            "workers=1"
        )
    return target


def _require_guard(workers: int) -> None:
    """Refuse more processes if each of them would run the script again, and start its own sweep."""
    script = getattr(sys.modules.get("__main__"), "__file__", None)
    if workers < 2 or script is None or not Path(script).is_file():
        return
    if multiprocessing.parent_process() is None and _has_guard(Path(script)):
        return
    raise InputError(
        f"{script}: with workers={workers} each process imports the script again: put its calls under "
        'if __name__ == "__main__":'
    )


def _has_guard(script: Path) -> bool:
    """Tell whether a script has a ``__main__`` guard."""
    try:
        tree = ast.parse(script.read_bytes())
    except (OSError, SyntaxError, ValueError):
        return True  # its source is unknown
    return any(isinstance(node, ast.Name) and node.id == "__name__" for node in ast.walk(tree))
