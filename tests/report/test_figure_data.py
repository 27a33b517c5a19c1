import numpy as np
import pytest

from projservo_cli.geometry.displacements import exp_rotation
from projservo_cli.geometry.kinematics import project
from projservo_cli.report.figure_inputs import along_line
from projservo_cli.report.figures.path_deviation import study_numbers
from projservo_cli.task.trajectory import trajectory_displacement
from tests.report.cases import GAINS, SPECS, case

# Images of exact data differ by round-off in the projective frame, px.
PX = 1e-7


def data_of(name, material):
    """Data of a figure, by the rest of its name."""
    return next(spec for key, spec in SPECS.items() if key[6:] == name).data(material)


def test_partition_leads_from_the_face_to_its_goal():
    material = case()[2]
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


def test_margins_begin_at_one_and_vanish_where_visibility_changes():
    material = case()[2]
    data, plan = data_of("visibility", material), material.plan
    np.testing.assert_allclose(data["theta_margin"][:, 0], 1.0, rtol=1e-12)
    for view, tau_margin in enumerate(data["tau_margin"].T):
        places = [0.0, data["tau_0_share"][view]]
        assert data["tau_share"][0] <= places[1] <= data["tau_share"][-1]
        found = np.interp(places, data["tau_share"], tau_margin)  # it is linear in τ
        assert found == pytest.approx([1.0, 0.0], abs=1e-9)
        for theta in np.radians(data["theta_0_deg"][view]):
            turned = exp_rotation(plan.H_hat[1], -theta).T @ plan.a @ plan.optical_center[view]
            assert turned / (plan.a @ plan.optical_center[view]) == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(*data["images"][:, -1], atol=PX)  # both senses end at the same face


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


def test_the_map_of_sight_is_the_margin_of_the_displaced_face():
    material = case()[2]
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
