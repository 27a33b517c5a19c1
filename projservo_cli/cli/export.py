"""``projservo export``: all arrays of a run as CSV tables."""

import csv
import dataclasses
import io
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import numpy as np

from projservo_cli.cli.output import Console, print_json
from projservo_cli.files import replacing
from projservo_cli.records import InputError
from projservo_cli.store import Run, load
from projservo_cli.tables import to_csv

FIELDS = "fields.csv"


def run(names: list[str], rest: list[str], options: dict[str, Any]) -> int:
    """Write the files; the exit code."""
    del names
    if not rest:
        raise click.UsageError("export needs a run: projservo export RUN")
    found = load(rest[0])
    path = Path(options["output"]) if options["output"] else found.path.parent / "csv"
    if path.exists() and not options["force"]:
        raise InputError(f"{path}: exists already; choose another with -o, or replace it with --force")
    files = write_csv(found, path)
    if options["json"]:
        print_json({"run": found.path.resolve(), "files": [file.resolve() for file in files]})
        return 0
    console = Console(quiet=options["quiet"], verbose=options["verbose"])
    console.show(f"export: {len(files)} files: {path}")
    return 0


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


def _scalar(value: Any) -> str:
    if isinstance(value, str):
        return value
    return repr(value) if isinstance(value, float) else json.dumps(value, ensure_ascii=False)


def _plain(name: str) -> str:
    """A name that can be that of a file or a variable anywhere."""
    return re.sub(r"\W", "_", name, flags=re.ASCII)


def _write(path: Path, content: bytes) -> None:
    with replacing(path) as temporary:
        temporary.write_bytes(content)
