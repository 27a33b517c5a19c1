"""The body in whole runs of the paper's task: how accurate, how steady, and against points."""

import math
from collections import Counter
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.configured import calibrate, plan, scenario_of, servo, under
from tests.known import driven
from tests.stages.cases import Case, case

STEPS, TAIL, GAIN = 200, 150, 0.1


@cache
def calibrated(name="paper"):
    """Case, calibration at 0.5 px and plan of a configuration."""
    example = case(name)
    calibration = calibrate.run(example.config)[1]
    return example, calibration, plan.run(example.config, calibration)


def bounds_at_goal(example, sigma):
    """Least rms errors of the centre, mm, and of the rotation, deg, of one look at the goal (Cramér–Rao)."""
    truth = example.truth
    M = truth.M[[*truth.face, *truth.pins]]
    M = M @ (example.scenario.true_ends.goal_pose @ np.linalg.inv(truth.robot.base_tool)).T

    def images(x):
        R = Rotation.from_rotvec(x[3:]).as_matrix()
        moved = np.c_[(M[:, :3] - example.goal_center) @ R.T + example.goal_center + x[:3], np.ones(len(M))]
        m = moved @ np.swapaxes(truth.P, 1, 2)
        return (m[..., :2] / m[..., 2:]).ravel()

    J = np.array([images(1e-6 * x) - images(-1e-6 * x) for x in np.eye(6)]).T / 2e-6
    variance = sigma**2 * np.diag(np.linalg.inv(J.T @ J))
    return 1e3 * math.sqrt(variance[:3].sum()), math.degrees(math.sqrt(variance[3:].sum()))


def steady(law, sigma, observation, runs):
    """Rms errors of centre, mm, and rotation, deg, over the last instants of noisy runs, and the verdicts."""
    example, calibration, planned = calibrated()
    scenario = scenario_of(example.config, calibration)
    assert scenario.exact.s_start.shape[1] == 10
    if observation == "points":
        scenario = replace(scenario, numbers=scenario.numbers[:4], exact=scenario.exact.by_points())
    sense = planned.rotation_sense()
    noise = example.config.noise.model_copy(update={"servo_px": sigma, "averaged_frames": 1})
    position, rotation, verdicts = [], [], Counter()
    for seed in range(runs):
        config = example.config.model_copy(update={"noise": noise, "seed": seed})
        limits = {"image_error_px": 1e-9, "max_steps": STEPS}
        trace = driven(under(scenario, config), sense, law, None, **limits)
        verdicts[trace.verdict] += 1
        assert trace.features == observation
        gap = 1e3 * np.linalg.norm(trace.center[TAIL:] - example.goal_center, axis=1)
        R = trace.pose[TAIL:, :3, :3]
        turned = np.swapaxes(R, 1, 2) @ example.scenario.true_ends.goal_pose[:3, :3]
        turn = np.degrees(Rotation.from_matrix(turned).magnitude())
        position.append(np.mean(gap**2))
        rotation.append(np.mean(np.square(turn)))
    return np.sqrt([np.mean(position), np.mean(rotation)]), verdicts


@pytest.mark.volume
@pytest.mark.parametrize("law", ["exact", "direct_two"])
def test_noise_in_the_loop_reaches_its_bound(law):
    """Each step corrects a share λ of the difference between two fits: B_target² + λ/(2−λ) B_current²."""
    bound = np.array(bounds_at_goal(calibrated()[0], 0.5)) * math.sqrt(1 + GAIN / (2 - GAIN))
    body, verdicts = steady(law, 0.5, "body", 100)
    points, _ = steady(law, 0.5, "points", 25)
    assert set(verdicts) <= {"max steps", "no progress"}
    assert (body <= 1.1 * bound).all()
    # Averaging 20 views instead of 8 is worth 1.6 in position; a body 0.3 m across instead of a face of
    # 0.08 m much more in rotation.
    assert points[0] > 1.5 * body[0]
    assert points[1] > 3 * body[1]


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
