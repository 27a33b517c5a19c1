"""Plans where no path keeps everything: what is given up, in what order, and that it is said."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm

from projservo_cli.cli.words import summary
from projservo_cli.config import load_config
from projservo_cli.geometry.kinematics import backward
from projservo_cli.records import WorkFailed
from projservo_cli.report.values import scalars
from projservo_cli.stages import calibrate, plan, servo
from projservo_cli.stages.plan import demands_of, plan_task
from projservo_cli.task.along import planning_workspace
from projservo_cli.task.approach import approach
from tests.conftest import ROOT
from tests.planning.cases import constrained, reaching_of
from tests.samples import pixels, poe
from tests.stages.cases import case

# Joints of the second robot with the elbow all but straight, rad, and a twist of 4 mm that leads from there
# out of its reach: the one direction in which no joint moves it, rad and m.
STRETCHED = np.array([2.4487, -1.7559, -0.03, -2.8467, 2.5378, 1.2031])
BEYOND = np.array([0.001101, -0.000833, 0.0, -0.000762, -0.00191, 0.00314])


@pytest.mark.parametrize("name", ["paper", "ur5"])
def test_joints_approach_what_they_can_reach(name, rng):
    """A displacement that the joints can make is reached; what is left is what the images say."""
    reaching = reaching_of(name)
    q_goal = reaching.q_start + rng.uniform(-0.05, 0.05, 6)
    start = np.linalg.inv(poe(reaching.model, reaching.q_start))
    goal = poe(reaching.model, q_goal) @ start
    work, q = planning_workspace(reaching), reaching.q_start.copy()
    H_back = backward(reaching.model, reaching.q_start)
    allowed = reaching._replace(demands=reaching.demands._replace(miss_px=5.0))
    left = approach(allowed, H_back, tuple(goal.ravel()), q, work, np.empty((2, 4)), np.empty(6))
    s = [pixels(reaching.model.P, reaching.A @ H.T) for H in (poe(reaching.model, q) @ start, goal)]
    assert left == pytest.approx(np.linalg.norm(s[1] - s[0], axis=2).max(), abs=1e-6)
    assert left < 0.1


def test_the_bound_on_conditioning_is_given_up_first():
    plan = constrained("paper", conditioning=0.5)
    assert plan.feasible
    assert plan.relaxed.startswith("with conditioning below its bound (")
    assert "of 0.5)" in plan.relaxed
    assert "behind" not in plan.relaxed
    assert plan.relaxed in plan.reason
    assert plan.reason.startswith("no path was found that keeps all constraints; planned ")
    assert plan.miss.max() == 0.0
    np.testing.assert_array_equal(plan.given_up, plan.condition <= 0.5)
    strict = constrained("paper")
    assert strict.feasible
    assert strict.relaxed == ""
    assert not strict.given_up.any()


def test_truly_infeasible_tasks_stay_so():
    """Joint limits and views are never given up."""
    example = case("paper")
    lower, upper = example.truth.robot.lower.copy(), example.truth.robot.upper.copy()
    lower[0], upper[0] = example.ends.q_start[0] - 0.01, example.ends.q_start[0] + 0.01
    plan = constrained("paper", lower=lower, upper=upper)
    assert not plan.feasible
    assert plan.constraint == "joints"
    assert plan.relaxed == ""
    plan = constrained("paper", border_px=470.0)
    assert not plan.feasible
    assert plan.constraint == "image"


def stretched(**demands):
    """Plan of a task whose goal a robot could just reach if it were a few millimetres larger."""
    example = case("ur5")
    x, y, z, *shift = BEYOND
    X = np.zeros((4, 4))
    X[:3, :3], X[:3, 3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]], shift
    truth = example.truth
    goal = expm(X) @ poe(truth.model, STRETCHED)
    s_star = pixels(truth.P, truth.M_face @ goal.T)
    asked = demands_of(example.config)._replace(**demands)
    reach = example.ends
    return plan_task(
        truth.model, reach.q_start, reach.s_start, s_star, truth.center, "constrained", 0.9, 101, asked
    )


@pytest.mark.volume
def test_joints_stay_behind_where_the_goal_is_just_out_of_reach():
    """The images of the joints that are planned stay as far behind as the plan says, and no further."""
    truth = case("ur5").truth
    found = stretched()
    assert found.feasible, found.reason
    assert "px behind the planned images (5 px allowed)" in found.relaxed
    assert 0.5 < found.miss.max() < 5.0
    assert found.given_up[-1]
    assert not found.given_up[:50].any()
    start = np.linalg.inv(poe(truth.model, found.q_start))
    for q, s, miss in zip(found.q[::10], found.s[::10], found.miss[::10], strict=True):
        off = pixels(truth.P, found.A @ (poe(truth.model, q) @ start).T) - s
        # Where they follow, joints are solved to 1e-8 rad.
        assert np.linalg.norm(off, axis=2).max() == pytest.approx(miss, abs=1e-4)
    for allowed in (0.0, 0.5 * found.miss.max()):
        strict = stretched(miss_px=allowed)
        assert not strict.feasible
        assert "the joints cannot follow" in strict.reason


@pytest.fixture
def lost():
    """The task of paper.yaml with a plan that no joints can follow to its end."""
    config = load_config(ROOT / "configs" / "paper.yaml", ["control.mode=track", "noise.servo_px=0.0"])
    _, calibration, _ = calibrate.run(config)
    found = plan.run(config, calibration)
    q = found.q.copy()
    q[-5:] = np.nan
    return config, calibration, replace(found, q=q, feasible=False, reason="too near to something")


@pytest.mark.volume
def test_without_a_plan_to_follow_the_law_goes_alone_and_says_so(lost):
    config, calibration, planned = lost
    trace = servo.run(config, calibration, planned, "exact_track")
    alone = servo.run(config, calibration, planned, "exact")
    assert (trace.verdict, trace.mode, trace.planned_s) == ("converged", "track", None)
    assert trace.unplanned == "no joints can follow the plan: too near to something"
    assert alone.unplanned == ""
    np.testing.assert_array_equal(trace.q, alone.q)
    words = summary("servo", {"laws": [scalars(trace)]})
    assert "driven without a plan: no joints can follow the plan: too near to something" in words


@pytest.mark.volume
def test_a_law_may_be_refused_to_go_without_a_plan(lost):
    _, calibration, planned = lost
    refusing = load_config(ROOT / "configs" / "paper.yaml", ["control.without_plan=refuse"])
    with pytest.raises(WorkFailed, match=r"cannot follow the planned motion.*control\.without_plan replan"):
        servo.run(refusing, calibration, planned, "exact_track")
