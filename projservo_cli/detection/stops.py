"""Stops of a robot in a stream of readings, and the images that cameras took at stops and between them."""

import math
from collections import Counter
from typing import NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d
from scipy.spatial.transform import Rotation, Slerp

from projservo_cli.geometry.flange import FlangeChart
from projservo_cli.records import BoolArray, FloatArray, IntArray

# Minimum duration of a stop, s: cameras are up to some 0.1 s late, and the image of its middle shows it.
STOP_S = 0.3
# Minimum number of readings of a stop, which separate noise from motion.
_LEAST = 5
# Share of the range of a coordinate within which it is at rest: images move by hundreds of pixels over
# that range, so that this is below the errors of corners, some hundredths of a pixel.
_STILL = 2e-4
# Ranges of noise: of a sample of up to some thousand normal errors, in deviations, and of encoder counts.
_OF_NOISE, _OF_COUNTS = 8.0, 2.5
# Lower quartile of the absolute value of a normal variable, and variance of second differences of noise.
_QUARTILE, _SECOND = 0.3186, 6.0
# Maximum that is taken for noise, as a share of the widest range: more is slow motion.
_MOST_NOISE = 0.02
# Longest time between readings, as a multiple of the median, and widest step of one, over which they are
# interpolated: half a turn is a joint that passes the end of its circle.
_GAP, _JUMP = 10.0, math.pi
# Time after the begin of a stop, s, in which late images may still show the motion before.
_AFTER_S = 0.3
# Maximum number of images of a camera in motion: each shows the delay to some 5 ms, all to 0.3 ms.
_MOST_MOVING = 400

# What became of an image.
AT_REST, REPEATED = "at stops", "more at these stops"
UNPAIRED = "at stops of which another camera has none"
MOVING, BEYOND, UNREAD = "in motion", "more in motion", "without readings at their time"


class Stream(NamedTuple):
    """Readings over time."""

    t: FloatArray  # (T,) s, rising
    q: FloatArray  # (T, n) joints, rad or m, or coordinates of poses
    T: FloatArray | None = None  # (T, 4, 4) poses of the flange
    chart: FlangeChart | None = None  # of their coordinates

    def at(self, when: FloatArray) -> FloatArray:
        """Readings (k, n) at times (k,), interpolated; NaN before, after, and in gaps."""
        after = np.clip(np.searchsorted(self.t, when), 1, len(self.t) - 1)
        known = (when >= self.t[0]) & (when <= self.t[-1]) & ~_gaps(self)[after - 1]
        if self.T is None or self.chart is None:
            q = np.stack([np.interp(when, self.t, column) for column in self.q.T], axis=-1)
        else:
            q = self.chart.coordinates(poses_at(self.t, self.T, when))
        return np.where(known[:, None], q, np.nan)

    def stops(self) -> FloatArray:
        """Begins and ends (s, 2) of the times at which no coordinate leaves the range of rest and noise.

        Noise is a low quantile of second differences, which motion hardly changes, or one encoder count.
        """
        step = float(np.median(np.diff(self.t)))
        count = max(_LEAST, math.ceil(STOP_S / step) + 1)
        if len(self.t) < count:
            return np.zeros((0, 2))
        span = np.ptp(self.q, axis=0)
        second = np.quantile(np.abs(np.diff(self.q, 2, axis=0)), 0.25, axis=0)
        change = np.abs(np.diff(self.q, axis=0))
        counts = np.where(change > 0.0, change, np.inf).min(axis=0)
        counts = np.where(np.isfinite(counts), counts, 0.0)
        noise = np.maximum(_OF_NOISE * second / (_QUARTILE * math.sqrt(_SECOND)), _OF_COUNTS * counts)
        most = np.maximum(_STILL * span, np.minimum(noise, _MOST_NOISE * span.max()))
        of_windows = slice(count // 2, count // 2 + len(self.t) - count + 1)  # by their middles
        highest, lowest = maximum_filter1d(self.q, count, axis=0), minimum_filter1d(self.q, count, axis=0)
        still = ((highest - lowest)[of_windows] <= most).all(axis=1)
        still &= ~np.lib.stride_tricks.sliding_window_view(_gaps(self), count - 1).any(axis=1)
        found = list[list[int]]()
        for first in np.flatnonzero(still).tolist():
            if found and first <= found[-1][1]:
                found[-1][1] = first + count - 1
            else:
                found.append([first, first + count - 1])
        return self.t[np.array(found, dtype=np.int64).reshape(-1, 2)]


def _gaps(stream: Stream) -> BoolArray:
    """Whether nothing is known between a reading and the next, (T − 1,)."""
    steps = np.diff(stream.t)
    jumps = np.abs(np.diff(stream.q, axis=0)).max(axis=1) > _JUMP
    return np.asarray((steps > _GAP * np.median(steps)) | jumps)


def poses_at(t: FloatArray, T: FloatArray, when: FloatArray) -> FloatArray:
    """Poses (k, 4, 4) at times (k,): positions straight, turns about one axis, between poses (T, 4, 4)."""
    if len(t) == 1:
        return np.broadcast_to(T, (len(when), 4, 4))
    when = np.clip(when, t[0], t[-1])
    found = np.tile(np.eye(4), (len(when), 1, 1))
    found[:, :3, :3] = Slerp(t, Rotation.from_matrix(T[:, :3, :3]))(when).as_matrix()
    found[:, :3, 3] = np.stack([np.interp(when, t, column) for column in T[:, :3, 3].T], axis=-1)
    return found


class Shots(NamedTuple):
    """Poses of a stream with their images, in the order of time."""

    q: FloatArray  # (K, n) readings
    t_q: FloatArray  # (K,) time of the reading, s; the last one of a stop
    moving: IntArray  # (K,) number of the motion, 0 at a stop
    image: IntArray  # (K, V) which image of each camera, -1 for none
    fate: tuple[Counter[str], ...]  # of each camera, how many images became what


def shots(stream: Stream, stamps: list[FloatArray]) -> Shots:
    """Choose the images of stops and of the motions between them.

    stamps : (k,) times of the images of each camera, s, rising.
    Each stop at which every camera took an image has the one of each next to its middle. Each image in
    motion is its own pose, with those of other cameras at the same time.
    """
    V, stops = len(stamps), stream.stops()
    fate = [np.full(len(t), MOVING, dtype=object) for t in stamps]
    # time of an image, reading, its time, motion, image of each camera
    rows = list[tuple[float, FloatArray, float, int, list[int]]]()
    for begin, end in stops:
        within = [np.flatnonzero((t >= begin) & (t <= end)) for t in stamps]
        whole, middle, image = all(map(len, within)), 0.5 * (begin + end), list[int]()
        for v, here in enumerate(within):
            fate[v][here] = REPEATED if whole else UNPAIRED
            if whole:
                image.append(int(here[np.argmin(np.abs(stamps[v][here] - middle))]))
                fate[v][image[-1]] = AT_REST
        if whole:
            taken_at = [float(stamps[v][i]) for v, i in enumerate(image)]
            near = stream.t >= max(begin, min(taken_at) - STOP_S)
            near &= stream.t <= min(end, max(taken_at) + STOP_S)
            q = stream.q[near]
            rows.append((middle, q[0] + (q - q[0]).mean(axis=0), end, 0, image))  # exact if all are alike
    motion, moved = [], set[int]()
    for v, t in enumerate(stamps):
        motion.append(1 + np.searchsorted(stops[:, 0] + _AFTER_S, t))
        fate[v][(fate[v] == MOVING) & np.isnan(stream.at(t)).any(axis=1)] = UNREAD
        moved |= set(motion[v][fate[v] == MOVING].tolist())
        late = np.searchsorted(stops[:, 0], t) >= motion[v]  # the next stop began, and not long ago
        fate[v][(fate[v] == REPEATED) & late & np.isin(motion[v], [*moved])] = MOVING
    every = math.ceil(max(int((one == MOVING).sum()) for one in fate) / _MOST_MOVING)
    kept = sorted(moved)[:: max(every, 1)]
    together = dict[float, list[int]]()
    for v, t in enumerate(stamps):
        here = np.flatnonzero(fate[v] == MOVING)
        taken = here[np.isin(motion[v][here], kept)][:_MOST_MOVING]
        fate[v][np.setdiff1d(here, taken)] = BEYOND
        for i in taken.tolist():
            together.setdefault(float(t[i]), [-1] * V)[v] = i
    times = np.array([*together])
    for t, q, image in zip(times, stream.at(times), together.values(), strict=True):
        v = next(v for v, i in enumerate(image) if i >= 0)
        rows.append((t, q, t, int(motion[v][image[v]]), image))
    rows.sort(key=lambda row: row[0])
    return Shots(
        q=np.array([row[1] for row in rows]).reshape(-1, stream.q.shape[1]),
        t_q=np.array([row[2] for row in rows]),
        moving=np.array([row[3] for row in rows], dtype=np.int64),
        image=np.array([row[4] for row in rows], dtype=np.int64).reshape(-1, V),
        fate=tuple(Counter(one.tolist()) for one in fate),
    )
