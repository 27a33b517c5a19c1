"""Options that several commands take, as decorators."""

import contextlib
import functools
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from projservo_cli.cli.output import Console

_Function = Callable[..., Any]
_Decorator = Callable[[_Function], _Function]

PATH = click.Path(path_type=Path)

override = click.option(
    "--set",
    "sets",
    metavar="A.B=V",
    multiple=True,
    help="Override a value of the configuration; V is YAML. Repeatable.",
)
joint_unit = click.option(
    "--joint-unit",
    type=click.Choice(["deg", "rad"]),
    help="Unit of the table's revolute joints. Default: rad.",
)
dry_run = click.option("-n", "--dry-run", is_flag=True, help="Say what would be done, do nothing.")
speed_scale = click.option(
    "--speed-scale", metavar="S", type=float, help="Scale every command by S, above 0 and at most 1."
)


def configuration(help: str, **settings: Any) -> _Decorator:
    """``-c``."""
    return click.option("-c", "--config", metavar="FILE", type=click.Path(), help=help, **settings)


def output(metavar: str, help: str, **settings: Any) -> _Decorator:
    """``-o``, a path."""
    return click.option("-o", "--output", metavar=metavar, type=PATH, help=help, **settings)


def force(help: str) -> _Decorator:
    """``--force``."""
    return click.option("--force", is_flag=True, help=help)


def threads(help: str) -> _Decorator:
    """``-j``."""
    return click.option("-j", "--threads", metavar="N", type=click.IntRange(1, 256), help=help)


def _with_terminal(context: click.Context, parameter: click.Parameter, value: bool) -> bool:
    """Refuse ``--confirm`` where nobody can answer."""
    del context, parameter
    if value and not sys.stdin.isatty():
        raise click.UsageError(
            "--confirm: standard input is no terminal, so nobody can be asked; leave it out"
        )
    return value


confirm = click.option(
    "--confirm", is_flag=True, callback=_with_terminal, help="Ask on the terminal before the first motion."
)


def told(function: _Function) -> _Function:
    """Give a command its console, made of ``--json``, ``-q`` and ``-v``, which all commands take.

    What a robot or a law of a user prints meanwhile goes to standard error: it is not what was asked for.
    """

    @click.option("--json", "as_json", is_flag=True, help="Print one JSON object on standard output.")
    @click.option("-q", "--quiet", is_flag=True, help="Print nothing but errors and what --json prints.")
    @click.option("-v", "--verbose", is_flag=True, help="Say more; show tracebacks.")
    @functools.wraps(function)
    def command(*arguments: Any, as_json: bool, quiet: bool, verbose: bool, **values: Any) -> Any:
        console = Console(quiet=quiet, verbose=verbose, as_json=as_json)
        with console, contextlib.redirect_stdout(sys.stderr):
            return function(console, *arguments, **values)

    return command


_OF_STAGES = (
    configuration("Configuration (YAML). Default: the one stored in the run that -o names, else paper.yaml."),
    override,
    click.option(
        "-o",
        "--output",
        metavar="DIR",
        type=click.Path(),
        help="Folder of the run, or its run.h5. Default: results/<configuration name>.",
    ),
    click.option("--data", metavar="TABLE", type=click.Path(), help="Calibrate from this table (CSV)."),
    click.option("--joints", metavar="RRPRRR", help="Type of each joint of the table. Default: all R."),
    joint_unit,
    click.option("--noise-px", metavar="S", type=float, help="Pixel noise of the table. Default: estimated."),
    click.option("--lens", is_flag=True, help="Estimate radial lens distortion, two coefficients a camera."),
    click.option(
        "--image-size",
        metavar="WxH",
        help="Size of the table's images, px. Default: that of rig, else from where markers were seen.",
    ),
    force("Make the named stages even where they are up to date."),
    dry_run,
    threads("Threads. Default: all processors."),
    told,
    click.pass_obj,  # the names of the stages of the call
)


def of_stages(function: _Function) -> _Function:
    """Give a stage the options of all stages, its console, and the names of the stages of the call."""
    for decorate in reversed(_OF_STAGES):
        function = decorate(function)
    return function


def require_new(path: Path, *, force: bool) -> None:
    """Refuse to replace unasked what is there.

    Raises InputError where it exists and ``--force`` was not given.
    """
    from projservo_cli.records import InputError

    if path.exists() and not force:
        raise InputError(f"{path}: exists already; choose another, or replace it with --force")


def one_run(command: str, run: Path | None, output: Path | None) -> Path | None:
    """The run that is named, as an argument or with ``-o``; None where none is."""
    if run is not None and output is not None:
        raise click.UsageError(f"{command} takes one run, as an argument or with -o")
    return run or output
