"""χ², covariance and efficiency against a bound computed here, by complex steps through another model."""

import numpy as np
import pytest
from scipy.stats import chi2, kstest

from projservo_cli.calibration import calibrate, predict, prediction_variance
from projservo_cli.calibration.prediction import error_factor
from tests.calibration.bound import Bound
from tests.calibration.simulated_robot import around, random_robot, trials

SIGMA = 0.5


def expected_rank(robot):
    """Both cameras up to scale, screws, markers, minus the frame: a similarity, rigid if a joint slides."""
    revolute = robot.joint_types.count("R")
    sliding = len(robot.joint_types) - revolute
    return 22 + 4 * revolute + 2 * sliding + 3 * len(robot.markers) - (6 if sliding else 7)


def drawn(types, count):
    """Noise draws of a small set of trials: robot, noise-free bound, calibrations."""
    rng = np.random.default_rng(5)
    robot = random_robot(types, rng, markers=5)
    q, held_out = trials(robot, frames=4), around(robot, 40, rng)
    bound = Bound(robot, q, held_out)
    found = [
        calibrate(robot.observe(q, SIGMA, np.random.default_rng(seed)), robot.joint_types, sigma_px=SIGMA)
        for seed in range(count)
    ]
    return robot, held_out, bound, found


@pytest.fixture(scope="module")
def draws():
    return drawn("RPRP", 12)


@pytest.mark.parametrize("types", ["RRR", "RPRP"])
def test_degrees_of_freedom(draws, types):
    robot, _, bound, found = draws if types == "RPRP" else drawn(types, 1)
    assert bound.rank == expected_rank(robot)
    for calibration in found:
        assert calibration.outlier.size == 0  # a normal draw of 85 pairs has 5σ once in a thousand sets
        assert calibration.dof == bound.coordinates - bound.rank
        factor = error_factor(calibration)
        assert np.linalg.matrix_rank(factor @ factor.T, rtol=1e-11, hermitian=True) == bound.rank


def test_chi2_is_distributed_as_it_should(draws):
    _, _, _, found = draws
    dof = found[0].dof
    value = np.array([calibration.chi2_per_dof * calibration.dof for calibration in found])
    # The sum has twelve times the degrees of freedom; both bounds fail once in ten thousand sets of draws.
    assert 1e-4 < chi2.cdf(value.sum(), len(found) * dof) < 1.0 - 1e-4
    assert kstest(chi2.cdf(value, dof), "uniform").pvalue > 1e-4
    for calibration in found:
        assert calibration.sigma_fitted_px**2 == pytest.approx(calibration.chi2_per_dof * SIGMA**2)
        mean_square = calibration.chi2_per_dof * SIGMA**2 * dof / (dof + expected_rank(draws[0]))
        assert calibration.rms_px == pytest.approx(np.sqrt(2.0 * mean_square))  # two coordinates a view


def test_covariance_is_the_bound_and_the_errors_are_as_it_says(draws):
    robot, held_out, bound, found = draws
    truth = robot.images(held_out)
    square = np.array([np.mean((predict(c, held_out) - truth) ** 2) for c in found])
    stated = np.array([prediction_variance(c, held_out).mean() for c in found])
    limit = SIGMA**2 * bound.mean_square()
    # The variance is evaluated at the estimate instead of the truth: 1.3 % of scatter, 0.3 % of the mean.
    np.testing.assert_allclose(stated, limit, rtol=0.06)
    assert stated.mean() == pytest.approx(limit, rel=0.012)
    # Four standard errors of the mean over the draws, from the spectrum of the bound itself.
    assert square.mean() / limit == pytest.approx(1.0, abs=4.0 * bound.relative_error(len(found)))


def test_errors_are_expected_as_the_bound_says(draws):
    """The error of images within the ranges of the joints, and its 99th percentile."""
    robot, _, _, found = draws
    q = trials(robot, frames=4)
    ahead = np.random.default_rng(6).uniform(q.min(axis=0), q.max(axis=0), (200, q.shape[1]))
    bound = Bound(robot, q, ahead)
    square = np.array([2.0 * np.mean((predict(c, ahead) - robot.images(ahead)) ** 2) for c in found])
    stated, limit = np.array([(c.predicted_rms_px, c.predicted_p99_px) for c in found]).T
    # The statement is about 60 poses of the same ranges, here are others, and all count: within 15 %.
    np.testing.assert_allclose(stated, np.sqrt(2.0 * bound.mean_square()) * SIGMA, rtol=0.15)
    variances = 2.0 * np.linalg.svd(bound.factor, compute_uv=False) ** 2 / len(bound.factor)
    sums = np.random.default_rng(0).standard_normal((40000, len(variances))) ** 2 @ variances
    np.testing.assert_allclose(limit, SIGMA * np.sqrt(np.quantile(sums, 0.99)), rtol=0.15)
    spread = 4.0 * bound.relative_error(len(square))
    assert np.mean(square) / np.mean(stated**2) == pytest.approx(1.0, abs=spread + 0.2)
    # Two beyond the bound have a chance of one in a hundred, by the binomial distribution.
    assert int((np.sqrt(square) > limit).sum()) <= 1
