"""From the adjusted scene to the projective frame of the result, and the covariance in it."""

from dataclasses import dataclass

import numpy as np

from projservo_cli.calibration import adjustment
from projservo_cli.calibration.adjustment import CAMERA, LENS, Layout, Scene
from projservo_cli.calibration.readings import Readings
from projservo_cli.records import FloatArray

OPEN_DIRECTION = 1e-10


@dataclass(frozen=True, eq=False)
class ProjectiveScene:
    """Projective kinematics: what [RH00] section 2 calls P, Ĥ, M and the plane at infinity.

    Attributes
    ----------
    P : (2, 3, 4) cameras; depths of the points seen are positive, of unit mean square a view.
    H_hat_0 : (n, 4, 4) operators at the reference.
    M : (m, 4) markers at the reference, a_inf @ M = 1.
    a_inf : (4,) plane at infinity.
    W : (4, 4) frame change that led here.
    camera_scale : (2,) factors the cameras took.
    lens : (2, 5) lenses, which no change of frame touches; None where none was sought.
    """

    P: FloatArray
    H_hat_0: FloatArray
    M: FloatArray
    a_inf: FloatArray
    W: FloatArray
    camera_scale: FloatArray
    lens: FloatArray | None = None


def isotropic(
    P: FloatArray, H_hat: FloatArray, M: FloatArray, a_inf: FloatArray, moved: FloatArray
) -> ProjectiveScene:
    """The one projective frame in which the points seen have the identity as second moment.

    The rotation that leaves free is settled by the left camera: its depth row and then its two image
    rows are triangular, its centre lies along the fourth axis on the positive side of ``a_inf``. So
    the frame depends on images alone: whatever frame the scene comes in, the same numbers come out.

    Parameters
    ----------
    P : (2, 3, 4) cameras.
    H_hat : (n, 4, 4) operators.
    M : (m, 4) markers at the reference.
    a_inf : (4,) plane at infinity.
    moved : (N, 4) markers where they were seen, scaled like M.
    """
    points = moved / (moved @ a_inf)[:, None]
    M = M / (M @ a_inf)[:, None]
    L = np.linalg.cholesky(points.T @ points / len(points))
    rows = (P[0] @ L)[[2, 0, 1]]
    depth = points @ P[0, 2]
    rows = rows * np.sign(depth.sum())
    Q, R = np.linalg.qr(rows.T, mode="complete")
    Q[:, :3] *= np.where(np.diagonal(R) < 0.0, -1.0, 1.0)
    if (a_inf @ L) @ Q[:, 3] < 0.0:
        Q[:, 3] *= -1.0
    W = Q.T @ np.linalg.inv(L)
    back = L @ Q
    depths = points @ P[:, 2].T
    scale = np.sign(depths.sum(axis=0)) / np.sqrt((depths**2).mean(axis=0))
    return ProjectiveScene(
        P=scale[:, None, None] * (P @ back),
        H_hat_0=W @ H_hat @ back,
        M=M @ W.T,
        a_inf=a_inf @ back,
        W=W,
        camera_scale=scale,
    )


def output_derivative(scene: Scene, readings: Readings, place: Layout, result: ProjectiveScene) -> FloatArray:
    """Derivative of P, H_hat_0, M and the lenses (ravelled, in this order) by the adjusted parameters.

    The frame and the camera scales are held: they are part of the gauge.

    Parameters
    ----------
    scene : adjusted scene.
    readings : types of the joints.
    place : where parameters stand.
    result : the scene in its projective frame.

    Returns
    -------
    (24 + 16 n + 4 m, size) derivative, of four rows more where the lenses are adjusted.
    """
    n, m = scene.H_hat.shape[0], scene.M.shape[0]
    back = np.linalg.inv(result.W)
    size = 2 * CAMERA + 16 * n + 4 * m
    J = np.zeros((size + place.size - place.lens, place.size))
    J[size:, place.lens :] = np.eye(place.size - place.lens)
    for v in (0, 1):
        rows = slice(v * CAMERA, (v + 1) * CAMERA)
        J[rows, rows] = result.camera_scale[v] * np.kron(np.eye(3), back.T)
    for i, B in enumerate(adjustment.generators(scene, readings.prismatic)):
        turned = result.W @ (B @ scene.H_hat[i] - scene.H_hat[i] @ B) @ back
        rows = slice(2 * CAMERA + 16 * i, 2 * CAMERA + 16 * (i + 1))
        J[rows, place.joint[i] : place.joint[i + 1]] = turned.reshape(len(B), 16).T
    for j in range(m):
        rows = slice(2 * CAMERA + 16 * n + 4 * j, 2 * CAMERA + 16 * n + 4 * (j + 1))
        first = int(place.joint[-1]) + 3 * j
        J[rows, first : first + 3] = result.W[:, :3]
    return J


def output_gauge(result: ProjectiveScene) -> FloatArray:
    """Orthonormal directions of P, H_hat_0, M that change no image: 16 of the frame, 2 of the cameras.

    Lenses have no part in them: their rows, where they are adjusted, are zero.
    """
    lenses = np.zeros(0 if result.lens is None else 2 * LENS)
    directions = []
    for k in range(16):
        Z = np.zeros((4, 4))
        Z[divmod(k, 4)] = 1.0
        directions.append(
            np.concatenate(
                [
                    -(result.P @ Z).ravel(),
                    (Z @ result.H_hat_0 - result.H_hat_0 @ Z).ravel(),
                    (result.M @ Z.T).ravel(),
                    lenses,
                ]
            )
        )
    for v in (0, 1):
        camera = np.zeros_like(directions[0])
        camera[v * CAMERA : (v + 1) * CAMERA] = result.P[v].ravel()
        directions.append(camera)
    U, s, _ = np.linalg.svd(np.array(directions).T, full_matrices=False)
    gauge: FloatArray = U[:, s > 1e-10 * s[0]]
    return gauge


def marker_factor(result: ProjectiveScene, factor: FloatArray) -> FloatArray:
    """Factor (4 m, r) of the covariance of the markers as points, whatever frame and scale they are given.

    Parameters
    ----------
    result : the scene.
    factor : (24 + 16 n + 4 m or more, r) factor of the covariance of P, H_hat_0, M.
    """
    first, m = result.P.size + result.H_hat_0.size, len(result.M)
    scales = np.zeros((first + 4 * m, m))
    for j in range(m):
        scales[first + 4 * j : first + 4 * (j + 1), j] = result.M[j]
    free = np.linalg.qr(np.hstack([output_gauge(result)[: first + 4 * m], scales]))[0]
    factor = factor[: first + 4 * m]
    return (factor - free @ (free.T @ factor))[first:]


def spread_factor(J: FloatArray, gauge: FloatArray) -> FloatArray:
    """Factor L of the inverse information, L Lᵀ = (JᵀJ)⁺, on the directions that images determine.

    Singular values of J itself keep the weakest direction, which the normal matrix would lose.

    Parameters
    ----------
    J : (rows, size) derivative of the residuals in units of their noise.
    gauge : (size, g) directions without information.

    Returns
    -------
    (size, size − g) factor; a direction the data leave open has a column of enormous length.
    """
    scale = np.linalg.norm(J, axis=0)
    # A parameter no residual depends on has no scale of its own: it is open whatever the unit.
    scale = np.where(scale > 0.0, scale, scale.max())
    G = np.linalg.qr(scale[:, None] * gauge)[0]
    free = np.linalg.qr(G, mode="complete")[0][:, G.shape[1] :]
    _, s, Vt = np.linalg.svd(np.linalg.qr((J / scale) @ free, mode="r"))
    # Robots of one or two joints leave more directions open than the gauge, none of which matters
    # to an image: they must come out as zero after the product with its derivative.
    floor = OPEN_DIRECTION * s[0]
    result: FloatArray = (free @ (Vt.T / np.maximum(s, floor))) / scale[:, None]
    return result
