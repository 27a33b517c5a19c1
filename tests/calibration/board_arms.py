"""Arms of parallel axes that carry a board before fixed cameras."""

from functools import reduce

import numpy as np
from scipy.spatial.transform import Rotation

from projservo_cli.geometry.displacements import rigid, rigid_inverse, screw_displacements
from projservo_cli.records import Observation, StatedBoard, prismatic_of

K = np.array([[905.0, 0.0, 652.0], [0.0, 903.0, 473.0], [0.0, 0.0, 1.0]])
SIZE = 1280, 960
PITCH = 0.02
BOARD = StatedBoard(0, 8, 6, PITCH)
SIGMA = 0.3


def _turn(x, y):
    """Screw (6,) of a vertical axis through a point of the ground, w and v."""
    return np.concatenate([[0.0, 0.0, 1.0], np.cross([x, y, 0.0], [0.0, 0.0, 1.0])])


def _slide(axis):
    """Screw (6,) of a translation."""
    return np.concatenate([np.zeros(3), axis])


X, Y, Z = np.eye(3)
# Types, screws, and half the range of each joint, rad or m.
ARMS = {
    "scara": ("RRPR", [_turn(0.0, 0.0), _turn(0.3, 0.0), _slide(Z), _turn(0.5, 0.0)], [0.6, 0.8, 0.08, 0.7]),
    "gantry": ("PPPR", [_slide(X), _slide(Y), _slide(Z), _turn(0.5, 0.0)], [0.15, 0.12, 0.08, 0.8]),
    "palletiser": ("RPPR", [_turn(0.0, 0.0), _slide(Z), _slide(X), _turn(0.5, 0.0)], [0.5, 0.08, 0.1, 0.8]),
}
# The board on the tool, tilted against the axes; at readings of zero in the base.
TOOL = rigid(Rotation.from_rotvec([0.5, 0.35, 0.2]), [0.55, 0.0, 0.2])

# Base frames of the arms by the rules of ``metric.frame``: z along joint 1, at the height of the board.
BASES = {
    name: rigid(Rotation.from_matrix(np.column_stack(axes)), origin)
    for name, axes, origin in (
        ("scara", (X, Y, Z), [0.0, 0.0, 0.2]),
        ("gantry", (Z, -Y, X), [0.5, 0.0, 0.2]),
        ("palletiser", (Y, -X, Z), [0.0, 0.0, 0.2]),
    )
}


def _looking(place, at):
    """Pose of a camera at a place that looks at a point, y down."""
    z = np.subtract(at, place) / np.linalg.norm(np.subtract(at, place))
    x = np.cross(z, [0.1, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return rigid(Rotation.from_matrix(np.column_stack([x, np.cross(z, x), z])), place)


CAMERAS = _looking([1.0, -0.6, 0.9], TOOL[:3, 3]), _looking([1.2, 0.4, 0.8], TOOL[:3, 3])


def corners():
    """Corners (48, 3) of the board, m."""
    x, y = np.meshgrid(np.arange(BOARD.columns), np.arange(BOARD.rows))
    return PITCH * np.c_[x.ravel() - 3.5, y.ravel() - 2.5, np.zeros(48)]


def recording(name, rng, count=30, sigma_px=SIGMA, views=1, turned=0.0):
    """Observation of an arm at random readings; the first camera turned by an angle, rad."""
    types, axes, half = ARMS[name]
    q = rng.uniform(-1.0, 1.0, (count, len(types))) * half
    T = reduce(np.matmul, screw_displacements(np.array(axes), prismatic_of(types), q).swapaxes(0, 1)) @ TOOL
    points = np.c_[corners(), np.ones(48)] @ T.swapaxes(1, 2)
    images = []
    turn = rigid(Rotation.from_rotvec([0.0, turned, 0.0]), np.zeros(3))
    for camera in (CAMERAS[0] @ turn, CAMERAS[1])[:views]:
        m = (points @ rigid_inverse(camera).T)[..., :3] @ K.T
        images.append(m[..., :2] / m[..., 2:] + sigma_px * rng.standard_normal((count, 48, 2)))
    names = ("top", "low")[:views]
    seen = np.stack(images, axis=1)
    within = (seen.min(axis=-1) >= 0.0) & (seen[..., 0] < SIZE[0]) & (seen[..., 1] < SIZE[1])
    seen[~within] = np.nan
    return types, Observation(np.arange(count), np.arange(48), q, seen, view=names)
