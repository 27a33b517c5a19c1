"""The installation and how to begin with it: ``init``, ``schema``, ``doctor`` and ``bench``."""

import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click

from projservo_cli.cli import options as option
from projservo_cli.cli.output import Console, wrapped
from projservo_cli.cli.program import FAILED, main
from projservo_cli.provenance import __version__, version_of

_STARTER, _SCHEMA = "projservo.yaml", "projservo.schema.json"  # as the first line of the starter names it
_MACHINE = ("projservo", "python", "numpy", "numba", "llvmlite", "system", "cpu", "cpu_count", "date", "jit")


@main.command("init", epilog="Example: projservo init mine.yaml")
@click.argument("file", default=_STARTER, type=option.PATH)
@click.option(
    "--arm",
    metavar="KIND",
    type=click.Choice(["so101"]),
    help="For an arm that people build, with two webcams: so101. Default: a simulated robot.",
)
@option.force(help="Replace the file if there is one.")
@option.explained
def _init(console: Console, *, file: Path, arm: str | None, force: bool) -> None:
    """Write a commented configuration to start from.

    Writes a configuration that runs as it is, with a comment on every key, and next to it the schema by which
    editors complete and check it.
    """
    from projservo_cli.config.schema import as_text, json_schema, starter
    from projservo_cli.store.files_and_locks import write_whole

    path = file / _STARTER if file.is_dir() else file
    if path.suffix not in (".yaml", ".yml"):
        raise click.UsageError(f"{path}: name a YAML file to write, such as {path.with_suffix('.yaml')}")
    option.require_new(path, force=force)
    described = path.with_name(_SCHEMA)
    write_whole(path, starter(arm))
    write_whole(described, as_text(json_schema()))
    words = [f"init: {path}, with {described} for editors"]
    if arm is None:
        words.append(f"next: projservo calibrate plan servo report -c {path}")
    else:
        words.append(f"next: set the sources of both cameras in {path}, then print the tags:")
        words.append("  projservo tags --kind roof --size-mm 30 -o tags.pdf")
    console.report({"configuration": path.resolve(), "schema": described.resolve()}, words)


@main.command("schema", epilog="Example: projservo schema -o schema.json")
@click.argument("what", required=False, metavar="[sweep]", type=click.Choice(["sweep"]))
@option.output(metavar="FILE", help="File to write. Default: standard output.")
@option.explained
def _schema(console: Console, *, what: str | None, output: Path | None) -> None:
    """Print the JSON Schema of the configuration.

    Editors that speak YAML complete and check a configuration whose first line names the schema: #
    yaml-language-server: $schema=FILE. That of sweeps is projservo schema sweep.
    """
    from projservo_cli.config.schema import as_text, json_schema, sweep_schema
    from projservo_cli.store.files_and_locks import write_whole

    schema = sweep_schema() if what else json_schema()
    if output is None:
        console.as_json = True
        console.report(schema, ())
    else:
        write_whole(output, as_text(schema))


@main.command("doctor", epilog="Example: projservo doctor -c arm.yaml --move")
@click.argument("run", required=False, type=option.PATH)
@option.configuration(help="Configuration (YAML) of a robot to check. Default: check the installation.")
@option.override
@option.output(metavar="FILE", help="Page to write. Default: preflight.html.")
@option.asking("--move", help="Ask, then move each joint by 3° or 16 mm to either side.")
@click.option("--watch", is_flag=True, help="Show both images in a browser of this machine until Ctrl-C.")
@option.explained
def _doctor(
    console: Console,
    *,
    run: Path | None,
    config: str | None,
    sets: tuple[str, ...],
    output: Path | None,
    move: bool,
    watch: bool,
) -> int:
    """Report installed packages, or check a robot and its cameras.

    Lists versions, extras, whether the kernels are compiled, and the folder of results. Exit code 1 when
    a required part is missing.

    With -c it opens robot and cameras, moves nothing, and writes a table and a page with both pictures: frame
    rates, exposure, sharpness, tags, joints, limits, each finding with its remedy. With a calibration in RUN,
    by default the run of the configuration's name in results, it says whether images still agree. If one
    camera moved, it writes refit_poses.csv, the poses to fit it again from. --move measures latency,
    hysteresis, sag, and whether tags sit fast. Exit code 1 if a recording would fail.
    """
    if config is not None:
        from projservo_cli.cli.tags_doctor import doctor

        options = {"sets": sets, "move": move, "watch": watch}
        return doctor(console, run, config, options, output or Path("preflight.html"))
    if run is not None or sets or output is not None or move or watch:
        raise click.UsageError("doctor checks a robot with -c alone: projservo doctor -c arm.yaml")
    packages, optional = _requirements()
    missing = [name for name, version in packages.items() if version is None]
    folder = Path("results").absolute()
    there = next(path for path in (folder, *folder.parents) if path.exists())
    writable = there.is_dir() and os.access(there, os.W_OK | os.X_OK)
    value: dict[str, Any] = {
        "projservo": __version__,
        "package": Path(__file__).resolve().parents[1],
        "python": ".".join(map(str, sys.version_info[:3])),
        "interpreter": sys.executable,
        "processors": os.cpu_count(),
        "packages": packages,
        "missing": missing,
        "extras": {name: sorted(lacking) for name, lacking in optional.items()},
        "kernels": None,
        "results": {"folder": folder, "writable": writable},
    }
    if not missing:
        from projservo_cli.geometry.jit import CACHE_FOLDER, COMPILED

        count = 0 if CACHE_FOLDER is None else sum(1 for _ in CACHE_FOLDER.rglob("*.nbi"))
        value["kernels"] = {"jit": COMPILED, "cache": CACHE_FOLDER, "compiled": count}
    console.report(value, map(wrapped, _found(value)))
    return FAILED if missing or not writable else 0


def _requirements() -> tuple[dict[str, str | None], dict[str, list[str]]]:
    """Versions of required packages, None if missing; and the missing packages of each extra."""
    import importlib.metadata
    import re

    try:
        needed = importlib.metadata.requires("projservo") or []
    except importlib.metadata.PackageNotFoundError:  # run from sources that were never installed
        needed = []
    packages: dict[str, str | None] = {}
    optional: dict[str, list[str]] = {}
    for text in needed:
        (name,) = re.findall(r"^[\w.-]+", text)
        extra = re.search(r"extra\s*==\s*['\"]([\w.-]+)['\"]", text)
        version = version_of(name)
        if extra is None:
            packages[name] = version
        else:
            optional.setdefault(extra[1], []).extend([name] if version is None else [])
    return packages, optional


def _found(value: dict[str, Any]) -> Iterator[str]:
    yield f"projservo {value['projservo']} in {value['package']}"
    yield f"python {value['python']} at {value['interpreter']}, {value['processors']} processors"
    versions = [f"{name} {version or 'MISSING'}" for name, version in value["packages"].items()]
    yield f"packages: {', '.join(versions) or 'unknown: projservo is not installed, only run'}"
    for name, lacking in value["extras"].items():
        lacks = f"lacks {', '.join(lacking)}: pip install '.[{name}]'"
        yield f"extra {name}: {lacks if lacking else 'installed'}"
    kernels, results = value["kernels"], value["results"]
    if kernels is None:
        explained = "unknown, packages are missing"
    elif not kernels["jit"]:
        explained = "not compiled at all: NUMBA_DISABLE_JIT is set"
    elif kernels["cache"] is None:
        explained = "compiled again in every run: no folder can be written; set PROJSERVO_CACHE_DIR"
    elif not kernels["compiled"]:
        explained = f"to be compiled by the first run, once, into {kernels['cache']}"
    else:
        explained = f"{kernels['compiled']} compiled, in {kernels['cache']}"
    yield f"kernels: {explained}"
    yield f"results: {results['folder']}{'' if results['writable'] else ', which CANNOT be written to'}"


@main.command("bench", epilog="Example: projservo bench --json")
@option.configuration(help="Configuration (YAML) with a simulated task. Default: paper.yaml.")
@option.override
@option.explained
def _bench(console: Console, *, config: str | None, sets: tuple[str, ...]) -> None:
    """Measure the speed of a control step and of a run.

    Times a step of every law in 256 states of a noisy run, a call from Python and a traced run of 150 steps,
    in turn with one numpy.linalg.svd of an 8x6 matrix.
    """
    from projservo_cli import provenance
    from projservo_cli.config.inputs import servo_inputs
    from projservo_cli.stages.bench import Case, timings

    console.say("compiling kernels if they are not in the cache, then measuring: half a minute")
    settings = option.configured(config, {"sets": sets})
    result = timings(Case(servo_inputs(settings)))
    collected = provenance.collect(seed=settings.seed)
    machine = {name: collected[name] for name in _MACHINE}
    console.report({**result, "machine": machine}, _timed(result, machine))


def _timed(result: dict[str, Any], machine: dict[str, Any]) -> Iterator[str]:
    yield f"{'':32}   min µs    median µs   quartiles µs      of one SVD"
    for name, times in result["times_us"].items():
        spread = f"{times['lower']:.2f} to {times['upper']:.2f}"
        numbers = f"{times['least']:10.2f} {times['median']:10.2f}   {spread:16}"
        yield f"{name:32} {numbers} {times['over_svd']:10.3f}"
    yield "{cpu}, {system}, numpy {numpy}, numba {numba}".format_map(machine)
