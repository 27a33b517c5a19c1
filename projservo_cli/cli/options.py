"""Options that several commands take, as decorators; and which configuration and run they are about."""

import contextlib
import functools
import math
import os
import re
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from projservo_cli.cli.output import Console

if TYPE_CHECKING:
    from projservo_cli.config import Config, Override
    from projservo_cli.store import Run

_Function = Callable[..., Any]

PATH = click.Path(path_type=Path)


class _Finite(click.types.FloatParamType):
    """A finite number; click takes NaN, in ranges as well, since it compares with no limit."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Read a number, and refuse one that is not finite."""
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{number} is not a finite number.", param, ctx)
        return number


class NumberRange(_Finite, click.FloatRange):
    """A number within limits."""


NUMBER = _Finite()
_RESULTS = Path("results")
_SIZE = re.compile(r"\s*(\d+)\s*[xX]\s*(\d+)\s*")
_TRIALS = "trials.csv"  # in the folder of a run: the default table of a recording
_KEYS = {  # that options stand for
    "data": "data.table",
    "readings": "data.readings",
    "mount": "data.mount",
    "joints": "data.joints",
    "joint_unit": "data.joint_unit",
    "noise_px": "data.noise_px",
    "init": "calibration.init",
    "cross_validate": "calibration.cross_validate",
    "lens": "calibration.lens",
    "joint_model": "calibration.joint_model",
}

# Options that each command describes for itself.
configuration = functools.partial(click.option, "-c", "--config", metavar="FILE", type=click.Path())
output = functools.partial(click.option, "-o", "--output", type=PATH)
force = functools.partial(click.option, "--force", is_flag=True)
joint_unit = functools.partial(click.option, "--joint-unit", type=click.Choice(["deg", "rad"]))
threads = functools.partial(click.option, "-j", "--threads", metavar="N", type=click.IntRange(1, 256))

override = click.option(
    "--set",
    "sets",
    metavar="A.B=V",
    multiple=True,
    help="Override a value of the configuration; V is YAML, files are relative to the configuration. "
    "Repeatable.",
)
dry_run = click.option("-n", "--dry-run", is_flag=True, help="Say what would be done, do nothing.")
speed_scale = click.option(
    "--speed-scale", metavar="S", type=NUMBER, help="Scale every command by S, above 0 and at most 1."
)


def _with_terminal(context: click.Context, parameter: click.Parameter, value: bool) -> bool:
    """Refuse an option that asks somebody where nobody can answer."""
    del context
    if value and not sys.stdin.isatty():
        what = "standard input is no terminal, so nobody can be asked; leave it out"
        raise click.UsageError(f"{parameter.opts[0]}: {what}")
    return value


asking = functools.partial(click.option, is_flag=True, callback=_with_terminal)
confirm = asking("--confirm", help="Ask on the terminal before the first motion.")


def explained(function: _Function) -> _Function:
    """Give a command its console, made of ``--json``, ``-q`` and ``-v``, which all commands take.

    The output of a plug-in robot or law goes to standard error: it is not a result.
    """

    @click.option("--json", "as_json", is_flag=True, help="Print one JSON object on standard output.")
    @click.option("-q", "--quiet", is_flag=True, help="Print errors only, and the object of --json.")
    @click.option("-v", "--verbose", is_flag=True, help="Say more; show tracebacks.")
    @functools.wraps(function)
    def command(*arguments: Any, as_json: bool, quiet: bool, verbose: bool, **values: Any) -> Any:
        console = Console(quiet=quiet, verbose=verbose, as_json=as_json)
        with console, contextlib.redirect_stdout(sys.stderr):
            return function(console, *arguments, **values)

    return command


_OF_STAGES = (
    configuration(
        help="Configuration (YAML). Default: the one stored in the run that -o names, else paper.yaml."
    ),
    override,
    output(metavar="DIR", help="Folder of the run, or its run.h5. Default: results/<configuration name>."),
    click.option("--data", metavar="TABLE", type=click.Path(), help="Calibrate from this table (CSV)."),
    click.option(
        "--readings",
        metavar="TABLE",
        type=click.Path(),
        help="Joints of each pose (CSV), where --data lists detections: pose, camera, marker, u, v.",
    ),
    click.option(
        "--mount",
        type=click.Choice(["world", "tool"]),
        help="Where the table's cameras are: they stand still, or are on the tool. Default: world.",
    ),
    click.option("--joints", metavar="RRPRRR", help="Type of each joint of the table. Default: all R."),
    joint_unit(help="Unit of the table's revolute joints. Default: rad."),
    click.option(
        "--noise-px", metavar="S", type=NUMBER, help="Pixel noise of the table. Default: estimated."
    ),
    click.option(
        "--lens", is_flag=True, help="Estimate radial lens distortion, and its centre where it shows."
    ),
    click.option(
        "--joint-model",
        metavar="auto|LIST",
        help="Fit curves of the joints: those that the images show, or of scale, quadratic, cubic, harmonic, "
        "coupling, sag, such as scale:2,sag.",
    ),
    click.option(
        "--image-size",
        metavar="WxH[,WxH]",
        help="Size of the images, px, or of the left and the right ones. Default: that of cameras or rig.",
    ),
    force(help="Make the named stages even where they are up to date."),
    dry_run,
    threads(help="Threads. Default: all processors."),
    explained,
    click.pass_obj,  # the names of the stages of the call
)


def of_stages(function: _Function) -> _Function:
    """Give a stage the options of all stages, its console, and the names of the stages of the call."""
    for decorate in reversed(_OF_STAGES):
        function = decorate(function)
    return function


def require_new(path: Path, *, force: bool) -> None:
    """Refuse to replace existing files without ``--force``."""
    if path.exists() and not force:
        raise click.UsageError(f"{path}: exists already; choose another, or replace it with --force")


def one_run(command: str, run: Path | None, output: Path | None) -> Path | None:
    """The run that is named, as an argument or with ``-o``; None where none is."""
    if run is not None and output is not None:
        raise click.UsageError(f"{command} takes one run, as an argument or with -o")
    return run or output


def configured(
    config: str | None, options: Mapping[str, Any], run: Path | None = None, *, teaching: bool = False
) -> "Config":
    """The configuration in a file, else in a run, else that which is shipped, with what options say.

    teaching : goal and start may name files that are still to be taught.
    Raises UsageError where a robot is named by the run alone, which starts no code.
    """
    from projservo_cli.config import load_config, shipped
    from projservo_cli.store import stored

    held = None if config or run is None else stored(run)
    if held is None or not held.configuration:
        return load_config(config or shipped("paper"), _overrides(options), teaching=teaching)
    found = load_config(held.path, _overrides(options), text=held.configuration)
    if not found.plant.simulated:
        raise click.UsageError(
            f"plant {found.plant.use} is named by the stored run alone, which starts no code: give the "
            "configuration again with -c"
        )
    return found


def calibrated_run(run: Path | None, config: "Config") -> "Run | None":
    """The run that is named, by default that of the configuration's name; None without a calibration."""
    from projservo_cli.store import stored

    found = stored(run or _RESULTS / config.name)
    if run is not None and not found.path.exists():
        raise click.UsageError(f"{run}: there is no run; calibrate first, or leave it out")
    return found if "calibrate" in found.results else None


def resolve(options: Mapping[str, Any], *, recording: bool = False) -> tuple["Config", "Run"]:
    """The configuration with all overrides, and the run as stored so far.

    A table next to the run, or the one that a ``recording`` puts there, is that of the configuration unless
    it names another.
    """
    from projservo_cli.config import Override, load_config, to_yaml
    from projservo_cli.store import stored

    if options.get("origin") is not None:
        return _from_sweep(options)
    if options.get("refit") is not None:
        return _of_refit(options)
    run = stored(options["output"]) if options["output"] else None
    if not options["config"] and run is not None and run.configuration:
        config = load_config(run.path, _overrides(options), text=run.configuration)
    elif not options["config"] and options["data"]:
        config = load_config(None, _overrides(options))
    else:
        config = configured(options["config"], options)
    run = run or _run_of(options, config)
    table = run.path.resolve().with_name(_TRIALS)
    if config.data is None and (recording or table.is_file()):
        in_folder = Override(f"{table}", "data.table", str(table))
        config = load_config(config.name, [in_folder], text=to_yaml(config))
    return config, run


def _of_refit(options: Mapping[str, Any]) -> tuple["Config", "Run"]:
    """Configuration of a run with a camera fitted again, and another run that holds its calibration."""
    from projservo_cli.config import Override, load_config, stored_yaml
    from projservo_cli.store import Run, load, run_path, stored

    flag, before = f"--refit {options['refit']}", load(options["run"])
    if not options["data"] or not options["output"]:
        raise click.UsageError(f"{flag}: takes --data TABLE, images by that camera, and -o, another run")
    if run_path(options["output"]).resolve() == before.path.resolve():
        raise click.UsageError(f"{flag}: -o {options['output']} is the run itself; name another")
    for name in ("config", "mount", "joints", "noise_px", "lens", "init", "cross_validate", "image_size"):
        if options[name]:
            text = f"that of {before.path.parent} stands; leave it out"
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
    from projservo_cli.config import load_config, to_yaml
    from projservo_cli.store import Run
    from projservo_cli.sweeps.folder import run_of

    if options["config"]:
        raise click.UsageError("-c and --from: the configuration is that of the sweep; leave -c out")
    config, calibration = run_of(options["origin"])
    if overrides := _overrides(options):
        config = load_config(config.name, overrides, text=to_yaml(config))
    run = _run_of(options, config)
    before = run.results.get("calibrate")
    if calibration is not None and (before is None or before.key != calibration.key):
        run = Run(run.path, run.configuration, {"calibrate": calibration})
    return config, run


def _run_of(options: Mapping[str, Any], config: "Config") -> "Run":
    """The run where the user says, else in the folder of the configuration's name; empty where none is."""
    from projservo_cli.files import require_inside
    from projservo_cli.store import stored

    folder = options["output"]
    if not folder:
        folder = _RESULTS / config.name
        require_inside(folder, _RESULTS)
    return stored(folder)


def _overrides(options: Mapping[str, Any]) -> list["Override"]:
    """Options that stand for keys, then ``--set``, then ``--goal`` and ``--speed-scale``."""
    from projservo_cli.config import Override, to_goals

    found = []
    keys = {key: name for name, key in _KEYS.items() if not (name == "joint_unit" and "motions" in options)}
    for key, name in keys.items():
        given = options.get(name)
        if given is None or given is False:
            continue
        flag = f"--{name.replace('_', '-')}" + ("" if given is True else f" {given}")
        value = os.path.abspath(given) if name in ("data", "readings", "init") else given
        if name == "joint_model" and given != "auto":
            value = given.split(",")
        found.append(Override(flag, key, value))
    if (size := options.get("image_size")) is not None:  # such as 1280x1024,1280x960
        flag, sizes = f"--image-size {size}", [_SIZE.fullmatch(one) for one in size.split(",")]
        if None in sizes:
            raise click.UsageError(
                f"{flag}: expected width x height in px, such as 1280x1024, or where views differ one each, "
                "such as 1280x1024,1280x960"
            )
        values = [[int(one[1]), int(one[2])] for one in sizes if one is not None]
        found.append(Override(flag, "data.image_size_px", values if len(values) > 1 else values[0]))
    found += map(Override.parse, options["sets"])  # which would undo what follows
    if goals := options.get("goals"):
        found += to_goals(f"--goal {' --goal '.join(goals)}", goals)
    if (scale := options.get("speed_scale")) is not None:
        found.append(Override(f"--speed-scale {scale}", "plant.speed_scale", scale))
    return found
