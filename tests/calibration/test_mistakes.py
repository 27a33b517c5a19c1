"""Tracks with mistakes of every kind: left out, told by kind, and as good as if they had never been seen."""

import dataclasses

import numpy as np
import pytest
from scipy.linalg import expm

from projservo_cli.calibration import calibrate
from projservo_cli.records import WorkFailed
from projservo_cli.report.report_data import findings
from tests.calibration.bound import errors_of_the_best
from tests.calibration.mistakes import KINDS, MISTAKES, table
from tests.studies.calibration_mistakes import median_error, shares_left_out


def calibrated(mistaken, **given):
    letters = mistaken.robot.joint_types
    return calibrate(mistaken.observation, letters, source="recorded", image_size=(1280, 1024), **given)


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
    told = findings(calibrated(mistaken))["rejected"]
    truth = np.flatnonzero((mistaken.kind == KINDS.index(mistake)).sum(axis=0) > 1)
    assert set(told["tracks"][why]) == set(truth.tolist())
    assert told["observations"] <= 3
    assert told["poses"] == []


def test_one_joint_is_enough_for_a_turntable():
    mistaken = table("drift", 6, 100, 36, joint_types="turntable", share=0.08)
    found = calibrated(mistaken)
    assert found.usable
    assert found.joint_types == "R"
    wrong, right = shares_left_out(mistaken, found)
    assert wrong > 0.8
    assert right < 0.02
    step = expm(found.H_hat_0[0] * np.radians(10.0))
    assert np.angle(np.linalg.eigvals(step)).max() == pytest.approx(np.radians(10.0), rel=1e-9)
    off, deviation = axis_missed(mistaken.robot, found)
    assert np.abs(off / deviation).max() < 3.0
    assert deviation.max() < 2.0  # of 0.5 px a reading


@pytest.mark.parametrize("said", [None, 1.0])
def test_the_noise_that_is_said_does_not_decide(said):
    """Points of a turntable that slip on it, all a little and a fifth of them away, in both views alike."""
    mistaken = table("drift", 1, 200, 36, joint_types="turntable", share=0.22, sigma=0.2, slip=0.15)
    found = calibrated(mistaken, sigma_px=said)
    assert found.usable
    assert "limited by outliers" in found.reason
    assert not any("joint" in text for text in found.advice)
    assert found.sigma_fitted_px == pytest.approx(0.25, rel=0.1)
    markers = np.intersect1d(found.marker, np.flatnonzero(mistaken.counted))
    assert median_error(mistaken, found, markers) < 0.6


def test_points_that_slip_with_wrong_joint_types_are_refused():
    mistaken = table("drift", 3, 30, 15, joint_types="RR", share=0.2, sigma=0.2, slip=0.15, length=8)
    with pytest.raises(WorkFailed, match="joint"):
        calibrate(mistaken.observation, "RP", source="recorded", sigma_px=1.0)


def test_sightings_left_out_that_agree_on_other_joints_are_told():
    """A third of the points of each pose is where the poses before show it, and all slip a little."""
    mistaken = table("right", 1, 40, 30, joint_types="RR", sigma=0.2, slip=0.25, length=30)
    images = mistaken.observation.images.copy()
    late = np.random.default_rng(0).random((30, 40)) < 0.3
    late[0] = False
    for k, j in np.argwhere(late):
        images[k, :, j] = mistaken.observation.images[k - 1, :, j]
    with pytest.raises(WorkFailed, match="show other joints than those read; check how poses and"):
        calibrate(dataclasses.replace(mistaken.observation, images=images), "RR", source="recorded")


def axis_missed(robot, calibration):
    """How far points of the true axis are from that of a calibration in images, and deviations (4,), px."""
    twist, n = robot.twists[0], calibration.P.size
    w = np.array([twist[2, 1], twist[0, 2], twist[1, 0]])
    place = -np.linalg.pinv(twist[:3, :3]) @ twist[:3, 3]
    ends = robot.cameras @ np.append([place - 0.1 * w, place + 0.1 * w], np.ones((2, 1)), axis=1).T
    ends /= ends[:, 2:]

    def missed(change):
        P, H_hat = (
            calibration.P + change[:n].reshape(2, 3, 4),
            calibration.H_hat_0[0] + change[n:].reshape(4, 4),
        )
        axis = P @ np.linalg.svd(H_hat)[2][2:].T
        lines = np.cross(axis[..., 0], axis[..., 1])
        # The sign of a null space is as it happens; both lines are steep.
        return (lines[:, None] @ ends)[:, 0].ravel() / np.repeat(
            np.sign(lines[:, 0]) * np.hypot(*lines.T[:2]), 2
        )

    # What one joint leaves open is enormous and moves no image: steps of unit length.
    roots = calibration.sqrt_cov_shared[: n + 16].T
    size = np.linalg.norm(roots, axis=1)
    steps = 1e-3 * roots / size[:, None]
    slopes = [(missed(step) - missed(-step)) / 2e-3 for step in steps]
    return missed(np.zeros(n + 16)), np.linalg.norm(slopes * size[:, None], axis=0)


def test_poses_of_other_readings_are_told():
    mistaken = table("readings", 7, 60, 20, length=8, share=0.3)
    assert findings(calibrated(mistaken))["rejected"]["poses"] == mistaken.wrong_poses.tolist()
