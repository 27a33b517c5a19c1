"""Observation tables: one row per marker seen at one robot pose, as comma-separated values.

Columns, in any order: ``pose, marker, q1 … qN, u_left, v_left, u_right, v_right``; further columns
are ignored. Joint readings are rad or m, pixels are raw, empty pixel cells mean *unseen*.
"""

import csv
import io
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from projservo_cli.files import replacing
from projservo_cli.records import FloatArray, InputError, IntArray, Observation

_INTEGER = re.compile(r"[+-]?[0-9]{1,18}")
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")
MAX_JOINTS = 64  # as many as a configuration may have
MAX_COLUMNS = 10_000
MAX_BYTES = 100_000_000  # of a table; more would not be calibrated from
_JOINT = re.compile(r"q[1-9][0-9]{0,8}")


class Sheet:
    """A header and the rows under it.

    Parameters
    ----------
    path : the file, UTF-8 with or without byte-order mark, any line ends.
    expected : the header a reader hopes for, for the message about an empty file.

    Attributes
    ----------
    where : the file, for messages.
    names : columns of the header, in small letters without surrounding spaces.

    Raises
    ------
    InputError
        When the file cannot be read or has no header.
    """

    def __init__(self, path: Path | str, expected: str) -> None:
        self.where = str(path)
        self._reader = csv.reader(io.StringIO(_text(Path(path)), newline=""), strict=True)
        header = self._next()
        if header is None:
            raise InputError(f"{self.where}: the table is empty; expected a header {expected}")
        if len(header) > MAX_COLUMNS:
            raise InputError(f"{self.where}:1: {len(header)} columns; a table has at most {MAX_COLUMNS}")
        self.names = [name.strip().lower() for name in header]
        if len(self.names) == 1 and ";" in self.names[0]:
            raise InputError(
                f"{self.where}:1: columns are separated by semicolons; use commas and decimal points"
            )

    def rows(self) -> Iterator[tuple[int, list[str]]]:
        """Line and cells of each row that is not blank.

        Raises
        ------
        InputError
            At a row of another length than the header.
        """
        while (cells := self._next()) is not None:
            if not any(cell.strip() for cell in cells):
                continue
            if len(cells) != len(self.names):
                raise InputError(
                    f"{self.where}:{self._reader.line_num}: {len(cells)} cells where the header has "
                    f"{len(self.names)}; the row is cut short or malformed"
                )
            yield self._reader.line_num, [cell.strip() for cell in cells]

    def _next(self) -> list[str] | None:
        try:
            return next(self._reader, None)
        except csv.Error as error:
            raise InputError(
                f"{self.where}:{self._reader.line_num}: {error}; expected comma-separated values"
            ) from error

    def columns(self, needed: Sequence[str], optional: Sequence[str] = ()) -> dict[str, int]:
        """Position of each column that is read: those needed, q1 … qN, and optional ones if present.

        Raises
        ------
        InputError
            When one is missing or stands there twice, or joint columns leave a gap.
        """
        joints = sorted(
            (name for name in set(self.names) if _JOINT.fullmatch(name)), key=lambda name: int(name[1:])
        )
        if len(joints) > MAX_JOINTS:
            raise InputError(f"{self.where}:1: {len(joints)} joint columns; a robot has at most {MAX_JOINTS}")
        missing = [name for name in needed if name not in self.names] + ([] if joints else ["q1"])
        if missing:
            raise InputError(f"{self.where}:1: the header lacks the column(s) {', '.join(missing)}")
        wanted = [*needed, *joints, *(name for name in optional if name in self.names)]
        twice = sorted({name for name in wanted if self.names.count(name) > 1})
        if twice:
            raise InputError(
                f"{self.where}:1: the header names the column(s) {', '.join(twice)} more than once"
            )
        gaps = [f"q{i}" for i in range(1, len(joints) + 1) if f"q{i}" not in joints]
        if gaps:
            raise InputError(
                f"{self.where}:1: joint column {gaps[0]} is missing, though there is {joints[-1]}"
            )
        return {name: self.names.index(name) for name in wanted}


def joints_of(columns: dict[str, int]) -> list[str]:
    """The joint columns among those that are read, in their order."""
    return [name for name in columns if _JOINT.fullmatch(name)]


def integer(where: str, column: str, text: str) -> int:
    """A whole number of at most 18 digits, or an ``InputError``."""
    if not _INTEGER.fullmatch(text):
        raise InputError(f"{where}: {column} is {text!r}; expected an integer")
    return int(text)


def number(where: str, column: str, text: str) -> float:
    """A finite number with a decimal point, or an ``InputError``."""
    value = float(text) if _NUMBER.fullmatch(text) else math.nan
    if not math.isfinite(value):
        raise InputError(f"{where}: {column} is {text!r}; expected a finite number")
    return value


def _text(path: Path) -> str:
    try:
        with path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}; expected a table") from error
    if len(content) > MAX_BYTES:
        raise InputError(
            f"{path}: larger than {MAX_BYTES // 1_000_000} MB; expected a table of trial motions"
        )
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise InputError(f"{path}:{line}: not UTF-8 text; export the table as UTF-8 CSV") from error
    if "\0" in text:
        line = text.split("\0", 1)[0].count("\n") + 1
        raise InputError(f"{path}:{line}: not a text file (it has a NUL byte)")
    return text


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


Column = tuple[str, list[str]]


def columns(name: str, array: npt.NDArray[Any], down: int | None = None) -> list[Column]:
    """Columns of an array: one axis runs down, by default the longest, the others stand in the heading.

    The heading is the NumPy expression of the column, such as ``images[0,:,1]``; a scalar is a
    column of one entry. Numbers are written so that reading them gives the same numbers.
    """
    if array.ndim == 0:
        return [(name, [_text_columns(array[()])])]
    if array.ndim == 1:
        return [(name, [_text_columns(value) for value in array.tolist()])]
    down = int(np.argmax(array.shape)) if down is None else down
    others = np.delete(array.shape, down)
    flat = np.moveaxis(array, down, 0).reshape(array.shape[down], int(np.prod(others)))
    found = []
    for k, index in enumerate(np.ndindex(*others)):
        place = [str(i) for i in index]
        place.insert(down, ":")
        found.append((f"{name}[{','.join(place)}]", [_text_columns(value) for value in flat[:, k].tolist()]))
    return found


def _text_columns(value: Any) -> str:
    if isinstance(value, (bool, np.bool_)):
        return str(int(value))
    if isinstance(value, (float, np.floating)):
        return repr(float(value))
    return str(value)


def to_csv(arrays: Mapping[str, npt.NDArray[Any]], down: int | None = None) -> str:
    """All arrays side by side, each from the first row on; cells past the end of an array are empty.

    Parameters
    ----------
    arrays : by name.
    down : axis that runs down; by default the longest of each array.
    """
    found = [column for name, array in arrays.items() for column in columns(name, np.asarray(array), down)]
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow([heading for heading, _ in found])
    writer.writerows(zip_longest(*(values for _, values in found), fillvalue=""))
    return stream.getvalue()
