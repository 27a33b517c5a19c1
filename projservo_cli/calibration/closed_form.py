"""Joint operators by the closed forms of [RH00]: one 4×4 homography a trial motion, equations (4), (5)."""

import numpy as np

from projservo_cli.calibration.frame import ProjectiveScene, isotropic
from projservo_cli.calibration.readings import Readings, joint_trials, reference_pose
from projservo_cli.calibration.reconstruction import reconstruct
from projservo_cli.geometry.displacement import log_rotation, log_translation, normalize_displacement
from projservo_cli.records import BoolArray, FloatArray, WorkFailed

LEAST_MARKERS = 5
# Parallax off the best plane, in units of the pixel noise, below which a body is coplanar.
COPLANAR = 3.0
# Trials whose angle has a smaller sine are too close to 0 or ±180° for equation (4).
LEAST_SINE = 1e-3


def trials_of(readings: Readings, method: str) -> tuple[int, list[list[int]]]:
    """Row of the reference pose, and the rows of each joint's trials.

    Parameters
    ----------
    readings : what was seen.
    method : for the message.

    Raises
    ------
    WorkFailed
        If the poses are not single-joint trials, or a joint has none.
    """
    home = reference_pose(readings.q)
    if home is None:
        raise WorkFailed(
            f"the {method} method needs single-joint trials about one reference pose, and these poses move "
            "several joints at once: use refined"
        )
    trials = joint_trials(readings.q, home)
    for i, rows in enumerate(trials):
        if not rows:
            raise WorkFailed(f"joint {i + 1} has no trial motion: record poses in which it alone moves")
    return home, trials


def homography(A: FloatArray, B: FloatArray) -> FloatArray:
    """4×4 homography B ∼ H A of five or more points, by least squares of the cross ratios of coordinates.

    Source: R. Hartley, A. Zisserman, Multiple View Geometry, 2nd ed., section 4.1, in space.

    Parameters
    ----------
    A, B : (m, 4) points of unit norm.
    """
    first, second = np.triu_indices(4, 1)
    rows = np.zeros((len(A), 6, 4, 4))
    k = np.arange(6)
    rows[:, k, first] += B[:, second, None] * A[:, None, :]
    rows[:, k, second] -= B[:, first, None] * A[:, None, :]
    return np.asarray(np.linalg.svd(rows.reshape(-1, 16))[2][15].reshape(4, 4))


def require_space(P: FloatArray, points: FloatArray, sigma_px: float) -> None:
    """Refuse points of one plane: the right image then follows from the left one.

    Parameters
    ----------
    P : (2, 3, 4) cameras.
    points : (m, 4) points of unit norm.
    sigma_px : pixel noise.

    Raises
    ------
    WorkFailed
        If they are coplanar up to the noise.
    """
    plane = np.linalg.svd(points)[2][3]
    center = np.linalg.svd(P[0])[2][3]
    on_plane = points - np.outer(points @ plane / (center @ plane), center)
    seen, flat = points @ P[1].T, on_plane @ P[1].T
    parallax = np.linalg.norm(seen[:, :2] / seen[:, 2:] - flat[:, :2] / flat[:, 2:], axis=1)
    if float(np.sqrt((parallax**2).mean())) < COPLANAR * sigma_px:
        raise WorkFailed(
            "the markers lie in one plane: a plane's motion does not determine a 4×4 homography; "
            "use refined, or move a marker off the plane"
        )


def operators(
    readings: Readings, F: FloatArray, sigma_px: float
) -> tuple[ProjectiveScene, FloatArray, BoolArray]:
    """Projective kinematics from homographies of the trial motions, [RH00] eqs. (2), (4), (5).

    The operator of a joint is the mean over its trials weighted by sin² θ (or τ²), the least-squares
    weights of the quotients in (4) and (5).

    Parameters
    ----------
    readings : single-joint trials.
    F : (3, 3) fundamental matrix, px.
    sigma_px : pixel noise, for the refusal of coplanar markers.

    Returns
    -------
    The scene, the reference joints (n,), and which of the markers it holds (m,).

    Raises
    ------
    WorkFailed
        If the trials do not determine the operators: which joint, and why.
    """
    home, trials = trials_of(readings, "closed_form")
    both = readings.both
    view = reconstruct(F, readings.pixels[0][both], readings.pixels[1][both])
    M = np.full((len(readings.q), readings.marker.size, 4), np.nan)
    M[readings.pose_of[both], readings.marker_of[both]] = view.points
    known = np.isfinite(M[..., 0])
    if int(known[home].sum()) < LEAST_MARKERS:
        raise WorkFailed(
            f"closed_form needs {LEAST_MARKERS} markers in both images of the reference pose, and there are "
            f"{int(known[home].sum())}: use refined"
        )
    require_space(view.P, M[home, known[home]], sigma_px)
    # The depth in the left camera is positive for all points: it orients them as a_inf would.
    H_hat = np.array(
        [_mean_operator(i, rows, M, known, home, readings, view.P[0, 2]) for i, rows in enumerate(trials)]
    )
    a_inf = np.linalg.svd(np.hstack(list(H_hat)))[0][:, 3]
    sides = view.points @ a_inf
    a_inf = a_inf * np.sign(np.median(sides))
    scene = isotropic(view.P, H_hat, M[home, known[home]], a_inf, view.points[np.abs(sides) > 1e-6])
    return scene, readings.q[home], known[home]


def _mean_operator(
    i: int,
    rows: list[int],
    M: FloatArray,
    known: BoolArray,
    home: int,
    readings: Readings,
    depth: FloatArray,
) -> FloatArray:
    """Operator (4, 4) of joint i from its trials, the rows of ``M`` (K, m, 4) where it alone moved."""
    total, weights = np.zeros((4, 4)), 0.0
    refused = ""
    for k in rows:
        common = known[home] & known[k]
        amplitude = float(readings.q[k, i] - readings.q[home, i])
        lever = amplitude if readings.prismatic[i] else float(np.sin(amplitude))
        if int(common.sum()) < LEAST_MARKERS:
            refused = f"fewer than {LEAST_MARKERS} markers are common to a trial and the reference"
            continue
        if not readings.prismatic[i] and abs(lever) < LEAST_SINE:
            refused = f"a turn by {np.degrees(amplitude):.4g}° leaves equation (4) undefined"
            continue
        A, B = M[home, common], M[k, common]
        try:
            H = normalize_displacement(homography(A, B), A, depth)
        except WorkFailed as error:
            raise WorkFailed(f"joint {i + 1}, pose {readings.pose[k]}: {error}") from None
        logarithm = log_translation if readings.prismatic[i] else log_rotation
        total += lever**2 * logarithm(H, amplitude)
        weights += lever**2
    if weights == 0.0:
        raise WorkFailed(f"joint {i + 1} has no trial that can be used: {refused}")
    return total / weights
