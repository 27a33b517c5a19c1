"""Projective pair of cameras and reconstruction: all that two views of unknown calibration give."""

from dataclasses import dataclass

import numpy as np

from projservo_cli.calibration.epipolar import homogeneous, normalization
from projservo_cli.records import FloatArray

WHITENINGS = 30


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Cameras and points in an isotropic projective frame.

    Attributes
    ----------
    P : (2, 3, 4) cameras to pixels.
    points : (N, 4) points of unit norm, with positive depth in both views where the data allow it.
    """

    P: FloatArray
    points: FloatArray


def canonical_pair(F: FloatArray) -> FloatArray:
    """Cameras (2, 3, 4) of a fundamental matrix, [I | 0] and [[e']× F | e'].

    Source: R. Hartley, A. Zisserman, Multiple View Geometry, 2nd ed., result 9.14.

    Parameters
    ----------
    F : (3, 3) matrix with rightᵀ F left = 0.
    """
    e = np.linalg.svd(F)[0][:, 2]
    right = np.hstack([np.cross(e[:, None], F, axis=0), e[:, None]])
    return np.stack([np.hstack([np.eye(3), np.zeros((3, 1))]), right])


def triangulate(P: FloatArray, left: FloatArray, right: FloatArray) -> FloatArray:
    """Points (N, 4) of unit norm from linear equations in both views.

    Source: R. Hartley, A. Zisserman, Multiple View Geometry, 2nd ed., section 12.2.

    Parameters
    ----------
    P : (2, 3, 4) cameras.
    left, right : (N, 3) homogeneous pixels with last entry one.
    """
    rows = np.concatenate(
        [image[:, :2, None] * camera[2] - camera[:2] for camera, image in zip(P, (left, right), strict=True)],
        axis=1,
    )
    return np.linalg.svd(rows)[2][:, 3]


def isotropic_frame(points: FloatArray) -> FloatArray:
    """Frame change W (4, 4) after which points of unit norm have a multiple of I as second moment.

    Without it one coordinate is a thousand times another and every linear method after it fails.

    Parameters
    ----------
    points : (N, 4) points of any scale.
    """
    W = np.eye(4)
    for _ in range(WHITENINGS):
        moved = points @ W.T
        moved = moved / np.linalg.norm(moved, axis=1, keepdims=True)
        W = np.linalg.inv(np.linalg.cholesky(4.0 * moved.T @ moved / len(moved))) @ W
    return W


def reconstruct(F: FloatArray, left: FloatArray, right: FloatArray) -> Reconstruction:
    """Isotropic projective reconstruction of corresponding pixels.

    Parameters
    ----------
    F : (3, 3) fundamental matrix, px.
    left, right : (N, 2) corresponding pixels.
    """
    T = np.stack([normalization(left), normalization(right)])
    back = np.linalg.inv(T)
    P = canonical_pair(back[1].T @ F @ back[0])
    # The right camera is known up to P' + e' vᵀ: a frame in which its left block is not singular.
    points = triangulate(P, homogeneous(left) @ T[0].T, homogeneous(right) @ T[1].T)
    W = isotropic_frame(points)
    points = points @ W.T
    P = back @ P @ np.linalg.inv(W)
    depth = points @ P[:, 2].T
    points = points * np.sign(depth[:, :1]) / np.linalg.norm(points, axis=1, keepdims=True)
    P[1] *= np.sign(np.median(points @ P[1, 2]))
    return Reconstruction(P, points)
