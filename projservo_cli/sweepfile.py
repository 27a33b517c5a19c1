"""The table of a sweep and the parts it is assembled from, as HDF5 that xarray opens.

A row a run along the dimension ``run``: numbers as they are, texts as characters along a dimension of
their own, which xarray joins. Beside the table, in ``traces/<run>``, the traces that were asked for.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from projservo_cli.hdf5 import checksummed, new_file, sealed
from projservo_cli.recordfile import load_record, save_record
from projservo_cli.records import InputError, Trace

SCHEMA = "projservo sweep"
SCHEMA_VERSION = 1
TABLE = "sweep.h5"
ROWS = 16_384  # of a chunk of the file
_NO_VARIABLE = "This is a netCDF dimension but not a netCDF variable. {:10d}"
TRACES = "traces"

Array = npt.NDArray[Any]
# Name, NumPy type, unit and description of a column.
Heading = tuple[str, str, str, str]


def write_part(path: Path, columns: Mapping[str, Array], traces: Mapping[int, Trace]) -> None:
    """Write rows and traces, as a whole or not at all.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    with new_file(path) as file:
        for name, values in columns.items():
            file.create_dataset(name, data=values, **checksummed(values.shape))
        for run, trace in traces.items():
            save_record(file.create_group(f"{TRACES}/{run}"), trace)


def assemble(
    path: Path, parts: Sequence[Path], headings: Sequence[Heading], attributes: Mapping[str, Any]
) -> int:
    """Put parts together, in the order given, a few at a time; the number of rows.

    Parameters
    ----------
    attributes : of the file: numbers and texts, everything else as JSON.

    Raises
    ------
    InputError
        If a part is damaged or the file cannot be written; the table that stood there stays.
    """
    rows = sum(_rows(part) for part in parts)
    size = rows * sum(np.dtype(dtype).itemsize for _, dtype, _, _ in headings)
    size += sum(part.stat().st_size for part in parts)  # their traces
    with new_file(path, size) as file:
        file.attrs["schema"] = SCHEMA
        file.attrs["schema_version"] = SCHEMA_VERSION
        for name, value in attributes.items():
            file.attrs[name] = value if isinstance(value, (str, int, float)) else json.dumps(value)
        for heading in headings:
            _make_column(file, rows, heading)
        _attach_scales(file, headings)
        at = 0
        for block in _blocks(parts, headings):
            size = len(block[headings[0][0]])
            for name, dtype, _, _ in headings:
                file[name][at : at + size] = _stored(block[name], dtype)
            at += size
        _copy_traces(file, parts)
    return rows


def _make_column(file: h5py.File, rows: int, heading: Heading) -> None:
    name, dtype, units, about = heading
    width = (int(dtype[1:]),) if dtype.startswith("S") else ()
    shape = (rows, *width)
    data = file.create_dataset(
        name,
        shape,
        dtype="S1" if width else dtype,
        chunks=(max(1, min(rows, ROWS)), *width),
        compression=1,
        shuffle=True,
        fletcher32=True,
    )
    data.attrs["long_name"] = about
    if width:
        data.attrs["_Encoding"] = "utf-8"
    else:
        data.attrs["units"] = units


def _attach_scales(file: h5py.File, headings: Sequence[Heading]) -> None:
    file["run"].make_scale("run")
    for name, dtype, _, _ in headings:
        if name != "run":
            file[name].dims[0].attach_scale(file["run"])
        if dtype.startswith("S"):
            dimension = f"characters_{dtype[1:]}"
            if dimension not in file:
                size = int(dtype[1:])
                file.create_dataset(dimension, data=np.zeros(size, dtype=np.float32))
                file[dimension].make_scale(_NO_VARIABLE.format(size))
            file[name].dims[1].attach_scale(file[dimension])


def _stored(values: Array, dtype: str) -> Array:
    if not dtype.startswith("S"):
        return values
    return np.ascontiguousarray(values.astype(dtype)).view("S1").reshape(len(values), int(dtype[1:]))


def _blocks(parts: Sequence[Path], headings: Sequence[Heading]) -> Iterator[dict[str, Array]]:
    """Rows of parts in blocks of about those of a chunk of the file."""
    waiting: list[dict[str, Array]] = []
    count = 0
    for part in parts:
        waiting.append(_read_part(part, [heading[0] for heading in headings]))
        count += len(waiting[-1][headings[0][0]])
        if count >= ROWS:
            yield _joined(waiting)
            waiting, count = [], 0
    if waiting:
        yield _joined(waiting)


def _joined(blocks: Sequence[dict[str, Array]]) -> dict[str, Array]:
    return {name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]}


def _read_part(path: Path, names: Sequence[str]) -> dict[str, Array]:
    try:
        with h5py.File(path, "r", locking=False) as file:
            return {name: file[name][()] for name in names}
    except (OSError, KeyError) as error:
        what = " ".join(str(error).split())
        raise InputError(f"{path}: damaged ({what}); delete it and run the sweep again") from error


def _rows(path: Path) -> int:
    _require_whole(path)
    return len(_read_part(path, ["run"])["run"])


def _require_whole(path: Path) -> None:
    """Refuse a file that is not as it was written; nothing of it is read before."""
    remedy = "delete it and run the sweep again"
    if not sealed(path, remedy):
        raise InputError(f"{path}: changed by another program, so that its checksum is gone; {remedy}")


def _copy_traces(file: h5py.File, parts: Sequence[Path]) -> None:
    for part in parts:
        with h5py.File(part, "r", locking=False) as source:
            for run in source.get(TRACES, ()):
                # Not as they are: references to dimensions do not survive a copy to another file.
                trace = load_record(part, source[f"{TRACES}/{run}"])
                save_record(file.create_group(f"{TRACES}/{run}"), trace)


class SweepTable:
    """A table read from its file, a column at a time.

    Parameters
    ----------
    path : the file.

    Attributes
    ----------
    names : of the columns.
    attributes : of the file; JSON as its values.

    Raises
    ------
    InputError
        If there is none or it is no table of a sweep.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        if not path.is_file():
            raise InputError(f"{path}: there is no table of a sweep; make one with projservo sweep")
        _require_whole(path)
        try:
            with h5py.File(path, "r", locking=False) as file:
                if file.attrs.get("schema") != SCHEMA:
                    raise InputError(f"{path}: not the table of a sweep")
                if int(file.attrs["schema_version"]) != SCHEMA_VERSION:
                    raise InputError(f"{path}: written by another version of projservo; use another sweep")
                self.attributes = {name: _plain(value) for name, value in file.attrs.items()}
                self.names = tuple(json.loads(file.attrs["columns"]))
                self.rows = len(file["run"])
        except (OSError, KeyError) as error:
            what = " ".join(str(error).split())
            raise InputError(f"{path}: cut short or damaged ({what}); run the sweep again") from error

    def column(self, name: str) -> Array:
        """Values (k,) of a column; texts as Python texts would be, of fixed width."""
        with h5py.File(self.path, "r", locking=False) as file:
            values = file[name][()]
        if values.ndim == 2:
            values = np.char.decode(values.view(f"S{values.shape[1]}")[:, 0], "utf-8")
        return np.asarray(values)

    def trace(self, run: int) -> Trace:
        """Trace of a run that was kept.

        Raises
        ------
        InputError
            If it was not.
        """
        with h5py.File(self.path, "r", locking=False) as file:
            if f"{TRACES}/{run}" not in file:
                raise InputError(f"{self.path}: the trace of run {run} was not kept; list it under traces")
            found: Trace = load_record(self.path, file[f"{TRACES}/{run}"])
            return found


def _plain(value: Any) -> Any:
    if isinstance(value, str) and value[:1] in ("{", "["):
        return json.loads(value)
    return value.item() if isinstance(value, np.generic) else value
