"""The figure of a plan through joint space, among regions, against the truth."""

import dataclasses

import numpy as np
import pytest

from projservo_cli.geometry.kinematics import forward_kinematics, project
from projservo_cli.report import style
from projservo_cli.report.animation import motion_of
from projservo_cli.report.figures.joint_space import PIECES
from projservo_cli.stages import studies
from projservo_cli.stages.motions import JointSearch
from projservo_cli.stages.plan import plan_task
from tests.configured import comparison_of, truth_of
from tests.known import asked, configured
from tests.report.cases import SPECS, case
from tests.report.test_figure_drawing import drawn, require_readable

BOX = [[600.0, 480.0], [700.0, 480.0], [700.0, 560.0], [600.0, 560.0]]
SPEC = SPECS["fig16_way"]


@pytest.fixture(scope="module")
def material():
    """The paper's task with a box between start and goal; the model is the true one in another frame."""
    _, bench, known = case()
    scenario, trajectory = bench.scenario, asked("joint_space", 21, keep_out=[{"left": BOX, "right": BOX}])
    search = JointSearch(scenario.goal_joints, 0.01)
    plan = plan_task(known.calibrated, scenario.ends, trajectory, scenario.demands, search)
    assert plan.feasible
    return dataclasses.replace(known, plan=plan, trajectory=trajectory)


@pytest.fixture(scope="module")
def data(material):
    return SPEC.data(material)


def seen(material, q):
    """True centre of the face in both images at joints (k, n), (k, 2, 2) px."""
    truth = material.plant.model
    points = np.array([forward_kinematics(truth, joints) @ material.middle for joints in q])
    return np.moveaxis(project(truth.P, points), 0, 1)


def test_trees_grow_from_start_and_goals_where_the_true_cameras_see_them(material, data):
    plan = material.plan
    roots = np.flatnonzero(plan.tree_parent < 0)
    np.testing.assert_array_equal(plan.tree_q[0], plan.q_start)
    assert len(roots) == 1 + plan.n_goals_tried
    goals = seen(material, plan.tree_q[roots[1:]])
    np.testing.assert_allclose(goals, np.broadcast_to(seen(material, plan.q[-1:]), goals.shape), atol=0.5)
    assert (plan.tree_parent[roots[1] :] >= roots[1])[len(roots) - 1 :].all()
    assert tuple(data["nodes"]) == (len(plan.tree_q), plan.tree_nodes)
    lines = np.concatenate([data["tree_start"], data["tree_goals"]]).reshape(-1, PIECES + 2, 2, 2)
    assert len(lines) == len(plan.tree_q) - len(roots)
    assert np.isnan(lines[:, -1]).all()
    edges = np.delete(np.arange(len(plan.tree_q)), roots)
    ends = [seen(material, plan.tree_q[nodes]) for nodes in (plan.tree_parent[edges], edges)]
    np.testing.assert_allclose(lines[:, 0], ends[0], atol=1e-6)
    np.testing.assert_allclose(lines[:, PIECES], ends[1], atol=1e-6)


def test_curves_are_of_the_plan_and_above_what_is_asked(material, data):
    plan = material.plan
    np.testing.assert_allclose(data["center"], seen(material, plan.q), atol=1e-6)
    np.testing.assert_allclose(data["border_px"], plan.border_distance, atol=1e-6)
    assert (plan.required_margins <= plan.margins + 0.05).all()  # between two checks
    low, high = plan.required_margins.min(axis=0), plan.required_margins.max(axis=0)
    assert (low[5:7] < high[5:7]).all()  # the width of the face at start and goal
    assert len(plan.relaxed_constraints) == 2
    for text, end, views in zip(plan.relaxed_constraints, ("start", "goal"), ("left", "right"), strict=True):
        assert text.startswith(f"relaxed at the {end}: limit of joint 3 0.4")
        assert f"width of the face in the {views} image" in text
        assert text.count("(8 px required)") == 1


def test_between_its_corners_the_way_is_straight(material):
    plan = material.plan
    assert plan.blends.shape == (len(plan.blends), 2)
    assert 0.0 < plan.blends[0, 0] < plan.blends[-1, 1] < plan.duration
    step = np.diff(plan.q, axis=0)
    towards = step / np.abs(step).max(axis=1)[:, None]
    turns = np.abs(np.diff(towards, axis=0)).max(axis=1) > 1e-9
    middle = plan.time[1:-1]
    near = [(plan.time[2:] > begin) & (plan.time[:-2] < end) for begin, end in plan.blends]
    assert not turns[~np.any(near, axis=0)].any()
    assert all(
        turns[(middle > begin) & (middle < end)].any() for begin, end in plan.blends if end - begin > 0.1
    )


def test_everything_in_the_figure_can_be_read(material, data, monkeypatch):
    figure = drawn(SPEC, material)
    require_readable(figure, monkeypatch)
    texts = {text.get_text() for text in figure.legends[0].get_texts()}
    assert {"tree from the start", "tree from the goals", "kept-out region"} <= texts
    cut = dataclasses.replace(material, plan=dataclasses.replace(material.plan, tree_nodes=9_999))
    texts = {text.get_text() for text in drawn(SPEC, cut).legends[0].get_texts()}
    assert f"{len(material.plan.tree_q)} of 9999 joint vectors of trees" in texts


def test_no_way_is_drawn_with_what_stood_in_it(material, monkeypatch):
    wall = [[600.0, 0.0], [610.0, 0.0], [610.0, 1023.0], [600.0, 1023.0]]
    _, bench, _ = case()
    scenario = bench.scenario
    trajectory = asked("joint_space", 21, keep_out=[{"left": wall}], search={"max_samples": 300})
    search = JointSearch(scenario.goal_joints, 0.01)
    plan = plan_task(material.calibrated, scenario.ends, trajectory, scenario.demands, search)
    assert not plan.feasible
    assert "in 300 samples; what stopped most: " in plan.reason
    shown = dataclasses.replace(material, plan=plan, trajectory=trajectory)
    require_readable(drawn(SPEC, shown), monkeypatch)
    assert len(style.contents(drawn(SPEC, shown), ["svg"])["svg"]) > 10_000
    assert "figure 16" in SPECS["fig14_path"].lacking(material)


def test_the_extra_runs_of_a_report_are_made_whatever_regions_the_plan_keeps_out_of(material):
    region = f"trajectory.keep_out=[{{left: {BOX}, right: {BOX}}}]"
    config = configured(
        "paper", "trajectory.profile=joint_space", "control.mode=track", "control.laws=[exact]", region
    )
    bench = comparison_of(config, material.calibration, material.plan)
    runs = studies.run_studies(bench, (0.5,), ())
    assert runs.own["direct_three", "true", False].verdict == "converged"
    assert studies.metric_plan(bench).profile == "linear"


def test_the_view_in_space_shows_the_planned_path_and_both_trees(material):
    truth, plan = truth_of(case()[0]), material.plan
    scene = motion_of(truth.robot, material.plant, truth.M, plan, {"exact": material.traces["exact"]})
    start = (forward_kinematics(material.plant.model, plan.q_start) @ material.middle)[:3]
    np.testing.assert_allclose([scene.planned[0], scene.trees[0][0]], [start, start], atol=1e-12)
    goals = plan.tree_q[np.flatnonzero(plan.tree_parent < 0)[1:]]
    there = np.array([(forward_kinematics(material.plant.model, q) @ material.middle)[:3] for q in goals])
    assert np.linalg.norm(there - scene.trees[1][0], axis=1).min() < 1e-12
    assert len(scene.planned) == len(plan.q)
