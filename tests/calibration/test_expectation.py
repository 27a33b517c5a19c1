"""The error of predicted images that a calibration states, against the Cramér–Rao bound and true errors."""

import numpy as np
import pytest

from projservo_cli.calibration import calibrate, predict
from tests.calibration.bound import Bound
from tests.calibration.simulated_robot import random_robot, trials

SIGMA = 0.5


def test_errors_over_draws_of_the_noise_are_as_stated():
    types = "RPR"
    rng = np.random.default_rng(5)
    robot = random_robot(types, rng, markers=5)
    q = trials(robot, frames=4)
    held_out = rng.uniform(q.min(axis=0), q.max(axis=0), (200, len(types)))
    bound = Bound(robot, q, held_out)
    square, stated, limit = [], [], []
    for seed in range(10):
        observation = robot.observe(q, SIGMA, np.random.default_rng(seed))
        found = calibrate(observation, types, sigma_px=SIGMA)
        square.append(2.0 * np.mean((predict(found, held_out) - robot.images(held_out)) ** 2))
        stated.append(found.predicted_rms_px)
        limit.append(found.predicted_p99_px)
    # The statement is about 60 poses of the same ranges, here are others, and all count: within a tenth.
    expected = np.sqrt(2.0 * bound.mean_square()) * SIGMA
    np.testing.assert_allclose(stated, expected, rtol=0.1)
    variances = 2.0 * np.linalg.svd(bound.factor, compute_uv=False) ** 2 / len(bound.factor)
    draws = np.random.default_rng(0).standard_normal((40000, len(variances))) ** 2 @ variances
    np.testing.assert_allclose(limit, SIGMA * np.sqrt(np.quantile(draws, 0.99)), rtol=0.1)
    spread = 4.0 * bound.relative_error(len(square))
    assert np.mean(square) / np.mean(np.square(stated)) == pytest.approx(1.0, abs=spread + 0.2)
    # Two beyond the bound have a chance of one in a hundred, by the binomial distribution.
    assert int((np.sqrt(square) > limit).sum()) <= 1
    assert (np.array(limit) > stated).all()
