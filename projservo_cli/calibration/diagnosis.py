"""Diagnosis of outliers: wrong joint readings, exchanged marker numbers, wrong detections, a lens."""

import dataclasses
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import islice

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial import cKDTree

from projservo_cli.calibration.adjustment import LeastSquares, fit_offsets, minimize
from projservo_cli.calibration.detections import RAYLEIGH, Detections
from projservo_cli.calibration.epipolar import OUTLIER, Epipolar
from projservo_cli.calibration.fit import OPEN_DIRECTION, Solution, fit_from, median_px
from projservo_cli.calibration.initialization import Search, starting_markers, starts, stationary
from projservo_cli.calibration.lens_estimation import undistorted
from projservo_cli.calibration.model_error import image_motions
from projservo_cli.calibration.prediction import CAMERA, Parameters
from projservo_cli.geometry.displacements import cross_matrix
from projservo_cli.records import VIEWS, BoolArray, FloatArray, IntArray, WorkFailed, letters_of

# Median residual, in σ, below which a corrected joint reading explains a pose.
_CORRECTED = 3.0
# Maximum number of observations of a pose in the search for wrong joint readings.
_MAX_OF_POSE = 50
# Minimum number of detections of a marker to diagnose it.
_SEEN = 3
# Epipolar distance, in units of its noise, below which an observation is no error of detection.
_CONSISTENT = 3.0
# Maximum share of observations that both views agree on and a fit may reject.
_MAX_UNEXPLAINED = 0.02
# Minimum share of a pose's observations that a wrong motion displaces: single slanted corners err along
# the epipolar line.
_MIN_OF_POSE = 0.25
# Minimum number of observations of one pose whose agreement on joints is more than chance.
_AGREEING = 5
# Maximum number of markers in the estimate of noise at free poses.
_FREED = 150
# Minimum share of the detections of an image that are rejected where its camera may have moved.
_MOSTLY = 0.5
# Minimum number of detections of such an image: two more than its motion has coordinates, to test it.
_SEEN_OF_IMAGE = 4
# Maximum motion of such an image, over the spread of its markers.
_SMALL_MOTION = 0.1
# Maximum number of runs of poses that a message names.
_MAX_RUNS = 4
# Share of the poses that show another motion above which the joint readings are wrong.
_MANY_POSES = 0.4
# Number of hypotheses about a joint at fault that are fitted completely.
_FOLLOWED = 2
# Number of hypotheses about the order of images, the first ones.
_ORDERS = 2
# Number of adjustment steps of the screws by which hypotheses are compared before.
_SCREW_STEPS = 8
# Log residual added to a joint of the other type, which explains more: one that stands still is simpler.
_SIMPLER = 0.1
# Maximum number of markers in the test of joint types.
_TYPED = 20
# Minimum share of the readings by which a prismatic joint does not turn the images, and in deviations of it.
_STRAIGHT, _SURE = 0.5, 6.0


@dataclass(frozen=True, eq=False)
class Outliers:
    """Explanations of rejected detections."""

    suspect: IntArray  # (S, 2) row of the pose and index of the joint whose reading no image agrees with
    id_switches: IntArray  # (W, 3) row of the pose, index of the marker as numbered and of the true one
    poses: IntArray  # (P,) rows of poses whose images show other joints than those read
    moved: IntArray  # (V, 2) row of the pose and view of images that a motion of the camera explains
    explained: BoolArray  # (2, N) detections that these explain

    @classmethod
    def empty(cls, detections: Detections) -> "Outliers":
        """Return no explanations."""
        rows = np.zeros((0, 3), dtype=np.int64)
        return cls(rows[:, :2], rows, rows[:, 0], rows[:, :2], np.zeros_like(detections.seen))

    @classmethod
    def of(cls, solution: Solution) -> "Outliers":
        """Explain rejected detections: exchanged marker numbers, moved cameras, then wrong joint readings."""
        problem, params, used = solution.problem, solution.params, solution.used
        detections, sigma = problem.detections, solution.sigma_px
        out = detections.seen & ~used
        id_switches, explained = _id_switches(problem, params, out, OUTLIER * sigma)
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
            some = np.isin(np.arange(len(pose.pose_of)), rows[:: max(1, rows.size // _MAX_OF_POSE)])
            alone = LeastSquares.of(pose.rows(some), problem.q_reference).with_noise(problem.tau)
            joints = _wrong_joints(alone, params, sigma)
            suspects += [(int(k), i) for i in joints]
            if joints or _fits_other_joints(alone, params, problem.q, sigma):
                explained[:, here] |= out[:, here]
                poses += [] if joints else [int(k)]
        pairs = np.array(suspects, dtype=np.int64).reshape(-1, 2)
        return cls(pairs, id_switches, np.array(poses, dtype=np.int64), moved, explained)


def _moved_images(solution: Solution, out: BoolArray) -> IntArray:
    """Images (V, 2), pose and view, mostly rejected by ``out`` (2, N), that fit a camera that moved a little.

    It shifts, turns and scales the image, and is small against the spread of its markers, as the motion by a
    wrong joint is not.
    """
    problem, sigma, found = solution.problem, solution.sigma_px, list[tuple[int, int]]()
    detections = problem.detections
    residual = problem.with_noise(None).residual(solution.params)
    residual /= np.maximum(detections.weight[..., None], 1e-300)
    for view, k in itertools.product((0, 1), np.unique(detections.pose_of[out.any(axis=0)])):
        rows = np.flatnonzero(detections.seen[view] & (detections.pose_of == k))
        if rows.size < _SEEN_OF_IMAGE or np.count_nonzero(out[view, rows]) < _MOSTLY * rows.size:
            continue
        x = detections.pixels[view, rows] - detections.pixels[view, rows].mean(axis=0)
        radius = float(np.sqrt((x**2).sum(axis=1).mean()))
        A, off = image_motions(x / radius), residual[view, rows]

        def left(b: FloatArray, A: FloatArray = A, off: FloatArray = off) -> FloatArray:
            """Residuals after a motion of the image by shift, scale and turn b (4,), px."""
            return np.asarray((off - A @ b).ravel())

        fit = least_squares(left, np.zeros(4), loss="soft_l1", f_scale=sigma)
        median = float(np.median(np.linalg.norm(fit.fun.reshape(-1, 2), axis=1)))
        if median <= _CORRECTED * RAYLEIGH * sigma and np.abs(fit.x).max() <= _SMALL_MOTION * radius:
            found.append((int(k), view))
    return np.array(found, dtype=np.int64).reshape(-1, 2)


def describe_moved(detections: Detections, moved: IntArray) -> str:
    """Describe images (V, 2) of cameras that moved, by runs of poses in the order of the recording."""
    present, sentences = np.unique(detections.pose_of), []
    for view, name in enumerate(VIEWS):
        at = np.searchsorted(present, np.sort(moved[moved[:, 1] == view, 0]))
        if not at.size:
            continue
        runs = np.split(at, np.flatnonzero(np.diff(at) > 1) + 1)
        words = [" to ".join(map(str, np.unique(detections.pose[present[run[[0, -1]]]]))) for run in runs]
        settled = f"settled over poses {words.pop(0)}" if at[0] == 0 and runs[0].size > 1 else ""
        more = f" and {len(words) - _MAX_RUNS} more" if len(words) > _MAX_RUNS else ""
        later = f"moved at pose{'s' * (at.size > 1)} {', '.join(words[:_MAX_RUNS])}{more}" if words else ""
        sentences.append(f"the {name} camera {' and '.join(filter(None, (settled, later)))}")
    return ", ".join(sentences)


def _id_switches(
    problem: LeastSquares, params: Parameters, out: BoolArray, limit: float
) -> tuple[IntArray, BoolArray]:
    """Observations (W, 3) that lie where another marker belongs in every view, and their detections (2, N).

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
        trees = [cKDTree(predicted[v, others]) for v in (0, 1)]
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


def _fits_other_joints(pose: LeastSquares, params: Parameters, q: FloatArray, sigma: float) -> bool:
    """Whether other joints explain the images of a pose: those of another pose (K, n), or near these."""
    poses = [dataclasses.replace(pose, q=np.broadcast_to(at, pose.q.shape), tau=None) for at in q]
    levels = [median_px(one.residual(params), one.detections.seen) for one in poses]
    nearest = poses[int(np.argmin(levels))]
    level = min(min(levels), _corrected_level(nearest, params, list(range(q.shape[1])), sigma))
    return level <= _CORRECTED * RAYLEIGH * sigma


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
    """Joint, or else pair of joints, whose correction explains the images of a pose; or none."""
    for size in (1, 2):
        pairs = list(itertools.combinations(range(pose.q.shape[1]), size))
        levels = [_corrected_level(pose, params, list(joints), sigma) for joints in pairs]
        if min(levels, default=np.inf) <= _CORRECTED * RAYLEIGH * sigma:
            return pairs[int(np.argmin(levels))]
    return ()


def _corrected_level(pose: LeastSquares, params: Parameters, joints: list[int], sigma: float) -> float:
    """Median residual, px, after a robust fit of some joints of a pose to its images.

    The other joints may be off by their noise.
    """
    seen, n = pose.detections.seen, pose.q.shape[1]
    others = np.setdiff1d(np.arange(n) if pose.tau is not None else joints, joints)
    moved = np.eye(n)[[*joints, *others]]

    def residual(x: FloatArray) -> FloatArray:
        images = dataclasses.replace(pose, q=pose.q + x @ moved).residual(params)[seen].ravel()
        return images if pose.tau is None else np.concatenate([images, x[len(joints) :] / pose.tau[others]])

    found = least_squares(residual, np.zeros(len(moved)), loss="soft_l1", f_scale=sigma)
    return float(np.median(np.linalg.norm(found.fun[: 2 * int(seen.sum())].reshape(-1, 2), axis=1)))


def _doubtful_observations(solution: Solution, found: Outliers, epipolar: Epipolar) -> BoolArray:
    """Mask (N,) of rejected, unexplained observations that both views agree on, if a pose has several.

    Errors of detection break the epipolar geometry; observations that obey it contradict the robot model.
    """
    detections = undistorted(solution.problem.detections, solution.params.lens)
    both = detections.both
    out = both & ~solution.used.all(axis=0) & ~found.explained.any(axis=0)
    out[both] &= epipolar.within(detections.rows(both), _CONSISTENT)
    at, poses = detections.pose_of, len(detections.q)
    share = np.bincount(at[out], minlength=poses) / np.maximum(np.bincount(at[both], minlength=poses), 1)
    return np.asarray(out & (share >= _MIN_OF_POSE)[at])


def describe_unexplained(solution: Solution, found: Outliers, epipolar: Epipolar) -> str:
    """Describe rejected observations that both views agree on, which contradict a fit; else empty."""
    total = int(solution.problem.detections.both.sum())
    count = int(_doubtful_observations(solution, found, epipolar).sum())
    if count <= max(3.0, _MAX_UNEXPLAINED * total):
        return ""
    return (
        f"in {count} of {total} observations both cameras agree with each other but not with the robot; "
        "check the joint readings and types (R or P)"
    )


def describe_other_motion(solution: Solution, found: Outliers, epipolar: Epipolar) -> str:
    """Describe a motion other than the joint readings that rejected observations agree on; else empty.

    It takes observations that both views agree on, at poses of which the rest is kept. Corners of an image
    share errors, so it takes a large share of the poses too.
    """
    problem, total = solution.problem, int(solution.problem.detections.both.sum())
    out, count, poses = _doubtful_observations(solution, found, epipolar), 0, 0
    for k in np.unique(problem.detections.pose_of[out]):
        rows = np.flatnonzero(out & (problem.detections.pose_of == k))
        if rows.size < _AGREEING:
            continue
        some = rows[:: max(1, rows.size // _MAX_OF_POSE)]
        alone = LeastSquares.of(problem.detections.rows(some), problem.q_reference).with_noise(problem.tau)
        if _fits_other_joints(alone, solution.params, problem.q, solution.sigma_px):
            count, poses = count + rows.size, poses + 1
    seen = np.unique(problem.detections.pose_of).size
    if count <= max(3.0, _MAX_UNEXPLAINED * total) or poses <= _MANY_POSES * seen:
        return ""
    return (
        f"{count} of {total} observations, at {poses} of {seen} poses, show other joints than those read; "
        "check how poses and images are paired, and the joint readings and types (R or P)"
    )


def noise_at_free_poses(solution: Solution) -> float:
    """Noise per coordinate, px, of a fit in which the body moves freely to each pose.

    Errors of joints have no part in it: to first order it removes from the residuals everything that
    cameras, markers and rigid motions of the poses can undo, hence any motion of a robot.
    """
    solution = solution.kept().thinned(_FREED)
    problem, detections, used = solution.problem, solution.problem.detections, solution.used[..., None, None]
    (K, m), N = (len(problem.q), detections.marker.size), detections.pose_of.size
    images = solution.params.images(problem.joints(solution.params), detections.pose_of, detections.marker_of)
    points = images.points[0][:, :3]
    turned = cross_matrix(np.median(points, axis=0) - points)  # about the middle, negative
    J, by_place = problem.derivative(solution.params), images.by_point[0][..., :3]
    by_motion = np.concatenate([by_place @ turned, by_place], axis=3) * detections.weight[..., None, None]
    X = np.zeros((2, N, 2, 2 * CAMERA + 3 * m + 6 * K))
    for v in (0, 1):
        X[v, ..., v * CAMERA : (v + 1) * CAMERA] = J[v, ..., :CAMERA]
    for block, values, first in (
        (detections.marker_of, J[..., -3:], 2 * CAMERA),
        (detections.pose_of, by_motion, 2 * CAMERA + 3 * m),
    ):
        width = values.shape[-1]
        columns = first + width * block[:, None, None] + np.arange(width)
        np.put_along_axis(X, np.broadcast_to(columns, values.shape), values, axis=3)
    rows = (X * used).reshape(4 * N, -1)
    rows /= np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
    left = (solution.residual * used[..., 0]).ravel()
    squares, basis = np.linalg.eigh(rows.T @ rows)
    known = squares > OPEN_DIRECTION * squares[-1]
    explained = (basis[:, known].T @ (rows.T @ left)) ** 2 / squares[known]
    dof = 2 * int(np.count_nonzero(solution.used)) - int(np.count_nonzero(known))
    return float(np.sqrt(max(left @ left - explained.sum(), 0.0) / max(dof, 1)))


def outlier_rows(detections: Detections, out: BoolArray) -> IntArray:
    """List the detections of a mask (2, N) as sorted rows (L, 3): pose, marker number, view (2 for both)."""
    rows = np.flatnonzero(out.any(axis=0))
    view = np.where(out[:, rows].all(axis=0), 2, np.where(out[0, rows], 0, 1))
    found = np.stack(
        [detections.pose[detections.pose_of[rows]], detections.marker[detections.marker_of[rows]], view],
        axis=1,
    )
    return found[np.lexsort(found.T[::-1])].astype(np.int64)


def straight_joints(solution: Solution) -> list[int]:
    """Revolute joints that images do not see turn: by their gear, to first order, without a fit.

    A prismatic joint has the same motion as a revolute one with its axis far away that turns by nothing.
    """
    solution = solution.determined()[0].thinned(_TYPED)
    problem, params, used = solution.problem, solution.params, solution.used
    turned = (problem.joints(params) - problem.q_reference)[problem.detections.pose_of, None]
    by_gear = (problem.joint_derivative(params) * turned * used[..., None, None]).reshape(
        -1, turned.shape[-1]
    )
    J = problem.dense(problem.derivative(params), used)
    rows = problem.whitened(params, np.hstack([J, by_gear, solution.raw.reshape(-1, 1)]), used)
    J, by_gear, left = np.split(rows, [J.shape[1], rows.shape[1] - 1], axis=1)
    J = J / np.maximum(np.linalg.norm(J, axis=0), 1e-300)
    apart = by_gear - J @ np.linalg.lstsq(J, by_gear)[0]
    inverse = np.linalg.pinv(apart)
    gear, std = -inverse @ left[:, 0], solution.sigma_px * np.linalg.norm(inverse, axis=1)
    found = ~problem.detections.prismatic & (gear < -_STRAIGHT) & (gear < -_SURE * std)
    return [int(i) for i in np.flatnonzero(found)]


def joint_at_fault(search: Search, max_px: float, straight: Sequence[int] | None = None) -> str:
    """Describe the one change, of a joint or of the order of images, with which the model fits, or "".

    A rough fit compares all changes. The best are fitted completely and accepted only if the fit passes as a
    calibration does, with a noise of at most ``max_px``.

    straight : joints that alone may be of the other type.
    """
    detections = search.problem.detections
    few = detections.of_markers(starting_markers(detections, search.epipolar.noise_px, search.rng))
    changes = _hypotheses(few, search.problem.q_reference)
    if straight is not None:
        changes = [changes[_ORDERS + i] for i in straight]
    candidates = []
    try:
        for done, (words, changed, handicap) in enumerate(changes):
            search.progress("calibration, joint at fault", done, len(changes))
            seen = changed.detections.seen
            for start in islice(starts(dataclasses.replace(search, problem=changed), changed.detections), 1):
                params = minimize(
                    changed, start, seen, robust=True, cameras=False, max_steps=_SCREW_STEPS
                ).params
                # In logarithms neither a few gross errors nor many small ones outweigh the rest.
                level = np.mean(np.log(np.linalg.norm(changed.residual(params)[seen], axis=1) + 1e-9))
                candidates.append((float(level) + handicap, words, changed, params))
    except WorkFailed:
        return ""
    candidates.sort(key=lambda candidate: candidate[0])
    for _, words, changed, params in candidates[:_FOLLOWED]:
        found = fit_from(changed, params, search.epipolar)
        if found is None or found.sigma_px > max_px:
            continue
        if not describe_unexplained(found, Outliers.empty(changed.detections), search.epipolar):
            return words
    return ""


def _hypotheses(detections: Detections, q_reference: FloatArray) -> list[tuple[str, LeastSquares, float]]:
    """Hypotheses that a joint is of the other type or stands still, or of late images; with a penalty."""
    found, q = [], detections.q
    for order, shifted, remedy in (
        ("before", np.vstack([q[:1], q[:-1]]), "let each pose settle for longer (plant.settle_s)"),
        ("after", np.vstack([q[1:], q[-1:]]), "store readings with the image of the same pose"),
    ):
        words = f"each image shows the pose {order} its reading: {remedy}, and take the newest frame"
        found.append((words, LeastSquares.of(dataclasses.replace(detections, q=shifted), q_reference), 0.0))
    for i, slides in enumerate(detections.prismatic):
        flipped = detections.prismatic.copy()
        flipped[i] = not slides
        given, fits = ("prismatic", "revolute") if slides else ("revolute", "prismatic")
        letters = letters_of(flipped)
        remedy = f"check the types of joints ({letters} would fit)"
        words = f"by the images joint {i + 1} is {fits}, not {given}: {remedy}"
        other = dataclasses.replace(detections, prismatic=flipped)
        found.append((words, LeastSquares.of(other, q_reference), _SIMPLER))
    for i in range(len(q_reference) if len(q_reference) > 1 else 0):
        words = (
            f"by the images joint {i + 1} stands still while its readings move: check that they are its own"
        )
        fewer = dataclasses.replace(
            detections, q=np.delete(detections.q, i, axis=1), prismatic=np.delete(detections.prismatic, i)
        )
        found.append((words, LeastSquares.of(fewer, np.delete(q_reference, i)), 0.0))
    return found
