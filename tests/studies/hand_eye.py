"""What users know: hand–eye calibration by OpenCV, pose from points, inverse kinematics of the model.

All of it is given what projservo does without: the intrinsics of both cameras, the tool in metres and the
kinematics of the arm.
"""

import math
from typing import NamedTuple

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

WORLD = {"Shah": cv2.CALIB_ROBOT_WORLD_HAND_EYE_SHAH, "Li": cv2.CALIB_ROBOT_WORLD_HAND_EYE_LI}
HAND = {
    "Tsai": cv2.CALIB_HAND_EYE_TSAI,
    "Park": cv2.CALIB_HAND_EYE_PARK,
    "Horaud": cv2.CALIB_HAND_EYE_HORAUD,
    "Andreff": cv2.CALIB_HAND_EYE_ANDREFF,
    "Daniilidis": cv2.CALIB_HAND_EYE_DANIILIDIS,
}
LEAST_POINTS = 4
STARTS = 40  # of the inverse kinematics
EXACT = 1e-9  # m and rad: what it may leave


class View(NamedTuple):
    """A camera as hand–eye calibration knows it."""

    K: np.ndarray  # (3, 3) true intrinsics, px
    base: np.ndarray  # (4, 4) base frame in the frame of the camera
    method: str  # by which, the best on its images
    rms_px: float  # what that leaves of all images


def intrinsics(P):
    """Upper triangular K (3, 3) of a camera P (3, 4), K[2, 2] = 1, with positive focal lengths."""
    K = cv2.decomposeProjectionMatrix(P)[0]
    K = K / K[2, 2]
    return K @ np.diag(np.sign(np.diag(K)))


def seen_pose(K, points, pixels, near=None):
    """Pose (4, 4) of the tool in the frame of a camera from its points (m, 3), m, and pixels (m, 2).

    near : (4, 4) pose to begin with; None to look for one.
    """
    seen = np.isfinite(pixels).all(axis=1)
    if seen.sum() < LEAST_POINTS:
        return None
    if near is None:
        found, turn, t = cv2.solvePnP(points[seen], pixels[seen], K, None, flags=cv2.SOLVEPNP_SQPNP)
        if not found:
            return None
    else:
        turn, t = cv2.Rodrigues(near[:3, :3])[0], near[:3, 3:].copy()
    turn, t = cv2.solvePnPRefineLM(points[seen], pixels[seen], K, None, turn, t)
    return _pose(cv2.Rodrigues(turn)[0], t)


def _pose(R, t):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, np.ravel(t)
    return T


def calibrated(P, points, hands, images):
    """A camera (3, 4) of which only K is taken, from poses (k, 4, 4) of the hand and pixels (k, m, 2).

    How the tool sits on the hand is not known. Of all methods the one is taken that leaves the least of the
    images.
    """
    K = intrinsics(P)
    pairs = [(hand, seen_pose(K, points, pixels), pixels) for hand, pixels in zip(hands, images, strict=True)]
    pairs = [pair for pair in pairs if pair[1] is not None]
    hands, tools = np.array([pair[0] for pair in pairs]), np.array([pair[1] for pair in pairs])
    found = []
    for name, base in _each_method(hands, tools):
        mount = mean(
            [np.linalg.inv(hand) @ np.linalg.inv(base) @ T for hand, T in zip(hands, tools, strict=True)]
        )
        rms = _left_px(K, points, [base @ hand @ mount for hand in hands], [pair[2] for pair in pairs])
        found.append((rms, name, base))
    rms, name, base = min(found, key=lambda each: each[0])
    return View(K, base, name, rms)


def _each_method(hands, tools):
    """Name and pose (4, 4) of the base in the frame of the camera by every method.

    hands, tools : (k, 4, 4) poses of the hand in the base frame and of the tool in the frame of the camera.
    """
    bases, (R, t) = np.linalg.inv(hands), (tools[:, :3, :3], tools[:, :3, 3])
    for name, method in WORLD.items():
        # The camera stands still, the tool moves: tool and base take the parts of the world and the gripper.
        found = cv2.calibrateRobotWorldHandEye(R, t, hands[:, :3, :3], hands[:, :3, 3], method=method)
        yield name, _pose(*found[2:])
    for name, method in HAND.items():
        found = cv2.calibrateHandEye(bases[:, :3, :3], bases[:, :3, 3], R, t, method=method)
        yield name, np.linalg.inv(_pose(*found))


def mean(poses):
    """Mean of poses (k, 4, 4)."""
    poses = np.array(poses)
    return _pose(Rotation.from_matrix(poses[:, :3, :3]).mean().as_matrix(), poses[:, :3, 3].mean(axis=0))


def _left_px(K, points, tools, images):
    """Root mean square of what poses (k, 4, 4) of the tool leave of its pixels (k, m, 2), px."""
    left = []
    for tool, pixels in zip(tools, images, strict=True):
        s = (points @ tool[:3, :3].T + tool[:3, 3]) @ K.T
        left.append(s[:, :2] / s[:, 2:] - pixels)
    return float(np.sqrt(np.nanmean(np.square(left)) * 2.0))


def tool_in_base(views, points, images, near=None):
    """Pose (4, 4) of the tool in the base frame that pixels (2, m, 2) show, mean of the views that do.

    near : (4, 4) pose to begin with; None to look for one.
    """
    found = [
        (view, seen_pose(view.K, points, s, None if near is None else view.base @ near))
        for view, s in zip(views, images, strict=True)
    ]
    shown = [np.linalg.inv(view.base) @ T for view, T in found if T is not None]
    return mean(shown) if shown else None


def mount_of(views, points, hands, images):
    """Pose (4, 4) of the tool on the hand, mean over poses (k, 4, 4) of it and pixels (k, 2, m, 2)."""
    tools = [tool_in_base(views, points, s) for s in images]
    return mean([np.linalg.inv(hand) @ T for hand, T in zip(hands, tools, strict=True) if T is not None])


def joints_for(arm, hand, near):
    """Joints (n,) within the limits that put the hand at a pose (4, 4), nearest to some (n,).

    None where no start leads there.
    """
    rng, low, high = (
        np.random.default_rng(0),
        np.clip(arm.limits.lower, -math.pi, None),
        np.clip(arm.limits.upper, None, math.pi),
    )
    low, high = np.minimum(low, near - 1e-6), np.maximum(high, near + 1e-6)

    def off(q):
        pose = arm.pose(q)
        turn = Rotation.from_matrix(hand[:3, :3].T @ pose[:3, :3]).as_rotvec()
        return np.append(turn, pose[:3, 3] - hand[:3, 3])

    found = []
    for trial in range(STARTS):
        start = near if trial == 0 else rng.uniform(low, high)
        fit = least_squares(off, start, bounds=(low, high), xtol=1e-14, ftol=1e-14, gtol=1e-14)
        if np.abs(fit.fun).max() < EXACT:
            found.append(fit.x)
            if trial == 0:
                break
    return min(found, key=lambda q: np.abs(q - near).max()) if found else None
