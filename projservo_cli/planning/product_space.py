"""A motion that keeps its distance from everything that must not happen: [RH00] section 4.3.

The coupled constraint of the paper on μ_t and μ_r, for both cameras, with the image borders, the
joint limits and the conditioning of the operators. Of all monotone paths from (0, 0, 0) to (1, 1, 1)
on a lattice of shares μ_t, μ_r, μ_p the one whose smallest margin, in shares of the required ones, is largest
is taken, among equals the quickest.
"""

import itertools
import math
from typing import NamedTuple

import numpy as np

from projservo_cli.geometry.jit import merged, njit
from projservo_cli.geometry.null_space import row_into
from projservo_cli.planning.joint_constraints import time_between
from projservo_cli.planning.motion_margins import (
    IMAGE,
    OF_MOTION,
    VISIBILITY,
    Along,
    Carrier,
    Motion,
    Reaching,
    along_shares,
    carrier_of,
    carry_joints,
    displacements_into,
    joint_margins_into,
    limit_margin,
    measured,
    room_along,
)
from projservo_cli.planning.time_parameterization import minimum_time
from projservo_cli.records import BoolArray, FloatArray, IntArray

# Values of each share; the second if no path stays in view on the first.
_NODES = (13, 19)
# A joint that moves more than this between two nodes, rad or m, has changed its branch.
_MOST_STRIDE = 1.5
# Parts in which the path between them is made if the joints do not settle in one.
_BETWEEN = 4
# Newton step, rad or m, after which joints at a node are good enough: they err by its square.
_ROUGH = 1e-2
# Between two paths equally short, the one with longer straight steps: a share of the duration of a rad at 1
# rad/s.
_STRAIGHTER = 1e-4
# A straight piece may take this much longer than the steps of the lattice that it replaces.
_DETOUR = 1.01
_ROUND_OFF = 1e-9
# Points of a path at which its joints and margins are looked at.
_CHECKS = 151
# Shares of this part of the best one are as good; the quicker path is better.
_EQUALLY = 0.95
_SIGHT = [OF_MOTION.index(VISIBILITY), OF_MOTION.index(IMAGE)]


def duration(motion: Motion) -> float:
    """Time a motion takes at the joint-speed limit, s; NaN if nothing limits or joints cannot follow."""
    speed = motion.reaching.demands.limits.speed
    return float(minimum_time(speed, motion.along.q)[-1]) if np.isfinite(speed).any() else math.nan


def evenly(motion: Motion, sigma: FloatArray) -> FloatArray:
    """Shares (k, 3) at parts sigma (k,) of the duration, or of the motion of the joint that moves most.

    If the joints cannot follow or nothing moves, of the length of the path in shares.
    """
    time = minimum_time(motion.reaching.demands.limits.speed, motion.along.q)
    if not time[-1] > 0.0:
        time = minimum_time(np.ones(3), motion.mu)
    mu = np.stack([np.interp(sigma * time[-1], time, column) for column in motion.mu.T], axis=1)
    mu[sigma <= 0.0], mu[sigma >= 1.0] = motion.mu[0], motion.mu[-1]
    return mu


def plan_path(reaching: Reaching) -> Motion:
    """Path whose smallest share is as good as any, and among those the quickest.

    Other senses of the rotations are looked at if they may be the better: from a quarter turn within the
    plane on, or if the shorter ones lead through violations. If no path keeps all
    constraints, one is taken that keeps at least the face in sight and in both images.
    """
    short = abs(float(reaching.amplitudes[2])) <= 0.5 * math.pi
    paths = [along_shares(reaching, np.linspace(0.0, 1.0, _CHECKS)[:, None] * np.ones(3))]
    good = max(0.0, _EQUALLY * float(paths[0].shares().min()))
    best: tuple[float, Reaching, int] = (-math.inf, reaching, _NODES[0])
    for size in _NODES:
        for amplitudes in _senses(reaching.amplitudes):
            if short and good > 0.0:
                break
            # Only one sense of the rotation onto the plane can be in view, [RH00] eqs. (13), (14).
            if best[0] > 0.0 and amplitudes[1] != best[1].amplitudes[1]:
                continue
            lattice = _in_view(reaching._replace(amplitudes=amplitudes), size)
            if lattice.worth > best[0]:
                best = (lattice.worth, lattice.nodes.reaching, size)
            if lattice.worth > good:  # no joints can compensate a loss of view
                lattice = _with_joints(lattice)
                paths += [_quickest(lattice)] if lattice.worth > good else []
                good = max(good, _EQUALLY * lattice.worth)
        if best[0] > 0.0 or good > 0.0:
            break
    if not any(path.holds() for path in paths):
        paths.append(_quickest(_in_view(*best[1:])))
    return _best_of(paths)


def _senses(amplitudes: FloatArray) -> list[FloatArray]:
    """Amplitudes (3,) with both senses of each rotation, the given first."""
    tau, *angles = amplitudes.tolist()
    theta_r, theta_p = ((x, x - math.copysign(2.0 * math.pi, x)) if x else (x,) for x in angles)
    return [np.array([tau, r, p]) for p, r in itertools.product(theta_p, theta_r)]


def _best_of(paths: list[Motion]) -> Motion:
    """Of the paths in view, or of all if none is, the quickest whose smallest share is as good as any."""
    paths = [path for path in paths if path.shares()[:, _SIGHT].min() > 0.0] or paths
    minimum = [float(path.shares().min()) for path in paths]
    good = min(_EQUALLY * max(minimum), max(minimum))
    paths = [path for path, share in zip(paths, minimum, strict=True) if share >= good]
    return min(paths, key=lambda path: duration(path) if math.isfinite(duration(path)) else math.inf)


class _Lattice(NamedTuple):
    """Constraints at the values of each share."""

    nodes: Motion  # through all k³ nodes, in the order of C, of which only neighbours are near to one another
    follows: bool  # whether joints follow, and count; otherwise the shares themselves take time

    @property
    def worth(self) -> float:
        """Largest smallest share of all monotone paths."""
        return float(widest(self.minimum(self.nodes))[-1])

    def minimum(self, motion: Motion) -> FloatArray:
        """Smallest share (s,) along a motion in the lattice."""
        ends = self.nodes.along.margins[[0, -1]].min(axis=0)
        shares = motion.along.margins / np.where(ends > 0.0, ends, 1.0)
        return np.asarray(shares[:, slice(None) if self.follows else _SIGHT].min(axis=1))

    def moved(self, motion: Motion) -> tuple[FloatArray, FloatArray]:
        """Return the duration terms along a motion in the lattice (s, n), and its speeds (n,)."""
        speed = motion.reaching.demands.limits.speed
        if not self.follows:
            return motion.mu, np.ones(3)
        return motion.along.q, speed if np.isfinite(speed).any() else np.ones_like(speed)


def _in_view(reaching: Reaching, size: int) -> _Lattice:
    """A lattice of the views alone, with ``size`` values of each share."""
    mu = np.ascontiguousarray(np.indices((size, size, size)).reshape(3, -1).T / (size - 1.0))
    along = room_along(reaching, len(mu))
    displacements_into(reaching, mu, along)
    return _Lattice(measured(Motion(reaching, mu, along)), False)


def _with_joints(view: _Lattice) -> _Lattice:
    """The same with joints, in place, sought where a path in view leads."""
    reaching, mu, along = view.nodes
    value = widest(view.minimum(view.nodes))
    _joints_into(carrier_of(reaching), mu, value, _size(value), along)
    joint_margins_into(reaching.demands, along)
    return _Lattice(view.nodes, True)


def _quickest(lattice: _Lattice) -> Motion:
    """Quickest path among those of the largest smallest share, in straight pieces."""
    value = widest(lattice.minimum(lattice.nodes))
    free = value >= value[-1] - _ROUND_OFF  # no turn within the plane changes visibility
    corners = _straightened(lattice, shortest(free, *lattice.moved(lattice.nodes)))
    length = np.r_[0.0, np.cumsum(np.abs(np.diff(corners, axis=0)).max(axis=1))]
    positions = np.linspace(0.0, length[-1], _CHECKS)
    mu = np.stack([np.interp(positions, length, column) for column in corners.T], axis=1)
    return along_shares(lattice.nodes.reaching, mu)


def _straightened(lattice: _Lattice, path: IntArray) -> FloatArray:
    """Corners (c, 3) of a path of nodes (k,) that are left when straight pieces serve as well.

    A piece is as long as bisection finds one whose shares are as good and that takes no longer.
    """
    (reaching, mu, along), (q, speed) = lattice.nodes, lattice.moved(lattice.nodes)
    worth, time = lattice.worth, minimum_time(speed, q[path])

    def serves(i: int, j: int) -> bool:
        """Whether the piece from one node of the path to another does."""
        x = np.linspace(0.0, 1.0, 2 * (j - i) + 1)[:, None]
        piece = along_shares(reaching, (1.0 - x) * mu[path[i]] + x * mu[path[j]], along.q[path[i]])
        detour = minimum_time(speed, lattice.moved(piece)[0])[-1] > _DETOUR * (time[j] - time[i]) + _ROUND_OFF
        return not detour and bool(lattice.minimum(piece).min() >= worth - _ROUND_OFF)

    kept, last = [0], len(path) - 1
    while kept[-1] < last:
        low, high, end = kept[-1] + 1, last + 1, last
        while low < high - 1:
            low, high = (end, high) if serves(kept[-1], end) else (low, end)
            end = (low + high) // 2
        kept.append(low)
    return mu[path[kept]]


def _size(nodes: FloatArray) -> int:
    """Nodes a side of a lattice of (size³, ...)."""
    return round(math.cbrt(len(nodes)))


def widest(shares: FloatArray) -> FloatArray:
    """Largest smallest share of all monotone paths from the first node up to each, of shares (size³,)."""
    value = np.empty(len(shares))
    _widest_into(shares, _size(shares), value)
    return value


def shortest(free: BoolArray, q: FloatArray, speed: FloatArray) -> IntArray:
    """Nodes (k,) of the monotone path through free ones of minimum time, first to last.

    free : (size³,) whether a path may pass a node.
    q : (size³, n) joints at the nodes, rad or m.
    speed : (n,) limits, rad/s or m/s.
    """
    came = np.empty(len(q), dtype=np.int64)
    _shortest_into(free, q, speed, _size(q), np.empty(len(q)), came)
    path = [len(q) - 1]
    while path[-1] > 0:
        path.append(int(came[path[-1]]))
    return np.array(path[::-1])


@merged
def _before(node: int, step: int, size: int) -> int:
    """The node a step before another, −1 if there is none; bits of a step stand for μ_t, μ_r, μ_p."""
    a, b, c = step >> 2, step >> 1 & 1, step & 1
    if node // (size * size) < a or node // size % size < b or node % size < c:
        return -1
    return node - (a * size + b) * size - c


@njit
def _widest_into(shares: FloatArray, size: int, value: FloatArray) -> None:
    for node in range(shares.shape[0]):
        best = math.inf if node == 0 else -math.inf
        for step in range(1, 8):
            before = _before(node, step, size)
            if before >= 0:
                best = max(best, value[before])
        value[node] = min(best, shares[node])


@njit
def _shortest_into(
    free: BoolArray, q: FloatArray, speed: FloatArray, size: int, cost: FloatArray, came: IntArray
) -> None:
    """Write the minimum time (size³,) to each node, infinite if it is unreachable, and its predecessor."""
    for node in range(q.shape[0]):
        cost[node] = 0.0 if node == 0 else math.inf
        for step in range(1, 8):
            before = _before(node, step, size)
            if free[node] and before >= 0 and cost[before] < math.inf:
                axes = (step >> 2) + (step >> 1 & 1) + (step & 1)
                total = cost[before] + time_between(speed, q[before], q[node])
                total += _STRAIGHTER * math.sqrt(axes)
                if total < cost[node]:
                    cost[node], came[node] = total, before


@njit
def _joints_into(carrier: Carrier, mu: FloatArray, value: FloatArray, size: int, along: Along) -> None:
    """Write joints, limit and condition at those nodes (size³,) whose value is positive.

    Each is continued from the best before it: the values become the minimum margin of both on the path there,
    zero if the joints cannot follow within both.
    """
    demands = carrier.reaching.demands
    for node in range(mu.shape[0]):
        free, value[node] = value[node] > 0.0, 0.0
        before, best = 0, math.inf if node == 0 else 0.0
        for step in range(7, 0, -1):
            other = _before(node, step, size)
            if other >= 0 and value[other] > best:
                before, best = other, value[other]
        row_into(along.q[node], carrier.reaching.q_start if node == 0 else along.q[before])
        if not free or best == 0.0:
            continue
        for parts in (1, _BETWEEN):
            ends = (mu[before], mu[node])
            condition = carry_joints(carrier, ends, parts, _ROUGH, _MOST_STRIDE / parts, along.q[node])
            if condition >= 0.0:
                along.condition[node] = condition
                along.limit[node] = limit = limit_margin(demands, along.q[node])
                value[node] = max(min(best, limit, condition - demands.conditioning), 0.0)
                break
            row_into(along.q[node], along.q[before])
