"""No truth enters a calibration: what is configured about robot, rig and markers may be garbage."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from projservo_cli.calibration import predict
from projservo_cli.config import load_config
from projservo_cli.stages import calibrate as calibrating
from projservo_cli.store.tables import write_table
from tests.configured import calibrate as stage
from tests.configured import truth_of

PAPER = Path(__file__).parents[2] / "configs" / "paper.yaml"
# Another arm, another rig, another body; the same numbers of joints, types, pixels and markers.
GARBAGE = (
    "robot={name: nonsense, dh: {joints: ["
    + ", ".join(f"{{type: R, d_m: {0.1 * i}, a_m: {1.7 - 0.3 * i}, alpha_deg: {17 * i}}}" for i in range(6))
    + "]}}",
    "rig.left={focal_px: [7, 900], principal_point_px: [9, 9], position_m: [-5, 2, 9], target_m: [0, 0, 1]}",
    "rig.right={focal_px: [99, 99], principal_point_px: [0, 0], position_m: [0, 15, 0], target_m: [1, 1, 1]}",
    "markers.positions_m=[" + ", ".join(f"[{0.2 * i}, {i * i % 7 / 5}, {-0.2 * i}]" for i in range(10)) + "]",
    "task={start: {joints: [1, 2, 3, 4, 5, 6], unit: rad}, goal: {roll_deg: 90}}",
)


def arrays(calibration):
    """Everything a calibration says but the time it took."""
    return {
        field.name: getattr(calibration, field.name)
        for field in dataclasses.fields(calibration)
        if field.name != "seconds"
    }


def same(one, other):
    assert arrays(one).keys() == arrays(other).keys()
    for name, value in arrays(one).items():
        np.testing.assert_array_equal(value, arrays(other)[name], err_msg=name)


@pytest.fixture(scope="module")
def honest():
    """Observation and calibration of the simulated robot, every number of it true."""
    return stage.run(load_config(PAPER, ()))[:2]


@pytest.mark.parametrize(("method", "noise"), [("bundle_adjustment", 0.5), ("closed_form", 0.5)])
def test_a_simulated_run_with_garbage_for_truth_is_the_same(monkeypatch, method, noise):
    settings = (f"calibration.method={method}", f"noise.calibration_px={noise}")
    observation, calibration, _ = stage.run(load_config(PAPER, settings))
    config = load_config(PAPER, (*GARBAGE, *settings))
    wrong = truth_of(config)
    # The garbage is garbage: its images have nothing to do with those observed.
    images = wrong.images(observation.q[0], wrong.M)
    assert np.nanmedian(np.abs(images - observation.images[0])) > 100.0
    monkeypatch.setattr(calibrating, "observed", lambda *asked, progress: (observation, noise))
    same(stage.run(config)[1], calibration)


@pytest.fixture(scope="module")
def table(honest, tmp_path_factory):
    path = tmp_path_factory.mktemp("table") / "trials.csv"
    write_table(honest[0], path)
    return path


def test_a_recorded_run_needs_neither_robot_nor_rig(honest, table, tmp_path):
    bare = tmp_path / "bare.yaml"
    bare.write_text(f"name: bare\nseed: 5\ndata: {{table: {table}}}\n", encoding="utf-8")
    observation, calibration, _ = stage.run(load_config(bare, ()))
    np.testing.assert_array_equal(observation.images, honest[0].images)
    # Another seed, another guess of the image centre, σ estimated: the same optimum. The search ends
    # when a step moves the images by 1e-7 of the residual, 1e-7 · 0.5 px · √2000 over all images.
    assert np.abs(predict(calibration, observation.q) - predict(honest[1], observation.q)).max() <= 1e-6
    assert calibration.sigma_px != honest[1].sigma_px
