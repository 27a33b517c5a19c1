"""Following: a law is led to a goal that an object carries while it moves, and the run is judged by it.

A law of gain λ comes to rest at its goal as exp(−λ t). Given the goal where it will be 1/λ later, it moves
along with the goal: λ (x* + v/λ − x) = λ (x* − x) + v. The law stays as it is, and so do its limits.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple, Self

import numpy as np

from projservo_cli.control.law import State
from projservo_cli.findings import NOTE, REFUSES, Finding, Subject, from_text
from projservo_cli.geometry.kinematics import project
from projservo_cli.image_size import within_images
from projservo_cli.loop.goal_ending import Ending
from projservo_cli.loop.goal_reach import GoalReach, beyond
from projservo_cli.loop.python_loop import BuiltInLaw
from projservo_cli.loop.verdicts import (
    CONVERGED,
    DIVERGED,
    FOLLOWED,
    JOINT_LIMIT,
    LOST_GOAL,
    MAX_STEPS,
    NO_PROGRESS,
    OUT_OF_REACH,
    OUT_OF_VIEW,
    RUNNING,
    TOO_FAST,
    WAITING,
    Limits,
    Log,
    tolerance,
)
from projservo_cli.records import MM, FloatArray, WorkFailed
from projservo_cli.robots.latency_compensation import DrivenRobot, Tracked
from projservo_cli.task.face import Task
from projservo_cli.task.incidences import image_error_at
from projservo_cli.task.objects.displaced_object import CarriedGoal
from projservo_cli.task.objects.moving_goal import Followed, MovingGoal
from projservo_cli.task.target import TaskImages

# Rms of the errors over their stated deviation that counts as followed.
_WITHIN = 3.0
# Time in which the velocity of an object is learnt, s: until then its goal is not led.
_LEARNT_S = 0.8
# Consecutive periods in which a limit of an estimate is passed that count as passed.
_SURE = 5
# Periods between checks whether the goal will be where a plan leads, and share of the path by which not.
_EVERY, _FREE = 10, 0.1


class FollowLimits(NamedTuple):
    """When a goal counts as followed, and when it is given up."""

    seconds: float  # for which it is followed, s
    max_speed: float  # of its object, mm/s, or px/s if no length is known
    lost_s: float  # for which its motion is predicted, s
    approach_mm: float  # distance of the tool from the goal within which no motion is predicted
    replans: int = 0  # how often a plan to it may be made again


class FollowedGoal(NamedTuple):
    """A goal to follow."""

    goal: MovingGoal
    limits: FollowLimits
    tracked: Tracked
    # True displacements (k, 4, 4) of the object at times (k,), s, since it was planned first, and its middle.
    truth: Callable[[FloatArray], tuple[FloatArray, FloatArray]]
    since: float | None = None  # when a retreat from the object began, s

    def true_motion(self, t: FloatArray) -> tuple[FloatArray, FloatArray]:
        """True displacements (k, 4, 4) of the goal at times (k,), s, and the middle (4,) of its object, m.

        Since the motion was planned; NaN if unknown.
        """
        T, middle = self.truth(t)
        if self.since is None:
            return T, middle
        (T_then,), _ = self.truth(np.array([self.since]))
        return T @ np.linalg.inv(T_then), T_then @ middle

    def retreat(self, images: TaskImages, t: float) -> Self:
        """Return the goal of a retreat that begins at a time, s, which goes along with the object."""
        goal = replace(self.goal, images=images, whole=True, D_planned=self.goal.tracker.at(t).D, taught=None)
        return self._replace(goal=goal, since=t)


class GoalMonitor:
    """The goal of a run that moves: it leads the law, and rules by how well the goal is followed.

    ``periods``: the goal over time. ``since``: period from which on it is followed; None before.
    ``here``: start and goal in the last period. ``replannings``: when a plan to it was made again, and why.
    ``covered``: views that did not show the object as the others did, when some did so last.
    ``true_motion``: as of the goal.
    """

    def __init__(
        self,
        law: BuiltInLaw,
        followed: FollowedGoal,
        robot: DrivenRobot,
        limits: Limits,
        plan: Callable[[Callable[[float], FloatArray], FloatArray], Task] | None = None,
    ) -> None:
        self._law, self._robot, self._limits = law, robot, limits
        self._goal, self._asked, self.true_motion = followed.goal, followed.limits, followed.true_motion
        # Task with a plan from joints (n,) to where the displacement (4, 4) after some time, s, has the goal.
        self._plan = plan
        self._leads_to: FloatArray | None = None  # displacement (4, 4) of the goal of the plan; None before
        self.replannings: list[Finding] = []
        self.covered: Finding | None = None
        self.lead_s = 1.0 / (law.gains.gain_t * law.gains.scale)
        self.periods: list[Followed] = []
        self.since: int | None = None
        self._before: list[Followed] = []  # periods in which it was not followed well enough
        self.reason: Finding | None = None
        kept = robot.plant.limits if limits.stop_at_joint_limit else None
        self._reach = GoalReach(self._goal, kept, self.lead_s)
        self._fast = 0
        self._turned: Finding | None = None  # why the law cannot be given the goal
        self._given_up: int | None = None  # period in which it was
        self._ending: Ending | None = None  # of a run without its goal

    def lead(self) -> FloatArray:
        """Give the law the goal where it will be, and return the images (V, m, 2) of the face where it is."""
        t, goal = self._robot.steered.reading.t_q, self._goal
        self._leads = bool(self.periods) and t - self.periods[0].t >= _LEARNT_S
        self._now, ahead = goal.tracker.at(t), goal.tracker.at(t + self.lead_s)
        self._D, D_ahead = goal.moved(self._now), goal.moved(ahead if self._leads else self._now)
        if self._ending is not None and self._ending.D_back is not None:
            self._D = D_ahead = self._ending.D_back
        images = goal.at(D_ahead)
        self._ahead, self._turned = images.by_points().s_star, None
        try:
            if self._law.arrives_in <= 0.0:  # else it goes to where the plan has the goal
                self._law.lead_to(images.task(self._law.law.model))
        except WorkFailed as error:
            self._turned = from_text(str(error), REFUSES)
        self.here = goal.at(self._D)
        self.covered = goal.tracker.covered or self.covered
        self.s_star, now = self.here.by_points().s_star, self._now
        self.periods.append(
            Followed(
                t=t,
                D=self._D,
                s_star=self.s_star,
                error=(math.nan,) * 3,
                sigma_px=goal.sigma_px(now, self._D @ goal.H),
                speed=now.speed_mm_s if math.isfinite(now.speed_mm_s) else now.speed_px_s,
                unseen_s=goal.tracker.unseen_s(t),
            )
        )
        return self.s_star

    def judge(self) -> float:
        """Return the image error of the tool as measured, px rms, against the goal where it is."""
        state = self._law.state
        if math.isfinite(float(state.face_px[0])):  # it measured
            error = self._error(state, self._D @ self._goal.H)
            self.periods[-1] = self.periods[-1]._replace(error=error, H=state.pose.copy())
        return self.periods[-1].error[0]

    def _error(self, state: State, H_star: FloatArray) -> tuple[float, float, float]:
        """Error of the tool as measured from the goal at H_star (4, 4): px, mm and deg.

        A goal of incidences is met by many poses, so it has no mm and deg.
        """
        goal, model = self._goal, self._law.law.model
        if not goal.whole:
            rows = self.here.task(model).incidences
            return image_error_at(rows, state.pose), math.nan, math.nan
        A_star = goal.images.body.M[: len(state.A)] @ H_star.T
        off = project(model.P, state.A) - project(model.P, A_star)
        return float(np.sqrt(np.square(off).sum(axis=-1).mean())), *goal.off(state.pose, H_star)

    @property
    def followed(self) -> list[Followed]:
        """Periods since the goal was reached last, until it was given up or no longer followed."""
        return self._before if self.since is None else self.periods[self.since : self._given_up]

    @property
    def carried(self) -> CarriedGoal | None:
        """The goal in the last period, with its errors; None of a retreat, out of sight, or pushed."""
        return None if self.pushed else self._goal.carried(self.periods[-1].t)

    @property
    def pushed(self) -> bool:
        """Whether its object was pushed, so that its motion is unknown."""
        return self._goal.tracker.pushed is not None

    @property
    def motion(self) -> str | None:
        """Kind of motion of its object, as the last frames show it; None if it was pushed."""
        return None if self.pushed else self._goal.tracker.kind.name

    def goes_on(self, limits: Limits) -> None:
        """Lead the law on by other limits, to no other verdict than that the goal is lost."""
        self._limits, self._asked = limits, self._asked._replace(seconds=math.inf)

    @property
    def over_window(self) -> tuple[float, float]:
        """Image error since then, px rms over time, and the error that counts as followed."""
        squares = np.nanmean([(one.error[0] ** 2, one.sigma_px**2) for one in self.followed], axis=0)
        return math.sqrt(squares[0]), _WITHIN * math.sqrt(squares[1])

    def ruled(self, log: Log, k: int, verdict: int, q_dot: FloatArray) -> int:
        """Return the new verdict; the arm slows down before it ends a run without its goal."""
        if self._ending is not None:
            return self._ending.ruled(log, k, verdict, q_dot)
        if verdict in (JOINT_LIMIT, OUT_OF_VIEW):
            self.reason = self._at_end(log, k, verdict)
            return OUT_OF_REACH
        if verdict == NO_PROGRESS or k == self._limits.max_steps:
            if self.since is not None:
                seconds = self.periods[-1].t - self.periods[self.since].t
                self.reason = Finding("followed_short", amount=seconds, limit=self._asked.seconds, unit="s")
            return MAX_STEPS
        if verdict == DIVERGED and np.isfinite(q_dot).all():
            verdict = RUNNING  # the goal went away faster
        if verdict not in (RUNNING, CONVERGED, WAITING):
            return verdict
        cause = self._cause(log, k, q_dot)
        try:
            waits = verdict == WAITING or (cause == RUNNING and self._replanned(log, k))
        except WorkFailed as error:  # no plan leads to where the goal will be
            cause, self.reason = OUT_OF_REACH, from_text(str(error), REFUSES)
        if cause != RUNNING:
            self._given_up = len(self.periods)
            near_mm = self._asked.approach_mm
            self._ending = Ending(cause, self._goal, self.periods, self._robot, self._limits, near_mm)
            return self._ending.ruled(log, k, verdict, q_dot)
        return WAITING if waits else self._followed(log, k)

    def _replanned(self, log: Log, k: int) -> bool:
        """Whether the arm waits for a plan, which is made once the velocity is learnt, and as it changes."""
        if self._plan is None:
            return False
        if not self._leads:
            return True
        if (planned := self._leads_to) is not None:
            left_s = self._law.arrives_in * self._robot.robot.bounds.period / self._law.gains.scale
            # Near the end, the law goes the rest by itself.
            may = left_s >= _LEARNT_S and len(self.replannings) < self._asked.replans
            if not may or k % _EVERY or not self._elsewhere(planned, left_s):
                return False
            why = Subject(name="goal_elsewhere")
            self.replannings.append(Finding("replanned", NOTE, why, k, unit="1"))
        self._law.follow(self._plan(self._displaced_after, log.read[k]))
        return True

    def _displaced_after(self, seconds: float) -> FloatArray:
        """Displacement (4, 4) of the goal after a time, s, which a plan then leads to."""
        self._leads_to = self._goal.moved(self._goal.tracker.at(self._robot.steered.reading.t_q + seconds))
        return self._leads_to

    def _elsewhere(self, planned: FloatArray, seconds: float) -> bool:
        """Whether the goal will be elsewhere after a time, s, than the plan has it (4, 4), beyond chance.

        A plan keeps the arm in sight and in reach, so the law may go a small share of the path without it.
        """
        motion = self._goal.tracker.at(self._robot.steered.reading.t_q + seconds)
        D = self._goal.moved(motion)
        off = self._goal.at(D).s_star - self._goal.at(planned).s_star
        sigma = self._goal.sigma_px(motion, D @ self._goal.H)
        far = max(_WITHIN * math.hypot(sigma, self._limits.image_error_px), _FREE * self.periods[-1].error[0])
        return float(np.sqrt(np.square(off).sum(axis=-1).mean())) > far

    def _at_end(self, log: Log, k: int, verdict: int) -> Finding:
        """Return which joint stands at its limit, or that the face left an image."""
        if verdict == OUT_OF_VIEW:
            return Finding("out_of_view", REFUSES, amount=float(k), unit="1")
        joint = int(log.events[2])
        unit = "m" if self._law.law.model.prismatic[joint] else "rad"
        of = Subject(joints=(joint + 1,))
        return Finding("joint_limit", REFUSES, of, float(log.read[k, joint]), unit=unit)

    def _followed(self, log: Log, k: int) -> int:
        """``FOLLOWED`` once the error stayed within its deviation for long enough."""
        now, stated = self.periods[-1], self._stated(log, k)
        self.periods[-1] = now._replace(sigma_px=stated)
        if self.since is None:
            arrived = self._leads and now.error[0] <= stated
            self.since = len(self.periods) - 1 if arrived else None
            return RUNNING
        window = self.followed
        if now.t - window[0].t < self._asked.seconds:
            return RUNNING
        error, most = self.over_window
        if error <= most:
            return FOLLOWED
        self._before, self.since = window, None
        return RUNNING

    def _stated(self, log: Log, k: int) -> float:
        """Stated deviation of the image error in this period, px, before it is stored."""
        within = tolerance(self._limits, float(log.fit[k, 2]), self._robot.noise_ratio)
        return math.hypot(within, self.periods[-1].sigma_px)

    def _cause(self, log: Log, k: int, q_dot: FloatArray) -> int:
        """Return the cause to give the goal up; ``RUNNING`` if there is none."""
        now, asked = self.periods[-1], self._asked
        near = now.error[1] < asked.approach_mm
        patience = _SURE * self._robot.robot.bounds.period if near else asked.lost_s
        if now.unseen_s > patience:
            self.reason = Finding("goal_unseen", REFUSES, amount=now.unseen_s, limit=patience, unit="s")
            return LOST_GOAL
        self._fast = self._fast + 1 if self._leads and now.speed > asked.max_speed else 0
        unit, size = ("m/s", 1.0 / MM) if math.isfinite(self._now.speed_mm_s) else ("px/s", 1.0)
        if self._fast > _SURE:
            amount, limit = (size * speed for speed in (now.speed, asked.max_speed))
            self.reason = Finding("goal_fast", REFUSES, amount=amount, limit=limit, unit=unit)
            return TOO_FAST
        return self._beyond(log, k, q_dot)

    def _beyond(self, log: Log, k: int, q_dot: FloatArray) -> int:
        """``OUT_OF_REACH`` if the goal is about to leave images or joint limits; otherwise ``RUNNING``."""
        plant, ahead_s = self._robot.plant, self.lead_s
        outside = ~np.asarray(within_images(self._ahead, plant.image_size[:, None]).all(axis=1))
        if self._turned is not None:
            self.reason = self._turned
            return OUT_OF_REACH
        if outside.sum() > len(outside) - plant.min_views:
            view = self._robot.robot.view[int(np.argmax(outside))]
            self.reason = Finding("goal_leaves_view", REFUSES, Subject(views=(view,)), ahead_s, unit="s")
            return OUT_OF_REACH
        leaves = None
        if not self._leads or self._law.arrives_in > 0.0:
            self._reach.pause()
        else:
            leaves = self._reach.found(k, log.read[k], self.periods[-1], _WITHIN * self._stated(log, k))
        if leaves is None and self.since is not None and self._limits.stop_at_joint_limit:
            leaves = beyond(plant.limits, log.read[k] + ahead_s * q_dot, ahead_s)
        self.reason = leaves or self.reason
        return RUNNING if leaves is None else OUT_OF_REACH
