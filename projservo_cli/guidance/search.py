"""A way through joint space: straight lines first, then two trees that grow towards each other.

J. Kuffner, S. LaValle, "RRT-Connect: an efficient approach to single-query path planning", ICRA 2000. Random
numbers are drawn by the caller, so that a plan is the same to the bit whoever makes others beside it.
"""

import math
from typing import NamedTuple

import numpy as np

from projservo_cli.geometry.jit import internal, njit
from projservo_cli.guidance.validity import Constraints, Trial, reached, time_between
from projservo_cli.records import FloatArray, IntArray

# Longest edge of a tree, s at the speed limits.
REACH = 0.8
# A way shorter than this, s, is none.
LEAST = 1e-9


class Tree(NamedTuple):
    """Joints that a start or the goals are joined to by valid straight ways."""

    q: FloatArray  # (k, n)
    parent: IntArray  # (k,) −1 at a root
    size: IntArray  # (1,) how many nodes there are


def new_tree(most: int, roots: FloatArray) -> Tree:
    """A tree of roots (r, n) with room for so many nodes."""
    q = np.empty((max(most, len(roots)), roots.shape[1]))
    q[: len(roots)] = roots
    return Tree(q, np.full(len(q), -1), np.array([len(roots)]))


@internal
def _nearest(c: Constraints, tree: Tree, q: FloatArray) -> int:
    best, nearest = math.inf, 0
    n = q.shape[0]
    for k in range(tree.size[0]):
        most = 0.0
        for i in range(n):
            most = max(most, abs(tree.q[k, i] - q[i]) / c.speed[i])
            if most >= best:
                break
        if most < best:
            best, nearest = most, k
    return nearest


@internal
def _extended(
    c: Constraints, tree: Tree, q: FloatArray, target: FloatArray, trial: Trial
) -> tuple[int, bool]:
    """Grow the tree from its nearest node towards joints q; the last node, and whether it is there."""
    node = _nearest(c, tree, q)
    n = q.shape[0]
    while True:
        time = time_between(c.speed, tree.q[node], q)
        if time <= LEAST:
            return node, True
        if tree.size[0] == tree.q.shape[0]:
            return node, False
        share = min(1.0, REACH / time)
        new = tree.size[0]
        for i in range(n):
            target[i] = q[i] if share == 1.0 else tree.q[node, i] + share * (q[i] - tree.q[node, i])
        got = reached(c, tree.q[node], target, trial)
        if got < 1.0:
            # What was reached before a check failed is valid, but too near a border to grow from.
            got *= 0.5
            if got * share * time <= 0.05:
                return node, False
        for i in range(n):
            tree.q[new, i] = tree.q[node, i] + got * (target[i] - tree.q[node, i]) if got < 1.0 else target[i]
        tree.parent[new] = node
        tree.size[0] += 1
        node = new
        if got < 1.0:
            return node, False


@njit
def grow(
    c: Constraints, trees: tuple[Tree, Tree], draws: FloatArray, scratch: FloatArray, trial: Trial
) -> tuple[int, int, int]:
    """Grow two trees towards drawn joints (k, n) and each other until they meet.

    scratch : (n,).
    Returns the nodes of both at which they met, −1 where they did not; how many draws it took.
    """
    for k in range(draws.shape[0]):
        first = trees[0] if k % 2 == 0 else trees[1]
        second = trees[1] if k % 2 == 0 else trees[0]
        if first.size[0] == first.q.shape[0] or second.size[0] == second.q.shape[0]:
            return -1, -1, k
        before = first.size[0]
        node, _ = _extended(c, first, draws[k], scratch, trial)
        if first.size[0] == before:
            continue
        other, there = _extended(c, second, first.q[node], scratch, trial)
        if there:
            return (node, other, k + 1) if k % 2 == 0 else (other, node, k + 1)
    return -1, -1, draws.shape[0]


@njit
def first_straight(c: Constraints, start: FloatArray, goals: FloatArray, trial: Trial) -> int:
    """The first of the goals (g, n) to which the straight way is valid, −1 for none."""
    for g in range(goals.shape[0]):
        if reached(c, start, goals[g], trial) == 1.0:
            return g
    return -1
