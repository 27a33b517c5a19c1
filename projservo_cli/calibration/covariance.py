"""The projective frame of the result, and the covariance in it."""

from dataclasses import dataclass

import numpy as np

from projservo_cli.calibration.adjustment import Problem, Scene
from projservo_cli.calibration.prediction import CAMERA
from projservo_cli.calibration.readings import ON_A_LINE
from projservo_cli.records import BoolArray, FloatArray, WorkFailed

# Least distance of the markers from their best line, in units of its own noise.
_OFF_LINE = 5.0
# A direction whose singular value is this share of the largest is open.
_OPEN_DIRECTION = 1e-10
_A_INF = np.array([0.0, 0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class ProjectiveScene:
    """Projective kinematics: what [RH00] section 2 calls P, Ĥ, M and the plane at infinity."""

    P: FloatArray  # (2, 3, 4) cameras; depths of the points seen are positive, of unit mean square a view
    H_hat_0: FloatArray  # (n, 4, 4) operators at the reference
    M: FloatArray  # (m, 4) markers at the reference, a_inf @ M = 1
    a_inf: FloatArray  # (4,) plane at infinity
    W: FloatArray  # (4, 4) frame change that led here
    camera_scale: FloatArray  # (2,) factors the cameras took


def isotropic(
    P: FloatArray, H_hat: FloatArray, M: FloatArray, a_inf: FloatArray, moved: FloatArray
) -> ProjectiveScene:
    """The one projective frame in which points seen, ``moved`` (N, 4), have the identity as second moment.

    The rotation that leaves free is settled by the left camera: its depth row and then its two image
    rows are triangular, its centre lies along the fourth axis on the positive side of ``a_inf``. So
    the frame depends on images alone: whatever frame the scene comes in, the same numbers come out.
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
        scale[:, None, None] * (P @ back), W @ H_hat @ back, M @ W.T, a_inf @ back, W, scale
    )


def projective(problem: Problem, scene: Scene) -> ProjectiveScene:
    """The adjusted scene in the isotropic projective frame of the points seen."""
    return isotropic(scene.P, scene.H_hat, scene.M, _A_INF, problem.carried(scene)[1][0])


def spread_factor(problem: Problem, scene: Scene, used: BoolArray) -> FloatArray:
    """Factor L of the inverse information, L Lᵀ = (JᵀJ)⁺, on the directions that readings (2, N) determine.

    Singular values of J itself keep the weakest direction, which the normal matrix would lose.
    At a noise of one pixel, (size, size − g); a direction left open has a column of enormous length.
    """
    J = problem.dense(problem.derivative(scene)[1], used)
    scale = np.linalg.norm(J, axis=0)
    # A parameter no residual depends on has no scale of its own: it is open whatever the unit.
    scale = np.where(scale > 0.0, scale, scale.max())
    G = np.linalg.qr(scale[:, None] * problem.gauge(scene))[0]
    free = np.linalg.qr(G, mode="complete")[0][:, G.shape[1] :]
    _, s, Vt = np.linalg.svd(np.linalg.qr((J / scale) @ free, mode="r"))
    # Robots of one or two joints leave more directions open than the gauge, none of which matters
    # to an image: they must come out as zero after the product with its derivative.
    result: FloatArray = (free @ (Vt.T / np.maximum(s, _OPEN_DIRECTION * s[0]))) / scale[:, None]
    return result


def covariance_factor(problem: Problem, scene: Scene, used: BoolArray, result: ProjectiveScene) -> FloatArray:
    """Factor (24 + 16 n + 4 m, r) of the covariance of P, H_hat_0, M at a noise of one pixel, gauge fixed.

    Of four rows more, for k1 and k2 of both views, where lenses are adjusted.
    """
    factor = _output_derivative(problem, scene, result) @ spread_factor(problem, scene, used)
    free = np.zeros((len(factor), 18))
    free[: result.P.size + result.H_hat_0.size + result.M.size] = _output_gauge(result)
    return np.asarray(factor - free @ (free.T @ factor))


def _output_derivative(problem: Problem, scene: Scene, result: ProjectiveScene) -> FloatArray:
    """Derivative of P, H_hat_0, M and the lenses (ravelled, in this order) by the adjusted parameters.

    The frame and the camera scales are held: they are part of the gauge.
    """
    n, m = scene.H_hat.shape[0], scene.M.shape[0]
    back = np.linalg.inv(result.W)
    size = 2 * CAMERA + 16 * n + 4 * m
    J = np.zeros((size + problem.size - problem.lens, problem.size))
    J[size:, problem.lens :] = np.eye(problem.size - problem.lens)
    for v in (0, 1):
        rows = slice(v * CAMERA, (v + 1) * CAMERA)
        J[rows, rows] = result.camera_scale[v] * np.kron(np.eye(3), back.T)
    for i, B in enumerate(scene.generators(problem.readings.prismatic)):
        turned = result.W @ (B @ scene.H_hat[i] - scene.H_hat[i] @ B) @ back
        rows = slice(2 * CAMERA + 16 * i, 2 * CAMERA + 16 * (i + 1))
        J[rows, problem.joint[i] : problem.joint[i + 1]] = turned.reshape(len(B), 16).T
    for j in range(m):
        rows = slice(2 * CAMERA + 16 * n + 4 * j, 2 * CAMERA + 16 * n + 4 * (j + 1))
        first = int(problem.joint[-1]) + 3 * j
        J[rows, first : first + 3] = result.W[:, :3]
    return J


def _output_gauge(result: ProjectiveScene) -> FloatArray:
    """Orthonormal directions (24 + 16 n + 4 m, 18) that change no image: of the frame and of both cameras."""
    directions = []
    for k in range(16):
        Z = np.zeros((4, 4))
        Z[divmod(k, 4)] = 1.0
        moved = (-(result.P @ Z), Z @ result.H_hat_0 - result.H_hat_0 @ Z, result.M @ Z.T)
        directions.append(np.concatenate([part.ravel() for part in moved]))
    for v in (0, 1):
        camera = np.zeros_like(directions[0])
        camera[v * CAMERA : (v + 1) * CAMERA] = result.P[v].ravel()
        directions.append(camera)
    return np.asarray(np.linalg.svd(np.array(directions).T, full_matrices=False)[0])


def _marker_factor(result: ProjectiveScene, factor: FloatArray) -> FloatArray:
    """Factor (4 m, r) of the covariance of the markers as points, whatever frame and scale they are given."""
    first, m = result.P.size + result.H_hat_0.size, len(result.M)
    scales = np.zeros((first + 4 * m, m))
    for j in range(m):
        scales[first + 4 * j : first + 4 * (j + 1), j] = result.M[j]
    # One of the directions is a sum of others: all markers scaled at once.
    U, s, _ = np.linalg.svd(np.hstack([_output_gauge(result), scales]), full_matrices=False)
    free = U[:, s > _OPEN_DIRECTION * s[0]]
    factor = factor[: first + 4 * m]
    return (factor - free @ (free.T @ factor))[first:]


def require_off_line(result: ProjectiveScene, factor: FloatArray) -> None:
    """Refuse a body that a factor (24 + 16 n + 4 m or more, r) of its covariance cannot tell from a line.

    A line is the span of two points; the markers must be off it by several times the noise of that distance.
    """
    U, extent, Vt = np.linalg.svd(result.M, full_matrices=False)
    m = len(result.M)
    across = np.eye(m) - U[:, :2] @ U[:, :2].T
    noise = across @ (Vt[2:] @ _marker_factor(result, factor).reshape(m, 4, -1)).reshape(m, -1)
    if extent[2] < _OFF_LINE * float(np.linalg.norm(noise)):
        raise WorkFailed(ON_A_LINE)
