"""What a calibration works on: joint readings and the marker pairs seen in them, as flat lists."""

import dataclasses
from dataclasses import dataclass

import numpy as np

from projservo_cli.records import BoolArray, FloatArray, InputError, IntArray, Observation

# Two joint readings closer than this are the same reading: far below any encoder's resolution.
SAME_READING = 1e-7


@dataclass(frozen=True, eq=False)
class Readings:
    """Every marker seen at a pose by at least one camera, ordered by marker and then by pose.

    Attributes
    ----------
    q : (K, n) joint readings, rad or m.
    prismatic : (n,) whether the joint is prismatic.
    pose : (K,) numbers of the poses.
    marker : (m,) numbers of the markers.
    pose_of : (N,) row of ``q``.
    marker_of : (N,) position in ``marker``, never falling.
    pixels : (2, N, 2) px, zero where not seen.
    seen : (2, N) whether the view saw the marker.
    """

    q: FloatArray
    prismatic: BoolArray
    pose: IntArray
    marker: IntArray
    pose_of: IntArray
    marker_of: IntArray
    pixels: FloatArray
    seen: BoolArray

    @property
    def both(self) -> BoolArray:
        """(N,) whether both views saw the marker."""
        result: BoolArray = np.logical_and(self.seen[0], self.seen[1])
        return result


def require_shapes(observation: Observation) -> None:
    """Refuse an observation whose arrays do not fit each other.

    Raises
    ------
    InputError
        Naming the array and its shape.
    """
    if observation.q.ndim != 2:
        raise InputError(f"joint readings of shape {observation.q.shape}: expected (poses, joints)")
    for name, numbers in (("pose", observation.pose), ("marker", observation.marker)):
        if numbers.ndim != 1:
            raise InputError(f"{name} numbers of shape {numbers.shape}: expected one dimension")
        values, count = np.unique(numbers, return_counts=True)
        if (count > 1).any():
            raise InputError(f"{name} number {values[count > 1][0]} stands twice: number each {name} once")
    K, m = len(observation.q), len(observation.marker)
    if len(observation.pose) != K:
        raise InputError(f"{len(observation.pose)} pose numbers for {K} rows of joint readings")
    if observation.images.shape != (K, 2, m, 2):
        raise InputError(
            f"images of shape {observation.images.shape}: expected {(K, 2, m, 2)} for {K} poses, two views, "
            f"{m} markers and two coordinates"
        )


def gather(observation: Observation, joint_types: str) -> Readings:
    """Flatten an observation into the list of what was seen.

    Parameters
    ----------
    observation : stereo images of markers at K poses, px, NaN where unseen.
    joint_types : one letter a joint, R or P.

    Raises
    ------
    InputError
        If the arrays or the letters do not fit each other, or values are not finite.
    """
    require_shapes(observation)
    letters = joint_types.upper()
    n = observation.q.shape[1]
    if len(letters) != n or set(letters) - {"R", "P"}:
        raise InputError(f"joint types {joint_types!r}: expected {n} letters R or P, one a joint")
    if not np.isfinite(observation.q).all():
        raise InputError("joint readings must be finite numbers")
    finite = np.isfinite(observation.images[..., 0]) & np.isfinite(observation.images[..., 1])
    if np.isinf(observation.images).any():
        raise InputError("pixels must be finite numbers, or missing where a marker was not seen")
    marker_of, pose_of = np.nonzero(finite.any(axis=1).T)
    seen = finite[pose_of, :, marker_of].T
    pixels = np.where(seen[..., None], observation.images[pose_of, :, marker_of].transpose(1, 0, 2), 0.0)
    present = np.unique(marker_of)
    return Readings(
        q=np.array(observation.q, dtype=np.float64),
        prismatic=np.array([letter == "P" for letter in letters]),
        pose=observation.pose,
        marker=observation.marker[present],
        pose_of=pose_of,
        marker_of=np.searchsorted(present, marker_of),
        pixels=pixels,
        seen=seen,
    )


def restrict(readings: Readings, keep: BoolArray) -> Readings:
    """Readings of some of the markers.

    Parameters
    ----------
    readings : what was seen.
    keep : (m,) markers that stay.
    """
    rows = keep[readings.marker_of]
    return dataclasses.replace(
        readings,
        marker=readings.marker[keep],
        pose_of=readings.pose_of[rows],
        marker_of=(np.cumsum(keep) - 1)[readings.marker_of[rows]],
        pixels=readings.pixels[:, rows],
        seen=readings.seen[:, rows],
    )


def of_poses(readings: Readings, keep: BoolArray) -> Readings:
    """Readings at some of the poses; the lists of poses and markers stay.

    Parameters
    ----------
    readings : what was seen.
    keep : (K,) poses that stay.
    """
    rows = keep[readings.pose_of]
    return dataclasses.replace(
        readings,
        pose_of=readings.pose_of[rows],
        marker_of=readings.marker_of[rows],
        pixels=readings.pixels[:, rows],
        seen=readings.seen[:, rows],
    )


def reference_pose(q: FloatArray) -> int | None:
    """Row from which every other differs in at most one joint, or None: the pose of single-joint trials.

    Parameters
    ----------
    q : (K, n) joint readings, rad or m.
    """
    changed = (np.abs(q[:, None] - q[None]) > SAME_READING).sum(axis=2)
    candidates = np.flatnonzero((changed <= 1).all(axis=1))
    if candidates.size == 0:
        return None
    # With trials of a single joint every row qualifies: the one in the middle moves least.
    travel = np.abs(q[:, None] - q[None]).sum(axis=(1, 2))
    return int(candidates[np.argmin(travel[candidates])])


def joint_trials(q: FloatArray, home: int) -> list[list[int]]:
    """Rows of each joint's trials, in which it differs from the reference.

    Parameters
    ----------
    q : (K, n) joint readings of single-joint trials, rad or m.
    home : row of the reference.
    """
    moved = np.abs(q - q[home]) > SAME_READING
    return [np.flatnonzero(moved[:, i]).tolist() for i in range(q.shape[1])]


def reference_joints(q: FloatArray) -> FloatArray:
    """Joint readings the model is written about: the trials' reference, else the most central pose.

    Parameters
    ----------
    q : (K, n) joint readings, rad or m.
    """
    row = reference_pose(q)
    if row is None:
        span = np.ptp(q, axis=0)
        deviation = (q - np.median(q, axis=0)) / np.where(span > 0.0, span, 1.0)
        row = int(np.argmin((deviation**2).sum(axis=1)))
    result: FloatArray = q[row].copy()
    return result
