"""By how much the images of each view are late, from what was seen on the way between trial poses.

A frame that comes with the joint reading of an instant t_q shows the joints of t_q − d. What is seen less
what is predicted for joints at t_q − d is noise; a wrong d shows along the image velocity J_q q̇. Each frame
tells its own d, and their mean and spread are that of the view: no noise has to be known. Where frames
carry stamps, a constant is estimated likewise, by which their clock is off that of the readings.
"""

from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq
from scipy.special import stdtrit

from projservo_cli.calibration.joint_noise import unit_noise
from projservo_cli.calibration.prediction import joint_derivative, predict
from projservo_cli.calibration.readings import MAD
from projservo_cli.records import BoolArray, Calibration, FloatArray, IntArray, Observation

# Delays that are looked for, s, and their steps; a pixel of what no camera sees, px.
_EARLIEST, _LATEST, _STEP, _NOWHERE = -0.1, 0.6, 0.01, 1e4
# Steps to the delay of a frame, the farthest of it from that of all, s, and the half step of its velocity.
_ROUNDS, _FARTHEST, _HALF = 6, 0.15, 1e-3
# A frame whose own noise would let it be off by more tells nothing, s; least of frames, and of their markers.
_VAGUE, _LEAST_FRAMES, _LEAST_MARKERS = 0.05, 3, 3
# Half of an interval, over the time between readings, that many frames leave: joints do not move straight.
_STRAIGHT = 0.025
# Frames that are so many deviations off do not count; how long before a motion the robot was seen at rest, s.
_OUTLIER, _BEFORE = 4.0, 0.5


class Delay(NamedTuple):
    """Delays of both views, s: instant of a joint reading less the middle of the exposure of its frame."""

    mean: FloatArray  # (2,)
    interval: FloatArray  # (2, 2) of 95 %
    jitter: FloatArray  # (2,) deviation of single frames, beyond what pixels and joints explain


class _Way(NamedTuple):
    """Joints over time, as they were read on one motion."""

    t: FloatArray  # (k,) s, rising
    q: FloatArray  # (k, n) rad or m

    def at(self, t: FloatArray) -> FloatArray:
        """Joints (…, n) at instants (…,), between readings in a straight line; at rest before and after."""
        return np.stack([np.interp(t, self.t, column) for column in self.q.T], axis=-1)


class _Frames(NamedTuple):
    """Frames of one view, each once."""

    way: IntArray  # (f,) the motion of each
    t: FloatArray  # (f,) s, of the clock of the readings: an instant which it is late after
    s: FloatArray  # (f, m, 2) px, markers as in the calibration, NaN where unseen

    def some(self, which: IntArray | BoolArray) -> "_Frames":
        """Some of them."""
        return _Frames(self.way[which], self.t[which], self.s[which])


def delay_of(calibration: Calibration, observation: Observation) -> Delay | None:
    """Delay of each view by the poses in motion; None where they do not tell it.

    calibration : what predicts images.
    observation : with poses in motion, times in s.
    """
    if observation.moving is None or observation.t_q is None:
        return None
    ways = _ways(observation)
    found = [_of_view(calibration, ways, _frames(calibration, observation, view), view) for view in (0, 1)]
    if None in found:
        return None
    mean, interval, jitter = (np.array(values) for values in zip(*filter(None, found), strict=True))
    return Delay(mean, interval, jitter)


def _ways(observation: Observation) -> dict[int, _Way]:
    """Joints over time of each motion, from where it was at rest just before, if that was read."""
    moving, t_q = observation.moving, observation.t_q
    assert moving is not None
    assert t_q is not None
    ways = {}
    for number in np.unique(moving[moving > 0]):
        rows = np.flatnonzero((moving == number) & np.isfinite(t_q))
        first = t_q[rows].min(initial=np.inf)
        before = np.flatnonzero((moving == 0) & (t_q < first) & (t_q >= first - _BEFORE))
        rows = np.concatenate([before[np.argsort(t_q[before])][-1:], rows])
        order = rows[np.unique(t_q[rows], return_index=True)[1]]
        ways[int(number)] = _Way(t_q[order], observation.q[order])
    return ways


def _frames(calibration: Calibration, observation: Observation, view: int) -> _Frames:
    """Frames of a view in motion; those that come twice only when they first came."""
    moving, t_q, t_view = observation.moving, observation.t_q, observation.t_view
    assert moving is not None
    assert t_q is not None
    known = observation.marker.tolist()
    columns = [known.index(number) if number in known else -1 for number in calibration.marker.tolist()]
    s = np.where(np.array(columns)[:, None] >= 0, observation.images[:, view, columns], np.nan)
    seen = np.isfinite(s[..., 0]).sum(axis=1) >= min(_LEAST_MARKERS, s.shape[1])
    rows = np.flatnonzero((moving > 0) & np.isfinite(t_q) & seen)
    rows = rows[np.lexsort((t_q[rows], moving[rows]))]
    same = np.zeros(len(rows), dtype=np.bool_)
    for i in range(1, len(rows)):
        same[i] = np.array_equal(s[rows[i]], s[rows[i - 1]], equal_nan=True)
    rows = rows[~same]
    t = t_q[rows]
    if t_view is not None and len(rows) and np.isfinite(t_view[rows, view]).all():
        stamps = t_view[rows, view]
        if np.ptp(t - stamps) < _LATEST - _EARLIEST:  # both clocks went on
            first = np.sort(np.unique(stamps, return_index=True)[1])
            rows, t, stamps = rows[first], t[first], stamps[first]
            t = stamps + np.mean(t - stamps)  # by the clock of the readings, as late as is typical
    return _Frames(moving[rows], t, s[rows])


def _of_view(
    calibration: Calibration, ways: dict[int, _Way], frames: _Frames, view: int
) -> tuple[float, FloatArray, float] | None:
    """Delay, interval (2,) and jitter of a view, s; None where too few frames tell it."""
    frames = frames.some(np.array([len(ways[int(way)].t) > 1 for way in frames.way], dtype=np.bool_))
    if len(frames.t) < _LEAST_FRAMES:
        return None
    common = _common(calibration, ways, frames, view)
    delay = np.full(len(frames.t), common)
    for _ in range(_ROUNDS):
        step, variance = _steps(calibration, ways, frames, view, delay)
        delay = np.clip(delay + step, common - _FARTHEST, common + _FARTHEST)
    telling = np.isfinite(variance) & (variance < _VAGUE**2)
    if np.count_nonzero(telling) < _LEAST_FRAMES:
        return None
    between = float(np.median(np.concatenate([np.diff(way.t) for way in ways.values()])))
    return _mean(delay[telling], variance[telling], _STRAIGHT * between)


def _joints(ways: dict[int, _Way], frames: _Frames, t: FloatArray) -> FloatArray:
    """Joints (f, n) of each frame at an instant (f,) of its own."""
    return np.array([ways[int(way)].at(at) for way, at in zip(frames.way, t, strict=True)])


def _common(calibration: Calibration, ways: dict[int, _Way], frames: _Frames, view: int) -> float:
    """The one delay with which most frames are best predicted, roughly, s."""
    delays = np.arange(_EARLIEST, _LATEST + 0.5 * _STEP, _STEP)
    off = []
    for delay in delays:
        predicted = predict(calibration, _joints(ways, frames, frames.t - delay))[:, view]
        predicted = np.where(np.isfinite(predicted), predicted, _NOWHERE)
        distance = np.nanmedian(np.linalg.norm(predicted - frames.s, axis=-1), axis=1)
        off.append(np.mean(np.log(distance + calibration.sigma_px)))
    return float(delays[int(np.argmin(off))])


def _steps(
    calibration: Calibration, ways: dict[int, _Way], frames: _Frames, view: int, delay: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Step (f,) of the delay of each frame to its weighted least squares, s, and its variance, s²."""
    q = _joints(ways, frames, frames.t - delay)
    after, before = (_joints(ways, frames, frames.t - delay + half) for half in (_HALF, -_HALF))
    q_dot = (after - before) / (2.0 * _HALF)
    J = joint_derivative(calibration, q)[:, view]
    residual = frames.s - predict(calibration, q)[:, view]
    sigma_q = (calibration.sigma_q or 0.0) * unit_noise(
        np.array([letter == "P" for letter in calibration.joint_types])
    )
    sigma = max(calibration.sigma_px, calibration.sigma_fitted_px)
    step, variance = np.zeros(len(q)), np.full(len(q), np.inf)
    every: BoolArray = np.asarray(np.isfinite(residual).all(axis=-1))
    for k, seen in enumerate(every):
        r, by_joint = residual[k, seen].ravel(), J[k, seen].reshape(-1, q.shape[1])
        velocity, G = -by_joint @ q_dot[k], by_joint * sigma_q
        weighted = np.linalg.solve(sigma**2 * np.eye(len(r)) + G @ G.T, np.stack([velocity, r], axis=1))
        information = float(velocity @ weighted[:, 0])
        if information > 0.0:
            step[k], variance[k] = float(velocity @ weighted[:, 1]) / information, 1.0 / information
    return step, variance


def _mean(delay: FloatArray, variance: FloatArray, least: float) -> tuple[float, FloatArray, float]:
    """Mean of delays (f,) of variances (f,), its interval (2,), and the deviation that variances leave open.

    ``least`` is half of the interval that any number of frames leaves, s.

    Random effects: R. C. Paule, J. Mandel, "Consensus values and weighting factors", J. Research NBS 87(5),
    1982; the interval of G. Knapp, J. Hartung, "Improved tests for a random effects meta-regression with a
    single covariate", Statistics in Medicine 22, 2003. Frames far off the median do not count.
    """
    off = np.abs(delay - np.median(delay))
    spread = float(np.median(off)) / MAD
    kept = off <= _OUTLIER * np.sqrt(spread**2 + variance)
    delay, variance = delay[kept], variance[kept]
    freedom = len(delay) - 1

    def left(square: float) -> float:
        """Squares that are left beyond what a square of the deviation explains."""
        weight = 1.0 / (variance + square)
        mean = weight @ delay / weight.sum()
        return float(weight @ (delay - mean) ** 2) - freedom

    square = 0.0 if left(0.0) <= 0.0 else float(brentq(left, 0.0, _FARTHEST**2 + float(np.ptp(delay)) ** 2))
    weight = 1.0 / (variance + square)
    mean = float(weight @ delay / weight.sum())
    error = float(np.sqrt((weight @ (delay - mean) ** 2) / (freedom * weight.sum())))
    half = float(np.hypot(stdtrit(freedom, 0.975) * error, least))
    return mean, np.array([mean - half, mean + half]), float(np.sqrt(square))
