"""A run as files of other programs: CSV tables, a MATLAB file, a NumPy archive."""

import csv
import dataclasses
import io
import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from projservo_cli.columns import to_csv
from projservo_cli.files import replacing
from projservo_cli.store import Run

FIELDS = "fields.csv"
_MATLAB_NAME = 63  # characters that a name may have there


def write_csv(run: Run, folder: Path) -> list[Path]:
    """A table for each record, and one that says what every field is.

    Returns
    -------
    The files, the table of fields first.

    Raises
    ------
    InputError
        If a file cannot be written.
    """
    stream = io.StringIO()
    about = csv.writer(stream, lineterminator="\n")
    about.writerow(["file", "field", "dimensions", "unit", "about", "value"])
    files = [folder / FIELDS]
    for name, record in _records(run):
        path = folder / f"{_plain(name.replace('/', '_'))}.csv"
        arrays = {}
        for label, value, metadata in _fields(record):
            array = isinstance(value, np.ndarray)
            dims = " ".join(metadata.get("dims", ())) if array else ""
            told = "" if array else _scalar(value)
            about.writerow([path.name, label, dims, metadata["units"], metadata["about"], told])
            if array:
                arrays[label] = value
        _write(path, to_csv(arrays, down=0).encode())
        files.append(path)
    _write(files[0], stream.getvalue().encode())
    return files


def write_npz(run: Run, path: Path) -> list[Path]:
    """An archive for ``numpy.load`` with a name such as ``servo/direct_two/q`` for each array.

    Texts are arrays of one text; nothing in it needs pickle.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    stream = io.BytesIO()
    arrays = {
        f"{name}/{label}": np.asarray(_simple(value))
        for name, record in _records(run)
        for label, value, _ in _fields(record)
    }
    np.savez_compressed(stream, allow_pickle=False, **arrays)
    _write(path, stream.getvalue())
    return [path]


def write_mat(run: Run, path: Path) -> list[Path]:
    """A MATLAB file (version 5) with a structure for each stage, such as ``servo.direct_two.q``.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    from scipy.io import savemat

    tree: dict[str, Any] = {}
    for name, record in _records(run):
        holder = tree
        for part in name.split("/"):
            holder = holder.setdefault(_matlab(part), {})
        for label, value, _ in _fields(record):
            holder[_matlab(label)] = _simple(value)
    with replacing(path) as temporary:
        savemat(
            str(temporary),
            tree,
            appendmat=False,
            long_field_names=True,
            do_compression=True,
            oned_as="column",
        )
    return [path]


WRITERS: dict[str, Callable[[Run, Path], list[Path]]] = {
    "csv": write_csv,
    "mat": write_mat,
    "npz": write_npz,
}


def _records(run: Run) -> Iterator[tuple[str, Any]]:
    """Every record of a run by the name of its place, such as ``calibrate/observation``."""
    for name, result in run.results.items():
        for label, record in result.records.items():
            yield (f"{name}/{label}" if label else name), record


def _fields(record: Any) -> Iterator[tuple[str, Any, Any]]:
    """Name, value and metadata of each field that has a value."""
    for field in dataclasses.fields(record):
        value = getattr(record, field.name)
        if value is not None:
            yield field.name, np.asarray(value) if "dims" in field.metadata else value, field.metadata


def _simple(value: Any) -> Any:
    """Arrays, numbers and texts as they are, anything else as JSON text."""
    return value if isinstance(value, (np.ndarray, bool, int, float, str)) else _scalar(value)


def _scalar(value: Any) -> str:
    if isinstance(value, str):
        return value
    return repr(value) if isinstance(value, float) else json.dumps(value, ensure_ascii=False)


def _plain(name: str) -> str:
    """A name that can be that of a file or a variable anywhere."""
    return re.sub(r"\W", "_", name, flags=re.ASCII)


def _matlab(name: str) -> str:
    plain = _plain(name)
    return (plain if plain[:1].isalpha() else f"x{plain}")[:_MATLAB_NAME]


def _write(path: Path, content: bytes) -> None:
    with replacing(path) as temporary:
        temporary.write_bytes(content)
