"""Time parameterization of a path through waypoints: no stops, within speeds and accelerations of joints.

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
from projservo_cli.planning.joint_constraints import Constraints, Trial, reached
from projservo_cli.records import FloatArray

# Share of the limits of speed and acceleration that is planned with, so that feedback has room.
ROOM = 0.9
# Straight chords by which the validity of a rounded corner is checked.
_CHORDS = 8
# Most halvings of a rounded corner.
_HALVINGS = 12
# Intervals of the grid on each straight piece and on each rounded corner.
_STRAIGHT, _ROUNDED = 64, 24
_BISECTIONS = 48
# Motion between two corners, rad or m, or s, below which it is none.
_LEAST = 1e-12


class TimedPath(NamedTuple):
    """A path on a grid of its parameter, the time along straight pieces at the speed limits, and its pace."""

    s: FloatArray  # (k,) s
    q: FloatArray  # (k, n) joints, rad or m
    dq: FloatArray  # (k, n) dq/ds
    ddq: FloatArray  # (k − 1, n) d²q/ds² of each interval
    x: FloatArray  # (k,) (ds/dt)²
    time: FloatArray  # (k,) s


def minimum_time(speed: FloatArray, q: FloatArray) -> FloatArray:
    """Time (s,) at which joints q (s, n) are reached if one is always at its speed limit (n,), s.

    If nothing limits, the motion of the joint that moves most.
    """
    speed = speed if np.isfinite(speed).any() else np.ones_like(speed)
    return np.concatenate([[0.0], np.cumsum((np.abs(np.diff(q, axis=0)) / speed).max(axis=1))])


def time_parameterized(c: Constraints, path: FloatArray, trial: Trial) -> TimedPath:
    """The pace of a path of corners (k, n), from rest to rest at ``ROOM`` of the limits."""
    path = path[np.r_[True, np.abs(np.diff(path, axis=0)).max(axis=1) > _LEAST]]
    if len(path) == 1:
        still = np.zeros((2, path.shape[1]))
        return TimedPath(
            s=np.array([0.0, 1.0]), q=path + still, dq=still, ddq=still[:1], x=np.zeros(2), time=np.zeros(2)
        )
    times = np.diff(minimum_time(c.limits.speed, path))
    slopes = np.diff(path, axis=0) / times[:, None]
    sizes = np.zeros(len(path))
    for k in range(1, len(path) - 1):
        sizes[k] = _rounding(c, path[k], slopes[k - 1 : k + 1], 0.5 * times[k - 1 : k + 1].min(), trial)
    timed = _on_grid(path, times, slopes, sizes)
    with np.errstate(divide="ignore", over="ignore"):
        timed.x[:] = ((ROOM * c.limits.speed / np.abs(timed.dq)) ** 2).min(axis=1)
    _speeds_into(timed, ROOM * c.limits.acceleration)
    return timed


def _parabola(corner: FloatArray, slopes: FloatArray, size: float, x: FloatArray) -> FloatArray:
    """Joints (k, n) at shares x (k, 1) of the parabola that rounds a corner from ``size`` s before it."""
    return np.asarray(corner + size * (x**2 * slopes[1] - (1.0 - x) ** 2 * slopes[0]))


def _rounding(c: Constraints, corner: FloatArray, slopes: FloatArray, size: float, trial: Trial) -> float:
    """Return the distance from a waypoint (n,), s, of its largest valid blend: ``size`` at most.

    The smallest blend leaves the waypoint by less than the distance of two checks.
    """
    x = np.linspace(0.0, 1.0, _CHORDS + 1)[:, None]
    for _ in range(_HALVINGS):
        path = _parabola(corner, slopes, size, x)
        if all(reached(c, path[k], path[k + 1], trial) == 1.0 for k in range(_CHORDS)):
            break
        size *= 0.5
    return size


def _on_grid(path: FloatArray, times: FloatArray, slopes: FloatArray, sizes: FloatArray) -> TimedPath:
    """The rounded path on its grid, its pace still to be found."""
    steps, q, dq, ddq = [np.zeros(1)], [path[:1]], [slopes[:1]], []
    even = np.ones((_STRAIGHT, 1))
    x = np.arange(1, _ROUNDED + 1)[:, None] / _ROUNDED
    for k, slope in enumerate(slopes):
        straight = times[k] - sizes[k] - sizes[k + 1]
        if straight > _LEAST:
            step = straight / _STRAIGHT * even
            steps.append(step[:, 0])
            q.append(path[k] + (sizes[k] + np.cumsum(step, axis=0)) * slope)
            dq.append(even * slope)
            ddq.append(0.0 * even * slope)
        size = sizes[k + 1]
        if size > 0.0:
            change = slopes[k + 1] - slope
            steps.append(np.full(_ROUNDED, 2.0 * size / _ROUNDED))
            q.append(_parabola(path[k + 1], slopes[k : k + 2], size, x))
            dq.append(slope + x * change)
            ddq.append(np.tile(change / (2.0 * size), (_ROUNDED, 1)))
    s = np.cumsum(np.concatenate(steps))
    return TimedPath(
        s=s, q=np.vstack(q), dq=np.vstack(dq), ddq=np.vstack(ddq), x=np.zeros(len(s)), time=np.zeros(len(s))
    )


@merged
def _narrowed(slope: float, offset: float, bound: float, low: float, high: float) -> tuple[float, float]:
    """Those u of an interval for which |slope u + offset| ≤ bound."""
    if abs(slope) < 1e-300:
        return (low, high) if abs(offset) <= bound else (1.0, -1.0)
    first, second = (-bound - offset) / slope, (bound - offset) / slope
    return max(low, min(first, second)), min(high, max(first, second))


@internal
def _accelerations(
    timed: TimedPath, i: int, x: float, ahead: float, maximum: FloatArray
) -> tuple[float, float]:
    """Accelerations d²s/dt² that interval i allows at a pace x, to end at no more than that ahead."""
    step = timed.s[i + 1] - timed.s[i]
    low, high = -x / (2.0 * step), (ahead - x) / (2.0 * step)
    for j in range(maximum.shape[0]):
        curve = timed.ddq[i, j]
        low, high = _narrowed(timed.dq[i, j], curve * x, maximum[j], low, high)
        low, high = _narrowed(timed.dq[i + 1, j] + 2.0 * step * curve, curve * x, maximum[j], low, high)
    return low, high


@njit
def _speeds_into(timed: TimedPath, acceleration: FloatArray) -> None:
    """Write the quickest pace from rest to rest within accelerations (n,), and its times.

    The pace is as quick as speeds allow yet.
    """
    count = timed.s.shape[0]
    timed.x[count - 1] = 0.0
    for i in range(count - 2, -1, -1):
        low, high = 0.0, timed.x[i]
        a, b = _accelerations(timed, i, high, timed.x[i + 1], acceleration)
        if a <= b:
            continue
        for _ in range(_BISECTIONS):
            middle = 0.5 * (low + high)
            a, b = _accelerations(timed, i, middle, timed.x[i + 1], acceleration)
            if a <= b:
                low = middle
            else:
                high = middle
        timed.x[i] = low
    timed.x[0] = 0.0
    timed.time[0] = 0.0
    for i in range(count - 1):
        _, u = _accelerations(timed, i, timed.x[i], timed.x[i + 1], acceleration)
        step = timed.s[i + 1] - timed.s[i]
        timed.x[i + 1] = max(0.0, timed.x[i] + 2.0 * step * u)
        timed.time[i + 1] = timed.time[i] + 2.0 * step / (math.sqrt(timed.x[i]) + math.sqrt(timed.x[i + 1]))


def joints_at(timed: TimedPath, times: FloatArray) -> FloatArray:
    """Joints (k, n) at times (k,), s: at rest before the first and after the last."""
    t = np.clip(times, 0.0, timed.time[-1])
    i = np.clip(np.searchsorted(timed.time, t, side="right") - 1, 0, len(timed.time) - 2)
    since, step = t - timed.time[i], timed.s[i + 1] - timed.s[i]
    rate, u = np.sqrt(timed.x[i]), (timed.x[i + 1] - timed.x[i]) / (2.0 * step)
    done = np.clip(rate * since + 0.5 * u * since**2, 0.0, step)[:, None]
    return np.asarray(timed.q[i] + done * timed.dq[i] + 0.5 * done**2 * timed.ddq[i])
