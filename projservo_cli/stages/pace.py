"""When a planned motion is where: as fast as the joint-speed limit lets it, or in the time it is given."""

import math
from typing import NamedTuple

import numpy as np

from projservo_cli.records import FloatArray, WorkFailed


class Pace(NamedTuple):
    """How fast a planned motion is to be.

    Attributes
    ----------
    duration : time it is given, s; None for as little as the joint-speed limit lets it take.
    ramp : time in which it comes up to its pace, and to rest again at its end, s.
    """

    duration: float | None = None
    ramp: float = 0.0


AS_FAST_AS_ALLOWED = Pace()


def least_time(q: FloatArray, speed: FloatArray) -> FloatArray:
    """Time (s,) at which joints q (s, n) are reached where one is always at its speed limit (n,), s.

    NaN throughout where no joint has a limit.
    """
    if not np.isfinite(speed).any():
        return np.full(len(q), math.nan)
    steps = (np.abs(np.diff(q, axis=0)) / speed).max(axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def timed(shortest: FloatArray, sigma: FloatArray, pace: Pace) -> FloatArray:
    """Time (s,) of a motion: its shortest time, from rest to rest, stretched to the duration it is given.

    Where nothing limits the speed, the path parameter sigma (s,) passes evenly but for the ramps.

    Raises
    ------
    WorkFailed
        If the joints would be too fast.
    """
    duration = pace.duration
    eased = from_rest(shortest, pace.ramp)
    least = float(eased[-1])
    if duration is None:
        return eased
    if least > duration:
        raise WorkFailed(
            f"trajectory.duration_s {duration:g}: the joint-speed limit lets the motion take {least:.4g} s "
            "or more: give it longer, or null for as short as that"
        )
    if not least > 0.0:
        eased = from_rest(sigma * duration, pace.ramp)
    return np.asarray(eased * (duration / eased[-1]))


def from_rest(time: FloatArray, ramp: float) -> FloatArray:
    """Times (s,) of a motion that comes up to its pace evenly in so many s, and so to rest again at its end.

    The pace, seconds of ``time`` a second, is a trapezoid, of a short motion a triangle of the same slope:
    the motion never is faster, and takes longer by the ramp.
    """
    total = float(time[-1])
    if not (ramp > 0.0 and total > 0.0):
        return time
    half = 0.5 * min(total, ramp)
    end = total + ramp if total >= ramp else 2.0 * math.sqrt(total * ramp)
    before = np.sqrt(2.0 * ramp * np.maximum(time, 0.0))
    after = end - np.sqrt(2.0 * ramp * np.maximum(total - time, 0.0))
    return np.select([time <= half, time >= total - half], [before, after], time + 0.5 * ramp)
