"""A robot at rest: waited for by joints and images, and averaged over frames."""

import math
from collections import deque
from collections.abc import Callable, Iterator

import numpy as np

from projservo_cli.findings import REFUSES, Finding, Subject
from projservo_cli.messages import failed
from projservo_cli.records import BoolArray, FloatArray, IntArray, Observation
from projservo_cli.robots.contract import PluginRobot, Reading

# Drift of a joint, rad or m, and of an image, px rms, within which both count as still.
STILL, STILL_PX = 2e-5, 0.02
_LEAST = 6  # readings that separate noise from motion
_PATIENCE_S = 20.0  # for a robot to come to rest where it was sent
_WAITED = 5  # looks for each image that is wanted, if the same one comes again


def at_rest(
    reading: Reading, observe: Callable[[], Reading], settle_s: float, what: str
) -> Iterator[Reading]:
    """Read once per period until joints and images are at rest, and yield each reading."""
    still, first = Standstill(settle_s), reading.t_q
    while not still.all(reading):
        if reading.t_q > first + settle_s + _PATIENCE_S:
            of = Subject(name=still.moving or "the robot")
            raise failed([Finding("restless", REFUSES, of, limit=_PATIENCE_S, unit="s")], stage=what)
        reading = observe()
        yield reading


def seen_at_rest(
    robot: PluginRobot, observe: Callable[[], Reading], frames: int, settle_s: float, what: str
) -> tuple[Reading, Reading, FloatArray, IntArray, list[Reading]]:
    """Wait until a robot and its images are at rest, and average frames of each view, objects included.

    Returns the first reading at rest, the mean, deviations (V, m) of a coordinate of it, px, NaN if unknown,
    counts (V, m), and the readings that it is of.
    """
    first, reading = robot.read(), observe()
    if reading.t_q > first.t_q:  # otherwise it is a simulator, whose time passes in its commands alone
        reading = [reading, *at_rest(reading, observe, settle_s, what)][-1]
    every_reading = [reading]

    def next_reading() -> Reading:
        every_reading.append(observe())
        return every_reading[-1]

    mean, squares, count = averaged(reading, next_reading, frames)
    sigma = np.where(count > 1, np.sqrt(squares / np.maximum(2 * count * (count - 1), 1)), np.nan)
    sigma = sigma if mean.sigma_px is None else mean.sigma_px
    return reading, mean, np.where(np.isfinite(mean.s[..., 0]), sigma, np.nan), count, every_reading


def observation_of_frames(every_reading: list[Reading], marker: IntArray) -> tuple[Observation, BoolArray]:
    """Return the frames of readings of a robot at rest, and which are new (K, V).

    marker : (m,) numbers of the first markers, those on the tool.
    """
    stated = [
        next_reading.sigma_px[:, : len(marker)]
        for next_reading in every_reading
        if next_reading.sigma_px is not None
    ]
    frames = Observation(
        pose=np.arange(len(every_reading)),
        marker=marker,
        q=np.array([next_reading.q for next_reading in every_reading]),
        images=np.array([next_reading.s[:, : len(marker)] for next_reading in every_reading]),
        sigma=np.array(stated) if len(stated) == len(every_reading) else None,
        view=every_reading[0].view,
    )
    return frames, np.array(
        [b.new_views(a) for a, b in zip([None, *every_reading], every_reading, strict=False)]
    )


def averaged(
    reading: Reading, observe: Callable[[], Reading], wanted: int
) -> tuple[Reading, FloatArray, IntArray]:
    """Return the mean of readings of a robot at rest, with a number of frames of each view, each once.

    Frames are weighted by their deviations, if they have any. Markers that most of the frames of a view do
    not show are NaN. Returns the mean; sums (V, m) of the squares of deviations of pixels from it, px²; how
    many frames (V, m) show a marker, 0 if it is NaN.
    """
    readings, frames = [reading], [[_frame(reading, view)] for view in range(len(reading.s))]
    for _ in range(_WAITED * wanted):
        if min(map(len, frames)) >= wanted:
            break
        readings.append(observe())
        for view, new in enumerate(readings[-1].new_views(readings[-2])):
            if new and len(frames[view]) < wanted:
                frames[view].append(_frame(readings[-1], view))
    s, sigma, squares, count = (np.stack(each) for each in zip(*map(_mean, frames), strict=True))
    q = readings[0].q + np.mean([seen.q - readings[0].q for seen in readings], axis=0)
    stated = reading.sigma_px if reading.sigma_px is None or len(readings) == 1 else sigma
    return readings[-1]._replace(q=q, s=s, sigma_px=stated), squares, count


def _frame(reading: Reading, view: int) -> FloatArray:
    """Return u, v and their deviation (m, 3), px, of a view; a deviation of one if it has none."""
    sigma = np.ones(len(reading.s[view])) if reading.sigma_px is None else reading.sigma_px[view]
    return np.column_stack([reading.s[view], sigma])


def _mean(frames: list[FloatArray]) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:
    """Mean (m, 2) of frames (m, 3) of one view, its deviation (m,), squares (m,) off it, their count (m,).

    An error without scatter from frame to frame does not average away: the share of the stated variance that
    scatters, of all markers together, becomes less.
    """
    seen, sigma = np.split(np.array(frames), [2], axis=2)
    count = np.isfinite(seen[..., 0]).sum(axis=0)
    count[2 * count <= len(seen)] = 0
    weight = np.where(np.isfinite(seen), sigma**-2.0, 0.0)
    total = np.maximum(weight.sum(axis=0), 1e-300)
    mean: FloatArray = np.nansum(seen * weight, axis=0) / total
    mean[count == 0] = np.nan
    off = (seen - mean) ** 2
    freedom = 2 * np.maximum(count - 1, 0).sum()
    scatter = min(1.0, float(np.nansum(off / sigma**2)) / freedom) if freedom else 1.0
    typical = count / total[:, 0]  # variance of a frame
    variance = np.where(count > 0, typical * (1.0 - scatter) + scatter / total[:, 0], np.nan)
    return mean, np.sqrt(variance), np.nansum(off, axis=(0, 2)), count


class Standstill:
    """Tells whether a robot has been at rest for a time, s, by consecutive readings.

    Over that time, and no fewer than six looks, the means of its thirds differ by no more than noise
    explains, from the differences of consecutive readings: motion adds up, noise does not.

    Source: J. von Neumann, "Distribution of the ratio of the mean square successive difference to the
    variance", Annals of Mathematical Statistics 12, 1941.
    """

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self._since = math.inf
        self._q: _Rows = deque()
        self._s: list[_Rows] = []  # one for each view, from the first reading on
        self._last: Reading | None = None
        self.moving = ""  # message on the part that moves

    def joints(self, reading: Reading) -> bool:
        """Whether the joints have been at rest up to the next reading."""
        self._since = min(self._since, reading.t_q)
        square, variance = _drift(self._kept(self._q, reading.t_q, reading.q))
        moving = np.flatnonzero(square > np.maximum(STILL**2, 9.0 * variance))
        self.moving = f"joint {moving[0] + 1}" if len(moving) else ""
        whole = reading.t_q - self._since >= self.seconds * (1.0 - 1e-9)
        return whole and len(self._q) >= _LEAST and not self.moving

    def all(self, reading: Reading) -> bool:
        """Whether joints and images have been at rest up to the next reading."""
        still = self.joints(reading)
        self._s = self._s or [deque() for _ in reading.s]
        new = reading.new_views(self._last)
        self._last = reading
        for view, rows in enumerate(self._s):
            frames = self._kept(rows, reading.t_q, reading.s[view].ravel() if new[view] else None)
            if rows[-1][0] < reading.t_q - self.seconds:
                continue  # the same image all the time
            square, variance = _drift(frames[:, np.isfinite(frames).all(axis=0)])
            if square.size and square.mean() > max(STILL_PX**2, 2.0 * variance.mean()):
                self.moving = self.moving or f"the {reading.view[view]} image"
            still = still and len(rows) >= _LEAST
        return still and not self.moving

    def _kept(self, rows: "_Rows", now: float, row: FloatArray | None) -> FloatArray:
        """The rows of the time that counts, with one more unless it is None."""
        if row is not None:
            rows.append((now, row))
        while len(rows) > _LEAST and rows[0][0] < now - self.seconds * (1.0 + 1e-9):
            rows.popleft()
        return np.array([values for _, values in rows])


_Rows = deque[tuple[float, FloatArray]]


def _drift(rows: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Variance of the means of the thirds of rows (k, c), and its expectation by noise, (c,)."""
    third = len(rows) // 3
    if third == 0:
        return np.zeros(rows.shape[1]), np.zeros(rows.shape[1])
    means = [part.mean(axis=0) for part in (rows[:third], rows[third:-third], rows[-third:])]
    noise = 0.5 * (np.diff(rows, axis=0) ** 2).mean(axis=0)
    return np.var(means, axis=0, ddof=1), noise / third
