"""``projservo sweep``: many closed-loop runs over a grid and random draws, to one table; and their report."""

import os
from pathlib import Path

import click

from projservo_cli.cli import options as option
from projservo_cli.cli.output import Console
from projservo_cli.cli.program import main


@main.command("sweep", epilog="Example: projservo sweep -c configs/sweep_noise.yaml -j 2")
@option.configuration(help="Configuration of the sweep (YAML).", required=True)
@option.override
@option.output(metavar="DIR", help="Folder of the sweep. Default: results/<name of the sweep>.")
@option.force(help="Start again, although the folder has runs.")
@option.dry_run
@option.threads(help="Processes. Default: all processors.")
@click.option(
    "--scheduler",
    metavar="ADDRESS",
    help="The Dask scheduler whose workers do the work, such as tcp://host:8786.",
)
@option.explained
def _sweep(
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
    same command goes on where it was. A run depends on its number alone: projservo servo --from
    SWEEP:INDEX repeats any of them.

    projservo report SWEEP writes statistics and figures. With --scheduler the workers of a Dask cluster do
    the work; it needs pip install '.[cluster]' here and there.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # also for child processes, from their start
    from projservo_cli.config import load_sweep
    from projservo_cli.store.files_and_locks import working_in
    from projservo_cli.store.sweep_table import SweepTable
    from projservo_cli.sweeps.design import read_design
    from projservo_cli.sweeps.folder import Folder, run_sweep
    from projservo_cli.sweeps.workers import Cluster, Engine

    design = read_design(load_sweep(config, sets))
    folder = Folder(output or Path("results") / design.sweep.name)
    status = folder.status(design, force=force)
    if not (dry_run or status.complete):
        if scheduler is not None and threads is not None:
            raise click.UsageError(
                "-j and --scheduler: the workers of a scheduler are as many as it has; leave -j out"
            )
        engine = Cluster(scheduler) if scheduler else Engine(threads or os.cpu_count() or 1)
        where = f"{engine.workers} workers of {scheduler}" if scheduler else "here"
        console.say(f"{design.total} runs, {design.sweep.runs} in each of {design.cells} cells, {where}")
        try:
            with working_in(folder.path, "parts", "calibrations"):
                status = run_sweep(design, folder, engine, console.progress, console.say, force=force)
        except KeyboardInterrupt:
            console.say(f"{folder.table}: the runs done so far; the same command goes on with the others")
            raise
        for law, failure in SweepTable(folder.table).failures.items():
            console.say(f"law {law}: {failure.words}")
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
    left = status.total - status.done
    state = f"{left} runs are left" if left else "all runs are done"
    words = [f"sweep: {status.total} runs in {design.cells} cells, {state}"]
    console.report(value, [*words, *([f"table: {folder.table}"] if table else [])])
