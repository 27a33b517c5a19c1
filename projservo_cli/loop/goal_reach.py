"""Whether the arm reaches a goal that moves: where it will be, and as fast as it goes."""

from collections import deque

import numpy as np

from projservo_cli.findings import REFUSES, Finding, Subject
from projservo_cli.records import FloatArray, JointLimits
from projservo_cli.task.objects.moving_goal import Followed, MovingGoal

# Time for which the goal is predicted, s, and periods between predictions.
_AHEAD_S, _EVERY = 1.0, 10
# Growth of an error that counts, and the time of it, s, or in time constants of the law if that is longer.
_GROWS, _CHASED_S, _CHASED = 1.1, 2.0, 5.0


class GoalReach:
    """Finds that a goal leaves the reach of the arm, or goes away faster than the arm follows.

    limits : of the joints, if the arm stops at them; None if not.
    lead_s : time constant of the law, s.
    """

    def __init__(self, goal: MovingGoal, limits: JointLimits | None, lead_s: float) -> None:
        self._goal, self._limits, self._chased_s = goal, limits, max(_CHASED_S, _CHASED * lead_s)
        self._q: FloatArray | None = None  # (n,) joints at the goal, rad or m; None before any are found
        self._led: deque[Followed] = deque()  # periods in which the law was led, from a time before on

    def found(self, k: int, q: FloatArray, now: Followed, within: float) -> Finding | None:
        """Return why the goal is out of reach in a period; None if it is not.

        q : (n,) joints as read, rad or m. within : image error that counts as reached, px.
        """
        self._led.append(now)
        while len(self._led) > 1 and now.t - self._led[1].t >= self._chased_s:
            self._led.popleft()
        recedes = self._recedes(now, within)
        # What incidences leave open may lead elsewhere than the whole pose.
        asks = recedes is None and self._goal.whole and k % _EVERY == 0
        return self._leaves(q, now, within) if asks else recedes

    def pause(self) -> None:
        """Forget errors up to now: a plan may go a long way round."""
        self._led.clear()

    def _recedes(self, now: Followed, within: float) -> Finding | None:
        """Return by how much the error has grown although the law was led."""
        errors = np.array([one.error[0] for one in self._led])
        whole = now.t - self._led[0].t >= self._chased_s and bool(np.isfinite(errors).all())
        if not whole or errors[-1] <= max(_GROWS * errors[0], within) or errors.min() < errors[0]:
            return None
        return Finding("goal_recedes", REFUSES, amount=errors[-1], limit=errors[0], unit="px")

    def _leaves(self, q: FloatArray, now: Followed, within: float) -> Finding | None:
        """Return how joints that reach where the goal is do not reach where it will be."""
        goal = self._goal
        there, left = goal.joints(q if self._q is None else self._q, now.D)
        if not left <= within:
            return None  # unknown, as from afar
        self._q = there
        motion = goal.tracker.at(now.t + _AHEAD_S)
        D = goal.moved(motion)
        ahead, left = goal.joints(there, D)
        if not left <= max(within, goal.sigma_px(motion, D @ goal.H)):
            return Finding("goal_beyond_reach", REFUSES, amount=_AHEAD_S, unit="s")
        return None if self._limits is None else beyond(self._limits, ahead, _AHEAD_S)


def beyond(limits: JointLimits, q: FloatArray, seconds: float) -> Finding | None:
    """Return the joint farthest beyond its limit of joints (n,) after a time, s; None if there is none."""
    off = np.maximum(limits.lower - q, q - limits.upper)
    of = Subject(joints=(int(np.argmax(off)) + 1,))
    return Finding("goal_leaves_reach", REFUSES, of, seconds, unit="s") if (off > 0.0).any() else None
