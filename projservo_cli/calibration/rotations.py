"""Rotations and cross products, many at a time."""

import numpy as np

from projservo_cli.records import FloatArray


def cross(w: FloatArray) -> FloatArray:
    """Matrices (..., 3, 3) of the cross products with w (..., 3)."""
    S = np.zeros((*w.shape[:-1], 3, 3))
    S[..., 0, 1], S[..., 0, 2], S[..., 1, 2] = -w[..., 2], w[..., 1], -w[..., 0]
    return S - np.swapaxes(S, -1, -2)


def rotation_about(w: FloatArray, theta: FloatArray) -> FloatArray:
    """Rotations about unit axes by Rodrigues' formula, [RH00] eq. (4) for directions alone.

    Parameters
    ----------
    w : (..., 3) unit axes.
    theta : (...) angles, rad.
    """
    S = cross(w)
    theta = theta[..., None, None]
    result: FloatArray = np.eye(3) + np.sin(theta) * S + (1.0 - np.cos(theta)) * (S @ S)
    return result


def rotation_vector(R: FloatArray) -> FloatArray:
    """Rotation vectors (..., 3) of rotations (..., 3, 3), rad, of length at most π.

    Through the unit quaternion of largest component: exact also at 0 and near π. Source:
    S. Shepperd, "Quaternion from rotation matrix", J. Guidance and Control 1(3), 1978.
    """
    trace = np.trace(R, axis1=-2, axis2=-1)
    Q = np.empty((*R.shape[:-2], 4, 4))
    Q[..., 0, 0] = 1.0 + trace
    for i, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):
        Q[..., 0, i + 1] = Q[..., i + 1, 0] = R[..., k, j] - R[..., j, k]
        Q[..., i + 1, i + 1] = 1.0 + 2.0 * R[..., i, i] - trace
        Q[..., j + 1, k + 1] = Q[..., k + 1, j + 1] = R[..., j, k] + R[..., k, j]
    largest = np.argmax(np.diagonal(Q, axis1=-2, axis2=-1), axis=-1)
    quaternion = np.take_along_axis(Q, largest[..., None, None], axis=-2)[..., 0, :]
    quaternion *= np.where(quaternion[..., :1] < 0.0, -1.0, 1.0) / np.linalg.norm(
        quaternion, axis=-1, keepdims=True
    )
    sine = np.linalg.norm(quaternion[..., 1:], axis=-1)
    angle = 2.0 * np.arctan2(sine, quaternion[..., 0])
    result: FloatArray = (
        quaternion[..., 1:] * np.where(sine > 1e-9, angle / np.maximum(sine, 1e-300), 2.0)[..., None]
    )
    return result


def mean_rotation(R: FloatArray) -> FloatArray:
    """Chordal mean (S, 3, 3) of rotations (S, K, 3, 3).

    Source: R. Hartley et al., "Rotation averaging", IJCV 103, 2013, section 5.3.
    """
    U, _, Vt = np.linalg.svd(R.sum(axis=1))
    U[..., 2] *= np.sign(np.linalg.det(U) * np.linalg.det(Vt))[:, None]
    return np.asarray(U @ Vt)


def rotation_exponential(v: FloatArray) -> FloatArray:
    """Rotations (..., 3, 3) of rotation vectors (..., 3), rad."""
    angle = np.linalg.norm(v, axis=-1)
    return rotation_about(v / np.maximum(angle, 1e-300)[..., None], angle)
