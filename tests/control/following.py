"""Plans of the scene in miniature, and runs that follow them."""

import math
import pickle

import numpy as np

from projservo_cli.planning.motion_margins import limits_alone
from projservo_cli.records import JointLimits, no_lenses
from projservo_cli.stages.plan import plan_task
from projservo_cli.task.target import TargetGoal, TaskImages, followed
from tests.known import asked
from tests.scene import GAINS, Run, limits

SPEED = math.radians(30.0)


_PLANS: dict[bytes, bytes] = {}


def planned(sc, G=None, profile="linear", duration=None, speed=SPEED, ramp=0.0):
    """Plan of a scene in the frame of its model, at a joint-speed limit.

    It is made once for equal arguments, since it takes seconds without the compiler; this is a copy.
    """
    key = pickle.dumps((sc, G, profile, duration, speed, ramp))
    if key not in _PLANS:
        n = len(sc.q_start)
        demands = limits_alone(JointLimits(np.full(n, -9.0), np.full(n, 9.0), *np.full((2, n), speed)))
        shown = TaskImages(sc.q_start, sc.s_start, TargetGoal.at(sc.s_star), sc.plant.center)
        motion = asked(profile, duration=duration, ramp=ramp)
        plan = plan_task(sc.seen(G)._replace(lens=no_lenses(2)), shown, motion, demands)
        _PLANS[key] = pickle.dumps(plan)
    return pickle.loads(_PLANS[key])


def tracked(sc, G=None, plan=None, rate=1.0, task=None):
    """Task of a scene with the plan to follow."""
    task = sc.task(G) if task is None else task
    return followed(sc.seen(G), task, planned(sc, G) if plan is None else plan, GAINS.period, rate)


class Followed(Run):
    """One compiled closed loop that follows its plan."""

    def __init__(self, sc, law, G=None, plan=None, bounds=None, task=None, **given):
        self.plan = planned(sc, G) if plan is None else plan
        task = tracked(sc, G, self.plan, task=task)
        self.periods = self.plan.duration / GAINS.period
        bounds = limits(speed=np.full(len(sc.q_start), SPEED)) if bounds is None else bounds
        super().__init__(sc, law, G=G, task=task, bounds=bounds, **given)
