"""Single readings that are wrong: found, named and left out."""

import dataclasses

import numpy as np
import pytest

from projservo_cli.calibration import calibrate, findings, predict
from tests.calibration.simulated_robot import around, random_robot, trials
from tests.calibration.statistics import shifted_readings

ROBOT = random_robot("RRRRRR", np.random.default_rng(30))
VIEWS = {"left": (0,), "right": (1,), "both": (0, 1)}


def observed(poses, seed=1):
    return ROBOT.observe(poses, 0.5, np.random.default_rng(seed))


def error_of(calibration):
    q = around(ROBOT, 60, np.random.default_rng(9))
    return np.sqrt(2.0 * np.mean((predict(calibration, q) - ROBOT.images(q)) ** 2))


@pytest.mark.parametrize("poses", [trials(ROBOT), around(ROBOT, 50, np.random.default_rng(2))])
def test_gross_errors_are_listed_and_left_out(poses):
    observation = observed(poses)
    clean = error_of(calibrate(observation, "RRRRRR", source="recorded"))
    rng = np.random.default_rng(3)
    images, wrong = observation.images.copy(), set()
    for k, j in zip(*np.nonzero(rng.random((len(poses), 10)) < 0.05), strict=True):
        for view in VIEWS[rng.choice(["left", "right", "both"])]:
            images[k, view, j] += rng.uniform(10.0, 50.0, 2) * rng.choice([-1.0, 1.0], 2)
            wrong.add((int(observation.pose[k]), int(observation.marker[j]), view))
    calibration = calibrate(dataclasses.replace(observation, images=images), "RRRRRR", source="recorded")
    listed = {
        (o["pose"], o["marker"], view) for o in findings(calibration)["outliers"] for view in VIEWS[o["view"]]
    }
    assert wrong <= listed
    assert len(listed - wrong) <= 2
    assert error_of(calibration) < 1.5 * clean
    assert any("left out as outliers" in line for line in calibration.advice)


def test_exchanged_markers_are_named():
    observation = observed(around(ROBOT, 50, np.random.default_rng(2)))
    rng = np.random.default_rng(4)
    images, exchanged = observation.images.copy(), []
    for k in sorted(rng.choice(50, 8, replace=False)):
        a, b = sorted(rng.choice(10, 2, replace=False))
        images[k][:, [a, b]] = images[k][:, [b, a]]
        exchanged.append(
            {
                "pose": int(observation.pose[k]),
                "markers": [int(observation.marker[a]), int(observation.marker[b])],
            }
        )
    calibration = calibrate(dataclasses.replace(observation, images=images), "RRRRRR", source="recorded")
    found = findings(calibration)
    assert found["swapped"] == exchanged
    assert found["outliers"] == []
    assert any("another's number" in line for line in calibration.advice)


def test_wrong_joint_readings_are_named():
    observation = observed(around(ROBOT, 50, np.random.default_rng(2)))
    clean = error_of(calibrate(observation, "RRRRRR", source="recorded"))
    rng = np.random.default_rng(5)
    q, wrong = observation.q.copy(), []
    for k in sorted(rng.choice(50, 7, replace=False)):
        i = int(rng.integers(6))
        q[k, i] += rng.choice([-0.3, 0.3])
        wrong.append({"pose": int(observation.pose[k]), "joint": i + 1})
    calibration = calibrate(dataclasses.replace(observation, q=q), "RRRRRR", source="recorded")
    found = findings(calibration)
    assert found["suspect_joint_readings"] == wrong
    assert found["outliers"] == []
    assert found["merged_poses"] == 43
    assert error_of(calibration) < 1.5 * clean
    assert any("disagree with the images" in line for line in calibration.advice)


@pytest.mark.parametrize("lost", ["swept away", "seen once, wrongly"])
def test_a_marker_whose_readings_are_all_wrong_costs_that_marker_alone(lost):
    rng = np.random.default_rng(6)
    observation = observed(trials(ROBOT))
    images = observation.images.copy()
    column = 4
    if lost == "swept away":
        images[:, :, column] += rng.uniform(60, 200, (len(images), 2, 2))
    else:
        images[1:, :, column] = np.nan
        images[0, 0, column] += 150.0
    found = calibrate(dataclasses.replace(observation, images=images), "RRRRRR", source="recorded")
    assert found.usable, found.reason
    number = observation.marker[column]
    assert number not in found.marker
    assert len(found.marker) == len(found.M) == len(observation.marker) - 1
    seen = np.isfinite(images[:, :, column, 0])
    listed = found.outlier[found.outlier[:, 1] == number]
    assert len(listed) == seen.any(axis=1).sum()
    assert any(f"marker {number}" in text for text in found.advice)


@pytest.mark.volume
def test_shifted_readings_of_another_lab_are_listed(shared_data):
    found = [shifted_readings(seed) for seed in range(2)]
    assert max(each.median_px for each in found) <= 0.19
    _, gross, seen, sound, accused = np.sum(found, axis=0)
    assert gross > 130
    assert seen >= 0.97 * gross
    assert accused <= 0.01 * sound
