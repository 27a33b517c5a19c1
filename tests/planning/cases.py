"""The shipped tasks as the planner sees them, with the true operators unless another model is given."""

import numpy as np

from projservo_cli.planning.motion_margins import Reaching
from projservo_cli.stages.plan import plan_task
from tests.known import asked
from tests.stages.cases import case


def reaching_of(name, model=None, border_px=20.0):
    """A shipped task, its partition taken from the linear plan of the model."""
    example = case(name)
    plan = example.plan if model is None else example.planned(model)
    demands = example.scenario.demands._replace(border_px=border_px)
    return Reaching(
        example.truth.model if model is None else model,
        demands,
        plan.H_hat,
        np.array([plan.tau, plan.theta_r, plan.theta_p]),
        plan.A,
        plan.a,
        plan.optical_center,
        np.sign(plan.optical_center @ plan.a),
        plan.q_start,
    )


def constrained(name, model=None, samples=101, **demands):
    """A shipped task planned under constraints, some of them changed."""
    example = case(name)
    return plan_task(
        example.truth.model if model is None else model,
        example.ends,
        asked("constrained", samples),
        example.scenario.demands._replace(**demands),
    )
