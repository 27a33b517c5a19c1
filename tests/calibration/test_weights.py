"""Detections with deviations of their own: the bound is reached, and residuals are what is stated."""

import dataclasses
import re

import numpy as np
import pytest

from projservo_cli.calibration import calibrate, cross_validate, predict, prediction_variance
from projservo_cli.calibration.detections import Detections
from projservo_cli.calibration.initial.epipolar import Epipolar
from projservo_cli.records import WorkFailed
from tests.calibration.bound import Bound
from tests.calibration.simulated_robot import around, random_robot, trials

SHARP, BLURRED, BLURRED_SHARE = 0.1, 2.0, 0.4


def stated(robot, q, seed):
    """What the robot shows at readings (K, n), and how well each marker was seen."""
    observation = robot.observe(q, 0.0, np.random.default_rng(0))
    rng = np.random.default_rng([7, seed])
    sigma = np.where(rng.random(observation.images.shape[:3]) < BLURRED_SHARE, BLURRED, SHARP)
    noise = sigma[..., None] * rng.standard_normal(observation.images.shape)
    return dataclasses.replace(observation, images=observation.images + noise, sigma=sigma)


@pytest.fixture(scope="module")
def draws():
    rng = np.random.default_rng(5)
    robot = random_robot("RPR", rng, markers=6)
    q, held_out = trials(robot, frames=5), around(robot, 40, rng)
    return robot, q, held_out, [stated(robot, q, seed) for seed in range(4)]


def test_the_bound_is_reached_and_chi2_is_one(draws):
    robot, q, held_out, seen = draws
    truth, ratios, chi2, held = robot.images(held_out), [], [], []

    def hold_out(solution, noise_px):
        held.append(cross_validate(solution, noise_px, 4, 0))

    for observation in seen:
        bound = Bound(robot, q, held_out, 1.0 / np.repeat(observation.sigma.ravel(), 2))
        found = calibrate(observation, robot.joint_types, fitted=hold_out)
        assert found.usable
        assert found.sigma_px == pytest.approx(np.median(observation.sigma))
        assert prediction_variance(found, held_out).mean() == pytest.approx(bound.mean_square(), rel=0.2)
        ratios.append(np.mean((predict(found, held_out) - truth) ** 2) / bound.mean_square())
        chi2.append(found.chi2_per_dof)
    # Four standard errors of the means; without weights both are beyond by factors.
    assert np.mean(ratios) == pytest.approx(1.0, abs=4.0 * bound.relative_error(len(seen)))
    assert np.mean(chi2) == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / (len(seen) * found.dof)))
    # Held out, markers err as their own deviations say, those that were seen well and the others.
    for sigma in (SHARP, BLURRED):
        each = np.concatenate(
            [(h.residual / h.predicted)[o.sigma == sigma].ravel() for h, o in zip(held, seen, strict=True)]
        )
        assert np.sqrt(np.nanmean(each**2)) == pytest.approx(1.0, abs=0.1)


def misstated(observation, factor):
    """The same, with deviations as many times as large."""
    return dataclasses.replace(observation, sigma=factor * observation.sigma)


@pytest.fixture(scope="module")
def plenty():
    rng = np.random.default_rng(6)
    robot = random_robot("RPR", rng, markers=12)
    q, held_out = around(robot, 40, rng), around(robot, 40, rng)
    return robot, held_out, stated(robot, q, 1), calibrate(stated(robot, q, 1), "RPR", source="recorded")


@pytest.mark.parametrize("factor", [0.3, 3.0])
def test_a_common_factor_of_stated_deviations_is_found_and_changes_no_verdict(plenty, factor):
    robot, held_out, observation, right = plenty
    found = calibrate(misstated(observation, factor), robot.joint_types, source="recorded")
    assert found.usable
    assert "of the markers state, times" in found.reason
    low, high = found.sigma_scale_interval
    assert low < 1.0 / factor < high < 1.5 * low
    assert low < found.sigma_scale < high
    assert found.sigma_px == pytest.approx(found.sigma_scale * factor * right.sigma_px)
    assert found.chi2_per_dof == pytest.approx(1.0, abs=0.2)
    np.testing.assert_allclose(predict(found, held_out), predict(right, held_out), atol=1e-5)


@pytest.mark.parametrize("factor", [0.1, 10.0])
def test_deviations_that_are_wrong_are_told_before_anything_is_accused(plenty, factor):
    robot, _, observation, _ = plenty
    told = r"stated deviations .* wrong: .* show ([\d.]+) times .*0.3 to 5 times allowed.* remove them"
    with pytest.raises(WorkFailed, match=told) as refused:
        calibrate(misstated(observation, factor), robot.joint_types, source="recorded")
    assert float(re.search(told, str(refused.value))[1]) == pytest.approx(1.0 / factor, rel=0.15)
    assert "joint" not in str(refused.value)


def test_deviations_that_a_rigid_body_refutes_are_told_by_one_camera(plenty):
    robot, _, observation, _ = plenty
    alone = dataclasses.replace(
        observation, images=observation.images[:, :1], sigma=10.0 * observation.sigma[:, :1], view=("eye",)
    )
    with pytest.raises(WorkFailed, match=r"stated deviations .* wrong: a rigid body shows 0\.(09|1)"):
        calibrate(alone, robot.joint_types, source="recorded")


def test_the_factor_is_right_where_a_third_of_the_sightings_are_wrong(plenty):
    robot, _, observation, _ = plenty
    scales = []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        # As many begin within the noise as are far off, in the left view.
        off = np.exp(rng.uniform(np.log(2.0), np.log(100.0), observation.sigma[:, 0].shape))
        off *= observation.sigma[:, 0] * (rng.random(off.shape) < 0.3)
        images = observation.images.copy()
        images[:, 0] += off[..., None] * rng.choice([-1.0, 1.0], (*off.shape, 2))
        readings = Detections.of(dataclasses.replace(observation, images=images), robot.joint_types)
        core = Epipolar.of(readings, rng).core
        scales.append(core.sigma_px / readings.stated_px)
        assert core.interval[0] < core.sigma_px < core.interval[1]
    assert np.mean(scales) == pytest.approx(1.0, abs=0.12)


def test_a_few_loose_detections_do_not_set_the_level_of_the_noise(draws):
    """Fifteen of 728 corners made 1.19 px of a noise of 0.05 px."""
    robot, q, _, _ = draws
    rng = np.random.default_rng(8)
    observation = robot.observe(q, 0.0, np.random.default_rng(0))
    sigma = np.where(rng.random(observation.images.shape[:3]) < 0.02, 10.0, 0.05)
    images = observation.images + sigma[..., None] * rng.standard_normal(observation.images.shape)
    found = calibrate(dataclasses.replace(observation, images=images, sigma=sigma), robot.joint_types)
    assert found.sigma_px == pytest.approx(0.05, rel=0.1)
    assert found.sigma_fitted_px == pytest.approx(found.sigma_px, rel=0.2)
