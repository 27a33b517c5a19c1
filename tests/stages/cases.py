"""Configured benchmarks with their true model: what stages plan and servo do without a calibration."""

from functools import cache

import numpy as np

from tests.configured import under
from tests.known import configured, driven, known_scenario, planned


class Case:
    """Truth, start, goal, plan and settings of one configuration."""

    def __init__(self, name, overrides=()):
        self.config = configured(name, *overrides)
        self.scenario = known_scenario(self.config)
        self.truth, self.ends = self.scenario.simulated.truth, self.scenario.ends
        self.plant = self.scenario.plant_of("direct_three")
        self.gains, self.limits = self.scenario.gains, self.scenario.termination
        self.plan = self.planned(self.truth.model)
        self.traces = {}

    def planned(self, model, profile="linear", samples=11):
        return planned(self.scenario, model, profile, samples)

    def servo(self, law, model=None, gains=None, sense=None, **limits):
        """Trace of one law without noise, by default with the true metric model and the planned sense."""
        gains, clean = self.gains if gains is None else gains, self.config.idealized
        scenario = under(self.scenario, clean, exact=self.ends, gains=gains)
        sense = self.plan.rotation_sense() if sense is None else sense
        return driven(scenario, sense, law, self.truth.model if model is None else model, **limits)

    def trace(self, law):
        """Trace of one law as configured, with the true metric model; made once."""
        if law not in self.traces:
            self.traces[law] = self.servo(law)
        return self.traces[law]

    @property
    def goal_center(self):
        """True centre of the face at the goal, m."""
        body = np.linalg.solve(self.truth.robot.base_tool, self.truth.M_face.mean(axis=0))
        return (self.scenario.true_ends.goal_pose @ body)[:3]


@cache
def case(name):
    """Case of a configuration, made once."""
    return Case(name)
