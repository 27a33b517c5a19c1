"""Planned motions: what they keep to, what they are refused for, and random tasks against a grid search."""

import math
from dataclasses import replace

import numpy as np
import pytest

from projservo_cli.records import InputError, position_limits
from projservo_cli.simulation.random_tasks import STRATA, random_tasks
from projservo_cli.stages.plan import plan_task
from projservo_cli.stages.report import projective_twin
from projservo_cli.task.target import TargetGoal, TaskImages
from tests.configured import truth_of
from tests.known import asked, configured, known_scenario
from tests.planning.cases import constrained
from tests.planning.oracle import TrueTask
from tests.samples import pixels, poe
from tests.stages.cases import case

pytestmark = pytest.mark.volume


class Judged:
    """The plan of a task from its joints at both ends, and how its shares fare in truth."""

    def __init__(self, config, truth, model, q_start, q_goal):
        s_start, s_star = (truth.images(q, truth.M_face) for q in (q_start, q_goal))
        H = [truth.robot.pose(q) @ np.linalg.inv(truth.robot.base_tool) for q in (q_start, q_goal)]
        self.true = TrueTask(truth.P, truth.image_size[0], *((truth.M_face @ T.T)[:, :3] for T in H))
        shown = TaskImages(q_start, s_start, TargetGoal.at(s_star), truth.center)
        self.plan = plan = plan_task(model, shown, asked("constrained"), known_scenario(config).demands)
        fine = np.linspace(0.0, 1.0, 1001)
        mu = np.stack([np.interp(fine, plan.path_parameter, column) for column in plan.mu.T], axis=1)
        senses = min(
            self.true.senses(),
            key=lambda pair: abs(abs(pair[0]) - abs(plan.theta_r)) + abs(abs(pair[1]) - abs(plan.theta_p)),
        )
        sight, border = self.true.along(mu, *senses)
        self.sight = float(sight.min())
        self.kept = self.sight > 0.0 and border.min() > 0.0


def tasks_of(arm, count, seed):
    """Truth of a shipped configuration, and random tasks of it."""
    config = configured(arm, "trajectory.border_px=0.0")
    truth = truth_of(config)
    q_front = np.array(config.task.start.values(config.robot.joint_types))
    return config, truth, random_tasks(truth, q_front, count, np.random.default_rng(seed))


@pytest.mark.parametrize("name", ["paper", "ur5", "coupled"])
def test_a_planned_motion_keeps_what_it_says(name):
    """Images and limits from the joints alone, by the true robot; shares grow; times are even."""
    example = case(name)
    plan = constrained(name)
    assert plan.feasible, plan.reason
    assert (np.diff(plan.mu, axis=0) >= -1e-15).all()
    np.testing.assert_array_equal(plan.mu[[0, -1]], [[0, 0, 0], [1, 1, 1]])
    robot = example.truth.robot
    assert ((plan.q > robot.limits.lower) & (plan.q < robot.limits.upper)).all()
    start = np.linalg.inv(poe(example.truth.model, plan.q_start))
    M = np.array([plan.A @ (poe(example.truth.model, q) @ start).T for q in plan.q])
    s = np.stack([pixels(example.truth.P, points) for points in M])
    np.testing.assert_allclose(s, plan.s, atol=1e-5)
    np.testing.assert_allclose(s[-1], example.ends.s_star, atol=1e-5)
    border = np.minimum(s + 0.5, example.truth.image_size[:, None] - 0.5 - s).min(axis=(2, 3))
    np.testing.assert_allclose(plan.border_distance, border, atol=1e-5)
    assert plan.margin.min() > 0.0
    steps = (np.abs(np.diff(plan.q, axis=0)) / math.radians(125)).max(axis=1)
    assert steps.sum() == pytest.approx(plan.duration, rel=0.02)
    # Corners of the path are cut between samples; away from them every step takes the same time.
    assert np.median(steps) == pytest.approx(plan.duration / 100, rel=0.02)


def test_the_shipped_task_needs_coupled_parts():
    """Pure translation passes τ_0 and pure rotation θ_0; the planned motion keeps all constraints."""
    example = case("coupled")
    q_goal = np.array(example.config.task.goal.joints.values("RRRRRR"))
    found = Judged(example.config, example.truth, example.truth.model, example.ends.q_start, q_goal)
    x, zero, one = np.linspace(0, 1, 201), np.zeros(201), np.ones(201)
    for first, then in (((x, zero, zero), (one, x, x)), ((zero, x, x), (x, one, one))):
        ways = (np.stack(way, axis=1) for way in (first, then))
        assert min(found.true.along(mu, *found.true.senses()[0])[0].min() for mu in ways) < -0.05
    assert found.kept
    assert found.plan.feasible, found.plan.reason
    assert found.sight > 0.2
    plan = example.plan
    assert 0 < np.nanmin(plan.tau_0[plan.tau_0 > 0]) < plan.tau


def test_what_makes_a_task_infeasible_is_named():
    example = case("paper")
    plan = constrained("paper", border_px=470.0)
    assert not plan.feasible
    assert plan.constraint == "image"
    assert "470 px asked for" in plan.reason
    assert "mu_t" in plan.reason
    upper = example.truth.robot.limits.upper.copy()
    upper[0] = example.ends.q_start[0] + 0.01
    lower = example.truth.robot.limits.lower.copy()
    lower[0] = example.ends.q_start[0] - 0.01
    plan = constrained("paper", limits=position_limits(lower, upper))
    assert not plan.feasible
    assert plan.constraint == "joints"
    assert "joint 1 is at" in plan.reason
    assert plan.margin.min() > 0.0  # in sight all the same
    plan = constrained("paper", conditioning=0.5)
    assert not plan.feasible
    assert plan.constraint == "conditioning"
    assert "0.5 allowed" in plan.reason


def test_a_start_that_is_the_goal_is_planned_as_no_motion():
    example = case("ur5")
    shown = example.ends.to(example.ends.s_start)
    plan = plan_task(example.truth.model, shown, asked("constrained", 5), example.scenario.demands)
    assert plan.feasible
    assert plan.duration == pytest.approx(0.0, abs=1e-6)
    assert np.abs(plan.H_d - np.eye(4)).max() < 1e-7


@pytest.mark.parametrize("arm", ["paper", "ur5"])
def test_random_tasks_stay_in_sight_wherever_a_grid_search_finds_a_way(arm):
    """Planned with the true operators in a projective frame; a plan that is called feasible always stays."""
    config, truth, tasks = tasks_of(arm, 8, 7)
    model = projective_twin(truth.model)
    ends = zip(*tasks, strict=True)
    found = [Judged(config, truth, model, *pair) for pair in ends]
    reachable = [task for task in found if task.true.feasible()]
    missed = [task for task in reachable if not task.kept]
    assert [task.plan.reason for task in missed if task.true.feasible(cells=1)] == []
    assert len(reachable) >= 6
    assert all(task.kept for task in found if task.plan.feasible)
    assert any(task.plan.feasible for task in found)


def test_random_tasks_are_what_they_say():
    _, truth, tasks = tasks_of("ur5", 12, 3)
    half = 0.5 * (truth.robot.limits.upper - truth.robot.limits.lower)
    middle = 0.5 * (truth.robot.limits.upper + truth.robot.limits.lower)
    strata = []
    for ends in zip(*tasks, strict=True):
        R_start, R_goal = (poe(truth.model, q)[:3, :3] for q in ends)
        angle = math.acos(np.clip((np.trace(R_goal @ R_start.T) - 1) / 2, -1, 1))
        strata.append(min(int(STRATA * angle / math.pi), STRATA - 1))
    np.testing.assert_array_equal(np.bincount(strata), 2)
    for q in np.concatenate(tasks):
        assert (np.abs(q - middle) <= 0.9 * half).all()
        H = poe(truth.model, q)
        M = (truth.M_face @ H.T)[:, :3]
        normal = np.cross(M[1] - M[0], M[2] - M[0])
        for P, size in zip(truth.P, truth.image_size, strict=True):
            ray = -np.linalg.solve(P[:, :3], P[:, 3]) - M.mean(axis=0)
            cosine = abs(ray @ normal) / np.linalg.norm(ray) / np.linalg.norm(normal)
            assert cosine >= math.cos(math.radians(75)) - 1e-9
            s = M @ P[:, :3].T + P[:, 3]
            s = s[:, :2] / s[:, 2:]
            assert ((s >= -0.5) & (s <= size - 0.5)).all()


def test_random_tasks_before_any_rig():
    """Cameras on the tool see the face at both ends, and so many of three as are asked for, whichever."""
    _, truth, _ = tasks_of("ur5", 6, 1)
    away = truth.P[0] @ np.diag([-1.0, -1.0, 1.0, 1.0])  # looks backwards at the same height
    three = replace(truth, P=np.stack([truth.P[0], away, truth.P[1]]), image_size=truth.image_size[[0, 0, 1]])
    front = truth.robot.q_reference
    for rig, least in ((replace(truth, on_tool=True), 2), (three, 2)):
        for q in np.concatenate(random_tasks(rig, front, 6, np.random.default_rng(4), least)):
            s = rig.images(q, rig.M_face)
            size = rig.image_size[:, None]
            assert ((s >= -0.5) & (s <= size - 0.5)).all(axis=(1, 2)).sum() >= least
    endless = truth.robot._replace(limits=truth.robot.limits._replace(upper=np.full(6, np.inf)))
    with pytest.raises(InputError, match="joint limits"):
        random_tasks(replace(truth, robot=endless), np.zeros(6), 6, np.random.default_rng(0))
