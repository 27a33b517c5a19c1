"""Pacing of set-points: one absolute set-point per period, within limits, and lag and sag of servos."""

import math

import numpy as np

from projservo_cli.records import BoolArray, FloatArray
from projservo_cli.robots.contract import Bounds, PluginRobot, Reading
from projservo_cli.robots.latency_estimation import History

# Share of the sag allowed for that a servo may still be behind where sag is separated from lag.
_STILL = 0.2
# Share by which a step may exceed its bound by rounding.
_ROUND_OFF = 1e-12


class SetPoint:
    """The set-point of a robot.

    bounds : of its commands, with the limits of its servos.
    q : (n,) first reading, rad or m: where it is sent at first.
    ``target``: (n,) the set-point, rad or m. ``short``: (n,) joints whose last step was cut short, mostly
    because the set-point was too far ahead of the reading.
    """

    def __init__(self, bounds: Bounds, q: FloatArray) -> None:
        self._bounds, self.target, self._answered = bounds, q.copy(), q.copy()
        self.short: BoolArray = np.zeros(len(q), dtype=np.bool_)
        self._q, self._sag = q.copy(), np.zeros(len(q))
        self._behind = np.zeros(len(q))  # lag of a servo with this time constant

    @property
    def at_rest(self) -> FloatArray:
        """Joints (n,) at which the arm comes to rest if nothing more is sent, rad or m."""
        return self.target - self._sag

    @property
    def unanswered(self) -> FloatArray:
        """Return the motion (n,) of the set-point since the last change of each reading, rad or m."""
        return self.target - self._answered

    def read(self, q: FloatArray, seconds: float) -> None:
        """Learn the sag from a reading (n,), some time after the last one, only if hardly any joint moves."""
        self._answered = np.where(q != self._q, self.target, self._answered)
        self._q = q.copy()
        weight = 1.0 / (1.0 + (self._behind / (_STILL * self._bounds.sag)) ** 2)
        share = -math.expm1(-seconds / self._bounds.max_servo_lag_s)
        self._sag += share * weight * (self.target - q - self._sag)

    def step(
        self, dq: FloatArray, seconds: float, counted_s: float | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Go on by a joint step (n,), rad or m, in a time that the robot counts so: set-point, speed (n,)."""
        bounds, lag, before = self._bounds, self._bounds.max_servo_lag_s, self.target
        counted_s = (seconds if counted_s is None else counted_s) * (1.0 + _ROUND_OFF)
        ahead, near, within = bounds.allowed(self._q, before, counted_s).values()
        target = np.clip(np.clip(before + dq, *ahead), *near)
        self.short = target != before + dq
        self.target = np.clip(target, *within)
        speed = np.clip((self.target - before) / seconds, -bounds.limits.speed, bounds.limits.speed)
        fades = math.exp(-seconds / lag)
        self._behind = fades * self._behind + (1.0 - fades) * lag * np.abs(speed)
        return self.target.copy(), speed


class Steered:
    """A robot that is sent absolute set-points, the sum of the steps asked for, one per period.

    The robot itself accumulates nothing.

    robot : of the contract.
    ``reading``: the last one. ``history``: joint readings of all observations. ``set_point``: its
    target, at first its joint readings. ``overruns``: periods that reading and computing did not fit.
    """

    reading: Reading
    set_point: SetPoint

    def __init__(self, robot: PluginRobot) -> None:
        self.robot, self.history, self.overruns = robot, History(), 0
        self._due: float | None = None

    @property
    def target(self) -> FloatArray:
        """The set-point (n,), rad or m."""
        return self.set_point.target

    def resume(self) -> None:
        """Go on after a pause, in which no period was missed."""
        self._due = None

    def observe(self) -> Reading:
        """Read joints and images."""
        self.reading = self.robot.read()
        t, q = self.reading.t_q, self.reading.q
        if self.history:
            self.set_point.read(q, t - self.history.last[0])
        else:
            self.set_point = SetPoint(self.robot.bounds, q)
        self.history.add(t, q)
        return self.reading

    def command(self, step: FloatArray, period: float) -> None:
        """Move the set-point by a step (n,), rad or m, and wait until the period, s, is over."""
        now = self.robot.now()
        due = (now if self._due is None else self._due) + period
        if now > due:  # thinking took too long, and no set-point must be due in the past
            due = now + period
            self.overruns += 1
        self.robot.command(*self.set_point.step(step, period, self.robot.seconds_to(due)), due)
        self._due = due
        if self.robot.wait_until(due):
            self.overruns += 1

    def hold(self) -> Reading:
        """Hold the set-point for a period, and look."""
        self.command(np.zeros_like(self.reading.q), self.robot.bounds.period)
        return self.observe()
