"""Tracks with mistakes of every kind: left out, told by kind, and as good as if they had never been seen."""

import numpy as np
import pytest

from projservo_cli.calibration import calibrate
from projservo_cli.report.material import findings
from tests.calibration.bound import errors_of_the_best
from tests.calibration.mistakes import KINDS, MISTAKES, table
from tests.calibration.mistakes_study import median_error, shares_left_out


def calibrated(mistaken):
    letters = mistaken.robot.joint_types
    return calibrate(mistaken.observation, letters, source="recorded", image_size=(1280, 1024))


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_fifth_of_the_sightings_may_be_wrong(mistake):
    mistaken = table(mistake, 4, 60, length=8)
    found = calibrated(mistaken)
    assert found.usable
    wrong, right = shares_left_out(mistaken, found)
    assert np.isnan(wrong) or wrong > 0.9  # NaN where whole tracks are wrong
    assert right < 0.02
    markers = np.intersect1d(found.marker, np.flatnonzero(mistaken.counted))
    best = np.median(errors_of_the_best(mistaken)[:, :, markers])
    assert median_error(mistaken, found, markers) < 1.15 * best


@pytest.mark.parametrize(("mistake", "why"), [("still", "still"), ("far", "still"), ("body", "other body")])
def test_tracks_of_something_else_are_told_with_the_reason(mistake, why):
    mistaken = table(mistake, 5, 60, length=8)
    told = findings(calibrated(mistaken))["left_out"]
    truth = np.flatnonzero((mistaken.kind == KINDS.index(mistake)).sum(axis=0) > 1)
    assert set(told["tracks"][why]) == set(truth.tolist())
    assert told["sightings"] <= 3
    assert told["poses"] == []


def test_one_joint_is_enough_for_a_turntable():
    mistaken = table("drift", 6, 100, 36, joint_types="turntable", share=0.08)
    found = calibrated(mistaken)
    assert found.usable
    assert found.joint_types == "R"
    wrong, right = shares_left_out(mistaken, found)
    assert wrong > 0.8
    assert right < 0.02


def test_poses_of_other_readings_are_told():
    mistaken = table("readings", 7, 60, 20, length=8, share=0.3)
    assert findings(calibrated(mistaken))["left_out"]["poses"] == mistaken.wrong_poses.tolist()
