"""Path in joint space to a goal configuration: straight, or by RRT-Connect; or the reason for none.

J. Kuffner, S. LaValle, "RRT-Connect: an efficient approach to single-query path planning", ICRA 2000. It is
shortened, blended and timed. Random numbers come from a seed and are drawn before the trees grow: a
path is the same to the bit on any number of processors.
"""

import math
from typing import NamedTuple

import numpy as np

from projservo_cli.geometry.jit import internal, njit
from projservo_cli.planning.goal_configurations import STARTS, UNSURE, GoalFeatures, goals_of
from projservo_cli.planning.joint_constraints import (
    DEVIATIONS,
    SHARE,
    Constraints,
    Trial,
    margins_into,
    new_trial,
    reached,
    time_between,
)
from projservo_cli.planning.keep_out import only
from projservo_cli.planning.motion_margins import CLEAR, FRONT, IMAGE, JOINTS, column, columns_of_kind
from projservo_cli.planning.time_parameterization import TimedPath, minimum_time, time_parameterized
from projservo_cli.records import NO_SPREAD, FloatArray, IntArray, JointLimits

# Longest edge of a tree, s at the speed limits.
_REACH = 0.8
# A path shorter than this, s, is none.
_LEAST = 1e-9
# Draws that the trees are given at a time.
_CHUNK = 250
# Number of paths of the search, and draws after which no further one begins.
_WAYS, _FURTHER = 2, 300
# A straight line that takes this much longer than to the nearest goal is compared with paths of trees.
_LONGER = 1.2
_SHORTENINGS = 60
_ROUND_OFF = 1e-9
# Goals within this distance of excluded joints, rad or m, are excluded too.
_NEARBY = 0.1


class Tree(NamedTuple):
    """Joints that a start or the goals are joined to by valid straight paths."""

    q: FloatArray  # (k, n)
    parent: IntArray  # (k,) −1 at a root
    size: IntArray  # (1,) how many nodes there are


class SearchLimits(NamedTuple):
    """Limits and seed of a search."""

    max_samples: int = 20_000
    seed: int = 0
    max_goals: int = 64
    excluded: FloatArray = np.zeros((0, 1))  # (k, n) joints near which no goal is taken, rad or m


class JointPath(NamedTuple):
    """Result of a search."""

    goals: FloatArray  # (g, n) joints that show the goal, nearest in time first
    n_goals: int  # how many there are, kept or not
    solutions: int  # how many apart from whole turns
    hidden: int  # how many of those lie beyond the limits or do not show the face
    blocked: int  # how many of those lie within a region that is kept out of
    failures: IntArray  # (c + n,) how often each margin, and each joint's limit, stopped the search
    start_clearance: FloatArray  # (c,) margins of the start
    region: int  # the one that the start is within, counted from 1; 0 for none
    constraints: Constraints  # constraints, relaxed at start and goals
    corners: FloatArray  # (k, n) of the path; none if none was found
    timing: TimedPath | None = None  # path in time; None if there is no path or nothing limits its speed
    draws: int = 0  # draws by the trees
    trees: tuple[Tree, Tree] | None = None  # from the start and from the goals, where they were grown


def may_start(clearance: FloatArray) -> bool:
    """Whether a path may begin at joints of such margins (c,): at a limit, but not at the edge of a view."""
    return bool(clearance[JOINTS] >= 0.0 and (clearance[column(FRONT, 0) :] > 0.0).all())


def with_ends(c: Constraints, ends: FloatArray) -> Constraints:
    """Constraints relaxed at joints (k, n), and near them, to a share of the margins there.

    Their images were measured, so that no deviation of a prediction reduces their margins. Joints of which
    that share meets the full requirement are not relaxed.
    """
    demands = np.array([margins_at(c, q)[0] for q in ends])
    measured = np.array([margins_at(c._replace(spread=NO_SPREAD), q)[0] for q in ends])
    measured = np.where(np.isfinite(measured), measured, 0.0)
    less = np.where(measured > 0.0, demands - (1.0 - SHARE) * measured, demands - _ROUND_OFF)
    demands = np.where(SHARE * demands >= c.full, c.full, np.minimum(c.full, less))
    poor = (demands < c.full).any(axis=1)
    return c._replace(ends=np.ascontiguousarray(ends[poor]), end_demands=np.ascontiguousarray(demands[poor]))


def margins_at(c: Constraints, q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Margins (c,) and images (V, b, 2), px, at joints (n,)."""
    trial = new_trial(c)
    margins_into(c, q, trial)
    return trial.margins, trial.s


def within_region(c: Constraints, q: FloatArray) -> int:
    """Number, counted from 1, of the region that the body is in at joints (n,); 0 for none."""
    c = c._replace(spread=NO_SPREAD)
    return _nearest_region(c, q) if -math.inf < margins_at(c, q)[0][_clear(c)] <= 0.0 else 0


def _nearest_region(c: Constraints, q: FloatArray) -> int:
    """Number, counted from 1, of the region that the body is deepest in, or nearest to, at joints (n,)."""
    regions = [only(c.keep_out, r) for r in range(len(c.keep_out.occludes))]
    clear = [margins_at(c._replace(keep_out=region), q)[0][_clear(c)] for region in regions]
    return 1 + int(np.argmin(clear))


def _clear(c: Constraints) -> int:
    """Column of the margin of regions."""
    return column(CLEAR, len(c.O))


def first_within(c: Constraints, q: FloatArray) -> tuple[int, int]:
    """The last of joints (s, n) up to which a path keeps out of regions, and the number of the one it enters.

    All but the regions is left aside. The last of all and 0 if it enters none.
    """
    n = q.shape[1]
    endless = np.full(n, math.inf)
    full = np.r_[np.full(_clear(c), -1e12), c.full[_clear(c)]]  # finite, as demands are interpolated
    speed = np.where(np.isfinite(c.limits.speed), c.limits.speed, 1.0)
    limits = JointLimits(-endless, endless, speed, c.limits.acceleration)
    c = with_ends(c._replace(limits=limits, full=full), q[[0, -1]])
    trial = new_trial(c)
    for i in range(len(q) - 1):
        if reached(c, q[i], q[i + 1], trial) < 1.0:
            return i, _nearest_region(c, trial.q)
    return len(q) - 1, 0


def find_path(
    c: Constraints,
    target: GoalFeatures,
    start: FloatArray,
    taught: FloatArray,
    search: SearchLimits,
) -> JointPath:
    """Find a path from the start to joints that show the goal.

    start : (n,) joints, rad or m.
    taught : (k, n) joints at which the goal was taught, k ≥ 0.
    """
    n, rng = len(start), np.random.default_rng(search.seed)
    starts = np.vstack([taught, start[None], _drawn(c, start, STARTS, rng)])
    every, rank, (solutions, hidden, blocked) = goals_of(c, target, start, taught, starts)
    goals, rank = every[: search.max_goals], rank[: search.max_goals]
    off = np.abs(goals[:, None] - search.excluded)
    far = np.all(np.max(off, axis=2, initial=0.0) > _NEARBY, axis=1)
    goals, rank = goals[far], rank[far]
    clearance, _ = margins_at(c._replace(spread=NO_SPREAD), start)
    clearance[columns_of_kind(IMAGE, len(c.O))] += DEVIATIONS * c.spread.max_sigma  # the face was seen there
    trial = new_trial(c)
    path = JointPath(
        goals=goals,
        n_goals=len(every),
        solutions=solutions,
        hidden=hidden,
        blocked=blocked,
        failures=trial.failures,
        start_clearance=clearance,
        region=within_region(c, start),
        constraints=c,
        corners=np.empty((0, n)),
    )
    if len(goals) == 0 or not may_start(clearance):
        return path
    c = with_ends(c, np.vstack([start[None], goals]))
    path = path._replace(constraints=c)
    sure = goals[rank < UNSURE]
    for asked in (sure, goals) if 0 < len(sure) < len(goals) else (goals,):
        max_draws = (
            search.max_samples - path.draws if asked is goals else min(search.max_samples // 2, _FURTHER)
        )
        best, draws, trees = _shortest(c, start, asked, max_draws, rng, trial)
        path = path._replace(draws=path.draws + draws, trees=trees)
        if len(best) > 0:
            return path._replace(corners=best, timing=time_parameterized(c, best, trial))
    return path


def _drawn(c: Constraints, start: FloatArray, count: int, rng: np.random.Generator) -> FloatArray:
    """Random joints (count, n) within the limits; within half a turn of the start if there are none."""
    low = np.where(np.isfinite(c.limits.lower), c.limits.lower, start - np.pi)
    high = np.where(np.isfinite(c.limits.upper), c.limits.upper, start + np.pi)
    return np.asarray(low + (high - low) * rng.random((count, len(start))))


def _shortest(
    c: Constraints,
    start: FloatArray,
    goals: FloatArray,
    max_draws: int,
    rng: np.random.Generator,
    trial: Trial,
) -> tuple[FloatArray, int, tuple[Tree, Tree] | None]:
    """The shortest path (k, n) that was found to any of the goals (g, n), within a number of draws of joints.

    A straight one, if it takes little longer than to the nearest goal; otherwise the best of some paths of
    trees. Returns the path, empty if there is none; the draws it took; the trees that found it, or the first.
    """
    best, shortest, draws = np.empty((0, len(start))), math.inf, 0
    straight = next((goal for goal in goals if reached(c, start, goal, trial) == 1.0), None)
    if straight is not None:
        best = np.stack([start, straight])
        shortest = minimum_time(c.limits.speed, best)[-1]
    trees: tuple[Tree, Tree] | None = None
    if not shortest <= _LONGER * (np.abs(goals - start) / c.limits.speed).max(axis=1).min():
        for _ in range(_WAYS):
            left = (max_draws if math.isinf(shortest) else _FURTHER) - draws
            if left <= 0:
                break
            path, used, grown = _by_trees(c, start, goals, left, rng, trial)
            draws, trees = draws + used, trees or grown
            if path is not None:
                path = _shortened(c, path, rng, trial)
                if (time := minimum_time(c.limits.speed, path)[-1]) < shortest:
                    best, shortest, trees = path, time, grown
    return best, draws, trees


def _by_trees(
    c: Constraints,
    start: FloatArray,
    goals: FloatArray,
    max_draws: int,
    rng: np.random.Generator,
    trial: Trial,
) -> tuple[FloatArray | None, int, tuple[Tree, Tree]]:
    """A path of corners (k, n), None if none was found; how many draws it took; the trees."""
    nodes = min(max_draws, 100_000) * 4 + len(goals)
    trees = _new_tree(nodes, start[None]), _new_tree(nodes, goals)
    draws = 0
    while draws < max_draws:
        chunk = _drawn(c, start, min(_CHUNK, max_draws - draws), rng)
        first, last, used = _grow(c, trees, chunk, trial)
        draws += used
        if first >= 0:
            return np.vstack([_branch(trees[0], first)[::-1], _branch(trees[1], last)[1:]]), draws, trees
        if used < len(chunk):
            break
    return None, draws, trees


def _new_tree(max_draws: int, roots: FloatArray) -> Tree:
    """A tree of roots (r, n) with room for ``max_draws`` nodes."""
    q = np.empty((max(max_draws, len(roots)), roots.shape[1]))
    q[: len(roots)] = roots
    return Tree(q, np.full(len(q), -1), np.array([len(roots)]))


@internal
def _nearest(c: Constraints, tree: Tree, q: FloatArray) -> int:
    best, nearest = math.inf, 0
    n = q.shape[0]
    for k in range(tree.size[0]):
        seconds = 0.0
        for i in range(n):
            seconds = max(seconds, abs(tree.q[k, i] - q[i]) / c.limits.speed[i])
            if seconds >= best:
                break
        if seconds < best:
            best, nearest = seconds, k
    return nearest


@internal
def _extended(c: Constraints, tree: Tree, q: FloatArray, trial: Trial) -> tuple[int, bool]:
    """Grow the tree from its nearest node towards joints q; the last node, and whether it is there."""
    node = _nearest(c, tree, q)
    n = q.shape[0]
    while True:
        time = time_between(c.limits.speed, tree.q[node], q)
        if time <= _LEAST:
            return node, True
        if tree.size[0] == tree.q.shape[0]:
            return node, False
        share = min(1.0, _REACH / time)
        new = tree.size[0]
        here, there = tree.q[node], tree.q[new]
        for i in range(n):
            there[i] = q[i] if share == 1.0 else here[i] + share * (q[i] - here[i])
        got = reached(c, here, there, trial)
        if got < 1.0:
            # The part before a failed check is valid, but too near a border to grow from.
            got *= 0.5
            if got * share * time <= 0.05:
                return node, False
            for i in range(n):
                there[i] = here[i] + got * (there[i] - here[i])
        tree.parent[new] = node
        tree.size[0] += 1
        node = new
        if got < 1.0:
            return node, False


@njit
def _grow(c: Constraints, trees: tuple[Tree, Tree], draws: FloatArray, trial: Trial) -> tuple[int, int, int]:
    """Grow two trees towards drawn joints (k, n) and each other until they meet.

    Returns the nodes of both at which they met, −1 if they did not; how many draws it took.
    """
    for k in range(draws.shape[0]):
        first = trees[0] if k % 2 == 0 else trees[1]
        second = trees[1] if k % 2 == 0 else trees[0]
        if first.size[0] == first.q.shape[0] or second.size[0] == second.q.shape[0]:
            return -1, -1, k
        before = first.size[0]
        node, _ = _extended(c, first, draws[k], trial)
        if first.size[0] == before:
            continue
        other, there = _extended(c, second, first.q[node], trial)
        if there:
            return (node, other, k + 1) if k % 2 == 0 else (other, node, k + 1)
    return -1, -1, draws.shape[0]


def _branch(tree: Tree, node: int) -> FloatArray:
    """Joints (k, n) from a node to its root."""
    nodes = [node]
    while tree.parent[nodes[-1]] >= 0:
        nodes.append(int(tree.parent[nodes[-1]]))
    return tree.q[nodes]


def _shortened(c: Constraints, path: FloatArray, rng: np.random.Generator, trial: Trial) -> FloatArray:
    """Shorten a path (k, n) by straight segments, first between random places on it."""
    time = minimum_time(c.limits.speed, path)
    for ends in np.sort(rng.random((_SHORTENINGS, 2)), axis=1):
        if len(path) <= 2:
            return path
        low, high = ends * time[-1]
        i, j = np.clip(np.searchsorted(time, (low, high)) - 1, 0, None)
        if i == j:  # on one straight piece
            continue
        new = np.stack([np.interp((low, high), time, column) for column in path.T], axis=1)
        if minimum_time(c.limits.speed, new)[-1] < high - low and reached(c, new[0], new[1], trial) == 1.0:
            path = np.vstack([path[: i + 1], new, path[j + 1 :]])
            time = minimum_time(c.limits.speed, path)
    k = 1
    while k < len(path) - 1:
        if reached(c, path[k - 1], path[k + 1], trial) == 1.0:
            path, k = np.delete(path, k, axis=0), max(1, k - 1)
        else:
            k += 1
    return path
