"""A sweep from its design to its table, in parts that outlive whatever happens."""

import math
import shutil
from collections.abc import Callable
from contextlib import closing

import numpy as np
from threadpoolctl import threadpool_limits

from projservo_cli.config import Config
from projservo_cli.geometry.jit import CACHE_FOLDER
from projservo_cli.records import WorkFailed
from projservo_cli.stages import Progress, calibrate
from projservo_cli.store import write_part
from projservo_cli.sweep.design import Design, name_of_run
from projservo_cli.sweep.engine import Engine
from projservo_cli.sweep.folder import Calibrated, Folder, Status
from projservo_cli.sweep.runs import Part, is_compiled, run_part

PARTS = 4  # of each worker at least
# Runs that take a second or two, by whether many have all but their images in common.
SHARED, OWN = 2_000, 100
CALIBRATIONS = 8  # that one process makes in less time than it takes to start another
SETTINGS = 64  # as many of a cell, and a part has many runs of each, nearly all of whose time is compiled
# Indices of the machine code of the closed loop, by whether many runs are made in one call.
LOOPS = ("compiled.run-*.nbi", "trial.without_rehearsal-*.nbi")


def run(
    design: Design,
    folder: Folder,
    engine: Engine,
    progress: Progress,
    say: Callable[[str], None],
    *,
    force: bool = False,
) -> Status:
    """Make the runs of a sweep that are not stored yet, and the table.

    Raises InputError if the folder holds another sweep, a file cannot be written, or a drawn value is
    invalid; WorkFailed if tasks cannot be drawn, or workers are lost again and again; what was stored is
    kept; KeyboardInterrupt after the table of what was stored has been assembled.
    """
    status = folder.status(design, force=force)
    if status.complete:
        return status
    if force:
        folder.clear()
    try:
        _make(design, folder, engine, status, progress, say)
    except KeyboardInterrupt:
        if folder.stored():
            folder.assemble(design)
        raise
    finally:
        engine.close()
    folder.assemble(design)
    shutil.rmtree(folder.parts)
    return Status(design.total, design.total, status.chunk, complete=True)


def _make(
    design: Design,
    folder: Folder,
    engine: Engine,
    status: Status,
    progress: Progress,
    say: Callable[[str], None],
) -> None:
    """Calibrations and parts that are missing."""
    for base in range(len(design.bases) if design.sweep.tasks else 0):
        design.tasks(base)  # or say that there are none, before anything else is made
    _compile_once(design, engine, say)
    wanted = folder.missing_calibrations(design)
    most = 1 + len(wanted) // CALIBRATIONS
    with closing(engine.completed(calibrate_one, wanted, most=most)) as calibrated:
        for count, one in enumerate(calibrated):
            folder.keep_calibration(one)
            progress("calibrations", count + 1, len(wanted))
    calibrations = folder.calibrations(design)

    def part(first: int, last: int) -> Part:
        at = design.placed(np.arange(first, last))
        pairs = zip(at["cell"].tolist(), at["calibration"].tolist(), strict=True)
        keys = {design.calibration_key(*pair) for pair in set(pairs)}
        return Part(design, first, last, {key: calibrations[key] for key in keys})

    threads = _shares_settings(design)
    chunk = status.chunk or design.sweep.chunk
    if not chunk:
        chunk = min(SHARED if threads else OWN, math.ceil(design.total / (PARTS * engine.workers)))
    if not status.chunk:
        folder.begin(design, chunk)
    if status.done:
        say(f"{status.done} of {status.total} runs are stored already")
    done, left = 0, status.total - status.done
    progress("runs", 0, left)
    parts = (part(*pair) for pair in folder.missing(design, chunk))
    with closing(engine.completed(run_part, parts, threads=threads)) as made_parts:
        for made in made_parts:
            write_part(folder.part(made.first, made.last), made.columns, made.traces)
            done += made.last - made.first
            progress("runs", done, left)


def _shares_settings(design: Design) -> bool:
    """Whether all runs are compiled ones, of which many differ in nothing but their images."""
    tasks = design.sweep.tasks.random if design.sweep.tasks is not None else 1
    settings = math.lcm(design.sweep.calibrations, tasks)
    if design.sweep.random or settings > SETTINGS or design.sweep.runs < settings:
        return False
    return all(is_compiled(design, design.cell(cell)) for cell in range(design.cells))


def calibrate_one(wanted: tuple[str, Config]) -> Calibrated:
    """Make the calibration of a key, on one thread like all that must be the same to the bit."""
    with threadpool_limits(1):
        try:
            return Calibrated(*wanted, calibrate.run(wanted[1]))
        except WorkFailed as error:
            return Calibrated(*wanted, None, str(error))


def _compile_once(design: Design, engine: Engine, say: Callable[[str], None]) -> None:
    """Fill an empty cache by one process, where several would each compile the same.

    That process ends here: the compiler keeps hundreds of megabytes.
    """
    loop = LOOPS[is_compiled(design, design.cell(0))]
    if not engine.here or engine.workers == 1 or CACHE_FOLDER is None or any(CACHE_FOLDER.rglob(loop)):
        return
    say("compiling kernels, once, before the processes start")
    with closing(engine.completed(_first_runs, [design])) as made:
        list(made)


def _first_runs(design: Design) -> None:
    """One calibration and a run of each law with it, for the kernels they leave."""
    records = calibrate_one((design.calibration_key(0, 0), design.calibrated(0, 0))).records
    calibration = None if records is None else records[1]
    cells = range(design.cells // len(design.bases))
    by_law = {name_of_run(design.cell(cell)): cell for cell in reversed(cells)}
    for cell in by_law.values():
        run = cell * design.sweep.runs
        run_part(Part(design, run, run + 1, {design.calibration_key(cell, 0): calibration}))
