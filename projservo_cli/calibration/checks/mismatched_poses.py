"""Poses that a fit rejects: images that show another pose, joints that come in another order."""

import dataclasses
from collections.abc import Iterator
from itertools import permutations

import numpy as np

from projservo_cli.calibration.detections import RAYLEIGH, Detections
from projservo_cli.calibration.robust_fit import Solution
from projservo_cli.findings import LIMITS, REFUSES, Finding, Subject
from projservo_cli.records import BoolArray, IntArray

# Median residual, in σ, below which something explains a pose.
EXPLAINED = 3.0
# Minimum share of the detections of an image that are rejected if its camera moved, or it shows another
# pose, and minimum number of them: two more than its motion has coordinates, to test it.
MOSTLY, SEEN_OF_IMAGE = 0.5, 4
# Steps of Gauss and Newton to the reading of a joint, and median residual by the next joint over that by it.
_STEPS, _CLEARER = 6, 2.0
# Median residual by another order of joints over that by the order as given, below which it explains poses,
# and over noise, within which it need only be half; maximum number of joints of which all orders are tried,
# and of markers by which.
_EXPLAINS, _OF_NOISE, _MOST_JOINTS, _ORDERED = 0.2, 1.5, 6, 8


def imaged_poses(solution: Solution, out: BoolArray) -> IntArray:
    """Images (P, 3), row of the pose, view and row of the pose that they show; others of that pose are kept.

    out : (V, N) rejected detections, the majority in each of these images.
    """
    detections, found = solution.problem.detections, list[tuple[int, int, int]]()
    if not out.any():
        return np.zeros((0, 3), dtype=np.int64)
    predicted = solution.params.predict(solution.problem.joints(solution.params))
    effect_px, poses = solution.joint_effect()[1], detections.pose_of
    limit_px = EXPLAINED * RAYLEIGH * float(np.hypot(solution.sigma_px, effect_px))
    for k in np.unique(poses[out.any(axis=0)]).tolist():
        at = poses == k
        seen, gone = (detections.seen & at).sum(axis=1), (out & at).sum(axis=1)
        enough = seen >= SEEN_OF_IMAGE
        off, kept = enough & (gone > MOSTLY * seen), enough & (gone < MOSTLY * seen)
        if not kept.any():
            continue
        for v in np.flatnonzero(off).tolist():
            rows = np.flatnonzero(detections.seen[v] & at)
            apart = predicted[:, v, detections.marker_of[rows]] - detections.pixels[v, rows]
            level = np.nan_to_num(np.median(np.linalg.norm(apart, axis=2), axis=1), nan=np.inf)
            level[k] = np.inf
            if level.min() <= limit_px:
                found.append((k, v, int(np.argmin(level))))
    return np.array(found, dtype=np.int64).reshape(-1, 3)


def findings_on_imaged_poses(detections: Detections, mismatched: IntArray) -> Iterator[Finding]:
    """Findings on images (P, 3) that show other poses, one for each view."""
    for v, name in enumerate(detections.view):
        if (of_view := mismatched[mismatched[:, 1] == v]).size:
            poses, others = (tuple(detections.pose[of_view[:, i]].tolist()) for i in (0, 2))
            instead = Finding("shown_poses", subject=Subject(poses=others))
            yield Finding("other_pose", LIMITS, Subject(views=(name,), poses=poses), others=(instead,))


def erring_joint(solution: Solution, poses: IntArray) -> Finding | None:
    """Find the one joint whose readings alone are wrong at poses, by rows, that a fit rejects.

    Of joints with parallel axes several explain them.
    """
    solution = solution.thinned(_ORDERED)
    params, detections = dataclasses.replace(solution.params, offsets=None), solution.problem.detections
    there = solution.problem.with_noise(None).rows(np.flatnonzero(np.isin(detections.pose_of, poses)))
    seen, tried = there.detections.seen, list[tuple[float, int, float]]()
    for i in range(len(params.H_hat)):
        off = np.zeros(len(there.q))
        for _ in range(_STEPS):
            here = dataclasses.replace(there, q=there.q + off[:, None] * np.eye(there.q.shape[1])[i])
            r, G = here.residual(params), here.joint_derivative(params)[..., i]
            square = here.at_poses((G**2).sum(axis=(0, 2)))
            off -= here.at_poses((G * r).sum(axis=(0, 2))) / np.maximum(square, 1e-300)
        level = float(np.median(np.linalg.norm(r, axis=2)[seen]))
        tried.append((np.nan_to_num(level, nan=np.inf), i, float(np.sqrt(np.mean(off[poses] ** 2)))))
    level, best, amount = min(tried)
    alike = sorted(i for own, i, _ in tried if own <= _CLEARER * level)
    if level > EXPLAINED * RAYLEIGH * solution.sigma_px or len(alike) == len(tried) > 1:
        return None
    subject = Subject(joints=tuple(sorted(detections.numbers[alike].tolist())))
    return Finding("erring_joint", REFUSES, subject, amount, unit=detections.units[best])


def other_order(solution: Solution, poses: IntArray) -> bool:
    """Whether joints in another order explain poses, by rows, that a fit rejects.

    Trials of one joint each give its operator, whatever the order; with many joints, only neighbours are
    tried in each other's places.
    """
    solution = solution.thinned(_ORDERED)
    problem, params = solution.problem, solution.params
    detections, n = problem.detections, len(params.H_hat)
    rows = np.flatnonzero(np.isin(detections.pose_of, poses))
    k = np.searchsorted(poses, detections.pose_of[rows])

    def level(order: tuple[int, ...]) -> float:
        """Median residual, px."""
        some = list(order)
        moved = dataclasses.replace(
            params, H_hat=params.H_hat[some], prismatic=params.prismatic[some], curve=None
        )
        images = moved.predict(problem.q[poses][:, some])[k, :, detections.marker_of[rows]].swapaxes(0, 1)
        off = np.linalg.norm(images - detections.pixels[:, rows], axis=2)[detections.seen[:, rows]]
        return float(np.median(np.nan_to_num(off, nan=np.inf)))

    given = tuple(range(n))
    if n <= _MOST_JOINTS:
        orders = list(permutations(given))[1:]
    else:
        orders = [(*given[:i], i + 1, i, *given[i + 2 :]) for i in range(n - 1)]
    if not (len(poses) and orders):
        return False
    best, noise_px = min(map(level, orders)), _OF_NOISE * RAYLEIGH * solution.sigma_px
    return best <= min(max(_EXPLAINS * level(given), noise_px), 0.5 * level(given))
