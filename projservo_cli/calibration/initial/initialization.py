"""Initialization of the adjustment: in a guessed metric frame markers, axes, then all places.

A nominal robot and rig may serve as a start too; it is tried, and kept only if it leads to a good fit.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from projservo_cli.calibration.bundle_adjustment import LeastSquares
from projservo_cli.calibration.detections import Detections, cauchy_weights, per_block, robust_deviation
from projservo_cli.calibration.initial.epipolar import ImageFrame, ImageGeometry, log_distances, marker_pairs
from projservo_cli.calibration.prediction import Parameters
from projservo_cli.geometry.displacements import (
    aligned,
    cross_matrix,
    displacements,
    homogeneous,
    nearest_rotations,
    rotation_vectors,
)
from projservo_cli.geometry.kinematics import forward_kinematics, joint_operators
from projservo_cli.geometry.least_squares import Equations, levenberg_marquardt
from projservo_cli.records import (
    BoolArray,
    FloatArray,
    InputError,
    IntArray,
    Model,
    WorkFailed,
    letters_of,
    no_lenses,
)

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False)
class Search:
    """Inputs of a search for the maximum likelihood."""

    problem: LeastSquares
    epipolar: ImageGeometry
    frame: ImageFrame
    rng: np.random.Generator
    progress: Progress  # called with the current task, the amount done and the total
    joint_noise: float | None = 0.0  # rms of joint readings less true joints, rad; None to estimate it


# Number of shared markers for a safe alignment: four resist one wrong marker.
_SAFE = 4
# Minimum number of shared markers for an alignment.
_MIN_MARKERS = 3
# Rounds of reweighting in an alignment.
_ROUNDS = 8
# Number of random triples of markers tried.
_TRIPLES = 60
# Scatter of a marker over the median above which it is not part of the body.
_LOOSE = 6.0
# Number of markers at a pose, over the maximum, from which it may be the first.
_FULL = 0.8
# Number of observations by both views wanted at each pose of the start.
_WANTED = 25
# Number of markers up to which the start takes all.
_FEW = 40
# Motion in the images, in units of the noise, below which a marker is stationary.
_STILL = 6.0
# Motion in the images, over the third quartile of the markers, below which a marker is stationary.
_STILL_SHARE = 0.05
# Number of random sets of axes to start from.
_STARTS = 20
# Maximum number of steps on the axes.
_TURNS = 60
# Maximum number of sets of axes that are kept.
_MAX_SETS = 3
# Loss of a minimum over the best one above which it does not explain the rotations.
_UNLIKELY = 4.0
# Difference of axes, rad, below which two sets lie in one valley, along which only images determine them.
_DISTINCT = 0.5
# Loss a pose above which axes contradict the rotations: an error of 45°, more than a guessed frame causes.
_CONTRADICTION = 5.5
# Residual, rad, above which the loss on rotations flattens.
_WIDTH = 0.05
# Weight that pulls axis points, hardly determined for nearly parallel joints, towards the body.
_RIDGE = 0.03
# Minimum width of the loss on points, over their distance, so that the bias of the ridge rejects no motion.
_MIN_SCALE = 1e-3
# Angle of a rotation, rad, above which noise may turn its vector over.
_HALF_TURN = 2.8


def stationary(detections: Detections, noise_px: float) -> BoolArray:
    """Mask (m,) of markers that move in no image and so are not on the robot."""
    move = np.zeros((detections.marker.size, len(detections.seen)))
    for v, seen in enumerate(detections.seen):
        rows = np.flatnonzero(seen)
        low, high = np.full((2, detections.marker.size, 2), [[[np.inf]], [[-np.inf]]])
        np.minimum.at(low, detections.marker_of[rows], detections.pixels[v, rows])
        np.maximum.at(high, detections.marker_of[rows], detections.pixels[v, rows])
        move[:, v] = np.where(np.isfinite(low), high - low, 0.0).max(axis=1)
    moved = move.max(axis=1)
    often = detections.count_of(detections.seen) > 2
    limit = max(_STILL * noise_px, _STILL_SHARE * float(np.percentile(moved, 75)))
    return np.asarray(often & (moved <= limit))


def starting_markers(detections: Detections, geometry: ImageGeometry, rng: np.random.Generator) -> BoolArray:
    """Mask (m,) of markers for the start: placed, moving, seen at many poses, and as many as poses need."""
    m, placed = detections.marker.size, geometry.placeable_markers(detections)
    moving = placed & ~stationary(detections, geometry.noise_px)
    if m <= _FEW:
        return moving if moving.sum() >= _WANTED else placed
    count = detections.count_of(detections.both[None])
    order = np.lexsort((rng.random(m), -np.minimum(count, np.median(count)), ~moving))
    return detections.covering(order[placed[order]], _WANTED)


@dataclass(frozen=True, eq=False)
class _Alignment:
    """The body in its own frame and its rigid motion to each pose."""

    body: FloatArray  # (m, 3) markers, NaN if never aligned, or not rigid
    R: FloatArray  # (K, 3, 3) rotations from the body to the pose
    merged: BoolArray  # (K,) whether the rotation of a pose is known


def _grow_body(reconstructed: FloatArray, detections: Detections, rng: np.random.Generator) -> _Alignment:
    """Body and poses from the points (N, 3) of observations, grown from a pose with many markers."""
    K = len(detections.q)
    points = np.zeros((K, detections.marker.size, 3))
    seen = np.zeros(points.shape[:2], dtype=bool)
    where = detections.pose_of, detections.marker_of
    points[where], seen[where] = reconstructed, True
    R, t = np.tile(np.eye(3), (K, 1, 1)), np.zeros((K, 3))
    seed = _seed(reconstructed, *where)
    body = np.where(seen[seed][:, None], points[seed], np.nan)
    found = np.arange(K) == seed
    for shared in (_SAFE, _MIN_MARKERS, _MIN_MARKERS):
        grown = True
        while grown:
            known = np.isfinite(body[:, 0])
            usable = seen & known
            rows = usable.sum(axis=1) >= max(min(shared, int(known.sum())), _MIN_MARKERS)
            for k in np.flatnonzero(rows & ~found):
                R[k], t[k] = _consensus(body[usable[k]], points[k, usable[k]], rng)
            if rows.any():
                filled = np.where(known[:, None], body, 0.0)
                R[rows], t[rows] = _robust_align(filled, points[rows], usable[rows], (R[rows], t[rows]))
            grown = bool((rows & ~found).any())
            found |= rows
            local = np.einsum("kji,kmj->kmi", R, points - t[:, None])
            body = _rigid_body(np.where((seen & found[:, None])[..., None], local, np.nan))
            grown |= int(np.isfinite(body[:, 0]).sum()) > int(known.sum())
    return _Alignment(body, R, found)


def _rigid_body(local: FloatArray) -> FloatArray:
    """Median points (m, 3) of markers (K, m, 3) over the poses, NaN if they scatter far more than most."""
    body = np.full(local.shape[1:], np.nan)
    some = np.isfinite(local[..., 0]).any(axis=0)
    body[some] = np.nanmedian(local[:, some], axis=0)
    scatter = np.full(len(body), np.nan)
    scatter[some] = np.nanmedian(np.linalg.norm(local[:, some] - body[some], axis=2), axis=0)
    twice = np.isfinite(local[..., 0]).sum(axis=0) > 1
    if twice.any():
        body[twice & (scatter > _LOOSE * np.median(scatter[twice]))] = np.nan
    return body


def _consensus(
    body: FloatArray, points: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Rigid motion of the body (m, 3) with the minimum median distance to points (m, 3), over random triples.

    Half of the points may be wrong: P. J. Rousseeuw, "Least median of squares regression", JASA 79, 1984.
    """
    m = len(body)
    three = np.argsort(rng.random((_TRIPLES, m)), axis=1)[:, :_MIN_MARKERS]
    R, t = aligned(body[three], points[three], np.ones(three.shape))
    distance = np.sort(np.linalg.norm(points - body @ np.swapaxes(R, 1, 2) - t[:, None], axis=2), axis=1)
    best = int(np.argmin(distance[:, min(max(m // 2, _MIN_MARKERS + 1), m - 1)]))
    return R[best], t[best]


def _robust_align(
    body: FloatArray, points: FloatArray, seen: BoolArray, motion: tuple[FloatArray, FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Align as ``aligned`` under a Cauchy loss by reweighting, from initial motions."""
    R, t = motion
    for _ in range(_ROUNDS):
        residual = np.linalg.norm(points - body @ np.swapaxes(R, 1, 2) - t[:, None], axis=2)
        square = (residual / (2.0 * robust_deviation(residual[seen], 1e-12))) ** 2
        R, t = aligned(body, points, np.where(seen, cauchy_weights(square), 0.0))
    return R, t


def _seed(points: FloatArray, pose_of: IntArray, marker_of: IntArray) -> int:
    """Pose with many markers whose distances between points (N, 3) agree best with those at other poses."""
    pairs = marker_pairs(pose_of, marker_of)
    deviation, compared = log_distances(points, pairs)
    count = np.bincount(pose_of)
    full = np.flatnonzero(count >= _FULL * count.max())
    at = pose_of[pairs[0]]
    typical = [
        np.median(deviation[(at == k) & compared]) if (compared & (at == k)).any() else np.inf for k in full
    ]
    return int(full[np.argmin(typical)])


def _rotation_axes(
    alignment: _Alignment,
    q: FloatArray,
    prismatic: BoolArray,
    rng: np.random.Generator,
) -> list[FloatArray]:
    """Sets of axes (n, 3) that explain the rotations at joint values (K, n), distinct minima, best first.

    Fitted from many random sets; empty if no axes explain the rotations. Axes of prismatic joints have no
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
        if len(kept) == _MAX_SETS:
            break
    return kept


def _rotations(vectors: FloatArray) -> FloatArray:
    """Rotations (…, 3, 3) of rotation vectors (…, 3), rad; SciPy takes one dimension of them."""
    return np.asarray(Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(*vectors.shape, 3))


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
    """Axes (S, n, 3) and losses (S,) near given ones: Cauchy loss on log(R R_predᵀ), all starts at once."""
    S, n = w.shape[:2]
    away = np.swapaxes(_chain(w, q, prismatic)[:, n], -1, -2) @ R
    base = nearest_rotations(away.sum(axis=1))

    def equations(w: FloatArray, base: FloatArray) -> Equations:
        residual, J = _axis_residuals(w, base, R, q, prismatic)
        loss, weight = _cauchy(residual)
        root = np.sqrt(weight)[..., None] / _WIDTH
        r, J = (root * residual).reshape(S, -1), (root[..., None] * J).reshape(S, -1, J.shape[-1])
        return Equations.of(r, J)._replace(cost=loss)

    def turned(step: FloatArray, w: FloatArray, base: FloatArray) -> tuple[FloatArray, FloatArray]:
        turn = _rotations(step.reshape(S, n + 1, 3))
        return np.einsum("snij,snj->sni", turn[:, :n], w), turn[:, n] @ base

    (w, _), there = levenberg_marquardt((w, base), equations, turned, _TURNS)
    return w, there.cost


def _axis_residuals(
    w: FloatArray, base: FloatArray, R: FloatArray, q: FloatArray, prismatic: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Residuals log(R R_predᵀ) (S, K, 3) and derivative (S, K, 3, 3 (n + 1)) by turns of axes and base.

    A turn δ of axis i turns the prediction by (R̄_i−1 − R̄_i) δ, a turn of the base by R̄_n δ; the
    logarithm is taken to first order, which vanishes with the residual.
    """
    S, n = w.shape[:2]
    chain = _chain(w, q, prismatic)
    residual = rotation_vectors(R @ np.swapaxes(chain[:, n] @ base[:, None], -1, -2))
    J = np.empty((S, len(R), 3, n + 1, 3))
    for i in range(n):
        J[..., i, :] = chain[:, i + 1] - chain[:, i]
    J[..., n, :] = -chain[:, n]
    return residual, J.reshape(S, len(R), 3, 3 * (n + 1))


def _cauchy(residual: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Cauchy loss (S,) of rotations (S, K, 3), and the weights (S, K)."""
    square = (residual**2).sum(axis=2) / _WIDTH**2
    return np.log1p(square).sum(axis=1), cauchy_weights(square)


def _solve_points(
    w: FloatArray,
    guess: tuple[FloatArray, FloatArray],
    detections: Detections,
    q: FloatArray,
    rigid: BoolArray,
) -> Parameters:
    """Axis points, directions of translation and markers, by linear equations for known axes.

    A point of marker j at pose k is R̄_n X_j + Σ R̄_{i−1} ((I − R_i) p_i, or q_i v_i if prismatic):
    least squares under a Cauchy loss with a small ridge, over rigid markers (m,). Rotated back by R̄_n, the
    unknown X_j is the mean of the remaining residuals. All translations get one common speed. Joint values
    (K, n) are from the reference.
    """
    (P, points), prismatic = guess, detections.prismatic
    n, m = w.shape[0], detections.marker.size
    pose_of, marker_of = detections.pose_of, detections.marker_of
    chain = _chain(w, q, prismatic)
    back = np.swapaxes(chain[n], 1, 2)
    by_joint = [
        back @ (chain[i] * q[:, i, None, None] if slides else chain[i] - chain[i + 1])
        for i, slides in enumerate(prismatic)
    ]
    rows = np.concatenate(by_joint, axis=2)[pose_of]
    # Unknowns are relative to the centre of the points, so the motion of the centre itself is subtracted.
    center = np.median(points, axis=0)
    shift = np.where(prismatic[:, None], 0.0, center)
    target = (back[pose_of] @ points[..., None])[..., 0] - center - rows @ shift.ravel()
    ridge = np.where(prismatic, 0.0, _RIDGE**2).repeat(3) + 1e-9 * len(points)
    p, X = _robust_solve(rows, target, ridge, marker_of, rigid)
    p, X = p.reshape(n, 3) + shift, X + center
    H_hat = np.zeros((n, 4, 4))
    H_hat[~prismatic, :3, :3] = cross_matrix(w[~prismatic])
    H_hat[~prismatic, :3, 3] = -np.cross(w, p)[~prismatic]
    if prismatic.any():
        slides = p[prismatic]
        slides[~slides.any(axis=1), 0] = 1.0  # which no point shows: any direction
        length = np.linalg.norm(slides, axis=1)
        H_hat[prismatic, :3, 3] = slides / length[:, None] * np.median(length)
    return Parameters(P, H_hat, prismatic, np.hstack([X, np.ones((m, 1))]))


def _robust_solve(
    rows: FloatArray, target: FloatArray, ridge: FloatArray, marker_of: IntArray, trusted: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Solve three equations a point under a Cauchy loss by reweighting: x, and markers (m, 3).

    The residual is target − rows x (N, 3) less the mean of its marker; only trusted markers (m,) count.
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
        weight = cauchy_weights((residual / (2.0 * robust_deviation(residual, _MIN_SCALE))) ** 2)
    return np.asarray(x), np.asarray(means[..., -1] - means[..., :-1] @ x)


class GuessedBody(NamedTuple):
    """Cameras and placed points by a guess, and their body, whatever the joints read."""

    P: FloatArray  # (V, 3, 4)
    placed: BoolArray  # (N,) observations that have a point
    points: FloatArray  # (P, 3) of these
    alignment: _Alignment


def bodies(search: Search, detections: Detections, factor: float = 1.0) -> Iterator[GuessedBody]:
    """Yield bodies by the guesses of the geometry of images, most promising first, at a factor of the focal.

    Raises WorkFailed if no three markers are seen together.
    """
    for P, points in search.epipolar.guesses(detections, search.frame, factor):
        placed = np.isfinite(points[:, 0])
        alignment = _grow_body(points[placed], detections.rows(placed), search.rng)
        if np.isfinite(alignment.body[:, 0]).sum() < _MIN_MARKERS:
            raise WorkFailed("no three markers are seen together: more must be seen at once")
        yield GuessedBody(P, placed, points[placed], alignment)


def starts(
    search: Search,
    detections: Detections,
    factors: tuple[float, ...] = (1.0,),
    known: Sequence[GuessedBody] | None = None,
) -> Iterator[Parameters]:
    """Yield initial parameters, most promising first: factors of the best focal lengths, and axes for each.

    detections : of the problem, or of some of its poses; known : bodies that their images show.
    Raises WorkFailed if no three markers are seen together.
    """
    for factor in factors:
        for body in bodies(search, detections, factor) if known is None else known:
            some, rigid = detections.rows(body.placed), np.isfinite(body.alignment.body[:, 0])
            if (known_operators := some.known_operators) is not None:
                yield from _of_flange(body, some, known_operators)
                continue
            for w in _rotation_axes(body.alignment, search.problem.q, some.prismatic, search.rng):
                params = _solve_points(w, (body.P, body.points), some, search.problem.q, rigid)
                if np.isfinite(params.H_hat).all() and np.isfinite(params.M).all():
                    yield params


def _of_flange(body: GuessedBody, detections: Detections, H_hat: FloatArray) -> Iterator[Parameters]:
    """Yield initial parameters in the base by poses of the flange, of known operators (6, 4, 4).

    The turn of the base follows from the rotations in closed form; points are linear in its place and scale.
    """
    motion = reduce(np.matmul, displacements(H_hat, detections.prismatic, detections.q))
    C = _turn_of_base(motion[:, :3, :3], body.alignment)
    rigid = np.isfinite(body.alignment.body[:, 0])
    found = _placed_in_base(C, motion, (body.P, body.points), detections, rigid)
    if found is not None:
        yield Parameters(found[0], H_hat, detections.prismatic, found[1], known_arm=True)


def _turn_of_base(D: FloatArray, alignment: _Alignment) -> FloatArray:
    """Rotation (3, 3) of the base into the frame of an alignment, by rotations of the flange (K, 3, 3).

    Rotation vectors of the flange and of the body between two poses are equal but for this rotation.
    Source: F. C. Park, B. J. Martin, "Robot sensor calibration: solving AX = XB on the Euclidean group",
    IEEE Trans. Robotics and Automation 10(5), 1994.
    """
    known = np.flatnonzero(alignment.merged)
    a, b = (known[at] for at in np.triu_indices(len(known), 1))
    flange, body = (rotation_vectors(R[a] @ R[b].swapaxes(1, 2)) for R in (D, alignment.R))
    used = np.linalg.norm(flange, axis=1) < _HALF_TURN
    flange, body, weight = flange[used], body[used], np.ones(np.count_nonzero(used))
    C = np.eye(3)
    for _ in range(_ROUNDS):
        C = nearest_rotations(body.T @ (weight[:, None] * flange))
        off = np.linalg.norm(body - flange @ C.T, axis=1)
        weight = cauchy_weights((off / (2.0 * robust_deviation(off, _WIDTH))) ** 2)
    return np.asarray(C)


def _placed_in_base(
    C: FloatArray,
    motion: FloatArray,
    guess: tuple[FloatArray, FloatArray],
    detections: Detections,
    rigid: BoolArray,
) -> tuple[FloatArray, FloatArray] | None:
    """Cameras and markers in the base, by its turn C (3, 3); None if the scale is not positive.

    A point of marker j at pose k is s C (R_k X_j + d_k) + t. Turned back by C R_k, the unknown s X_j is the
    mean of the remaining residuals.
    """
    (P, points), pose_of, marker_of = guess, detections.pose_of, detections.marker_of
    turned, d = C @ motion[:, :3, :3], motion[:, :3, 3]
    back = turned.swapaxes(1, 2)
    rows = np.concatenate([(back @ (d @ C.T)[..., None]), back], axis=2)[pose_of]
    center = np.median(points, axis=0)
    target = (back[pose_of] @ (points - center)[..., None])[..., 0]
    x, X = _robust_solve(rows, target, np.full(4, 1e-9 * len(points)), marker_of, rigid)
    if not x[0] > 0.0:
        return None
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = x[0] * C, x[1:] + center
    return P @ frame, homogeneous(X / x[0])


@dataclass(frozen=True, eq=False)
class Nominal:
    """Nominal robot, rig and markers, in one metric frame."""

    where: str  # name of its file, for messages
    P: FloatArray  # (V, 3, 4) cameras to pixels
    H_hat: FloatArray  # (n, 4, 4) twists at the reference: unit rotations without pitch, or unit translations
    q_reference: FloatArray  # (n,) rad or m
    marker: IntArray  # (m,) numbers of the markers
    M: FloatArray  # (m, 4) markers at the reference, last coordinate one

    @property
    def joint_types(self) -> str:
        """One letter a joint, R or P."""
        return letters_of(not H_hat[:3, :3].any() for H_hat in self.H_hat)

    def start(self, detections: Detections, q_reference: FloatArray) -> Parameters:
        """Initial parameters for detections, about their reference joints (n,), rad or m.

        Raises InputError if the joint types differ, or a detected marker is missing.
        """
        own, letters = self.joint_types, letters_of(detections.prismatic)
        if own != letters:
            raise InputError(
                f"{self.where}: its joints are {own}, the data have {letters}; "
                "give one screw a joint, or leave calibration.init out"
            )
        missing = np.setdiff1d(detections.marker, self.marker)
        if missing.size:
            raise InputError(
                f"{self.where}: marker {missing[0]} of the data is not in it; add the marker (marker_numbers "
                "says which is which), or leave calibration.init out"
            )
        a_inf, lens = np.array([0.0, 0.0, 0.0, 1.0]), no_lenses(len(self.P))
        model = Model(self.P, self.H_hat, detections.prismatic, self.q_reference, a_inf, lens)
        column = {int(number): j for j, number in enumerate(self.marker)}
        M = self.M[[column[int(number)] for number in detections.marker]]
        M = M @ forward_kinematics(model, q_reference).T
        return Parameters(self.P, joint_operators(model, q_reference), detections.prismatic, M)
