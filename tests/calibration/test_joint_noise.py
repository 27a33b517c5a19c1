"""Joint readings that err: how far, against truth and against least squares over everything at once."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from projservo_cli.calibration import calibrate, chi2_band, predict, prediction_variance
from tests.calibration.bound import derivative, images, parameters, spread
from tests.calibration.simulated_robot import around, random_robot, trials

UNIT = np.array([1.0, 0.3, 1.0, 1.0])  # rad and m
TYPES, SIGMA, SIGMA_Q = "RPRR", 0.2, 1e-3


def recorded(seed, markers=5):
    """Robot, true joints, and what was seen where joints are read with normal errors."""
    rng = np.random.default_rng([seed, 16])
    robot = random_robot(TYPES, rng, markers)
    q = np.concatenate([trials(robot, frames=5), around(robot, 10, rng)])
    q = q + 2e-3 * rng.uniform(-1.0, 1.0, q.shape)
    seen = robot.observe(q, SIGMA, rng)
    seen.q[:] += SIGMA_Q * UNIT * rng.standard_normal(q.shape)
    return robot, q, seen


def test_noise_of_joints_is_told_from_that_of_pixels_with_an_interval_that_holds():
    ratio, held, square = [], [], []
    for seed in range(12):
        robot, _q, seen = recorded(seed)
        # In every other case the noise of the pixels is known.
        known = {"sigma_px": SIGMA, "source": "simulated"} if seed % 2 else {"source": "recorded"}
        found = calibrate(seen, TYPES, joint_noise=None, **known)
        low, high = found.sigma_q_interval
        ratio.append(found.sigma_q / SIGMA_Q)
        held.append(low <= SIGMA_Q <= high)
        if seed % 2:
            assert np.diff([chi2_band(found.dof)[0], found.chi2_per_dof, chi2_band(found.dof)[1]]).min() > 0.0
        assert found.model_px == 0.0
        assert "joint readings off by" in found.reason
        ahead = around(robot, 40, np.random.default_rng(seed))
        error = predict(found, ahead) - robot.images(ahead)
        square.append(np.mean(error**2) / np.mean(prediction_variance(found, ahead)))
    assert np.median(ratio) == pytest.approx(1.0, abs=0.1)
    assert np.max(np.abs(np.log(ratio))) < np.log(1.6)
    assert sum(held) >= 10
    # A mean of some ten squares each, of normal errors in a few directions.
    assert np.mean(square) == pytest.approx(1.0, abs=0.35)


def test_the_fit_is_that_of_least_squares_over_robot_and_joints_at_once():
    """Beside a model of its own, with all true joints as parameters, and dense covariances."""
    robot, q, seen = recorded(3, markers=4)
    held, given = [], {"joint_noise": SIGMA_Q, "sigma_px": SIGMA, "source": "simulated"}
    found = calibrate(seen, TYPES, fitted=lambda s, _: held.append(s), **given)
    x, shape = parameters(robot), q.shape
    scale = np.concatenate([np.maximum(np.abs(x), 1e-2), np.full(q.size, 1e-3)])

    def residual(z):
        there, offset = (z[: len(x)] * scale[: len(x)]), z[len(x) :].reshape(shape) * 1e-3
        s = images(x + there, TYPES, 4, seen.q - robot.q_reference + offset)
        return np.concatenate([((s - seen.images) / SIGMA).ravel(), (offset / (SIGMA_Q * UNIT)).ravel()])

    brute = least_squares(residual, np.zeros(len(scale)), x_scale="jac", ftol=1e-12, xtol=1e-12)
    assert held[0].chi2 / SIGMA**2 == pytest.approx(2.0 * brute.cost, rel=1e-6)
    # The robot's part of the covariance of that problem, from derivatives of the other model at the truth.
    J, ahead = derivative(robot, q), around(robot, 6, np.random.default_rng(1))
    rows = J.reshape(len(q), -1, J.shape[1])
    step = 1e-6
    moved = [(robot.images(q + step * e) - robot.images(q - step * e)) / (2.0 * step) for e in np.eye(4)]
    by_joint = np.stack(moved, axis=-1).reshape(len(q), -1, 4)
    for k, G in enumerate(by_joint * (SIGMA_Q / SIGMA * UNIT)):
        rows[k] = np.linalg.solve(np.linalg.cholesky(np.eye(len(G)) + G @ G.T), rows[k])
    T = SIGMA * spread(rows.reshape(J.shape), derivative(robot, ahead))
    variance = prediction_variance(found, ahead)
    assert variance.ravel() == pytest.approx((T**2).sum(axis=1), rel=0.1)


def test_a_wrong_reading_is_found_among_small_errors_and_these_are_not_suspected():
    _robot, _q, seen = recorded(6)
    seen.q[20, 2] += 0.05
    found = calibrate(seen, TYPES, source="recorded", joint_noise=None)
    assert found.suspect.tolist() == [[seen.pose[20], 3]]
    assert found.sigma_q == pytest.approx(SIGMA_Q, rel=0.35)
