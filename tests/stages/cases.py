"""Configured benchmarks with their true model: what stages plan and servo do without a calibration."""

from functools import cache

import numpy as np

from projservo_cli.config import load_config
from projservo_cli.stages.plan import demands_of, plan_task
from projservo_cli.stages.scenario import plant_of, reach_of, truth_of
from projservo_cli.stages.servo import drive, gains_of, limits_of
from tests.conftest import ROOT


class Case:
    """Truth, start, goal, plan and settings of one configuration."""

    def __init__(self, name, overrides=()):
        self.config = load_config(ROOT / "configs" / f"{name}.yaml", list(overrides))
        self.truth = truth_of(self.config)
        self.reach = reach_of(self.config, self.truth)
        self.plant = plant_of(self.config, self.truth, self.reach.q_start)
        self.gains = gains_of(self.config)
        self.limits = limits_of(self.config)
        self.plan = self.planned(self.truth.model)
        self.traces = {}

    def planned(self, model, profile="linear", samples=11):
        return plan_task(
            model, self.reach.q_start, self.reach.s_start, self.reach.s_star, self.truth.center, profile,
            self.config.trajectory.delta, samples, demands_of(self.config),
        )  # fmt: skip

    def servo(self, law, model=None, gains=None, sense=None, **limits):
        """Trace of one law without noise, by default with the true metric model and the planned sense."""
        sense = self.plan.rotation_sense() if sense is None else sense
        most = limits.get("max_steps", self.limits.max_steps)
        return drive(
            law, self.truth.model if model is None else model, self.plant, self.truth, self.reach,
            self.gains if gains is None else gains, self.limits._replace(**limits),
            np.zeros((most + 1, 2, len(self.truth.face), 2)), sense,
        )  # fmt: skip

    def trace(self, law):
        """Trace of one law as configured, with the true metric model; made once."""
        if law not in self.traces:
            self.traces[law] = self.servo(law)
        return self.traces[law]

    @property
    def goal_center(self):
        """True centre of the face at the goal, m."""
        body = np.linalg.solve(self.truth.robot.base_tool, self.truth.M_face.mean(axis=0))
        return (self.reach.goal_pose @ body)[:3]


@cache
def case(name):
    """Case of a configuration, made once."""
    return Case(name)
