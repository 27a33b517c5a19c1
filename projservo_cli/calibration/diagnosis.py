"""Diagnosis of outliers: wrong joint readings, exchanged marker numbers, wrong detections, a lens."""

import dataclasses
import itertools
from dataclasses import dataclass
from functools import reduce
from itertools import islice

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial import cKDTree

from projservo_cli.calibration.adjustment import LeastSquares, cross_matrix, minimize, settled
from projservo_cli.calibration.epipolar import OUTLIER, Epipolar
from projservo_cli.calibration.fit import OPEN_DIRECTION, Solution, fit_from, median_px
from projservo_cli.calibration.initialization import Search, carrying, starts, still
from projservo_cli.calibration.lens_estimation import straightened
from projservo_cli.calibration.prediction import CAMERA, Scene
from projservo_cli.calibration.readings import RAYLEIGH, Readings
from projservo_cli.records import BoolArray, FloatArray, IntArray, WorkFailed

# A pose is explained by a corrected joint reading when its median residual falls below so many σ.
_CORRECTED = 3.0
# Sightings of a pose by which wrong joint readings are told; least readings of a marker to judge it.
_SHOWN, _SEEN = 50, 3
# Sightings both views agree on, in units of the epipolar noise, are no errors of detection.
_CONSISTENT = 3.0
# Share of sightings both views agree on that may be left out of a fit, and share of the sightings of a pose
# that a wrong motion puts off at least: single corners under a slant err along the epipolar line.
_MOST_UNEXPLAINED, _LEAST_OF_POSE = 0.02, 0.25
# Sightings of one pose that agree on joints by more than chance.
_AGREEING = 5
# Markers by which the noise at free poses is told.
_FREED = 150


@dataclass(frozen=True, eq=False)
class Outliers:
    """Explanations of what was left out."""

    suspect: IntArray  # (S, 2) row of the pose and index of the joint whose reading no image agrees with
    swapped: IntArray  # (W, 3) row of the pose, index of the marker that was read and of the one it is
    poses: IntArray  # (P,) rows of poses whose images are of other joints than those read
    explained: BoolArray  # (2, N) readings that these explain

    @classmethod
    def nothing(cls, readings: Readings) -> "Outliers":
        """No explanation of anything."""
        rows = np.zeros((0, 3), dtype=np.int64)
        return cls(rows[:, :2], rows, rows[:, 0], np.zeros_like(readings.seen))

    @classmethod
    def of(cls, solution: Solution) -> "Outliers":
        """Explain the readings left out by exchanged marker numbers first, then by wrong joint readings."""
        problem, scene, used = solution.problem, solution.scene, solution.used
        readings, sigma = problem.readings, solution.sigma_px
        out = readings.seen & ~used
        swapped, explained = _swaps(problem, scene, out, OUTLIER * sigma)
        suspects, poses = list[tuple[int, int]](), list[int]()
        for k in np.flatnonzero(readings.count_at(used) == 0):
            here = readings.pose_of == k
            pose = dataclasses.replace(readings, seen=readings.seen & ~explained).rows(here)
            rows = np.flatnonzero(pose.seen.any(axis=0))
            if rows.size < 3:
                continue
            some = np.isin(np.arange(len(pose.pose_of)), rows[:: max(1, rows.size // _SHOWN)])
            alone = LeastSquares.of(pose.rows(some), problem.q_reference).with_noise(problem.tau)
            joints = _wrong_joints(alone, scene, sigma)
            suspects += [(int(k), i) for i in joints]
            if joints or _is_elsewhere(alone, scene, problem.q, sigma):
                explained[:, here] |= out[:, here]
                poses += [] if joints else [int(k)]
        pairs = np.array(suspects, dtype=np.int64).reshape(-1, 2)
        return cls(pairs, swapped, np.array(poses, dtype=np.int64), explained)


def _swaps(problem: LeastSquares, scene: Scene, out: BoolArray, limit: float) -> tuple[IntArray, BoolArray]:
    """Sightings (W, 3) that lie where another marker belongs in every view, and their readings (2, N).

    The other is itself not seen there, or left out; a view that fits its own marker speaks against it.
    """
    readings = problem.readings
    joints, rows = problem.joints(settled(problem, scene)), np.flatnonzero((out == readings.seen).all(axis=0))
    found = set()
    explained = np.zeros_like(out)
    for k in np.unique(readings.pose_of[rows]):
        here = readings.pose_of == k
        free = np.ones(readings.marker.size, dtype=bool)
        free[readings.marker_of[here & ~out.any(axis=0)]] = False
        predicted = np.nan_to_num(scene.seen(joints[k : k + 1])[0], nan=-np.inf)
        others = np.flatnonzero(free & np.isfinite(predicted).all(axis=(0, 2)))
        trees = [cKDTree(predicted[v, others]) for v in (0, 1)]
        for row in rows[here[rows]]:
            # A view that did not see the marker has no say.
            near = [
                trees[v].query_ball_point(readings.pixels[v, row], limit / readings.weight[v, row])
                for v in np.flatnonzero(readings.seen[:, row])
            ]
            marker = int(readings.marker_of[row])
            fits = np.setdiff1d(others[np.array(reduce(np.intersect1d, near), dtype=np.int64)], marker)
            if fits.size == 1:
                found.add((int(k), marker, int(fits[0])))
                explained[:, row] = out[:, row]
    # An exchange shows in both markers and is one finding.
    listed = sorted((k, a, b) for k, a, b in found if a < b or (k, b, a) not in found)
    return np.array(listed, dtype=np.int64).reshape(-1, 3), explained


def _is_elsewhere(pose: LeastSquares, scene: Scene, q: FloatArray, sigma: float) -> bool:
    """Whether other joints explain the images of a pose: those of another one (K, n), or near these."""
    poses = [dataclasses.replace(pose, q=np.broadcast_to(at, pose.q.shape), tau=None) for at in q]
    levels = [median_px(one.residual(scene), one.readings.seen) for one in poses]
    nearest = poses[int(np.argmin(levels))]
    level = min(min(levels), _corrected_level(nearest, scene, list(range(q.shape[1])), sigma))
    return level <= _CORRECTED * RAYLEIGH * sigma


def why_lost(solution: Solution, kept: BoolArray) -> IntArray:
    """Markers left out whole, (T, 2): index, and why, an index into ``WHY_LOST``; others (m,) are kept."""
    readings = solution.problem.readings
    near = np.linalg.norm(solution.residual, axis=2) <= OUTLIER * solution.sigma_px
    fits = readings.count_of(readings.seen & near)
    seen = readings.count_of(readings.seen)
    why = np.select([still(readings, solution.sigma_px), seen < _SEEN, fits > seen / _SEEN], [0, 3, 2], 1)
    return np.stack([np.flatnonzero(~kept), why[~kept]], axis=1)


def _wrong_joints(pose: LeastSquares, scene: Scene, sigma: float) -> tuple[int, ...]:
    """The joint, or else the pair of joints, whose correction explains the images of a pose; or none."""
    for size in (1, 2):
        pairs = list(itertools.combinations(range(pose.q.shape[1]), size))
        levels = [_corrected_level(pose, scene, list(joints), sigma) for joints in pairs]
        if min(levels, default=np.inf) <= _CORRECTED * RAYLEIGH * sigma:
            return pairs[int(np.argmin(levels))]
    return ()


def _corrected_level(pose: LeastSquares, scene: Scene, joints: list[int], sigma: float) -> float:
    """Median residual after some joints of a pose are fitted to its images, nearly by least distances, px.

    The others may be off by their noise.
    """
    seen, n = pose.readings.seen, pose.q.shape[1]
    others = np.setdiff1d(np.arange(n) if pose.tau is not None else joints, joints)
    moved = np.eye(n)[[*joints, *others]]

    def residual(x: FloatArray) -> FloatArray:
        images = dataclasses.replace(pose, q=pose.q + x @ moved).residual(scene)[seen].ravel()
        return images if pose.tau is None else np.concatenate([images, x[len(joints) :] / pose.tau[others]])

    found = least_squares(residual, np.zeros(len(moved)), loss="soft_l1", f_scale=sigma)
    return float(np.median(np.linalg.norm(found.fun[: 2 * int(seen.sum())].reshape(-1, 2), axis=1)))


def _doubtful(solution: Solution, found: Outliers, epipolar: Epipolar) -> BoolArray:
    """Sightings (N,) left out without explanation that both views agree on, where they are not alone.

    Errors of detection break the epipolar geometry; what obeys it speaks against the model of the robot.
    """
    readings = straightened(solution.problem.readings, solution.scene.lens)
    both = readings.both
    out = both & ~solution.used.all(axis=0) & ~found.explained.any(axis=0)
    out[both] &= epipolar.within(readings.rows(both), _CONSISTENT)
    at, poses = readings.pose_of, len(readings.q)
    share = np.bincount(at[out], minlength=poses) / np.maximum(np.bincount(at[both], minlength=poses), 1)
    return np.asarray(out & (share >= _LEAST_OF_POSE)[at])


def unexplained(solution: Solution, found: Outliers, epipolar: Epipolar) -> str:
    """What speaks against a fit: sightings left out that both views agree on, in words, else empty."""
    sightings = int(solution.problem.readings.both.sum())
    count = int(_doubtful(solution, found, epipolar).sum())
    if count <= max(3.0, _MOST_UNEXPLAINED * sightings):
        return ""
    return (
        f"in {count} of {sightings} sightings both cameras agree with each other but not with the robot; "
        "check the joint readings and types (R or P)"
    )


def other_motion(solution: Solution, found: Outliers, epipolar: Epipolar) -> str:
    """Other joints than those read that sightings left out agree on, in words, else empty.

    Of sightings that both views agree on, at poses of which the rest is kept.
    """
    problem, sightings = solution.problem, int(solution.problem.readings.both.sum())
    out, count = _doubtful(solution, found, epipolar), 0
    for k in np.unique(problem.readings.pose_of[out]):
        rows = np.flatnonzero(out & (problem.readings.pose_of == k))
        if rows.size < _AGREEING:
            continue
        some = rows[:: max(1, rows.size // _SHOWN)]
        alone = LeastSquares.of(problem.readings.rows(some), problem.q_reference).with_noise(problem.tau)
        count += rows.size if _is_elsewhere(alone, solution.scene, problem.q, solution.sigma_px) else 0
    if count <= max(3.0, _MOST_UNEXPLAINED * sightings):
        return ""
    return (
        f"{count} of {sightings} sightings show other joints than those read; check how poses and images are "
        "paired, and the joint readings and types (R or P)"
    )


def noise_at_free_poses(solution: Solution) -> float:
    """Noise per coordinate that is left where the body may move freely to each pose, px.

    No error of joints has a part in it: residuals are cleared, to first order, of what cameras, markers and
    rigid motions of the poses can undo. What a robot does to images is among these.
    """
    solution = solution.kept().of_some(_FREED)
    problem, readings, used = solution.problem, solution.problem.readings, solution.used[..., None, None]
    (K, m), N = (len(problem.q), readings.marker.size), readings.pose_of.size
    images = solution.scene.images(problem.joints(solution.scene), readings.pose_of, readings.marker_of)
    points = images.points[0][:, :3]
    turned = cross_matrix(np.median(points, axis=0) - points)  # about the middle, negative
    J, by_place = problem.derivative(solution.scene), images.by_point[0][..., :3]
    by_motion = np.concatenate([by_place @ turned, by_place], axis=3) * readings.weight[..., None, None]
    X = np.zeros((2, N, 2, 2 * CAMERA + 3 * m + 6 * K))
    for v in (0, 1):
        X[v, ..., v * CAMERA : (v + 1) * CAMERA] = J[v, ..., :CAMERA]
    for block, values, first in (
        (readings.marker_of, J[..., -3:], 2 * CAMERA),
        (readings.pose_of, by_motion, 2 * CAMERA + 3 * m),
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


def listed(readings: Readings, out: BoolArray) -> IntArray:
    """Readings of a mask (2, N) as sorted rows (L, 3): pose number, marker number, view (2 for both)."""
    rows = np.flatnonzero(out.any(axis=0))
    view = np.where(out[:, rows].all(axis=0), 2, np.where(out[0, rows], 0, 1))
    found = np.stack(
        [readings.pose[readings.pose_of[rows]], readings.marker[readings.marker_of[rows]], view], axis=1
    )
    return found[np.lexsort(found.T[::-1])].astype(np.int64)


# Hypotheses that are followed to the end, and steps of the screws by which they are compared before.
_FOLLOWED, _SCREW_STEPS = 2, 8
# A joint that stands still is a prismatic one of no speed: it is preferred unless the residuals with the
# other are smaller by more than this share.
_SIMPLER = 0.1


def blamed_joint(search: Search, most_px: float) -> str:
    """The one change of one joint with which the model does describe the data, in words; empty if none.

    All changes are compared first; the best are followed to the maximum of the likelihood and believed only
    where that passes as a calibration would and leaves no more than a noise, px.
    """
    readings = search.problem.readings
    few = readings.of_markers(carrying(readings, search.epipolar.noise_px, search.rng))
    changes = _hypotheses(few, search.problem.q_reference)
    candidates = []
    try:
        for done, (words, changed, handicap) in enumerate(changes):
            search.tell("calibration, joint at fault", done, len(changes))
            seen = changed.readings.seen
            for start in islice(starts(dataclasses.replace(search, problem=changed), changed.readings), 1):
                scene = minimize(changed, start, seen, robust=True, cameras=False, most=_SCREW_STEPS).scene
                # By logarithms neither a few gross errors nor many small ones outweigh the rest.
                level = np.mean(np.log(np.linalg.norm(changed.residual(scene)[seen], axis=1) + 1e-9))
                candidates.append((float(level) + handicap, words, changed, scene))
    except WorkFailed:
        return ""
    candidates.sort(key=lambda candidate: candidate[0])
    for _, words, changed, scene in candidates[:_FOLLOWED]:
        found = fit_from(changed, scene, search.epipolar)
        if found is None or found.sigma_px > most_px:
            continue
        if not unexplained(found, Outliers.nothing(changed.readings), search.epipolar):
            return words
    return ""


def _hypotheses(readings: Readings, q_reference: FloatArray) -> list[tuple[str, LeastSquares, float]]:
    """Every joint of the other type, every joint standing still: in words, as it then is, its handicap."""
    found = []
    for i, slides in enumerate(readings.prismatic):
        flipped = readings.prismatic.copy()
        flipped[i] = not slides
        given, fits = ("prismatic", "revolute") if slides else ("revolute", "prismatic")
        words = f"by the images joint {i + 1} is {fits}, not {given}: check --joints"
        found.append(
            (words, LeastSquares.of(dataclasses.replace(readings, prismatic=flipped), q_reference), _SIMPLER)
        )
    for i in range(len(q_reference) if len(q_reference) > 1 else 0):
        words = (
            f"by the images joint {i + 1} stands still while its readings move: check that they are its own"
        )
        fewer = dataclasses.replace(
            readings, q=np.delete(readings.q, i, axis=1), prismatic=np.delete(readings.prismatic, i)
        )
        found.append((words, LeastSquares.of(fewer, np.delete(q_reference, i)), 0.0))
    return found
