"""Planned motions of random tasks against a grid search.

From the root of the repository: ``python -m tests.planning.study paper 500``.
"""

import sys
import time
from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from projservo_cli.config import load_config
from projservo_cli.records import Plan, WorkFailed
from projservo_cli.stages.plan import Profile, demands_of, plan_task
from projservo_cli.stages.scenario import Shown
from projservo_cli.stages.studies import projective_twin
from projservo_cli.stages.world import truth_of
from projservo_cli.sweep.tasks import random_tasks
from tests.conftest import ROOT
from tests.planning.oracle import TrueTask

FINE = 1001


@dataclass
class Outcome:
    """What became of one task."""

    number: int
    oracle: bool
    kept: bool = False
    sight: float = np.nan
    border_px: float = np.nan
    seconds: float = np.nan
    reason: str = ""
    constraint: str = ""
    feasible: bool = False
    near: bool = False
    linear: bool = False


@dataclass
class Study:
    """Outcomes of all tasks of an arm."""

    outcomes: list[Outcome] = field(default_factory=list)

    @property
    def missed(self):
        """Tasks the grid search finds a path for while the planned motion leaves sight or image."""
        return [o for o in self.outcomes if o.oracle and not o.kept]

    def words(self):
        feasible = [o for o in self.outcomes if o.oracle]
        seconds = [o.seconds for o in self.outcomes if np.isfinite(o.seconds)]
        counted = [o for o in self.missed if not o.near]
        yield (
            f"grid search: {len(feasible)} of {len(self.outcomes)} feasible; planned motion keeps sight and "
            f"images in {sum(o.kept for o in feasible)}; of {len(self.missed)} others {len(counted)} count"
        )
        beyond = sum(o.kept and not o.oracle for o in self.outcomes)
        yield f"planned although the grid finds nothing: {beyond}"
        yield f"the linear profile keeps sight and images in {sum(o.linear for o in feasible)} of them"
        least = min((o.sight for o in feasible if o.kept), default=np.nan)
        yield f"least true sight {least:.4f} of the start's"
        yield f"joints and operators too: {sum(o.feasible for o in feasible)} feasible; others by " + str(
            dict(Counter(o.constraint for o in feasible if not o.feasible))
        )
        yield (
            f"CPU ms a plan: median {1e3 * np.median(seconds):.1f}, "
            f"95 % {1e3 * np.quantile(seconds, 0.95):.1f}, most {1e3 * max(seconds):.1f}"
        )
        for o in self.missed:
            yield f"  task {o.number}: {'within one cell' if o.near else 'COUNTS'}: {o.reason}"


def tasks_of(arm, count, seed):
    """Truth of a shipped configuration, and random tasks of it."""
    config = load_config(ROOT / "configs" / f"{arm}.yaml", ["trajectory.border_px=0.0"])
    truth = truth_of(config)
    q_front = np.array(config.task.start.values(config.robot.joint_types))
    return config, truth, random_tasks(truth, q_front, count, np.random.default_rng(seed))


def outcome_of(number, config, truth, model, q_start, q_goal):
    """Plan one task and judge the plan by true geometry."""
    s_start, s_star = (truth.images(q, truth.M_face) for q in (q_start, q_goal))
    H = [truth.robot.pose(q) @ np.linalg.inv(truth.robot.base_tool) for q in (q_start, q_goal)]
    true = TrueTask(truth.P, truth.image_size, *((truth.M_face @ T.T)[:, :3] for T in H))
    outcome = Outcome(number, true.feasible())
    begun = time.thread_time()
    try:
        shown = Shown(q_start, s_start, s_star, truth.center)
        plan = plan_task(model, shown, Profile("constrained"), demands_of(config))
    except WorkFailed as error:
        outcome.reason = str(error)
    else:
        outcome.seconds = time.thread_time() - begun
        judge(outcome, true, plan)
    if outcome.oracle and not outcome.kept:
        outcome.near = not true.feasible(cells=1)
    return outcome


def judge(outcome, true, plan: Plan):
    """Fill in how the planned shares fare in truth, looked at in ``FINE`` places."""
    fine = np.linspace(0.0, 1.0, FINE)
    mu = np.stack([np.interp(fine, plan.sigma, column) for column in plan.mu.T], axis=1)
    senses = min(
        true.senses(),
        key=lambda pair: abs(abs(pair[0]) - abs(plan.theta_r)) + abs(abs(pair[1]) - abs(plan.theta_p)),
    )
    sight, border = true.along(mu, *senses)
    outcome.sight, outcome.border_px = float(sight.min()), float(border.min())
    outcome.kept = outcome.sight > 0.0 and outcome.border_px > 0.0
    outcome.reason, outcome.constraint, outcome.feasible = plan.reason, plan.constraint, plan.feasible
    sight, border = true.along(np.repeat(fine[:, None], 3, axis=1), *true.senses()[0])
    outcome.linear = bool(sight.min() > 0.0 and border.min() > 0.0)


def study(arm, count, seed=1):
    """Outcomes of random tasks, with the true operators in a projective frame."""
    config, truth, tasks = tasks_of(arm, count, seed)
    model = projective_twin(truth.model)
    result = Study()
    for number, (q_start, q_goal) in enumerate(zip(tasks.q_start, tasks.q_goal, strict=True)):
        result.outcomes.append(outcome_of(number, config, truth, model, q_start, q_goal))
    return result, tasks


if __name__ == "__main__":
    found, drawn = study(sys.argv[1], int(sys.argv[2]), *map(int, sys.argv[3:]))
    print(f"{len(drawn.angle)} tasks")
    for line in found.words():
        print(line)
