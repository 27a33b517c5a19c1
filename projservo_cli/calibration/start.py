"""Screws of the joints in a guessed metric frame: axis directions first, then all places linearly."""

from dataclasses import dataclass

import numpy as np

from projservo_cli.calibration.body import Alignment
from projservo_cli.calibration.epipolar import MAD
from projservo_cli.calibration.readings import Readings
from projservo_cli.calibration.rotations import (
    cross,
    mean_rotation,
    rotation_about,
    rotation_exponential,
    rotation_vector,
)
from projservo_cli.records import BoolArray, FloatArray

STARTS = 20
ROTATION_STEPS = 60
# Minima with so many times the least loss are not worth a try: they do not explain the rotations.
UNLIKELY = 4.0
# Sets that differ less, rad, lie in one valley: along it the rotations hardly determine the axes, and
# images decide.
DISTINCT = 0.5
# Loss a pose beyond which axes contradict the rotations: a typical error of 45°, far more than a
# guessed metric frame or some wrong joint readings bring about.
CONTRADICTION = 5.5
# Pull of axis points towards the body, in units of the typical equation: keeps the axes of nearly
# parallel joints, whose places are hardly determined, from running away.
RIDGE = 0.03
# Least width of the loss on points, in units of their distance: the ridge's own bias must not weigh
# down the motions that show an axis best.
LEAST_SCALE = 1e-3


@dataclass(frozen=True, eq=False)
class Screws:
    """Joint operators as twists and markers at the reference, in a guessed metric frame.

    Attributes
    ----------
    H_hat : (n, 4, 4) twists: pure rotations of unit speed, translations of one common speed.
    body : (m, 3) markers at the reference joints.
    """

    H_hat: FloatArray
    body: FloatArray


def chain_rotations(w: FloatArray, q: FloatArray, prismatic: BoolArray) -> FloatArray:
    """Rotation parts of the truncated products of [RH00] eq. (6): (..., n + 1, K, 3, 3), first the identity.

    Parameters
    ----------
    w : (..., n, 3) unit axes.
    q : (K, n) joint values from the reference, rad.
    prismatic : (n,) joints that do not turn.
    """
    K, n = q.shape
    result = np.empty((*w.shape[:-2], n + 1, K, 3, 3))
    result[..., 0, :, :, :] = np.eye(3)
    for i in range(n):
        if prismatic[i]:
            result[..., i + 1, :, :, :] = result[..., i, :, :, :]
        else:
            turn = rotation_about(w[..., i, None, :], q[:, i])
            result[..., i + 1, :, :, :] = result[..., i, :, :, :] @ turn
    return result


def isolated_axes(R: FloatArray, q: FloatArray, prismatic: BoolArray) -> FloatArray | None:
    """Axis of each joint from the poses that differ from the reference in it alone, None if one has none.

    Parameters
    ----------
    R : (K, 3, 3) rotations of the poses.
    q : (K, n) joint values from the reference, rad.
    prismatic : (n,) joints that do not turn.
    """
    moved = np.abs(q) > 1e-6
    home = np.flatnonzero(~moved.any(axis=1))
    if home.size == 0:
        return None
    w = np.tile([0.0, 0.0, 1.0], (q.shape[1], 1))
    for i in np.flatnonzero(~prismatic):
        rows = np.flatnonzero(moved[:, i] & (moved.sum(axis=1) == 1))
        if rows.size == 0:
            return None
        vectors = rotation_vector(R[rows] @ R[home[0]].T)
        total = np.median(vectors * np.sign(q[rows, i])[:, None], axis=0)
        w[i] = total / max(float(np.linalg.norm(total)), 1e-12)
    return w


def rotation_axes(
    alignment: Alignment,
    q: FloatArray,
    prismatic: BoolArray,
    rng: np.random.Generator,
    keep: int,
    steps: int = ROTATION_STEPS,
) -> list[FloatArray]:
    """Axis directions that explain the rotations of the poses, the distinct minima, best first.

    Levenberg–Marquardt under a Cauchy loss on log(R_k R_predᵀ) from many random sets of axes at once,
    and from the axes that single-joint trials show directly.

    Parameters
    ----------
    alignment : rotations of the poses.
    q : (K, n) joint values from the reference, rad or m.
    prismatic : (n,) joints that do not turn.
    rng : draws the axes.
    keep : most sets to return.
    steps : of the search.

    Returns
    -------
    Sets of (n, 3) unit vectors, those of prismatic joints without meaning; none where no axes explain
    the rotations at all.
    """
    R, q = alignment.R[alignment.merged], q[alignment.merged]
    w = rng.standard_normal((STARTS, q.shape[1], 3))
    w /= np.linalg.norm(w, axis=2, keepdims=True)
    direct = isolated_axes(R, q, prismatic)
    if direct is not None:
        w[0] = direct
    w, loss = _fit_axes(w, R, q, prismatic, steps)
    order = np.argsort(loss)
    kept: list[FloatArray] = []
    enough = min(UNLIKELY * loss[order[0]] + 1e-9, CONTRADICTION * len(R))
    for s in order[loss[order] <= enough]:
        same = [np.abs((w[s] - other)[~prismatic]).max(initial=0.0) < DISTINCT for other in kept]
        if not any(same):
            kept.append(w[s])
        if len(kept) == keep:
            break
    return kept


def _fit_axes(
    w: FloatArray, R: FloatArray, q: FloatArray, prismatic: BoolArray, steps: int
) -> tuple[FloatArray, FloatArray]:
    """Levenberg–Marquardt for all starts at once: axes (S, n, 3) and losses (S,)."""
    S, n = w.shape[:2]
    chain = chain_rotations(w, q, prismatic)[:, n]
    base = mean_rotation(np.swapaxes(chain, -1, -2) @ R)
    damping = np.full(S, 1e-2)
    residual, J = _axis_residuals(w, base, R, q, prismatic)
    loss, weight = _cauchy(residual)
    for _ in range(steps):
        size = J.shape[-1]
        rows = J.reshape(S, -1, size)
        weighted = np.swapaxes(rows * np.repeat(weight, 3, axis=1)[..., None], 1, 2)
        A = weighted @ rows
        g = (weighted @ residual.reshape(S, -1, 1))[..., 0]
        A += (damping * np.trace(A, axis1=1, axis2=2) / size + 1e-12)[:, None, None] * np.eye(size)
        step = -np.linalg.solve(A, g[..., None]).reshape(S, n + 1, 3)
        turn = rotation_exponential(np.asarray(step, dtype=np.float64))
        w_new = np.einsum("snij,snj->sni", turn[:, :n], w)
        base_new = turn[:, n] @ base
        residual_new, J_new = _axis_residuals(w_new, base_new, R, q, prismatic)
        loss_new, weight_new = _cauchy(residual_new)
        better = loss_new <= loss
        damping = np.where(better, np.maximum(0.2 * damping, 1e-9), np.minimum(8.0 * damping, 1e6))
        settled = np.abs(loss - loss_new) < 1e-9 * loss
        w[better], base[better], residual[better], J[better] = (
            w_new[better], base_new[better], residual_new[better], J_new[better],
        )  # fmt: skip
        loss[better], weight[better] = loss_new[better], weight_new[better]
        if (settled | (damping >= 1e6)).all():
            break
    return w, loss


def _axis_residuals(
    w: FloatArray, base: FloatArray, R: FloatArray, q: FloatArray, prismatic: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Residuals log(R R_predᵀ) (S, K, 3) and derivative (S, K, 3, 3 (n + 1)) by turns of axes and base.

    A turn δ of axis i turns the prediction by (R̄_i−1 − R̄_i) δ, a turn of the base by R̄_n δ; the
    logarithm is taken to first order, which vanishes with the residual.
    """
    S, n = w.shape[:2]
    chain = chain_rotations(w, q, prismatic)
    residual = rotation_vector(R @ np.swapaxes(chain[:, n] @ base[:, None], -1, -2))
    J = np.empty((S, len(R), 3, n + 1, 3))
    for i in range(n):
        J[..., i, :] = chain[:, i + 1] - chain[:, i]
    J[..., n, :] = -chain[:, n]
    return residual, J.reshape(S, len(R), 3, 3 * (n + 1))


def _cauchy(residual: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Cauchy loss (S,) of rotations (S, K, 3) at a width of 0.05 rad, and the weights (S, K)."""
    square = (residual**2).sum(axis=2) / 0.05**2
    return np.log1p(square).sum(axis=1), 1.0 / (1.0 + square)


def place(w: FloatArray, points: FloatArray, readings: Readings, q: FloatArray) -> Screws:
    """Axis points, directions of translation and markers, linear in the points once all axes are known.

    A point of marker j at pose k is R̄_n X_j + Σ R̄_{i−1} ((I − R_i) p_i, or q_i v_i if prismatic):
    least squares under a Cauchy loss with a small ridge.

    Parameters
    ----------
    w : (n, 3) unit axes of the revolute joints.
    points : (N, 3) reconstruction of the sightings shared by both views.
    readings : what was seen; its rows with both views are those of ``points``.
    q : (K, n) joint values from the reference, rad or m.
    """
    n, m = w.shape[0], readings.marker.size
    pose_of, marker_of = readings.pose_of[readings.both], readings.marker_of[readings.both]
    chain = chain_rotations(w, q, readings.prismatic)
    center = np.median(points, axis=0)
    A = np.zeros((len(points), 3, n + m, 3))
    for i in range(n):
        if readings.prismatic[i]:
            A[:, :, i] = (chain[i] * q[:, i, None, None])[pose_of]
        else:
            A[:, :, i] = (chain[i] - chain[i + 1])[pose_of]
    A[np.arange(len(points)), :, n + marker_of] = chain[n][pose_of]
    # Axis points and markers are sought from the centre of the points; R̄_n 0 and R̄_i p vanish there
    # only after the centre's own motion is taken out.
    shift = np.zeros((n + m, 3))
    shift[:n][~readings.prismatic] = center
    shift[n:] = center
    rows = A.reshape(3 * len(points), -1)
    target = points.ravel() - rows @ shift.ravel()
    ridge = np.zeros((n + m, 3))
    ridge[:n][~readings.prismatic] = RIDGE
    x = _robust_solve(rows, target, ridge.ravel() ** 2).reshape(n + m, 3) + shift
    speed = np.linalg.norm(x[:n][readings.prismatic], axis=1)
    H_hat = np.zeros((n, 4, 4))
    for i in range(n):
        if readings.prismatic[i]:
            H_hat[i, :3, 3] = x[i] / np.linalg.norm(x[i]) * np.median(speed)
        else:
            H_hat[i, :3, :3] = cross(w[i])
            H_hat[i, :3, 3] = -np.cross(w[i], x[i])
    return Screws(H_hat, x[n:])


def _robust_solve(rows: FloatArray, target: FloatArray, ridge: FloatArray) -> FloatArray:
    """Least squares of three equations a point under a Cauchy loss by reweighting."""
    weight = np.ones(target.size // 3)
    for _ in range(10):
        W = np.repeat(weight, 3)
        A = (rows.T * W) @ rows + np.diag(ridge + 1e-9 * len(weight))
        x = np.linalg.solve(A, (rows.T * W) @ target)
        residual = np.linalg.norm((target - rows @ x).reshape(-1, 3), axis=1)
        scale = max(float(np.median(residual)) / MAD, LEAST_SCALE)
        weight = 1.0 / (1.0 + (residual / (2.0 * scale)) ** 2)
    return np.asarray(x)
