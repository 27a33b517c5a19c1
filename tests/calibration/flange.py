"""A board before a camera, and poses of the flange that carries one of them."""

import numpy as np
from scipy.spatial.transform import Rotation

from projservo_cli.geometry.displacements import rigid, rigid_inverse
from projservo_cli.records import WORLD
from projservo_cli.store.flange_poses import pose_columns
from projservo_cli.store.observation_tables import to_csv

K = np.array([[905.0, 0.0, 652.0], [0.0, 903.0, 473.0], [0.0, 0.0, 1.0]])
FACING = Rotation.from_rotvec([np.pi, 0.0, 0.0])
HAND = rigid(Rotation.from_rotvec([0.1, -0.05, 1.2]), [0.03, 0.05, 0.04])
# Cameras on the flange, and in the base; the board on the flange, and on the table.
HANDS = HAND, rigid(Rotation.from_rotvec([0.1, 0.1, 1.1]), [-0.05, 0.05, 0.04])
CAMERAS = (
    rigid(Rotation.from_rotvec([0.0, 0.0, 0.1]), [0.5, 0.0, -0.5]),
    rigid(Rotation.from_rotvec([0.1, 0.35, 0.0]), [0.15, 0.1, -0.45]),
)
BOARD_ON_FLANGE = rigid(Rotation.from_rotvec([0.0, np.pi, 0.3]), [0.02, 0.01, 0.0])
BOARD_ON_TABLE = rigid(Rotation.identity(), [0.5, 0.0, 0.0])
PITCH = 0.025
SIZE = 1280, 960


def poses(rng, count=25):
    """Poses of a flange that points down at a table, within reach of a camera above it."""
    turns = Rotation.from_rotvec(rng.uniform(-0.5, 0.5, (count, 3))) * FACING
    places = rng.uniform([0.4, -0.15, 0.35], [0.6, 0.1, 0.55], (count, 3))
    return np.array([rigid(R, t) for R, t in zip(turns, places, strict=True)])


def board():
    """Corners (48, 3) of a board of 8×6, m."""
    x, y = np.meshgrid(np.arange(8), np.arange(6))
    return PITCH * np.c_[x.ravel() - 3.5, y.ravel() - 2.5, np.zeros(48)]


def images(T, mount, rng, sigma_px, corners=None, views=1):
    """Pixels (K, V, 48, 2) of a board (48, 3), on the flange or on a table before cameras on the flange."""
    if mount == WORLD:
        base_of = T @ BOARD_ON_FLANGE
        to_cameras = [np.broadcast_to(rigid_inverse(camera), T.shape) for camera in CAMERAS[:views]]
    else:
        base_of = np.broadcast_to(BOARD_ON_TABLE, T.shape)
        to_cameras = [rigid_inverse(T @ hand) for hand in HANDS[:views]]
    X = np.c_[board() if corners is None else corners, np.ones(48)]
    m = np.stack([X @ (to_camera @ base_of).swapaxes(1, 2) for to_camera in to_cameras], axis=1)
    m = m[..., :3] @ K.T
    pixels = m[..., :2] / m[..., 2:]
    return pixels + sigma_px * rng.standard_normal(pixels.shape)


def write_recording(folder, mount, rng, names=("images", "poses"), count=25):
    """Write a list of detections and a table of poses, of 0.3 px."""
    T = poses(rng, count)
    seen = images(T, mount, rng, 0.3)[:, 0]
    pose, marker = np.divmod(np.arange(seen.shape[0] * seen.shape[1]), seen.shape[1])
    u, v = seen.reshape(-1, 2).T
    within = (np.minimum(u, v) >= 0.0) & (u < SIZE[0]) & (v < SIZE[1])
    found = {"pose": pose, "camera": np.full(len(u), "eye"), "marker": marker, "u": u, "v": v}
    (folder / f"{names[0]}.csv").write_text(to_csv({key: column[within] for key, column in found.items()}))
    (folder / f"{names[1]}.csv").write_text(to_csv({"pose": np.arange(count), **pose_columns(T)}))
