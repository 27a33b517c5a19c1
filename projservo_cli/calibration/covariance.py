"""The projective frame of the result, the covariance in it, and how far predictions from it may err."""

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from projservo_cli.calibration.adjustment import Problem, Scene, carried, derivative, gauge, generators
from projservo_cli.calibration.prediction import CAMERA, marker_pixels, prediction_derivative
from projservo_cli.calibration.readings import MOST_REACHES, REACH_M, REACH_RAD, Readings
from projservo_cli.records import PRISMATIC, BoolArray, FloatArray, Model

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
    return isotropic(scene.P, scene.H_hat, scene.M, _A_INF, carried(problem, scene)[1][0])


def spread_factor(problem: Problem, scene: Scene, used: BoolArray) -> FloatArray:
    """Factor L of the inverse information, L Lᵀ = (JᵀJ)⁺, on the directions that readings (2, N) determine.

    Singular values of J itself keep the weakest direction, which the normal matrix would lose.
    At a noise of one pixel, (size, size − g); a direction left open has a column of enormous length.
    """
    J = problem.dense(derivative(problem, scene)[1], used)
    scale = np.linalg.norm(J, axis=0)
    # A parameter no residual depends on has no scale of its own: it is open whatever the unit.
    scale = np.where(scale > 0.0, scale, scale.max())
    G = np.linalg.qr(scale[:, None] * gauge(problem, scene))[0]
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
    for i, B in enumerate(generators(scene, problem.readings.prismatic)):
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


def marker_factor(result: ProjectiveScene, factor: FloatArray) -> FloatArray:
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


# Noise of predictions at the reach, in units of the pixel noise: above it a joint is weak.
WEAK_NOISE = 3.0
# Poses at which predictions are judged; how sure they stay below the bound; halvings of an empty range.
_POSES, _SURE, _HALVINGS = 60, 0.99, 10
# Frames of the trial motion that is advised; the least range of it, in reaches, and how often the
# logarithm of the range between it and the farthest is halved: to a twentieth.
_FRAMES, _LEAST_REACHES, _BISECTIONS = 8, 0.01, 7


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """A calibration whose predictions err, judged in twice the image region in which markers were seen."""

    model: Model  # projective robot and rig
    M: FloatArray  # (m, 4) markers at the reference
    factor: FloatArray  # (24 + 16 n + 4 m, r) factor of the covariance at a noise of one pixel
    readings: Readings  # what the calibration was made from

    def shown(self, q: FloatArray) -> BoolArray:
        """Which images (K, 2, m) at poses (K, n) lie in the region that counts."""
        pixels = marker_pixels(self.model, self.M, q)
        inside = np.empty(pixels.shape[:-1], dtype=np.bool_)
        for v in (0, 1):
            seen = self.readings.pixels[v][self.readings.seen[v]]
            low, high = seen.min(axis=0), seen.max(axis=0)
            wide = 0.5 * (high - low)
            inside[:, v] = ((pixels[:, v] >= low - wide) & (pixels[:, v] <= high + wide)).all(axis=-1)
        return inside

    def spread(self, q: FloatArray, shown: BoolArray) -> FloatArray:
        """Derivative (rows, r) of coordinates shown at poses (K, n) by independent errors of size one."""
        J = prediction_derivative(self.model, self.M, q)[shown]
        return np.asarray(J.reshape(-1, len(self.factor)) @ self.factor)

    def at(self, i: int, offsets: FloatArray) -> FloatArray:
        """Poses (K, n) with joint i at offsets (K,) from the reference, rad or m."""
        q = np.tile(self.model.q_reference, (len(offsets), 1))
        q[:, i] += offsets
        return q

    def reach(self, i: int) -> float:
        """Reach of joint i at which predictions are judged, rad or m."""
        return REACH_M if self.model.joint_types[i] == PRISMATIC else REACH_RAD

    def reach_spread(self, i: int) -> FloatArray:
        """``spread`` with joint i at its reach, to either side; halved where no image would count."""
        reach = self.reach(i)
        for _ in range(_HALVINGS):
            q = self.at(i, np.array([reach, -reach]))
            shown = self.shown(q)
            if shown.any():
                break
            reach *= 0.5
        return self.spread(q, shown)


def reach_noise(sure: Uncertainty) -> FloatArray:
    """Noise of predicted images (n,) with each joint at its reach, in units of the pixel noise."""
    rows = (sure.reach_spread(i) for i in range(len(sure.model.joint_types)))
    return np.array([np.sqrt((T**2).sum() / max(len(T), 1)) for T in rows])


def needed_spans(sure: Uncertainty, noise: FloatArray) -> FloatArray:
    """Range (n,) of a trial motion of each joint of too much noise (n,) that would mend it, rad or m.

    The trial is of eight frames about the reference, of this joint alone, beside the data there are;
    information adds up. NaN for joints that are not weak or that no trial of sensible range mends.
    """
    needed = np.full(len(noise), np.nan)
    for i in np.flatnonzero(noise > WEAK_NOISE).tolist():
        T = sure.reach_spread(i)
        low, high = _LEAST_REACHES * sure.reach(i), MOST_REACHES * sure.reach(i)
        if _noise_after(sure, i, high, T) > WEAK_NOISE:
            continue
        for _ in range(_BISECTIONS):
            middle = float(np.sqrt(low * high))
            if _noise_after(sure, i, middle, T) > WEAK_NOISE:
                low = middle
            else:
                high = middle
        needed[i] = high
    return needed


def _noise_after(sure: Uncertainty, i: int, span: float, T: FloatArray) -> float:
    """Noise at the reach after a trial over a span: rms of T (I + Cᵀ C)⁻¹ Tᵀ, C the trial's ``spread``."""
    q = sure.at(i, np.linspace(-0.5 * span, 0.5 * span, _FRAMES))
    C = sure.spread(q, sure.shown(q))
    root = np.asarray(np.linalg.qr(np.vstack([np.eye(C.shape[1]), C]), mode="r"))
    left = np.linalg.solve(root.T, T.T)
    return float(np.sqrt((left**2).sum() / max(len(T), 1)))


def predicted_error(sure: Uncertainty) -> tuple[float, float]:
    """Expected error of images at poses of all joints at once, and what 99 of 100 calibrations stay below.

    Root mean squares of the Euclidean error per marker and view, in units of the pixel noise, over poses
    drawn evenly within the ranges that the joints moved through; where no image would count, the ranges
    are halved about the reference. No residual shows on which side of the expectation a calibration came
    to lie: to first order the error of a maximum of the likelihood does not depend on what it leaves.
    """
    q = sure.readings.q
    poses = np.random.default_rng(0).uniform(q.min(axis=0), q.max(axis=0), (_POSES, q.shape[1]))
    for _ in range(_HALVINGS):
        shown = sure.shown(poses)
        if shown.any():
            break
        poses = 0.5 * (poses + sure.model.q_reference)
    spread = sure.spread(poses, shown)
    variances = np.linalg.eigvalsh(spread.T @ spread) / max(int(shown.sum()), 1)
    return float(np.sqrt(variances.sum())), float(np.sqrt(quantile(variances, _SURE)))


def quantile(variances: FloatArray, probability: float) -> float:
    """Quantile of a sum of squares of independent normal variables of variances (r,), by its three moments.

    Source: M. J. Buckley, G. K. Eagleson, "An approximation to the distribution of quadratic forms in
    normal random variables", Australian Journal of Statistics 30A, 1988.
    """
    mean, square, cube = (float((variances**power).sum()) for power in (1, 2, 3))
    if cube == 0.0:
        return mean
    freedom = square**3 / cube**2
    return mean + float(np.sqrt(square / freedom) * (chdtri(freedom, 1.0 - probability) - freedom))
