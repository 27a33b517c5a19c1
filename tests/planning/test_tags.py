"""Tools with several tags: one in sight is enough, by metric truth, in plans and in the loop."""

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from projservo_cli.geometry.stereo import optical_centers
from projservo_cli.planning.joint_constraints import FINE_PX, constraints_of
from projservo_cli.planning.rrt_connect import margins_at
from projservo_cli.simulation.arm import METRIC_A_INF
from projservo_cli.stages.plan import plan_task
from projservo_cli.stages.plan_motion import search_of
from projservo_cli.stages.runs.run_trace import trace_of
from projservo_cli.stages.servo import drive
from tests.configured import calibrate, scenario_of
from tests.known import configured
from tests.planning.columns import IMAGE, VISIBILITY

# Joint 4 alone leads from start to goal, deg, and turns the middle tag away from both cameras on the way.
START = [135.19, -81.51, -99.29, -86.65, 116.76, 88.12]
GOAL = [135.19, -81.51, -99.29, -241.35, 116.76, 88.12]


def scenario(*overrides, calibrated=False):
    """The scenario of the task with its tags, by the true model or by a calibration."""
    ends = [
        f"task.start={{joints: {START}, unit: deg}}",
        f"task.goal={{joints: {{joints: {GOAL}, unit: deg}}}}",
    ]
    tool = ("markers.positions_m=null", "markers.face=null", "markers.tags=roof")
    config = configured("ur5", *tool, *ends, "control.features=body", "control.mode=track", *overrides)
    return scenario_of(config, calibrate.run(config)[1] if calibrated else None)


def in_truth(truth, q):
    """Side times area, width and border (t, 6) of each tag at joints (n,), by plain geometry."""
    X = (truth.M @ truth.displacement(q).T)[:, :3].reshape(5, 4, 3)
    s = truth.images(q, truth.M).reshape(2, 5, 4, 2)
    O = optical_centers(truth.P, METRIC_A_INF)[:, :3]
    rows = []
    for t in range(5):
        normal = np.cross(X[t, 0] - X[t, 1], X[t, 2] - X[t, 1])
        hulls = [s[v, t][ConvexHull(s[v, t]).vertices] for v in range(2)]
        edges = [np.roll(hull, -1, axis=0) - hull for hull in hulls]
        across = [np.c_[-e[:, 1], e[:, 0]] / np.linalg.norm(e, axis=1)[:, None] for e in edges]
        widths = [np.ptp(hull @ a.T, axis=0).min() for hull, a in zip(hulls, across, strict=True)]
        border = np.minimum(s[:, t] + 0.5, truth.image_size[:, None] - 0.5 - s[:, t]).min(axis=(1, 2))
        rows.append([*((O - X[t].mean(axis=0)) @ normal), *widths, *border])
    return np.array(rows)


def test_the_tag_that_counts_is_the_best_of_all_tried_one_by_one():
    made = scenario()
    truth, q_start = made.simulated.truth, made.ends.q_start
    A = truth.M @ truth.displacement(q_start).T
    c = constraints_of(truth.model, A, made.ends.task(truth.model), q_start, made.demands)
    first = in_truth(truth, q_start)[0, :2]
    rng, counted = np.random.default_rng(2), set()
    for q in q_start + rng.uniform(-0.5, 0.5, (300, 6)) * [0.3, 0.3, 0.5, 3.0, 1.0, 1.0]:
        if not ((truth.M @ truth.displacement(q).T @ truth.P[:, 2].T) > 0.0).all():
            continue
        found = in_truth(truth, q)
        found[:, :2] /= first
        excess = (found - c.full[VISIBILITY : IMAGE + 2]) / np.repeat([1.0, FINE_PX], [2, 4])
        best = int(excess.min(axis=1).argmax())
        margins = margins_at(c, q)[0]
        np.testing.assert_allclose(margins[VISIBILITY : IMAGE + 2], found[best], rtol=1e-6, atol=1e-6)
        assert (margins[VISIBILITY:] > c.full[VISIBILITY:]).all() == (excess.min(axis=1) > 0.0).any()
        counted.add((best, bool(excess[best].min() > 0.0)))
    assert len({tag for tag, _ in counted}) >= 3
    assert {kept for _, kept in counted} == {True, False}


def limited(made):
    """What the motion keeps to, where joints other than the fourth hardly move."""
    ends = np.radians([START, GOAL])
    limits = made.demands.limits._replace(lower=ends.min(axis=0) - 0.03, upper=ends.max(axis=0) + 0.03)
    return made.demands._replace(limits=limits)


@pytest.mark.parametrize("profile", ["joint_space", "auto"])
def test_the_middle_tag_may_turn_away_where_another_stays_in_sight(profile):
    made = scenario(f"trajectory.profile={profile}")
    demands, search = limited(made), search_of(made)
    shown = made.world.model, made.ends, made.world.inputs.trajectory
    plan = plan_task(*shown, demands, search)
    assert plan.feasible, plan.reason
    seen = np.array([in_truth(made.simulated.truth, q) for q in plan.q])
    assert seen[:, 0, :2].min() < 0.0  # the face is not, all the way
    assert (seen[:, :, :2].min(axis=2).max(axis=1) > 0.0).all()
    assert plan.margin.min() > 0.0
    alone = plan_task(*shown, demands._replace(tags=demands.tags[:0]), search)
    assert not alone.feasible


def test_a_run_that_sees_another_tag_alone_for_a_while_arrives():
    """The face turns away, and is lost to both cameras besides; the body is measured by the others."""
    unseen = "disturbance.lost_markers={from_step: 10, steps: 30, markers: [0, 1, 2, 3]}"
    made = scenario("trajectory.profile=joint_space", "noise.servo_px=0.2", unseen, calibrated=True)
    plan = plan_task(
        made.world.model, made.ends, made.world.inputs.trajectory, limited(made), search_of(made)
    )
    trace = trace_of(drive(made, plan, "exact_track"))
    assert np.isnan(trace.s[10:40, :, :4]).all()
    assert trace.verdict == "converged"
    assert trace.position_error_mm < 1.0
