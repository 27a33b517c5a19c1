"""The end of a run without its goal: the arm slows down, and near a lost object goes back as it came."""

import math
from collections.abc import Sequence

import numpy as np

from projservo_cli.loop.verdicts import CONVERGED, LOST_GOAL, RUNNING, WAITING, Limits, Log, tolerance
from projservo_cli.records import FloatArray
from projservo_cli.robots.latency_compensation import DrivenRobot
from projservo_cli.task.objects.moving_goal import Followed, MovingGoal

# Time of a retreat from a goal that is lost, at most, s, and share of its path that is left out.
_BACK_S, _LEFT_OUT = 3.0, 0.1


class Ending:
    """The end of a run, with a verdict, of a goal that is given up.

    periods : of the run, more to come.
    near_mm : distance of the tool from a lost goal within which it goes back.
    ``D_back``: displacement (4, 4) of the goal to which it goes back; None if it does not.
    """

    def __init__(
        self,
        verdict: int,
        goal: MovingGoal,
        periods: Sequence[Followed],
        robot: DrivenRobot,
        limits: Limits,
        near_mm: float,
    ) -> None:
        self._verdict, self._goal, self._periods, self._robot = verdict, goal, periods, robot
        self._limits, self._near_mm = limits, near_mm
        self.D_back: FloatArray | None = None
        self._began = math.inf  # when it began to go back, s
        self._before: FloatArray | None = None  # (n,) velocity when it began to slow down
        self._slowing = 0  # periods since

    def ruled(self, log: Log, k: int, verdict: int, q_dot: FloatArray) -> int:
        """Return the verdict once the arm is at rest, and where it is to be; its velocity (n,) until then."""
        if k == self._limits.max_steps:
            return self._verdict
        if self.D_back is not None and verdict in (RUNNING, CONVERGED, WAITING) and not self._is_back(log, k):
            return RUNNING
        self.D_back = None
        if self._slowed(log, k, q_dot) or self._goes_back():
            return RUNNING
        return self._verdict

    def _slowed(self, log: Log, k: int, q_dot: FloatArray) -> bool:
        """Slow the arm down within its limits; whether it still moves."""
        if self._before is None:
            self._before = log.q_dot[k - 1].copy() if k else np.zeros_like(q_dot)
            self._slowing = 0
        bounds = self._robot.robot.bounds
        periods_each = np.abs(self._before) / (bounds.limits.acceleration * bounds.period)
        needed, self._slowing = max(1, math.ceil(float(periods_each.max()))), self._slowing + 1
        q_dot[:] = self._before * (1.0 - self._slowing / needed)
        return self._slowing < needed

    def _goes_back(self) -> bool:
        """Whether the arm, at rest near a goal that is lost, begins to go back, as it came to its object."""
        H_star = self._goal.H
        measured = [one for one in self._periods if np.isfinite(one.H).all()]
        lost = self._verdict == LOST_GOAL and math.isinf(self._began)
        if not lost or not measured or not measured[-1].error[1] < self._near_mm:
            return False
        far = next((one for one in reversed(measured) if not one.error[1] < self._near_mm), measured[0])
        relative = np.linalg.solve(far.D @ H_star, far.H)
        self.D_back = np.asarray(measured[-1].D @ H_star @ relative @ np.linalg.inv(H_star))
        self._began, self._before = self._periods[-1].t, None
        return True

    def _is_back(self, log: Log, k: int) -> bool:
        """Whether the arm went back all but a share of its path, or for long enough."""
        now, whole = self._periods[-1], next(one.error[0] for one in self._periods if one.t > self._began)
        left = max(_LEFT_OUT * whole, tolerance(self._limits, float(log.fit[k, 2]), self._robot.noise_ratio))
        return now.t >= self._began + _BACK_S or now.error[0] < left
