"""Episodes of a LeRobot data set, v2 and v3: frames at which the arm hardly moves, and the joints there.

Source of the format: huggingface/lerobot 0.4.4, ``lerobot/datasets/utils.py`` and ``lerobot_dataset.py``;
``motors/motors_bus.py`` has the normalised values.
"""

import json
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from projservo_cli.calibration.detections import even_choice
from projservo_cli.detection.images import ImageSeries, StoredImage, decoded
from projservo_cli.image_size import view_named
from projservo_cli.records import TWO_TURNS, VIEW_NAME, BoolArray, FloatArray, InputError, IntArray, JointList

# Numbers of poses: frame f of episode e is pose e · 100 000 + f; an episode of 30 Hz is shorter than 50 min.
_FRAMES = 100_000
# Maximum speed of a joint, rad/s: 50 ms between image and state, as cameras have, are then 0.25°.
_SLOW = math.radians(5.0)
# Half of the time over which a speed is measured, s: a count of a servo, 0.09°, is then 0.9°/s.
_HALF_S = 0.1
# Minimum distance of two poses of an episode in a joint, rad: nearer ones show the same again.
_APART = math.radians(1.0)
# Number of poses of all episodes, and the minimum and maximum of one: calibration takes a minute or less.
_ALL, _LEAST, _MOST = 600, 8, 40
# Frames of a motion out of a rest, by which calibrate measures the delay of images, and number of motions.
_MOTION, _MOTIONS = 15, 6
# Time from an episode to the next on the clock of all, s: longer than any.
_EPISODE_S = 10_000.0
# Counts of a servo in a turn: those of Feetech and Dynamixel in the arms of LeRobot.
_TURN = 4096
# Value of a normalised joint at the end of its range, where it is cut off, and beyond which it is in degrees.
_FULL = 100.0
# Time for which decoding goes on rather than seeks, s.
_NEAR_S = 2.0
# Range of a joint, rad, below which its axis stays uncertain: half of that of a trial to one side.
_LITTLE = math.radians(15.0)
_STATE, _IMAGES = "observation.state", "observation.images."
_NORMALISED = "normalised"
# Units by the words of descriptions, and the largest value that each may have.
_UNITS = {
    **dict.fromkeys(("deg", "degree", "degrees"), "deg"),
    **dict.fromkeys(("rad", "radian", "radians"), "rad"),
    **dict.fromkeys((_NORMALISED, "normalized", "range_m100_100"), _NORMALISED),
}
_LARGEST = {"deg": math.degrees(TWO_TURNS), "rad": TWO_TURNS, _NORMALISED: _FULL + 0.1}


class Episodes(NamedTuple):
    """Chosen frames of episodes, and counts of the others."""

    series: ImageSeries  # joints in rad
    joints: list[str]  # their names
    left_out: list[str]  # names of states that move no flange
    unit: str  # of the states, as a phrase
    frames: int  # number of all frames
    slow: int  # number of those at which no joint is fast
    empty: list[int]  # episodes without a slow frame

    @property
    def little(self) -> dict[str, float]:
        """Joints that moved little, and their ranges, degrees."""
        spans = np.ptp(self.series.joints.q, axis=0)
        return {
            name: math.degrees(span) for name, span in zip(self.joints, spans, strict=True) if span < _LITTLE
        }


def episode_of(pose: IntArray) -> IntArray:
    """Episodes (K,) of numbers of poses."""
    return np.asarray(pose // _FRAMES)


def numbers_in(text: str) -> list[int]:
    """Numbers of episodes, such as ``0-3,7``. Raises InputError."""
    found = set[int]()
    for part in text.split(","):
        match = re.fullmatch(r"\s*(\d{1,6})(?:\s*-\s*(\d{1,6}))?\s*", part)
        if match is None or int(match[2] or match[1]) < int(match[1]):
            raise InputError(
                f"--episodes {text}: {part.strip()!r} is no number or range; give 0-3,7 for example"
            )
        found |= {*range(int(match[1]), int(match[2] or match[1]) + 1)}
    return sorted(found)


def read_episodes(
    folder: Path,
    chosen: Sequence[int] | None,
    cameras: Mapping[str, str],
    state_unit: str | None,
    calibration_file: Path | None,
) -> Episodes:
    """Choose slow frames of episodes, spread over the joints.

    folder : data set with ``meta/info.json``; chosen : numbers of the episodes, None for all.
    cameras : by the name of each view, the key of its images; empty for all of the data set.
    state_unit : of the joints, None as the data set states; calibration_file : of normalised ones.
    Raises InputError if the data set cannot be read, or does not say what its numbers mean.
    """
    data = _DataSet.of(folder)
    keys, joints = data.cameras(cameras), data.joints()
    wanted = sorted(data.files) if chosen is None else chosen
    if missing := {*wanted} - {*data.files}:
        has = f"{min(data.files)} to {max(data.files)}" if data.files else "none"
        raise InputError(f"{folder}: there is no episode {min(missing)}; it has {has}")
    states = [data.states(e) for e in wanted]
    columns = [data.names.index(name) for name in joints]
    values = [state[:, columns] for state, _ in states]
    largest = max((float(np.abs(value).max()) for value in values), default=0.0)
    unit, how = data.unit(state_unit, largest)
    scale = np.array({"deg": math.radians(1.0), "rad": 1.0}.get(unit, math.nan))
    if unit == _NORMALISED:
        scale, how = _scales(data, calibration_file, joints), f"{how}, by {calibration_file}"
    pose, q, t, moving = list[int](), list[FloatArray](), list[float](), list[int]()
    images, empty, slow = list[tuple[StoredImage, ...]](), list[int](), 0
    shown = {wanted[k] for k in even_choice(len(wanted), _MOTIONS)}
    for e, value, (_, stamps) in zip(wanted, values, states, strict=True):
        of_frame = scale * value
        usable = _speeds(of_frame, stamps) < _SLOW
        if unit == _NORMALISED:  # at the end of a range the joint may be anywhere beyond
            usable &= (np.abs(value) < _FULL).all(axis=1)
        slow += int(usable.sum())
        rest = _spread(of_frame, usable, int(np.clip(_ALL // len(wanted), _LEAST, _MOST)))
        if not rest:
            empty.append(e)
            continue
        motion = {*_motion(of_frame, usable)} - {*rest} if e in shown else set[int]()
        rows = sorted([*rest, *motion])
        pose += [e * _FRAMES + k for k in rows]
        q += [*of_frame[rows]]
        t += (_EPISODE_S * e + stamps[rows]).tolist()
        moving += [(e + 1) * (k in motion) for k in rows]
        images += zip(*(data.images(e, key, stamps, rows) for key in keys.values()), strict=True)
    count = sum(map(len, values))
    if not pose:
        raise InputError(
            f"{folder}: at all {count} frames a joint is faster than {math.degrees(_SLOW):g}°/s: record an "
            "episode in which the arm pauses"
        )
    readings = JointList(np.array(pose), np.array(q), numbered=True)
    series = ImageSeries(tuple(keys), readings, images, np.array(moving), np.array(t))
    others = [name for name in data.names if name not in joints]
    words = f"{unit}, {how}"
    return Episodes(series, joints, others, words, count, slow, empty)


def _speeds(q: FloatArray, t: FloatArray) -> FloatArray:
    """Speeds (F,) of the fastest joint, rad/s, the larger one of before and after."""
    found = np.zeros(len(t))
    for other in (np.searchsorted(t, t - _HALF_S), np.searchsorted(t, t + _HALF_S, "right") - 1):
        apart = np.maximum(np.abs(t[other] - t), 1e-9)
        found = np.maximum(found, np.abs(q[other] - q).max(axis=1) / apart)
    return found


def _spread(q: FloatArray, usable: BoolArray, most: int) -> list[int]:
    """Rows of joints (F, n), each the farthest from all before; at most some, in order."""
    rows, far = list[int](), np.where(usable, np.inf, -1.0)
    while len(rows) < most and far.max(initial=-1.0) >= _APART:
        rows.append(int(np.argmax(far)))
        far = np.where(usable, np.minimum(far, np.abs(q - q[rows[-1]]).max(axis=1)), -1.0)
    return sorted(rows)


def _motion(q: FloatArray, usable: BoolArray) -> range:
    """Rows of the largest motion out of a rest, of joints (F, n)."""
    first = np.flatnonzero(usable[:-1] & ~usable[1:])
    if not first.size:
        return range(0)
    last = np.minimum(first + _MOTION, len(q) - 1)
    best = int(np.argmax(np.abs(q[last] - q[first]).max(axis=1)))
    return range(int(first[best]), int(last[best]))


def _scales(data: "_DataSet", path: Path | None, joints: Sequence[str]) -> FloatArray:
    """Radians (n,) of a normalised unit of each joint, by LeRobot's calibration file of motors.

    The middle of the range is zero, as it is where LeRobot writes degrees.
    """
    if path is None:
        raise InputError(
            f"{data.where}: {_STATE} is normalised, shares of a range that it does not have: give "
            "--calibration-file, the JSON of this arm from ~/.cache/huggingface/lerobot/calibration"
        )
    motors, scales = _json(path), []
    for name in (joint.removesuffix(".pos") for joint in joints):
        try:
            extent = int(motors[name]["range_max"]) - int(motors[name]["range_min"])
            scales.append((-1.0 if motors[name]["drive_mode"] else 1.0) * extent)
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(
                f"{path}: has no drive_mode, range_min and range_max of {name}; give the calibration file of "
                "the arm of these episodes"
            ) from error
    return np.array(scales) / (2.0 * _FULL) * 2.0 * math.pi / _TURN


@dataclass(frozen=True)
class _Stored:
    """Image that is read when it is looked at."""

    name: str
    read: Callable[[], FloatArray]

    def __str__(self) -> str:
        return self.name

    def grey(self) -> FloatArray:
        """Grey values (height, width). Raises InputError if there is no such image."""
        return self.read()


@dataclass(frozen=True)
class _DataSet:
    """Description of a data set."""

    where: Path  # its file
    fps: float
    features: Mapping[str, Any]
    # Of each episode, by key of a video or empty, the file and the time of its first frame there, s.
    files: Mapping[int, Mapping[str, tuple[Path, float]]]
    names: list[str]  # of the states
    tables: dict[Path, Any] = field(default_factory=dict)
    readers: dict[str, "_Reader"] = field(default_factory=dict)

    @classmethod
    def of(cls, folder: Path) -> "_DataSet":
        """Read the description. Raises InputError if there is none, or packages are missing."""
        _packages()
        where = folder / "meta" / "info.json"
        if not where.is_file():
            raise InputError(f"{where}: there is no such file; give the folder of a LeRobot data set")
        info = _json(where)
        version, parts = str(info.get("codebase_version")).lstrip("v"), ("chunk_index", "file_index")
        if version[:2] not in ("2.", "3."):
            raise InputError(f"{where}: codebase_version is {version}; 2.1 and 3.0 are read: convert it")
        try:
            features = info["features"]
            keys = ["", *(key for key, one in features.items() if one["dtype"] == "video")]
            groups = {key: f"videos/{key}/" if key else "data/" for key in keys}
            if version[0] == "2":
                lines = _text(folder / "meta" / "episodes.jsonl").splitlines()
                rows = [json.loads(line) for line in lines if line.strip()]
            else:
                columns = [f"{group}{part}" for group in groups.values() for part in parts]
                columns += [f"{group}from_timestamp" for key, group in groups.items() if key]
                tables = sorted((folder / "meta" / "episodes").glob("*/*.parquet"))
                rows = [
                    row for one in tables for row in _parquet(one, ["episode_index", *columns]).to_pylist()
                ]
            files = {}
            for row in rows:
                e = int(row["episode_index"])
                chunk, of_key = e // int(info.get("chunks_size", 1000)), {}
                for key, group in groups.items():
                    numbers = {part: row.get(group + part) for part in parts}
                    pattern = info["video_path" if key else "data_path"]
                    name = pattern.format(video_key=key, episode_index=e, episode_chunk=chunk, **numbers)
                    of_key[key] = folder / name, float(row.get(f"{group}from_timestamp", 0.0))
                files[e] = of_key
            names = features[_STATE].get("names")
            fps = float(info["fps"])
        except InputError:
            raise
        except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
            raise InputError(f"{where}: is not as LeRobot writes it: {error!r}") from error
        names = next(iter(names.values()), None) if isinstance(names, dict) else names
        if not (isinstance(names, list) and all(isinstance(name, str) for name in names)):
            raise InputError(f"{where}: {_STATE} has no names; name its joints there, from base to tool")
        return cls(where, fps, features, files, names)

    def cameras(self, asked: Mapping[str, str]) -> dict[str, str]:
        """Keys of images by the names of the views: all, or those asked for, with or without their prefix."""
        short = {
            key.removeprefix(_IMAGES): key
            for key, one in self.features.items()
            if one["dtype"] in ("video", "image")
            and not any("depth_map" in name and flag for name, flag in (one.get("info") or {}).items())
        }
        named = asked or {view_named(re.sub(r"[\W_]+", "_", name).strip("_")): name for name in short}
        found = {view: short.get(name.removeprefix(_IMAGES), "") for view, name in named.items()}
        if not all(found.values()) or not found:
            raise InputError(f"{self.where}: has no such images; it has {', '.join(short) or 'none'}")
        if len(found) < len(asked or short) or not all(re.fullmatch(VIEW_NAME, view) for view in found):
            raise InputError(f"{self.where}: name the cameras {', '.join(short)}, such as top=KEY")
        return found

    def joints(self) -> list[str]:
        """Names of the states that move the flange."""
        places = [name for name in self.names if name.endswith(".pos")] or self.names
        joints = [name for name in places if "gripper" not in name.lower()]
        if len({*self.names}) < len(self.names) or not joints:
            raise InputError(f"{self.where}: names of {_STATE} are no joints: {', '.join(self.names)}")
        return joints

    def unit(self, stated: str | None, largest: float) -> tuple[str, str]:
        """Unit of the states, whose largest value is given, and how it is known."""
        state = self.features[_STATE]
        said = state.get("units", state.get("unit")) or []
        words = [said] if isinstance(said, str) else [*said]
        if len(words) == len(self.names):  # a gripper may be in another
            words = [word for name, word in zip(self.names, words, strict=True) if name in self.joints()]
        found = {_UNITS.get(str(word).lower(), f"{word!r}") for word in words} | {stated} - {None}
        if len(found) > 1 or found - {*_LARGEST}:
            raise InputError(
                f"{self.where}: {_STATE} is in {' and '.join(sorted(map(str, found)))}; expected one of "
                f"{', '.join(_LARGEST)}"
            )
        unit, how = next(iter(found), None), "as the data set says" if words else "as stated"
        if unit is None and largest > _FULL:
            unit, how = "deg", f"since values reach {largest:.0f}"
        if unit is None:
            raise InputError(
                f"{self.where}: does not say the unit of {_STATE}, whose values reach {largest:.3g}: give "
                "--state-unit deg, rad, or normalised with --calibration-file"
            )
        if largest > _LARGEST[unit]:
            raise InputError(
                f"{self.where}: {_STATE} reaches {largest:.4g}, more than {_LARGEST[unit]:.4g}: it is not "
                f"{unit}; give another --state-unit, or correct the data set"
            )
        return unit, how

    def states(self, e: int) -> tuple[FloatArray, FloatArray]:
        """States (F, s) and times (F,), s, of the frames of an episode."""
        path, columns = self.files[e][""][0], (_STATE, "timestamp", "episode_index")
        if path not in self.tables:
            table = _parquet(path, columns)
            self.tables[path] = [table[column].to_pylist() for column in columns]
        rows = [row for row in zip(*self.tables[path], strict=True) if row[-1] == e]
        try:
            state, t = (np.array([row[i] for row in rows], dtype=np.float64) for i in (0, 1))
        except (TypeError, ValueError):
            state, t = np.zeros((0, 0)), np.zeros(0)
        if not rows or state.shape[1:] != (len(self.names),) or not np.isfinite(state).all():
            raise InputError(f"{path}: episode {e} has not {len(self.names)} finite states in every frame")
        if not (np.diff(t) > 0.0).all() or len(t) > _FRAMES:
            raise InputError(f"{path}: timestamp of episode {e} does not rise over {_FRAMES} frames or fewer")
        return state, t

    def images(self, e: int, key: str, t: FloatArray, rows: Sequence[int]) -> Iterator[StoredImage]:
        """Images of a camera at rows of an episode, with times (F,), s."""
        path, first = self.files[e].get(key, self.files[e][""])
        video, cells = self.features[key]["dtype"] == "video", None
        if not video:
            cells = _parquet(path, [key], e)[key]
        reader = self.readers.setdefault(key, _Reader(0.5 / self.fps))
        for k in rows:
            name = f"{path}: {key} of episode {e} at {t[k]:.3f} s"
            if cells is None:
                yield _Stored(name, partial(reader.at, path, first + float(t[k])))
            else:
                yield _Stored(name, partial(decoded, (cells[k].as_py() or {}).get("bytes") or b"", name))


class _Reader:
    """Frames of the videos of one camera, of which one is open at a time.

    tolerance : maximum distance of a frame from its time, s.
    """

    def __init__(self, tolerance: float) -> None:
        self._tolerance = tolerance
        self._path: Path | None = None
        self._container: Any = None
        self._frames: Iterator[Any] = iter(())
        self._last: Any = None

    def at(self, path: Path, t: float) -> FloatArray:
        """Grey values (height, width) of the frame at a time, s. Raises InputError if there is none."""
        av, near = _packages()[1], self._tolerance
        try:
            if path != self._path:
                if self._container is not None:
                    self._container.close()
                self._path = self._last = None
                self._container = av.open(str(path))
                self._path = path
            if self._last is None or not self._last.time - near < t < self._last.time + _NEAR_S:
                stream = self._container.streams.video[0]
                self._container.seek(max(int((t - near) / stream.time_base), 0), stream=stream)
                self._frames = self._container.decode(stream)
                self._last = next(self._frames)
            while self._last.time < t - near:
                self._last = next(self._frames)
            if self._last.time <= t + near:
                return np.asarray(self._last.to_ndarray(format="gray"), dtype=np.float64)
        except StopIteration:
            self._last = None
        except (av.FFmpegError, OSError, IndexError) as error:
            raise InputError(f"{path}: cannot be read as a video: {error}") from error
        raise InputError(f"{path}: has no frame at {t:.3f} s, of which there is a state; download it again")


def _packages() -> tuple[Any, Any]:
    """Return the modules of Parquet and video. Raises InputError if one is missing."""
    try:
        import av
        import pyarrow.parquet
    except ImportError as error:
        raise InputError("episodes need pyarrow and PyAV: pip install '.[lerobot]'") from error
    return pyarrow.parquet, av


def _parquet(path: Path, columns: Sequence[str], episode: int | None = None) -> Any:
    """Return columns of a table, perhaps of one episode. Raises InputError if it cannot be read."""
    rows = None if episode is None else [("episode_index", "=", episode)]
    try:
        table = _packages()[0].read_table(path, columns=[*columns], filters=rows)
    except (OSError, ValueError, KeyError, NotImplementedError) as error:
        raise InputError(f"{path}: cannot be read as Parquet: {error}") from error
    if missing := {*columns} - {*table.column_names}:
        raise InputError(f"{path}: has no column {min(missing)}")
    return table


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read: {error}") from error


def _json(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(_text(path))
    except ValueError as error:
        raise InputError(f"{path}: is not JSON: {error}") from error
    if not isinstance(found, dict):
        raise InputError(f"{path}: holds no object of JSON")
    return found
