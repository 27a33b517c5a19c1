"""The figure of a plan through joint space, among regions, against the truth."""

import dataclasses

import numpy as np

from projservo_cli.geometry.kinematics import forward_kinematics, project
from projservo_cli.report.figures.joint_space import PIECES
from projservo_cli.stages.plan import plan_task
from projservo_cli.stages.plan_motion import JointSearch
from tests.known import asked
from tests.report.cases import SPECS, case

BOX = [[600.0, 480.0], [700.0, 480.0], [700.0, 560.0], [600.0, 560.0]]


def seen(material, q):
    """True centre of the face in both images at joints (k, n), (k, 2, 2) px."""
    truth = material.plant.model
    points = np.array([forward_kinematics(truth, joints) @ material.middle for joints in q])
    return np.moveaxis(project(truth.P, points), 0, 1)


def test_trees_grow_from_start_and_goals_where_the_true_cameras_see_them():
    """The paper's task with a box between start and goal; the model is the true one in another frame."""
    _, bench, known = case()
    scenario, trajectory = bench.scenario, asked("joint_space", 21, keep_out=[{"left": BOX, "right": BOX}])
    search = JointSearch(scenario.goal_joints, 0.01)
    plan = plan_task(known.calibrated, scenario.ends, trajectory, scenario.demands, search)
    assert plan.feasible
    material = dataclasses.replace(known, plan=plan, trajectory=trajectory)
    data = SPECS["fig16_way"].data(material)
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
