"""``projservo sweep``: many closed-loop runs over a grid and random draws, to one table; and their report."""

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import click

from projservo_cli.cli import options as option
from projservo_cli.cli.group import main
from projservo_cli.cli.output import Console, wrapped


@main.command(epilog="Example: projservo sweep -c configs/sweep_noise.yaml -j 2")
@option.configuration("Configuration of the sweep (YAML).", required=True)
@option.override
@option.output("DIR", "Folder of the sweep. Default: results/<name of the sweep>.")
@option.force("Begin anew, whatever is in the folder.")
@option.dry_run
@option.threads("Processes. Default: all processors.")
@click.option(
    "--scheduler",
    metavar="ADDRESS",
    help="The Dask scheduler whose workers do the work, such as tcp://host:8786.",
)
@option.told
def sweep(
    console: Console,
    *,
    config: str,
    sets: tuple[str, ...],
    output: Path | None,
    force: bool,
    dry_run: bool,
    threads: int | None,
    scheduler: str | None,
) -> None:
    """Make many runs over a grid of values and random draws.

    Makes the runs of a sweep (configs/sweep_noise.yaml shows one) in parts that are stored as they are done,
    and assembles them to one table, sweep.h5, which xarray.open_dataset reads. Interrupted or killed, the
    same command goes on where it was. What a run does depends on its number alone: projservo servo --from
    SWEEP:INDEX makes any of them anew.

    projservo report SWEEP writes statistics and figures. With --scheduler the workers of a Dask cluster do
    the work; it needs pip install 'projservo[cluster]' here and there.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # in the processes to come, from their beginning
    from projservo_cli.config.sweep import load_sweep
    from projservo_cli.files import require_writable, working_in
    from projservo_cli.records import InputError
    from projservo_cli.sweep.design import read_design
    from projservo_cli.sweep.engine import Cluster, Engine
    from projservo_cli.sweep.folder import Folder, run_sweep

    design = read_design(load_sweep(config, sets))
    folder = Folder(output or Path("results") / design.sweep.name)
    status = folder.status(design, force=force)
    if not (dry_run or status.complete):
        if scheduler is not None and threads is not None:
            raise InputError(
                "-j and --scheduler: the workers of a scheduler are as many as it has; leave -j out"
            )
        require_writable(folder.table)
        engine = Cluster(scheduler) if scheduler else Engine(threads or os.cpu_count() or 1)
        where = f"{engine.workers} workers of {scheduler}" if scheduler else "here"
        console.say(f"{design.total} runs, {design.sweep.runs} in each of {design.cells} cells, {where}")
        try:
            with working_in(folder.path, "parts", "calibrations"):
                status = run_sweep(design, folder, engine, console.progress, console.say, force=force)
        except KeyboardInterrupt:
            console.say(f"{folder.table}: the runs done so far; the same command goes on with the others")
            raise
    table = folder.table.resolve() if folder.table.exists() else None
    value = {
        "sweep": folder.path.resolve(),
        "table": table,
        "dry_run": dry_run,
        "complete": status.complete,
        "runs": status.total,
        "done": status.done,
        "cells": design.cells,
        "axes": {axis.name: list(axis.values) for axis in design.axes},
    }
    left = (
        f"{status.total - status.done} runs are left" if status.done < status.total else "all runs are done"
    )
    words = [f"sweep: {status.total} runs in {design.cells} cells, {left}"]
    console.tell(value, [*words, *([f"table: {folder.table}"] if table else [])])


_UNUSED = ("config", "sets", "output", "data", "dry_run", "view", "animation")


def tell_report(console: Console, sweep: Path, options: Mapping[str, Any]) -> int:
    """Write the report of a sweep and print its tables; the exit code."""
    from projservo_cli.files import working_in
    from projservo_cli.records import InputError
    from projservo_cli.report.style import FORMATS
    from projservo_cli.sweep.folder import Folder
    from projservo_cli.sweep.statistics import report

    for name in _UNUSED:
        if options[name]:
            flag = name.replace("_", "-").removesuffix("s")
            raise InputError(f"--{flag}: not used by report {sweep}, which is of a sweep")
    folder = Folder(sweep)
    with working_in(folder.path):
        found, files = report(folder.assembled(), FORMATS, console.progress)
    value = {"sweep": folder.path.resolve(), **found, "files": [path.resolve() for path in files]}
    names = ", ".join(path.name for path in files)
    console.tell(value, [*_words(found), wrapped(f"files: {folder.path}: {names}")])
    return 0


def _words(found: dict[str, Any]) -> Iterator[str]:
    """The table of cells, and that of pairs of laws on the same tasks."""
    yield (
        f"report: {found['runs']} of {found['total']} runs; shares in %, 95 % interval; "
        "medians of converged runs"
    )
    cells, pairs = found["cells"], found["paired"]
    known = ("cell", "runs", "converged", "success_rate", "success_interval", "verdicts", "quantiles")
    axes = [name for name in cells[0] if name not in known and not name.endswith("_rate")]
    widths = [max(len(name), *(len(str(cell[name])) for cell in cells)) + 2 for name in axes]
    head = "".join(f"{name:<{width}}" for name, width in zip(axes, widths, strict=True))
    yield f"  {head}{'converged %':>15}{'hidden':>7}{'outside':>8}{'steps':>6}{'mm':>8}{'path':>7}"
    for cell in cells:
        low, high = (100.0 * value for value in cell["success_interval"])
        rate = f"{100.0 * cell['success_rate']:.1f} ({low:.0f}-{high:.0f})"
        quantiles = (("steps", 6), ("position_error_mm", 8), ("path_length_ratio", 7))
        medians = ((cell["quantiles"][name]["0.5"], width) for name, width in quantiles)
        numbers = "".join(f"{'-' if m is None else format(m, '.3g'):>{width}}" for m, width in medians)
        text = "".join(f"{cell[name]!s:<{width}}" for name, width in zip(axes, widths, strict=True))
        hidden, outside = 100.0 * cell["self_occluded_rate"], 100.0 * cell["left_image_rate"]
        yield f"  {text}{rate:>15}{hidden:>7.1f}{outside:>8.1f}{numbers}"
    if pairs:
        yield "paired on the same tasks: both converged, only the first, only the second,"
        yield "neither; p: chance if alike"
    measured = ("laws", "pairs", "both", "only", "neither", "p_success", "median_difference", "p_difference")
    for pair in pairs:
        where = ", ".join(f"{name} {value}" for name, value in pair.items() if name not in measured)
        counts = f"{pair['both']}, {pair['only'][0]}, {pair['only'][1]}, {pair['neither']}"
        laws = " : ".join(pair["laws"]) + (f" ({where})" if where else "")
        yield f"  {laws}: {counts}; p {pair['p_success']:.2g}"
