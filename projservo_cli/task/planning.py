"""A motion that keeps its distance from everything that must not happen: [RH00] section 4.3.

The coupled constraint of the paper on μ_t and μ_r, for both cameras, beside the image borders, the
joint limits and the conditioning of the operators. Of all monotone paths from (0, 0, 0) to (1, 1, 1)
the one whose smallest share (``task.margins``) is largest is taken, among equals the quickest.
"""

import math
from functools import lru_cache
from itertools import pairwise, product
from typing import NamedTuple

import numpy as np

from projservo_cli.geometry.algebra import apply, mat, sub, vec
from projservo_cli.geometry.displacement import wrap
from projservo_cli.geometry.mechanisms import Work
from projservo_cli.records import FloatArray
from projservo_cli.task.along import EQUALLY, Path, best_of, planning_workspace, timed
from projservo_cli.task.lattice import (
    COARSE,
    NODES,
    shortest,
    slowness,
    solve_joints,
    view_shares,
    widest,
    with_joints,
)
from projservo_cli.task.margins import (
    CONDITIONING,
    IMAGE,
    JOINTS,
    VISIBILITY,
    WORST,
    Demands,
    Reaching,
    image_margin,
    limit_margin,
)
from projservo_cli.task.path import straightened, view_path
from projservo_cli.task.search import WAYS, carry, traced
from projservo_cli.task.visibility import margin_coefficients

# A margin of conditioning that no path is bounded by.
ENDLESS = 1e9
# Joints are carried through every so many nodes of the fine lattice.
EVERY = (5, 4)
# How far beside a path, in nodes of the fine lattice, a better one is looked for.
BESIDE = 2
# The lattices of joints that were not looked at.
NOTHING = np.empty(0)


class Candidate(NamedTuple):
    """Lattices of one choice of senses, and what their best path is worth.

    Attributes
    ----------
    reaching : the task in these senses.
    views : (k, k, k) best smallest share in view of the paths up to each node.
    in_view : of those to the last node.
    field, joints, value : joints at coarse nodes, at all nodes, and best smallest share of the paths up
        to each node; without meaning where ``least`` is −∞.
    least : largest smallest share; −∞ where the views alone keep it from being good enough.
    """

    reaching: Reaching
    views: FloatArray
    in_view: float
    field: FloatArray
    joints: FloatArray
    value: FloatArray
    least: float


def turning_sense(reaching: Reaching) -> float:
    """Sense of the rotation onto the plane that keeps the face in sight: θ_r or the rest of a whole turn.

    At every share μ_t a camera sees the face for half a turn of θ around an angle φ(μ_t), [RH00]
    eqs. (13), (14) with p_0 = 0. That band moves with the translation, by less than half a turn; only
    the sense that ends in it can be reached in sight of the camera, whatever path is taken.
    """
    tau, theta, _ = (float(x) for x in reaching.amplitudes)
    if theta == 0.0:
        return theta
    senses = (theta, theta - math.copysign(2.0 * math.pi, theta))
    inside = [0, 0]
    H_t, H_r, a = mat(reaching.H_hat[0]), mat(reaching.H_hat[1]), vec(reaching.a)
    for row in reaching.O:
        O = vec(row)
        drift = apply(H_t, O)
        moved = sub(O, (tau * drift[0], tau * drift[1], tau * drift[2], tau * drift[3]))
        sign = math.copysign(1.0, float(reaching.a @ row))
        middle = [
            math.atan2(sign * c_s, sign * c_c)
            for _, c_s, c_c in (margin_coefficients(a, H_r, O), margin_coefficients(a, H_r, moved))
        ]
        end = middle[0] + wrap(middle[1] - middle[0])
        for i, sense in enumerate(senses):
            inside[i] += abs(sense - end) < 0.5 * math.pi
    return senses[1] if inside[1] > inside[0] else senses[0]


def plan_path(reaching: Reaching) -> Path:
    """Path whose smallest share is largest, and among those the quickest.

    Both senses of the rotation within the plane are looked at where either may be the better: from a
    quarter turn on, or where the shorter one leads through an image border. Where no path keeps all
    constraints, one is taken that the joints can follow all the same (``_relaxed``), and where there is
    none, one that keeps at least the face in sight and in both images.

    Parameters
    ----------
    reaching : the task; its scale is not used.
    """
    relaxed = reaching.demands
    reaching = reaching._replace(demands=relaxed._replace(miss_px=0.0))
    work, newton = planning_workspace(reaching), np.empty(len(reaching.q_start))
    theta_p = float(reaching.amplitudes[2])
    reaching = _turned(reaching, turning_sense(reaching), theta_p)
    other = _turned(reaching, reaching.amplitudes[1], theta_p - math.copysign(2.0 * math.pi, theta_p))
    candidates = [_candidate(reaching, 0.0, work, newton)]
    least = candidates[0].least
    if theta_p != 0.0 and (abs(theta_p) > 0.5 * math.pi or least <= 0.0):
        candidates.append(_candidate(other, max(EQUALLY * least, 0.0), work, newton))
    good = max(EQUALLY * max(candidate.least for candidate in candidates), 0.0)
    paths = [_quickest(candidate) for candidate in candidates if candidate.least > good]
    best = best_of(paths)
    if best is None or not best.holds():
        if theta_p != 0.0 and len(candidates) == 1:
            candidates.append(_candidate(other, 0.0, work, newton))
        best = best_of([*paths, *_narrow(candidates, work)])
    if (best is None or not best.holds()) and relaxed.miss_px > 0.0:
        best = _relaxed(candidates, relaxed._replace(conditioning=0.0), work, newton)
    if best is None or not best.holds():
        best = best_of([*paths, _in_view(candidates)])
    assert best is not None
    return best


def _turned(reaching: Reaching, theta_r: float, theta_p: float) -> Reaching:
    """The same task with other senses of the rotations, and the scales of visibility and image."""
    turned = reaching._replace(amplitudes=np.array([reaching.amplitudes[0], theta_r, theta_p]))
    ends = np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    visibility, distance = np.empty((2, 2)), np.empty((2, 2))
    view_path(turned, ends, visibility, distance)
    scale = np.ones(4)
    scale[VISIBILITY] = _positive(visibility.min())
    scale[IMAGE] = _positive(image_margin(distance.min(), reaching.demands))
    return turned._replace(scale=scale)


def _positive(margin: float) -> float:
    return margin if margin > 0.0 else 1.0


def _candidate(reaching: Reaching, good: float, work: Work, newton: FloatArray) -> Candidate:
    """Fill the lattices of one choice of senses; those of the joints only where the views let it be good."""
    shares, views = np.empty((NODES, NODES, NODES)), np.empty((NODES, NODES, NODES))
    view_shares(reaching, shares, np.empty((2 * len(reaching.A), 7)))
    in_view = widest(shares, views)
    found = Candidate(reaching, views, in_view, NOTHING, NOTHING, NOTHING, -math.inf)
    return _with_joints(found, work, newton) if in_view > good else found


def _with_joints(candidate: Candidate, work: Work, newton: FloatArray) -> Candidate:
    """The candidate with the joints of its nodes."""
    reaching, shares = candidate.reaching, candidate.views.copy()
    n = len(reaching.q_start)
    field = np.empty((COARSE, COARSE, COARSE, n + 1))
    solve_joints(reaching, work, newton, np.empty((2, 4)), np.empty(field.shape[:3]), field)
    ends = field[0, 0, 0], field[-1, -1, -1]
    reaching.scale[JOINTS] = _positive(min(limit_margin(end[:n], reaching.demands) for end in ends))
    reaching.scale[CONDITIONING] = _positive(min(float(end[n]) for end in ends))
    joints, value = np.empty((*shares.shape, n)), np.empty_like(shares)
    with_joints(reaching, field, np.empty((COARSE, n + 1)), shares, joints)
    return candidate._replace(field=field, joints=joints, value=value, least=widest(shares, value))


def _quickest(candidate: Candidate) -> Path:
    """Quickest path of a candidate among those of the largest smallest share."""
    reaching, field = candidate.reaching, candidate.field
    mu = _corners(reaching, field, candidate.value, candidate.least, candidate.joints)
    return timed(reaching, mu)


def _narrow(candidates: list[Candidate], work: Work) -> list[Path]:
    """A path for joints carried from node to node, of the first candidate that has one that holds.

    Through coarse nodes first, and where that does not hold between them, through the fine ones around it.
    """
    in_view = [candidate for candidate in candidates if candidate.in_view > 0.0]
    for every, (reaching, views, *_) in product(EVERY, in_view):
        corners = _carried(reaching, np.ascontiguousarray(views[::every, ::every, ::every]), work)
        if not len(corners):
            continue
        path = timed(reaching, corners)
        if path.holds():
            return [path]
        corners = _carried(reaching, _around(corners, views), work)
        if len(corners) and (path := timed(reaching, corners)).holds():
            return [path]
    return []


def _carried(reaching: Reaching, views: FloatArray, work: Work) -> FloatArray:
    """Corners (c, 3) of the widest path for joints carried through the nodes (k, k, k) in view; or none."""
    n, last = len(reaching.q_start), len(views) - 1
    value, came = np.empty((*views.shape, WAYS)), np.empty((*views.shape, WAYS), dtype=np.int64)
    joints, start, scratch = np.empty((*value.shape, n)), np.empty((n, 4, 4)), np.empty((10, max(n, 4)))
    carry(reaching, views, value, joints, came, (NODES - 1) // last, start, scratch, work)
    path = np.empty((3 * len(views), 3), dtype=np.int64)
    return np.asarray(path[: traced(value, came, path)] / last)


def _around(corners: FloatArray, views: FloatArray) -> FloatArray:
    """The views (k, k, k) of the nodes near a path, ``WORST`` elsewhere."""
    near = np.full_like(views, WORST)
    for first, last in pairwise(corners):
        for node in np.rint(np.linspace(first, last, COARSE) * (NODES - 1)).astype(int):
            box = tuple(slice(max(0, i - BESIDE), i + BESIDE + 1) for i in node)
            near[box] = views[box]
    return near


def _relaxed(candidates: list[Candidate], demands: Demands, work: Work, newton: FloatArray) -> Path | None:
    """Path of the smallest miss, then of the best conditioning, that joints can follow at all.

    Where the operators are too dependent the joints stay behind by as much as the demands let them.
    """
    paths = []
    for candidate in candidates:
        if candidate.in_view > 0.0:
            reaching = candidate.reaching._replace(demands=demands, scale=candidate.reaching.scale.copy())
            found = _with_joints(candidate._replace(reaching=reaching), work, newton)
            if found.least > 0.0:
                paths.append(_quickest(found))
    paths = [path for path in paths if path.holds()]
    return min(paths, key=lambda path: (path.along.miss.max(), -path.along.condition.min()), default=None)


def _in_view(candidates: list[Candidate]) -> Path:
    """Shortest path in shares of the candidate that keeps its distance best, joints left aside."""
    candidate = max(candidates, key=lambda candidate: candidate.in_view)
    demands = candidate.reaching.demands
    endless = np.full(3, math.inf)
    free = candidate.reaching._replace(demands=demands._replace(lower=-endless, upper=endless, speed=endless))
    shares = _grid(NODES)
    field = np.concatenate([_grid(COARSE), np.full((COARSE,) * 3 + (1,), ENDLESS)], axis=3)
    return timed(candidate.reaching, _corners(free, field, candidate.views, candidate.in_view, shares))


@lru_cache(maxsize=2)
def _grid(nodes: int) -> FloatArray:
    """Shares at the nodes of a lattice (k, k, k, 3)."""
    axis = np.linspace(0.0, 1.0, nodes)
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=3)


def _corners(
    reaching: Reaching, field: FloatArray, value: FloatArray, least: float, joints: FloatArray
) -> FloatArray:
    """Corners (c, 3) of the straightened shortest path through nodes of at least that share."""
    weight = np.empty(joints.shape[3])
    slowness(reaching.demands.speed, weight)
    path = np.empty((3 * NODES, 3), dtype=np.int64)
    cost, came = np.empty_like(value), np.empty(value.shape, dtype=np.int64)
    path = path[: shortest(value, least, joints, weight, cost, came, path)]
    kept = np.empty(len(path) + 1, dtype=np.int64)
    count = straightened(reaching, field, weight, path, NODES - 1, least, kept)
    return np.asarray(path[kept[:count]] / (NODES - 1))
