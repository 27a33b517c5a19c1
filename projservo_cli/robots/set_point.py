"""Where a robot is sent: set-points that the loop integrates, and where the arm comes to rest behind them.

A servo lags behind its set-point while that moves, and sags below it under gravity. What a law is given are
the joints at which the arm would come to rest if nothing more were sent: lag has then no part in its loop,
and sag is integrated away.
"""

import math
from typing import NamedTuple

import numpy as np

from projservo_cli.records import BoolArray, FloatArray
from projservo_cli.robots.contract import Bounds

# Share of the sag allowed for that a servo may still be behind where sag is told from lag.
_STILL = 0.2


class Servo(NamedTuple):
    """What is taken of the servos of a robot."""

    lag_s: float  # time constant with which joints follow, s
    sag: FloatArray  # (n,) how far joints stay short under gravity, rad or m


class SetPoint:
    """The set-point of a robot.

    bounds : of its commands; servo : what is taken of its servos.
    q : (n,) first reading, rad or m: where it is sent at first.
    ``target``: (n,) the set-point, rad or m. ``short``: (n,) joints whose last step was cut short because the
    set-point was too far ahead of the reading.
    """

    def __init__(self, bounds: Bounds, servo: Servo, q: FloatArray) -> None:
        self._bounds, self._servo = bounds, servo
        self.target = q.copy()
        self.short: BoolArray = np.zeros(len(q), dtype=np.bool_)
        self._q, self._sag = q.copy(), np.zeros(len(q))
        self._behind = np.zeros(len(q))  # by how much a servo of that lag would be

    @property
    def at_rest(self) -> FloatArray:
        """Joints (n,) at which the arm comes to rest if nothing more is sent, rad or m."""
        return self.target - self._sag

    def read(self, q: FloatArray, seconds: float) -> None:
        """Learn the sag from a reading (n,), so long after the last one: only while hardly anything moves."""
        self._q = q.copy()
        weight = 1.0 / (1.0 + (self._behind / (_STILL * self._servo.sag)) ** 2)
        share = -math.expm1(-seconds / self._servo.lag_s)
        self._sag += share * weight * (self.target - q - self._sag)

    def step(self, dq: FloatArray, seconds: float) -> tuple[FloatArray, FloatArray]:
        """Go on by a joint step (n,), rad or m, in so many seconds: the set-point (n,) and its speed (n,)."""
        bounds, lag, before, q = self._bounds, self._servo.lag_s, self.target, self._q
        target = np.clip(before + dq, q - bounds.lead, q + bounds.lead)
        self.short = target != before + dq
        self.target = np.clip(target, np.minimum(bounds.lower, q), np.maximum(bounds.upper, q))
        speed = np.clip((self.target - before) / seconds, -bounds.speed, bounds.speed)
        fades = math.exp(-seconds / lag)
        self._behind = fades * self._behind + (1.0 - fades) * lag * np.abs(speed)
        return self.target.copy(), speed
