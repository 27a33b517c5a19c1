"""Observation tables: one row per marker seen at one robot pose, as comma-separated values.

Columns, in any order: ``pose, marker, q1 … qN, u_left, v_left, u_right, v_right``, and optionally
``sigma_left, sigma_right, moving, t_q, t_left, t_right``; others are ignored. Views may have other names, and
be one or more: each pair of columns ``u_NAME, v_NAME`` is a view. Joint readings are rad or m,
pixels are raw; empty or ``nan``, they mean *unseen*. Sigmas are standard deviations of the pixels, px. A pose
with a number in ``moving`` belongs to that motion; times are s, empty if unknown. Files are UTF-8 with or
without byte-order mark, with any line ends. Columns are separated by commas, or as spreadsheets do by tabs or
by semicolons, where decimal commas are read; a first line ``sep=;`` is skipped.
"""

import csv
import io
import math
import re
import unicodedata
from array import array
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain, zip_longest
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from projservo_cli.calibration.time_offset import require_seconds
from projservo_cli.geometry.flange import FLANGE_TYPES, FlangeChart
from projservo_cli.image_size import view_named, views_in_order
from projservo_cli.metric.position_error import Positions
from projservo_cli.records import (
    FARTHEST_M,
    TOOL,
    TWO_TURNS,
    VIEW_NAME,
    VIEWS,
    WORLD,
    Calibration,
    FloatArray,
    InputError,
    IntArray,
    JointList,
    Observation,
)
from projservo_cli.store.files_and_locks import lines_of, write_whole
from projservo_cli.store.flange_poses import (
    FORMS,
    coordinates_of,
    flange_columns,
    pose_columns,
    poses_of,
    require_joints,
)

_MAX_JOINTS = 64  # maximum number of joints, as in a configuration
_MAX_COLUMNS = 10_000  # maximum number of columns
_MAX_BYTES = 1_000_000_000  # maximum size of a table, far beyond the size of a calibration
_MAX_CELLS = 12_000_000  # maximum of poses × markers: mistyped pose numbers must not fill the memory
_OF_VIEW = re.compile(f"u_({VIEW_NAME})")  # column of pixels u of a view; v follows
_DETECTION = ("pose", "camera", "marker", "u", "v")  # columns of a list of detections
_MOVING = "moving"  # column of the number of a motion
_T_Q = "t_q"  # column of the time of the joint readings, s
_IDENTITY = " of "  # precedes the identity of the robot in that column
_XYZ = ("x", "y", "z")  # columns of a position, m
_MOUNT = "mount"  # column of the mount of the cameras
_RECORDING = "recording"  # column of the recording that a row belongs to
_JOINT = re.compile(r"q[1-9][0-9]{0,8}")
_INTEGER = re.compile(r"([+-]?[0-9]{1,18})(\.0*)?")
# Cells as good as empty, where one may be.
_UNKNOWN = frozenset({"nan", "na", "n/a", "#n/a", "null", "none", "-"})
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")


def read_table(
    path: Path | str,
    joint_types: str | None = None,
    joint_unit: str | None = None,
    *,
    frame: str | None = None,
    like: Calibration | None = None,
    chart: FloatArray | None = None,
) -> Observation:
    """Read an observation table, by joint readings or by poses of the flange.

    path : file, or the name of a frame.
    frame : text of a frame that is in no file; messages count its rows from 0.
    joint_types : one letter a joint column, R or P, by default all R.
    joint_unit : unit of the revolute columns, ``deg`` or ``rad``; by default rad, and readings beyond two
        turns are refused as a mistaken unit.
    like : calibration whose readings these must be like, poses of the flange in the same coordinates.
    chart : (2, 4, 4) coordinates of poses of the flange without one; None for some about them.
    Returns poses in the order of their first row, markers by number; NaN if unseen; readings in rad and m.
    Raises InputError ``file:line: message`` if the file cannot be read or a row is not valid.
    """
    optional = [_MOVING, _T_Q]
    sheet = _Sheet(
        path, ["pose", "marker"], joint_types, optional=optional, frame=frame, seen=True, flange=True
    )
    stated = sheet.has_all([f"sigma_{view}" for view in sheet.views])
    times_of = [_T_Q, *(f"t_{view}" for view in sheet.views)]
    readings: dict[int, tuple[int, dict[str, float | None]]] = {}
    lines: dict[int, dict[int, int]] = {}  # line of each marker at each pose
    rows, seen = array("q"), array("d")  # pose and marker; pixels, then their deviations
    for row in sheet.rows():
        pose, marker = row.integer("pose"), row.integer("marker")
        seen.extend(row.observation(sheet.views, stated))
        rows.extend((pose, marker))
        of_pose = {name: row.number(name) for name in sheet.joints} | row.moment(times_of)
        line, first = readings.setdefault(pose, (row.line, of_pose))
        if of_pose != first:
            name = next(name for name, value in of_pose.items() if value != first[name])
            raise InputError(
                f"{row.where}: {name} of pose {pose} is {of_pose[name]!r}, but {first[name]!r} in "
                f"{sheet.named(line)}; a pose has one joint reading"
            )
        if (line := lines.setdefault(pose, {}).setdefault(marker, row.line)) != row.line:
            raise InputError(f"{row.where}: marker {marker} at pose {pose} is already in {sheet.named(line)}")
    sheet.require(rows, "an observation")
    del lines
    of_row = np.frombuffer(rows, dtype=np.int64).reshape(-1, 2)
    poses = {pose: k for k, pose in enumerate(readings)}
    markers, j = np.unique(of_row[:, 1], return_inverse=True)
    if len(poses) * len(markers) > _MAX_CELLS:
        raise InputError(f"{sheet.file}: {len(poses)} poses × {len(markers)} markers are too many to hold")
    k = np.array([poses[pose] for pose in of_row[:, 0].tolist()])
    of_seen, V = np.frombuffer(seen).reshape(len(of_row), -1), len(sheet.views)
    images = np.full((len(poses), V, len(markers), 2), np.nan)
    images[k, :, j] = of_seen[:, : 2 * V].reshape(-1, V, 2)
    sigma = np.full(images.shape[:3], np.nan) if stated else None
    if sigma is not None:
        sigma[k, :, j] = of_seen[:, 2 * V :]
    numbers, values = np.array([*poses], dtype=np.int64), [of_pose for _, of_pose in readings.values()]
    # (K, columns); unknown values become NaN
    q_read, moving, times = (
        np.array([[of_pose.get(name) for name in names] for of_pose in values], dtype=np.float64)
        for names in (sheet.joints, (_MOVING,), times_of)
    )
    q, flange_chart = sheet.readings(
        numbers, q_read, joint_unit, [line for line, _ in readings.values()], like, chart
    )
    found = Observation(
        pose=numbers,
        marker=markers,
        q=q,
        flange_chart=flange_chart,
        images=images,
        view=sheet.views,
        moving=moving[:, 0].astype(np.int64) if np.nansum(moving) > 0.0 else None,
        t_q=times[:, 0] if np.isfinite(times[:, 0]).any() else None,
        t_view=times[:, 1:] if np.isfinite(times[:, 1:]).any() else None,
        sigma=sigma,
    )
    require_seconds(sheet.file, found)
    return found


def read_detections(
    path: Path | str,
    readings: Path | str,
    joint_types: str | None = None,
    joint_unit: str | None = None,
    *,
    like: Calibration | None = None,
    chart: FloatArray | None = None,
) -> Observation:
    """Read a list of detections of any cameras, ``pose, camera, marker, u, v``, beside a table of readings.

    Optional columns: ``sigma``, px, and ``t``, s, the time of an image. Views are the cameras: left, right,
    then all others by name, c2 before c10; one whose name is a number n is cam n. Poses of the table of
    joints that no row names are poses that no camera saw.
    readings : table of joints, ``pose, q1 … qN``, or of poses of the flange; joint_types, joint_unit, like,
        chart : as for an observation table.
    Raises InputError ``file:line: message`` if a file cannot be read or a row is not valid.
    """
    joints = read_joint_list(readings, joint_types, joint_unit, flange=True, like=like, chart=chart)
    sheet = _Sheet(path, _DETECTION, optional=["sigma", "t"], joints=False)
    poses = {int(pose): k for k, pose in enumerate(joints.pose)}
    views: dict[str, int] = {}
    lines: dict[tuple[int, int, int], int] = {}
    rows = list[tuple[int, int, int]]()
    values = list[tuple[float, float, float, float]]()
    for row in sheet.rows():
        if (pose := row.integer("pose")) not in poses:
            raise InputError(
                f"{row.where}: pose {pose} has no joint readings in {readings}: add its row there"
            )
        name = view_named(row["camera"])
        if not _OF_VIEW.fullmatch(f"u_{name}"):
            raise InputError(f"{row.where}: camera is {row['camera']!r}; expected a number or a name")
        where = poses[pose], views.setdefault(name, len(views)), row.integer("marker")
        if (line := lines.setdefault(where, row.line)) != row.line:
            raise InputError(
                f"{row.where}: marker {where[2]} of camera {name} at pose {pose} is already in "
                f"{sheet.named(line)}"
            )
        rows.append(where)
        sigma = row.deviation("sigma") if row.get("sigma") else math.nan
        values.append(
            (row.number("u"), row.number("v"), sigma, row.number("t") if row.get("t") else math.nan)
        )
    sheet.require(rows, "a detection")
    k, first, number = np.array(rows).T
    names = views_in_order(views)
    v = np.array([names.index(name) for name in views])[first]
    markers, j = np.unique(number, return_inverse=True)
    if len(poses) * len(markers) > _MAX_CELLS:
        raise InputError(f"{sheet.file}: {len(poses)} poses × {len(markers)} markers are too many to hold")
    found = np.array(values)
    images = np.full((len(poses), len(names), len(markers), 2), np.nan)
    images[k, v, j] = found[:, :2]
    sigma_of, t_view = np.full(images.shape[:3], np.nan), np.full(images.shape[:2], np.nan)
    sigma_of[k, v, j], t_view[k, v] = found[:, 2], found[:, 3]
    if (some := np.isnan(found[:, 2])).any() and not some.all():
        raise InputError(
            f"{sheet.file}: sigma is empty in {np.count_nonzero(some)} rows; state it in all or none"
        )
    return Observation(
        pose=joints.pose,
        marker=markers,
        q=joints.q,
        flange_chart=joints.flange_chart,
        images=images,
        view=tuple(names),
        t_view=t_view if np.isfinite(t_view).any() else None,
        sigma=None if some.all() else sigma_of,
    )


def read_joint_list(
    path: Path | str,
    joint_types: str | None = None,
    joint_unit: str | None = None,
    view: Sequence[str] = VIEWS,
    *,
    flange: bool = False,
    like: Calibration | None = None,
    chart: FloatArray | None = None,
) -> JointList:
    """Read a list of joint readings, one pose per row: columns ``q1 … qN``, optionally ``pose, left, right``.

    view : names of the views, which columns with names of their images have; by default left and right.
    joint_types : as for an observation table.
    joint_unit : ``deg`` or ``rad`` as for an observation table; with ``rad`` readings stay as they are.
    flange : whether poses of the flange may stand for them; like, chart : as for an observation table.
    Raises InputError ``file:line: message`` if the file cannot be read or a row is not valid.
    """
    sheet = _Sheet(path, [], joint_types, optional=["pose", *view], unread=view, flange=flange)
    named = sheet.has_all(view)
    lines: dict[int, int] = {}
    readings, names = [], []
    for row in sheet.rows():
        pose = row.integer("pose") if "pose" in sheet.columns else len(lines)
        if lines.setdefault(pose, row.line) != row.line:
            raise InputError(f"{row.where}: pose {pose} is already in {sheet.named(lines[pose])}")
        readings.append([row.number(name) for name in sheet.joints])
        names.append([row[side] for side in view if named])
        if "" in names[-1]:
            raise InputError(
                f"{row.where}: an image has no name; name {'both' if len(view) == 2 else 'all'}, or drop the "
                "row"
            )
    sheet.require(readings, "a pose")
    poses = np.array([*lines], dtype=np.int64)
    q, flange_chart = sheet.readings(poses, np.array(readings), joint_unit, [*lines.values()], like, chart)
    images = dict(zip(view, zip(*names, strict=True), strict=True)) if named else None
    numbered = "pose" in sheet.columns
    return JointList(pose=poses, q=q, numbered=numbered, images=images, flange_chart=flange_chart)


def read_positions(path: Path | str, joint_types: str, joint_unit: str | None = None) -> Positions:
    """Read positions of a point of the tool: columns ``pose, q1 … qN, x, y, z``, m, optionally ``sigma``, m.

    Arguments as for an observation table.
    Raises InputError ``file:line: message`` if the file cannot be read or a row is not valid.
    """
    sheet = _Sheet(path, ["pose", *_XYZ], joint_types, optional=["sigma"])
    rows = [
        (row.integer("pose"), [row.number(name) for name in (*sheet.joints, *_XYZ)],
         row.number("sigma") if "sigma" in row else 0.0)
        for row in sheet.rows()
    ]  # fmt: skip
    sheet.require(rows, "a position")
    numbers, values, sigma = zip(*rows, strict=True)
    pose, found = np.array(numbers, dtype=np.int64), np.array(values)
    q = sheet.in_radians(pose, found[:, :-3], joint_unit)
    if (span := float(np.ptp(found[:, -3:], axis=0).max())) > FARTHEST_M:
        raise InputError(
            f"{sheet.file}: positions are {span:.4g} m apart: they look like millimetres; divide x, y, z and "
            "sigma by 1000"
        )
    return Positions(pose=pose, q=q, xyz=found[:, -3:], sigma=np.array(sigma))


def recording_of(path: Path | str) -> str | None:
    """Recording that all rows of a table belong to; None if they name none or several."""
    found = _recording(path)
    return None if found is None else found.partition(_IDENTITY)[0]


def identity_in(path: Path | str) -> str:
    """Identity of the robot that a table was recorded with; empty if it names none."""
    return (_recording(path) or "").partition(_IDENTITY)[2]


def mount_in(path: Path | str, frame: str | None = None) -> str:
    """Mount of the cameras, world or tool, as the first row of a table states it; world if none does.

    frame : text of a frame that is in no file, which ``path`` then only names.
    """
    row = next(_Sheet(path, [], optional=[_MOUNT], joints=False, frame=frame).rows(), _Row())
    mount = (row.get(_MOUNT) or WORLD).lower()
    if mount not in (WORLD, TOOL):
        raise InputError(f"{row.where}: {_MOUNT} is {row[_MOUNT]!r}; expected {WORLD} or {TOOL}")
    return mount


def _recording(path: Path | str) -> str | None:
    """Return the common recording of all rows of a table; None for none or several."""
    sheet = _Sheet(path, [], optional=[_RECORDING], joints=False)
    found = {row[_RECORDING] for row in sheet.rows() if _RECORDING in row}
    return found.pop() if len(found) == 1 else None


def write_table(observation: Observation, path: Path | str, **columns: str) -> None:
    """Write an observation table, as ``table_text`` has it."""
    write_whole(Path(path), table_text(observation, **columns))


def table_text(
    observation: Observation, *, recording: str = "", identity: str = "", mount: str = WORLD
) -> str:
    """Return the observation table that ``read_table`` reads back to the last bit.

    Every marker of every pose has a row, with empty cells if unseen. ``recording`` fills a further column,
    with the ``identity`` of the robot, and so does the ``mount`` of cameras on the tool.
    """
    K, m = len(observation.pose), len(observation.marker)
    columns = {"pose": np.repeat(observation.pose, m), "marker": np.tile(observation.marker, K)}
    readings = {f"q{i}": values for i, values in enumerate(observation.q.T, 1)}
    if observation.flange_chart is not None:
        readings = pose_columns(FlangeChart.from_record(observation.flange_chart).poses(observation.q))
    columns |= {name: np.repeat(values, m) for name, values in readings.items()}
    for v, view in enumerate(observation.view):
        for name, pixels in zip("uv", observation.images[:, v].reshape(K * m, 2).T, strict=True):
            columns[f"{name}_{view}"] = or_empty(pixels)
    if observation.sigma is not None:
        sigma = np.where(np.isnan(observation.images[..., 0]), np.nan, observation.sigma)
        columns |= {f"sigma_{view}": or_empty(sigma[:, v].ravel()) for v, view in enumerate(observation.view)}
    moments = {_MOVING: observation.moving, _T_Q: observation.t_q}
    if observation.t_view is not None:
        moments |= {f"t_{view}": t for view, t in zip(observation.view, observation.t_view.T, strict=True)}
    for name, values in moments.items():
        if values is not None:
            columns[name] = or_empty(np.repeat(values, m))
    if mount != WORLD:
        columns[_MOUNT] = np.full(K * m, mount)
    if recording:
        columns[_RECORDING] = np.full(K * m, recording + (_IDENTITY + identity if identity else ""))
    return to_csv(columns)


def or_empty(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Cells of a column, empty for NaN."""
    if values.dtype.kind != "f":
        return values
    return np.where(np.isnan(values), "", values.astype(object))


def to_csv(arrays: Mapping[str, npt.NDArray[Any]], down: int | None = None) -> str:
    """Write arrays side by side, each from the first row on; cells past the end of an array are empty.

    Numbers are written without loss.

    arrays : by name.
    down : axis along the rows; by default the longest of each array. The heading of a column is its NumPy
        expression, such as ``images[0,:,1]``.
    """
    found = [column for name, array in arrays.items() for column in _columns(name, np.asarray(array), down)]
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow([heading for heading, _ in found])
    writer.writerows(zip_longest(*(values for _, values in found), fillvalue=""))
    return stream.getvalue()


def _columns(name: str, array: npt.NDArray[Any], down: int | None) -> Iterator[tuple[str, list[str]]]:
    """Heading and cells of each column of an array; a scalar is a column of one entry."""
    array = np.atleast_1d(array)
    down = int(np.argmax(array.shape)) if down is None else down
    rows = np.moveaxis(array, down, 0)
    for index in np.ndindex(*rows.shape[1:]):
        axes = ",".join([*map(str, index[:down]), ":", *map(str, index[down:])])
        heading = f"{name}[{axes}]" if index else name
        yield heading, [_cell(value) for value in rows[(slice(None), *index)].tolist()]


def _cell(value: Any) -> str:
    return str(int(value)) if isinstance(value, bool) else str(value)


def in_radians(
    where: str, joint_types: str, pose: IntArray, q: FloatArray, unit: str | None, option: str
) -> FloatArray:
    """Convert readings (K, n) to rad and m; implausible rad are refused unless a unit is given.

    where, option : file or argument of the readings, and option of the unit, for messages.
    """
    if unit not in (None, "deg", "rad"):
        raise InputError(f"{where}: joint_unit {unit!r}: give deg or rad")
    revolute = np.array([letter in "Rr" for letter in joint_types])
    sliding = np.argwhere(~revolute & (np.abs(q) > FARTHEST_M))
    if unit != "rad" and sliding.size:
        k, i = sliding[0]
        raise InputError(
            f"{where}: q{i + 1} of pose {pose[k]} is {q[k, i]:g}, of a prismatic joint in m "
            f"({len(sliding)} such readings): they look like millimetres; divide them by 1000, or give "
            f"{option.format('rad')} if they are rad and m after all"
        )
    if unit == "deg":
        return np.where(revolute, np.radians(q), q)
    beyond = np.argwhere(revolute & (np.abs(q) > TWO_TURNS))
    if unit is None and beyond.size:
        k, i = beyond[0]
        raise InputError(
            f"{where}: q{i + 1} of pose {pose[k]} is {q[k, i]:g}, more than two turns in rad "
            f"({len(beyond)} such readings): they look like degrees; give {option.format('deg')}, or "
            f"{option.format('rad')} if they are radians after all"
        )
    return q


class _Row(dict[str, str]):
    """Cells of one line of a file by the names of their columns."""

    line: int
    where: str  # file and line, for messages

    def observation(self, views: Sequence[str], stated: bool) -> list[float]:
        """Pixels of all views, and their deviations if stated, NaN if unseen."""
        pixels, sigmas = [], []
        for view in views:
            u, v, deviation = f"u_{view}", f"v_{view}", f"sigma_{view}"
            seen = self[u] != ""
            if seen != (self[v] != ""):
                raise InputError(f"{self.where}: one of {u}, {v} is empty; give both or neither")
            pixels += [self.number(u), self.number(v)] if seen else [math.nan, math.nan]
            if stated:
                sigmas.append(self.deviation(deviation) if seen else math.nan)
        return pixels + sigmas

    def integer(self, column: str) -> int:
        """A whole number of at most 18 digits, which pandas may write as 3.0."""
        if (found := _INTEGER.fullmatch(self[column])) is None:
            raise InputError(f"{self.where}: {column} is {self[column]!r}; expected an integer")
        return int(found[1])

    def moment(self, times: Sequence[str]) -> dict[str, float | None]:
        """Number of the motion and times of a pose, by column; None for an unknown time."""
        found: dict[str, float | None] = {
            name: self.number(name) if self[name] else None for name in times if name in self
        }
        if _MOVING in self:
            found[_MOVING] = moving = self.integer(_MOVING)
            if moving < 0:
                raise InputError(f"{self.where}: moving is {moving}; number motions from 1, 0 is at rest")
            if moving > 0 and found.get(_T_Q) is None:
                raise InputError(f"{self.where}: a pose in motion needs t_q, when its joints were read, in s")
        return found

    def number(self, column: str) -> float:
        """A finite number with a decimal point."""
        value = float(self[column]) if _NUMBER.fullmatch(self[column]) else math.nan
        if not math.isfinite(value):
            raise InputError(f"{self.where}: {column} is {self[column]!r}; expected a finite number")
        return value

    def deviation(self, column: str) -> float:
        """A standard deviation."""
        if not (value := self.number(column)) > 0.0:
            raise InputError(f"{self.where}: {column} is {self[column]!r}; expected a positive number, px")
        return value


def _views_in(names: Sequence[str]) -> tuple[str, ...]:
    """Names of the views of a header, in its order; of left and right alone in this one; both without any."""
    found = [match[1] for match in map(_OF_VIEW.fullmatch, names) if match]
    views = [view for view in found if f"v_{view}" in names or view in VIEWS]
    views += [view for view in VIEWS if f"v_{view}" in names and view not in views]
    if {*views} <= {*VIEWS}:
        return tuple(view for view in VIEWS if view in views) or VIEWS
    return tuple(dict.fromkeys(views))


def _columns_of(views: Sequence[str]) -> list[str]:
    """Columns of the pixels of views."""
    return [f"{name}_{view}" for view in views for name in "uv"]


class _Sheet:
    """A table with the columns that are read (needed ones, q1 … qN, optional ones if present)."""

    def __init__(
        self,
        path: Path | str,
        needed: Sequence[str],
        joint_types: str | None = None,
        *,
        optional: Sequence[str] = (),
        frame: str | None = None,
        seen: bool = False,
        joints: bool = True,
        flange: bool = False,
        unread: Sequence[str] = (),
    ) -> None:
        self.file, self._of_frame = str(path), frame is not None
        of_file = lines_of(path, "a table as UTF-8 CSV", _MAX_BYTES)
        lines = of_file if frame is None else iter(io.StringIO(frame, newline=""))
        first, self._skipped = next(lines, ""), 0
        if first.strip().lower().startswith("sep="):  # written by spreadsheets for themselves
            first, self._skipped = next(lines, ""), 1
        self._separator = max(",;\t", key=first.count)
        self._reader = csv.reader(
            chain([first] * (first != ""), lines), strict=True, delimiter=self._separator
        )
        if (header := self._next()) is None:
            expected = [*needed[:2], *["q1…qN"] * joints, *(_columns_of(VIEWS) if seen else needed[2:])]
            raise InputError(f"{self.file}: the table is empty; expected a header {','.join(expected)}")
        names = [unicodedata.normalize("NFC", name.strip().lower()) for name in header]
        self.joints = sorted(filter(_JOINT.fullmatch, set(names)), key=lambda name: int(name[1:]))
        self.flange = self._flange_columns(names) if flange and not self.joints else ()
        self.joints = [*self.flange] or self.joints
        self.views = _views_in(names) if seen else ()
        needed = [*needed, *_columns_of(self.views)]
        optional = [*optional, *(f"{what}_{view}" for view in self.views for what in ("sigma", "t"))]
        self._blank = {*_columns_of(self.views), *optional} - {_MOVING, _RECORDING, *unread, "pose"}
        wanted = [*needed, *self.joints, *(name for name in optional if name in names)]
        if wrong := self._wrong(names, needed, wanted, joint_types, joints):
            raise InputError(f"{self._place(1 + self._skipped)}: {wrong}")
        self._width, self._numeric = len(names), {*wanted} - {*unread, "camera", _RECORDING, _MOUNT}
        self.columns = {name: names.index(name) for name in wanted}
        self._joint_types = joint_types or "R" * len(self.joints)

    def _flange_columns(self, names: Sequence[str]) -> tuple[str, ...]:
        """Columns of poses of the flange in the header, if there are any."""
        try:
            return flange_columns(names)
        except InputError as error:
            raise InputError(f"{self._place(1 + self._skipped)}: {error}") from None

    def _wrong(
        self,
        names: Sequence[str],
        needed: Sequence[str],
        wanted: Sequence[str],
        joint_types: str | None,
        joints: bool,
    ) -> str:
        """Describe an error of the header; empty if there is none."""
        n = len(self.joints)
        if len(names) > _MAX_COLUMNS:
            return f"{len(names)} columns; a table has at most {_MAX_COLUMNS}"
        if wrong := [name for name in names if re.fullmatch(r"q0[0-9]*", name)]:
            return f"the header has {wrong[0]}: number the joint columns q1, q2, … from base to tool"
        if missing := [name for name in needed if name not in names] + ["q1"] * (joints and not n):
            listed = "camera" in names and "camera" not in needed
            other = "; a list of detections has its joints in another table: give --readings" * listed
            other += f"; poses of the flange have {FORMS}" * (missing == ["q1"])
            return f"the header lacks the column(s) {', '.join(missing)}{other}"
        if twice := sorted({name for name in wanted if names.count(name) > 1}):
            return f"the header names the column(s) {', '.join(twice)} more than once"
        if n > _MAX_JOINTS:
            return f"{n} joint columns; a robot has at most {_MAX_JOINTS}"
        if self.flange:
            types = f"joints {joint_types!r}: poses of the flange have no types; leave joints out"
            return "" if joint_types in (None, FLANGE_TYPES) else types
        if gaps := [f"q{i}" for i in range(1, n + 1) if f"q{i}" not in self.joints]:
            return f"joint column {gaps[0]} is missing, though there is {self.joints[-1]}"
        if joint_types is not None and len(joint_types) != n:
            letters = f"{joint_types!r} has {len(joint_types)} letters"
            return f"{n} joint columns q1…q{n}, but joints {letters}; give one R or P a column"
        return ""

    def has_all(self, names: Sequence[str]) -> bool:
        """Whether some columns are present. Raises InputError for some of them without the others."""
        present = [name in self.columns for name in names]
        if any(present) and not all(present):
            how = "both, or neither" if len(names) == 2 else "all, or none"
            raise InputError(f"{self._place(1)}: give the columns {' and '.join(names)} {how}")
        return all(present)

    def named(self, line: int) -> str:
        """A line, which is a row of a frame, for messages."""
        return f"row {line - 2}" if self._of_frame else f"line {line}"

    def _place(self, line: int) -> str:
        """The place of a line, for messages; of the header of a frame, the frame."""
        if not self._of_frame:
            return f"{self.file}:{line}"
        return f"{self.file}: {self.named(line)}" if line > 1 else self.file

    def require(self, rows: Sequence[Any], one: str) -> None:
        """Refuse a table without rows, each of which is one of something, with an InputError."""
        if not rows:
            raise InputError(f"{self.file}: the table has a header but no rows; add {one} a row")

    def rows(self) -> Iterator[_Row]:
        """Yield the rows that are not blank. Raises InputError at a row of another length than the header."""
        while (cells := self._next()) is not None:
            if not any(cell.strip() for cell in cells):
                continue
            line = self._reader.line_num + self._skipped
            if len(cells) != self._width:
                raise InputError(
                    f"{self._place(line)}: {len(cells)} cells, but the header has {self._width}; the row is "
                    "cut short or malformed"
                )
            row = _Row({name: cells[i].strip() for name, i in self.columns.items()})
            for name in self._blank:
                if row.get(name, "").lower() in _UNKNOWN:
                    row[name] = ""
            if self._separator != ",":
                row.update({name: row[name].replace(",", ".") for name in self._numeric})
            row.line, row.where = line, self._place(line)
            yield row

    def _next(self) -> list[str] | None:
        try:
            return next(self._reader, None)
        except csv.Error as error:
            place = self._place(self._reader.line_num + self._skipped)
            raise InputError(f"{place}: {error}; expected values between {self._separator!r}") from error

    def readings(
        self,
        pose: IntArray,
        values: FloatArray,
        unit: str | None,
        lines: Sequence[int],
        like: Calibration | None,
        chart: FloatArray | None,
    ) -> tuple[FloatArray, FloatArray | None]:
        """Joint readings (K, n), rad and m, or coordinates of poses of the flange, and the chart of these.

        lines : (K,) of the rows; like : calibration whose readings these must be like; chart : otherwise.
        """
        if not self.flange:
            require_joints(self.file, like)
            return self.in_radians(pose, values, unit), None
        where = [self._place(line) for line in lines]
        return coordinates_of(poses_of(self.flange, values, where), self.file, like, chart)

    def in_radians(self, pose: IntArray, q: FloatArray, unit: str | None) -> FloatArray:
        """Convert readings (K, n) to rad and m, as ``in_radians``."""
        option = "joint_unit={!r}" if self._of_frame else "--joint-unit {}"
        return in_radians(self.file, self._joint_types, pose, q, unit, option)
