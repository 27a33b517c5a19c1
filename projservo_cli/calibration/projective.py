"""Projective kinematics, what [RH00] section 2 calls P, Ĥ, M and the plane at infinity.

Of an adjusted scene with its covariance, or by the paper's closed forms: one 4×4 homography a trial motion,
equations (4), (5).
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from projservo_cli.calibration.adjustment import moved_operators
from projservo_cli.calibration.epipolar import reconstruct
from projservo_cli.calibration.fit import OPEN_DIRECTION, Solution
from projservo_cli.calibration.prediction import Scene
from projservo_cli.calibration.readings import MOST_JUDGED, ON_A_LINE, Readings, even_choice
from projservo_cli.geometry.algebra import normalize_displacement
from projservo_cli.records import BoolArray, Errors, FloatArray, IntArray, WorkFailed

# Least distance of the markers from their best line, in units of its own noise.
_OFF_LINE = 5.0
_A_INF = np.array([0.0, 0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class Projective:
    """A scene in its isotropic projective frame."""

    # depths of the points seen are positive, of unit mean square a view; a_inf @ M = 1
    scene: Scene
    a_inf: FloatArray  # (4,) plane at infinity
    W: FloatArray  # (4, 4) frame change that led here
    camera_scale: FloatArray  # (2,) factors the cameras took

    @classmethod
    def of(cls, solution: Solution) -> "Projective":
        """The adjusted scene in the isotropic projective frame of the points seen."""
        problem, readings = solution.problem, solution.problem.readings
        moved = solution.scene.moved(problem.q, readings.pose_of, readings.marker_of)
        return _isotropic(solution.scene, _A_INF, moved)

    def errors(self, solution: Solution, errors: Errors) -> Errors:
        """Those of P, H_hat, k1 and k2 of both views where lenses are sought, and M, by ``Solution.errors``.

        At a noise of one pixel. Raises WorkFailed where the markers cannot be told from a line.
        """
        back = np.linalg.inv(self.W)
        cameras = [scale * np.kron(np.eye(3), back.T) for scale in self.camera_scale]
        joints = [(self.W @ moved @ back).reshape(-1, 16).T for moved in moved_operators(solution.scene)]
        lenses = np.eye(solution.problem.shared - solution.problem.joint[-1])
        by_marker = self.W[:, :3]
        shared = block_diag(*cameras, *joints, lenses) @ errors.shared
        found = Errors(shared, by_marker @ errors.marker, by_marker @ errors.own)
        few = even_choice(len(self.scene.M), MOST_JUDGED)
        _require_off_line(replace(self.scene, M=self.scene.M[few]), found.of(few).scaled(solution.sigma_px))
        return found

    def defects(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Defects (n,) of [RH00] section 2: of Ĥ³ = −Ĥ or Ĥ² = 0, of no trace, of one plane at infinity."""
        H_hat, prismatic = self.scene.H_hat, self.scene.prismatic
        square = H_hat @ H_hat
        law = np.where(prismatic[:, None, None], square, square @ H_hat + H_hat)
        return (
            np.linalg.norm(law, axis=(1, 2)) / np.linalg.norm(H_hat, axis=(1, 2)),
            np.abs(np.trace(H_hat, axis1=1, axis2=2)),
            np.linalg.norm(self.a_inf @ H_hat, axis=1) / np.linalg.norm(self.a_inf),
        )


def _isotropic(scene: Scene, a_inf: FloatArray, moved: FloatArray) -> Projective:
    """The one projective frame in which points seen, ``moved`` (N, 4), have the identity as second moment.

    The rotation that leaves free is settled by the left camera: its depth row and then its two image
    rows are triangular, its centre lies along the fourth axis on the positive side of ``a_inf``. So
    the frame depends on images alone: whatever frame the scene comes in, the same numbers come out.
    """
    P = scene.P
    points = moved / (moved @ a_inf)[:, None]
    M = scene.M / (scene.M @ a_inf)[:, None]
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
    P, H_hat = scale[:, None, None] * (P @ back), W @ scene.H_hat @ back
    return Projective(Scene(P, H_hat, scene.prismatic, M @ W.T, scene.lens), a_inf @ back, W, scale)


def _require_off_line(scene: Scene, errors: Errors) -> None:
    """Refuse markers that cannot be told from a line by their errors.

    A line is the span of two points; the markers must be off it by several times the noise of that distance,
    whatever frame and scale they are given: beside the gauge their scales are free.
    """
    M, factor = scene.M, errors.dense()
    first, m = len(factor) - M.size, len(M)
    scales = np.vstack([np.zeros((first, m)), block_diag(*M[:, :, None])])
    # One of the directions is a sum of others: all markers scaled at once.
    U, s, _ = np.linalg.svd(np.hstack([scene.gauge(), scales]), full_matrices=False)
    free = U[:, s > OPEN_DIRECTION * s[0]]
    markers = (factor - free @ (free.T @ factor))[first:]
    U, extent, Vt = np.linalg.svd(M, full_matrices=False)
    across = np.eye(m) - U[:, :2] @ U[:, :2].T
    noise = across @ (Vt[2:] @ markers.reshape(m, 4, -1)).reshape(m, -1)
    if extent[2] < _OFF_LINE * float(np.linalg.norm(noise)):
        raise WorkFailed(ON_A_LINE)


_LEAST_MARKERS = 5
# Parallax off the best plane, in units of the pixel noise, below which a body is coplanar.
_COPLANAR = 3.0
# Trials whose angle has a smaller sine are too close to 0 or ±180° for equation (4) under noise.
_LEAST_LEVER = 1e-3


def closed_form_operators(
    readings: Readings, F: FloatArray, sigma_px: float
) -> tuple[Projective, FloatArray, BoolArray]:
    """Projective kinematics from homographies of the trial motions, [RH00] eqs. (2), (4), (5).

    The operator of a joint is the mean over its trials weighted by sin² θ (or τ²), the least-squares
    weights of the quotients in (4) and (5). With the reference joints (n,), and which markers (m,) there are.

    Raises WorkFailed if the trials do not determine the operators: which joint, and why.
    """
    home = readings.home()
    if home is None:
        raise WorkFailed(
            "the closed_form method needs single-joint trials about one reference pose, and these poses move "
            "several joints at once: use refined"
        )
    both = readings.both
    P, points = reconstruct(F, readings.pixels[0][both], readings.pixels[1][both])
    M = np.full((len(readings.q), readings.marker.size, 4), np.nan)
    M[readings.pose_of[both], readings.marker_of[both]] = points
    known = np.isfinite(M[..., 0])
    if int(known[home].sum()) < _LEAST_MARKERS:
        raise WorkFailed(
            f"closed_form needs {_LEAST_MARKERS} markers in both images of the reference pose, and there are "
            f"{int(known[home].sum())}: use refined"
        )
    _require_space(P, M[home, known[home]], sigma_px)
    # The depth in the left camera is positive for all points: it orients them as a_inf would.
    trials = readings.trials(home)
    H_hat = np.array([_mean_operator(i, rows, M, home, readings, P[0, 2]) for i, rows in enumerate(trials)])
    a_inf = np.linalg.svd(np.hstack(list(H_hat)))[0][:, 3]
    sides = points @ a_inf
    a_inf = a_inf * np.sign(np.median(sides))
    scene = Scene(P, H_hat, readings.prismatic, M[home, known[home]])
    return _isotropic(scene, a_inf, points[np.abs(sides) > 1e-6]), readings.q[home], known[home]


def _mean_operator(
    i: int, rows: IntArray, M: FloatArray, home: int, readings: Readings, depth: FloatArray
) -> FloatArray:
    """Operator (4, 4) of joint i from its trials, the rows of M (K, m, 4) where it alone moved.

    Each says (H − H⁻¹) / (2 sin θ), or / (2 τ): [RH00] eqs. (4), (5) from group to algebra, weighted by the
    square of what it is divided by. ``depth`` (4,) is a plane that all points lie on one side of.
    """
    total, weights = np.zeros((4, 4)), 0.0
    refused = "record poses in which it alone moves"
    for k in rows:
        common = np.isfinite(M[[home, k], :, 0]).all(axis=0)
        amplitude = float(readings.q[k, i] - readings.q[home, i])
        lever = amplitude if readings.prismatic[i] else float(np.sin(amplitude))
        if int(common.sum()) < _LEAST_MARKERS:
            refused = f"fewer than {_LEAST_MARKERS} markers are common to a trial and the reference"
            continue
        if not readings.prismatic[i] and abs(lever) < _LEAST_LEVER:
            refused = f"a turn by {np.degrees(amplitude):.4g}° leaves equation (4) undefined"
            continue
        A, B = M[home, common], M[k, common]
        try:
            H = normalize_displacement(_homography(A, B), A, depth)
        except WorkFailed as error:
            raise WorkFailed(f"joint {i + 1}, pose {readings.pose[k]}: {error}") from None
        total += 0.5 * lever * (H - np.linalg.inv(H))
        weights += lever**2
    if weights == 0.0:
        raise WorkFailed(f"joint {i + 1} has no trial that can be used: {refused}")
    return total / weights


def _homography(A: FloatArray, B: FloatArray) -> FloatArray:
    """4×4 homography B ∼ H A of five or more points (m, 4) of unit norm, least squares of the cross products.

    Source: R. Hartley, A. Zisserman, Multiple View Geometry, 2nd ed., section 4.1, in space.
    """
    first, second = np.triu_indices(4, 1)
    rows = np.zeros((len(A), 6, 4, 4))
    k = np.arange(6)
    rows[:, k, first] += B[:, second, None] * A[:, None, :]
    rows[:, k, second] -= B[:, first, None] * A[:, None, :]
    return np.asarray(np.linalg.svd(rows.reshape(-1, 16))[2][15].reshape(4, 4))


def _require_space(P: FloatArray, points: FloatArray, sigma_px: float) -> None:
    """Refuse points (m, 4) of one plane up to the noise: the right image then follows from the left one."""
    plane = np.linalg.svd(points)[2][3]
    center = np.linalg.svd(P[0])[2][3]
    on_plane = points - np.outer(points @ plane / (center @ plane), center)
    seen, flat = points @ P[1].T, on_plane @ P[1].T
    parallax = np.linalg.norm(seen[:, :2] / seen[:, 2:] - flat[:, :2] / flat[:, 2:], axis=1)
    if float(np.sqrt((parallax**2).mean())) < _COPLANAR * sigma_px:
        raise WorkFailed(
            "the markers lie in one plane: a plane's motion does not determine a 4×4 homography; "
            "use refined, or move a marker off the plane"
        )
