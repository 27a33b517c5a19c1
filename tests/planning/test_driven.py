"""A small part of ``python -m tests.planning.driven ARM 500``, and the grid search with the arm behind it."""

from dataclasses import replace

import numpy as np
import pytest

from projservo_cli.cli.words import summary
from projservo_cli.config import load_config
from projservo_cli.records import WorkFailed
from projservo_cli.report.values import scalars
from projservo_cli.stages import calibrate, plan, servo
from projservo_cli.stages.world import truth_of
from tests.conftest import ROOT
from tests.planning.arm import arm_of, feasible, flood, pivot_ratio, pose, solve
from tests.planning.driven import configured, driven, feasible_tasks, true_task, words
from tests.samples import poe
from tests.stages.cases import case

pytestmark = pytest.mark.volume


@pytest.fixture(scope="module", params=["paper", "ur5"])
def tasks(request):
    return request.param, feasible_tasks(request.param, 3)


def test_feasible_tasks_are_driven_along_their_plans(tasks):
    name, found = tasks
    runs = [driven(name, i, *ends) for i, ends in enumerate(zip(found.q_start, found.q_goal, strict=True))]
    table = "\n".join(words(runs))
    assert all(run.converged for run in runs), table
    assert all(run.planned for run in runs), table
    assert sum(run.occluded for run in runs) == 0, table
    # 0.5 px of noise in trials whose joints stayed within 30° of the reference; tasks go anywhere.
    assert max(run.position_mm for run in runs) < 10.0, table


def test_feasible_tasks_have_a_path_for_the_joints(tasks):
    """A goal outside the limits has none; neither has one that the cameras cannot follow."""
    name, found = tasks
    truth = truth_of(configured(name))
    task = true_task(truth, found.q_start[0], found.q_goal[0])
    arm = arm_of(truth, 0.001)
    assert feasible(arm, task, found.q_start[0])
    narrow = arm._replace(lower=found.q_start[0] - 1e-3, upper=found.q_start[0] + 1e-3)
    assert not feasible(narrow, task, found.q_start[0])
    assert not feasible(arm._replace(conditioning=0.9), task, found.q_start[0])
    task.size = np.array([8.0, 8.0])
    assert not feasible(arm, task, found.q_start[0])


@pytest.mark.parametrize("name", ["paper", "ur5"])
def test_the_arm_of_the_grid_search_is_the_true_one(name, rng):
    truth = truth_of(configured(name))
    arm = arm_of(truth, 0.001)
    q = arm.reference + rng.uniform(-1.0, 1.0, 6)
    H, J, G, there = np.empty((3, 4)), np.empty((6, 6)), np.empty((6, 7)), np.empty((3, 4))
    pose(arm, q, H, J)
    np.testing.assert_allclose(H, poe(truth.model, q)[:3], atol=1e-12)
    found = q + rng.uniform(-0.05, 0.05, 6)
    assert solve(arm, H, found, there, J, G)
    np.testing.assert_allclose(found, q, atol=1e-6)


def test_pivot_ratio_of_orthogonal_rows(rng):
    Q, _ = np.linalg.qr(rng.normal(size=(12, 6)))
    sizes = np.array([3.0, 0.5, 2.0, 1.0, 0.25, 4.0])
    assert pivot_ratio(np.ascontiguousarray((Q * sizes).T)) == pytest.approx(0.25 / 4.0)


def test_flood_reaches_nothing_behind_a_wall(tasks):
    name, found = tasks
    truth = truth_of(configured(name))
    task = true_task(truth, found.q_start[0], found.q_goal[0])
    c = np.repeat(task.c[None], 5, axis=0)
    still = np.repeat(np.eye(3)[None], 5, axis=0)
    free = np.ones((5, 5, 5), dtype=bool)
    free[2] = False
    reached = flood(arm_of(truth, 1e-6), free, task.c, c, still, still, found.q_start[0])
    assert reached[:2].all()
    assert not reached[2:].any()


def test_a_task_that_needs_coupled_parts_is_driven_in_sight():
    """A turn first hides the face; the planned motion, with 0.5 px of noise throughout, never does."""
    example = case("coupled")
    assert not example.planned(example.truth.model, "rotation_first", 101).feasible
    q_goal = np.array(example.config.task.goal.joints.values("RRRRRR"))
    run = driven("coupled", 0, example.ends.q_start, q_goal)
    assert run.planned
    assert run.converged, run.reason
    assert run.occluded == 0


@pytest.fixture(scope="module")
def lost():
    """The task of paper.yaml with a plan that no joints can follow to its end."""
    config = load_config(ROOT / "configs" / "paper.yaml", ["control.mode=track", "noise.servo_px=0.0"])
    _, calibration, _ = calibrate.run(config)
    found = plan.run(config, calibration)
    q = found.q.copy()
    q[-5:] = np.nan
    return config, calibration, replace(found, q=q, feasible=False, reason="too near to something")


def test_without_a_plan_to_follow_the_law_goes_alone_and_says_so(lost):
    config, calibration, planned = lost
    trace = servo.run(config, calibration, planned, "exact_track")
    alone = servo.run(config, calibration, planned, "exact")
    assert (trace.verdict, trace.mode, trace.planned_s) == ("converged", "track", None)
    assert trace.unplanned == "no joints can follow the plan: too near to something"
    assert alone.unplanned == ""
    np.testing.assert_array_equal(trace.q, alone.q)
    words = " ".join(" ".join(summary("servo", {"laws": [scalars(trace)]})).split())
    assert "driven without a plan: no joints can follow the plan: too near to something" in words


def test_a_law_may_be_refused_to_go_without_a_plan(lost):
    _, calibration, planned = lost
    refusing = load_config(ROOT / "configs" / "paper.yaml", ["control.without_plan=refuse"])
    with pytest.raises(WorkFailed, match=r"cannot follow the planned motion.*control\.without_plan replan"):
        servo.run(refusing, calibration, planned, "exact_track")
