"""The kernels of a sweep made by one process before many need them."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

from projservo_cli.geometry.jit import CACHE_FOLDER
from projservo_cli.sweep.design import Design, TaskSet, name_of_run
from projservo_cli.sweep.engine import LocalEngine, completed
from projservo_cli.sweep.preparation import Wanted, calibrate_one
from projservo_cli.sweep.runs import Part, compiled_by, run_part

# Indices of the machine code of the closed loop, by whether many runs are made in one call.
LOOPS = ("compiled.run-*.nbi", "trial.without_rehearsal-*.nbi")


class First(NamedTuple):
    """What is made first: a sweep, and the random tasks of its bases."""

    design: Design
    tasks: Mapping[int, TaskSet]


def compile_once(
    design: Design, tasks: Mapping[int, TaskSet], engine: LocalEngine, say: Callable[[str], None]
) -> None:
    """Fill an empty cache by one process, where several would each compile the same.

    That process ends here: the compiler keeps hundreds of megabytes.
    """
    loop = LOOPS[compiled_by(design, design.cell(0))]
    if engine.workers == 1 or CACHE_FOLDER is None or any(CACHE_FOLDER.rglob(loop)):
        return
    say("compiling kernels, once, before the processes start")
    for _ in completed(engine, first_runs, [First(design, tasks)]):
        engine.close()


def first_runs(first: First) -> int:
    """One calibration and a run of each law with it, for the kernels they leave; the number of runs."""
    design = first.design
    records = calibrate_one(Wanted(design.calibration_key(0, 0), design.calibrated(0, 0))).records
    calibration = None if records is None else records[1]
    cells = range(design.cells // len(design.bases))
    by_law = {name_of_run(design.cell(cell)): cell for cell in reversed(cells)}
    for cell in by_law.values():
        run = cell * design.sweep.runs
        run_part(Part(design, run, run + 1, {design.calibration_key(cell, 0): calibration}, first.tasks))
    return len(by_law)
