"""Initialization of the adjustment: in a guessed metric frame markers, axes, then all places.

Or from what is known of a robot and its rig beforehand, which is tried and never trusted.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from projservo_cli.calibration.adjustment import LeastSquares, cross_matrix
from projservo_cli.calibration.epipolar import (
    Epipolar,
    ImageFrame,
    log_distances,
    marker_pairs,
    metric_guesses,
)
from projservo_cli.calibration.prediction import Scene
from projservo_cli.calibration.readings import MAD, Readings, per_block
from projservo_cli.geometry.kinematics import forward_kinematics, joint_operators
from projservo_cli.records import (
    PRISMATIC,
    REVOLUTE,
    BoolArray,
    FloatArray,
    InputError,
    IntArray,
    Model,
    WorkFailed,
)

Tell = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False)
class Search:
    """What a search for the maximum likelihood works on."""

    problem: LeastSquares
    epipolar: Epipolar
    frame: ImageFrame
    rng: np.random.Generator
    tell: Tell  # told what is done, how much of it, and of how much
    joint_noise: float | None = 0.0  # rms of joint readings less true joints, rad; None to estimate it


# Shared markers that carry an alignment: four resist one wrong marker, three are the least.
_SAFE, _LEAST = 4, 3
_ROUNDS, _TRIPLES = 8, 60
# Markers that scatter so much more than most are not of the body; poses so full may be the first.
_LOOSE, _FULL = 6.0, 0.8


# Sightings by both views wanted at each pose of markers to start from; markers below which all are taken.
_WANTED, _FEW = 25, 40
# Motion in the images below which a marker stands still: in units of the noise, and of that of most markers.
_STILL, _STILL_SHARE = 6.0, 0.05


def still(readings: Readings, noise_px: float) -> BoolArray:
    """Which markers (m,) move in no image, as what is no part of the robot."""
    move = np.zeros((readings.marker.size, 2))
    for v in (0, 1):
        rows = np.flatnonzero(readings.seen[v])
        low, high = np.full((2, readings.marker.size, 2), [[[np.inf]], [[-np.inf]]])
        np.minimum.at(low, readings.marker_of[rows], readings.pixels[v, rows])
        np.maximum.at(high, readings.marker_of[rows], readings.pixels[v, rows])
        move[:, v] = np.where(np.isfinite(low), high - low, 0.0).max(axis=1)
    moved = move.max(axis=1)
    often = readings.count_of(readings.seen) > 2
    limit = max(_STILL * noise_px, _STILL_SHARE * float(np.percentile(moved, 75)))
    return np.asarray(often & (moved <= limit))


def carrying(readings: Readings, noise_px: float, rng: np.random.Generator) -> BoolArray:
    """Markers (m,) to start from: moving ones, long seen, and no more than each pose needs."""
    m, both = readings.marker.size, readings.both
    moving = ~still(readings, noise_px)
    if m <= _FEW:
        return moving if moving.sum() >= _WANTED else np.ones(m, dtype=bool)
    rows = np.flatnonzero(both)
    count = np.bincount(readings.marker_of[rows], minlength=m)
    edge = np.cumsum(count) - count
    lack = np.full(len(readings.q), _WANTED)
    chosen = np.zeros(m, dtype=bool)
    for j in np.lexsort((rng.random(m), -np.minimum(count, np.median(count)), ~moving)):
        poses = readings.pose_of[rows[edge[j] : edge[j] + count[j]]]
        if count[j] > 1 and (lack[poses] > 0).any():
            chosen[j] = True
            lack[poses] -= 1
    return chosen


@dataclass(frozen=True, eq=False)
class _Alignment:
    """The body in its own frame and its rigid motion to each pose."""

    body: FloatArray  # (m, 3) markers, NaN where never merged, or not rigid
    R: FloatArray  # (K, 3, 3) rotations from the body to the pose
    merged: BoolArray  # (K,) poses whose rotation is known


def _merged(reconstructed: FloatArray, readings: Readings, rng: np.random.Generator) -> _Alignment:
    """Body and poses from the points (N, 3) that both cameras saw, grown from the fullest pose."""
    K, both = len(readings.q), readings.both
    points = np.zeros((K, readings.marker.size, 3))
    seen = np.zeros(points.shape[:2], dtype=bool)
    where = readings.pose_of[both], readings.marker_of[both]
    points[where], seen[where] = reconstructed, True
    R, t = np.tile(np.eye(3), (K, 1, 1)), np.zeros((K, 3))
    seed = _seed(reconstructed, *where)
    body = np.where(seen[seed][:, None], points[seed], np.nan)
    found = np.arange(K) == seed
    for shared in (_SAFE, _LEAST, _LEAST):
        grown = True
        while grown:
            known = np.isfinite(body[:, 0])
            usable = seen & known
            rows = usable.sum(axis=1) >= max(min(shared, int(known.sum())), _LEAST)
            for k in np.flatnonzero(rows & ~found):
                R[k], t[k] = _consensus(body[usable[k]], points[k, usable[k]], rng)
            if rows.any():
                filled = np.where(known[:, None], body, 0.0)
                R[rows], t[rows] = _robust_align(filled, points[rows], usable[rows], (R[rows], t[rows]))
            grown = bool((rows & ~found).any())
            found |= rows
            local = np.einsum("kji,kmj->kmi", R, points - t[:, None])
            body = _rigid(np.where((seen & found[:, None])[..., None], local, np.nan))
            grown |= int(np.isfinite(body[:, 0]).sum()) > int(known.sum())
    return _Alignment(body, R, found)


def _rigid(local: FloatArray) -> FloatArray:
    """Median places (m, 3) of what poses show (K, m, 3), NaN where they scatter much more than most."""
    body = np.full(local.shape[1:], np.nan)
    some = np.isfinite(local[..., 0]).any(axis=0)
    body[some] = np.nanmedian(local[:, some], axis=0)
    scatter = np.full(len(body), np.nan)
    scatter[some] = np.nanmedian(np.linalg.norm(local[:, some] - body[some], axis=2), axis=0)
    twice = np.isfinite(local[..., 0]).sum(axis=0) > 1
    if twice.any():
        body[twice & (scatter > _LOOSE * np.median(scatter[twice]))] = np.nan
    return body


def _align(body: FloatArray, points: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rigid motions (K, 3, 3), (K, 3) of bodies (…, m, 3) to points (K, m, 3) of weights (K, m).

    Source: S. Umeyama, "Least-squares estimation of transformation parameters between two point
    patterns", PAMI 13(4), 1991. All poses at once: ``Rotation.align_vectors`` takes them one by one.
    """
    share = (weight / weight.sum(axis=1)[:, None])[:, None]
    center_body, center_points = (share @ body)[:, 0], (share @ points)[:, 0]
    moments = np.swapaxes(points - center_points[:, None], 1, 2) @ (
        weight[..., None] * (body - center_body[:, None])
    )
    U, _, Vt = np.linalg.svd(moments)
    U[:, :, 2] *= np.sign(np.linalg.det(U) * np.linalg.det(Vt))[:, None]
    R = U @ Vt
    return R, center_points - np.einsum("kij,kj->ki", R, center_body)


def _consensus(
    body: FloatArray, points: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """The rigid motion of three of the places (m, 3) that leaves the least median distance of points (m, 3).

    P. J. Rousseeuw, "Least median of squares regression", JASA 79, 1984: half of them may be wrong.
    """
    m = len(body)
    three = np.argsort(rng.random((_TRIPLES, m)), axis=1)[:, :_LEAST]
    R, t = _align(body[three], points[three], np.ones(three.shape))
    distance = np.sort(np.linalg.norm(points - body @ np.swapaxes(R, 1, 2) - t[:, None], axis=2), axis=1)
    best = int(np.argmin(distance[:, min(max(m // 2, _LEAST + 1), m - 1)]))
    return R[best], t[best]


def _robust_align(
    body: FloatArray, points: FloatArray, seen: BoolArray, motion: tuple[FloatArray, FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """``_align`` under a Cauchy loss by reweighting from some motions, its scale the median residual."""
    R, t = motion
    for _ in range(_ROUNDS):
        residual = np.linalg.norm(points - body @ np.swapaxes(R, 1, 2) - t[:, None], axis=2)
        scale = max(float(np.median(residual[seen])) / MAD, 1e-12)
        R, t = _align(body, points, np.where(seen, 1.0 / (1.0 + (residual / (2.0 * scale)) ** 2), 0.0))
    return R, t


def _seed(points: FloatArray, pose_of: IntArray, marker_of: IntArray) -> int:
    """Of the full poses that whose points (N, 3) lie most nearly as in the other poses that show them."""
    pairs = marker_pairs(pose_of, marker_of)
    deviation, compared = log_distances(points, pairs)
    count = np.bincount(pose_of)
    full = np.flatnonzero(count >= _FULL * count.max())
    at = pose_of[pairs[0]]
    typical = [
        np.median(deviation[(at == k) & compared]) if (compared & (at == k)).any() else np.inf for k in full
    ]
    return int(full[np.argmin(typical)])


_STARTS, _TURNS, _MOST_SETS = 20, 60, 3
# Minima with so many times the least loss are not worth a try: they do not explain the rotations.
_UNLIKELY = 4.0
# Sets that differ less, rad, lie in one valley: along it the rotations hardly determine the axes, and
# images decide.
_DISTINCT = 0.5
# Loss a pose beyond which axes contradict the rotations: a typical error of 45°, far more than a
# guessed metric frame or some wrong joint readings bring about.
_CONTRADICTION = 5.5
# Residual, rad, beyond which the loss on rotations flattens.
_WIDTH = 0.05


def _rotation_axes(
    alignment: _Alignment,
    q: FloatArray,
    prismatic: BoolArray,
    rng: np.random.Generator,
) -> list[FloatArray]:
    """Sets of axes (n, 3) that explain the rotations at joint values (K, n), distinct minima, best first.

    From many random sets. None where no axes explain the rotations at all; axes of prismatic joints have no
    meaning.
    """
    R, q = alignment.R[alignment.merged], q[alignment.merged]
    w = rng.standard_normal((_STARTS, q.shape[1], 3))
    w /= np.linalg.norm(w, axis=2, keepdims=True)
    w, loss = _fit_axes(w, R, q, prismatic)
    order = np.argsort(loss)
    kept: list[FloatArray] = []
    enough = min(_UNLIKELY * loss[order[0]] + 1e-9, _CONTRADICTION * len(R))
    for s in order[loss[order] <= enough]:
        if not any(np.abs((w[s] - other)[~prismatic]).max(initial=0.0) < _DISTINCT for other in kept):
            kept.append(w[s])
        if len(kept) == _MOST_SETS:
            break
    return kept


def _rotations(vectors: FloatArray) -> FloatArray:
    """Rotations (…, 3, 3) of rotation vectors (…, 3), rad; SciPy takes one dimension of them."""
    return np.asarray(Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(*vectors.shape, 3))


def _rotation_vectors(R: FloatArray) -> FloatArray:
    """Rotation vectors (…, 3) of rotations (…, 3, 3), rad."""
    return np.asarray(Rotation.from_matrix(R.reshape(-1, 3, 3)).as_rotvec().reshape(R.shape[:-1]))


def _chain(w: FloatArray, q: FloatArray, prismatic: BoolArray) -> FloatArray:
    """Rotation parts of the truncated products of [RH00] eq. (6): (…, n + 1, K, 3, 3), first the identity.

    From unit axes (…, n, 3) and joint values (K, n) from the reference, rad.
    """
    K, n = q.shape
    turns = _rotations(w[..., :, None, :] * np.where(prismatic, 0.0, q).T[..., None])
    result = np.empty((*w.shape[:-2], n + 1, K, 3, 3))
    result[..., 0, :, :, :] = np.eye(3)
    for i in range(n):
        result[..., i + 1, :, :, :] = result[..., i, :, :, :] @ turns[..., i, :, :, :]
    return result


def _fit_axes(
    w: FloatArray, R: FloatArray, q: FloatArray, prismatic: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Axes (S, n, 3) and losses (S,): Levenberg–Marquardt for all at once, Cauchy loss on log(R R_predᵀ)."""
    S, n = w.shape[:2]
    away = np.swapaxes(_chain(w, q, prismatic)[:, n], -1, -2) @ R
    base = np.stack([Rotation.from_matrix(rotations).mean().as_matrix() for rotations in away])
    damping = np.full(S, 1e-2)
    residual, J = _axis_residuals(w, base, R, q, prismatic)
    loss, weight = _cauchy(residual)
    for _ in range(_TURNS):
        size = J.shape[-1]
        rows = J.reshape(S, -1, size)
        weighted = np.swapaxes(rows * np.repeat(weight, 3, axis=1)[..., None], 1, 2)
        A = weighted @ rows
        g = (weighted @ residual.reshape(S, -1, 1))[..., 0]
        A += (damping * np.trace(A, axis1=1, axis2=2) / size + 1e-12)[:, None, None] * np.eye(size)
        turn = _rotations(np.asarray(-np.linalg.solve(A, g[..., None]).reshape(S, n + 1, 3), float))
        w_new = np.einsum("snij,snj->sni", turn[:, :n], w)
        base_new = turn[:, n] @ base
        residual_new, J_new = _axis_residuals(w_new, base_new, R, q, prismatic)
        loss_new, weight_new = _cauchy(residual_new)
        better = loss_new <= loss
        damping = np.where(better, np.maximum(0.2 * damping, 1e-9), np.minimum(8.0 * damping, 1e6))
        settled = np.abs(loss - loss_new) < 1e-9 * loss
        for kept, new in (
            (w, w_new), (base, base_new), (residual, residual_new), (J, J_new), (loss, loss_new),
            (weight, weight_new),
        ):  # fmt: skip
            kept[better] = new[better]
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
    chain = _chain(w, q, prismatic)
    residual = _rotation_vectors(R @ np.swapaxes(chain[:, n] @ base[:, None], -1, -2))
    J = np.empty((S, len(R), 3, n + 1, 3))
    for i in range(n):
        J[..., i, :] = chain[:, i + 1] - chain[:, i]
    J[..., n, :] = -chain[:, n]
    return residual, J.reshape(S, len(R), 3, 3 * (n + 1))


def _cauchy(residual: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Cauchy loss (S,) of rotations (S, K, 3), and the weights (S, K)."""
    square = (residual**2).sum(axis=2) / _WIDTH**2
    return np.log1p(square).sum(axis=1), 1.0 / (1.0 + square)


# Pull of axis points towards the body, in units of the typical equation: keeps the axes of nearly
# parallel joints, whose places are hardly determined, from running away.
_RIDGE = 0.03
# Least width of the loss on points, in units of their distance: the ridge's own bias must not weigh
# down the motions that show an axis best.
_LEAST_SCALE = 1e-3


def _place(
    w: FloatArray, guess: tuple[FloatArray, FloatArray], readings: Readings, q: FloatArray, rigid: BoolArray
) -> Scene:
    """Axis points, directions of translation and markers, linear in the points once all axes are known.

    A point of marker j at pose k is R̄_n X_j + Σ R̄_{i−1} ((I − R_i) p_i, or q_i v_i if prismatic):
    least squares under a Cauchy loss with a small ridge, from the markers that are rigid (m,). Turned back by
    R̄_n, the unknown X_j of a marker is the mean of what the rest leaves. Translations get one common speed.
    Joint values (K, n) are from the reference; the readings of both views are those of the guess.
    """
    (P, points), prismatic = guess, readings.prismatic
    n, m = w.shape[0], readings.marker.size
    pose_of, marker_of = readings.pose_of[readings.both], readings.marker_of[readings.both]
    chain = _chain(w, q, prismatic)
    back = np.swapaxes(chain[n], 1, 2)
    by_joint = [
        back @ (chain[i] * q[:, i, None, None] if slides else chain[i] - chain[i + 1])
        for i, slides in enumerate(prismatic)
    ]
    rows = np.concatenate(by_joint, axis=2)[pose_of]
    # Axis points and markers are sought from the centre of the points; R̄_n 0 and R̄_i p vanish there
    # only after the centre's own motion is taken out.
    center = np.median(points, axis=0)
    shift = np.where(prismatic[:, None], 0.0, center)
    target = (back[pose_of] @ points[..., None])[..., 0] - center - rows @ shift.ravel()
    ridge = np.where(prismatic, 0.0, _RIDGE**2).repeat(3) + 1e-9 * len(points)
    places, X = _robust_solve(rows, target, ridge, marker_of, rigid)
    places, X = places.reshape(n, 3) + shift, X + center
    H_hat = np.zeros((n, 4, 4))
    H_hat[~prismatic, :3, :3] = cross_matrix(w[~prismatic])
    H_hat[~prismatic, :3, 3] = -np.cross(w, places)[~prismatic]
    length = np.linalg.norm(places, axis=1)[prismatic]
    if prismatic.any():
        H_hat[prismatic, :3, 3] = places[prismatic] / length[:, None] * np.median(length)
    return Scene(P, H_hat, prismatic, np.hstack([X, np.ones((m, 1))]))


def _robust_solve(
    rows: FloatArray, target: FloatArray, ridge: FloatArray, marker_of: IntArray, trusted: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Least squares of three equations a point under a Cauchy loss by reweighting: x, and markers (m, 3).

    The residual target − rows x (N, 3) less the marker's own place; from the markers that are trusted (m,).
    """
    whole = np.concatenate([rows, target[..., None]], axis=2)
    weight = trusted[marker_of].astype(np.float64)
    for _ in range(10):
        sums = np.maximum(np.bincount(marker_of, weight, len(trusted)), 1e-12)[:, None, None]
        means = per_block(marker_of, weight[:, None, None] * whole, len(trusted)) / sums
        left = whole - means[marker_of]
        A = np.tensordot(left * weight[:, None, None], left, axes=((0, 1), (0, 1)))
        x = np.linalg.solve(A[:-1, :-1] + np.diag(ridge), A[:-1, -1])
        residual = np.linalg.norm(left[..., -1] - left[..., :-1] @ x, axis=1)
        scale = max(float(np.median(residual)) / MAD, _LEAST_SCALE)
        weight = 1.0 / (1.0 + (residual / (2.0 * scale)) ** 2)
    return np.asarray(x), np.asarray(means[..., -1] - means[..., :-1] @ x)


def starts(search: Search, readings: Readings, factors: tuple[float, ...] = (1.0,)) -> Iterator[Scene]:
    """Scenes to start from, most promising first: factors of the best focal lengths, and axes for each.

    The readings are those of the problem, perhaps at some of its poses.
    """
    for factor in factors:
        for guess in metric_guesses(search.epipolar, readings, search.frame, factor):
            alignment = _merged(guess[1], readings, search.rng)
            rigid = np.isfinite(alignment.body[:, 0])
            if int(rigid.sum()) < _LEAST:
                raise WorkFailed(
                    "no three markers are seen together by both cameras: more must be seen at once"
                )
            q = search.problem.q
            for w in _rotation_axes(alignment, q, readings.prismatic, search.rng):
                scene = _place(w, guess, readings, q, rigid)
                if np.isfinite(scene.H_hat).all() and np.isfinite(scene.M).all():
                    yield scene


@dataclass(frozen=True, eq=False)
class Nominal:
    """What is believed of robot, rig and markers, in one metric frame."""

    where: str  # name of its file, for messages
    P: FloatArray  # (2, 3, 4) cameras to pixels
    H_hat: FloatArray  # (n, 4, 4) twists at the reference: unit rotations without pitch, or unit translations
    q_reference: FloatArray  # (n,) rad or m
    marker: IntArray  # (m,) numbers of the markers
    M: FloatArray  # (m, 4) markers at the reference, last coordinate one

    @property
    def joint_types(self) -> str:
        """One letter a joint, R or P."""
        return "".join("R" if H_hat[:3, :3].any() else "P" for H_hat in self.H_hat)

    def scene(self, readings: Readings, q_reference: FloatArray) -> Scene:
        """Start for the readings, about their reference joints (n,), rad or m.

        Raises InputError if the joints are others, or a marker that was seen is not known.
        """
        own, letters = self.joint_types, "".join("P" if slides else "R" for slides in readings.prismatic)
        if own != letters:
            raise InputError(
                f"{self.where}: its joints are {own}, those of the data {letters}; "
                "give one screw a joint, or leave --init out"
            )
        missing = np.setdiff1d(readings.marker, self.marker)
        if missing.size:
            raise InputError(
                f"{self.where}: marker {missing[0]} of the data is not in it; add the marker (marker_numbers "
                "says which is which), or leave --init out"
            )
        types = np.where(readings.prismatic, PRISMATIC, REVOLUTE).astype(np.int64)
        model = Model(self.P, self.H_hat, types, self.q_reference, np.array([0.0, 0.0, 0.0, 1.0]))
        column = {int(number): j for j, number in enumerate(self.marker)}
        M = self.M[[column[int(number)] for number in readings.marker]]
        M = M @ forward_kinematics(model, q_reference).T
        return Scene(self.P, joint_operators(model, q_reference), readings.prismatic, M)
