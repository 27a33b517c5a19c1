"""Readings in messages of ROS: joint states by name, poses, and chains of transforms between two frames."""

from collections import Counter, defaultdict
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from projservo_cli.detection.stops import Stream, poses_at
from projservo_cli.geometry.displacements import rigid_inverse
from projservo_cli.geometry.flange import UNIT, FlangeChart
from projservo_cli.records import FloatArray, InputError, IntArray

JOINTS, POSE = "sensor_msgs/msg/JointState", "geometry_msgs/msg/PoseStamped"
TREES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")  # the second one of early ROS 1
# Minimum number of readings, for times between them and second differences.
_LEAST = 3


class Readings:
    """Readings of a topic, as messages bring them.

    where : bag and topic, for messages; notes : takes sentences on messages that are left out.
    """

    def __init__(self, where: str, notes: list[str]) -> None:
        self._where, self._notes = where, notes
        self._joints = list[tuple[int, tuple[str, ...], FloatArray]]()
        # poses of each frame in its parents, with their stamps, ns
        self._poses = defaultdict[str, dict[str, list[tuple[int, list[float]]]]](dict)
        self._wrong = 0

    def add_joints(self, stamp: int, message: Any) -> None:
        """Take a JointState."""
        self._joints.append((stamp, tuple(message.name), np.asarray(message.position, dtype=np.float64)))

    def add_pose(self, stamp: int, message: Any) -> None:
        """Take a PoseStamped."""
        self._add(stamp, message.pose.position, message.pose.orientation, "", "")

    def add_transform(self, stamp: int, message: Any) -> None:
        """Take a TransformStamped."""
        T, parent = message.transform, message.header.frame_id
        self._add(stamp, T.translation, T.rotation, parent, message.child_frame_id)

    def _add(self, stamp: int, place: Any, turn: Any, parent: str, child: str) -> None:
        """Take a pose of a frame in its parent, unless it is none."""
        row = [place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w]
        if np.isfinite(row).all() and abs(np.linalg.norm(row[3:]) - 1.0) <= UNIT:
            of_child = self._poses[child.lstrip("/")]
            of_child.setdefault(parent.lstrip("/"), []).append((stamp, row))
        else:
            self._wrong += 1

    def stream(self, frames: tuple[str, str] | None, names: Sequence[str]) -> tuple[int, Stream]:
        """Time of the first reading, ns, and all readings, at times from there on.

        frames : base and flange of transforms; names : of the joints, by default those of most messages.
        Raises InputError if there are too few, or no chain between the frames.
        """
        if self._joints:
            stamps, q = self._of_joints(names)
            T = None
        else:
            stamps, T = self._chain(*frames) if frames else _sorted(self._poses.get("", {}).get("", []))
        if self._wrong:
            self._notes.append(f"{self._where}: {self._wrong} poses without a unit quaternion were left out")
        if len(stamps) < _LEAST:
            raise InputError(
                f"{self._where}: {len(stamps)} readings; record {_LEAST} or more, with the images"
            )
        t = 1e-9 * (stamps - stamps[0])
        if T is None:
            return int(stamps[0]), Stream(t, q)
        chart = FlangeChart.of(T)
        return int(stamps[0]), Stream(t, chart.coordinates(T), T, chart)

    def _of_joints(self, names: Sequence[str]) -> tuple[IntArray, FloatArray]:
        """Stamps (T,), ns, and positions (T, n) of joints, whatever their order in a message."""
        whole = [row for row in self._joints if len(row[1]) == len(row[2]) and np.isfinite(row[2]).all()]
        if missing := {*names} - {name for _, of_row, _ in whole for name in of_row}:
            known = sorted({name for _, of_row, _ in whole for name in of_row})
            raise InputError(f"{self._where}: no joint {', '.join(missing)}; there are: {', '.join(known)}")
        if not names and whole:
            most = Counter(frozenset(of_row) for _, of_row, _ in whole).most_common(1)[0][0]
            names = next(of_row for _, of_row, _ in whole if {*of_row} == most)
            whole = [row for row in whole if {*row[1]} == most]
        whole = [row for row in whole if {*names} <= {*row[1]}]
        if others := len(self._joints) - len(whole):
            self._notes.append(
                f"{self._where}: {others} of {len(self._joints)} messages have other joints or no positions, "
                "and were left out"
            )
        self._notes.append(f"{self._where}: q1 … q{len(names)} are {', '.join(names)}")
        q = np.array([[position[of_row.index(name)] for name in names] for _, of_row, position in whole])
        stamps, first = np.unique(np.array([row[0] for row in whole], dtype=np.int64), return_index=True)
        return stamps, q[first].reshape(len(first), len(names))

    def _chain(self, base: str, flange: str) -> tuple[IntArray, FloatArray]:
        """Stamps (T,), ns, and poses (T, 4, 4) of a frame in another, at the stamps of its busiest part."""
        up, down = self._line(base), self._line(flange)
        common = next((frame for frame in up if frame in down), None)
        if common is None:
            raise InputError(f"{self._where}: {base} and {flange} have no common parent: record all of tf")
        up, down = up[: up.index(common)], down[: down.index(common)]
        parts = {frame: _sorted(*self._poses[frame].values()) for frame in (*up, *down)}
        busiest = max(parts.values(), key=lambda part: len(part[0]), default=None)
        if busiest is None or len(busiest[0]) == 1:
            raise InputError(f"{self._where}: {flange} does not move in {base}; name the frames of the robot")
        stamps = busiest[0]
        for there, _ in parts.values():
            if len(there) > 1:
                stamps = stamps[(stamps >= there[0]) & (stamps <= there[-1])]
        T = {frame: poses_at(1e-9 * (at - busiest[0][0]), poses, 1e-9 * (stamps - busiest[0][0]))
             for frame, (at, poses) in parts.items()}  # fmt: skip
        found = [np.broadcast_to(np.eye(4), (len(stamps), 4, 4))] * 2
        for side, line in enumerate((up, down)):
            for frame in line:
                found[side] = T[frame] @ found[side]
        return stamps, rigid_inverse(found[0]) @ found[1]

    def _line(self, frame: str) -> list[str]:
        """Frames from one up to the root."""
        line = [frame.lstrip("/")]
        known = {*self._poses, *(parent for parents in self._poses.values() for parent in parents)}
        if line[0] not in known:
            raise InputError(f"{self._where}: no frame {frame}; there are: {', '.join(sorted(known))}")
        while parents := self._poses.get(line[-1]):
            parent = next(iter(parents))
            if len(parents) > 1 or parent in line:
                raise InputError(
                    f"{self._where}: {line[-1]} is in {', '.join(parents)}; a frame has one parent"
                )
            line.append(parent)
        return line


def _sorted(rows: list[tuple[int, list[float]]]) -> tuple[IntArray, FloatArray]:
    """Stamps (T,) of poses in their order, each once, and the poses (T, 4, 4)."""
    stamps, first = np.unique(np.array([stamp for stamp, _ in rows], dtype=np.int64), return_index=True)
    values = np.array([row for _, row in rows]).reshape(-1, 7)[first]
    T = np.tile(np.eye(4), (len(values), 1, 1))
    if len(values):
        T[:, :3, :3], T[:, :3, 3] = Rotation.from_quat(values[:, 3:]).as_matrix(), values[:, :3]
    return stamps, T
