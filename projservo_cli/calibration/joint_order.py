"""Order of joints along the arm: the pairs that no recorded pose decides.

Joints that move one at a time about one reference show the same images in any order. Two orders differ where
several joints have moved, by the commutators of their operators.
"""

import dataclasses
from collections.abc import Iterator
from functools import cache
from itertools import combinations, product

import numpy as np

from projservo_cli.calibration.adjustment import LeastSquares, minimize
from projservo_cli.calibration.detections import MIN_MOTION
from projservo_cli.calibration.fit import OPEN_DIRECTION, Solution
from projservo_cli.calibration.prediction import Parameters
from projservo_cli.records import IntArray

# Increase of χ² by another order above which the images decide against it: five standard deviations.
_DECISIVE = 25.0
# Maximum number of joints between two of which every part is tried.
_BETWEEN = 8
# Multiple of that increase, to first order, from which no fit is tried: parameters never undo so much.
_PLAIN = 400.0
# Maximum number of markers in the comparison.
_MARKERS = 24
# Maximum number of steps in which parameters of another order follow the images.
_STEPS = 10


def undecided_pairs(solution: Solution, sigma_px: float) -> IntArray:
    """Pairs (p, 2) of joints, from 1, whose order matters and no image shows, at a noise in px.

    A pair is open if the images allow an order that inverts it, and of the joints between them each with one
    of both. Operators go with their joints, so single-joint trials stay as they are. An order is excluded
    where it moves the images, cleared of the parameters' derivatives, by more than noise, and its best fit is
    worse by as much; so are all orders that invert the same pairs and more.
    """
    problem = solution.problem
    n, m = len(problem.q_reference), problem.detections.marker.size
    if n == 1:
        return np.zeros((0, 2), dtype=np.int64)
    scale, solution = m / min(m, _MARKERS), solution.kept().thinned(_MARKERS)
    problem, params, used = solution.problem, solution.params, solution.used
    rows = problem.whitened(params, problem.dense(problem.derivative(params), used), used)
    Q, R = np.linalg.qr(rows / np.maximum(np.linalg.norm(rows, axis=0), 1e-300))
    U, size, _ = np.linalg.svd(R)
    known = Q @ U[:, size > OPEN_DIRECTION * size[0]]

    @cache
    def level() -> float:
        """Squares that the order as given leaves of these markers, px²."""
        return minimize(problem, params, used, robust=False, max_steps=_STEPS).cost

    def allowed(order: tuple[int, ...]) -> bool:
        """Whether the images allow an order."""
        other, reordered = _reordered(problem, params, order)
        change = (other.residual(reordered) - problem.residual(params)) * used[..., None]
        change = problem.whitened(params, change.reshape(-1, 1), used)[:, 0]
        left = change - known @ (known.T @ change)
        if not scale * (left @ left) <= _PLAIN * _DECISIVE * sigma_px**2:
            return False
        if scale * (left @ left) <= _DECISIVE * sigma_px**2:
            return True
        fit = minimize(other, reordered, used, robust=False, max_steps=_STEPS)
        return bool(scale * (fit.cost - level()) <= _DECISIVE * sigma_px**2)

    excluded, pairs = list[set[tuple[int, int]]](), list[tuple[int, int]]()
    for i, j in sorted(combinations(range(n), 2), key=lambda pair: pair[1] - pair[0]):
        for before in _parts(range(i + 1, j)):
            after = [k for k in range(i + 1, j) if k not in before]
            inverted = {(i, j), *product([i], before), *product(after, [j])}
            inverted |= {(k, other) for k, other in product(after, before) if k < other}
            if any(others <= inverted for others in excluded):
                continue
            if allowed((*range(i), *before, j, i, *after, *range(j + 1, n))):
                pairs.append((i, j))
                break
            excluded.append(inverted)
    pairs = [pair for pair in sorted(pairs) if _matters(solution, pair, sigma_px)]
    return np.array(pairs, dtype=np.int64).reshape(-1, 2) + 1


def _parts(between: range) -> Iterator[tuple[int, ...]]:
    """Yield all parts of the joints between two, or those next to the first where they are many."""
    for size in range(len(between) + 1):
        yield from combinations(between, size) if len(between) <= _BETWEEN else [tuple(between[:size])]


def _reordered(
    problem: LeastSquares, params: Parameters, order: tuple[int, ...]
) -> tuple[LeastSquares, Parameters]:
    """Problem and parameters whose joints come in another order, their operators with them."""
    at = list(order)
    detections = dataclasses.replace(
        problem.detections, q=problem.detections.q[:, at], prismatic=problem.detections.prismatic[at]
    )
    other = LeastSquares.of(detections, problem.q_reference[at], params.lens is not None)
    offsets = None if params.offsets is None else params.offsets[:, at]
    params = dataclasses.replace(
        params, H_hat=params.H_hat[at], prismatic=params.prismatic[at], offsets=offsets
    )
    return other.with_noise(None if problem.tau is None else problem.tau[at]), params


def _matters(solution: Solution, pair: tuple[int, int], sigma_px: float) -> bool:
    """Whether the order of two joints moves images at the ends of their ranges, by more than noise."""
    problem, params = solution.problem, solution.params
    q = np.repeat(problem.q_reference[None], 4, axis=0)
    ends = np.array([problem.detections.q.min(axis=0), problem.detections.q.max(axis=0)])
    for k, i in enumerate(pair):
        q[:, i] = ends[[0, 1, 0, 1] if k else [0, 0, 1, 1], i]
    order = list(range(q.shape[1]))
    order.remove(pair[1])
    order.insert(pair[0], pair[1])
    there = LeastSquares.of(problem.detections.everywhere(q), problem.q_reference, params.lens is not None)
    other, reordered = _reordered(there, params, tuple(order))
    change = np.linalg.norm(other.pixels(reordered)[0] - there.pixels(params)[0], axis=-1)
    return bool(not np.median(change) <= MIN_MOTION * sigma_px)
