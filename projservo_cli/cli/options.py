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
    from projservo_cli.store.run_file import Run

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
RESULTS = Path("results")
_UNNAMED = "projservo: configuration"  # whether a call takes that which is shipped, as it names none
_SIZE = re.compile(r"(?:([^=]*)=)?\s*(\d+)\s*[xX]\s*(\d+)\s*")
_KEYS = {  # keys that options set
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
dictionary = functools.partial(
    click.option, "--dictionary", metavar="NAME", default="4X4_50", show_default=True
)
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
    """Refuse an option that asks a question without a terminal."""
    del context
    if value and not sys.stdin.isatty():
        what = "standard input is no terminal, so no question can be asked; leave it out"
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


def require_new(path: Path, *, force: bool) -> None:
    """Refuse to replace existing files without ``--force``."""
    if path.exists() and not force:
        raise click.UsageError(f"{path}: exists already; choose another, or replace it with --force")


def one_run(command: str, run: Path | None, output: Path | None) -> Path | None:
    """The run that is named, as an argument or with ``-o``; None if none is."""
    if run is not None and output is not None:
        raise click.UsageError(f"{command} takes one run, as an argument or with -o")
    return run or output


def configured(
    config: str | None, options: Mapping[str, Any], run: Path | None = None, *, teaching: bool = False
) -> "Config":
    """The configuration of a file, a run, or else the shipped one, with the options applied.

    teaching : goal and start may name files that are still to be taught.
    Raises UsageError if a robot is named by the run alone, which starts no code.
    """
    from projservo_cli.config import load_config, shipped
    from projservo_cli.store.run_file import stored

    of_run = None if config or run is None else stored(run)
    if of_run is None or not of_run.configuration:
        click.get_current_context().meta[_UNNAMED] = config is None
        return load_config(config or shipped("paper"), overrides(options), teaching=teaching)
    found = load_config(of_run.path, overrides(options), text=of_run.configuration)
    if not found.plant.simulated:
        raise click.UsageError(
            f"plant {found.plant.use} is named by the stored run alone, which starts no code: give the "
            "configuration again with -c"
        )
    return found


def say_unnamed(console: Console) -> None:
    """Say, once, that a call names no configuration, if it takes that which is shipped."""
    if click.get_current_context().meta.pop(_UNNAMED, False):
        console.say("configuration: paper.yaml, as shipped; projservo init writes yours (-c FILE)")


def calibrated_run(run: Path | None, config: "Config") -> "Run | None":
    """The run that is named, by default of the configuration's name; None without a calibration."""
    from projservo_cli.store.run_file import stored

    found = stored(run or RESULTS / config.name)
    if run is not None and not found.path.exists():
        raise click.UsageError(f"{run}: there is no run; calibrate first, or leave it out")
    return found if "calibrate" in found.results else None


def overrides(options: Mapping[str, Any]) -> list["Override"]:
    """Options that set keys, then ``--set``, then ``--goal`` and ``--speed-scale``."""
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
        flag, parts = f"--image-size {size}", [_SIZE.fullmatch(one) for one in size.split(",")]
        sizes = [(one[1], [int(one[2]), int(one[3])]) for one in parts if one is not None]
        names = [name.strip() for name, _ in sizes if name is not None]
        if len(sizes) < len(parts) or len({*names}) not in (0, len(parts)):
            raise click.UsageError(
                f"{flag}: expected width x height in px, such as 1280x1024, or where views differ one each, "
                "such as 1280x1024,1280x960 or left=1280x1024,right=1280x960"
            )
        values: Any = [one for _, one in sizes]
        values = dict(zip(names, values, strict=True)) if names else values if len(values) > 1 else values[0]
        found.append(Override(flag, "data.image_size_px", values))
    if (text := options.get("intrinsics")) is not None:
        from projservo_cli.records import ONLY

        named = [one.rpartition("=")[::2] for one in text.split(",")]
        given = {name or ONLY: os.path.abspath(file) for name, file in named}
        found.append(Override(f"--intrinsics {text}", "calibration.intrinsics", given))
    if (text := options.get("board")) is not None:
        from projservo_cli.detection.finders import Board

        board = Board.of(text)
        rows, columns = board.shape
        shape = {"columns": columns, "rows": rows, "pitch_mm": board.pitch_mm, "staggered": board.staggered}
        found.append(Override(f"--board {text}", "markers.boards", [shape]))
    found += map(Override.parse, options["sets"])  # undoes earlier overrides of its key
    if goals := options.get("goals"):
        found += to_goals(f"--goal {' --goal '.join(goals)}", goals)
    if (scale := options.get("speed_scale")) is not None:
        found.append(Override(f"--speed-scale {scale}", "plant.speed_scale", scale))
    return found
