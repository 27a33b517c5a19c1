"""Replanning: monitor a run that follows a path, and search another path when it fails.

A path is searched again, from where the robot is, where

- the path ahead would leave an image, by the offset of both images from their prediction;
- the face was lost, and seen again on the path backwards; lost once more, it is passed over: the robot
  follows its path by its joint readings to where the face is seen again;
- the law that ends the motion is stopped by a joint limit or a singularity, or comes no nearer: the joints
  that were taken for the goal are excluded from then on.
"""

from collections.abc import Callable
from typing import Protocol

import numpy as np

from projservo_cli.findings import NOTE, Finding, Subject
from projservo_cli.loop.python_loop import BuiltInLaw
from projservo_cli.loop.stall_monitor import StallMonitor
from projservo_cli.loop.verdicts import (
    CONVERGED,
    DIVERGED,
    MARKERS_LOST,
    NO_PROGRESS,
    RUNNING,
    VERDICT_NAMES,
    WAITING,
    Limits,
    Log,
    on_plateau,
)
from projservo_cli.messages.verdict_causes import VERDICTS
from projservo_cli.records import FloatArray, Plan
from projservo_cli.task.face import Task

# Periods between checks of the path ahead, by the mean offset of the images in the last ones.
_EVERY, _LAST = 10, 5
# Senses along a path.
_BACK, _ON = -1, 1


class _Replanner(Protocol):
    """Paths to the goal of a task."""

    def predicted(self, q: FloatArray) -> FloatArray:
        """Pixels (V, b, 2) of the body at joints (n,), by the calibration, the face first."""

    def leaves(self, q: FloatArray, off: FloatArray) -> bool:
        """Whether a path of joints (s, n) leaves an image, if images err by (s, V, 2), px."""

    def replan(self, q: FloatArray, excluded: FloatArray, off: FloatArray) -> Plan | None:
        """Plan of a path from joints (n,), with image errors (V, 2), px, to goals not excluded (k, n)."""


def _stopped(verdict: int) -> bool:
    """Whether a verdict of the loop stopped a law for which another path is searched."""
    return verdict >= 0 and bool(VERDICTS[VERDICT_NAMES[verdict]].stopped)


class ExecutionMonitor:
    """Monitor of a built-in law that follows a plan.

    law : that is driven, on a plan; follow : the task with a plan as the law is given it.
    replanner : of paths to the goal; searches : how often one may be searched again.
    limits : of the run.
    stall : monitor of a robot that may lag behind its set-points; None for one that does not.
    blind : whether the robot may move on where the face is lost.
    ``attempts``: why a path was searched again each time, and when.
    """

    def __init__(
        self,
        law: BuiltInLaw,
        follow: Callable[[Plan], Task],
        replanner: _Replanner,
        searches: int,
        limits: Limits,
        stall: StallMonitor | None = None,
        *,
        blind: bool = True,
    ) -> None:
        self.law, self.follow, self.replanner = law, follow, replanner
        self.left, self.limits = searches, limits
        self.attempts: list[Finding] = []
        self._stall, self._may_pass = stall, blind
        self._excluded: list[FloatArray] = []
        self._blind = 0  # sense in which the robot passes along the path where the face is lost; 0 if seen
        self._lost = 0  # how often the face was lost
        self._waited = 0  # periods without images at the end of the path
        self._alone = 0  # instants since the law is without a plan

    def ruled(self, log: Log, k: int, verdict: int, q_dot: FloatArray) -> int:
        """Return the new verdict; write the velocity (n,) of the path backwards."""
        if k == self.limits.max_steps or verdict == CONVERGED:
            return verdict
        if verdict == MARKERS_LOST or (verdict == WAITING and self._blind):
            return self._passed(log, k, q_dot)
        if verdict == WAITING:
            return verdict
        if self._blind and verdict == RUNNING:
            sense, self._blind = self._blind, 0
            if sense == _BACK:
                return self._replanned(log, k, verdict, "face_back")
            self.attempts.append(Finding("passed_over", NOTE, amount=k, unit="1"))
            return verdict
        path, clock = self.law.law.task.reference.q, float(self.law.state.plan.clock[0])
        if clock < len(path) - 1:
            if verdict == DIVERGED and np.isfinite(q_dot).all():
                verdict = RUNNING  # a path may lead away from the goal
            return self._on_path(log, k, verdict, path[int(clock) :])
        self._alone += 1
        if not _stopped(verdict) and not self._stalls(log, k, verdict):
            return verdict
        self._excluded += [path[-1].copy(), log.read[k].copy()]
        why = VERDICT_NAMES[verdict] if _stopped(verdict) else "no progress"
        return self._replanned(log, k, verdict, why)

    def _stalls(self, log: Log, k: int, verdict: int) -> bool:
        """Whether the law that ends the motion comes no nearer."""
        if self._stall is not None:
            return verdict == NO_PROGRESS and self._stall.minimum
        window = self.limits.stall_periods
        still = on_plateau(log.judged, k, window) and on_plateau(log.judged, k, window // 2)
        return verdict == RUNNING and self._alone > window and still

    def _on_path(self, log: Log, k: int, verdict: int, ahead: FloatArray) -> int:
        """Return the new verdict with joints (s, n) ahead."""
        self._alone = 0
        if _stopped(verdict):
            return self._replanned(log, k, verdict, VERDICT_NAMES[verdict])
        checks = verdict == RUNNING and k % _EVERY == 0 and self.left > 0
        if checks and self._leaves_image(log, k, ahead):
            return self._replanned(log, k, verdict, "ahead")
        return verdict

    def _replanned(self, log: Log, k: int, verdict: int, why: str) -> int:
        """Hold the robot and follow another path, if there is one; otherwise keep the verdict."""
        if not self.left:
            return verdict
        self.left -= 1
        excluded = np.array(self._excluded).reshape(-1, log.read.shape[1])
        plan = self.replanner.replan(log.read[k], excluded, self._off(log, k))
        if plan is None:
            self.left = 0
            self.attempts.append(Finding("replanned_in_vain", NOTE, Subject(name=why), k, unit="1"))
            return verdict
        self.attempts.append(Finding("replanned", NOTE, Subject(name=why), k, unit="1"))
        self.law.follow(self.follow(plan))
        log.events[2] = -1.0
        self._alone = 0
        return WAITING

    def _passed(self, log: Log, k: int, q_dot: FloatArray) -> int:
        """Go a period along the path without images: back at first, on where the face was lost before.

        The face is lost for good where the path begins, or at its end if no other joints show the goal.
        """
        path, state = self.law.law.task.reference.q, self.law.state
        if not self._blind:
            self._lost += 1
            self._blind = _ON if self._may_pass and self._lost > 1 else _BACK
        end = float(len(path) - 1)
        clock = min(float(state.plan.clock[0]), end) + self._blind
        self._waited = self._waited + 1 if clock > end else 0
        if clock < 0.0:
            return MARKERS_LOST
        if self._waited > self.limits.max_lost_periods:
            self._blind, self._excluded = 0, [*self._excluded, path[-1].copy()]
            return self._replanned(log, k, MARKERS_LOST, "goal_hidden")
        clock = min(clock, end)
        state.plan.clock[0], step = clock, state.step
        step.parts[0], step.share[0], step.blocked[0] = 0, -1.0, -1
        there = np.array([np.interp(clock, np.arange(len(path)), joint) for joint in path.T])
        q_dot[:] = (there - log.read[k]) / self.law.gains.period
        return RUNNING

    def _off(self, log: Log, k: int) -> FloatArray:
        """Return the offset (V, 2) of the images from their prediction, px; 0 if unseen."""
        rows = slice(max(0, k + 1 - _LAST), k + 1)
        predicted = np.array([self.replanner.predicted(q) for q in log.read[rows]])
        b = min(log.s.shape[2], predicted.shape[2])
        off = log.s[rows, :, :b] - predicted[:, :, :b]
        visible = np.isfinite(off)
        count = np.maximum(visible.sum(axis=(0, 2)), 1)
        return np.asarray(np.where(visible, off, 0.0).sum(axis=(0, 2)) / count)

    def _leaves_image(self, log: Log, k: int, ahead: FloatArray) -> bool:
        """Whether the face leaves an image along joints (s, n), by the image errors now and there."""
        s_star = self.law.law.task.s_star
        at_goal = (s_star - self.replanner.predicted(ahead[-1])[:, : s_star.shape[1]]).mean(axis=1)
        x = np.linspace(0.0, 1.0, len(ahead))[:, None, None]
        return self.replanner.leaves(ahead, (1.0 - x) * self._off(log, k) + x * at_goal)
