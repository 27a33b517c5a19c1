import dataclasses
import json

import numpy as np

from projservo_cli.calibration import predict
from projservo_cli.calibration.prediction import parameters_from
from projservo_cli.chain.outdated import steps_for
from projservo_cli.config import load_config, to_yaml
from projservo_cli.records import Observation, changed
from projservo_cli.report.figure_inputs import Fit
from projservo_cli.robots.frame_recorder import FrameRecorder
from projservo_cli.store.run_file import Result, Run
from tests.configured import report_on
from tests.report.cases import SPECS, case

SPEC = SPECS["fig13_calibration"]
SHIFT_PX = np.array([[0.3, -0.4], [-0.1, 0.2]])  # of each view


def shifted(**fields):
    """A calibration and images that are what it predicts, but for one shift in each view."""
    known = changed(case()[2].calibration, **fields)
    q = case()[2].observation.q
    images = predict(known, q) + SHIFT_PX[:, None]
    return Fit(known, Observation(np.arange(len(q)) + 100, known.marker, q, images))


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
        spec.name for spec in SPECS.values() if (spec.task or spec.metric) and not spec.optional
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
    filmed = {"": dataclasses.replace(trace, frames=film.recorded())}
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
        "no length on the tool is known: set markers.positions_m, markers.tag_size_m or markers.board.size_m",
    }
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert f"directTHREE: {trace.verdict} after {trace.steps} steps" in page
    assert material.plan.reason.split(";")[0] in page
