"""What the 3D view shows, against the truth that the runs carry."""

import numpy as np

from projservo_cli.geometry.kinematics import forward_kinematics
from projservo_cli.records import changed
from projservo_cli.report.animation import motion_of, write_view
from projservo_cli.simulation.arm import camera_center
from tests.configured import truth_of
from tests.report.cases import SHORT, case


def test_cameras_on_the_tool_move_past_a_scene_that_stands_still(tmp_path):
    """What is drawn shows the same from the cameras as the displacement of the scene before them."""
    config, _, material = case()
    truth, plant, trace = truth_of(config), material.plant, material.traces["exact"]
    model = truth.robot.model(truth.P, on_tool=True)
    goal = np.linalg.inv(forward_kinematics(model, trace.q[-1])) @ truth.robot.base_tool
    traces = {"exact": changed(trace, goal_pose=goal)}
    motion = motion_of(truth.robot, plant._replace(model=model), truth.M, material.plan, traces)
    run, centers = motion.runs["exact"], [camera_center(P) for P in truth.P]
    assert np.ptp(run.face, axis=0).max() == 0.0
    for k, q in enumerate(trace.q):
        before = (plant.M[plant.order] @ forward_kinematics(model, q).T)[:, :3]
        expected = np.linalg.norm(before[:, None] - centers, axis=2)
        drawn = np.linalg.norm(run.face[k][:, None] - run.cameras[k, :, 0], axis=2)
        np.testing.assert_allclose(drawn, expected, atol=1e-12)
        flange = np.linalg.inv(forward_kinematics(model, q)) @ truth.robot.base_tool
        np.testing.assert_allclose(run.robot[k, -1], flange[:3, 3], atol=1e-12)
    apexes = motion.goal[[1, 17]]  # each camera has fifteen points and a gap
    np.testing.assert_allclose(apexes, run.cameras[-1, :, 0], atol=1e-12)
    write_view(tmp_path / "view.html", motion, name="a", known="b")
    text = (tmp_path / "view.html").read_text(encoding="utf-8")
    assert "planned path of the middle of the cameras" in text
    assert text.count('"name":"right camera"') == 1 + len(trace.q)  # at first, and in each frame


def test_the_robot_ends_at_the_tool_and_carries_the_face():
    config, _, material = case()
    truth = truth_of(config)
    scene = motion_of(truth.robot, material.plant, truth.M, material.plan, material.traces)
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
