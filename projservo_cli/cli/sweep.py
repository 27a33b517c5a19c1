"""``projservo sweep``: many closed-loop runs over a grid and random draws, to one table."""

import os
from pathlib import Path
from typing import Any

import click

from projservo_cli.cli.output import Console, print_json
from projservo_cli.records import InputError


def run(names: list[str], rest: list[str], options: dict[str, Any]) -> int:
    """Make the runs that are not stored yet, and the table; the exit code."""
    del names, rest
    if not options["config"]:
        raise click.UsageError("sweep needs a configuration: projservo sweep -c configs/sweep_noise.yaml")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # in the processes to come, from their beginning
    from projservo_cli.config.sweep import load_sweep
    from projservo_cli.files import require_writable
    from projservo_cli.lock import working_in
    from projservo_cli.sweep.again import folder_of
    from projservo_cli.sweep.design import read_design
    from projservo_cli.sweep.driver import run as run_sweep
    from projservo_cli.sweep.driver import status_of
    from projservo_cli.sweep.engine import engine_for

    console = Console(quiet=options["quiet"], verbose=options["verbose"])
    design = read_design(load_sweep(options["config"], options["sets"]))
    folder = folder_of(options["output"] or Path("results") / design.sweep.name)
    status = status_of(design, folder, force=options["force"])
    if options["dry_run"] or status.complete:
        return _tell(console, design, folder, status, options)
    if options["scheduler"] is not None and options["threads"] is not None:
        raise InputError("-j and --scheduler: the workers of a scheduler are as many as it has; leave -j out")
    require_writable(folder.table)
    engine = engine_for(options["threads"] or os.cpu_count() or 1, options["scheduler"])
    where = f"{engine.workers} workers of {options['scheduler']}" if options["scheduler"] else "here"
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
