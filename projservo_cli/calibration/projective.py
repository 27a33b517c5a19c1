"""Projective kinematics of [RH00] section 2: P, Ĥ, M and the plane at infinity, with their covariance."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from projservo_cli.calibration.bundle_adjustment import moved_operators
from projservo_cli.calibration.detections import MAX_JUDGED, ON_A_LINE, even_choice
from projservo_cli.calibration.prediction import Parameters
from projservo_cli.calibration.robust_fit import OPEN_DIRECTION, Solution
from projservo_cli.records import Errors, FloatArray, WorkFailed

# Minimum distance of the markers from their best line, in units of its noise.
_OFF_LINE = 5.0
# Plane at infinity of the frame of the adjustment.
_A_INF = np.array([0.0, 0.0, 0.0, 1.0])


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

        errors : as of ``Solution.errors``.
        Raises WorkFailed if the markers cannot be distinguished from a line.
        """
        found = self._in_frame(solution, errors)
        few = even_choice(len(self.params.M), MAX_JUDGED)
        _require_off_line(replace(self.params, M=self.params.M[few]), found.of(few).scaled(solution.sigma_px))
        return found

    def bias(self, solution: Solution, bias: FloatArray) -> FloatArray:
        """Errors (p, k) of P, H_hat, lenses and M by the errors of the parameters, of the markers judged.

        Markers beyond follow no separate error.
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
        problem, by_marker = solution.problem, self.W[:, :3]
        own, of_boards = np.split(errors.shared, [problem.curved.stop])
        lenses = np.eye(len(own) - problem.joint[-1])
        shared = block_diag(*cameras, *joints, lenses) @ own
        marker = errors.marker + problem.markers_by_boards(solution.params) @ of_boards
        return Errors(shared, by_marker @ marker, by_marker @ errors.own)

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

    A line is the span of two points. The markers must be off it by several times the noise of this distance,
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
