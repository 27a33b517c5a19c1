"""Parts of an arm that recorded poses leave open: the order of joints, and all of it where poses are few.

Joints that move one at a time about one reference show the same images in any order. Two orders differ where
several joints have moved, by the commutators of their operators. Where poses are few, several arms fit them,
each with a small covariance.
"""

import dataclasses
from collections.abc import Sequence
from itertools import combinations, product

import numpy as np

from projservo_cli.calibration.bundle_adjustment import LeastSquares
from projservo_cli.calibration.detections import MIN_MOTION, SAME_READING, Detections
from projservo_cli.calibration.prediction import Parameters
from projservo_cli.calibration.robust_fit import OPEN_DIRECTION, Solution
from projservo_cli.findings import REFUSES, Finding, Subject
from projservo_cli.messages import failed
from projservo_cli.records import FloatArray, IntArray

# Increase of χ² by another order above which the images decide against it: ten standard deviations.
_DECISIVE = 100.0
# Maximum number of markers in the comparison, and of joints between two of which every part is tried.
_MARKERS, _BETWEEN = 24, 8
# Numbers of a rigid motion from one pose to another, of a revolute joint and of a prismatic one.
_OF_MOTION, _OF_REVOLUTE, _OF_PRISMATIC = 6, 4, 2
# Numbers to spare for each joint, as trials of single joints have them, up to those of a motion.
_SPARE = 2


def undecided_pairs(solution: Solution, sigma_px: float) -> IntArray:
    """Pairs (p, 2) of joints, from 1, whose order matters and no image shows, at a noise in px.

    A pair is open if the images allow an order that inverts it, and of the joints between them each with one
    of both. Operators go with their joints, so single-joint trials stay as they are. An order is excluded
    if it moves the images, cleared of the parameters' derivatives, by more than noise; so are all orders
    that invert the same pairs and more.
    """
    scale = max(solution.problem.detections.marker.size / _MARKERS, 1.0)
    solution = solution.kept().thinned(_MARKERS)
    problem, params, used = solution.problem, solution.params, solution.used
    n = len(problem.q_reference)
    rows = problem.whitened(params, problem.dense(problem.derivative(params), used), used)
    Q, R = np.linalg.qr(rows / np.maximum(np.linalg.norm(rows, axis=0), 1e-300))
    U, size, _ = np.linalg.svd(R)
    known = Q @ U[:, size > OPEN_DIRECTION * size[0]]
    excluded, pairs = list[set[tuple[int, int]]](), list[tuple[int, int]]()
    for i, j in sorted(combinations(range(n), 2), key=lambda pair: pair[1] - pair[0]):
        between = range(i + 1, j)
        for chosen in product((False, True), repeat=min(len(between), _BETWEEN)):
            before = [k for k, first in zip(between, chosen, strict=False) if first]
            after = [k for k in between if k not in before]
            inverted = {(i, j), *product([i], before), *product(after, [j])}
            inverted |= {(k, other) for k, other in product(after, before) if k < other}
            if any(others <= inverted for others in excluded):
                continue
            order = [*range(i), *before, j, i, *after, *range(j + 1, n)]
            change = _change(problem, params, order) * problem.detections.weight[..., None] * used[..., None]
            change = problem.whitened(params, change.reshape(-1, 1), used)[:, 0]
            left = change - known @ (known.T @ change)
            if scale * (left @ left) <= _DECISIVE * sigma_px**2:
                pairs.append((i, j))
                break
            excluded.append(inverted)
    pairs = [pair for pair in sorted(pairs) if _effect(solution, *pair) > MIN_MOTION * sigma_px]
    found = problem.detections.numbers[np.array(pairs, dtype=np.int64).reshape(-1, 2)]
    return np.sort(found, axis=1)[np.lexsort(np.sort(found, axis=1).T[::-1])]


def _change(problem: LeastSquares, params: Parameters, order: Sequence[int]) -> FloatArray:
    """Change (V, N, 2) of the images, px, if the joints come in another order, their operators with them."""
    at, there, q = list(order), problem.detections, params.turned(problem.joints(params))
    other = dataclasses.replace(
        params, H_hat=params.H_hat[at], prismatic=params.prismatic[at], offsets=None, curve=None
    )
    there = dataclasses.replace(there, q=q[:, at], prismatic=there.prismatic[at])
    reordered = LeastSquares.of(there, np.zeros(len(at)), params.lens is not None)
    return np.asarray(reordered.pixels(other)[0] - problem.pixels(params)[0])


def _effect(solution: Solution, i: int, j: int) -> float:
    """Median motion of images at the ends of the ranges of two joints, px, by their order."""
    problem, q = solution.problem, np.tile(solution.problem.q_reference, (4, 1))
    q[:, [i, j]] = list(product(*((row.min(), row.max()) for row in problem.detections.q.T[[i, j]])))
    there = LeastSquares.of(
        problem.detections.everywhere(q), problem.q_reference, solution.params.lens is not None
    )
    order = [*range(i), j, *range(i, j), *range(j + 1, q.shape[1])]
    return float(np.median(np.linalg.norm(_change(there, solution.params, order), axis=-1)))


def require_enough_poses(detections: Detections) -> None:
    """Refuse poses that show hardly more of the arm, or of joints in a row, than these have.

    With as many numbers as unknowns an arm is one of finitely many, and no residual decides between them: of
    34 sets of five poses of a UR5 six predicted images 18 to 40 times worse than stated. With one motion to
    spare 1 of 120 was beyond 3 times. Raises WorkFailed with both numbers and the number of poses to record.
    """
    q, n = np.round(detections.q[np.unique(detections.pose_of)] / SAME_READING), detections.prismatic.size
    for i, j in sorted(combinations(range(n + 1), 2), key=lambda ends: ends[0] - ends[1]):
        poses, own = len(np.unique(q[:, i:j], axis=0)), _OF_REVOLUTE * (j - i)
        own -= (_OF_REVOLUTE - _OF_PRISMATIC) * int(detections.prismatic[i:j].sum())
        needed, shown = own + min(_SPARE * (j - i), _OF_MOTION), _OF_MOTION * (poses - 1)
        if shown >= needed or j - i == 1:  # range and noise decide for a single joint
            continue
        first, last = sorted(detections.numbers[[i, j - 1]].tolist())
        of = Subject() if j - i == n else Subject(joints=tuple(range(first, last + 1)))
        enough, by = -(-needed // _OF_MOTION) + 1, (Finding("numbers", amount=shown, limit=needed, unit="1"),)
        raise failed([Finding("few_postures", REFUSES, of, poses, limit=enough, unit="1", others=by)])
