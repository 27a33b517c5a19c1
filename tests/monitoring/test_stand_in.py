"""The stand-in of the study of monitoring: its pixels, the errors of its corners, and what befalls it."""

import cv2
import numpy as np
import pytest
from scipy.linalg import expm

from projservo_cli.monitoring.image_monitor import detected_fault
from tests.monitoring.stand_in import (
    ARMS,
    CAMERAS,
    FOCAL,
    IMAGE,
    StandIn,
    camera_of,
    roof,
    seen,
    tool_pose,
)
from tests.studies.monitoring import (
    Rig,
    calibrated,
    driven,
    tasks,
)

HOME = {name: np.radians(arm.home) for name, arm in ARMS.items()}


def pixels(**fault):
    """What an arm without errors shows after a period, and its reading."""
    robot = StandIn(corners="exact", fault=fault or None)
    robot.command(robot.setpoint, 0.0 * robot.setpoint, 0.04)
    q, s = robot.read()[:2]
    return s, q


@pytest.mark.parametrize("name", ARMS)
def test_pixels_are_those_of_twists_and_of_opencv(name):
    arm, q, T = ARMS[name], HOME[name] + 0.3, np.eye(4)
    for letter, at, angle in zip(arm.axes, arm.at, q, strict=True):
        w, twist = np.eye(3)["xyz".index(letter)], np.zeros((4, 4))
        twist[:3, :3], twist[:3, 3] = np.cross(np.eye(3), w), np.cross(at, w)
        T = T @ expm(angle * twist)
    there = np.eye(4)
    there[:3] = [[0, 0, 1, arm.tip], [1, 0, 0, 0], [0, 1, 0, arm.at[-1][2]]]
    points = (roof().place[:, None] + roof().corners).reshape(-1, 3)
    base = (T @ there @ np.c_[points, np.ones(20)].T)[:3].T
    K = np.array([[FOCAL, 0, IMAGE[0] / 2 - 0.5], [0, FOCAL, IMAGE[1] / 2 - 0.5], [0, 0, 1]])
    for view, (place, target, _) in enumerate(CAMERAS):
        R, t = camera_of(view)
        expected = cv2.projectPoints(base, cv2.Rodrigues(R)[0], t, K, None)[0].reshape(-1, 4, 2)
        np.testing.assert_allclose(seen(tool_pose(arm, q), view).pixels, expected, atol=1e-6)
        np.testing.assert_allclose(R @ place + t, 0.0, atol=1e-12)
        assert np.allclose((R @ target + t)[:2], 0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("rig", "number", "level"),
    [
        (Rig("five", "jpeg", 0.0, 0.0), 140240, ("hand", 1)),
        (Rig("six", "none", 0.0, 0.0), 120259, ("blur",)),
    ],
    ids=["hand", "blur"],
)
def test_what_has_passed_is_no_fault(rig, number, level):
    # Windows show it all along; images since then agree, and no cause explains them better than none.
    (row,) = driven((rig, [("sound", number, level)]))
    assert row["verdict"] == "converged", row["reason"]


@pytest.mark.parametrize(
    ("bent", "shift", "named"),
    [((), 0.0, ""), ((1, 4), 0.0, ""), ((1, 4), 3.0, "left camera"), ((0, 1, 4), 0.0, "marker")],
)
def test_tags_that_are_bent_in_one_posture_are_no_fault_and_hide_no_camera(bent, shift, named):
    # Corners of a slanted tag that are off by up to 0.8 px, as a detector of sharp images has them.
    rig = Rig("five", "finder", 0.0, 0.0)
    goal = next(tasks(rig, np.random.default_rng(1)))[1]
    robot, size = StandIn(**rig.options(at_deg=goal, seed=2)), np.array(IMAGE, dtype=float)
    q, s = robot.read()[:2]
    for tag in bent:
        s[:, 4 * tag : 4 * tag + 4] += [[-0.15, 0.2], [-0.4, 0.1], [0.6, -0.5], [0.5, 0.15]]
    s[0] += shift
    fault = detected_fault(calibrated(rig), q, np.arange(20), s, size)
    assert named in fault if named else fault == ""
