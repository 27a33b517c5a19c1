"""``projservo sweep``: many closed-loop runs over a grid and random draws, to one table."""

import os
from pathlib import Path
from typing import Any

import click

from projservo_cli.cli.options import wrapped
from projservo_cli.cli.output import Console, print_json
from projservo_cli.records import InputError


def run(names: list[str], rest: list[str], options: dict[str, Any]) -> int:
    """Make the runs that are not stored yet, and the table; the exit code."""
    del names, rest
    if not options["config"]:
        raise click.UsageError("sweep needs a configuration: projservo sweep -c configs/sweep_noise.yaml")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # in the processes to come, from their beginning
    from projservo_cli.config.sweep import load_sweep
    from projservo_cli.files import require_writable, working_in
    from projservo_cli.sweep.design import read_design
    from projservo_cli.sweep.driver import run as run_sweep
    from projservo_cli.sweep.engine import Cluster, Engine
    from projservo_cli.sweep.folder import Folder

    console = Console(quiet=options["quiet"], verbose=options["verbose"])
    design = read_design(load_sweep(options["config"], options["sets"]))
    folder = Folder(options["output"] or Path("results") / design.sweep.name)
    status = folder.status(design, force=options["force"])
    if options["dry_run"] or status.complete:
        return _tell(console, design, folder, status, options)
    if options["scheduler"] is not None and options["threads"] is not None:
        raise InputError("-j and --scheduler: the workers of a scheduler are as many as it has; leave -j out")
    require_writable(folder.table)
    scheduler = options["scheduler"]
    engine = Cluster(scheduler) if scheduler else Engine(options["threads"] or os.cpu_count() or 1)
    where = f"{engine.workers} workers of {scheduler}" if scheduler else "here"
    console.say(f"{design.total} runs, {design.sweep.runs} in each of {design.cells} cells, {where}")
    try:
        with working_in(folder.path, "parts", "calibrations"):
            status = run_sweep(design, folder, engine, console.progress, console.say, force=options["force"])
    except KeyboardInterrupt:
        console.finish()
        console.say(f"{folder.table}: the runs done so far; the same command goes on with the others")
        raise
    finally:
        console.finish()
    return _tell(console, design, folder, status, options)


def _tell(console: Console, design: Any, folder: Any, status: Any, options: dict[str, Any]) -> int:
    """Say how far the sweep is and where its table lies."""
    if options["json"]:
        print_json(
            {
                "sweep": folder.path.resolve(),
                "table": folder.table.resolve() if folder.table.exists() else None,
                "dry_run": options["dry_run"],
                "complete": status.complete,
                "runs": status.total,
                "done": status.done,
                "cells": design.cells,
                "axes": {axis.name: list(axis.values) for axis in design.axes},
            }
        )
        return 0
    left = (
        "all runs are done" if status.done == status.total else f"{status.total - status.done} runs are left"
    )
    console.show(f"sweep: {status.total} runs in {design.cells} cells, {left}")
    if folder.table.exists():
        console.show(f"table: {folder.table}")
    return 0


UNUSED = ("config", "sets", "output", "data", "dry_run", "view", "animation")


def run_report(names: list[str], rest: list[str], options: dict[str, Any]) -> int:
    """Write the report and print the tables; the exit code."""
    del names
    for name in UNUSED:
        if options[name]:
            flag = name.replace("_", "-").removesuffix("s")
            raise InputError(f"--{flag}: not used by report {rest[0]}, which is of a sweep")
    from projservo_cli.files import working_in
    from projservo_cli.report.style import FORMATS
    from projservo_cli.sweep.folder import Folder
    from projservo_cli.sweep.report import report

    console = Console(quiet=options["quiet"], verbose=options["verbose"])
    folder = Folder(rest[0])
    try:
        with working_in(folder.path):
            found, files = report(folder, FORMATS, console.progress)
    finally:
        console.finish()
    if options["json"]:
        print_json({"sweep": folder.path.resolve(), **found, "files": [path.resolve() for path in files]})
        return 0
    console.show(
        f"report: {found['runs']} of {found['total']} runs; shares in %, 95 % interval; "
        "medians of converged runs"
    )
    for line in (*_cells(found["cells"]), *_pairs(found["paired"])):
        console.show(line)
    console.show(wrapped(f"files: {folder.path}: {', '.join(path.name for path in files)}"))
    return 0


def _cells(cells: list[dict[str, Any]]) -> list[str]:
    known = ("cell", "runs", "converged", "success_rate", "success_interval", "verdicts", "quantiles")
    axes = [name for name in cells[0] if name not in known and not name.endswith("_rate")]
    widths = [max(len(name), *(len(str(cell[name])) for cell in cells)) + 2 for name in axes]
    head = "".join(f"{name:<{width}}" for name, width in zip(axes, widths, strict=True))
    lines = [f"  {head}{'converged %':>15}{'hidden':>7}{'outside':>8}{'steps':>6}{'mm':>8}{'path':>7}"]
    for cell in cells:
        low, high = (100.0 * value for value in cell["success_interval"])
        rate = f"{100.0 * cell['success_rate']:.1f} ({low:.0f}-{high:.0f})"
        middle = [
            cell["quantiles"][name]["0.5"] for name in ("steps", "position_error_mm", "path_length_ratio")
        ]
        numbers = [
            f"{'-' if value is None else format(value, '.3g'):>{w}}"
            for value, w in zip(middle, (6, 8, 7), strict=True)
        ]
        text = "".join(f"{cell[name]!s:<{width}}" for name, width in zip(axes, widths, strict=True))
        hidden, outside = 100.0 * cell["self_occluded_rate"], 100.0 * cell["left_image_rate"]
        lines.append(f"  {text}{rate:>15}{hidden:>7.1f}{outside:>8.1f}{''.join(numbers)}")
    return lines


def _pairs(pairs: list[dict[str, Any]]) -> list[str]:
    lines = [
        "paired on the same tasks: both converged, only the first, only the second,",
        "neither; p: chance if alike",
    ]
    for pair in pairs:
        known = ("laws", "pairs", "both", "only", "neither", "p_success", "median_difference", "p_difference")
        where = ", ".join(f"{name} {value}" for name, value in pair.items() if name not in known)
        counts = f"{pair['both']}, {pair['only'][0]}, {pair['only'][1]}, {pair['neither']}"
        laws = " : ".join(pair["laws"]) + (f" ({where})" if where else "")
        lines.append(f"  {laws}: {counts}; p {pair['p_success']:.2g}")
    return lines if pairs else []
