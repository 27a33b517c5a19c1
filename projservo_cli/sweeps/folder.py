"""The folder of a sweep: its manifest, progress and results, and the repetition of one run.

A manifest describes the rest. While a sweep runs there is a file for each part; a part that is there
is done, so after any end the same command goes on with the others. The table is assembled from them, and
when it is complete they are removed. Calibrations stay, to repeat any run.
"""

import json
import math
import shutil
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from projservo_cli import provenance
from projservo_cli.chain.outdated import inputs_of, result_of, steps_for
from projservo_cli.config import Config, stored_yaml
from projservo_cli.config.inputs import servo_inputs
from projservo_cli.geometry.jit import CACHE_FOLDER, is_cached
from projservo_cli.laws import codes_of
from projservo_cli.loop.batch import until_rehearsal
from projservo_cli.loop.compiled_loop import run_compiled
from projservo_cli.loop.jit_warmup import are_cached
from projservo_cli.records import Calibration, CrossValidation, InputError, Observation, WorkFailed
from projservo_cli.stages import Progress, calibrate
from projservo_cli.store.files_and_locks import write_whole
from projservo_cli.store.run_file import Result, Run, load, save
from projservo_cli.store.sweep_table import TABLE, SweepTable, assemble, write_part
from projservo_cli.sweeps.design import Design, name_of_run
from projservo_cli.sweeps.runs import Part, columns_of, is_compiled, run_part
from projservo_cli.sweeps.workers import Engine, versions

_REFUSED = ".refused"  # a calibration that cannot be made leaves a file with the reason
_PARTS = 4  # minimum number per worker
# Runs that take a second or two, by whether many have all but their images in common.
_SHARED, _OWN = 2_000, 100
_CALIBRATIONS = 8  # that one process makes in less time than it takes to start another
_SETTINGS = 64  # as many of a cell, and a part has many runs of each, nearly all of whose time is compiled


_Records = tuple[Observation, Calibration, CrossValidation | None]  # records of a calibration


class _Status(NamedTuple):
    """Progress of a sweep: stored and total runs; ``complete`` once its parts are merged."""

    done: int
    total: int
    chunk: int  # runs of a part; 0 before it began
    complete: bool = False


class Folder:
    """The folder of a sweep, by its name or its table's."""

    def __init__(self, target: Path | str) -> None:
        path = Path(target)
        self.path = path.parent if path.name == TABLE else path
        self.table = self.path / TABLE
        self.parts = self.path / "parts"
        self.manifest = self.path / "manifest.json"

    def part(self, first: int, last: int) -> Path:
        """File of the runs ``first`` to ``last`` - 1."""
        return self.parts / f"{first:010d}-{last:010d}.h5"

    def stored(self) -> list[Path]:
        """Parts that are done, in the order of their runs."""
        return sorted(self.parts.glob("[0-9]*-[0-9]*.h5"))

    def missing(self, design: Design, chunk: int) -> Iterator[tuple[int, int]]:
        """First run of each part that is not done, and the one after its last.

        Runs of one number in all cells come one after the other: they may share a plan, and an interrupted
        sweep has as many of each cell.
        """
        stored = set(self.stored())
        for first in sorted(range(0, design.total, chunk), key=lambda first: first % design.sweep.runs):
            last = min(first + chunk, design.total)
            if self.part(first, last) not in stored:
                yield first, last

    def status(self, design: Design, *, force: bool = False) -> _Status:
        """Return the progress of a sweep; refuse another sweep or other versions without ``force``."""
        total = design.total
        if not force and self.table.exists() and not self.manifest.exists():
            raise InputError(
                f"{self.table}: its {self.manifest.name} is missing; choose another folder, or use "
                "--force (force=True)"
            )
        if force or not self.manifest.exists():
            return _Status(0, total, 0)
        chunk = self._chunk(design)
        if self.table.exists() and SweepTable(self.table).rows == total:
            return _Status(total, total, chunk, complete=not self.stored())
        left = sum(last - first for first, last in self.missing(design, chunk))
        return _Status(total - left, total, chunk)

    def _chunk(self, design: Design) -> int:
        """Return the runs of a part; refuse runs of another configuration, or of other versions."""
        manifest, now = self._read(), versions()
        if manifest["key"] != design.key:
            raise InputError(
                f"{self.manifest}: of another configuration; choose another folder, or start again "
                "with --force (force=True)"
            )
        made_by = manifest.get("sources", {})
        changed = [law for law, source in design.sources.items() if source and source != made_by.get(law)]
        if changed:
            raise InputError(
                f"{self.manifest}: the source of {', '.join(changed)} changed since; choose another folder "
                "or start again with --force (force=True)"
            )
        made_with = manifest["provenance"]
        other = [f"{name} {made_with[name]}, now {now[name]}" for name in now if made_with[name] != now[name]]
        if other:
            raise InputError(
                f"{self.manifest}: made with {'; '.join(other)}: a sweep is not continued with other "
                "versions; start again with --force (force=True)"
            )
        return int(manifest["chunk"])

    def _read(self) -> dict[str, Any]:
        """Key and recipe of the design, runs per part, and versions."""
        if not self.manifest.exists():
            raise InputError(f"{self.path}: holds no sweep; make one with projservo sweep -c FILE")
        try:
            found: dict[str, Any] = json.loads(self.manifest.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise InputError(f"{self.manifest}: damaged; start again with --force (force=True)") from error
        return found

    def design(self) -> Design:
        """The design of the sweep that the folder holds."""
        return Design.made_of(self._read()["recipe"])

    def begin(self, design: Design, chunk: int) -> None:
        """Write the manifest."""
        origin = provenance.collect(seed=design.sweep.seed)
        values = {
            "key": design.key,
            "chunk": chunk,
            "provenance": origin,
            "sources": design.sources,
            "recipe": design.recipe,
        }
        write_whole(self.manifest, json.dumps(values))

    def clear(self) -> None:
        """Remove the files of a sweep of another configuration."""
        for folder in (self.parts, self.path / "calibrations"):
            shutil.rmtree(folder, ignore_errors=True)
        for path in (self.table, self.manifest):
            path.unlink(missing_ok=True)

    def assemble(self, design: Design) -> None:
        """Put the stored parts together to the table."""
        columns = columns_of(design)
        attributes = {
            "name": design.sweep.name,
            "key": design.key,
            "random": list(design.sweep.random),
            "axes": [[axis.name, list(axis.values)] for axis in design.axes],
            "columns": [column.name for column in columns],
            "provenance": self._read()["provenance"],
            "total": design.total,
        }
        assemble(self.table, self.stored(), columns, attributes)

    def assembled(self) -> Path:
        """The table of the runs that are done."""
        if self.stored():
            self.assemble(self.design())
        return self.table

    def calibration(self, key: str) -> Path:
        """Return the path of a calibration's run file, or of the file with the reason of its failure."""
        return self.path / "calibrations" / f"{key[:20]}.h5"

    def missing_calibrations(self, design: Design) -> list[tuple[str, Config]]:
        """Calibrations that are needed and not yet stored: their keys, and configurations that need them."""
        return [
            (key, config)
            for key, config in design.calibrations()
            if not any(self.calibration(key).with_suffix(kind).exists() for kind in (".h5", _REFUSED))
        ]

    def keep_calibration(self, key: str, config: Config, made: _Records | str) -> None:
        """Store a calibration as a separate run file, or the reason of its failure."""
        path = self.calibration(key)
        if isinstance(made, str):
            write_whole(path.with_suffix(_REFUSED), made + "\n")
            return
        (step,) = steps_for(config, Run(path), ["calibrate"])
        save(Run(path, stored_yaml(config), {"calibrate": result_of(step, config, *made)}))

    def calibrations(self, design: Design) -> dict[str, Calibration | None]:
        """Calibrations by their key, None if one was refused; with covariance if a plan needs it."""
        found: dict[str, Calibration | None] = {}
        whole = design.with_covariance()
        for key, _ in design.calibrations():
            made = load(path).calibration if (path := self.calibration(key)).exists() else None
            found[key] = made if made is None or key in whole else made.without_covariance()
        return found


def run_of(target: str) -> tuple[Config, Result | None]:
    """Configuration of the run SWEEP:INDEX, and its calibration, None if the sweep has not come to it."""
    sweep, _, index = target.rpartition(":")
    if not sweep or not index.isdecimal():
        raise InputError(f"--from {target}: expected SWEEP:INDEX, such as results/sweep_noise:17")
    folder = Folder(sweep)
    design = folder.design()
    run = int(index)
    cell, _, number, _ = design.numbers(run)
    config = design.config(run).model_copy(update={"name": f"{design.sweep.name}-{run}"})
    path = folder.calibration(design.calibration_key(cell, number))
    refused = path.with_suffix(_REFUSED)
    if refused.exists():
        raise WorkFailed(f"run {run}: {refused.read_text(encoding='utf-8').strip()}")
    if not path.exists():
        return config, None
    (step,) = steps_for(config, Run(path), ["calibrate"])
    return config, replace(load(path).results["calibrate"], key=step.key)


def run_sweep(
    design: Design,
    folder: Folder,
    engine: Engine,
    progress: Progress,
    say: Callable[[str], None],
    *,
    force: bool = False,
) -> _Status:
    """Make the missing runs of a sweep, and the table; of the stored runs also at Ctrl-C."""
    status = folder.status(design, force=force)
    if status.complete:
        return status
    if force:
        folder.clear()
    try:
        columns_of(design)  # fails early if there can be no table
        for base in range(len(design.bases)):
            design.random_ends(base)  # likewise
        _compile_once(design, engine, say)
        wanted = folder.missing_calibrations(design)
        max_workers = 1 + len(wanted) // _CALIBRATIONS
        with closing(engine.completed(_calibrate, wanted, max_workers=max_workers)) as calibrated:
            for count, one in enumerate(calibrated, 1):
                folder.keep_calibration(*one)
                progress("calibrations", count, len(wanted))
        if status.done:
            say(f"{status.done} of {status.total} runs are stored already")
        _make_parts(design, folder, engine, status, progress)
    except KeyboardInterrupt:
        if folder.stored():
            folder.assemble(design)
        raise
    finally:
        engine.close()
    folder.assemble(design)
    shutil.rmtree(folder.parts)
    return _Status(design.total, design.total, status.chunk, complete=True)


def _make_parts(design: Design, folder: Folder, engine: Engine, status: _Status, progress: Progress) -> None:
    """Make the parts that are missing."""
    calibrations, threads = folder.calibrations(design), _shares_settings(design)
    chunk = status.chunk
    if not chunk:
        max_chunk = _SHARED if threads else _OWN
        chunk = design.sweep.chunk or min(max_chunk, math.ceil(design.total / (_PARTS * engine.workers)))
        folder.begin(design, chunk)

    def part(first: int, last: int) -> Part:
        at = design.placed(np.arange(first, last))
        pairs = set(zip(at.cell.tolist(), at.calibration.tolist(), strict=True))
        keys = {design.calibration_key(*pair) for pair in pairs}
        return Part(design, first, last, {key: calibrations[key] for key in keys})

    done, left = 0, status.total - status.done
    progress("runs", 0, left)
    parts = (part(*pair) for pair in folder.missing(design, chunk))
    with closing(engine.completed(run_part, parts, threads=threads)) as made_parts:
        for columns, traces, failures in made_parts:
            first, last = int(columns["run"][0]), int(columns["run"][-1]) + 1
            write_part(folder.part(first, last), columns, traces, failures)
            done += last - first
            progress("runs", done, left)


def _shares_settings(design: Design) -> bool:
    """Tell whether all runs are compiled ones, many of which differ in their images alone."""
    tasks = design.sweep.tasks.count if design.sweep.tasks is not None else 1
    settings = math.lcm(design.sweep.calibrations, tasks)
    if design.sweep.random or settings > _SETTINGS or design.sweep.runs < settings:
        return False
    return all(_in_kernel(design, cell) for cell in range(design.cells))


def _in_kernel(design: Design, cell: int) -> bool:
    """Whether the kernel of whole runs makes the runs of a cell."""
    config = design.cell(cell)
    return is_compiled(design, servo_inputs(config), name_of_run(config))


def _calibrate(wanted: tuple[str, Config]) -> tuple[str, Config, _Records | str]:
    """Make the calibration of a key, or report its failure; one thread makes it the same to the bit."""
    with threadpool_limits(1):
        try:
            return (*wanted, calibrate.run(inputs_of("calibrate", wanted[1])))
        except WorkFailed as error:
            return (*wanted, str(error))


def _compile_once(design: Design, engine: Engine, say: Callable[[str], None]) -> None:
    """Fill an empty cache by one process, which ends here: the compiler keeps hundreds of megabytes."""
    if not engine.here or engine.workers == 1 or CACHE_FOLDER is None:
        return
    loop = until_rehearsal if _in_kernel(design, 0) else run_compiled
    if is_cached(loop) and are_cached(codes_of(_first_cells(design))):
        return
    say("compiling kernels, once, before the processes start")
    with closing(engine.completed(_first_runs, [design])) as made:
        list(made)


def _first_cells(design: Design) -> dict[str, int]:
    """Return the first cell of each law, by the names of their runs."""
    return {name_of_run(design.cell(cell)): cell for cell in reversed(design.cells_of(0))}


def _first_runs(design: Design) -> None:
    """One calibration and a run of each law with it, for the kernels they leave."""
    _, _, made = _calibrate((design.calibration_key(0, 0), design.calibrated(0, 0)))
    calibration = None if isinstance(made, str) else made[1]
    for cell in _first_cells(design).values():
        run = cell * design.sweep.runs
        run_part(Part(design, run, run + 1, {design.calibration_key(cell, 0): calibration}))
