"""What the 3D view shows, against the truth that the runs carry."""

import dataclasses

import numpy as np
import pytest

from projservo_cli.report.animation import MOST_INSTANTS, motion_of
from tests.configured import truth_of
from tests.report.cases import SHORT, case


@pytest.fixture(scope="module")
def shown():
    config, _, material = case()
    truth = truth_of(config)
    scene = motion_of(truth.robot, material.plant, truth.M, material.plan, material.traces)
    return truth, material, scene


def test_the_robot_ends_at_the_tool_and_carries_the_face(shown):
    truth, material, scene = shown
    assert list(scene.runs) == list(material.traces)
    for name, trace in material.traces.items():
        run = scene.runs[name]
        np.testing.assert_array_equal(run.seconds, trace.period * np.arange(SHORT + 1))
        np.testing.assert_array_equal(run.hidden, trace.self_occluded)
        # Round-off of products of exponentials, m.
        np.testing.assert_allclose(run.robot[:, -1], trace.pose[:, :3, 3], atol=1e-12)
        np.testing.assert_allclose(run.path, trace.center, atol=1e-12)
        in_tool = np.linalg.solve(truth.robot.base_tool, truth.M.T)
        np.testing.assert_allclose(
            run.markers, np.swapaxes((trace.pose @ in_tool)[:, :3], 1, 2), atol=1e-12, rtol=0
        )
        face = [truth.face[k] for k in material.plant.order]
        np.testing.assert_array_equal(run.face, run.markers[:, face])


def test_the_ends_of_the_task_and_the_planned_path_between_them(shown):
    _, material, scene = shown
    trace = material.traces["direct_three"]
    run = scene.runs["direct_three"]
    np.testing.assert_allclose(scene.start, run.face[0], atol=1e-12)
    middle = scene.goal.mean(axis=0)
    np.testing.assert_allclose(middle, material.goal_center(trace), atol=1e-12)
    # The model of the case is the true one, so the joints of the plan lead along the straight line.
    way = middle - trace.center[0]
    off = scene.planned - trace.center[0]
    off -= np.outer(off @ way / (way @ way), way)
    np.testing.assert_allclose(off, 0.0, atol=1e-6)
    np.testing.assert_allclose(scene.planned[[0, -1]], [trace.center[0], middle], atol=1e-6)


def test_instants_miss_neither_the_quick_beginning_nor_the_end_of_a_long_run(shown):
    truth, material, _ = shown
    trace, count = material.traces["stacked"], 2001
    share = 1.0 - np.exp(-np.arange(count) / 20.0)  # as good as still after a tenth
    q = trace.q[0] + share[:, None] * (trace.q[-1] - trace.q[0])
    hidden, unknown = np.zeros((count, 2), dtype=bool), np.full((4, 4), np.nan)
    long = dataclasses.replace(trace, q=q, self_occluded=hidden, goal_pose=unknown)
    scene = motion_of(truth.robot, material.plant, truth.M, material.plan, {"stacked": long})
    assert scene.goal is None  # of which only images are known
    chosen = np.round(scene.runs["stacked"].seconds / trace.period)
    assert (chosen[0], chosen[-1]) == (0, 2000)
    assert len(chosen) <= MOST_INSTANTS
    assert np.all(np.diff(chosen) > 0)
    assert np.count_nonzero(chosen < 100) > 0.4 * MOST_INSTANTS
