"""Screening of a recording before all geometry: unseen poses, placeholders, and readings that pass a turn."""

import dataclasses
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np

from projservo_cli.calibration.detections import require_shapes
from projservo_cli.records import FloatArray, IntArray, Observation, WorkFailed

# A full turn, rad.
_TURN = 2.0 * np.pi
# Maximum distance around the circle between both ends of the readings, rad, if they pass a full turn.
_MAX_STEP = np.pi / 3.0
# That distance, in mean spacings of the readings, if they leave less than half a turn free.
_MAX_SPACINGS = 5.0
# Probability that readings spread evenly over their range leave so wide a gap by chance.
_CHANCE = 1e-3
# Minimum number of detections with one coordinate, or markers with one pixel, that no camera saw there.
_REPEATED, _MARKERS = 3, 4
# Coordinates that stand for a missing pixel at the corner of an image, px, and share of others below them.
_CORNERS, _BELOW = (0.0, -1.0), 0.01
# Minimum ratio of their number to that of another number: pixels on a coarse grid repeat, too.
_MORE = 2.0
# Quartile distances beyond the quartiles above which no detection lies, J. W. Tukey's outer fence.
_FENCE = 3.0
# Maximum number of numbers that a message names.
_EXAMPLES = 3


class Screening(NamedTuple):
    """A recording without what is no observation, and what was found."""

    observation: Observation
    unseen: IntArray  # numbers of the poses at rest that no camera saw
    placeholders: int  # number of detections that stood for an unseen marker
    circular: IntArray  # numbers of the joints, from 1, whose readings passed a full turn
    advice: tuple[str, ...]  # a line for each kind that was found

    @contextmanager
    def told(self) -> Iterator[None]:
        """Add what was found to the reason of a WorkFailed."""
        try:
            yield
        except WorkFailed as error:
            raise type(error)("; ".join((str(error), *self.advice))) from error


def screened(observation: Observation, joint_types: str) -> Screening:
    """Empty placeholders, drop poses that nobody saw, and unwrap readings; one letter a joint, R or P.

    Raises InputError if the arrays do not fit each other.
    """
    require_shapes(observation)
    images, advice = without_placeholders(observation.images)
    count = int(np.isfinite(observation.images[..., 0]).sum() - np.isfinite(images[..., 0]).sum())
    lost = np.asarray(np.isnan(images)).any(axis=3).reshape(len(images), -1).all(axis=1)
    if observation.moving is not None:
        lost &= observation.moving == 0
    unseen = observation.pose[lost]
    if unseen.size:
        numbers = ", ".join(map(str, unseen[:_EXAMPLES])) + ", …" * (unseen.size > _EXAMPLES)
        several = unseen.size > 1
        advice += (
            f"{unseen.size} pose{'s' * several} that no camera saw {'were' if several else 'was'} dropped "
            f"({numbers}): look why no marker was found there",
        )
    kept = dataclasses.replace(observation, images=images).rows(np.asarray(~lost))
    q, joints = np.array(kept.q, dtype=np.float64), list[int]()
    for i, letter in zip(
        range(q.shape[1]), joint_types.upper(), strict=False
    ):  # their number is checked later
        if letter == "R" and (turns := _turns(q[:, i])).any():
            high, low = np.degrees([q[:, i].max(), q[:, i].min()])
            end = 180 * round(high / 360.0 + low / 360.0 + 1.0) - 1  # of the convention of the readings
            q[:, i] += _TURN * turns
            first, last = np.degrees([q[:, i].min(), q[:, i].max()])
            joints.append(i + 1)
            advice += (
                f"readings of joint {i + 1} pass {end}° to {end - 358}°: taken as {first:.4g}° to "
                f"{last:.4g}° (a range of {last - first:.3g}°, as given {high - low:.3g}°)",
            )
    if joints:
        kept = dataclasses.replace(kept, q=q)
    return Screening(kept, unseen, count, np.array(joints, dtype=np.int64), advice)


def _turns(q: FloatArray) -> FloatArray:
    """Full turns (K,) to add to readings of a revolute joint, rad, which pass the end of a turn; else zero.

    The readings are cut at the widest gap on the circle. Both ends must be close together around the circle,
    and the gap must be more than half a turn, or than chance leaves among readings spread over their range.
    """
    none, span = np.zeros(len(q)), float(np.ptp(q)) if np.isfinite(q).all() and len(q) else 0.0
    step, circle = max(_TURN - span, 0.0), np.unique(np.mod(q, _TURN))
    if step > _MAX_STEP or span > _TURN + 1e-9 or circle.size < 2:
        return none
    gaps = np.diff(circle, append=circle[0] + _TURN)
    k = int(np.argmax(gaps))
    gap, m = float(gaps[k]), circle.size
    if gap < np.pi + 1e-6:
        chance = (m - 1) * (1.0 - gap / span) ** (m - 2)
        if chance > _CHANCE or gap < 2.0 * step or step * (m - 1) > _MAX_SPACINGS * (_TURN - gap):
            return none
    first = circle[(k + 1) % m]
    turns = np.rint((first + np.mod(q - first + 1e-12, _TURN) - q) / _TURN)
    values, count = np.unique(turns, return_counts=True)
    return np.asarray(turns - values[np.argmax(count)])


def without_placeholders(images: FloatArray) -> tuple[FloatArray, tuple[str, ...]]:
    """Images (K, 2, m, 2) with NaN for numbers that stand for unseen markers, and advice that names them.

    A detector or an export writes 9999, -1 or 0 where a marker was not seen. Such a number repeats exactly
    over markers and poses: far outside the others or at the corner of the image in one coordinate, as one
    pixel of two markers in an image, or as one subpixel of many markers.
    """
    label = _placeholders(images)
    wrong = np.asarray(np.isfinite(label).any(axis=-1))
    if not wrong.any():
        return images, ()
    found: dict[str, list[tuple[int, int]]] = {}
    for k, view, j in np.argwhere(wrong).tolist():
        pairs = zip("uv", label[k, view, j], strict=True)
        name = ", ".join(f"{axis} = {value:.6g}" for axis, value in pairs if np.isfinite(value))
        found.setdefault(name, []).append((k, j))
    each = sorted(found.items(), key=lambda item: -len(item[1]))
    text = "; ".join(
        f"{name} stands in {len(set(at))} rows of "
        + ("several markers and poses" if len({j for _, j in at}) > 1 else "several poses of one marker")
        for name, at in each[:_EXAMPLES]
    )
    more = f"; {len(each) - _EXAMPLES} further numbers" if len(each) > _EXAMPLES else ""
    return np.where(wrong[..., None], np.nan, images), (
        f"{text}{more}: no camera saw that, so it was taken as unseen; empty these cells",
    )


def _placeholders(images: FloatArray) -> FloatArray:
    """Coordinates (K, 2, m, 2) of images that stand for unseen markers; NaN elsewhere."""
    label = np.full(images.shape, np.nan)
    at = np.nonzero(np.isfinite(images).all(axis=-1))
    seen, image, marker = images[at], 2 * at[0] + at[1], at[2]
    track = 2 * marker + at[1]
    found = np.full(seen.shape, np.nan)
    for c, column in enumerate(seen.T):
        values, count = np.unique(column, return_counts=True)
        low, high = np.percentile(values, [25, 75]) if values.size else (0.0, 0.0)
        far = np.abs(values - np.clip(values, low, high)) > _FENCE * (high - low)
        corner = np.isin(values, _CORNERS) & (np.arange(values.size) < _BELOW * values.size + 1)
        corner &= count > _MORE * np.median(count) if values.size else False
        for value in values[(count >= _REPEATED) & (far | corner)]:
            rows = column == value
            still = rows.sum() == np.isin(track, track[rows]).sum()
            if not still and np.unique(image[rows]).size > 1:
                found[rows, c] = value
    whole = np.mean(seen == np.rint(seen)) > 0.5 if seen.size else True
    _, inverse, count = np.unique(seen @ [1.0, 1.0j], return_inverse=True, return_counts=True)
    often = np.flatnonzero(count[inverse] >= _REPEATED)
    often = often[np.argsort(inverse[often], kind="stable")]
    for rows in np.split(often, np.flatnonzero(np.diff(inverse[often])) + 1):
        together = np.unique(image[rows], return_counts=True)[1] > 1  # two markers in one pixel of an image
        many = not whole and min(np.unique(marker[rows]).size, together.size) >= _MARKERS
        if many or together.sum() > 1:
            found[rows] = seen[rows]
    # A view that shows nothing else shows one spot, which the checks of images refuse by its name.
    good = np.isnan(found).all(axis=-1)
    if all(good[at[1] == view].any() for view in np.unique(at[1])):
        label[at] = found
    return label
