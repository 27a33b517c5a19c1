"""Projective kinematics: P, Ĥ, M and the plane at infinity of [RH00] section 2.

From adjusted parameters with their covariance, or by the paper's closed forms: one 4×4 homography a trial
motion, equations (4), (5).
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from projservo_cli.calibration.bundle_adjustment import moved_operators
from projservo_cli.calibration.detections import MAX_JUDGED, ON_A_LINE, Detections, even_choice
from projservo_cli.calibration.epipolar import reconstruct
from projservo_cli.calibration.prediction import Parameters
from projservo_cli.calibration.robust_fit import OPEN_DIRECTION, Solution
from projservo_cli.geometry.displacements import normalize_displacement
from projservo_cli.records import BoolArray, Errors, FloatArray, IntArray, WorkFailed

# Minimum distance of the markers from their best line, in units of its noise.
_OFF_LINE = 5.0
# Plane at infinity of the frame of the adjustment.
_A_INF = np.array([0.0, 0.0, 0.0, 1.0])
# Minimum number of markers common to a trial and the reference, by which a 4×4 homography is determined.
_MIN_MARKERS = 5
# Parallax off the best plane, in units of the pixel noise, below which a body is coplanar.
_COPLANAR = 3.0
# Minimum sine of the angle of a trial: near 0 and ±180° noise dominates equation (4).
_MIN_LEVER = 1e-3


@dataclass(frozen=True, eq=False)
class Projective:
    """Parameters in their isotropic projective frame."""

    # depths of the points seen are positive, of unit mean square a view; a_inf @ M = 1
    params: Parameters
    a_inf: FloatArray  # (4,) plane at infinity
    W: FloatArray  # (4, 4) frame change from the original frame
    camera_scale: FloatArray  # (2,) factors on the cameras

    @classmethod
    def of(cls, solution: Solution) -> "Projective":
        """Transform a solution to the isotropic projective frame of the points seen."""
        problem, detections = solution.problem, solution.problem.detections
        moved = solution.params.moved(problem.q, detections.pose_of, detections.marker_of)
        return _isotropic(solution.params, _A_INF, moved)

    def errors(self, solution: Solution, errors: Errors) -> Errors:
        """Errors of P, H_hat, k1 and k2 if lenses are estimated, and M, at a noise of one pixel.

        errors : those of ``Solution.errors``.
        Raises WorkFailed if the markers cannot be distinguished from a line.
        """
        found = self._in_frame(solution, errors)
        few = even_choice(len(self.params.M), MAX_JUDGED)
        _require_off_line(replace(self.params, M=self.params.M[few]), found.of(few).scaled(solution.sigma_px))
        return found

    def bias(self, solution: Solution, bias: FloatArray) -> FloatArray:
        """Errors (p, k) of P, H_hat, lenses and M by those of the parameters, of the markers judged.

        Markers beyond follow no error of their own.
        """
        m, s = len(self.params.M), solution.problem.shared
        marker = np.zeros((m, 3, bias.shape[1]))
        marker[solution.judged_markers] = bias[s:].reshape(-1, 3, bias.shape[1])
        found = self._in_frame(solution, Errors(bias[:s], marker, np.zeros((m, 3, 0))))
        return np.concatenate([found.shared, found.marker.reshape(-1, bias.shape[1])])

    def _in_frame(self, solution: Solution, errors: Errors) -> Errors:
        """Errors of the parameters of a solution, of P, H_hat, lenses and M in this frame."""
        back = np.linalg.inv(self.W)
        cameras = [scale * np.kron(np.eye(3), back.T) for scale in self.camera_scale]
        joints = [(self.W @ moved @ back).reshape(-1, 16).T for moved in moved_operators(solution.params)]
        lenses = np.eye(solution.problem.shared - solution.problem.joint[-1])
        by_marker = self.W[:, :3]
        shared = block_diag(*cameras, *joints, lenses) @ errors.shared
        return Errors(shared, by_marker @ errors.marker, by_marker @ errors.own)

    def defects(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Defects (n,) of [RH00] section 2: of Ĥ³ = −Ĥ or Ĥ² = 0, of zero trace, of one plane at infinity."""
        H_hat, prismatic = self.params.H_hat, self.params.prismatic
        square = H_hat @ H_hat
        law = np.where(prismatic[:, None, None], square, square @ H_hat + H_hat)
        return (
            np.linalg.norm(law, axis=(1, 2)) / np.linalg.norm(H_hat, axis=(1, 2)),
            np.abs(np.trace(H_hat, axis1=1, axis2=2)),
            np.linalg.norm(self.a_inf @ H_hat, axis=1) / np.linalg.norm(self.a_inf),
        )


def _isotropic(params: Parameters, a_inf: FloatArray, moved: FloatArray) -> Projective:
    """Transform to the frame in which points seen, ``moved`` (N, 4), have the identity as second moment.

    The left camera fixes the remaining rotation: its depth row and then its two image rows are triangular,
    its centre lies along the fourth axis on the positive side of ``a_inf``. So the frame depends on the
    images alone, and the result on no original frame.
    """
    P = params.P
    points = moved / (moved @ a_inf)[:, None]
    M = params.M / (params.M @ a_inf)[:, None]
    try:
        L = np.linalg.cholesky(points.T @ points / len(points))
    except np.linalg.LinAlgError:
        raise WorkFailed(
            "the fit leaves all markers at all poses in one plane: the images do not show the depth; move "
            "the joints farther, or add a camera"
        ) from None
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
    P, H_hat = scale[:, None, None] * (P @ back), W @ params.H_hat @ back
    moved_frame = replace(params, P=P, H_hat=H_hat, M=M @ W.T, offsets=None)
    return Projective(moved_frame, a_inf @ back, W, scale)


def _require_off_line(params: Parameters, errors: Errors) -> None:
    """Refuse markers that their errors do not distinguish from a line.

    A line is the span of two points. The markers must be off it by several times the noise of that distance,
    in any frame and scale: the gauge and their scales are free.
    """
    M, factor = params.M, errors.dense()
    first, m = len(factor) - M.size, len(M)
    scales = np.vstack([np.zeros((first, m)), block_diag(*M[:, :, None])])
    # One of the directions is a sum of others: all markers scaled at once.
    U, s, _ = np.linalg.svd(np.hstack([params.gauge(), scales]), full_matrices=False)
    free = U[:, s > OPEN_DIRECTION * s[0]]
    markers = (factor - free @ (free.T @ factor))[first:]
    U, extent, Vt = np.linalg.svd(M, full_matrices=False)
    across = np.eye(m) - U[:, :2] @ U[:, :2].T
    noise = across @ (Vt[2:] @ markers.reshape(m, 4, -1)).reshape(m, -1)
    if extent[2] < _OFF_LINE * float(np.linalg.norm(noise)):
        raise WorkFailed(ON_A_LINE)


def closed_form_operators(
    detections: Detections, F: FloatArray, sigma_px: float
) -> tuple[Projective, FloatArray, BoolArray]:
    """Projective kinematics from homographies of the trial motions, [RH00] eqs. (2), (4), (5).

    The operator of a joint is the mean over its trials weighted by sin² θ (or τ²), the least-squares
    weights of the quotients in (4) and (5). Returns the reference joints (n,) and a mask of markers (m,) too.

    Raises WorkFailed if the trials do not determine the operators: which joint, and why.
    """
    home = detections.home()
    if home is None:
        raise WorkFailed(
            "the closed_form method needs single-joint trials about one reference pose, and these poses move "
            "several joints at once: use bundle_adjustment"
        )
    both = detections.both
    P, points = reconstruct(F, detections.pixels[0][both], detections.pixels[1][both])
    M = np.full((len(detections.q), detections.marker.size, 4), np.nan)
    M[detections.pose_of[both], detections.marker_of[both]] = points
    known = np.isfinite(M[..., 0])
    if int(known[home].sum()) < _MIN_MARKERS:
        raise WorkFailed(
            f"closed_form needs {_MIN_MARKERS} markers in both images of the reference pose, and there are "
            f"{int(known[home].sum())}: use bundle_adjustment"
        )
    _require_space(P, M[home, known[home]], sigma_px)
    # The depth in the left camera, positive for all points, orients them as a_inf would.
    trials = detections.trials(home)
    H_hat = np.array([_mean_operator(i, rows, M, home, detections, P[0, 2]) for i, rows in enumerate(trials)])
    a_inf = np.linalg.svd(np.hstack(list(H_hat)))[0][:, 3]
    sides = points @ a_inf
    a_inf = a_inf * np.sign(np.median(sides))
    params = Parameters(P, H_hat, detections.prismatic, M[home, known[home]])
    return _isotropic(params, a_inf, points[np.abs(sides) > 1e-6]), detections.q[home], known[home]


def _mean_operator(
    i: int, rows: IntArray, M: FloatArray, home: int, detections: Detections, depth: FloatArray
) -> FloatArray:
    """Operator (4, 4) of joint i from its trials, the rows of M (K, m, 4) where it alone moved.

    Each trial gives (H − H⁻¹) / (2 sin θ), or / (2 τ), [RH00] eqs. (4), (5) from group to algebra, with the
    square of the divisor as weight. ``depth`` (4,) is a plane with all points on one side.
    """
    total, weights = np.zeros((4, 4)), 0.0
    refused = "record poses in which it alone moves"
    for k in rows:
        common = np.isfinite(M[[home, k], :, 0]).all(axis=0)
        amplitude = float(detections.q[k, i] - detections.q[home, i])
        lever = amplitude if detections.prismatic[i] else float(np.sin(amplitude))
        if int(common.sum()) < _MIN_MARKERS:
            refused = f"fewer than {_MIN_MARKERS} markers are common to a trial and the reference"
            continue
        if not detections.prismatic[i] and abs(lever) < _MIN_LEVER:
            refused = f"a turn by {np.degrees(amplitude):.4g}° leaves equation (4) undefined"
            continue
        A, B = M[home, common], M[k, common]
        try:
            H = normalize_displacement(_homography(A, B), A, depth)
        except WorkFailed as error:
            raise WorkFailed(f"joint {detections.numbers[i]}, pose {detections.pose[k]}: {error}") from None
        total += 0.5 * lever * (H - np.linalg.inv(H))
        weights += lever**2
    if weights == 0.0:
        raise WorkFailed(f"joint {detections.numbers[i]} has no usable trial: {refused}")
    return total / weights


def _homography(A: FloatArray, B: FloatArray) -> FloatArray:
    """4×4 homography B ∼ H A of five or more unit points (m, 4), by least squares of the cross products.

    Source: R. Hartley, A. Zisserman, Multiple View Geometry, 2nd ed., section 4.1, in space.
    """
    first, second = np.triu_indices(4, 1)
    rows = np.zeros((len(A), 6, 4, 4))
    k = np.arange(6)
    rows[:, k, first] += B[:, second, None] * A[:, None, :]
    rows[:, k, second] -= B[:, first, None] * A[:, None, :]
    return np.asarray(np.linalg.svd(rows.reshape(-1, 16))[2][15].reshape(4, 4))


def _require_space(P: FloatArray, points: FloatArray, sigma_px: float) -> None:
    """Refuse points (m, 4) in one plane up to the noise, where the left image determines the right one."""
    plane = np.linalg.svd(points)[2][3]
    center = np.linalg.svd(P[0])[2][3]
    on_plane = points - np.outer(points @ plane / (center @ plane), center)
    in_space, flat = points @ P[1].T, on_plane @ P[1].T
    parallax = np.linalg.norm(in_space[:, :2] / in_space[:, 2:] - flat[:, :2] / flat[:, 2:], axis=1)
    if float(np.sqrt((parallax**2).mean())) < _COPLANAR * sigma_px:
        raise WorkFailed(
            "the markers lie in one plane: a plane's motion does not determine a 4×4 homography; "
            "use bundle_adjustment, or move a marker off the plane"
        )
