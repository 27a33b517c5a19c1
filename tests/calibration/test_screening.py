"""Recordings with poses nobody saw, placeholders for unseen markers, and readings that pass a full turn."""

import dataclasses

import numpy as np
import pytest

from projservo_cli import Observations, calibrate
from projservo_cli.calibration import residual_statistics
from projservo_cli.records import Calibration, Observation, flat_fields
from projservo_cli.report.json_objects import findings
from tests.calibration.simulated_robot import around, random_robot, trials

ROBOT = random_robot("RRR", np.random.default_rng(1), markers=8)
Q = np.vstack([trials(ROBOT, 6), around(ROBOT, 8, np.random.default_rng(5))])
SEEN = ROBOT.observe(Q, 0.5, np.random.default_rng(2))
GAPS = np.random.default_rng(3).random(SEEN.images.shape[:3]) < 0.2
EMPTY = dataclasses.replace(SEEN, images=np.where(GAPS[..., None], np.nan, SEEN.images))


def calibrated(observation):
    return calibrate(Observations.of(observation, joint_types="RRR"), progress=False)


def numbers(calibration):
    """All arrays and numbers of a calibration that do not say what was screened."""
    of_screening = {"placeholders", "unseen_poses", "circular_joints"}
    apart = {"advice", "notes", "findings", "seconds"} | of_screening
    names = {field.name for field in flat_fields(Calibration)}
    return {name: getattr(calibration, name) for name in names - apart}


@pytest.fixture(scope="module")
def without():
    """Numbers of the calibration with empty cells."""
    return numbers(calibrated(EMPTY))


def filled(u, v):
    """Images with placeholders of one or both coordinates, None for a coordinate as good as any; in turns."""
    images = SEEN.images.copy()
    for c, value in enumerate((u, v)):
        if value is not None:
            images[GAPS, c] = np.resize(value, len(images))[np.nonzero(GAPS)[0]]
    return images


@pytest.mark.parametrize(
    ("u", "v", "words"),
    [
        (9999.0, 9999.0, "u = 9999, v = 9999"),
        (640.0, 480.0, "u = 640, v = 480"),
        (-999.0, None, "u = -999"),
        (None, 65535.0, "v = 65535"),
        ((9999.0, -1.0), (9999.0, -1e9), "u = 9999, v = 9999"),
        ((-999.0, 9999.0), None, "u = -999"),
    ],
)
def test_a_placeholder_counts_as_an_empty_cell(without, u, v, words):
    found = calibrated(dataclasses.replace(SEEN, images=filled(u, v)))
    np.testing.assert_equal(numbers(found), without)
    assert found.placeholders == findings(found)["rejected"]["placeholders"] == GAPS.sum()
    told = [one for one in found.findings if one.code == "placeholders"]
    assert words in [one.subject.name for one in told]
    assert (len(told), sum(one.amount for one in told)) == (np.size(u), GAPS.any(axis=1).sum())
    assert all(len(one.subject.markers) > 1 for one in told)


def test_poses_that_no_camera_saw_change_nothing_but_the_advice(without):
    q = np.insert(SEEN.q, [0, 9], [[9.0, -8.0, 7.0], [2.0, 2.0, -9.0]], axis=0)
    images = np.insert(EMPTY.images, [0, 9], np.nan, axis=0)
    pose = np.insert(SEEN.pose, [0, 9], [701, 702])
    found = calibrated(Observation(pose, SEEN.marker, q, images))
    np.testing.assert_equal(numbers(found), without)
    assert findings(found)["rejected"]["unseen_poses"] == [701, 702]
    told = {one.code: one.subject for one in found.findings}
    assert told["unseen_poses"].poses == (701, 702)


@pytest.mark.parametrize("low", [0.0, -90.0])
def test_readings_on_a_circle_are_cut_at_the_widest_gap(low):
    low = np.radians(low)
    shift = low + np.radians([8.0, 100.0, 200.0]) - SEEN.q.min(axis=0) - np.radians([20.0, 0.0, 0.0])
    plain = dataclasses.replace(SEEN, q=SEEN.q + shift)  # only joint 1 passes the end of the turn
    wrapped = dataclasses.replace(plain, q=low + np.mod(plain.q - low, 2.0 * np.pi))
    found, expected = calibrated(wrapped), calibrated(plain)
    assert found.circular_joints.tolist() == [1]
    turns = (found.joint_min - expected.joint_min) / (2.0 * np.pi)
    np.testing.assert_allclose(turns, np.rint(turns), atol=1e-9)
    for name in ("excitation", "predicted_rms_px", "prediction_noise", "sigma_px", "rms_px"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-6)
    told = {one.code: one.subject for one in found.findings}
    assert told["circular_readings"].joints == (1,)
    held = ROBOT.observe(around(ROBOT, 9, np.random.default_rng(6)), 0.0, np.random.default_rng(0))
    turned = np.mod(held.q + shift, 2.0 * np.pi)
    scores = [
        residual_statistics(one, dataclasses.replace(held, q=q))
        for one in (found, expected)
        for q in (held.q + shift, turned)
    ]
    assert max(score["rms_px"] for score in scores) == pytest.approx(scores[0]["rms_px"], rel=1e-6)
    assert scores[0]["rms_px"] < 1.0
