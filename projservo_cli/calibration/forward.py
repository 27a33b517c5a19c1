"""Images at many poses at once: the vectorised forward model and its derivative.

The twin of the kernels in ``geometry``: the same equations for all poses and points together, which the
adjustment, predictions and random tasks share.
"""

from dataclasses import dataclass
from functools import reduce
from typing import NamedTuple

import numpy as np

from projservo_cli.geometry.lens import bent, bent_derivative, through
from projservo_cli.records import BoolArray, FloatArray, IntArray

CAMERA = 12
LENS = 2


def _sine_and_versine(prismatic: BoolArray, q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Coefficients (K, n) of Ĥ and Ĥ² in [RH00] eqs. (4), (5) at joints (K, n) from the reference."""
    return np.where(prismatic, q, np.sin(q)), np.where(prismatic, 0.0, 2.0 * np.sin(0.5 * q) ** 2)


def displacements(H_hat: FloatArray, prismatic: BoolArray, q: FloatArray) -> FloatArray:
    """Displacements exp(q Ĥ) (n, K, 4, 4) of operators (n, 4, 4) at joints (K, n), [RH00] eqs. (4), (5).

    Joint values are from the reference, rad or m.
    """
    squared = H_hat @ H_hat
    sine, versine = (part.T[..., None, None] for part in _sine_and_versine(prismatic, q))
    return np.eye(4) + sine * H_hat[:, None] + versine * squared[:, None]


def moved_points(E: FloatArray, M: FloatArray) -> FloatArray:
    """Points (m, 4) or (K, m, 4) after the last joints alone, (n + 1, K, m, 4): [RH00] eq. (6) from its end.

    By displacements (n, K, 4, 4). Entry n holds points at the reference, entry 0 those moved by all joints.
    """
    n, K = E.shape[:2]
    Y = np.empty((n + 1, K, *M.shape[-2:]))
    Y[n] = M
    for i in range(n - 1, -1, -1):
        Y[i] = Y[i + 1] @ np.swapaxes(E[i], 1, 2)
    return Y


def image_points(P: FloatArray, points: FloatArray) -> FloatArray:
    """Homogeneous image points (…, 2, m, 3) of points (…, m, 4) in both cameras (2, 3, 4), [RH00] eq. (1)."""
    return np.asarray(points[..., None, :, :] @ np.swapaxes(P, 1, 2))


def projection_derivative(
    P: FloatArray, lens: FloatArray | None, points: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray | None]:
    """Pixels (2, N, 2) of points (N, 4), and derivatives by image points (2, N, 2, 3) and k1, k2 of a lens.

    [RH00] eq. (7), second row corrected: rows (1, 0, −u)/m3 and (0, 1, −v)/m3; then the lenses (2, 5).
    """
    m = image_points(P, points)
    pixels = m[..., :2] / m[..., 2:]
    G = np.zeros((*pixels.shape, 3))
    G[..., 0, 0] = G[..., 1, 1] = 1.0 / m[..., 2]
    G[..., 2] = -pixels / m[..., 2:]
    if lens is None:
        return pixels, G, None
    by_pixel, by_lens = bent_derivative(lens[:, None], pixels)
    return bent(lens[:, None], pixels), by_pixel @ G, by_lens


class Images(NamedTuple):
    """Pixels of N sightings and their derivatives."""

    pixels: FloatArray  # (2, N, 2) px
    points: FloatArray  # (n + 1, N, 4) the point behind each joint, entry 0 moved by all joints
    by_camera: FloatArray  # (2, N, 2, 12)
    by_point: FloatArray  # (n + 1, 2, N, 2, 4) by ``points``, the joints before it held
    by_lens: FloatArray | None  # (2, N, 2, 2) by k1 and k2, if there is a lens

    def by_joint(self, H_hat: FloatArray) -> FloatArray:
        """Derivative (2, N, 2, n) by the joints of operators (n, 4, 4), [RH00] eqs. (7), (19)."""
        velocity = self.points[:-1] @ H_hat.swapaxes(1, 2)
        return np.asarray(np.einsum("ivNrc,iNc->vNri", self.by_point[:-1], velocity))


@dataclass(frozen=True, eq=False)
class Scene:
    """Rig, robot and markers, in any one frame; joint values are from the reference, rad or m."""

    P: FloatArray  # (2, 3, 4) cameras to pixels
    H_hat: FloatArray  # (n, 4, 4) operators at the reference
    prismatic: BoolArray  # (n,) whether the joint is prismatic
    M: FloatArray  # (m, 4) markers at the reference
    lens: FloatArray | None = None  # (2, 5) lenses, None without
    # (K, n) true joints less their readings at the poses of a problem, rad or m; None where they are exact
    offsets: FloatArray | None = None

    def seen(self, q: FloatArray) -> FloatArray:
        """Pixels (K, 2, m, 2) of all markers at joints (K, n), [RH00] eqs. (1), (6).

        NaN for a point that does not lie in front of the camera, or beyond where its lens turns back.
        """
        m = image_points(self.P, moved_points(displacements(self.H_hat, self.prismatic, q), self.M)[0])
        pixels: FloatArray = m[..., :2] / np.where(m[..., 2:] > 0.0, m[..., 2:], np.nan)
        return pixels if self.lens is None else through(self.lens[:, None], pixels)

    def motion(self, q: FloatArray) -> FloatArray:
        """Displacements (K, 4, 4) by all joints together at joints (K, n), [RH00] eq. (6)."""
        return reduce(np.matmul, displacements(self.H_hat, self.prismatic, q))

    def moved(self, q: FloatArray, pose_of: IntArray, marker_of: IntArray) -> FloatArray:
        """Points (N, 4) of sightings, moved by all joints."""
        return np.asarray((self.motion(q)[pose_of] @ self.M[marker_of][..., None])[..., 0])

    def images(self, q: FloatArray, pose_of: IntArray, marker_of: IntArray) -> Images:
        """Sightings (N,) of markers at rows of q (K, n), with their derivatives.

        From images to the point behind each joint by [RH00] eq. (6).
        """
        E = displacements(self.H_hat, self.prismatic, q)[:, pose_of]
        Y = moved_points(E, self.M[marker_of][:, None])[:, :, 0]
        pixels, G, by_lens = projection_derivative(self.P, self.lens, Y[0])
        D = np.empty((len(Y), *pixels.shape, 4))
        D[0] = G @ self.P[:, None]
        for i, by_joint in enumerate(E):
            D[i + 1] = D[i] @ by_joint
        by_camera = (G[..., None] * Y[0][:, None, None, :]).reshape(*pixels.shape, CAMERA)
        return Images(pixels, Y, by_camera, D, by_lens)

    def everywhere(self, q: FloatArray) -> Images:
        """Images of all markers at joints (K, n), pose by pose, with their derivatives."""
        pose_of, marker_of = np.divmod(np.arange(len(q) * len(self.M)), len(self.M))
        return self.images(q, pose_of, marker_of)

    def derivative(self, q: FloatArray, images: Images | None = None) -> tuple[FloatArray, FloatArray]:
        """Derivatives of all markers' pixels by P, H_hat (ravelled), and by the marker's own coordinates.

        (K, 2, m, 2, 24 + 16 n), four columns more with a lens for k1 and k2 of both views, and
        (K, 2, m, 2, 4). An operator enters by E = I + s Ĥ + c Ĥ², [RH00] eqs. (4), (5), so
        dE = s dĤ + c (dĤ Ĥ + Ĥ dĤ). images : those of ``everywhere``, where they are known.
        """
        (K, n), m = q.shape, len(self.M)
        pose_of = np.repeat(np.arange(K), m)
        images = self.everywhere(q) if images is None else images
        joints, lenses = 2 * CAMERA, 2 * CAMERA + 16 * n
        J = np.zeros((2, K * m, 2, lenses + (0 if images.by_lens is None else 2 * LENS)))
        for v in (0, 1):
            J[v, ..., v * CAMERA : (v + 1) * CAMERA] = images.by_camera[v]
            if images.by_lens is not None:
                J[v, ..., lenses + v * LENS : lenses + (v + 1) * LENS] = images.by_lens[v]
        parts = _sine_and_versine(self.prismatic, q)
        sine, versine = (part[pose_of].T[..., None, None, None] for part in parts)
        for i, (s, c, H) in enumerate(zip(sine, versine, self.H_hat, strict=True)):
            D, Y = images.by_point[i], images.points[i + 1]
            Y, HY = Y[:, None, None], (Y @ H.T)[:, None, None]
            block = D[..., None] * (s * Y + c * HY) + (c * (D @ H)[..., None]) * Y
            J[..., joints + 16 * i : joints + 16 * (i + 1)] = block.reshape(2, K * m, 2, 16)
        shared, own = (part.reshape(2, K, m, 2, -1).swapaxes(0, 1) for part in (J, images.by_point[n]))
        return shared, own

    def gauge(self) -> FloatArray:
        """Orthonormal directions (24 + 16 n + 4 m, 18) of P, H_hat, M that change no image.

        Those of the frame and of the scales of both cameras; four rows of zeros before M for lenses.
        """
        Z = np.eye(16).reshape(16, 1, 4, 4)
        lenses = np.zeros((16, 0 if self.lens is None else 2 * LENS))
        parts = -(self.P @ Z), Z @ self.H_hat - self.H_hat @ Z, lenses, self.M @ Z.swapaxes(2, 3)
        frame = np.hstack([part.reshape(16, -1) for part in parts])
        cameras = np.zeros((2, frame.shape[1]))
        cameras[0, :CAMERA], cameras[1, CAMERA : 2 * CAMERA] = self.P.reshape(2, CAMERA)
        return np.asarray(np.linalg.svd(np.vstack([frame, cameras]).T, full_matrices=False)[0])
