import dataclasses
import json

import numpy as np
import pytest
from matplotlib.container import BarContainer
from scipy.linalg import sqrtm

from projservo_cli.calibration import predict, prediction_variance
from projservo_cli.calibration.prediction import parameters_from
from projservo_cli.config import load_config, to_yaml
from projservo_cli.records import CrossValidation, Observation
from projservo_cli.report import style
from projservo_cli.report.report_data import Fit
from projservo_cli.robots.frame_recorder import FrameRecorder
from projservo_cli.steps import steps_for
from projservo_cli.store import Result, Run
from tests.configured import calibrate, report_on
from tests.fake_records import fake
from tests.known import configured
from tests.report.cases import SPECS, case

SPEC = SPECS["fig13_calibration"]
SHIFT_PX = np.array([[0.3, -0.4], [-0.1, 0.2]])  # of each view


@pytest.fixture(scope="module")
def fitted():
    """The paper's task, calibrated from its simulated trials."""
    return Fit(*reversed(calibrate.run(configured("paper"))[:2]))


def shifted(name="paper", size=1.0, **fields):
    """A calibration and images that are what it predicts, but for one shift in each view."""
    known = dataclasses.replace(case(name)[2].calibration, **fields)
    q = case(name)[2].observation.q
    images = predict(known, q) + size * SHIFT_PX[:, None]
    return Fit(known, Observation(np.arange(len(q)) + 100, known.marker, q, images))


def drawn(fit):
    return style.drawn(SPEC.draw, SPEC.data(fit), SPEC.height)


def bars(axes):
    return [bar for group in axes.containers if isinstance(group, BarContainer) for bar in group]


def test_residuals_are_seen_minus_predicted_where_they_were_seen():
    fit = shifted()
    data = SPEC.data(fit)
    for v, view in enumerate(("left", "right")):
        np.testing.assert_allclose(data[f"residual_{view}"], np.tile(SHIFT_PX[v], (490, 1)), atol=1e-9)
        np.testing.assert_array_equal(data[f"seen_{view}"], fit.observation.images[:, v].reshape(-1, 2))
        assert data[f"rejected_outlier_{view}"].shape == (0, 2)
    # rms over both views and coordinates: (0.09 + 0.16 + 0.01 + 0.04) / 4
    np.testing.assert_allclose(data["pose_residual_px"], np.sqrt(0.075), rtol=1e-9)
    assert set(data["pose_coordinates"]) == {40}


def test_markers_are_matched_by_number_and_unknown_ones_left_out():
    fit = shifted()
    order = [3, 1, 0, 2, 9, 8, 7, 6, 5, 4]
    images = np.concatenate([fit.observation.images[:, :, order], np.full((49, 2, 1, 2), 7.0)], axis=2)
    marker = np.append(fit.observation.marker[order], 77)
    other = Fit(fit.calibration, dataclasses.replace(fit.observation, marker=marker, images=images))
    expected = SPEC.data(fit) | dict.fromkeys(
        ("rejected_marker_left", "rejected_marker_right"), np.full((49, 2), 7.0)
    )
    for name, values in SPEC.data(other).items():
        np.testing.assert_array_equal(values, expected[name], err_msg=name)


def test_what_the_fit_rejected_is_drawn_apart_and_counts_nowhere():
    number = case()[2].calibration.marker
    fit = shifted(
        outlier=np.array([[100, number[0], 0], [101, number[1], 1], [102, number[2], 2]]),
        suspect=np.array([[103, 1]]),
        id_switches=np.array([[104, number[3], number[4]]]),
    )
    fit.observation.images[5, 0, 5] = np.nan  # not seen: neither used nor left out
    data = SPEC.data(fit)
    # left: one of its own, one of both, two exchanged, a pose of ten; likewise right
    for view in ("left", "right"):
        count = [len(data[f"rejected_{kind}_{view}"]) for kind in ("outlier", "id_switch", "pose", "marker")]
        assert count == [2, 2, 10, 0]
    assert [len(data[f"seen_{view}"]) for view in ("left", "right")] == [490 - 15, 490 - 14]
    images = fit.observation.images
    assert (data["rejected_outlier_left"] == images[0, 0, 0]).all(axis=1).any()
    assert not (data["rejected_outlier_right"] == images[0, 1, 0]).all(axis=1).any()
    assert len(data["pose_residual_px"]) == 48  # the pose in doubt has none
    np.testing.assert_array_equal(data["pose_coordinates"][:5], [38, 38, 36, 32, 38])


def test_held_out_errors_take_the_place_of_those_in_the_fit():
    fit = shifted()
    residual = np.full((49, 2, 10, 2), 3.0)
    residual[7] = residual[0, 1, 4] = np.nan
    sizes = {"pose": 49, "marker": 10}
    given = {"residual": residual, "predicted": np.where(np.isnan(residual), np.nan, 2.0)}
    held_out = dataclasses.replace(fit, held_out=fake(CrossValidation, sizes=sizes, **given))
    data = SPEC.data(held_out)
    np.testing.assert_allclose(data["pose_residual_px"], np.full(48, 3.0))
    np.testing.assert_allclose(data["pose_predicted_px"], np.full(48, 2.0))
    np.testing.assert_array_equal(data["pose_coordinates"], [38] + 47 * [40])
    axes = drawn(held_out).axes[3]
    assert axes.get_title() == "each pose, held out"
    model = axes.lines[0].get_xydata()
    np.testing.assert_array_equal(model[:, 0], model[:, 1])  # as predicted, so found
    # All that is drawn lies within the axes.
    assert axes.get_xlim()[0] < 2.0 < axes.get_xlim()[1]
    assert axes.get_ylim()[1] > 3.0
    axes = drawn(fit).axes[3]
    assert "not held out" in axes.get_title()
    predicted, left = axes.lines[0].get_data()  # a residual and the error of its prediction make up the noise
    np.testing.assert_allclose(predicted**2 + left**2, fit.calibration.sigma_px**2)


def test_information_is_the_inverse_of_the_covariance_without_its_null_space():
    calibration = case()[2].calibration
    m, s = len(calibration.M), len(calibration.sqrt_cov_shared)
    gauge = parameters_from(calibration).gauge()
    directions = np.random.default_rng(1).normal(size=(len(gauge), 6))
    basis = np.linalg.qr(np.hstack([gauge, directions]))[0][:, gauge.shape[1] :]
    factor = basis * np.sqrt([1e-6, 1e-3, 0.5, 2.0, 2.0, 4.0])
    factor += gauge[:, :6]  # which no image shows
    off = {"sqrt_cov_shared": factor[:s], "sqrt_cov_marker": factor[s:].reshape(m, 4, 6)}
    values = SPEC.data(shifted(**off, sqrt_cov_own=np.zeros((m, 4, 3))))["information"]
    # round-off of the largest eigenvalue over the smallest: 4 · 1e-16 · 200 / 1e-6
    np.testing.assert_allclose(values, [1e6, 1e3, 2.0, 0.5, 0.5, 0.25], rtol=1e-6)


@pytest.mark.parametrize("size", [1e-6, 0.05, 1.0, 8.0])
def test_arrows_are_magnified_by_a_round_factor_to_a_visible_length(size):
    fit = shifted(size=size)
    extent = np.ptp(fit.observation.images, axis=(0, 2)).max()
    factor = float(SPEC.data(fit)["factor"])
    length = factor * size * np.sqrt(0.15) / (0.04 * extent)  # rms of both coordinates
    assert 0.4 - 1e-6 <= length <= 1.0 + 1e-6  # the steps 1, 2, 5 are at most 2.5 apart
    assert round(factor / 10.0 ** np.floor(np.log10(factor) + 1e-9), 9) in (1.0, 2.0, 5.0)


def test_predicted_errors_add_up_to_the_free_parameters(fitted):
    data = SPEC.data(fitted)
    record = fitted.calibration
    free = data["residual"].size - record.dof
    assert len(data["information"]) == free == 69  # two cameras, six screws, ten markers, less the gauge
    # the trace of the projection onto what the parameters can explain is their number
    total = (data["pose_coordinates"] * data["pose_predicted_px"] ** 2).sum()
    assert total == pytest.approx(free * record.sigma_px**2, rel=1e-6)
    left = (data["pose_coordinates"] * data["pose_residual_px"] ** 2).sum()
    assert left == pytest.approx(record.chi2_per_dof * record.dof * record.sigma_px**2, rel=1e-6)
    variance = prediction_variance(record, fitted.observation.q)
    np.testing.assert_allclose(data["pose_predicted_px"] ** 2, variance.mean(axis=(1, 2, 3)), rtol=1e-9)


def test_the_histogram_holds_every_residual_beside_the_normal_density(fitted):
    axes = drawn(fitted).axes[2]
    area = sum(bar.get_width() * bar.get_height() for bar in bars(axes))
    assert area == pytest.approx(1.0, abs=1e-12)
    x, density = axes.lines[0].get_data()
    assert density.max() == pytest.approx(1.0 / (0.5 * np.sqrt(2.0 * np.pi)), rel=1e-9)
    # the range is four σ: all of the normal density but 6e-5
    assert np.trapezoid(density, x) == pytest.approx(1.0, abs=1e-4)


def test_excitation_is_in_degrees_and_metres_on_own_axes_and_weak_joints_are_hatched():
    fit = shifted("stanford", poorly_observable=np.array([False, True, True, False, False, False]))
    axes = drawn(fit).axes
    left, right = axes[4], axes[6]
    revolute = [i for i, letter in enumerate(fit.calibration.joint_types) if letter == "R"]
    heights = [bar.get_height() for bar in bars(left)]
    np.testing.assert_allclose(heights, np.degrees(np.ptp(fit.observation.q, axis=0)[revolute]))
    assert [bar.get_height() for bar in bars(right)] == [np.ptp(fit.observation.q[:, 2])]
    assert (left.get_ylabel(), right.get_ylabel()) == ("range (deg)", "range (m)")
    labels = [label.get_text() for label in left.get_xticklabels()]
    assert labels[1:4] == ["$q_{2}$", "$q_{3}$ (m)", "$q_{4}$"]
    assert [bool(bar.get_hatch()) for bar in bars(left)] == [False, True, False, False, False]
    assert [bool(bar.get_hatch()) for bar in bars(right)] == [True]


def test_a_method_without_covariance_says_so_in_both_panels():
    unknown = np.full_like(case()[2].calibration.sqrt_cov_shared, np.nan)
    axes = drawn(shifted(sqrt_cov_shared=unknown)).axes
    for panel in (axes[3], axes[5]):
        assert [text.get_text() for text in panel.texts] == ["the method has no covariance"]


def test_a_recorded_run_without_a_task_is_reported_on_with_its_calibration(tmp_path):
    table = tmp_path / "table.csv"
    table.write_text("pose,marker\n")
    config = load_config(None, [f"data.table={table}", "report.formats=[svg]"])
    material = case()[2]
    records = {"calibration": material.calibration, "observation": material.observation}
    run = Run(tmp_path / "run.h5", to_yaml(config), {"calibrate": Result("", "", {}, {}, records)})
    for names, with_plan in ((["report"], False), (["plan", "report"], True)):
        assert ("plan" in [step.stage for step in steps_for(config, run, names)]) == with_plan
    made = report_on(run, tmp_path)
    assert (made.figures, made.claims) == (("figures/fig13_calibration.svg",), ())
    assert (tmp_path / made.figures[0]).read_bytes().startswith(b"<?xml")
    assert [entry["what"] for entry in made.omitted] == [
        spec.name for spec in SPECS.values() if (spec.task or spec.metric) and not spec.frames
    ]
    assert all("task" in entry["reason"] or "no length" in entry["reason"] for entry in made.omitted)


def test_runs_of_a_robot_without_a_model_are_reported_on_with_their_frames_and_their_plan(tmp_path):
    """Runs that are up to date, of one law of two; the others are not asked for, and no robot is moved."""
    table = tmp_path / "table.csv"
    table.write_text("pose,marker\n")
    material = case()[2]
    trace = material.traces["direct_three"]
    film = FrameRecorder()
    for k in range(trace.steps + 1):
        film.show(k, np.ones((2, 3, 2)), np.full((2, 8, 16), 99, dtype=np.uint8))
    settings = {
        "task": {"start": {"joints": [0.0] * 6, "unit": "rad"}, "goal": {"roll_deg": 9.0}},
        "markers": {"numbers": [0, 1, 2, 3], "face": [0, 1, 2]},
        "control": {"laws": ["direct_three", "exact"]},
    }
    overrides = [f"{key}={json.dumps(value)}" for key, value in settings.items()]
    config = load_config(None, [f"data.table={table}", "report.formats=[svg]", *overrides])
    records = {"calibration": material.calibration, "observation": material.observation}
    blank = Run(tmp_path / "run.h5", to_yaml(config), {"calibrate": Result("", "", {}, {}, records)})
    keys = {step.name: step.key for step in steps_for(config, blank, ["servo"])}
    filmed = {"": dataclasses.replace(trace, **film.fields())}
    made = {
        "calibrate": records,
        "plan": {"": material.plan},
        "servo/direct_three": filmed,
        "servo/exact": filmed,
    }
    results = {name: Result(keys[name], "", {}, {}, one) for name, one in made.items()}
    results["servo/exact"] = dataclasses.replace(results["servo/exact"], key="of another configuration")
    run = dataclasses.replace(blank, results=results)
    steps = steps_for(config, run, ["report"])
    assert [step.name for step in steps if not step.why] == ["calibrate", "plan", "servo/direct_three"]
    assert [step.name for step in steps if step.why] == ["report"]
    run.results.pop("servo/exact")
    told = report_on(run, tmp_path)
    assert told.figures == ("figures/fig13_calibration.svg", "figures/fig17_frames.svg")
    assert {entry["reason"] for entry in told.omitted} == {
        "no model of robot and cameras is known that could be drawn: set robot, rig and markers",
        "no length on the tool is known: set markers.positions_m or markers.tag_size_m",
    }
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert f"directTHREE: {trace.verdict} after {trace.steps} steps" in page
    assert material.plan.reason.split(";")[0] in page


def test_with_joint_noise_residuals_are_drawn_as_they_are_tested():
    material = case()[2]
    calibration = dataclasses.replace(material.calibration, sigma_q=2e-3)
    data = SPECS["fig13_calibration"].data(dataclasses.replace(material, calibration=calibration))
    sigma, expected, h = calibration.sigma_px, [], 1e-6
    for q, seen in zip(material.observation.q, material.observation.images, strict=True):
        moved = [predict(calibration, np.stack([q + h * e, q - h * e])) for e in np.eye(6)]
        G = np.stack([(ahead - behind).ravel() for ahead, behind in moved], axis=1) / (2.0 * h) * 2e-3
        r = (seen - predict(calibration, q[None])[0]).ravel()
        expected.append(sigma * np.linalg.solve(sqrtm(sigma**2 * np.eye(len(r)) + G @ G.T), r))
    assert data["residual"] == pytest.approx(np.concatenate(expected), abs=1e-5)
    plain = SPECS["fig13_calibration"].data(material)
    assert (data["pose_predicted_px"] < plain["pose_predicted_px"]).all()
    assert np.isfinite(data["residual"]).all()
