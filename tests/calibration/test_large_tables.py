"""Large tables: a fit is assessed by some of its markers, and what these show is of the whole."""

import dataclasses

import numpy as np
import pytest

from projservo_cli.calibration import calibrate, predict, robust_fit
from tests.calibration.simulated_robot import around, random_robot, trials

SIGMA, SHARE = 0.5, 0.02


@pytest.mark.parametrize("detections", [40_000, 1_500])
def test_a_gear_is_named_and_stated_by_few_of_the_markers_too(monkeypatch, detections):
    rng = np.random.default_rng(3)
    robot = random_robot("RRR", rng, markers=24)
    q = np.concatenate([trials(robot, frames=6), around(robot, 40, rng)])

    def true(read):
        """Joints where a gear turns the second by more than its readings."""
        return read + SHARE * (read - robot.q_reference) * np.eye(3)[1]

    monkeypatch.setattr(robust_fit, "_MAX_JUDGED_DETECTIONS", detections)
    seen = dataclasses.replace(robot.observe(true(q), SIGMA, rng), q=q)
    found = calibrate(seen, "RRR", source="recorded", joint_noise=0.0)
    (scale,) = (one for one in found.findings if one.code == "scale")
    assert scale.subject.joints == (2,)
    assert scale.amount == pytest.approx(SHARE, abs=5.0 * scale.deviation)
    assert len(found.model_error_bias) == found.P.size + found.H_hat_0.size + found.M.size
    ahead = around(robot, 100, rng)
    off = predict(found, ahead) - robot.images(true(ahead))
    assert np.sqrt(np.mean((off**2).sum(axis=-1))) < 2.0 * found.predicted_rms_px
