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
def _extended(c: Constraints, tree: Tree, q: FloatArray, trial: Trial) -> tuple[int, bool]:
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
        here, there = tree.q[node], tree.q[new]
        for i in range(n):
            there[i] = q[i] if share == 1.0 else here[i] + share * (q[i] - here[i])
        got = reached(c, here, there, trial)
        if got < 1.0:
            # What was reached before a check failed is valid, but too near a border to grow from.
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
def grow(c: Constraints, trees: tuple[Tree, Tree], draws: FloatArray, trial: Trial) -> tuple[int, int, int]:
    """Grow two trees towards drawn joints (k, n) and each other until they meet.

    Returns the nodes of both at which they met, −1 where they did not; how many draws it took.
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
