"""Observation tables: one row per marker seen at one robot pose, as comma-separated values.

Columns, in any order: ``pose, marker, q1 … qN, u_left, v_left, u_right, v_right``; further columns
are ignored. Joint readings are rad or m, pixels are raw, empty pixel cells mean *unseen*.
"""

import csv
import io
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from projservo_cli.files import replacing
from projservo_cli.records import InputError, Observation

PIXELS = ("u_left", "v_left", "u_right", "v_right")
MAX_CELLS = 50_000_000  # poses × markers: a mistyped number of a pose must not fill the memory

_INTEGER = re.compile(r"[+-]?[0-9]{1,18}")
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")
_JOINT = re.compile(r"q[1-9][0-9]*")


@dataclass(frozen=True)
class _Row:
    line: int
    pose: int
    marker: int
    q: tuple[float, ...]
    pixels: tuple[float, ...]


def read_table(path: Path | str, joint_types: str | None = None) -> Observation:
    """Read an observation table.

    Parameters
    ----------
    path : Path or str
        The file, UTF-8 with or without byte-order mark, any line ends.
    joint_types : str, optional
        One letter a joint column; its length must be the number of joint columns.

    Returns
    -------
    Observation
        Poses in the order of their first row, markers by number; NaN where unseen.

    Raises
    ------
    InputError
        ``file:line: what`` when the file cannot be read or a row makes no sense.
    """
    where = str(path)
    reader = csv.reader(io.StringIO(_text(Path(path)), newline=""), strict=True)
    try:
        header = next(reader, None)
        if header is None:
            raise InputError(f"{where}: the table is empty; expected a header pose,marker,q1…qN,u_left,…")
        columns = _columns(where, header, joint_types)
        rows = [
            _row(f"{where}:{reader.line_num}", reader.line_num, cells, columns, len(header))
            for cells in reader
            if any(cell.strip() for cell in cells)
        ]
    except csv.Error as error:
        raise InputError(f"{where}:{reader.line_num}: {error}; expected comma-separated values") from error
    if not rows:
        raise InputError(f"{where}: the table has a header but no rows; nothing was observed")
    return _observation(where, rows)


def _text(path: Path) -> str:
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}; expected a table") from error
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise InputError(f"{path}:{line}: not UTF-8 text; export the table as UTF-8 CSV") from error
    if "\0" in text:
        line = text.split("\0", 1)[0].count("\n") + 1
        raise InputError(f"{path}:{line}: not a text file (it has a NUL byte)")
    return text


def _columns(where: str, header: list[str], joint_types: str | None) -> dict[str, int]:
    """Position of each column that is read; joints under q1, q2 … without a gap."""
    names = [name.strip().lower() for name in header]
    joints = sorted((name for name in names if _JOINT.fullmatch(name)), key=lambda name: int(name[1:]))
    wanted = ["pose", "marker", *joints, *PIXELS]
    if len(names) == 1 and ";" in names[0]:
        raise InputError(f"{where}:1: columns are separated by semicolons; use commas and decimal points")
    missing = [name for name in ["pose", "marker", "q1", *PIXELS] if name not in names]
    if missing:
        raise InputError(f"{where}:1: the header lacks the column(s) {', '.join(missing)}")
    twice = sorted({name for name in wanted if names.count(name) > 1})
    if twice:
        raise InputError(f"{where}:1: the header names the column(s) {', '.join(twice)} more than once")
    gaps = [f"q{i}" for i in range(1, len(joints) + 1) if f"q{i}" not in joints]
    if gaps:
        raise InputError(f"{where}:1: joint column {gaps[0]} is missing, though there is {joints[-1]}")
    if joint_types is not None and len(joint_types) != len(joints):
        raise InputError(
            f"{where}:1: {len(joints)} joint columns q1…q{len(joints)}, but joints {joint_types!r} has "
            f"{len(joint_types)} letters; give one R or P a column"
        )
    return {name: names.index(name) for name in wanted}


def _row(where: str, line: int, cells: list[str], columns: dict[str, int], width: int) -> _Row:
    if len(cells) != width:
        raise InputError(
            f"{where}: {len(cells)} cells where the header has {width}; the row is cut short or malformed"
        )
    text = {name: cells[index].strip() for name, index in columns.items()}
    joints = [name for name in columns if _JOINT.fullmatch(name)]
    for view in ("left", "right"):
        if (text[f"u_{view}"] == "") != (text[f"v_{view}"] == ""):
            raise InputError(f"{where}: one of u_{view}, v_{view} is empty; give both or neither")
    return _Row(
        line,
        _integer(where, "pose", text["pose"]),
        _integer(where, "marker", text["marker"]),
        tuple(_number(where, name, text[name]) for name in joints),
        tuple(_number(where, name, text[name]) if text[name] else math.nan for name in PIXELS),
    )


def _integer(where: str, column: str, text: str) -> int:
    if not _INTEGER.fullmatch(text):
        raise InputError(f"{where}: {column} is {text!r}; expected an integer")
    return int(text)


def _number(where: str, column: str, text: str) -> float:
    value = float(text) if _NUMBER.fullmatch(text) else math.nan
    if not math.isfinite(value):
        raise InputError(f"{where}: {column} is {text!r}; expected a finite number")
    return value


def _observation(where: str, rows: list[_Row]) -> Observation:
    poses = {pose: k for k, pose in enumerate(dict.fromkeys(row.pose for row in rows))}
    markers = {marker: j for j, marker in enumerate(sorted({row.marker for row in rows}))}
    if len(poses) * len(markers) > MAX_CELLS:
        raise InputError(f"{where}: {len(poses)} poses × {len(markers)} markers are too many to hold")
    first: dict[int, _Row] = {}
    seen: dict[tuple[int, int], int] = {}
    q = np.empty((len(poses), len(rows[0].q)))
    images = np.full((len(poses), 2, len(markers), 2), np.nan)
    for row in rows:
        start = first.setdefault(row.pose, row)
        if row.q != start.q:
            column = next(i for i, (a, b) in enumerate(zip(row.q, start.q, strict=True), 1) if a != b)
            raise InputError(
                f"{where}:{row.line}: q{column} of pose {row.pose} is {row.q[column - 1]!r}, but "
                f"{start.q[column - 1]!r} in line {start.line}; a pose has one joint reading"
            )
        line = seen.setdefault((row.pose, row.marker), row.line)
        if line != row.line:
            raise InputError(
                f"{where}:{row.line}: marker {row.marker} at pose {row.pose} is already in line {line}"
            )
        q[poses[row.pose]] = row.q
        images[poses[row.pose], :, markers[row.marker]] = np.reshape(row.pixels, (2, 2))
    pose, marker = np.array(list(poses), dtype=np.int64), np.array(list(markers), dtype=np.int64)
    return Observation(pose, marker, q, images)


def write_table(observation: Observation, path: Path | str) -> None:
    """Write an observation table that ``read_table`` reads back to the last bit.

    Every marker of every pose has a row, with empty cells where unseen. The file appears whole or
    not at all.
    """
    n = observation.q.shape[1]
    with replacing(Path(path)) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["pose", "marker", *(f"q{i}" for i in range(1, n + 1)), *PIXELS])
        writer.writerows(_cells(observation))


def _cells(observation: Observation) -> Iterator[list[object]]:
    for k, pose in enumerate(observation.pose.tolist()):
        q = [repr(value) for value in observation.q[k].tolist()]
        for j, marker in enumerate(observation.marker.tolist()):
            pixels = observation.images[k, :, j].ravel().tolist()
            yield [pose, marker, *q, *("" if math.isnan(value) else repr(value) for value in pixels)]
