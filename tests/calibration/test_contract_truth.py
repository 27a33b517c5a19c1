"""No truth enters a calibration: what is configured about robot, rig and markers may be garbage."""

from pathlib import Path

import numpy as np

from projservo_cli.config import load_config
from projservo_cli.records import flat_fields
from projservo_cli.stages import calibrate as calibrating
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


def test_a_simulated_run_with_garbage_for_truth_is_the_same(monkeypatch):
    observation, calibration, _ = stage.run(load_config(PAPER))
    config = load_config(PAPER, GARBAGE)
    wrong = truth_of(config)
    # The garbage is garbage: its images have nothing to do with those observed.
    images = wrong.images(observation.q[0], wrong.M)
    assert np.nanmedian(np.abs(images - observation.images[0])) > 100.0
    monkeypatch.setattr(calibrating, "observed", lambda *asked, progress: (observation, 0.5))
    other = stage.run(config)[1]
    for field in flat_fields(type(other)):
        if field.name != "seconds":
            values = getattr(other, field.name), getattr(calibration, field.name)
            np.testing.assert_array_equal(*values, err_msg=field.name)
