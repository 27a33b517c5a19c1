"""Diagnosis of outliers: wrong joint readings, exchanged marker numbers, wrong detections, a lens."""

import dataclasses
import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from functools import reduce

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial import cKDTree

from projservo_cli.calibration.bundle_adjustment import LeastSquares, fit_offsets
from projservo_cli.calibration.checks.mismatched_poses import EXPLAINED, MOSTLY, SEEN_OF_IMAGE, imaged_poses
from projservo_cli.calibration.checks.model_errors import image_motions
from projservo_cli.calibration.detections import RAYLEIGH, Detections
from projservo_cli.calibration.initial.epipolar import OUTLIER
from projservo_cli.calibration.initial.initialization import stationary
from projservo_cli.calibration.prediction import Parameters
from projservo_cli.calibration.robust_fit import Solution, median_px
from projservo_cli.findings import LIMITS, Finding, Subject
from projservo_cli.records import BoolArray, FloatArray, IntArray

# Maximum number of observations of a pose in the search for wrong joint readings.
MAX_OF_POSE = 50
# Minimum number of detections of a marker to diagnose it.
_SEEN = 3
# Maximum motion of an image whose camera moved, over the spread of its markers, if no other view shows
# the joints.
_SMALL_MOTION = 0.1
# Minimum number of poses over which a camera settles, and of later ones, whose shifts are by chance.
_SETTLES, _LATER = 2, 10
# Standard deviations of chance above which further poses belong to the settling of a camera.
_SETTLED = 2.5


@dataclass(frozen=True, eq=False)
class Outliers:
    """Explanations of rejected detections."""

    suspect: IntArray  # (S, 2) row of the pose and index of the joint whose reading no image agrees with
    id_switches: IntArray  # (W, 3) row of the pose, index of the marker as numbered and of the true one
    poses: IntArray  # (P,) rows of poses whose images show other joints than those read
    moved: IntArray  # (V, 2) row of the pose and view of images that a motion of the camera explains
    mismatched: IntArray  # (P, 3) row of the pose, view, and row of the pose that its image shows instead
    explained: BoolArray  # (V, N) detections that these explain

    @classmethod
    def empty(cls, detections: Detections) -> "Outliers":
        """Return no explanations."""
        rows = np.zeros((0, 3), dtype=np.int64)
        return cls(rows[:, :2], rows, rows[:, 0], rows[:, :2], rows, np.zeros_like(detections.seen))

    @classmethod
    def of(cls, solution: Solution) -> "Outliers":
        """Explain rejected detections: exchanged numbers, other poses, moved cameras, then wrong readings."""
        problem, params, used = solution.problem, solution.params, solution.used
        detections, sigma = problem.detections, solution.sigma_px
        out = detections.seen & ~used
        id_switches, explained = _id_switches(problem, params, out, OUTLIER * sigma)
        mismatched = imaged_poses(solution, out & ~explained)
        for k, view, _ in mismatched:
            explained[view] |= out[view] & (detections.pose_of == k)
        moved = _moved_images(solution, out & ~explained)
        for k, view in moved:
            here = detections.pose_of == k
            explained[view, here] |= out[view, here]
        suspects, poses = list[tuple[int, int]](), list[int]()
        for k in np.setdiff1d(np.flatnonzero(detections.count_at(used) == 0), moved[:, 0]):
            here = detections.pose_of == k
            pose = dataclasses.replace(detections, seen=detections.seen & ~explained).rows(here)
            rows = np.flatnonzero(pose.seen.any(axis=0))
            if rows.size < 3:
                continue
            some = np.isin(np.arange(len(pose.pose_of)), rows[:: max(1, rows.size // MAX_OF_POSE)])
            alone = LeastSquares.of(pose.rows(some), problem.q_reference).with_noise(problem.tau)
            joints = _wrong_joints(alone, params, sigma)
            suspects += [(int(k), i) for i in joints]
            if joints or fits_other_joints(alone, params, problem.q, sigma):
                explained[:, here] |= out[:, here]
                poses += [] if joints else [int(k)]
        pairs = np.array(suspects, dtype=np.int64).reshape(-1, 2)
        return cls(pairs, id_switches, np.array(poses, dtype=np.int64), moved, mismatched, explained)


def _moved_images(solution: Solution, out: BoolArray) -> IntArray:
    """Images (V, 2), pose and view, mostly rejected by ``out`` (V, N), that fit a camera that moved a little.

    It shifts, turns and scales the image, and is small against the spread of its markers, as the motion by a
    wrong joint is not, unless another view shows that no joint is wrong.
    """
    problem, sigma, found = solution.problem, solution.sigma_px, list[tuple[int, int]]()
    detections = problem.detections
    residual = problem.with_noise(None).residual(solution.params)
    residual /= np.maximum(detections.weight[..., None], 1e-300)
    for view, k in itertools.product(range(len(out)), np.unique(detections.pose_of[out.any(axis=0)])):
        rows = np.flatnonzero(detections.seen[view] & (detections.pose_of == k))
        if rows.size < SEEN_OF_IMAGE or np.count_nonzero(out[view, rows]) < MOSTLY * rows.size:
            continue
        x = detections.pixels[view, rows] - detections.pixels[view, rows].mean(axis=0)
        radius = float(np.sqrt((x**2).sum(axis=1).mean()))
        A, off = image_motions(x / radius), residual[view, rows]

        def left(b: FloatArray, A: FloatArray = A, off: FloatArray = off) -> FloatArray:
            """Residuals after a motion of the image by shift, scale and turn b (4,), px."""
            return np.asarray((off - A @ b).ravel())

        fit = least_squares(left, np.zeros(4), loss="soft_l1", f_scale=sigma)
        median = float(np.median(np.linalg.norm(fit.fun.reshape(-1, 2), axis=1)))
        at = detections.pose_of == k
        seen, used = (detections.seen & at).sum(axis=1), (solution.used & at).sum(axis=1)
        alone = bool((used > MOSTLY * np.maximum(seen, SEEN_OF_IMAGE)).any())
        small = np.abs(fit.x).max() <= _SMALL_MOTION * radius
        if median <= EXPLAINED * RAYLEIGH * sigma and (alone or small):
            found.append((int(k), view))
    found = _of_cameras(detections, found)
    for view in {view for _, view in found}:
        found += [(k, view) for k in _settling(detections, residual[view], out[view], view, found)]
    return np.array([*dict.fromkeys(found)], dtype=np.int64).reshape(-1, 2)


def _of_cameras(detections: Detections, moved: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Images that moved, poses and views, without poses at which all cameras did: there the arm moved.

    Over the first poses all cameras may settle.
    """
    poses, views = np.unique(detections.pose_of).tolist(), dict[int, set[int]]()
    for k, view in moved:
        views.setdefault(k, set()).add(view)
    settling = next((i for i, k in enumerate(poses) if k not in views), len(poses))
    seen = {k: np.flatnonzero((detections.seen & (detections.pose_of == k)).any(axis=1)) for k in views}
    at_arm = {k for k in views if 1 < len(seen[k]) == len(views[k]) and k not in poses[:settling]}
    return [(k, view) for k, view in moved if k not in at_arm]


def _settling(
    detections: Detections, residual: FloatArray, out: BoolArray, view: int, moved: list[tuple[int, int]]
) -> list[int]:
    """Poses over which a camera settled, none if it did not.

    They begin with the first ones, at which one camera or another moved, of which this one at some. They go
    on while shifts the same way are larger together than later shifts are by chance.

    residual : (N, 2) of the view, px; out : (N,) rejected; moved : poses and views of small motions.
    """
    poses, known = np.unique(detections.pose_of), {k for k, _ in moved}
    at = [(detections.pose_of == k) & detections.seen[view] for k in poses]
    sound = np.array([rows.any() and out[rows].mean() < MOSTLY for rows in at])
    first = next((i for i, k in enumerate(poses.tolist()) if k not in known), len(poses))
    here = [i for i in range(first) if (int(poses[i]), view) in moved]
    if first < _SETTLES or not here or sound[:first].any():
        return []
    shift = np.array([np.median(residual[rows], axis=0) if rows.any() else np.zeros(2) for rows in at])
    along = shift @ shift[here[0]]
    best, last = _SETTLED, first
    for end in range(first + 1, len(poses)):
        few, rest = along[first:end][sound[first:end]], along[end:][sound[end:]]
        if rest.size < _LATER:
            break
        apart = few.sum() / max(float(np.sqrt(few.size * np.mean(rest**2))), 1e-300)
        best, last = max((best, last), (float(apart), end))
    return [k for k, rows in zip(poses[:last].tolist(), at, strict=False) if rows.any()]


def moved_images(detections: Detections, moved: IntArray) -> Iterator[Finding]:
    """Findings on images (N, 2) of cameras that moved or settled, by the ends of runs of poses."""
    present = np.unique(detections.pose_of)
    for view, name in enumerate(detections.view):
        at = np.searchsorted(present, np.sort(moved[moved[:, 1] == view, 0]))
        if not at.size:
            continue
        runs = np.split(at, np.flatnonzero(np.diff(at) > 1) + 1)
        ends = [int(end) for run in runs for end in detections.pose[present[run[[0, -1]]]]]
        if at[0] == 0 and runs[0].size > 1:
            yield Finding("unsettled_camera", LIMITS, Subject(views=(name,), poses=tuple(ends[:2])))
            ends = ends[2:]
        if ends:
            yield Finding("moved_camera", LIMITS, Subject(views=(name,), poses=tuple(ends)))


def _id_switches(
    problem: LeastSquares, params: Parameters, out: BoolArray, limit: float
) -> tuple[IntArray, BoolArray]:
    """Observations (W, 3) that lie where another marker belongs in every view, and their detections (V, N).

    The other marker is unseen or rejected there. A detection that fits its own marker contradicts a switch.
    """
    detections = problem.detections
    joints, rows = (
        problem.joints(fit_offsets(problem, params)),
        np.flatnonzero((out == detections.seen).all(axis=0)),
    )
    found = set()
    explained = np.zeros_like(out)
    for k in np.unique(detections.pose_of[rows]):
        here = detections.pose_of == k
        free = np.ones(detections.marker.size, dtype=bool)
        free[detections.marker_of[here & ~out.any(axis=0)]] = False
        predicted = np.nan_to_num(params.predict(joints[k : k + 1])[0], nan=-np.inf)
        others = np.flatnonzero(free & np.isfinite(predicted).all(axis=(0, 2)))
        trees = [cKDTree(of_view[others]) for of_view in predicted]
        for row in rows[here[rows]]:
            # A view that did not see the marker counts for nothing.
            near = [
                trees[v].query_ball_point(detections.pixels[v, row], limit / detections.weight[v, row])
                for v in np.flatnonzero(detections.seen[:, row])
            ]
            marker = int(detections.marker_of[row])
            fits = np.setdiff1d(others[np.array(reduce(np.intersect1d, near), dtype=np.int64)], marker)
            if fits.size == 1:
                found.add((int(k), marker, int(fits[0])))
                explained[:, row] = out[:, row]
    # A switch of two markers shows in both and counts once.
    switches = sorted((k, a, b) for k, a, b in found if a < b or (k, b, a) not in found)
    return np.array(switches, dtype=np.int64).reshape(-1, 3), explained


def fits_other_joints(pose: LeastSquares, params: Parameters, q: FloatArray, sigma: float) -> bool:
    """Whether other joints explain the images of a pose: joints of another pose (K, n), or near these."""
    poses = [dataclasses.replace(pose, q=np.broadcast_to(at, pose.q.shape), tau=None) for at in q]
    levels = [median_px(one.residual(params), one.detections.seen) for one in poses]
    nearest = poses[int(np.argmin(levels))]
    level = min(min(levels), _corrected_level(nearest, params, list(range(q.shape[1])), sigma))
    return level <= EXPLAINED * RAYLEIGH * sigma


def rejection_reasons(solution: Solution, kept: BoolArray) -> IntArray:
    """Rejected markers (T, 2), those not ``kept`` (m,): index, and reason, an index into ``WHY_LOST``."""
    detections = solution.problem.detections
    near = np.linalg.norm(solution.residual, axis=2) <= OUTLIER * solution.sigma_px
    fits = detections.count_of(detections.seen & near)
    seen = detections.count_of(detections.seen)
    why = np.select(
        [stationary(detections, solution.sigma_px), seen < _SEEN, fits > seen / _SEEN], [0, 3, 2], 1
    )
    return np.stack([np.flatnonzero(~kept), why[~kept]], axis=1)


def _wrong_joints(pose: LeastSquares, params: Parameters, sigma: float) -> tuple[int, ...]:
    """Joint, or pair of joints, whose correction explains the images of a pose; or none."""
    for size in (1, 2):
        pairs = list(itertools.combinations(range(pose.q.shape[1]), size))
        levels = [_corrected_level(pose, params, list(joints), sigma) for joints in pairs]
        if min(levels, default=np.inf) <= EXPLAINED * RAYLEIGH * sigma:
            return pairs[int(np.argmin(levels))]
    return ()


def _corrected_level(pose: LeastSquares, params: Parameters, joints: list[int], sigma: float) -> float:
    """Median residual, px, after a robust fit of some joints of a pose to its images.

    The other joints may err by their noise.
    """
    seen, n = pose.detections.seen, pose.q.shape[1]
    others = np.setdiff1d(np.arange(n) if pose.tau is not None else joints, joints)
    moved = np.eye(n)[[*joints, *others]]

    def residual(x: FloatArray) -> FloatArray:
        images = dataclasses.replace(pose, q=pose.q + x @ moved).residual(params)[seen].ravel()
        return images if pose.tau is None else np.concatenate([images, x[len(joints) :] / pose.tau[others]])

    found = least_squares(residual, np.zeros(len(moved)), loss="soft_l1", f_scale=sigma)
    return float(np.median(np.linalg.norm(found.fun[: 2 * int(seen.sum())].reshape(-1, 2), axis=1)))


def outlier_rows(detections: Detections, out: BoolArray) -> IntArray:
    """List the detections of a mask (V, N) as sorted rows (L, 3): pose, marker number, view (V for all).

    An observation that several views lose, but not all of them, has a row for each.
    """
    whole = out.all(axis=0)
    view, rows = np.nonzero(np.vstack([out & ~whole, whole]))
    found = np.stack(
        [detections.pose[detections.pose_of[rows]], detections.marker[detections.marker_of[rows]], view],
        axis=1,
    )
    return found[np.lexsort(found.T[::-1])].astype(np.int64)
