"""Commands of the stages and of their chain: dry run, work, summary."""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.shell_completion import CompletionItem

from projservo_cli.cli import options as option
from projservo_cli.cli.output import Console, visible, words_of, wrapped
from projservo_cli.cli.program import FAILED, main
from projservo_cli.deviations import CURVES

if TYPE_CHECKING:
    from projservo_cli.chain.execution import Chain
    from projservo_cli.config import Config
    from projservo_cli.records import WorkFailed
    from projservo_cli.store.run_file import Run

_NAMING = {"plant": {"plant", "plant.use"}, "law": {"control", "control.laws"}}  # keys of --set
_AGAIN = ", and the robot is not moved: --force records all poses again"
_TRIALS = "trials.csv"  # default table of a recording, in the folder of a run
# Options that the report of a sweep ignores.
_UNUSED = ("config", "sets", "output", "data", "dry_run", "view", "animation")


_OF_STAGES = (
    option.configuration(
        help="Configuration (YAML). Default: the one stored in the run that -o names, otherwise paper.yaml."
    ),
    option.override,
    option.output(
        metavar="DIR", help="Folder of the run, or its run.h5. Default: results/<configuration name>."
    ),
    click.option("--data", metavar="TABLE", type=click.Path(), help="Calibrate from this table (CSV)."),
    click.option(
        "--readings",
        metavar="TABLE",
        type=click.Path(),
        help="Joints, or poses of the flange (CSV), where --data lists detections: pose, camera, "
        "marker, u, v.",
    ),
    click.option(
        "--mount",
        type=click.Choice(["world", "tool"]),
        help="Where the table's cameras are: fixed in the world, or on the tool. Default: world.",
    ),
    click.option(
        "--board",
        metavar="KIND:CxR[:MMmm]",
        help="The table's markers are corners of a board: chessboard:9x7:25mm (inner corners), "
        "charuco:11x8 (squares), circles:9x7 or acircles:4x11, from marker 0. A fit uses its shape.",
    ),
    click.option(
        "--intrinsics",
        metavar="[NAME=]FILE,...",
        help="YAML file of each camera by OpenCV or ROS: its lens is taken, and its focal lengths and "
        "centre are priors.",
    ),
    click.option("--joints", metavar="RRPRRR", help="Type of each joint of the table. Default: all R."),
    option.joint_unit(help="Unit of the table's revolute joints. Default: rad."),
    click.option(
        "--noise-px", metavar="S", type=option.NUMBER, help="Pixel noise of the table. Default: estimated."
    ),
    click.option("--lens", is_flag=True, help="Estimate radial lens distortion, and its centre if it shows."),
    click.option(
        "--joint-model",
        metavar="auto|LIST",
        help=f"Fit curves of the joints: those that the images show, or of {', '.join(CURVES)}, such as "
        "scale:2,sag.",
    ),
    click.option(
        "--image-size",
        metavar="[NAME=]WxH,...",
        help="Size of all images, px, or of each view, by name or in the order of the views (in a list of "
        "detections by name, c2 before c10). Default: the size in cameras or rig.",
    ),
    option.force(help="Make the named stages even if they are up to date."),
    option.dry_run,
    option.threads(help="Threads. Default: all processors."),
    option.explained,
    click.pass_obj,  # the names of the stages of the call
)


def _of_stages(function: Callable[..., Any]) -> Callable[..., Any]:
    """Give a stage the options of all stages, its console, and the names of the stages of the call."""
    for decorate in reversed(_OF_STAGES):
        function = decorate(function)
    return function


def _laws(context: click.Context, parameter: click.Parameter, incomplete: str) -> list[str]:
    """Laws for the completion of a shell."""
    del context, parameter
    from projservo_cli.laws import LAWS

    return [law for law in LAWS if law.startswith(incomplete)]


def _stages_or_files(
    context: click.Context, parameter: click.Parameter, incomplete: str
) -> list[CompletionItem]:
    """Further stages for the completion of a shell, otherwise files."""
    del parameter
    further = [name for name in main.stages if name.startswith(incomplete) and name not in context.obj]
    return [*map(CompletionItem, further)] or [CompletionItem(incomplete, type="file")]


@main.stage("record", epilog="Example: projservo record -c configs/stanford.yaml --output trials.csv")
@option.configuration(help="Configuration (YAML). Default: paper.yaml.")
@option.override
@option.output(metavar="TABLE", help="Observation table to write (CSV). Default: data.table.")
@click.option(
    "--motions",
    metavar="CSV",
    type=option.PATH,
    help="Further poses after the trial motions, a row each, with columns q1 ... qN.",
)
@option.joint_unit(help="Unit of the table's revolute joints. Default: rad.")
@option.speed_scale
@option.confirm
@option.force(help="Start again, although the table has rows.")
@option.dry_run
@option.explained
@click.pass_obj
def _record(stages: Sequence[str], /, console: Console, **options: Any) -> int:
    """Drive the robot through trial motions and write a table.

    Drives the robot of a configuration, simulated or yours, through its trial motions (and --motions, whose
    readings --joint-unit is about), in steps that the joint-speed limit allows, and writes the images
    into an observation table for calibrate.

    The table grows as the robot goes. After an interruption the same command continues it; a table of another
    configuration is refused, unless --force starts again.

    Before other stages, as in projservo record calibrate, -o is the run, and the table is data.table,
    otherwise trials.csv next to the run; a recording of another configuration of the same plant is made
    again.
    """
    if options["joint_unit"] is not None and options["motions"] is None:
        raise click.UsageError("--joint-unit is the unit of --motions, which is not given")
    if len(stages) > 1:
        return _make(console, stages, options)
    from projservo_cli.chain.recordings import data_table, recording_made
    from projservo_cli.config.inputs import recording_inputs
    from projservo_cli.stages.record import new_recording
    from projservo_cli.store.files_and_locks import writing

    config = option.configured(options["config"], options)
    path = options["output"] or data_table(config)
    poses, given = _motions(config, options), recording_inputs(config)
    recording, why = new_recording(given, path, motions=poses, force=options["force"]), None
    if not (recording.why or config.plant.simulated):
        console.say(f"record: {path} is up to date{_AGAIN}")
    if not options["dry_run"]:
        with writing(path):
            recording = new_recording(given, path, motions=poses, force=options["force"])
            why = recording_made(console, config, recording, confirm=options["confirm"])
    value = _recording_object(recording, why)
    console.report(value, [*words_of("record", value), *([f"table: {path}"] if path.exists() else [])])
    if why:
        click.echo(visible(f"projservo: record: {why}"), err=True)
    return FAILED if why else 0


def _recording_object(recording: Any, why: "WorkFailed | None") -> dict[str, Any]:
    """The JSON object of a recording, and why it stopped short if it did."""
    explained: dict[str, Any] = recording.summary
    if why is None:
        return explained
    return explained | {"reason": str(why), "findings": list(why.findings), "failed": "record"}


def _motions(config: Any, options: Mapping[str, Any]) -> Any:
    """The list of ``--motions``; None if none is given."""
    from projservo_cli.store.observation_tables import read_joint_list

    if options["motions"] is None:
        return None
    return read_joint_list(options["motions"], config.joint_types, options["joint_unit"])


@main.stage(
    "calibrate", epilog="Example: projservo calibrate --data trials.csv --joints RRPRRR -o results/mine"
)
@click.option(
    "--cross-validate",
    metavar="K",
    type=int,
    help="Predict the poses in K parts, each from a fit to the others.",
)
@click.option(
    "--init",
    metavar="FILE",
    type=click.Path(),
    help="Try this robot and rig (JSON: screws, cameras, markers) first as a start.",
)
@click.option(
    "--suggest",
    metavar="[N]",
    type=click.IntRange(1, 100),
    help="Suggest N further poses to record, by decreasing information; 5 without N.",
)
@click.argument("run", metavar="[RUN]", required=False, type=option.PATH, shell_complete=_stages_or_files)
@click.option(
    "--refit",
    metavar="NAME",
    help="Fit this camera of RUN, which moved, again by the images in --data; -o is another run.",
)
@_of_stages
def _calibrate(stages: Sequence[str], console: Console, **options: Any) -> int:
    """Learn the projective kinematics from trial motions.

    Estimates the cameras and all joint operators from images alone, simulated from the configuration or
    recorded in an observation table (--data).

    --cross-validate and --init become part of the configuration of the run. --suggest works on the
    calibration as it is and writes suggestions.csv into the folder of the run, for record --motions.

    projservo calibrate RUN --refit NAME --data TABLE -o NEW keeps joints, markers and other cameras of RUN,
    and fits the camera NAME, which moved, again. Exit code 1 if the joint readings cannot be
    confirmed: too few poses, and no other camera.
    """
    if (options["run"] is None) != (options["refit"] is None):
        raise click.UsageError(
            "a camera is fitted again by projservo calibrate RUN --refit NAME --data TABLE -o NEW"
        )
    return _make(console, stages, options)


@main.stage("plan", epilog="Example: projservo plan -c configs/ur5.yaml --set trajectory.profile=exponential")
@_of_stages
def _plan(stages: Sequence[str], console: Console, **options: Any) -> int:
    """Plan the task as a translation and two rotations.

    Partitions the task by the start and goal images and lays a path on which the cameras keep seeing the
    face. Calibrates first where needed.
    """
    return _make(console, stages, options)


@main.stage("servo", epilog="Example: projservo servo -o results/ur5 --law direct_two --law stacked")
@click.option(
    "--law",
    "laws",
    metavar="NAME",
    multiple=True,
    shell_complete=_laws,
    help="This law, or plug-in law (module:Class), instead of control.laws. Repeatable.",
)
@option.speed_scale
@option.confirm
@click.option(
    "--blind",
    is_flag=True,
    help="Move a robot although cameras show no marker of the calibration, without a comparison.",
)
@click.option(
    "--goal",
    "goals",
    metavar="NAME",
    multiple=True,
    help="Go to this goal of task.goals, or taught one, NAME.yaml next to the configuration, instead of "
    "task.goal and task.steps. Repeatable, for several one after the other.",
)
@click.option(
    "--from",
    "origin",
    metavar="SWEEP:INDEX",
    help="The run of that number of a sweep, repeated as a separate run.",
)
@_of_stages
def _servo(stages: Sequence[str], console: Console, **options: Any) -> int:
    """Run the control laws in closed loop.

    Runs each law of control.laws (or of --law) to its verdict, and says why one did not converge. Calibrates
    and plans first where needed. Exit code 1 when a law of control.must_converge does not converge: by
    default all but the classical ones.

    With --set plant=module:Class (or plant in the configuration) an external robot takes the place of the
    simulated one. It is driven to the start of the task and from there by each law, in every call, and
    always stopped, also on errors and Ctrl-C.
    """
    return _make(console, stages, options)


@main.stage(
    "report",
    epilog="Example: projservo calibrate plan servo report -c configs/ur5.yaml -o results/ur5 --view",
)
@click.argument("run", metavar="[RUN]", required=False, type=option.PATH)
@click.option("--view", is_flag=True, help="A 3D view of robot, rig and paths with a time slider, view.html.")
@click.option(
    "--animation", is_flag=True, help="Both camera images under several laws over time, animation.gif."
)
@_of_stages
def _report(stages: Sequence[str], console: Console, *, run: Path | None, **options: Any) -> int:
    """Draw the figures and check the paper's claims.

    Writes into the folder of the run: the figures, each with its numbers as CSV; the table of claims; and
    report.html, one page that needs no other file. Makes every missing stage before it.

    --view adds view.html, a 3D view of robot, rig, face and paths with a time slider, which needs no network;
    it needs pip install '.[view]' and a robot described in metres. --animation adds animation.gif,
    the camera images under the direct and the classical laws. The page links to both; a report that is up
    to date is not made again for them.

    RUN is short for -o RUN. With the folder of a sweep it writes its statistics and figures instead: success
    with intervals, final errors, laws compared on the same tasks.
    """
    from projservo_cli.records import InputError
    from projservo_cli.store.run_file import SWEEP, run_path

    if run is not None and not run.exists():
        raise InputError(
            f"{run}: there is no such folder: name the folder of a run (projservo servo -o {run}), or "
            "of a sweep"
        )
    if run is not None and (run.name == SWEEP or not run_path(run).is_file()):
        return _print_sweep(console, run, options)
    options["output"] = option.one_run("report", run, options["output"])
    return _make(console, stages, options)


def _make(console: Console, names: Sequence[str], options: Mapping[str, Any]) -> int:
    """Make the named stages and their missing inputs; return the exit code."""
    if options["threads"] is not None:  # read by the compiler's runtime when it is first imported
        os.environ["NUMBA_NUM_THREADS"] = str(options["threads"])
    from projservo_cli.chain.execution import FIGURES
    from projservo_cli.store.files_and_locks import tidy, working_in, writing

    chain = _asked(console, names, options)
    if options["dry_run"]:
        words = (f"{s.name}: {f'would be made ({s.why})' if s.why else s.status}" for s in chain.steps)
        steps = [
            {"stage": s.stage, "law": s.law or None, "why": s.why or None}
            | ({"step": s.part} if s.part else {})
            for s in chain.steps
        ]
        console.report({"run": chain.run.path.resolve(), "dry_run": True, "steps": steps}, words)
        return 0
    folder = chain.run.path.parent
    if not chain.pending and not _optional_files(options):
        tidy(folder, FIGURES)
        return _work(console, chain, options)
    with working_in(folder, FIGURES):
        if chain.recording is None:  # again, since another process may have written the run until now
            return _work(console, _asked(console, names, options), options)
        with writing(chain.recording.path):
            chain = _asked(console, names, options)
            if chain.record():
                unasked = {**options, "confirm": options["confirm"] and not chain.recording.why}
                chain = _asked(console, names, unasked, replace(chain.recording, why=""))
            return _work(console, chain, options)


def _asked(
    console: Console, names: Sequence[str], options: Mapping[str, Any], recording: Any = None
) -> "Chain":
    """Return the chain of the call, by the configuration and the run; refuse a forbidden one.

    recording : if it was made just now.
    """
    from projservo_cli.chain.execution import Chain
    from projservo_cli.chain.recordings import pending_recording
    from projservo_cli.config import Override

    laws, records = _law_names(options.get("laws", ())), "record" in names
    config, stored = _resolve(options, recording=records)
    if wanted := _optional_files(options):
        _require_optional(config, wanted)
    if records and recording is None:
        recording = pending_recording(config, stored, _motions(config, options), force=options["force"])
    how: dict[str, Any] = {name: bool(options.get(name)) for name in ("force", "confirm", "blind")}
    chain = Chain(console, names, config, stored, laws, recording=recording, **how)
    if not options["dry_run"]:
        keys = {Override.parse(text).key for text in options["sets"]}
        named = {kind for kind, those in _NAMING.items() if options["config"] or keys & those}
        chain.require_permitted(named | ({"law"} if laws else set()))
    return chain


def _resolve(options: Mapping[str, Any], *, recording: bool = False) -> tuple["Config", "Run"]:
    """The configuration with all overrides, and the run as stored so far.

    A table next to the run, or the one that a ``recording`` puts there, belongs to the configuration unless
    it names another.
    """
    from projservo_cli.config import Override, load_config, overridden
    from projservo_cli.store.run_file import stored

    if options.get("origin") is not None:
        return _from_sweep(options)
    if options.get("refit") is not None:
        return _of_refit(options)
    run = stored(options["output"]) if options["output"] else None
    if not options["config"] and run is not None and run.configuration:
        config = load_config(run.path, option.overrides(options), text=run.configuration)
    elif not options["config"] and options["data"]:
        config = load_config(None, option.overrides(options))
    else:
        config = option.configured(options["config"], options)
    run = run or _run_of(options, config)
    table = run.path.resolve().with_name(_TRIALS)
    if config.data is None and (recording or table.is_file()):
        in_folder = Override(f"{table}", "data.table", str(table))
        config = overridden(config, [in_folder])
    return config, run


def _of_refit(options: Mapping[str, Any]) -> tuple["Config", "Run"]:
    """Configuration of a run with a camera fitted again, and another run that holds its calibration."""
    from projservo_cli.config import Override, load_config, stored_yaml
    from projservo_cli.store.run_file import Run, load, run_path, stored

    flag, before = f"--refit {options['refit']}", load(options["run"])
    if not options["data"] or not options["output"]:
        raise click.UsageError(f"{flag}: takes --data TABLE, images by that camera, and -o, another run")
    if run_path(options["output"]).resolve() == before.path.resolve():
        raise click.UsageError(f"{flag}: -o {options['output']} is the run itself; name another")
    of_first = "config mount joints board intrinsics noise_px lens init cross_validate image_size"
    for name in of_first.split():
        if options[name]:
            text = f"the one in {before.path.parent} holds; leave it out"
            raise click.UsageError(f"--{name.replace('_', '-')} and {flag}: {text}")
    if options["refit"] not in before.calibration.view:
        raise click.UsageError(f"{flag}: the cameras are {', '.join(before.calibration.view)}")
    result, files = before.results["calibrate"], {"table": options["data"], "readings": options["readings"]}
    one = {name: os.path.abspath(file) for name, file in files.items() if file}
    one |= {"view": options["refit"], "joint_unit": options["joint_unit"]}
    settings = load_config(before.path, text=result.configuration).calibration.model_dump(mode="json")
    refits = Override(flag, "calibration.refits", [*settings["refits"], one])
    sets = map(Override.parse, options["sets"])
    config, run = (
        load_config(before.path, [refits, *sets], text=result.configuration),
        stored(options["output"]),
    )
    if run.configuration != stored_yaml(config):
        run = Run(run.path, run.configuration, {"calibrate": result})
    return config, run


def _from_sweep(options: Mapping[str, Any]) -> tuple["Config", "Run"]:
    """Configuration of a run of a sweep, and a run that holds the calibration it was made with."""
    from projservo_cli.config import overridden
    from projservo_cli.store.run_file import Run
    from projservo_cli.sweeps.folder import run_of

    if options["config"]:
        raise click.UsageError("-c and --from: the sweep has its configuration; leave -c out")
    config, calibration = run_of(options["origin"])
    if overrides := option.overrides(options):
        config = overridden(config, overrides)
    run = _run_of(options, config)
    before = run.results.get("calibrate")
    if calibration is not None and (before is None or before.key != calibration.key):
        run = Run(run.path, run.configuration, {"calibrate": calibration})
    return config, run


def _run_of(options: Mapping[str, Any], config: "Config") -> "Run":
    """The run where the user says, else in the folder of the configuration's name; empty if none is."""
    from projservo_cli.store.files_and_locks import require_inside
    from projservo_cli.store.run_file import stored

    folder = options["output"]
    if not folder:
        folder = option.RESULTS / config.name
        require_inside(folder, option.RESULTS)
    return stored(folder)


def _require_optional(config: Any, wanted: Sequence[str]) -> None:
    """Make sure, before any work, that ``view`` and ``animation`` can be made if they are wanted."""
    from projservo_cli.config.settings_and_rules import truth_of
    from projservo_cli.records import InputError
    from projservo_cli.report.animation import plotly

    if config.task is None:
        text = "shows runs of laws, which need a task: set task.start and task.goal"
        raise InputError(f"--{wanted[0]}: {text}")
    if config.steps:
        raise InputError(
            f"--{wanted[0]}: shows runs of one motion, and the task is a sequence: name a --goal"
        )
    if "view" in wanted:
        plotly()
        try:
            truth_of(config)
        except InputError as error:
            raise InputError(
                "--view: images alone give a robot only up to a projective frame, which has no metres to "
                f"draw; {error}, or use --animation, which shows the images"
            ) from error


def _optional_files(options: Mapping[str, Any]) -> list[str]:
    """Return the files that a report has in addition to its page."""
    return [name for name in ("view", "animation") if options.get(name)]


def _law_names(names: Sequence[str]) -> tuple[str, ...]:
    """The laws of ``--law``, each once, registered names replaced by their classes."""
    from projservo_cli.experiment import law_target
    from projservo_cli.records import InputError

    try:
        return tuple(dict.fromkeys(map(law_target, names)))
    except InputError as error:
        raise click.UsageError(f"--{error}") from error


def _work(console: Console, chain: "Chain", options: Mapping[str, Any]) -> int:
    """Make the outdated stages and print their results; return the exit code."""
    chain.read()
    _announce(console, chain)
    chain.make()
    # Further values of their objects.
    more_values: dict[str, dict[str, Any]] = {"calibrate": {}, "report": {}}
    if (count := options.get("suggest")) is not None and not chain.lacks("calibrate"):
        more_values["calibrate"] = chain.suggestions(count)
    if "calibrate" in chain.names:
        done = not chain.lacks("calibrate")
        by_joints = done and chain.run.calibration.flange_chart is None
        more_values["calibrate"]["joint_types_assumed"] = by_joints and chain.config.joint_types is None
    if (wanted := _optional_files(options)) and not chain.lacks("report"):
        more_values["report"] |= chain.optional_files(wanted)
    more_values["report"]["replayed"] = chain.replayed()
    from projservo_cli.records import WorkFailed
    from projservo_cli.report.json_objects import failed_object, stage_object

    values, joints, failure = {}, chain.config.joint_names, chain.failure
    for name in chain.names:
        if name == "record":
            short = WorkFailed(failure.reason, findings=failure.evidence) if chain.lacks(name) else None
            values[name] = {"run": chain.run.path.resolve()} | _recording_object(chain.recording, short)
        elif chain.lacks(name):
            why = failure.reason, failure.evidence
            values[name] = failed_object(name, chain.run, why, failure.step, chain.laws_done)
        else:
            values[name] = stage_object(name, chain.run, joints, chain.laws)
            values[name] |= more_values.get(name, {})
    words = [line for name in values for line in words_of(name, values[name], detailed=console.verbose)]
    words += [f"table: {chain.recording.path}"] if chain.recording is not None else []
    words += [f"run: {chain.run.path}"] if chain.run.results else []
    console.report(values if len(values) > 1 else values[chain.names[0]], words)
    findings = list(chain.findings(more_values["calibrate"]))
    for finding in findings:
        if finding.fatal or not console.quiet:
            click.echo(visible(f"projservo: {finding.text}"), err=True)
    return FAILED if any(finding.fatal for finding in findings) else 0


def _announce(console: Console, chain: "Chain") -> None:
    """Print the stages to make by reason, and those up to date."""
    option.say_unnamed(console)
    reasons: dict[str, list[str]] = {}
    for step in chain.steps:
        if step.stage == "record" and len(chain.recording.done) > chain.recording.found:
            continue  # it was said before it was made
        needed = "" if step.stage in chain.names else f", needed by {chain.names[-1]}"
        if step.why or not needed:
            again = step.stage == "record" and not chain.config.plant.simulated
            kept = f"{step.status}{_AGAIN}" if again else step.status
            said = f"making ({step.why}{needed})" if step.why else kept
            reasons.setdefault(said, []).append(step.name)
    for said, found in reasons.items():
        console.say(f"{', '.join(found)}: {said}")


def _print_sweep(console: Console, sweep: Path, options: Mapping[str, Any]) -> int:
    """Write the report of a sweep and print its tables; the exit code."""
    from projservo_cli.report.style import FORMATS
    from projservo_cli.store.files_and_locks import working_in
    from projservo_cli.sweeps.folder import Folder
    from projservo_cli.sweeps.statistics import report

    for name in _UNUSED:
        if options[name]:
            flag = name.replace("_", "-").removesuffix("s")
            raise click.UsageError(f"--{flag}: not used by report {sweep}, which is of a sweep")
    folder = Folder(sweep)
    with working_in(folder.path):
        found, files = report(folder.assembled(), FORMATS, console.progress)
    value = {"sweep": folder.path.resolve(), **found, "files": [path.resolve() for path in files]}
    names = ", ".join(path.name for path in files)
    console.report(value, [*words_of("sweep", found), wrapped(f"files: {folder.path}: {names}")])
    return 0
