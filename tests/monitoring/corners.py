"""Errors of the corners of tags as finders make them, by a table that ``tests.studies.corners`` measures.

An error has a lasting part, which is the same while the view is, and a part that is fresh in each frame. The
lasting part is told by first harmonics in the phases of the corner; what these leave is told by its size.
"""

import itertools
from pathlib import Path

import numpy as np

TABLE = Path(__file__).with_name("corners.npz")
FINDERS = ("finder", "subpix", "jpeg")
SEED = 29
SIDES = np.array([25.0, 45.0, 90.0])  # px
TILTS = np.radians([0.0, 30.0, 50.0, 65.0])
AZIMUTHS, ROLLS = 8, 12  # evenly around
FOCAL, SIZE = 760.0, 0.035  # px, m
# Columns of the table: lasting (5 for u, 5 for v), rms of what those leave, stated and fresh deviation, px,
# and the share of images in which the tag is found.
LASTING, LEFT, STATED, FRESH, FOUND = slice(0, 10), 10, 11, 12, 13
FLIP = np.diag([1.0, -1.0, -1.0])  # from x right, y up, z to the camera to the axes of a camera
CORNERS = 0.5 * np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])


def onto_z(a):
    """Least rotations (..., 3, 3) that turn unit vectors (..., 3) onto the z axis."""
    cross = np.zeros((*a.shape[:-1], 3, 3))
    cross[..., 0, 2], cross[..., 1, 2] = -a[..., 0], -a[..., 1]
    cross -= cross.swapaxes(-1, -2)
    return np.eye(3) + cross + cross @ cross / (1.0 + a[..., 2])[..., None, None]


def about_z(angle):
    """The rotation (3, 3) about the z axis."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def pose_of(side, tilt, azimuth, roll):
    """Rotation (3, 3) and place (3,), m, before a camera of a tag that is seen so."""
    there = np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), np.cos(tilt)])
    return FLIP @ about_z(roll) @ onto_z(there), np.array([0.0, 0.0, FOCAL * SIZE / side])


def view_of(R, t):
    """Tilt, azimuth and roll (...,), rad, of tags at rotations (..., 3, 3) and places (..., 3)."""
    Q = FLIP @ onto_z(t / np.linalg.norm(t, axis=-1, keepdims=True)) @ R
    there = Q[..., 2, :]
    turned = Q @ onto_z(there).swapaxes(-1, -2)
    tilt = np.arccos(np.clip(there[..., 2], -1.0, 1.0))
    azimuth = np.arctan2(there[..., 1], there[..., 0])
    return tilt, azimuth, np.arctan2(turned[..., 1, 0], turned[..., 0, 0])


def harmonics(pixels):
    """Regressors (..., 5) of the lasting part at pixels (..., 2)."""
    x = 2.0 * np.pi * pixels
    u, v = x[..., 0], x[..., 1]
    return np.stack([np.ones_like(u), np.cos(u), np.sin(u), np.cos(v), np.sin(v)], axis=-1)


class CornerMap:
    """Errors of corners by the table, of one finder; the same view has the same lasting error."""

    def __init__(self, finder, seed=SEED):
        with np.load(TABLE) as file:
            self.table = file[finder].astype(float)
        # What harmonics leave lasts too: waves over the image, of each marker (of 250), view and coordinate.
        rng = np.random.default_rng([seed, 1])
        period, way = rng.uniform(3.0, 8.0, (250, 2, 2)), rng.uniform(0.0, 2.0 * np.pi, (2, 250, 2, 2))
        self.wave = 2.0 * np.pi / period[..., None] * np.stack([np.cos(way[0]), np.sin(way[0])], axis=-1)
        self.begin = way[1]

    def at(self, R, t, side, pixels, view, blurred=False):
        """Lasting errors (k, 4, 2), deviations stated and fresh (k, 4), px, and shares found (k,).

        R, t : (k, 3, 3), (k, 3) tags before the camera; side : (k,) px if it were not tilted; pixels :
        (k, 4, 2) true corners; tag i of the k has the markers 4 i to 4 i + 3.
        """
        tilt, azimuth, roll = view_of(R, t)
        quarter = 0.5 * np.pi * np.arange(4)
        whole = [np.interp(np.log(side), np.log(SIDES), np.arange(len(SIDES)))[:, None] + 0.0 * quarter]
        whole += [np.interp(tilt, TILTS, np.arange(len(TILTS)))[:, None] + 0.0 * quarter]
        whole += [(azimuth[:, None] + quarter) % (2.0 * np.pi) * (AZIMUTHS / (2.0 * np.pi))]
        whole += [(roll[:, None] - quarter) % (2.0 * np.pi) * (ROLLS / (2.0 * np.pi))]
        low = np.floor(np.stack(whole)).astype(int)
        share, count = np.stack(whole) - low, np.array([len(SIDES), len(TILTS), AZIMUTHS, ROLLS])
        found = np.zeros((len(side), 4, FOUND + 1))
        for ends in itertools.product((0, 1), repeat=4):
            up = np.array(ends)[:, None, None]
            weight = np.where(up, share, 1.0 - share).prod(axis=0)
            index = low + up
            index[:2] = np.minimum(index[:2], count[:2, None, None] - 1)
            index[2:] %= count[2:, None, None]
            found += weight[..., None] * self.table[int(blurred)][tuple(index)]
        basis = harmonics(pixels)
        errors = np.stack([(basis * found[..., 5 * c : 5 * c + 5]).sum(axis=-1) for c in (0, 1)], axis=-1)
        marker = np.arange(4 * len(side)).reshape(-1, 4)
        wave = np.cos((self.wave[marker, view] @ pixels[..., None])[..., 0] + self.begin[marker, view])
        errors += np.sqrt(2.0) * found[..., LEFT, None] * wave
        return errors, found[..., STATED], found[..., FRESH], found[..., FOUND].mean(axis=1)
