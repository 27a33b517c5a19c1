import dataclasses

import numpy as np
import pytest

from projservo_cli.geometry.displacements import exp_rotation
from projservo_cli.geometry.kinematics import project
from projservo_cli.report import style
from projservo_cli.report.figures import planned, scene
from projservo_cli.report.figures.path_deviation import study_numbers
from projservo_cli.report.report_data import along_line, title
from projservo_cli.simulation.arm import camera_center
from projservo_cli.task.trajectory import trajectory_displacement
from tests.report.cases import GAINS, SPECS, case
from tests.samples import prismatic, revolute

# Images of exact data differ by round-off in the projective frame, px.
PX = 1e-7


def data_of(name, material):
    """Data of a figure, by the rest of its name."""
    return next(spec for key, spec in SPECS.items() if key[6:] == name).data(material)


@pytest.fixture(params=["paper", "ur5"])
def material(request):
    return case(request.param)[2]


def test_partition_leads_from_the_face_to_its_goal(material):
    data, plan = data_of("partition", material), material.plan
    np.testing.assert_allclose(data["within_plane"][0], data["A"], atol=PX)
    np.testing.assert_allclose(data["within_plane"][-1], data["A_r"], atol=PX)
    np.testing.assert_allclose(data["onto_plane"][0], data["A_r"], atol=PX)
    np.testing.assert_allclose(data["onto_plane"][-1], data["A_t"], atol=PX)
    goal = plan.s_star[0, material.plant.order]
    np.testing.assert_allclose(np.sort(data["A_star"], axis=0), np.sort(goal, axis=0), atol=PX)
    middle = project(material.calibrated.P[:1], plan.A_c[None])[0, 0]
    along, off = data["axis"][1] - data["axis"][0], middle - data["axis"][0]
    assert abs(along[0] * off[1] - along[1] * off[0]) < 1e-6 * np.linalg.norm(along) ** 2  # lies on the axis


def test_margins_begin_at_one_and_vanish_where_visibility_changes(material):
    data, plan = data_of("visibility", material), material.plan
    np.testing.assert_allclose(data["theta_margin"][:, 0], 1.0, rtol=1e-12)
    for view, tau_margin in enumerate(data["tau_margin"].T):
        places = [0.0, data["tau_0_share"][view]]
        inside = data["tau_share"][0] <= places[1] <= data["tau_share"][-1]
        found = np.interp(places, data["tau_share"], tau_margin)  # it is linear in τ
        assert found[0] == pytest.approx(1.0, abs=1e-9)
        assert not inside or found[1] == pytest.approx(0.0, abs=1e-9)
        for theta in np.radians(data["theta_0_deg"][view]):
            turned = exp_rotation(plan.H_hat[1], -theta).T @ plan.a @ plan.optical_center[view]
            assert turned / (plan.a @ plan.optical_center[view]) == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(*data["images"][:, -1], atol=PX)  # both senses end at the same face


def test_middle_camera_of_two_equal_cameras_is_the_camera():
    P = case("paper")[2].plant.model.P[0]
    np.testing.assert_allclose(planned.middle_camera(np.stack([P, P]), np.array([1280, 1024])), P, atol=1e-9)


def test_rendered_plan_begins_and_ends_at_the_true_faces(material):
    camera = planned.middle_camera(material.plant.model.P, material.plant.image_size[0])
    trace, face = material.traces["direct_three"], material.plant.M[material.plant.order]
    for data in (data_of("planned", material), data_of("planned_steep", material)):
        for j, pose in ((0, trace.pose[0]), (-1, trace.goal_pose)):
            seen = project(camera[None], face @ (pose @ np.linalg.inv(material.robot.base_tool)).T)[0]
            gaps = np.linalg.norm(data["faces"][j][:, None] - seen, axis=2)
            assert gaps.min(axis=1).max() < 1e-6


def test_steep_profile_does_the_translation_early_and_the_same_rotations(material):
    data = data_of("planned_steep", material)
    early = data["sigma"] >= planned.STEEP
    assert (data["mu"][early, 0] == 1.0).all()
    np.testing.assert_array_equal(data["mu"][:, 1], data["sigma"])
    np.testing.assert_allclose(data["margin"][0], 1.0, rtol=1e-12)


def test_skeleton_passes_the_axes_of_revolute_joints():
    H_hat = np.array([revolute([0, 0, 0], [0, 0, 1]), prismatic([1, 0, 0]), revolute([2, 5, 3], [0, 1, 0])])
    kinds = np.array([False, True, False])
    points = scene.skeleton(H_hat, kinds, np.array([4.0, 0, 3]))
    np.testing.assert_allclose(points, [[0, 0, 0], [0, 0, 0], [2, 0, 3], [4, 0, 3]], atol=1e-15)


def test_corners_of_a_viewing_pyramid_are_seen_at_the_corners_of_the_image(material):
    model, size = material.plant.model, material.plant.image_size[0]
    pyramids = data_of("scene", material)["pyramids"]
    for P, (center, *corners) in zip(model.P, pyramids, strict=True):
        np.testing.assert_allclose(center, camera_center(P), atol=1e-12)
        m = np.c_[corners, np.ones(4)] @ P.T
        expected = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * size - 0.5
        np.testing.assert_allclose(m[:, :2] / m[:, 2:], expected, atol=1e-8)
        np.testing.assert_allclose(m[:, 2], m[0, 2], rtol=1e-12)
        assert m[0, 2] > 0


def test_scene_shows_the_tool_of_the_robot_at_the_face_and_a_goal_that_is_known(material):
    data = data_of("scene", material)
    trace = material.traces["direct_three"]
    np.testing.assert_allclose(data["robot"][-1], trace.pose[0, :3, 3], atol=1e-12)
    np.testing.assert_allclose(data["line"], [trace.center[0], material.goal_center(trace)], atol=1e-12)
    unknown = {"exact": dataclasses.replace(material.traces["exact"], goal_pose=np.full((4, 4), np.nan))}
    assert "face_goal" not in data_of("scene", dataclasses.replace(material, traces=unknown))


def test_drift_table_holds_each_run_at_its_place_and_paths_run_through_the_instants():
    material = case()[2]
    numbers = study_numbers(material.studies)
    drift, at_samples = numbers["path_deviation_mm"], numbers["path_deviation_at_samples_mm"]
    assert drift.shape == (2, 2, 2, len(GAINS))
    trace = material.studies.sweep["direct_two", "calibrated", True, GAINS[0]]
    assert drift[1, 1, 1, 0] == trace.center_deviation_mm
    assert at_samples[1, 1, 1, 0] == trace.center_deviation_at_samples_mm
    assert not numbers["path_deviation_converged"].any()  # four steps are too few
    path = data_of("drift", material)["path_mm_direct_two_2"]
    assert len(path) > 4 * len(trace.center)
    instants = along_line(trace.center, trace.center[0], material.goal_center(trace))
    for instant in 1e3 * np.stack(instants, axis=1):
        assert np.abs(path - instant).max(axis=1).min() < 1e-9
    # both sample the same curve, at different points
    assert path[:, 1].max() == pytest.approx(trace.center_deviation_mm, rel=1e-2)


def test_metric_scale_is_the_true_distance_and_the_frame_changes_no_angle():
    data = data_of("errors_three", case()[2])
    # four steps: the centre has hardly left its line, whose direction fixes the scale of a_inf
    np.testing.assert_allclose(data["tau_affine"], data["distance"], rtol=5e-3)
    assert np.abs(data["tau"] - data["distance"]).max() > 1.0
    for name in ("theta_r", "theta_p"):
        assert data[f"{name}_difference_deg_true"].max() < 1e-6


def test_joint_steps_add_up_to_the_trajectory():
    data = data_of("joints", case()[2])
    for name in ("free", "limited"):
        np.testing.assert_allclose(np.diff(data[f"q_{name}"], axis=0), data[f"step_{name}"], atol=1e-9)
    assert np.abs(data["step_limited"]).max() <= data["step_limit_deg"] * (1 + 1e-12)


def test_image_errors_end_at_the_goal_by_definition():
    material = case()[2]
    trace = dataclasses.replace(
        material.traces["direct_three"],
        center=np.tile(material.goal_center(material.traces["stacked"]), (5, 1)),
    )
    data = data_of("image_errors", dataclasses.replace(material, traces={"direct_three": trace}))
    np.testing.assert_allclose(data["center_e"], 0.0, atol=1e-9)
    np.testing.assert_allclose(data["e"], trace.s - trace.s_star)


def test_the_map_of_sight_is_the_margin_of_the_displaced_face(material):
    data, plan = data_of("path", material), material.plan
    amplitudes = (plan.tau, plan.theta_r, plan.theta_p)
    for i, j in ((0, 0), (20, 60), (80, 0), (80, 80)):
        H = trajectory_displacement(plan.H_hat, amplitudes, np.array([i / 80, j / 80, 0.4]))
        sight = plan.optical_center @ np.linalg.solve(H.T, plan.a) / (plan.optical_center @ plan.a)
        np.testing.assert_allclose(data["margin"][:, i, j], sight, atol=1e-10)
    # No share μ_p does better for both images than the one shown, of 41.
    H = trajectory_displacement(plan.H_hat, amplitudes, np.array([20 / 80, 60 / 80, 0.4]))
    s = project(material.calibrated.P, plan.A @ H.T)
    border = np.minimum(s + 0.5, material.plant.image_size[:, None] - 0.5 - s).min(axis=(1, 2))
    assert data["border_px"][:, 20, 60].min() >= border.min() - 1e-9


def test_numbers_on_the_map_of_sight_keep_off_the_path(material):
    data = data_of("path", material)
    figure = style.drawn(SPECS["fig14_path"].draw, data, 6.0)
    for axes in figure.axes[:2]:
        for text in axes.texts:
            assert np.linalg.norm(data["mu"][:, :2] - text.get_position(), axis=1).min() > planned.LABEL
    assert sum(len(axes.texts) for axes in figure.axes[:2]) > 0


def test_margins_that_grow_a_hundredfold_leave_the_others_to_be_read(material):
    data = data_of("path", material)
    data["along"][-1, 3] = 200.0
    axes = style.drawn(SPECS["fig14_path"].draw, data, 6.0).axes[3]
    one, zero, most = (axes.transData.transform((0.0, y))[1] for y in (1.0, 0.0, 200.0))
    assert one - zero > 0.15 * (most - zero)


def test_the_overview_counts_hidden_steps_and_errors_from_a_hundred_percent():
    material = case()[2]
    data = data_of("overview", material)
    for law in ("direct_three", "stacked"):
        trace = material.traces[law]
        hidden = data[f"hidden_{law}"]
        counts = trace.self_occluded_steps_left, trace.self_occluded_steps_right
        assert tuple(hidden.sum(axis=0)) == counts
        union = np.count_nonzero(hidden[:, 0] | hidden[:, 1])
        assert str(data[f"verdict_{law}"]).endswith(f"in {trace.steps} steps, face hidden in {union}")
    for name in ("tau_affine", "theta_r", "theta_p"):
        values, e = data[f"{name}_percent"], getattr(material.traces["direct_three"], name)
        assert values[0] == pytest.approx(100.0, rel=1e-14)
        np.testing.assert_allclose(values[-1] * np.abs(e[0]), 100.0 * np.abs(e[-1]), rtol=1e-12)
    # the centre lies inside its face: between the extremes of its markers in each image
    s, center = data["s_direct_three"], data["center"]
    assert (center > s.min(axis=2)).all()
    assert (center < s.max(axis=2)).all()


def test_of_a_rotation_near_zero_no_share_is_drawn_and_the_legend_says_so_above_the_curves():
    material = case()[2]
    trace = material.traces["direct_three"]
    small = dataclasses.replace(trace, theta_r=np.full(trace.theta_r.shape, np.radians(0.3)))
    traces = material.traces | {"direct_three": small}
    data = data_of("overview", dataclasses.replace(material, traces=traces))
    assert np.isnan(data["theta_r_percent"]).all()
    control = style.drawn(SPECS["fig00_overview"].draw, data, 6.0).axes[1]
    legend = control.get_legend()
    assert legend.get_texts()[1].get_text() == r"$\theta_r$ near 0"
    assert legend.get_window_extent().y0 >= control.get_window_extent().y1


def test_laws_that_follow_the_plan_stand_beside_the_same_that_plan_anew():
    material = case()[2]
    compared = ["stacked", "exact", "exact_track", "stacked_image_track"]
    assert material.compared() == compared
    assert title("stacked_image_track") == "stacked Jacobians, following planned images"
    assert title("my_laws:Law") == "my_laws:Law"
    data = data_of("modes_path", material)
    assert data["names"].tolist() == compared
    for name in compared:
        way, off = data[f"path_mm_{name}"].T
        assert (way[0], off[0]) == pytest.approx((0.0, 0.0), abs=1e-9)
        most = material.traces[name].center_deviation_at_samples_mm
        assert off.max() == pytest.approx(most, abs=1e-9)
    anew = {name: material.traces[name] for name in ("exact", "stacked")}
    reason = SPECS["fig15_modes_path"].lacking(dataclasses.replace(material, traces=anew))
    assert "set control.mode" in reason
