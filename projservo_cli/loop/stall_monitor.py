"""Settling: whether a robot has arrived, or is stalled away from its goal, judged while it runs.

A robot that may lag behind its set-points has arrived once it is at rest. Joints that lag or sag, and images
with latency, show their errors at the goal only.
"""

import math

import numpy as np

from projservo_cli.findings import LIMITS, REFUSES, Finding, Subject
from projservo_cli.loop.verdicts import (
    CONVERGED,
    FOLLOWING_ERROR,
    MARKERS_LOST,
    NO_PROGRESS,
    RUNNING,
    WAITING,
    Limits,
    Log,
    tolerance,
)
from projservo_cli.records import BoolArray, FloatArray
from projservo_cli.robots.latency_compensation import DrivenRobot

# Share of the tolerance that a robot at rest may still move.
_SETTLED = 0.5
# At the goal, which one noisy frame may show too soon, the law goes on for these periods; then the robot is
# held until it is at rest. It moves again if the error is beyond these tolerances, or beyond one in these
# consecutive frames.
_MORE, _GROWN, _LOOKS = 15, 3.0, 5
# Without progress at an image error of no more than this multiple of the tolerance, steps become shorter.
_NEAR = 10.0
# Progress is an image error that falls by this fraction below its minimum so far.
_FALL = 0.01
# Joints are at rest if they move by less than these deviations of their readings, or than this, rad or m;
# their set-points do by the latter.
_DEVIATIONS, _LEAST = 4.0, 3e-4
# A joint does not follow if it stays while its set-point moves by this multiple of its sag.
_STAYS = 2.0
# Windows without progress after which a robot that moves to and fro is given up.
_PATIENCE = 8
# Share of a window that a robot is held, from which lost markers and no law keep it still.
_MOSTLY = 0.5
# A window lasts this multiple of the latency of images and servos.
_TIMES_LATE = 4.0


class StallMonitor:
    """Monitor of a robot that may lag behind its set-points.

    robot : the robot; limits : of the run.
    ``reason``: cause of the stall, once found. ``minimum``: whether it is a local minimum of the law.
    """

    def __init__(self, robot: DrivenRobot, limits: Limits) -> None:
        self._robot, self._limits = robot, limits
        known, bounds = robot.known, robot.robot.bounds
        latency = bounds.max_servo_lag_s + max(0.0, float((known.delays.mean + known.delays.sigma).max()))
        self._window = max(limits.stall_periods, math.ceil(_TIMES_LATE * latency / bounds.period))
        self._still = np.maximum(_DEVIATIONS * known.sigma_q, _LEAST)
        self._best, self._since = math.inf, 0
        self._read: list[FloatArray] = []
        self._sent: list[FloatArray] = []
        self._short: list[BoolArray] = []
        self._held: list[bool] = []  # whether the robot was held, since markers were lost
        self._more = self._looks = 0  # periods and looks that are left at the goal
        self.minimum = False
        self.reason: Finding | None = None

    def ruled(self, log: Log, k: int, verdict: int, q_dot: FloatArray) -> int:
        """Return the new verdict; it is not asked while the arm is held.

        Joint velocities (n,) without progress near the goal answer noise, which a singular arm amplifies;
        ever smaller ones average over it.

        Source: H. Robbins, S. Monro, "A stochastic approximation method", Annals of Mathematical Statistics
        22 (1951) 400–407.
        """
        steered, now = self._robot.steered, len(self._read)
        self._read.append(steered.reading.q)
        self._sent.append(steered.target)
        self._short.append(steered.set_point.short)
        self._held.append(verdict == WAITING)
        error = float(log.judged[k])
        # Remaining error of the law, and the sag that is not yet learnt.
        left = error + self._robot.carried_px
        if left < (1.0 - _FALL) * self._best:
            self._best, self._since = left, now
        ends = verdict not in (RUNNING, WAITING, CONVERGED)
        if ends or k == self._limits.max_steps or math.isnan(error):
            return verdict
        within = tolerance(self._limits, float(log.fit[k, 2]), self._robot.noise_ratio)
        if now - self._since >= self._window and error <= _NEAR * within:
            q_dot *= self._window / (now - self._since)
        verdict = self._arrived(verdict, error, within)
        return verdict if verdict == CONVERGED else self._stuck(now, verdict, error <= _GROWN * within)

    def _arrived(self, verdict: int, error: float, within: float) -> int:
        """``CONVERGED`` if the robot is at rest at the goal; until then the law goes on, then waits."""
        if verdict == CONVERGED and not self._looks:
            self._looks, self._more = _LOOKS, _MORE if self._limits.noise_px > 0.0 else 0
        if not self._looks or error > _GROWN * within:
            self._looks = 0
            return verdict
        if self._more:
            self._more -= 1
            return RUNNING
        if not self._robot.settled(_SETTLED * within):
            return WAITING
        self._looks -= 1
        return verdict if verdict == CONVERGED or not self._looks else WAITING

    def _stuck(self, now: int, verdict: int, near: bool) -> int:
        """Return why the robot makes no progress, or the verdict.

        ``MARKERS_LOST`` if it was held most of the time, since markers flicker.
        ``near``: whether it is so near the goal that its joints may not resolve the command.
        """
        idle, window = now - self._since, self._window
        if idle < window:
            return verdict
        moved, sent = (np.ptp(rows[-window:], axis=0) for rows in (self._read, self._sent))
        moved_since, sent_since = (np.ptp(rows[self._since :], axis=0) for rows in (self._read, self._sent))
        stands, sag = bool((moved <= self._still).all()), self._robot.robot.bounds.sag
        short: BoolArray = np.all(self._short[-window:], axis=0) & (moved <= self._still)
        stays = (moved_since <= self._still) & (sent_since > _STAYS * np.maximum(sag, self._still)) | short
        if stays.any():
            self.reason = self._staying(stays)
            return FOLLOWING_ERROR
        if stands and (sent <= _LEAST).all():
            holds = self._held[-window:]
            if np.mean(holds) > _MOSTLY:
                self.reason = Finding(
                    "marker_flickers", REFUSES, amount=sum(holds), limit=len(holds), unit="1"
                )
                return MARKERS_LOST
            self.minimum = True
            far = float(sent.max())
            self.reason = (
                Finding("coarse_motion", LIMITS, amount=far, unit=self._unit(int(np.argmax(sent))))
                if near
                else Finding("local_minimum", LIMITS)
            )
            return NO_PROGRESS
        if (moved <= np.maximum(sag, self._still)).all() and idle >= _PATIENCE * window:
            self.reason = self._holding(moved_since, sent_since)
            return NO_PROGRESS
        return verdict

    def _unit(self, i: int) -> str:
        """Return the unit of joint i."""
        return self._robot.robot.bounds.unit(i)

    def _staying(self, stays: BoolArray) -> Finding:
        """Return the joint that stays where it is however far its set-point goes."""
        gap = np.abs(self._sent[-1] - self._read[-1]) * stays
        i = int(np.argmax(gap))
        at, off = float(self._read[-1][i]), float(gap[i])
        return Finding("joint_stays", REFUSES, Subject(joints=(i + 1,)), at, limit=off, unit=self._unit(i))

    def _holding(self, moved: FloatArray, sent: FloatArray) -> Finding:
        """Return why a robot that oscillates comes no nearer."""
        i = int(np.argmax(sent / self._still))
        code = "small_steps" if moved[i] <= 0.5 * sent[i] else "no_gain"
        subject, amounts = Subject(joints=(i + 1,)), (float(sent[i]), float(moved[i]))
        return Finding(code, LIMITS, subject, amounts[0], limit=amounts[1], unit=self._unit(i))
