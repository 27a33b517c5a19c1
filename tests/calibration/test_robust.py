"""Single readings that are wrong: found, named and left out."""

import dataclasses

import numpy as np
import pytest

from projservo_cli.calibration import calibrate, predict
from projservo_cli.records import WorkFailed
from projservo_cli.report.report_data import findings
from tests.calibration.damage import listed, shifted
from tests.calibration.simulated_robot import around, random_robot, trials

ROBOT = random_robot("RRRRRR", np.random.default_rng(30))
SOME = around(ROBOT, 50, np.random.default_rng(2))
SIGMA = 0.5


def observed(poses):
    return ROBOT.observe(poses, SIGMA, np.random.default_rng(1))


def calibrated(observation):
    return calibrate(observation, "RRRRRR", source="recorded")


def error_of(calibration):
    q = around(ROBOT, 60, np.random.default_rng(9))
    return np.sqrt(2.0 * np.mean((predict(calibration, q) - ROBOT.images(q)) ** 2))


@pytest.mark.parametrize("poses", [trials(ROBOT), SOME])
def test_gross_errors_are_listed_and_left_out(poses):
    observation, wrong = shifted(observed(poses), 0.08, SIGMA)
    calibration = calibrated(observation)
    found = listed(calibration)[0]
    assert wrong <= found
    assert len(found - wrong) <= 4  # of the shifts some are hardly more than noise
    assert error_of(calibration) < 1.5 * error_of(calibrated(observed(poses)))
    assert any("rejected as outliers" in line for line in calibration.advice)
    views = {"left": (0,), "right": (1,), "both": (0, 1)}
    told = findings(calibration)["outliers"]
    assert {(o["pose"], o["marker"], v) for o in told for v in views[o["view"]]} == found


@pytest.mark.parametrize("lost", ["swept away", "seen once, wrongly"])
def test_a_marker_whose_readings_are_all_wrong_costs_that_marker_alone(lost):
    observation = observed(trials(ROBOT))
    images, column = observation.images.copy(), 4
    if lost == "swept away":
        images[:, :, column] += np.random.default_rng(6).uniform(60, 200, (len(images), 2, 2))
    else:
        images[1:, :, column] = np.nan
        images[0, 0, column] += 150.0
    found = calibrated(dataclasses.replace(observation, images=images))
    assert found.usable, found.reason
    number = observation.marker[column]
    assert number not in found.marker
    assert len(found.marker) == len(found.M) == len(observation.marker) - 1
    seen = np.isfinite(images[:, :, column, 0])
    assert (found.outlier[:, 1] == number).sum() == seen.any(axis=1).sum()
    assert any(f"marker {number}" in text for text in found.advice)


SIDE = np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]]) * 0.03
TAGS = [*range(8, 12), *range(4, 8), *range(4)]


@pytest.mark.parametrize(
    ("kinds", "length", "single"),
    [("RRPRRR", 0.02, True), ("PRRRRR", 0.05, True), ("RRRRP", 0.02, False), ("RRRRP", 0.05, True)],
)
def test_a_prismatic_joint_that_is_taken_for_revolute_is_named(kinds, length, single):
    """Its fit passes as usable otherwise, with an axis far away, three to eleven times the stated error."""
    robot = random_robot(kinds, np.random.default_rng(1))
    rng = np.random.default_rng(2)
    poses = trials(robot, length=length) if single else around(robot, 60, rng, length=length)
    observation = robot.observe(poses, 0.3, rng)
    with pytest.raises(WorkFailed, match=rf"joint {kinds.index('P') + 1} is prismatic, .*{kinds} would fit"):
        calibrate(observation, "R" * len(kinds), source="recorded", joint_noise=None)
    assert calibrate(observation, kinds, source="recorded", joint_noise=None).usable
