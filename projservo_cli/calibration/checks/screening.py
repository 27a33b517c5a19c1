"""Screening of a recording before all geometry: unseen poses, placeholders, and readings that pass a turn."""

import dataclasses
import math
from typing import NamedTuple

import numpy as np

from projservo_cli.calibration.detections import require_shapes
from projservo_cli.findings import LIMITS, Finding, Subject
from projservo_cli.records import FloatArray, IntArray, Observation

# Maximum distance around the circle between both ends of readings that pass a full turn, rad, and in mean
# spacings of the readings if they leave less than half a turn free.
_MAX_STEP, _MAX_SPACINGS = np.pi / 3.0, 5.0
# Probability that readings spread evenly over their range leave so wide a gap by chance.
_CHANCE = 1e-3
# Minimum number of detections, or of markers, at one number that no camera saw there.
_REPEATED, _MARKERS = 3, 4
# Numbers of a missing pixel at the corner of an image, px, maximum share of others below, minimum frequency.
_CORNERS, _BELOW, _MORE = (0.0, -1.0), 0.01, 2.0
# Quartile distances beyond the quartiles above which no detection lies, J. W. Tukey's outer fence.
_FENCE = 3.0
# Degree, rad, by which readings stay within the ends of a turn.
_DEGREE = math.radians(1.0)


class _Screening(NamedTuple):
    """A recording without placeholders and unseen poses, and the findings."""

    observation: Observation
    unseen: IntArray  # numbers of the poses at rest that no camera saw
    placeholders: int  # number of detections in place of an unseen marker
    circular: IntArray  # numbers of the joints, from 1, whose readings passed a full turn
    findings: tuple[Finding, ...]


def screened(observation: Observation, joint_types: str) -> _Screening:
    """Empty placeholders, drop poses that nobody saw, and unwrap readings; one letter a joint, R or P.

    Raises InputError if the arrays do not fit each other.
    """
    require_shapes(observation)
    images, found = without_placeholders(observation.images, observation.marker)
    count = int(np.isnan(images[..., 0]).sum() - np.isnan(observation.images[..., 0]).sum())
    lost = np.asarray(np.isnan(images)).any(axis=3).reshape(len(images), -1).all(axis=1)
    if observation.moving is not None:
        lost &= observation.moving == 0
    if (unseen := observation.pose[lost]).size:
        subject = Subject(poses=tuple(unseen.tolist()))
        found += (Finding("unseen_poses", LIMITS, subject, unseen.size, unit="1"),)
    kept = dataclasses.replace(observation, images=images).rows(np.asarray(~lost))
    q, joints = np.array(kept.q, dtype=np.float64), list[int]()
    for i, letter in enumerate(joint_types.upper()[: q.shape[1]]):
        if letter == "R" and (turns := _turns(q[:, i])).any():
            low, high = float(q[:, i].min()), float(q[:, i].max())
            end = math.pi * round(0.5 * (low + high) / math.pi + 1.0) - _DEGREE  # end of their convention
            q[:, i] += 2.0 * np.pi * turns
            joints.append(i + 1)
            other = end - 2.0 * (math.pi - _DEGREE)
            ends = (Finding("circular_readings", amount=end, limit=other, unit="rad"),)
            subject, taken, given = Subject(joints=(i + 1,)), float(np.ptp(q[:, i])), high - low
            one = Finding("circular_readings", LIMITS, subject, taken, limit=given, unit="rad", others=ends)
            found += (one,)
    return _Screening(dataclasses.replace(kept, q=q), unseen, count, np.array(joints, dtype=np.int64), found)


def _turns(q: FloatArray) -> FloatArray:
    """Full turns (K,), rad, to add to readings of a revolute joint that pass the end of a turn.

    The readings are cut at the widest gap on the circle. Both ends must be close together around the circle,
    and the gap must be more than half a turn, or than chance leaves among readings spread over their range.
    """
    turn, none = 2.0 * np.pi, np.zeros(len(q))
    circle = np.unique(np.mod(q, turn))
    span, m = float(np.ptp(q)) if len(q) else 0.0, circle.size
    if not turn - _MAX_STEP <= span <= turn + 1e-9 or m < 2:
        return none
    gaps, step = np.diff(circle, append=circle[0] + turn), max(turn - span, 0.0)
    gap, first = float(gaps.max()), circle[(int(np.argmax(gaps)) + 1) % m]
    if gap < np.pi + 1e-6:
        chance = (m - 1) * (1.0 - gap / span) ** (m - 2)
        if chance > _CHANCE or gap < 2.0 * step or step * (m - 1) > _MAX_SPACINGS * (turn - gap):
            return none
    turns = np.rint((first + np.mod(q - first + 1e-12, turn) - q) / turn)
    values, count = np.unique(turns, return_counts=True)
    return np.asarray(turns - values[np.argmax(count)])


def without_placeholders(images: FloatArray, marker: IntArray) -> tuple[FloatArray, tuple[Finding, ...]]:
    """Images (K, V, m, 2) with NaN for numbers that mean unseen markers, and findings that name them.

    Such a number, as 9999, -1 or 0, repeats exactly over markers and poses: far outside the others or at the
    corner of the image in one coordinate, as one pixel of two markers in an image, or as a subpixel of many.
    """
    at = np.nonzero(np.isfinite(images).all(axis=-1))
    V = images.shape[1]
    seen, image, track = images[at], V * at[0] + at[1], V * at[2] + at[1]
    found = np.full(seen.shape, np.nan)
    for c, column in enumerate(seen.T if len(seen) else ()):
        values, count = np.unique(column, return_counts=True)
        low, high = np.percentile(values, [25, 75])
        far = np.abs(values - np.clip(values, low, high)) > _FENCE * (high - low)
        corner = np.isin(values, _CORNERS) & (np.arange(values.size) < _BELOW * values.size + 1)
        corner &= count > _MORE * np.median(count)
        for value in values[(count >= _REPEATED) & (far | corner)]:
            rows = column == value
            if rows.sum() < np.isin(track, track[rows]).sum() and np.ptp(
                image[rows]
            ):  # otherwise it is at rest
                found[rows, c] = value
    whole = len(seen) == 0 or np.mean(seen == np.rint(seen)) > 0.5
    _, inverse, count = np.unique(seen @ [1.0, 1.0j], return_inverse=True, return_counts=True)
    often = np.flatnonzero(count[inverse] >= _REPEATED)
    often = often[np.argsort(inverse[often], kind="stable")]
    for rows in np.split(often, np.flatnonzero(np.diff(inverse[often])) + 1):
        together = np.unique(image[rows], return_counts=True)[1]
        many = not whole and min(np.unique(at[2][rows]).size, together.size) >= _MARKERS
        if many or (together > 1).sum() > 1:
            found[rows] = seen[rows]
    wrong = np.isfinite(found).any(axis=-1)
    # A view whose every detection is such a number shows one spot, which the checks of images refuse by its
    # name.
    if not wrong.any() or any(wrong[at[1] == view].all() for view in range(V)):
        return images, ()
    named: dict[str, set[tuple[int, int]]] = {}
    for label, k, j in zip(found[wrong], at[0][wrong].tolist(), at[2][wrong].tolist(), strict=True):
        name = ", ".join(f"{axis} = {x:.6g}" for axis, x in zip("uv", label, strict=True) if np.isfinite(x))
        named.setdefault(name, set()).add((k, j))
    images = images.copy()
    images[tuple(part[wrong] for part in at)] = np.nan
    return images, tuple(
        Finding(
            "placeholders",
            LIMITS,
            Subject(markers=tuple(int(marker[j]) for j in sorted({j for _, j in rows})), name=name),
            len(rows),
            unit="1",
        )
        for name, rows in sorted(named.items(), key=lambda item: -len(item[1]))
    )
