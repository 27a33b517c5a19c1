"""Readings with deviations of their own: the bound is reached, and residuals are what is stated."""

import dataclasses

import numpy as np
import pytest

from projservo_cli.calibration import calibrate, cross_validate, predict, prediction_variance
from projservo_cli.records import InputError
from projservo_cli.tables import read_table, write_table
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
    return robot, q, held_out, [stated(robot, q, seed) for seed in range(10)]


def test_the_bound_is_reached_and_chi2_is_one(draws):
    robot, q, held_out, seen = draws
    truth, ratios, chi2, held = robot.images(held_out), [], [], []

    def hold_out(solution, noise_px):
        held.append(cross_validate(solution, noise_px, 4, 0))

    for observation in seen:
        bound = Bound(robot, q, held_out, 1.0 / np.repeat(observation.sigma.ravel(), 2))
        found = calibrate(observation, robot.joint_types, fitted=hold_out)
        assert found.usable
        assert found.sigma_px == pytest.approx(np.sqrt(np.mean(observation.sigma**2)))
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


def test_a_reading_far_off_by_its_own_deviation_is_an_outlier(draws):
    robot, _, _, seen = draws
    observation = seen[0]
    images, (k, v, j) = observation.images.copy(), np.argwhere(observation.sigma == SHARP)[40]
    images[k, v, j] += 1.5  # half of what the blurred ones are off
    found = calibrate(dataclasses.replace(observation, images=images), robot.joint_types)
    assert found.outlier.tolist() == [[observation.pose[k], observation.marker[j], v]]


def test_one_deviation_for_all_changes_nothing(draws):
    robot, q, _, _ = draws
    plain = robot.observe(q, 0.5, np.random.default_rng(3))
    alike = dataclasses.replace(plain, sigma=np.full(plain.images.shape[:3], 0.5))
    known, told = (calibrate(o, robot.joint_types, sigma_px=0.5) for o in (plain, alike))
    for field in dataclasses.fields(known):
        if field.name != "seconds":
            np.testing.assert_array_equal(getattr(known, field.name), getattr(told, field.name))


def test_tables_keep_deviations_to_the_bit_and_refuse_what_is_none(draws, tmp_path):
    observation, path = draws[3][0], tmp_path / "table.csv"
    images = observation.images.copy()
    images[2, 1, 3] = np.nan
    write_table(dataclasses.replace(observation, images=images), path)
    found = read_table(path)
    np.testing.assert_array_equal(found.sigma, np.where(np.isnan(images[..., 0]), np.nan, observation.sigma))
    text = path.read_text(encoding="utf-8")
    for wrong, message in (
        (text.replace("sigma_right", "other"), r":1: give the columns sigma_left and sigma_right both"),
        (text.replace(",0.1,", ",-0.1,", 1), "sigma_left is '-0.1'; expected a positive number, px"),
        (text.replace(",0.1,", ",,", 1), "sigma_left is ''; expected a finite number"),
    ):
        path.write_text(wrong, encoding="utf-8")
        with pytest.raises(InputError, match=message):
            read_table(path)
