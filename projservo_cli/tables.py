"""Observation tables: one row per marker seen at one robot pose, as comma-separated values.

Columns, in any order: ``pose, marker, q1 … qN, u_left, v_left, u_right, v_right``; further columns
are ignored. Joint readings are rad or m, pixels are raw, empty pixel cells mean *unseen*.
"""

import csv
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from projservo_cli.delimited import Sheet, integer, joints_of, number
from projservo_cli.files import replacing
from projservo_cli.records import FloatArray, InputError, IntArray, Observation

PIXELS = ("u_left", "v_left", "u_right", "v_right")
RECORDING = "recording"  # column that says which recording a row belongs to
MAX_CELLS = 5_000_000  # poses × markers: mistyped numbers of poses must not fill the memory
TWO_TURNS = 4.0 * math.pi  # rad; no arm with stops turns a joint that far from its zero


@dataclass(frozen=True)
class _Row:
    line: int
    pose: int
    marker: int
    q: tuple[float, ...]
    pixels: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class JointList:
    """Joint readings of numbered poses.

    Attributes
    ----------
    pose : (K,) numbers; 0, 1 … where the file has none.
    q : (K, n) readings, rad or m.
    numbered : whether the file has pose numbers.
    left, right : names of the images of each pose; None where the file has none.
    """

    pose: IntArray
    q: FloatArray
    numbered: bool
    left: tuple[str, ...] | None
    right: tuple[str, ...] | None


def read_table(
    path: Path | str, joint_types: str | None = None, joint_unit: str | None = None
) -> Observation:
    """Read an observation table.

    Parameters
    ----------
    path : Path or str
        The file, UTF-8 with or without byte-order mark, any line ends.
    joint_types : str, optional
        One letter a joint column, R or P, by default all R; its length must be the number of joint
        columns.
    joint_unit : str, optional
        Unit of the revolute columns, ``deg`` or ``rad``. By default rad, where readings beyond two
        turns are taken for a mistaken unit and refused.

    Returns
    -------
    Observation
        Poses in the order of their first row, markers by number; NaN where unseen; readings in rad
        and m.

    Raises
    ------
    InputError
        ``file:line: what`` when the file cannot be read or a row makes no sense.
    """
    sheet = Sheet(path, "pose,marker,q1…qN,u_left,…")
    columns = sheet.columns(["pose", "marker", *PIXELS])
    types = _types(sheet.where, columns, joint_types)
    rows = [_row(f"{sheet.where}:{line}", line, cells, columns) for line, cells in sheet.rows()]
    if not rows:
        raise InputError(f"{sheet.where}: the table has a header but no rows; nothing was observed")
    pose, marker, q, images = _arrays(sheet.where, rows)
    return Observation(pose, marker, _in_radians(sheet.where, pose, q, types, joint_unit), images)


def read_joints(path: Path | str, joint_types: str | None = None, joint_unit: str | None = None) -> JointList:
    """Read a list of joint readings, one pose a row: columns ``q1 … qN``, perhaps ``pose, left, right``.

    Parameters
    ----------
    path, joint_types : as for an observation table.
    joint_unit : ``deg`` or ``rad`` as for an observation table; ``as is`` for readings that are only
        passed on.

    Raises
    ------
    InputError
        ``file:line: what`` when the file cannot be read, a row makes no sense or a pose stands there twice.
    """
    sheet = Sheet(path, "q1…qN")
    columns = sheet.columns([], ["pose", "left", "right"])
    types = _types(sheet.where, columns, joint_types)
    if ("left" in columns) != ("right" in columns):
        raise InputError(f"{sheet.where}:1: give the columns left and right both, or neither")
    numbers: dict[int, int] = {}
    readings, names = [], []
    for line, cells in sheet.rows():
        where = f"{sheet.where}:{line}"
        pose = integer(where, "pose", cells[columns["pose"]]) if "pose" in columns else len(numbers)
        if numbers.setdefault(pose, line) != line:
            raise InputError(f"{where}: pose {pose} is already in line {numbers[pose]}")
        readings.append([number(where, name, cells[columns[name]]) for name in joints_of(columns)])
        names.append(tuple(cells[columns[side]] for side in ("left", "right") if side in columns))
        if "" in names[-1]:
            raise InputError(f"{where}: an image has no name; name both, or drop the row")
    if not readings:
        raise InputError(f"{sheet.where}: there is a header but no rows; no pose was given")
    poses = np.array(list(numbers), dtype=np.int64)
    q = np.array(readings)
    if joint_unit != "as is":
        q = _in_radians(sheet.where, poses, q, types, joint_unit)
    left, right = (tuple(side) for side in zip(*names, strict=True)) if names[0] else (None, None)
    return JointList(poses, q, "pose" in columns, left, right)


def _types(where: str, columns: dict[str, int], joint_types: str | None) -> str:
    joints = joints_of(columns)
    if joint_types is not None and len(joint_types) != len(joints):
        raise InputError(
            f"{where}:1: {len(joints)} joint columns q1…q{len(joints)}, but joints {joint_types!r} has "
            f"{len(joint_types)} letters; give one R or P a column"
        )
    return joint_types or "R" * len(joints)


def _in_radians(
    where: str, pose: IntArray, q: FloatArray, joint_types: str, joint_unit: str | None
) -> FloatArray:
    """Readings (K, n) in rad and m; those that can hardly be rad are refused unless rad was asked for."""
    revolute = np.array([letter in "Rr" for letter in joint_types])
    if joint_unit == "deg":
        return np.where(revolute, np.radians(q), q)
    beyond = np.argwhere(revolute & (np.abs(q) > TWO_TURNS))
    if joint_unit is None and beyond.size:
        k, i = beyond[0]
        raise InputError(
            f"{where}: q{i + 1} of pose {pose[k]} is {q[k, i]:g}, more than two turns in rad ({len(beyond)} "
            "such readings): they look like degrees; give --joint-unit deg, or --joint-unit rad if they are "
            "radians after all"
        )
    return q


def _row(where: str, line: int, cells: list[str], columns: dict[str, int]) -> _Row:
    text = {name: cells[index] for name, index in columns.items()}
    for view in ("left", "right"):
        if (text[f"u_{view}"] == "") != (text[f"v_{view}"] == ""):
            raise InputError(f"{where}: one of u_{view}, v_{view} is empty; give both or neither")
    return _Row(
        line,
        integer(where, "pose", text["pose"]),
        integer(where, "marker", text["marker"]),
        tuple(number(where, name, text[name]) for name in joints_of(columns)),
        tuple(number(where, name, text[name]) if text[name] else math.nan for name in PIXELS),
    )


def _arrays(where: str, rows: list[_Row]) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
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
    return np.array(list(poses), dtype=np.int64), np.array(list(markers), dtype=np.int64), q, images


def write_table(observation: Observation, path: Path | str, *, recording: str = "") -> None:
    """Write an observation table that ``read_table`` reads back to the last bit.

    Every marker of every pose has a row, with empty cells where unseen. The file appears whole or
    not at all. ``recording``, if given, stands in a further column of every row.
    """
    n = observation.q.shape[1]
    header = ["pose", "marker", *(f"q{i}" for i in range(1, n + 1)), *PIXELS]
    mark = [recording] if recording else []
    with replacing(Path(path)) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([*header, *([RECORDING] if recording else [])])
        writer.writerows([*row, *mark] for row in _cells(observation))


def recording_of(path: Path | str) -> str | None:
    """The recording that all rows of a table belong to; None where they name none or several.

    Raises
    ------
    InputError
        When the file cannot be read.
    """
    sheet = Sheet(path, "pose,marker,q1…qN,u_left,…")
    if RECORDING not in sheet.names:
        return None
    column = sheet.names.index(RECORDING)
    found = {cells[column] for _, cells in sheet.rows()}
    return found.pop() if len(found) == 1 else None


def _cells(observation: Observation) -> Iterator[list[object]]:
    for k, pose in enumerate(observation.pose.tolist()):
        q = [repr(value) for value in observation.q[k].tolist()]
        for j, marker in enumerate(observation.marker.tolist()):
            pixels = observation.images[k, :, j].ravel().tolist()
            yield [pose, marker, *q, *("" if math.isnan(value) else repr(value) for value in pixels)]
