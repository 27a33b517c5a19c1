"""An independent robot, rig and marker body: matrix exponentials by scipy, nothing of the package."""

import json
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.linalg import expm

from projservo_cli.records import FloatArray, Observation
from tests.conftest import SHARED
from tests.samples import prismatic, revolute

IMAGE_SIZE = (1280, 1024)
NAMES = ("left", "right", "top", "low", "side")  # of the views
PLACES = ((-0.5, 0.0), (0.5, 0.0), (0.1, 1.3), (-0.2, -0.9), (1.4, 0.3))  # of the cameras, in baselines


@dataclass(frozen=True, eq=False)
class Robot:
    """Metric truth: twists (n, 4, 4) at q_reference, cameras (V, 3, 4), markers (m, 4) at the reference."""

    joint_types: str
    twists: FloatArray
    cameras: FloatArray
    markers: FloatArray
    q_reference: FloatArray

    def projected(self, q: FloatArray) -> FloatArray:
        """Homogeneous image points (K, V, 3, m) at joint readings (K, n), the third the depths in m."""
        result = np.empty((len(q), len(self.cameras), 3, len(self.markers)))
        for k, row in enumerate(q):
            T = np.eye(4)
            for twist, amount in zip(self.twists, row - self.q_reference, strict=True):
                T = T @ expm(twist * amount)
            result[k] = self.cameras @ T @ self.markers.T
        return result

    def images(self, q: FloatArray) -> FloatArray:
        """Noise-free pixels (K, V, m, 2) at joint readings (K, n)."""
        m = self.projected(q)
        return np.swapaxes(m[:, :, :2] / m[:, :, 2:], 2, 3)

    def observe(self, q: FloatArray, sigma: npt.ArrayLike, rng: np.random.Generator) -> Observation:
        """Observation with normal noise of each view; numbers of poses and markers have gaps on purpose."""
        images = self.images(q)
        images = images + np.reshape(sigma, (-1, 1, 1)) * rng.standard_normal(images.shape)
        m, view = len(self.markers), NAMES[: len(self.cameras)]
        return Observation(3 + 2 * np.arange(len(q)), 5 + 3 * np.arange(m), q.copy(), images, view=view)


def reference_ur5(cameras: int = 2) -> Robot:
    """The true UR5 of the reference data before so many of its cameras."""
    truth = json.loads((SHARED / "ur5" / "truth.json").read_text(encoding="utf-8"))
    twists = np.zeros((len(truth["screws"]), 4, 4))
    for twist, screw in zip(twists, truth["screws"], strict=True):
        twist[:3, :3], twist[:3, 3] = np.cross(np.eye(3), screw["w"]), screw["v"]
    places = np.c_[truth["markers_tool"], np.ones(len(truth["markers_tool"]))]
    P = np.array([truth["camera_left"], truth["camera_right"]])[:cameras]
    markers = places @ np.transpose(truth["T_base_tool_at_reference"])
    return Robot(truth["joint_types"], twists, P, markers, np.array(truth["q_reference"]))


def rig(baseline: float = 0.3, distance: float = 1.4, focal: float = 1200.0, views: int = 2) -> FloatArray:
    """Converging cameras that look at the origin from a distance, px per m; those beyond two from above."""
    cameras = []
    for side, above in PLACES[:views]:
        center = np.array([side * baseline, above * baseline, -distance])
        z = -center / np.linalg.norm(center)
        x = np.cross([0.0, 1.0, 0.0], z)
        x /= np.linalg.norm(x)
        R = np.stack([x, np.cross(z, x), z])
        K = np.array([[focal, 0.0, 640.0], [0.0, focal, 512.0], [0.0, 0.0, 1.0]])
        cameras.append(K @ np.hstack([R, (-R @ center)[:, None]]))
    return np.array(cameras)


def random_robot(joint_types: str, rng: np.random.Generator, markers: int = 10, views: int = 2) -> Robot:
    """Axes of any direction through points within 0.4 m of the body's centre; a body of 0.1 m."""
    twists = []
    for letter in joint_types:
        direction = rng.standard_normal(3)
        point = rng.uniform(-0.4, 0.4, 3)
        twists.append(prismatic(direction) if letter == "P" else revolute(point, direction))
    body = rng.uniform(-0.1, 0.1, (markers, 3))
    q = rng.uniform(-1.0, 1.0, len(joint_types))
    return Robot(joint_types, np.array(twists), rig(views=views), np.hstack([body, np.ones((markers, 1))]), q)


def trials(
    robot: Robot, frames: int = 8, angle: float = np.radians(30.0), length: float = 0.15
) -> FloatArray:
    """The reference and single-joint trial motions, (1 + n frames, n)."""
    rows = [robot.q_reference]
    for i, letter in enumerate(robot.joint_types):
        reach = length if letter == "P" else angle
        for offset in np.linspace(-reach, reach, frames):
            rows.append(robot.q_reference + offset * np.eye(len(robot.joint_types))[i])
    return np.array(rows)


def around(
    robot: Robot, count: int, rng: np.random.Generator, angle: float = 0.5, length: float = 0.15
) -> FloatArray:
    """Random poses about the reference, all joints at once, (count, n)."""
    reach = np.array([length if letter == "P" else angle for letter in robot.joint_types])
    return robot.q_reference + rng.uniform(-1.0, 1.0, (count, len(reach))) * reach
