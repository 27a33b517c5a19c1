"""What the 3D view shows, against the truth that the runs carry."""

import numpy as np
import pytest

from projservo_cli.report.animation import motion_of
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
