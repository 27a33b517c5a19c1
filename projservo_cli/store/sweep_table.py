"""The table of a sweep: one variable a column, and a group for each stored trace."""

import json
import typing
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
import numpy.typing as npt

from projservo_cli.records import SIZES, BoolArray, InputError, Trace
from projservo_cli.store.run_file import (
    SWEEP,
    as_attribute,
    attribute,
    labelled,
    load_record,
    new_file,
    opened,
    save_record,
)

if typing.TYPE_CHECKING:
    import h5netcdf

_SCHEMA = "projservo sweep"
_VERSION = 4  # version of the table layout
_AGAIN = "move it elsewhere and run the sweep again"
TABLE = SWEEP
_ROWS = 16_384  # rows per chunk of the file
_TEXT = 48  # bytes that the name of a law or a verdict takes in it
_PACKED = {"compression": "gzip", "compression_opts": 1, "shuffle": True, "fletcher32": True}
_TRACES = "traces"
_FAILURES = "failures"

_Array = npt.NDArray[Any]


class Heading(NamedTuple):
    """One column of the table: its name, NumPy type, unit and meaning."""

    name: str
    dtype: str
    units: str
    about: str


class Failure(NamedTuple):
    """Runs of a law that failed or did not start."""

    runs: int  # how many they are
    first: int  # number of the first of them
    reason: str  # why that one did, in words

    @property
    def words(self) -> str:
        """Return it in words."""
        runs = "1 run" if self.runs == 1 else f"{self.runs} runs"
        return f"{runs} failed or did not start, first run {self.first}: {self.reason}"


def merge_failures(found: dict[str, Failure], more: Iterable[tuple[str, Failure]]) -> None:
    """Add the failures of further runs, by the names of their laws; of the reasons the first one stays."""
    for law, one in more:
        known = found.get(law, one._replace(runs=0))
        earlier = min(known, one, key=lambda failure: failure.first)
        found[law] = earlier._replace(runs=known.runs + one.runs)


def write_part(
    path: Path,
    columns: Mapping[str, _Array],
    traces: Mapping[int, Trace],
    failures: Mapping[str, Failure] | None = None,
) -> None:
    """Write rows, traces and failures of a part atomically."""
    with new_file(path) as file:
        file.attrs[_FAILURES] = json.dumps(failures or {})
        if traces:
            with labelled(file) as groups:
                for run, trace in traces.items():
                    save_record(groups.create_group(f"{_TRACES}/{run}"), trace)
        for name, values in columns.items():
            file[name] = values


def assemble(
    path: Path, parts: Sequence[Path], headings: Sequence[Heading], attributes: Mapping[str, Any]
) -> None:
    """Write a table from parts in the given order, a few at a time, with attributes of the file."""
    rows, failures = 0, dict[str, Failure]()
    for part in parts:
        with opened(part, _AGAIN, unchanged=True) as file:
            rows += len(file["run"])
            merge_failures(failures, _failures(attribute(file, _FAILURES, dict)).items())
    texts = {name for name, dtype, *_ in headings if dtype.startswith("S")}
    size = rows * sum(_TEXT if name in texts else np.dtype(dtype).itemsize for name, dtype, *_ in headings)
    size += sum(part.stat().st_size for part in parts)  # their traces
    with new_file(path, size) as new, labelled(new) as table:
        table.attrs.update({"schema": _SCHEMA, "schema_version": _VERSION})
        table.attrs.update({name: as_attribute(value) for name, value in attributes.items()})
        table.dimensions["run"] = rows
        table.attrs[_FAILURES] = json.dumps(failures)
        chunks = (max(1, min(rows, _ROWS)),)
        for name, dtype, units, about in headings:
            if name in texts:  # HDF5 packs no texts of any length
                data = table.create_variable(name, ("run",), h5py.string_dtype(), chunks=chunks)
            else:
                data = table.create_variable(name, ("run",), dtype, chunks=chunks, **_PACKED)
                data.attrs["units"] = units
            data.attrs["long_name"] = about
        first = 0
        for block in _blocks(table, parts, [name for name, *_ in headings]):
            last = first + len(block["run"])
            for name, dtype, *_ in headings:
                values = np.asarray(block[name], dtype=dtype)
                if name in texts:
                    values = np.char.decode(values, "utf-8").astype(object)
                table[name][first:last] = values
            first = last


def _blocks(
    file: "h5netcdf.File", parts: Sequence[Path], names: Sequence[str]
) -> Iterator[dict[str, _Array]]:
    """Yield rows of parts in blocks of about a chunk, and copy their traces into the file."""
    waiting: list[dict[str, _Array]] = []
    for part in parts:
        with opened(part, _AGAIN) as source:
            waiting.append({name: source[name][()] for name in names})
            for run in source.get(_TRACES, ()):
                trace = load_record(source[f"{_TRACES}/{run}"], Trace, dict(SIZES))
                save_record(file.create_group(f"{_TRACES}/{run}"), trace)
        if part == parts[-1] or sum(len(rows["run"]) for rows in waiting) >= _ROWS:
            yield {name: np.concatenate([rows[name] for rows in waiting]) for name in names}
            waiting = []


def _failures(stored: Mapping[str, Any]) -> dict[str, Failure]:
    """Return failures by the names of laws, as a file has them."""
    return {law: Failure(*one) for law, one in stored.items()}


def values_in(cell: int, axes: Sequence[tuple[str, Sequence[Any]]]) -> dict[str, Any]:
    """Return the value of each axis of a grid in a cell; the last axis runs fastest."""
    index = np.unravel_index(cell, [len(values) for _, values in axes])
    return {name: values[int(i)] for (name, values), i in zip(axes, index, strict=True)}


class SweepTable:
    """A table read from its file, a column at a time: ``names`` of columns, ``attributes`` of the file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        if not path.is_file():
            raise InputError(f"{path}: there is no table of a sweep; make one with projservo sweep")
        with opened(path, _AGAIN, unchanged=True) as file:
            if "schema" not in file.attrs or attribute(file, "schema") != _SCHEMA:
                raise InputError(f"{path}: not the table of a sweep; name a folder that projservo sweep made")
            if attribute(file, "schema_version") != _VERSION:
                raise InputError(
                    f"{path}: another version of projservo made it; run it again: projservo sweep --force"
                )
            found = ((name, attribute(file, name)) for name in file.attrs)
            is_json = ("{", "[")
            self.attributes = {k: json.loads(v) if str(v).startswith(is_json) else v for k, v in found}
            self.names = tuple(self.attributes["columns"])
            self.failures = _failures(self.attributes.get(_FAILURES, {}))  # failures by law
            self.rows = len(file["run"])
            self.traces = tuple(sorted(map(int, file.get(_TRACES, ()))))  # numbers of runs
        self._read: dict[str, _Array] = {}

    @property
    def axes(self) -> list[tuple[str, list[Any]]]:
        """Name and values of each axis of the grid, the last one running fastest."""
        return [(name, values) for name, values in self.attributes["axes"]]

    def __getitem__(self, name: str) -> _Array:
        """A column, or values derived from some, read once."""
        if name not in self._read:
            self._read[name] = self._derived(name)
        return self._read[name]

    def _derived(self, name: str) -> _Array:
        if name == "success":
            return np.asarray(self.column(name) == 1)
        if name == "converged":
            return np.asarray(self["verdict"] == name)
        if name == "law" and name not in self.names:  # where an axis of another name sets it
            return np.full(self.rows, "all")
        if name == "self_occluded":
            hidden = [self[name] > 0 for name in self.names if name.startswith("self_occluded_steps_")]
            return np.asarray(np.any(hidden, axis=0))
        if name == "left_image":
            return self["first_outside_image"] >= 0
        if name == "path_length_ratio":
            straight = self["distance_mm"]
            ratio = np.full(straight.shape, np.nan)
            np.divide(self["path_length_mm"], straight, out=ratio, where=straight > 1.0)
            return ratio
        return self.column(name)

    def values(self, cell: int) -> dict[str, Any]:
        """Value of each axis in a cell."""
        return values_in(cell, self.axes)

    def cells(self) -> Iterator[tuple[int, BoolArray]]:
        """Each cell that has runs, and which they are."""
        for cell in np.unique(self["cell"]):
            yield int(cell), self["cell"] == cell

    def column(self, name: str) -> _Array:
        """Values (k,) of a column; texts as Python texts would be, of fixed width."""
        with opened(self.path, _AGAIN) as file:
            data = file[name]
            if data.dtype.kind != "O":
                return np.asarray(data[()])
            texts = data.asstr()  # texts of any length, a few at a time
            return np.concatenate(
                [texts[i : i + _ROWS].astype(str) for i in range(0, max(len(data), 1), _ROWS)]
            )

    def trace(self, run: int) -> Trace:
        """Stored trace of a run. Raises InputError if it was not stored."""
        with opened(self.path, _AGAIN) as file:
            if f"{_TRACES}/{run}" not in file:
                raise InputError(f"{self.path}: the trace of run {run} was not kept; list it under traces")
            return typing.cast("Trace", load_record(file[f"{_TRACES}/{run}"], Trace, dict(SIZES)))
