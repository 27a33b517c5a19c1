"""Rigid displacements, twists and screws as arrays, of many at once."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from projservo_cli.records import BoolArray, FloatArray


def homogeneous(points: FloatArray) -> FloatArray:
    """Points (…, d) with one more coordinate of one."""
    return np.concatenate([points, np.ones((*points.shape[:-1], 1))], axis=-1)


def cross_matrix(w: FloatArray) -> FloatArray:
    """Matrices (…, 3, 3) of the cross products with w (…, 3).

    Columns lie one after the other in memory: their layout decides in which order products are summed, and
    so the last bits of fits.
    """
    columns = np.zeros((*w.shape, 3))
    columns[..., 1, 2], columns[..., 2, 0], columns[..., 0, 1] = w[..., 0], w[..., 1], w[..., 2]
    return (columns - columns.swapaxes(-1, -2)).swapaxes(-1, -2)


def twists(axes: FloatArray) -> FloatArray:
    """Twists (…, 4, 4) of screws (…, 6)."""
    result = np.zeros((*axes.shape[:-1], 4, 4))
    result[..., :3, :3] = cross_matrix(axes[..., :3])
    result[..., :3, 3] = axes[..., 3:]
    return result


def screws(H_hat: FloatArray) -> FloatArray:
    """Screws (…, 6) of twists (…, 4, 4)."""
    skew = 0.5 * (H_hat[..., :3, :3] - H_hat[..., :3, :3].swapaxes(-1, -2))
    w = np.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], axis=-1)
    return np.concatenate([w, H_hat[..., :3, 3]], axis=-1)


def sine_and_versine(prismatic: BoolArray, q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Coefficients (…, n) of Ĥ and Ĥ² in [RH00] eqs. (4), (5) at joints (…, n) from the reference."""
    return np.where(prismatic, q, np.sin(q)), np.where(prismatic, 0.0, 2.0 * np.sin(0.5 * q) ** 2)


def exponentials(axes: FloatArray, prismatic: BoolArray, q: FloatArray) -> FloatArray:
    """Displacements (…, n, 4, 4) of screws (…, n, 6) by readings (…, n), [RH00] eqs. (4), (5)."""
    H = twists(axes)
    sine, versine = (part[..., None, None] for part in sine_and_versine(prismatic, q))
    return np.asarray(np.eye(4) + sine * H + versine * (H @ H))


def rigid(R: Rotation, t: Sequence[float] | FloatArray) -> FloatArray:
    """4×4 displacement of a rotation and a translation (3,), m."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R.as_matrix(), t
    return T


def rigid_inverse(T: FloatArray) -> FloatArray:
    """Inverse of rigid displacements (…, 4, 4)."""
    R = T[..., :3, :3].swapaxes(-1, -2)
    result = np.zeros_like(T)
    result[..., :3, :3], result[..., 3, 3] = R, 1.0
    result[..., :3, 3] = -(R @ T[..., :3, 3, None])[..., 0]
    return result
