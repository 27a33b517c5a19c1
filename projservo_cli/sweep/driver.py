"""A sweep from its configuration to its table, in parts that outlive whatever happens.

The folder of a sweep holds a manifest, which says what all else is of, and while it runs ``parts``, a
file each. A part that is there is done, so after any end the same command goes on with the others. The
table is assembled from the parts; when it is complete they are removed.
"""

import json
import math
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from projservo_cli import provenance
from projservo_cli.files import replacing
from projservo_cli.records import InputError
from projservo_cli.stages import Progress
from projservo_cli.store import TABLE, SweepTable, assemble, write_part
from projservo_cli.sweep import preparation
from projservo_cli.sweep.compiling import compile_once
from projservo_cli.sweep.design import Design, from_recipe
from projservo_cli.sweep.engine import Engine, LocalEngine, completed
from projservo_cli.sweep.runs import Made, Part, columns_of, compiled_by, run_part

PART_S = 1.5  # what making a part should take
PILOTS, PILOT_RUNS = 5, 16  # parts that are made to see how long a run takes, and their runs
CALIBRATIONS = 8  # that one process makes in less time than it takes to start another
SETTINGS = 64  # as many of a cell, and a part has many runs of each, nearly all of whose time is compiled
MOST_RUNS = 50_000  # in a part, whose rows are in memory
SAME = ("projservo", "python", "numpy", "scipy", "numba", "jit")
MANIFEST = "manifest.json"


@dataclass(frozen=True)
class Folder:
    """The folder of a sweep and what is in it."""

    path: Path

    @property
    def table(self) -> Path:
        """The assembled table."""
        return self.path / TABLE

    @property
    def parts(self) -> Path:
        """Folder of the parts."""
        return self.path / "parts"

    @property
    def manifest(self) -> Path:
        """What table and parts are of."""
        return self.path / MANIFEST

    def part(self, first: int, last: int) -> Path:
        """File of the runs ``first`` to ``last`` - 1."""
        return self.parts / f"{first:010d}-{last:010d}.h5"

    def stored(self) -> list[Path]:
        """Parts that are done, in the order of their runs."""
        return sorted(self.parts.glob("[0-9]*-[0-9]*.h5"))


@dataclass(frozen=True)
class Status:
    """How far a sweep is.

    Attributes
    ----------
    done, total : runs that are stored, and in all.
    chunk : runs of a part; 0 before it began.
    complete : whether nothing is left to do: all runs are in the table, and the parts are removed.
    """

    done: int
    total: int
    chunk: int
    complete: bool = False


def status_of(design: Design, folder: Folder, *, force: bool) -> Status:
    """How far a sweep is.

    Raises
    ------
    InputError
        If the folder holds another sweep, or one made with other versions, and ``force`` is not set.
    """
    if force:
        return Status(0, design.total, 0)
    if not folder.manifest.exists():
        if folder.table.exists():
            raise InputError(
                f"{folder.table}: its {MANIFEST} is missing; choose another folder or use --force"
            )
        return Status(0, design.total, 0)
    manifest = read_manifest(folder)
    _same(folder, design, manifest)
    chunk = int(manifest["chunk"])
    if folder.table.exists() and SweepTable(folder.table).rows == design.total:
        return Status(design.total, design.total, chunk, complete=not folder.stored())
    names = {path.name for path in folder.stored()}
    done = [last - first for first, last in ranges(design, chunk) if folder.part(first, last).name in names]
    return Status(sum(done), design.total, chunk)


def read_manifest(folder: Folder) -> dict[str, Any]:
    """What is in a folder: key and recipe of the design, runs a part, and with which versions it is made.

    Raises
    ------
    InputError
        If there is no sweep, or the manifest is damaged.
    """
    if not folder.manifest.exists():
        raise InputError(f"{folder.path}: holds no sweep; make one with projservo sweep -c FILE")
    try:
        found: dict[str, Any] = json.loads(folder.manifest.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{folder.manifest}: damaged; begin anew with --force") from error
    return found


def _same(folder: Folder, design: Design, manifest: dict[str, Any]) -> None:
    """Refuse what was made of another configuration, or with versions that give other bits."""
    path, made_with = folder.manifest, manifest["provenance"]
    if manifest["key"] != design.key:
        raise InputError(
            f"{path}: of another configuration; choose another folder with -o, or begin anew with --force"
        )
    now = provenance.collect(seed=design.sweep.seed)
    other = [f"{name} {made_with[name]}, now {now[name]}" for name in SAME if made_with[name] != now[name]]
    if other:
        raise InputError(
            f"{path}: made with {'; '.join(other)}: a sweep is not continued with other versions; "
            "begin anew with --force"
        )


def ranges(design: Design, chunk: int) -> Iterator[tuple[int, int]]:
    """First run of each part, and the one after its last."""
    for first in range(0, design.total, chunk):
        yield first, min(first + chunk, design.total)


def clear(folder: Folder) -> None:
    """Remove what a sweep of another configuration left."""
    for path in (folder.parts, folder.path / "calibrations"):
        shutil.rmtree(path, ignore_errors=True)
    for path in (folder.table, folder.manifest, *folder.path.glob("tasks_*.npz")):
        path.unlink(missing_ok=True)


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

    Raises
    ------
    InputError
        If the folder holds another sweep, a file cannot be written, or a drawn value is invalid.
    WorkFailed
        If tasks cannot be drawn, or workers are lost again and again; what was stored is kept.
    KeyboardInterrupt
        After the table of what was stored has been assembled.
    """
    status = status_of(design, folder, force=force)
    if status.complete:
        return status
    if force:
        clear(folder)
    try:
        _make(design, folder, engine, status, progress, say)
    except KeyboardInterrupt:
        engine.close()
        if folder.stored():
            assembled(design, folder)
        raise
    finally:
        engine.close()
    assembled(design, folder)
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
    tasks = preparation.tasks_of(design, folder.path, say)
    if isinstance(engine, LocalEngine):
        compile_once(design, tasks, engine, say)
    missing = list(preparation.missing_calibrations(design, folder.path))
    engine.suit(1 + len(missing) // CALIBRATIONS, threads=False)
    for count, calibrated in enumerate(completed(engine, preparation.calibrate_one, missing)):
        preparation.keep_calibration(folder.path, calibrated)
        progress("calibrations", count + 1, len(missing))
    calibrations = preparation.calibrations_of(design, folder.path)

    def part(first: int, last: int) -> Part:
        cell, draw = np.divmod(np.arange(first, last), design.sweep.runs)
        pairs = set(zip(cell.tolist(), (draw % design.sweep.calibrations).tolist(), strict=True))
        keys = {design.calibration_key(*pair) for pair in pairs}
        return Part(design, first, last, {key: calibrations[key] for key in keys}, tasks)

    threads = shares_settings(design)
    engine.suit(1 if threads else status.total, threads=False)  # threads would be timed with each other
    chunk = status.chunk or design.sweep.chunk or _measured_chunk(design, engine, part)
    if not status.chunk:
        _begin(design, folder, chunk)
    engine.suit(status.total, threads=threads)
    left = status.total - status.done
    if status.done:
        say(f"{status.done} of {status.total} runs are stored already")
    done = 0
    todo = (part(*pair) for pair in ranges(design, chunk) if not folder.part(*pair).exists())
    progress("runs", 0, left)
    for made in completed(engine, run_part, todo):
        write_part(folder.part(made.first, made.last), made.columns, made.traces)
        done += made.last - made.first
        progress("runs", done, left)


def shares_settings(design: Design) -> bool:
    """Whether all runs are compiled ones, of which many differ in nothing but their images."""
    tasks = design.sweep.tasks.random if design.sweep.tasks is not None else 1
    settings = math.lcm(design.sweep.calibrations, tasks)
    if design.sweep.random or settings > SETTINGS or design.sweep.runs < settings:
        return False
    return all(compiled_by(design, design.cell(cell)) for cell in range(design.cells))


def _measured_chunk(design: Design, engine: Engine, part: Callable[[int, int], Part]) -> int:
    """Runs that take about ``PART_S``, from a few spread over the sweep."""
    places = sorted({i * design.total // PILOTS for i in range(PILOTS)})
    pilots = [part(place, min(place + PILOT_RUNS, design.total)) for place in places]
    timed = [(made.seconds / (made.last - made.first)) for made in completed(engine, _second_time, pilots)]
    typical = sorted(timed)[len(timed) // 2]
    return max(1, min(MOST_RUNS, math.ceil(PART_S / typical)))


def _second_time(part: Part) -> Made:
    """A part made twice, the second time with everything compiled."""
    run_part(part)
    return run_part(part)


def _begin(design: Design, folder: Folder, chunk: int) -> None:
    origin = provenance.collect(seed=design.sweep.seed)
    values = {"key": design.key, "chunk": chunk, "provenance": origin, "recipe": design.recipe}
    with replacing(folder.manifest) as temporary:
        temporary.write_text(json.dumps(values), encoding="utf-8")


def assembled(design: Design, folder: Folder) -> int:
    """Put the stored parts together to the table; the number of runs in it."""
    manifest = read_manifest(folder)
    columns = columns_of(design)
    attributes = {
        "name": design.sweep.name,
        "key": design.key,
        "random": list(design.sweep.random),
        "axes": [[axis.name, list(axis.values)] for axis in design.axes],
        "columns": [column.name for column in columns],
        "provenance": manifest["provenance"],
        "total": design.total,
    }
    headings = [(column.name, column.dtype, column.units, column.about) for column in columns]
    return assemble(folder.table, folder.stored(), headings, attributes)


def stored_design(folder: Folder) -> Design:
    """The design of the sweep in a folder.

    Raises
    ------
    InputError
        If there is no sweep.
    """
    return from_recipe(read_manifest(folder)["recipe"])
