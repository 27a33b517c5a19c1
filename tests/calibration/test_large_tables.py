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


@pytest.mark.parametrize(
    ("types", "views", "lens"), [("RRPR", 2, False), ("RRR", 3, False), ("RRR", 2, True)]
)
def test_a_search_with_some_of_the_markers_ends_where_that_with_all_does(monkeypatch, types, views, lens):
    """With wrong detections and markers that single views see; to a hundredth of the noise."""
    rng = np.random.default_rng(views)
    robot = random_robot(types, rng, markers=40, views=views)
    q = np.concatenate([trials(robot, frames=6), around(robot, 30, rng)])
    seen = robot.observe(q, SIGMA, rng)
    images = np.where(rng.random(seen.images.shape[:3])[..., None] < 0.1, np.nan, seen.images)
    images[rng.random(images.shape[:3]) < 0.01] += 40.0
    seen = dataclasses.replace(seen, images=images, view=tuple("abcd"[:views]) if views > 2 else seen.view)
    found = []
    for detections in (40_000, 1_000):
        monkeypatch.setattr(robust_fit, "_MAX_JUDGED_DETECTIONS", detections)
        found.append(calibrate(seen, types, source="recorded", joint_noise=0.0, lens=lens))
    whole, few = (predict(one, around(robot, 50, np.random.default_rng(0))) for one in found)
    np.testing.assert_allclose(few, whole, atol=0.01 * SIGMA)
    np.testing.assert_array_equal(found[0].outlier, found[1].outlier)
