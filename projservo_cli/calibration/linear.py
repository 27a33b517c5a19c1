"""Joint operators by the linear multi-frame method: whole trajectories at once, then twists."""

import numpy as np

from projservo_cli.calibration.adjustment import Scene
from projservo_cli.calibration.closed_form import trials_of
from projservo_cli.calibration.readings import Readings
from projservo_cli.calibration.reconstruction import Reconstruction, reconstruct
from projservo_cli.calibration.rotations import cross
from projservo_cli.records import BoolArray, FloatArray, WorkFailed

LEAST_MARKERS = 4


def trajectories(
    readings: Readings, view: Reconstruction, home: int
) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
    """Place and derivatives of each marker along the trials of every joint, from one null vector each.

    In M(θ) = M0 + sin θ V + (1 − cos θ) W, [RH00] eq. (4) applied to a point, or M0 + τ V by eq. (5),
    all images of a marker are linear in M0 and the V_i, W_i of all joints, with one common scale.

    Parameters
    ----------
    readings : single-joint trials.
    view : projective reconstruction.
    home : row of the reference pose.

    Returns
    -------
    M0 (m, 4), V and W (n, m, 4), and which markers (m,) were seen often enough.
    """
    n, m = readings.q.shape[1], readings.marker.size
    q = readings.q - readings.q[home]
    basis = np.concatenate(
        [
            np.ones((len(q), 1)),
            np.where(readings.prismatic, q, np.sin(q)),
            np.where(readings.prismatic, 0.0, 1.0 - np.cos(q)),
        ],
        axis=1,
    )
    # Prismatic joints have no W: its column would be free.
    present = np.concatenate([np.ones(1 + n, dtype=bool), ~readings.prismatic])
    x = np.zeros((m, 1 + 2 * n, 4))
    known = np.zeros(m, dtype=bool)
    pixel_size = [np.abs(readings.pixels[v][readings.seen[v]]).max() for v in (0, 1)]
    for j in range(m):
        rows = []
        for v in (0, 1):
            k = np.flatnonzero((readings.marker_of == j) & readings.seen[v])
            camera = readings.pixels[v, k][..., None] * view.P[v, 2] - view.P[v, :2]
            camera = camera / pixel_size[v]
            factors = basis[readings.pose_of[k]][:, present]
            rows.append(np.einsum("kb,krc->krbc", factors, camera).reshape(2 * len(k), -1))
        A = np.concatenate(rows)
        known[j] = len(A) >= A.shape[1] - 1
        if known[j]:
            x[j, present] = np.linalg.svd(A)[2][A.shape[1] - 1].reshape(-1, 4)
    V, W = np.swapaxes(x[:, 1 : 1 + n], 0, 1), np.swapaxes(x[:, 1 + n :], 0, 1)
    return x[:, 0], V, W, known


def operators(readings: Readings, F: FloatArray) -> tuple[Scene, FloatArray, BoolArray]:
    """Scene from linear equations alone, its operators twists wherever noise has left them a metric.

    Where no positive quadratic form is kept by all revolute operators the frame stays affine and the
    operators as the equations gave them: a result for comparison only, as its residuals will say.

    Parameters
    ----------
    readings : single-joint trials.
    F : (3, 3) fundamental matrix, px.

    Returns
    -------
    The scene, the reference joints (n,), and which of the markers it holds (m,).

    Raises
    ------
    WorkFailed
        If the poses are no single-joint trials, or too few markers were seen along them.
    """
    home, _ = trials_of(readings, "linear")
    both = readings.both
    view = reconstruct(F, readings.pixels[0][both], readings.pixels[1][both])
    M, V, W, known = trajectories(readings, view, home)
    if int(known.sum()) < LEAST_MARKERS:
        raise WorkFailed(
            f"linear needs {LEAST_MARKERS} markers seen along the trials of every joint: use refined"
        )
    M, V, W = M[known], V[:, known], W[:, known]
    scale = np.linalg.norm(M, axis=1)
    M, V, W = M / scale[:, None], V / scale[:, None], W / scale[:, None]
    # No velocity leaves a plane a_inf·M = constant: it is the left null vector of all of them.
    a_inf = np.linalg.svd(np.concatenate([V, W]).reshape(-1, 4))[2][3]
    depth = M @ a_inf
    M, V, W = M / depth[:, None], V / depth[:, None], W / depth[:, None]
    to_affine = np.linalg.inv(_affine_frame(a_inf, M))
    H_hat = np.array([_operator(M, V[i], W[i], bool(slides)) for i, slides in enumerate(readings.prismatic)])
    H_hat = to_affine @ H_hat @ np.linalg.inv(to_affine)
    # To first order a velocity is parallel to the plane at infinity; exactly so from here on.
    H_hat[:, 3] = 0.0
    frame = to_affine
    metric = _metric_frame(H_hat[~readings.prismatic, :3, :3])
    if metric is not None:
        to_metric = np.eye(4)
        to_metric[:3, :3] = metric
        H_hat = _twists(to_metric @ H_hat @ np.linalg.inv(to_metric), readings.prismatic)
        frame = to_metric @ to_affine
    M = M @ frame.T
    return Scene(view.P @ np.linalg.inv(frame), H_hat, M / M[:, 3:]), readings.q[home], known


def _operator(M: FloatArray, V: FloatArray, W: FloatArray, slides: bool) -> FloatArray:
    """Operator (4, 4) with Ĥ M = V and Ĥ V = W (zero for a translation), least squares over the markers."""
    sources = np.concatenate([M, V])
    targets = np.concatenate([V, np.zeros_like(V) if slides else W])
    return np.asarray(np.linalg.lstsq(sources, targets, rcond=None)[0].T)


def _affine_frame(a_inf: FloatArray, M: FloatArray) -> FloatArray:
    """Columns (4, 4): three orthonormal points on the plane at infinity, and the mean marker off it."""
    return np.column_stack([np.linalg.svd(a_inf[None])[2][1:].T, M.mean(axis=0)])


def _metric_frame(B: FloatArray) -> FloatArray | None:
    """Frame change (3, 3) after which the blocks (r, 3, 3) of revolute operators are antisymmetric.

    The quadratic form Q that all of them keep, Bᵀ Q + Q B = 0, is linear in its six entries; with
    Q = Sᵀ S the change is S. None where that form is not positive, as happens under noise.
    """
    if len(B) == 0:
        return np.eye(3)
    basis = []
    for i, j in zip(*np.triu_indices(3), strict=True):
        E = np.zeros((3, 3))
        E[i, j] = E[j, i] = 1.0
        basis.append(E)
    rows = np.array([(np.swapaxes(B, 1, 2) @ E + E @ B).ravel() for E in basis]).T
    Q = np.tensordot(np.linalg.svd(rows)[2][5], np.array(basis), axes=1)
    Q = Q * np.sign(np.trace(Q))
    values = np.linalg.eigvalsh(Q)
    if not values[0] > 1e-6 * values[2]:
        return None
    return np.asarray(np.linalg.cholesky(Q).T)


def _twists(H_hat: FloatArray, prismatic: BoolArray) -> FloatArray:
    """Nearest rotations of unit speed without pitch, and translations of one common speed."""
    result = np.zeros_like(H_hat)
    speed = np.median(np.linalg.norm(H_hat[prismatic, :3, 3], axis=1)) if prismatic.any() else 0.0
    for i, slides in enumerate(prismatic):
        v = H_hat[i, :3, 3]
        if slides:
            result[i, :3, 3] = v / np.linalg.norm(v) * speed
            continue
        S = 0.5 * (H_hat[i, :3, :3] - H_hat[i, :3, :3].T)
        w = np.array([S[2, 1], S[0, 2], S[1, 0]])
        w /= np.linalg.norm(w)
        result[i, :3, :3] = cross(w)
        result[i, :3, 3] = v - w * (w @ v)
    return result
