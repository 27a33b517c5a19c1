"""From corners to joints over time: a path without stops, at the speeds and accelerations that joints have.

Corners are rounded by parabolas as large as validity lets them be, so that the path is C¹. Its pace is the
quickest on a grid: Q.-C. Pham, "A general, fast, and robust implementation of the time-optimal path
parameterization algorithm", IEEE T-RO 30, 2014; H. Pham, Q.-C. Pham, "A new approach to time-optimal path
parameterization based on reachability analysis", IEEE T-RO 34, 2018. Between the points of the grid the path
parameter is accelerated evenly and q'' is constant, so that joint accelerations are linear: bounds at both
ends of an interval hold all along it.
"""

import math
from typing import NamedTuple

import numpy as np

from projservo_cli.geometry.jit import internal, merged, njit
from projservo_cli.guidance.validity import Constraints, Trial, put_row, reached, time_between
from projservo_cli.records import FloatArray

# Straight chords by which the validity of a rounded corner is checked.
CHORDS = 8
# Halvings of a rounded corner until it counts as sharp.
HALVINGS = 12
# Intervals of the grid on each straight piece and on each rounded corner.
STRAIGHT, ROUNDED = 64, 24
BISECTIONS = 48


class Pace(NamedTuple):
    """A path on a grid of its parameter, the time along straight pieces at the speed limits, and its pace."""

    s: FloatArray  # (k,) s
    q: FloatArray  # (k, n) joints, rad or m
    dq: FloatArray  # (k, n) dq/ds
    ddq: FloatArray  # (k − 1, n) d²q/ds² of each interval
    x: FloatArray  # (k,) (ds/dt)²
    time: FloatArray  # (k,) s


def new_pace(corners: int, n: int) -> Pace:
    """Room for the pace of a path of so many corners and n joints."""
    k = (corners - 1) * (STRAIGHT + ROUNDED) + 1
    return Pace(
        np.zeros(k), np.zeros((k, n)), np.zeros((k, n)), np.zeros((k - 1, n)), np.zeros(k), np.zeros(k)
    )


@internal
def _corner(
    path: FloatArray, k: int, size: float, time_before: float, time_after: float, x: float, q: FloatArray
) -> None:
    """Write the joints at a share x of the parabola that rounds a corner from ``size`` s before it."""
    before = size / time_before * (1.0 - x) * (1.0 - x)
    after = size / time_after * x * x
    for i in range(q.shape[0]):
        q[i] = path[k, i] - before * (path[k, i] - path[k - 1, i]) + after * (path[k + 1, i] - path[k, i])


@njit
def put_corners(
    c: Constraints, path: FloatArray, count: int, sizes: FloatArray, scratch: FloatArray, trial: Trial
) -> None:
    """Write how far from each corner (k,) of a path, s, the largest valid rounding begins and ends."""
    for k in range(count):
        sizes[k] = 0.0
    for k in range(1, count - 1):
        before, after = time_between(c, path[k - 1], path[k]), time_between(c, path[k], path[k + 1])
        size = 0.5 * min(before, after)
        for _ in range(HALVINGS):
            fits = True
            _corner(path, k, size, before, after, 0.0, scratch[0])
            for j in range(1, CHORDS + 1):
                _corner(path, k, size, before, after, j / CHORDS, scratch[1])
                if reached(c, scratch[0], scratch[1], trial) < 1.0:
                    fits = False
                    break
                put_row(scratch[0], scratch[1])
            if fits:
                break
            size *= 0.5
        sizes[k] = size


@njit
def put_path(c: Constraints, path: FloatArray, count: int, sizes: FloatArray, pace: Pace) -> int:
    """Write the rounded path on its grid; how many points that has."""
    n = path.shape[1]
    g = 0
    pace.s[0] = 0.0
    for k in range(1, count):
        time = time_between(c, path[k - 1], path[k])
        straight = time - sizes[k - 1] - sizes[k]
        parts = STRAIGHT if straight > 1e-9 else 0
        for j in range(parts + 1 if k == 1 else parts):
            done = sizes[k - 1] + straight * (j if k == 1 else j + 1) / STRAIGHT
            if j > 0 or k > 1:
                g += 1
                pace.s[g] = pace.s[g - 1] + straight / STRAIGHT
            for i in range(n):
                slope = (path[k, i] - path[k - 1, i]) / time
                pace.q[g, i] = path[k - 1, i] + done * slope
                pace.dq[g, i] = slope
                if g > 0:
                    pace.ddq[g - 1, i] = 0.0
        if k < count - 1 and sizes[k] > 0.0:
            after = time_between(c, path[k], path[k + 1])
            for j in range(1, ROUNDED + 1):
                x = j / ROUNDED
                g += 1
                pace.s[g] = pace.s[g - 1] + 2.0 * sizes[k] / ROUNDED
                _corner(path, k, sizes[k], time, after, x, pace.q[g])
                for i in range(n):
                    slope = (path[k, i] - path[k - 1, i]) / time
                    change = (path[k + 1, i] - path[k, i]) / after - slope
                    pace.dq[g, i] = slope + x * change
                    pace.ddq[g - 1, i] = change / (2.0 * sizes[k])
    return g + 1


@merged
def _narrowed(slope: float, offset: float, bound: float, low: float, high: float) -> tuple[float, float]:
    """Those u of an interval for which |slope u + offset| ≤ bound."""
    if abs(slope) < 1e-300:
        return (low, high) if abs(offset) <= bound else (1.0, -1.0)
    first, second = (-bound - offset) / slope, (bound - offset) / slope
    return max(low, min(first, second)), min(high, max(first, second))


@internal
def _accelerations(pace: Pace, i: int, x: float, ahead: float, most: FloatArray) -> tuple[float, float]:
    """Accelerations d²s/dt² that interval i allows at a pace x, to end at no more than that ahead."""
    step = pace.s[i + 1] - pace.s[i]
    low, high = -x / (2.0 * step), (ahead - x) / (2.0 * step)
    for j in range(most.shape[0]):
        curve = pace.ddq[i, j]
        low, high = _narrowed(pace.dq[i, j], curve * x, most[j], low, high)
        low, high = _narrowed(pace.dq[i + 1, j] + 2.0 * step * curve, curve * x, most[j], low, high)
    return low, high


@njit
def put_pace(pace: Pace, count: int, speed: FloatArray, acceleration: FloatArray) -> float:
    """Write the quickest pace from rest to rest within speeds and accelerations (n,), and its times.

    Returns the duration, s; NaN where a sharp corner lets none pass.
    """
    n = speed.shape[0]
    for i in range(count):
        most = math.inf
        for j in range(n):
            rate = abs(pace.dq[i, j])
            if rate > 0.0:
                most = min(most, (speed[j] / rate) * (speed[j] / rate))
        pace.x[i] = most
    pace.x[count - 1] = 0.0
    for i in range(count - 2, -1, -1):
        low, high = 0.0, pace.x[i]
        a, b = _accelerations(pace, i, high, pace.x[i + 1], acceleration)
        if a <= b:
            continue
        for _ in range(BISECTIONS):
            middle = 0.5 * (low + high)
            a, b = _accelerations(pace, i, middle, pace.x[i + 1], acceleration)
            if a <= b:
                low = middle
            else:
                high = middle
        pace.x[i] = low
    pace.x[0] = 0.0
    pace.time[0] = 0.0
    for i in range(count - 1):
        _, u = _accelerations(pace, i, pace.x[i], pace.x[i + 1], acceleration)
        step = pace.s[i + 1] - pace.s[i]
        pace.x[i + 1] = max(0.0, pace.x[i] + 2.0 * step * u)
        pace.time[i + 1] = pace.time[i] + 2.0 * step / (math.sqrt(pace.x[i]) + math.sqrt(pace.x[i + 1]))
    return float(pace.time[count - 1])


def joints_at(pace: Pace, times: FloatArray) -> FloatArray:
    """Joints (k, n) at times (k,), s: at rest before the first and after the last."""
    t = np.clip(times, 0.0, pace.time[-1])
    i = np.clip(np.searchsorted(pace.time, t, side="right") - 1, 0, len(pace.time) - 2)
    since, step = t - pace.time[i], pace.s[i + 1] - pace.s[i]
    rate, u = np.sqrt(pace.x[i]), (pace.x[i + 1] - pace.x[i]) / (2.0 * step)
    done = np.clip(rate * since + 0.5 * u * since**2, 0.0, step)[:, None]
    return np.asarray(pace.q[i] + done * pace.dq[i] + 0.5 * done**2 * pace.ddq[i])
