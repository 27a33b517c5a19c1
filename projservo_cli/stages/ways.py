"""Ways through joint space to the goal of a task, for a run that is under way."""

from dataclasses import replace

import numpy as np

from projservo_cli.geometry.kinematics import forward_kinematics, project
from projservo_cli.geometry.lens import straight_views
from projservo_cli.guidance.goals import Aim
from projservo_cli.guidance.margins import Reaching
from projservo_cli.guidance.validity import BORDER, CLEAR
from projservo_cli.guidance.way import Budget, find_way, margins_at
from projservo_cli.records import NO_SPREAD, FloatArray, Plan
from projservo_cli.stages.motions import body_at_start, joint_constraints, sampled_way, search_of
from projservo_cli.stages.scenario import Scenario


class Ways:
    """Ways to the goal of a scenario, of which a plan was made."""

    def __init__(self, scenario: Scenario, plan: Plan) -> None:
        model, shown, self._trajectory = scenario.model, scenario.ends, scenario.config.trajectory
        task, amplitudes = shown.task(model), np.array([plan.tau, plan.theta_r, plan.theta_p])
        self._plan, self._search, self._made = plan, search_of(scenario), 0
        demands, q_start = scenario.demands, shown.q_start
        self._reaching = Reaching(model, demands, plan.H_hat, amplitudes, plan.A, plan.a, task.O, q_start)
        A = body_at_start(model, task, shown, plan.A)
        self._c = joint_constraints(self._reaching, A, task, self._trajectory, self._search.spread)
        self._aim = Aim(task.A_star, straight_views(model.lens, task.s_star), self._search.sigma)

    def predicted(self, q: FloatArray) -> FloatArray:
        """Pixels (2, m, 2) of the face at joints (n,), by the calibration."""
        c = self._c
        return project(c.model.P, c.M[: c.face] @ forward_kinematics(c.model, q).T, c.model.lens)

    def leaves(self, q: FloatArray, off: FloatArray) -> bool:
        """Whether a path of joints (s, n) leaves an image, where images are off by (s, 2, 2), px."""
        for joints, px in zip(q, off, strict=True):
            P = self._c.model.P.copy()
            P[:, :2] += px[:, :, None] * P[:, 2:]
            c = self._c._replace(spread=NO_SPREAD, model=self._c.model._replace(P=P))
            if margins_at(c, joints)[0][BORDER:].min() < 0.0:
                return True
        return False

    def anew(self, q: FloatArray, shunned: FloatArray, off: FloatArray) -> Plan | None:
        """Plan of a way from joints (n,), off by (2, 2) px, to other goals than those shunned (k, n).

        It keeps so much farther from borders and regions. Each is searched with a seed of its own.
        """
        self._made += 1
        plan, asked, full = self._plan, self._trajectory, self._c.full.copy()
        full[BORDER:CLEAR] += np.abs(off).max(axis=1)
        full[CLEAR] += np.abs(off).max()
        c = self._c._replace(full=full)
        how = Budget(asked.search.samples, asked.search.seed + self._made, asked.goals, shunned)
        start = np.clip(q, c.lower, c.upper)
        way = find_way(c, self._aim, start, self._search.q_shown, how, self._search.acceleration)
        if way.pace is None:
            return None
        found = sampled_way(self._reaching, way.pace, asked.samples)
        H, H_start = (forward_kinematics(self._reaching.model, q) for q in (start, plan.q_start))
        sigma, duration = np.linspace(0.0, 1.0, len(found.mu)), float(way.pace.time[-1])
        return replace(
            plan,
            q_start=start,
            A=plan.A @ (H @ np.linalg.inv(H_start)).T,
            q=found.along.q,
            mu=found.mu,
            sigma=sigma,
            time=duration * sigma,
            duration=duration,
        )
