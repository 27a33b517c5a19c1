"""The body in whole runs of the paper's task."""

from functools import cache

import numpy as np
import pytest

from tests.configured import calibrate, plan, scenario_of, servo
from tests.stages.cases import Case, case


@cache
def calibrated(name="paper"):
    """Case, calibration at 0.5 px and plan of a configuration."""
    example = case(name)
    calibration = calibrate.run(example.config)[1]
    return example, calibration, plan.run(example.config, calibration)


def noisy(*overrides):
    example = Case("paper", ["noise.servo_px=0.5", "stop.max_steps=25", *overrides])
    _, calibration, _ = calibrated()
    return example, calibration, plan.run(example.config, calibration)


def test_the_body_is_the_default_but_for_the_laws_that_need_points():
    example, calibration, planned = noisy()
    body = servo.run(example.config, calibration, planned, "exact")
    assert body.features == "body"
    assert (body.views_used == 20).all()
    assert body.s.shape == (body.steps + 1, 2, 4, 2)
    # 26 fits of 34 degrees of freedom; the calibration's own noise adds a little.
    assert np.sqrt(np.mean(body.fit_px**2)) == pytest.approx(0.5, rel=0.15)
    assert np.sqrt(np.mean(body.prediction_px**2)) == pytest.approx(0.55, rel=0.2)
    stacked = servo.run(example.config, calibration, planned, "stacked")
    assert stacked.features == "points"
    assert np.isnan(stacked.fit_px).all()
    assert np.isnan(stacked.prediction_px).all()
    assert (body.s[0] == stacked.s[0]).all()  # the same noise for every law


def test_a_goal_known_by_images_of_the_face_is_reached_with_the_body():
    example, calibration, _ = calibrated()
    images = {view: example.ends.s_star[i].tolist() for i, view in enumerate(("left", "right"))}
    config = Case("paper", [f"task.goal={{images: {images}}}"]).config
    assert np.isnan(scenario_of(config, calibration).ends.s_star[:, 4:]).all()
    trace = servo.run(config, calibration, plan.run(config, calibration), "exact")
    assert trace.verdict == "converged"
    # In the loop the face alone is fitted too, so that the calibration's errors cancel at the goal.
    assert (trace.views_used == 8).all()
    gap = np.linalg.norm(trace.center[-1] - example.goal_center)
    assert gap < 1e-4
