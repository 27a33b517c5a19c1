"""Time offset (latency) of the images of each view, from frames between trial poses.

A frame that comes with the joint reading of time t_q shows the joints of t_q − d. Seen less predicted pixels
for joints at t_q − d are noise; an error of d shows along the image velocity J_q q̇. Each frame estimates its
own d; their mean and spread hold for the view, so no noise need be known. If frames have time stamps, d
is the constant offset of their clock from the clock of the readings.
"""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.optimize import brentq
from scipy.special import stdtrit

from projservo_cli.calibration.detections import MAD
from projservo_cli.calibration.prediction import joint_derivative, predict, reading_changes
from projservo_cli.findings import LIMITS, Finding, Subject
from projservo_cli.messages import with_findings
from projservo_cli.records import Calibration, FloatArray, InputError, IntArray, Observation, TimeOffset

# Minimum time offset searched, s: stamps of another clock may be early.
_EARLIEST = -0.1
# Maximum time offset searched, s.
_LATEST = 0.6
# Step of the search, s.
_STEP = 0.01
# Pixel in place of a marker that the camera does not see, px.
_NOWHERE = 1e4
# Number of Gauss–Newton steps to the offset of a frame.
_ROUNDS = 6
# Maximum distance of the offset of a frame from the common offset, s.
_FARTHEST = 0.15
# Half of the step of the finite difference for joint velocities, s.
_HALF = 1e-3
# Standard deviation of the offset of a frame, s, above which it is not informative.
_VAGUE = 0.05
# Minimum number of informative frames of a view.
_MIN_FRAMES = 3
# Minimum number of markers in a frame.
_MIN_MARKERS = 3
# Minimum half of the interval, over the time between readings, as joints do not move straight between them.
_STRAIGHT = 0.025
# Distance of an offset from the median, in deviations, above which its frame does not count.
_OUTLIER = 4.0
# Time between readings in a motion, s, give or take a factor of thirty.
_BETWEEN = 0.06
# Maximum time before a motion of the reading at rest that it starts from, s.
_BEFORE = 0.5


def time_unit(rate: float) -> str:
    """Tell in which unit stamps are that go on at such a rate in a second, with the remedy; empty for s."""
    units = {"milliseconds": 1e3, "microseconds": 1e6, "nanoseconds": 1e9}
    near = [name for name, unit in units.items() if abs(np.log10(rate / unit)) < 1.5]
    return f"it looks like {near[0]}: divide by {units[near[0]]:g}" if near else ""


def require_seconds(where: str, observation: Observation) -> None:
    """Refuse stamps of poses in motion that go on as in another unit than s. Raises InputError.

    Readings in a motion come every few hundredths of a second, and images are stamped as fast as readings.
    """
    motion = np.zeros(len(observation.pose)) if observation.moving is None else observation.moving
    spans = dict[str, float]()
    for name, t in zip(
        ("t_q", *(f"t_{name}" for name in observation.view)), _stamps(observation), strict=True
    ):
        motions = [np.sort(t[motion == k]) for k in np.unique(motion[motion > 0])]
        steps = np.concatenate([np.diff(one[np.isfinite(one)]) for one in motions] or [np.zeros(0)])
        if not steps.any():
            continue
        spans[name], step = float(steps.sum()), float(np.median(steps[steps > 0.0]))
        if unit := time_unit(step / _BETWEEN) or time_unit(spans[name] / spans.get("t_q", spans[name])):
            raise InputError(f"{where}: {name} goes on by {step:g} from row to row of a motion: {unit}")


def _stamps(observation: Observation) -> FloatArray:
    """Stamps (3, K) of joints, left and right images, s; NaN where unknown."""
    nobody = np.full((len(observation.pose), len(observation.view)), np.nan)
    t_q = nobody[:, 0] if observation.t_q is None else observation.t_q
    return np.vstack([t_q, (nobody if observation.t_view is None else observation.t_view).T])


def is_repeated_frame(stamp: float, s: FloatArray, last_stamp: float, last_s: FloatArray) -> bool:
    """Whether a frame repeats the last one: the same stamp, s, or the same pixels (m, 2), NaN if missing."""
    return stamp == last_stamp or np.array_equal(s, last_s, equal_nan=True)


@dataclass(frozen=True, eq=False)
class _Frames:
    """Frames of one view during motions, without repetitions."""

    calibration: Calibration
    view: int
    motions: dict[int, tuple[FloatArray, FloatArray]]  # for each motion, times (k,), s, and joints (k, n)
    motion_of: IntArray  # (f,) number of the motion of each frame
    t: FloatArray  # (f,) time by the clock of the readings, s, that the offset applies to
    s: FloatArray  # (f, m, 2) px, markers as in the calibration, NaN if unseen
    sigma: FloatArray  # (f, m) deviations of these pixels, scaled as in the calibration, px

    @classmethod
    def of(
        cls, calibration: Calibration, observation: Observation, view: int, moving: IntArray, t_q: FloatArray
    ) -> "_Frames":
        """Select the frames of a view, repeated ones once."""
        motions = _motions(observation.q, moving, t_q)
        known = observation.marker.tolist()
        columns = [known.index(number) if number in known else -1 for number in calibration.marker.tolist()]
        s = np.where(np.array(columns)[:, None] >= 0, observation.images[:, view, columns], np.nan)
        sigma = np.full(s.shape[:2], max(calibration.sigma_px, calibration.sigma_fitted_px))
        if (stated := observation.sigma) is not None:
            stated = (
                stated[:, view, columns] * (calibration.sigma_scale or 1.0) * (sigma / calibration.sigma_px)
            )
            sigma = np.where(stated > 0.0, stated, sigma)
        seen = np.isfinite(s[..., 0]).sum(axis=1) >= min(_MIN_MARKERS, s.shape[1])
        rows = np.flatnonzero(np.isin(moving, list(motions)) & np.isfinite(t_q) & seen)
        rows = rows[np.lexsort((t_q[rows], moving[rows]))]
        stamps = np.full(len(s), np.nan) if observation.t_view is None else observation.t_view[:, view]
        repeated = [
            k for last, k in pairwise(rows) if is_repeated_frame(stamps[k], s[k], stamps[last], s[last])
        ]
        rows = rows[~np.isin(rows, repeated)]
        t, lag = t_q[rows], t_q[rows] - stamps[rows]
        if len(rows) and np.isfinite(lag).all() and np.ptp(lag) < _LATEST - _EARLIEST:  # both clocks went on
            t = stamps[rows] + lag.mean()  # on the clock of the readings
        return cls(calibration, view, motions, moving[rows], t, s[rows], sigma[rows])

    def joints(self, offset: FloatArray | float) -> FloatArray:
        """Joints (f, n) of each frame at its offset, s: linear between readings, otherwise at rest."""
        at, q = self.t - offset, np.empty((len(self.t), len(self.calibration.H_hat_0)))
        for number, (t, q_read) in self.motions.items():
            here = self.motion_of == number
            q[here] = np.stack([np.interp(at[here], t, column) for column in q_read.T], axis=-1)
        return q

    def common(self) -> float:
        """Common offset that predicts most frames best, on a grid, s."""
        offsets = np.arange(_EARLIEST, _LATEST + 0.5 * _STEP, _STEP)
        distances = []
        for offset in offsets:
            predicted = predict(self.calibration, self.joints(offset))[:, self.view]
            predicted = np.where(np.isfinite(predicted), predicted, _NOWHERE)
            distance = np.nanmedian(np.linalg.norm(predicted - self.s, axis=-1), axis=1)
            distances.append(np.mean(np.log(distance + self.calibration.sigma_px)))
        return float(offsets[int(np.argmin(distances))])

    def steps(self, offset: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Gauss–Newton step (f,) of the offset of each frame, s, and its variance, s²."""
        found, q = self.calibration, self.joints(offset)
        q_dot = (self.joints(offset - _HALF) - self.joints(offset + _HALF)) / (2.0 * _HALF)
        J, r = joint_derivative(found, q)[:, self.view], self.s - predict(found, q)[:, self.view]
        unseen = np.isnan(r).any(axis=-1)
        J[unseen], r[unseen] = 0.0, 0.0
        J, r = J.reshape(len(q), -1, q.shape[1]), r.reshape(len(q), -1, 1)
        velocity = -J @ q_dot[..., None]
        G = reading_changes(found, q)[:, self.view]
        G[unseen] = 0.0
        G = G.reshape(J.shape)
        noise = np.repeat(self.sigma, 2, axis=1)[..., None] ** 2 * np.eye(r.shape[1])
        S = noise + G @ np.swapaxes(G, 1, 2)
        weighted = np.swapaxes(velocity, 1, 2) @ np.linalg.solve(S, np.concatenate([velocity, r], axis=2))
        information = np.maximum(weighted[:, 0, 0], 1e-300)  # a robot at rest gives none
        return weighted[:, 0, 1] / information, 1.0 / information


def with_time_offset(calibration: Calibration, observation: Observation) -> Calibration:
    """Add the time offset of each view, its interval and jitter, if poses in motion determine them.

    calibration : projective kinematics.
    observation : may have poses in motion, times in s.
    """
    moving, t_q = observation.moving, observation.t_q
    if moving is None or t_q is None:
        return calibration
    for name, t in zip(
        ("t_q", *(f"t_{name}" for name in observation.view)), _stamps(observation)[:, moving > 0], strict=True
    ):
        if t.size >= _MIN_FRAMES and (t == np.rint(t)).all() and (np.diff(t) == 0.0).any():
            return with_findings(calibration, [Finding("whole_seconds", LIMITS, Subject(name=name))])
    views = [_Frames.of(calibration, observation, view, moving, t_q) for view in range(len(observation.view))]
    found = [result for result in map(_time_offset, views) if result is not None]
    if len(found) < len(views):
        return calibration
    mean, interval, jitter = (np.array(values) for values in zip(*found, strict=True))
    offset = TimeOffset(time_offset_s=mean, time_offset_interval_s=interval, time_offset_jitter_s=jitter)
    return replace(calibration, time_offset=offset)


def _motions(q: FloatArray, moving: IntArray, t_q: FloatArray) -> dict[int, tuple[FloatArray, FloatArray]]:
    """Times and joints of each motion, from the pose at rest just before, if it was read."""
    motions = {}
    for number in np.unique(moving[moving > 0]):
        rows = np.flatnonzero((moving == number) & np.isfinite(t_q))
        first = t_q[rows].min(initial=np.inf)
        before = np.flatnonzero((moving == 0) & (t_q < first) & (t_q >= first - _BEFORE))
        rows = np.concatenate([before[np.argsort(t_q[before])][-1:], rows])
        order = rows[np.unique(t_q[rows], return_index=True)[1]]
        if len(order) > 1:
            motions[int(number)] = t_q[order], q[order]
    return motions


def _time_offset(frames: _Frames) -> tuple[float, FloatArray, float] | None:
    """Time offset, interval (2,) and jitter of a view, s; None if too few frames determine it."""
    if len(frames.t) < _MIN_FRAMES:
        return None
    common = frames.common()
    offset = np.full(len(frames.t), common)
    for _ in range(_ROUNDS):
        step, variance = frames.steps(offset)
        offset = np.clip(offset + step, common - _FARTHEST, common + _FARTHEST)
    informative = variance < _VAGUE**2
    if np.count_nonzero(informative) < _MIN_FRAMES:
        return None
    between = float(np.median(np.concatenate([np.diff(t) for t, _ in frames.motions.values()])))
    return _mean(offset[informative], variance[informative], _STRAIGHT * between)


def _mean(offset: FloatArray, variance: FloatArray, floor: float) -> tuple[float, FloatArray, float]:
    """Mean of offsets (f,) of variances (f,), its interval (2,), and their deviation beyond these variances.

    floor : minimum half of the interval, s, for any number of frames.

    Random effects: R. C. Paule, J. Mandel, "Consensus values and weighting factors", J. Research NBS 87(5),
    1982; the interval of G. Knapp, J. Hartung, "Improved tests for a random effects meta-regression with a
    single covariate", Statistics in Medicine 22, 2003. Frames far from the median do not count.
    """
    distances = np.abs(offset - np.median(offset))
    spread = float(np.median(distances)) / MAD
    kept = distances <= _OUTLIER * np.sqrt(spread**2 + variance)
    offset, variance = offset[kept], variance[kept]
    freedom = len(offset) - 1

    def consensus(square: float) -> tuple[float, float, float]:
        """Sum of weights, mean, and weighted squares about it, for a squared deviation."""
        weight = 1.0 / (variance + square)
        mean = float(weight @ offset / weight.sum())
        return float(weight.sum()), mean, float(weight @ (offset - mean) ** 2)

    square, upper = 0.0, _FARTHEST**2 + float(np.ptp(offset)) ** 2
    if consensus(0.0)[2] > freedom:
        square = float(brentq(lambda square: consensus(square)[2] - freedom, 0.0, upper))
    total, mean, squares = consensus(square)
    half = float(np.hypot(stdtrit(freedom, 0.975) * np.sqrt(squares / (freedom * total)), floor))
    return mean, np.array([mean - half, mean + half]), float(np.sqrt(square))
