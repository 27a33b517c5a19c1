"""Time offset (latency) of the images of each view, from frames between trial poses.

A frame that comes with the joint reading of an instant t_q shows the joints of t_q − d. What is seen less
what is predicted for joints at t_q − d is noise; a wrong d shows along the image velocity J_q q̇. Each frame
tells its own d, and their mean and spread are that of the view: no noise has to be known. Where frames
carry stamps, a constant is estimated likewise, by which their clock is off that of the readings.
"""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.optimize import brentq
from scipy.special import stdtrit

from projservo_cli.calibration.prediction import joint_derivative, predict
from projservo_cli.calibration.readings import MAD, per_rad
from projservo_cli.records import Calibration, FloatArray, IntArray, Observation

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


def comes_again(stamp: float, s: FloatArray, last_stamp: float, last_s: FloatArray) -> bool:
    """Whether a frame is the last one once more: of the same stamp, s, or the same pixels (m, 2).

    Stamps are NaN, and pixels, where there are none.
    """
    return stamp == last_stamp or np.array_equal(s, last_s, equal_nan=True)


@dataclass(frozen=True, eq=False)
class _Frames:
    """Frames of one view on the way, each once."""

    calibration: Calibration
    view: int
    ways: dict[int, tuple[FloatArray, FloatArray]]  # of each motion, instants (k,), s, and joints (k, n) then
    way: IntArray  # (f,) the motion of each frame
    t: FloatArray  # (f,) s, of the clock of the readings: an instant which it is late after
    s: FloatArray  # (f, m, 2) px, markers as in the calibration, NaN where unseen
    sigma: FloatArray  # (f, m) deviation of these pixels: as stated, times what the calibration found of that

    @classmethod
    def of(
        cls, calibration: Calibration, observation: Observation, view: int, moving: IntArray, t_q: FloatArray
    ) -> "_Frames":
        """Frames of a view; those that come twice only when they first came."""
        ways = _ways(observation.q, moving, t_q)
        known = observation.marker.tolist()
        columns = [known.index(number) if number in known else -1 for number in calibration.marker.tolist()]
        s = np.where(np.array(columns)[:, None] >= 0, observation.images[:, view, columns], np.nan)
        sigma = np.full(s.shape[:2], max(calibration.sigma_px, calibration.sigma_fitted_px))
        if (stated := observation.sigma) is not None:
            stated = (
                stated[:, view, columns] * (calibration.sigma_scale or 1.0) * (sigma / calibration.sigma_px)
            )
            sigma = np.where(stated > 0.0, stated, sigma)
        seen = np.isfinite(s[..., 0]).sum(axis=1) >= min(_LEAST_MARKERS, s.shape[1])
        rows = np.flatnonzero(np.isin(moving, list(ways)) & np.isfinite(t_q) & seen)
        rows = rows[np.lexsort((t_q[rows], moving[rows]))]
        stamps = np.full(len(s), np.nan) if observation.t_view is None else observation.t_view[:, view]
        again = [k for last, k in pairwise(rows) if comes_again(stamps[k], s[k], stamps[last], s[last])]
        rows = rows[~np.isin(rows, again)]
        t, late = t_q[rows], t_q[rows] - stamps[rows]
        if (
            len(rows) and np.isfinite(late).all() and np.ptp(late) < _LATEST - _EARLIEST
        ):  # both clocks went on
            t = stamps[rows] + late.mean()  # by the clock of the readings
        return cls(calibration, view, ways, moving[rows], t, s[rows], sigma[rows])

    def joints(self, delay: FloatArray | float) -> FloatArray:
        """Joints (f, n) of each frame at a delay of its own, s: straight between readings, else at rest."""
        at, q = self.t - delay, np.empty((len(self.t), len(self.calibration.H_hat_0)))
        for number, (t, read) in self.ways.items():
            here = self.way == number
            q[here] = np.stack([np.interp(at[here], t, column) for column in read.T], axis=-1)
        return q

    def common(self) -> float:
        """The one delay with which most frames are best predicted, roughly, s."""
        delays = np.arange(_EARLIEST, _LATEST + 0.5 * _STEP, _STEP)
        off = []
        for delay in delays:
            predicted = predict(self.calibration, self.joints(delay))[:, self.view]
            predicted = np.where(np.isfinite(predicted), predicted, _NOWHERE)
            distance = np.nanmedian(np.linalg.norm(predicted - self.s, axis=-1), axis=1)
            off.append(np.mean(np.log(distance + self.calibration.sigma_px)))
        return float(delays[int(np.argmin(off))])

    def steps(self, delay: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Step (f,) of the delay of each frame to its weighted least squares, s, and its variance, s²."""
        found, q = self.calibration, self.joints(delay)
        q_dot = (self.joints(delay - _HALF) - self.joints(delay + _HALF)) / (2.0 * _HALF)
        J, r = joint_derivative(found, q)[:, self.view], self.s - predict(found, q)[:, self.view]
        unseen = np.isnan(r).any(axis=-1)
        J[unseen], r[unseen] = 0.0, 0.0
        J, r = J.reshape(len(q), -1, q.shape[1]), r.reshape(len(q), -1, 1)
        velocity = -J @ q_dot[..., None]
        G = J * ((found.sigma_q or 0.0) * per_rad(found.prismatic))
        noise = np.repeat(self.sigma, 2, axis=1)[..., None] ** 2 * np.eye(r.shape[1])
        S = noise + G @ np.swapaxes(G, 1, 2)
        weighted = np.swapaxes(velocity, 1, 2) @ np.linalg.solve(S, np.concatenate([velocity, r], axis=2))
        information = np.maximum(weighted[:, 0, 0], 1e-300)  # of a robot that stands still there is none
        return weighted[:, 0, 1] / information, 1.0 / information


def with_delay(calibration: Calibration, observation: Observation) -> Calibration:
    """The calibration with the delay of each view, its interval and jitter, where poses in motion tell them.

    calibration : what predicts images.
    observation : perhaps with poses in motion, times in s.
    """
    moving, t_q = observation.moving, observation.t_q
    if moving is None or t_q is None:
        return calibration
    views = [_Frames.of(calibration, observation, view, moving, t_q) for view in (0, 1)]
    found = [told for told in map(_delay, views) if told is not None]
    if len(found) < len(views):
        return calibration
    mean, interval, jitter = (np.array(values) for values in zip(*found, strict=True))
    return replace(calibration, delay_s=mean, delay_interval_s=interval, delay_jitter_s=jitter)


def _ways(q: FloatArray, moving: IntArray, t_q: FloatArray) -> dict[int, tuple[FloatArray, FloatArray]]:
    """Joints over time of each motion, from where it was at rest just before, if that was read."""
    ways = {}
    for number in np.unique(moving[moving > 0]):
        rows = np.flatnonzero((moving == number) & np.isfinite(t_q))
        first = t_q[rows].min(initial=np.inf)
        before = np.flatnonzero((moving == 0) & (t_q < first) & (t_q >= first - _BEFORE))
        rows = np.concatenate([before[np.argsort(t_q[before])][-1:], rows])
        order = rows[np.unique(t_q[rows], return_index=True)[1]]
        if len(order) > 1:
            ways[int(number)] = t_q[order], q[order]
    return ways


def _delay(frames: _Frames) -> tuple[float, FloatArray, float] | None:
    """Delay, interval (2,) and jitter of a view, s; None where too few frames tell it."""
    if len(frames.t) < _LEAST_FRAMES:
        return None
    common = frames.common()
    delay = np.full(len(frames.t), common)
    for _ in range(_ROUNDS):
        step, variance = frames.steps(delay)
        delay = np.clip(delay + step, common - _FARTHEST, common + _FARTHEST)
    telling = variance < _VAGUE**2
    if np.count_nonzero(telling) < _LEAST_FRAMES:
        return None
    between = float(np.median(np.concatenate([np.diff(t) for t, _ in frames.ways.values()])))
    return _mean(delay[telling], variance[telling], _STRAIGHT * between)


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

    def consensus(square: float) -> tuple[float, float, float]:
        """Sum of weights, mean, and weighted squares about it, at a square of the deviation."""
        weight = 1.0 / (variance + square)
        mean = float(weight @ delay / weight.sum())
        return float(weight.sum()), mean, float(weight @ (delay - mean) ** 2)

    square, most = 0.0, _FARTHEST**2 + float(np.ptp(delay)) ** 2
    if consensus(0.0)[2] > freedom:
        square = float(brentq(lambda square: consensus(square)[2] - freedom, 0.0, most))
    total, mean, squares = consensus(square)
    half = float(np.hypot(stdtrit(freedom, 0.975) * np.sqrt(squares / (freedom * total)), least))
    return mean, np.array([mean - half, mean + half]), float(np.sqrt(square))
