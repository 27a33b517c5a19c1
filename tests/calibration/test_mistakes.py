"""Tracks with mistakes of every kind: left out, told by kind, and as good as if they had never been seen."""

import dataclasses
import functools

import numpy as np
import pytest

from projservo_cli.calibration import calibrate
from projservo_cli.records import WorkFailed
from projservo_cli.report.json_objects import findings
from tests.calibration.bound import errors_of_the_best
from tests.calibration.mistakes import KINDS, MISTAKES, median_error, shares_left_out, table
from tests.calibration.simulated_robot import random_robot, trials


@functools.cache
def calibrated(mistake):
    """A table of a few tracks with a mistake, and its calibration."""
    mistaken = table(mistake, 4, 60, length=8)
    letters, size = mistaken.robot.joint_types, (1280, 1024)
    return mistaken, calibrate(mistaken.observation, letters, source="recorded", image_size=size)


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_fifth_of_the_sightings_may_be_wrong(mistake):
    mistaken, found = calibrated(mistake)
    assert found.usable
    wrong, right = shares_left_out(mistaken, found)
    assert np.isnan(wrong) or wrong > 0.9  # NaN where whole tracks are wrong
    assert right < 0.02
    markers = np.intersect1d(found.marker, np.flatnonzero(mistaken.counted))
    best = np.median(errors_of_the_best(mistaken)[:, :, markers])
    assert median_error(mistaken, found, markers) < 1.15 * best


@pytest.mark.parametrize(("mistake", "why"), [("still", "still"), ("far", "still"), ("body", "other body")])
def test_tracks_of_something_else_are_told_with_the_reason(mistake, why):
    mistaken, found = calibrated(mistake)
    told = findings(found)["rejected"]
    truth = np.flatnonzero((mistaken.kind == KINDS.index(mistake)).sum(axis=0) > 1)
    assert set(told["tracks"][why]) == set(truth.tolist())
    assert told["observations"] <= 3
    assert told["poses"] == []


@pytest.mark.parametrize("lost", ["swept away", "seen once, wrongly"])
def test_a_marker_whose_readings_are_all_wrong_costs_that_marker_alone(lost):
    robot, column = random_robot("RRRRRR", np.random.default_rng(30)), 4
    observation = robot.observe(trials(robot), 0.5, np.random.default_rng(1))
    images, number = observation.images, observation.marker[column]
    if lost == "swept away":
        images[:, :, column] += np.random.default_rng(6).uniform(60, 200, (len(images), 2, 2))
    else:
        images[1:, :, column] = np.nan
        images[0, 0, column] += 150.0
    found = calibrate(observation, "RRRRRR", source="recorded")
    assert found.usable, found.reason
    assert number not in found.marker
    assert len(found.marker) == len(found.M) == len(observation.marker) - 1
    seen = np.isfinite(images[:, :, column, 0])
    assert (found.outlier[:, 1] == number).sum() == seen.any(axis=1).sum()
    assert any(f"marker {number}" in text for text in found.advice)


def test_sightings_left_out_that_agree_on_other_joints_are_told():
    """A third of the points of each pose is where the poses before show it, and all slip a little."""
    mistaken = table("right", 1, 30, 20, joint_types="RR", sigma=0.2, slip=0.25, length=30)
    images = mistaken.observation.images.copy()
    late = np.random.default_rng(0).random((20, 30)) < 0.3
    late[0] = False
    for k, j in np.argwhere(late):
        images[k, :, j] = mistaken.observation.images[k - 1, :, j]
    with pytest.raises(WorkFailed, match="show other joints than those read; check how poses and"):
        calibrate(dataclasses.replace(mistaken.observation, images=images), "RR", source="recorded")
