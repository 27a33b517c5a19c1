"""Joint operators by the closed forms of [RH00]: one 4×4 homography a trial motion, equations (4), (5)."""

import numpy as np

from projservo_cli.calibration.covariance import ProjectiveScene, isotropic
from projservo_cli.calibration.epipolar import reconstruct
from projservo_cli.calibration.readings import Readings
from projservo_cli.geometry.displacement import normalize_displacement
from projservo_cli.records import BoolArray, FloatArray, IntArray, WorkFailed

_LEAST_MARKERS = 5
# Parallax off the best plane, in units of the pixel noise, below which a body is coplanar.
_COPLANAR = 3.0
# Trials whose angle has a smaller sine are too close to 0 or ±180° for equation (4) under noise.
_LEAST_LEVER = 1e-3


def closed_form_operators(
    readings: Readings, F: FloatArray, sigma_px: float
) -> tuple[ProjectiveScene, FloatArray, BoolArray]:
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
    scene = isotropic(P, H_hat, M[home, known[home]], a_inf, points[np.abs(sides) > 1e-6])
    return scene, readings.q[home], known[home]


def _mean_operator(
    i: int, rows: IntArray, M: FloatArray, home: int, readings: Readings, depth: FloatArray
) -> FloatArray:
    """Operator (4, 4) of joint i from its trials, the rows of M (K, m, 4) where it alone moved.

    Each says (H − H⁻¹) / (2 sin θ), or / (2 τ): [RH00] eqs. (4), (5) from group to algebra, weighted by the
    square of what it is divided by.

    ``depth`` (4,) is a plane that all points lie on one side of.
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
