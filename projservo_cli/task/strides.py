"""Joints beside one another: how far apart they are, and how long the way takes."""

import math

from projservo_cli.geometry.jit import njit
from projservo_cli.records import FloatArray


@njit
def put(q: FloatArray, other: FloatArray) -> None:
    """Write joints to a row."""
    for i in range(q.shape[0]):
        q[i] = other[i]


@njit
def near(q: FloatArray, other: FloatArray, stride: float) -> bool:
    """Whether no joint differs by more than a stride, rad or m."""
    for i in range(q.shape[0]):
        if not abs(q[i] - other[i]) <= stride:
            return False
    return True


@njit
def slowness(speed: FloatArray, weight: FloatArray) -> None:
    """Seconds a rad or m of each joint takes at the joint-speed limit; 1 for all where nothing limits."""
    limited = False
    for i in range(speed.shape[0]):
        weight[i] = 1.0 / speed[i] if math.isfinite(speed[i]) else 0.0
        limited = limited or weight[i] > 0.0
    if not limited:
        weight[:] = 1.0


@njit
def stride(q: FloatArray, other: FloatArray, weight: FloatArray) -> float:
    """Time between joints, s: that of the joint that takes longest."""
    longest = 0.0
    for i in range(weight.shape[0]):
        longest = max(longest, weight[i] * abs(other[i] - q[i]))
    return longest
