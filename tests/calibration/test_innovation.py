"""The test of images in the loop: its distribution, its false alarms, what it finds and whom it blames."""

import dataclasses

import numpy as np
import pytest
from scipy.stats import chi2, kstest

from projservo_cli.calibration import WINDOW, Innovation, calibrate, innovation
from projservo_cli.calibration.prediction import prediction_derivative
from tests.calibration.simulated_robot import random_robot, trials

SIGMA = 0.5
ALL = slice(None)


@pytest.fixture(scope="module")
def arm():
    """A robot, and its calibration from noisy trials."""
    robot = random_robot("RRRRRR", np.random.default_rng(3))
    observation = robot.observe(trials(robot), SIGMA, np.random.default_rng(4))
    return robot, calibrate(observation, "RRRRRR", source="recorded", sigma_px=SIGMA)


def walk(robot, steps, rng):
    """Joints along a smooth way around the reference, and true pixels with noise there."""
    phase = rng.uniform(0.0, 2.0 * np.pi, 6)
    q = robot.q_reference + 0.4 * np.sin(np.linspace(0.0, 2.0, steps)[:, None] + phase) - 0.4 * np.sin(phase)
    s = robot.images(q)
    return q, s + SIGMA * rng.standard_normal(s.shape)


def look(test, q, s):
    """One look of an arm at rest."""
    return test.disturbed(np.stack([q, q]), np.zeros(6), np.zeros(2), s, np.ones(2, dtype=bool))


def first_alarm(test, q, s):
    for k in range(len(q)):
        said = look(test, q[k], s[k])
        if said:
            return k, said
    return None, ""


def test_each_innovation_has_the_distribution_it_is_tested_by(arm, monkeypatch):
    """χ² of every part and instant, for errors of the calibration drawn from its covariance."""
    robot, calibration = arm
    m, shares = len(calibration.marker), []
    monkeypatch.setattr(innovation, "predict", lambda calibration, q: np.zeros((2, 2, m, 2)))
    q = walk(robot, 12, np.random.default_rng(1))[0]
    left = np.outer([True, False], np.ones(m, dtype=bool))
    for seed in range(30):
        rng = np.random.default_rng(seed)
        test = Innovation(calibration, SIGMA, 100)
        error = rng.standard_normal(len(test._mean))
        for row in q:
            J = prediction_derivative(calibration, row[None])[0] @ test._factor
            r = J @ error + SIGMA * rng.standard_normal((2, m, 2))
            values, _, S = test._seen(r - J @ test._mean, J, left)
            shares.append(chi2.cdf(values @ np.linalg.solve(S, values), values.size))
            assert look(test, row, r) == ""
    # The innovations of a Kalman filter are independent, so all 360 shares are uniform.
    assert kstest(shares, "uniform").pvalue > 1e-3


@pytest.mark.parametrize("slips", [False, True])
def test_undisturbed_runs_with_slips_and_unseen_markers_are_never_called_disturbed(arm, slips):
    robot, calibration = arm
    for seed in range(5):
        q, s = walk(robot, 60, np.random.default_rng(100 + seed))
        if slips:
            s[10::5] += 40.0
            s[3::7] = np.nan
            s[4::7, 1] = np.nan
        assert first_alarm(Innovation(calibration, SIGMA, 2000), q, s) == (None, "")


@pytest.mark.parametrize(
    ("where", "shift", "blamed"),
    [
        ((0, ALL), (2.0, -1.5), "those of the left camera alone: it was moved; recalibrate"),
        ((1, ALL), (-2.0, 2.0), "those of the right camera alone"),
        ((ALL, 4), (5.0, 3.0), "marker {4} was moved on the tool"),
        ((ALL, ALL), (6.0, 4.0), "in both cameras alike"),
    ],
)
def test_what_moved_is_found_within_few_observations_and_named(arm, where, shift, blamed):
    robot, calibration = arm
    q, s = walk(robot, 60, np.random.default_rng(7))
    s[(slice(30, None), *where)] += shift
    k, said = first_alarm(Innovation(calibration, SIGMA, 2000), q, s)
    assert 30 + WINDOW - 1 <= k <= 30 + WINDOW + 2
    assert blamed.replace("{4}", str(calibration.marker[4])) in said


def test_the_verdict_does_not_depend_on_the_unit_of_pixels(arm):
    """A fixed least noise would hide a bump in images measured in other units than pixels."""
    robot, calibration = arm
    q, s = walk(robot, 50, np.random.default_rng(7))
    s[30:, 0] += (2.0, -1.5)
    unit = 1e-3
    observation = robot.observe(trials(robot), SIGMA, np.random.default_rng(4))
    small = calibrate(
        dataclasses.replace(observation, images=unit * observation.images),
        "RRRRRR",
        source="recorded",
        sigma_px=unit * SIGMA,
    )
    k, said = first_alarm(Innovation(calibration, SIGMA, 2000), q, s)
    other, same = first_alarm(Innovation(small, unit * SIGMA, 2000), q, unit * s)
    assert k == other
    assert "left camera" in said
    assert "left camera" in same


def test_a_bump_is_found_that_the_calibration_alone_would_hide(arm):
    """Far from the reference predictions are off by more than the noise; what was learned is not."""
    robot, calibration = arm
    q = robot.q_reference + np.linspace(0.0, 1.2, 80)[:, None] * [1.0, -1.0, 1.0, -1.0, 1.0, 1.0]
    rng = np.random.default_rng(2)
    s = robot.images(q) + SIGMA * rng.standard_normal((80, 2, len(calibration.marker), 2))
    s[60:, 0] += (1.5, 1.5)
    k, said = first_alarm(Innovation(calibration, SIGMA, 2000), q, s)
    assert 62 <= k <= 70
    assert "left camera" in said
