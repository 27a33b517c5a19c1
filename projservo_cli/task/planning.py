"""A motion that keeps its distance from everything that must not happen: [RH00] section 4.3.

The coupled constraint of the paper on μ_t and μ_r, for both cameras, beside the image borders, the
joint limits and the conditioning of the operators. Of all monotone paths from (0, 0, 0) to (1, 1, 1)
on a lattice of shares μ_t, μ_r, μ_p the one whose smallest share of ``task.margins`` is largest is taken,
among equals the quickest.
"""

import math
from functools import lru_cache
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.interpolate import RegularGridInterpolator

from projservo_cli.geometry.algebra import mat, vec
from projservo_cli.records import BoolArray, FloatArray, IntArray
from projservo_cli.task.margins import (
    CONDITIONING,
    IMAGE,
    JOINTS,
    VISIBILITY,
    WORST,
    Along,
    Reaching,
    along,
    carrier_of,
    carry_joints,
    image_margin,
    limit_margin,
    view_at,
)
from projservo_cli.task.visibility import margin_coefficients

NODES = 41
# Joints are solved at so many values of each share and interpolated between; if no path shows, at more.
COARSE = (9, 15)
# A joint that moves more than this between two such nodes, rad or m, has changed its branch.
MOST_STRIDE = 1.5
# Parts in which the way between them is made where the joints do not settle in one.
BETWEEN = 4
# Newton step, rad or m, after which joints at such a node are good enough: they are off by its square.
ROUGH = 1e-2
# Of two paths equally short, that with longer straight steps: a share of the duration of a rad at 1 rad/s.
STRAIGHTER = 1e-4
# A straight piece may take this much longer than the steps of the lattice that it replaces.
DETOUR = 1.01
ROUND_OFF = 1e-9
# Points of a path at which its joints and margins are looked at.
CHECKS = 151
# Shares of this part of the best one are as good, joints being interpolated; the quicker path is better.
EQUALLY = 0.95
# What leads from a node to the next: one share or several of them.
STEPS = np.array([step for step in product((0, 1), repeat=3) if any(step)])


class Path(NamedTuple):
    """A path of shares and what is along it."""

    reaching: Reaching  # the task in the senses of both rotations that were chosen
    mu: FloatArray  # (s, 3) shares
    along: Along  # joints and margins there

    def shares(self) -> FloatArray:
        """Each margin (s, 4) over that at the worse of both ends, or over 1 where that is not positive."""
        margins = self.along.margins
        scale = np.minimum(margins[0], margins[-1])
        return np.asarray(margins / np.where(scale > 0.0, scale, 1.0))

    def holds(self) -> bool:
        """Whether all constraints hold."""
        return bool(self.along.margins.min() > 0.0)

    def duration(self) -> float:
        """Time it takes at the joint-speed limit, s; NaN where nothing limits or the joints cannot follow."""
        speed = self.reaching.demands.speed
        return float(least_time(speed, self.along.q)[-1]) if np.isfinite(speed).any() else math.nan

    def at(self, sigma: FloatArray) -> FloatArray:
        """Shares (k, 3) at parts sigma (k,) of the duration, or of the motion of the joint that moves most.

        Where the joints cannot follow or nothing moves, of the length of the path in shares.
        """
        time = least_time(self.reaching.demands.speed, self.along.q)
        if not time[-1] > 0.0:
            time = least_time(np.full(3, math.inf), self.mu)
        mu = np.stack([np.interp(sigma * time[-1], time, column) for column in self.mu.T], axis=1)
        mu[sigma <= 0.0], mu[sigma >= 1.0] = self.mu[0], self.mu[-1]
        return mu


def least_time(speed: FloatArray, q: FloatArray) -> FloatArray:
    """Time (s,) at which joints q (s, n) are reached where one is always at its speed limit (n,), s."""
    return np.concatenate([[0.0], np.cumsum(_strides(speed, q[:-1], q[1:]))])


def _strides(speed: FloatArray, q: FloatArray, q_next: FloatArray) -> FloatArray:
    """Time between joints (..., n), s, at the speed limits (n,); the largest motion where there are none."""
    speed = speed if np.isfinite(speed).any() else np.ones_like(speed)
    return np.asarray((np.abs(q_next - q) / speed).max(axis=-1))


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
    H_r, a = mat(reaching.H_hat[1]), vec(reaching.a)
    for O in reaching.O:
        sign = math.copysign(1.0, float(reaching.a @ O))
        middle = []
        for center in (O, O - tau * (reaching.H_hat[0] @ O)):
            _, c_s, c_c = margin_coefficients(a, H_r, vec(center))
            middle.append(math.atan2(sign * c_s, sign * c_c))
        end = middle[0] + math.remainder(middle[1] - middle[0], 2.0 * math.pi)
        for i, sense in enumerate(senses):
            inside[i] += abs(sense - end) < 0.5 * math.pi
    return senses[1] if inside[1] > inside[0] else senses[0]


def plan_path(reaching: Reaching) -> Path:
    """Path whose smallest share is largest, and among those the quickest.

    Both senses of the rotation within the plane are looked at where either may be the better: from a
    quarter turn on, or where the shorter one leads through what must not happen. Where no path keeps all
    constraints, one is taken that keeps at least the face in sight and in both images.
    """
    tau, _, theta_p = (float(x) for x in reaching.amplitudes)
    theta_r = turning_sense(reaching)
    angles = [theta_p] if theta_p == 0.0 else [theta_p, theta_p - math.copysign(2.0 * math.pi, theta_p)]
    senses = [reaching._replace(amplitudes=np.array([tau, theta_r, angle])) for angle in angles]
    paths: list[Path] = []
    for coarse in COARSE:
        found = [_Lattice(senses[0], coarse)]
        if abs(theta_p) > 0.5 * math.pi or found[0].least <= 0.0:
            found += [_Lattice(sense, coarse) for sense in senses[1:]]
        good = EQUALLY * max(0.0, *(lattice.least for lattice in found))
        paths += [lattice.quickest() for lattice in found if lattice.least > good]
        if any(path.holds() for path in paths):
            return _best_of(paths)
    return _best_of([*paths, max(map(_Lattice, senses), key=lambda lattice: lattice.least).quickest()])


def _best_of(paths: list[Path]) -> Path:
    """Of the paths in view, or of all if none is, the quickest whose smallest share is as good as any."""
    in_view = [path for path in paths if path.shares()[:, [VISIBILITY, IMAGE]].min() > 0.0]
    paths = in_view or paths
    least = [float(path.shares().min()) for path in paths]
    good = min(EQUALLY * max(least), max(least))
    paths = [path for path, share in zip(paths, least, strict=True) if share >= good]
    return min(paths, key=lambda path: path.duration() if math.isfinite(path.duration()) else math.inf)


class _Lattice:
    """Shares of the constraints over μ_t, μ_r, μ_p in one choice of senses, and their widest path.

    reaching : the task in these senses.
    coarse : values of each share at which joints are solved; 0 where they need not follow: the views alone
        are looked at, and what takes time are the shares themselves.
    """

    def __init__(self, reaching: Reaching, coarse: int = 0) -> None:
        self.reaching = reaching
        self.speed = reaching.demands.speed if coarse else np.full(3, math.inf)
        first_and_last = view_at(reaching, np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]))
        self.scale = np.ones(4)
        self.scale[VISIBILITY] = _positive(first_and_last.visibility)
        self.scale[IMAGE] = _positive(image_margin(first_and_last.distance, reaching.demands))
        self.field: RegularGridInterpolator | None = None
        if coarse:
            nodes = _coarse_joints(reaching, _grid(coarse))
            ends = np.stack([nodes[0, 0, 0], nodes[-1, -1, -1]])
            self.scale[JOINTS] = _positive(limit_margin(ends[:, :-1], reaching.demands))
            self.scale[CONDITIONING] = _positive(ends[:, -1])
            self.field = RegularGridInterpolator((np.linspace(0.0, 1.0, coarse),) * 3, nodes)
        shares, self.joints = self.worth(_grid(NODES).reshape(-1, 3))
        self.value = widest(shares.reshape((NODES,) * 3))
        self.least = float(self.value[-1, -1, -1])

    def worth(self, mu: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Smallest share (s,) of all constraints at mu (s, 3), and the joints (s, n) interpolated there."""
        demands, view = self.reaching.demands, view_at(self.reaching, mu)
        sight = view.visibility.min(axis=1) / self.scale[VISIBILITY]
        shares = np.minimum(sight, image_margin(view.distance.min(axis=1), demands) / self.scale[IMAGE])
        if self.field is None:
            return shares, mu
        found = self.field(mu)
        q, condition = found[:, :-1], found[:, -1]
        within = limit_margin(q, demands).min(axis=1) / self.scale[JOINTS]
        return np.minimum(shares, np.minimum(within, condition / self.scale[CONDITIONING])), q

    def quickest(self) -> Path:
        """Quickest path among those of the largest smallest share, in straight pieces."""
        joints = self.joints.reshape((*self.value.shape, -1))
        nodes = shortest(self.value >= self.least, joints, self.speed)
        corners = self._straightened(nodes / (NODES - 1))
        length = np.r_[0.0, np.cumsum(np.abs(np.diff(corners, axis=0)).max(axis=1))]
        places = np.linspace(0.0, length[-1], CHECKS)
        mu = np.stack([np.interp(places, length, column) for column in corners.T], axis=1)
        return Path(self.reaching, mu, along(self.reaching, mu))

    def _straightened(self, nodes: FloatArray) -> FloatArray:
        """Corners (c, 3) of the path of nodes (k, 3) that is left when straight pieces serve as well.

        A piece grows as long as its shares stay as good and it takes no longer than the nodes.
        """
        time = least_time(self.speed, self.worth(nodes)[1])
        kept = [0]
        for j in range(2, len(nodes)):
            anchor = kept[-1]
            x = np.linspace(0.0, 1.0, 2 * (j - anchor) + 1)[:, None]
            shares, q = self.worth((1.0 - x) * nodes[anchor] + x * nodes[j])
            late = least_time(self.speed, q)[-1] > DETOUR * (time[j] - time[anchor]) + ROUND_OFF
            if late or shares.min() < self.least - ROUND_OFF:
                kept.append(j - 1)
        return nodes[[*kept, len(nodes) - 1]]


def _positive(margins: FloatArray) -> float:
    """The least margin, or 1 where that is not positive."""
    return float(margins.min()) if margins.min() > 0.0 else 1.0


@lru_cache(maxsize=3)
def _grid(nodes: int) -> FloatArray:
    """Shares at the nodes of a lattice (k, k, k, 3)."""
    axis = np.linspace(0.0, 1.0, nodes)
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=3)


def _coarse_joints(reaching: Reaching, grid: FloatArray) -> FloatArray:
    """Joints and margins of conditioning (a, a, a, n + 1), each node continued from the best before it.

    Where the joints cannot be reached that margin is ``WORST`` and they are those before.
    """
    carrier, demands = carrier_of(reaching), reaching.demands
    field = np.empty((*grid.shape[:3], len(reaching.q_start) + 1))
    value = np.empty(grid.shape[:3])
    for node in np.ndindex(value.shape):
        step, best, before = np.zeros(3, dtype=np.int64), math.inf, reaching.q_start
        earlier = before
        steps = STEPS[(node >= STEPS).all(axis=1)][::-1]
        if len(steps):
            step = steps[np.argmax(value[tuple((node - steps).T)])]
            best = value[tuple(node - step)]
            before = earlier = field[tuple(node - step)][:-1]
            if (node >= 2 * step).all():
                earlier = field[tuple(node - 2 * step)][:-1]
        field[node], value[node] = [*before, WORST], WORST
        ends = np.stack([grid[tuple(node - step)], grid[node]])
        for parts in (1, BETWEEN) if best > WORST else ():
            q = 2.0 * before - earlier if parts == 1 else before.copy()
            condition = carry_joints(carrier, ends, parts, ROUGH, math.inf, q)
            if condition >= 0.0 and (np.abs(q - before) <= MOST_STRIDE).all():
                margin = condition - demands.conditioning
                field[node] = [*q, margin]
                value[node] = max(min(best, limit_margin(q, demands).min(), margin), WORST + 1.0)
                break
    return field


def _levels(shape: tuple[int, ...]) -> tuple[list[IntArray], IntArray]:
    """Nodes of a lattice by their number of steps from the first, and what each of ``STEPS`` adds to them.

    Nodes are indices into the flat lattice with a layer before the first ones.
    """
    padded = tuple(n + 1 for n in shape)
    nodes = 1 + np.indices(shape).reshape(3, -1)
    flat, steps = (np.asarray(np.ravel_multi_index(tuple(x), padded)) for x in (nodes, STEPS.T))
    level = nodes.sum(axis=0)
    in_order = flat[np.argsort(level, kind="stable")]
    return np.split(in_order, np.cumsum(np.bincount(level)[3:-1])), steps


def _padded(values: FloatArray, before: float) -> FloatArray:
    """Values (a, b, c, ...) with a layer before the first nodes, the lattice made flat."""
    found = np.pad(values, [(1, 0)] * 3 + [(0, 0)] * (values.ndim - 3), constant_values=before)
    return np.asarray(found.reshape(-1, *values.shape[3:]))


def widest(shares: FloatArray) -> FloatArray:
    """Largest smallest share of all monotone paths from the first node up to each, of shares (a, b, c)."""
    levels, steps = _levels(shares.shape)
    value = _padded(shares, -math.inf)
    for level in levels[1:]:
        value[level] = np.minimum(value[level], value[level - steps[:, None]].max(axis=0))
    return value.reshape([n + 1 for n in shares.shape])[1:, 1:, 1:]


def shortest(free: BoolArray, joints: FloatArray, speed: FloatArray) -> IntArray:
    """Nodes (k, 3) of the monotone path through free ones that takes the least time, first to last.

    free : (a, b, c) whether a path may pass a node.
    joints : (a, b, c, n) at the nodes, rad or m.
    speed : (n,) limits, rad/s or m/s.
    """
    levels, steps = _levels(free.shape)
    passable, q = _padded(free.astype(float), 0.0), _padded(joints, 0.0)
    cost, came = np.full(len(q), math.inf), np.zeros(len(q), dtype=np.int64)
    cost[levels[0]] = 0.0
    longer = STRAIGHTER * np.sqrt(STEPS.sum(axis=1))[:, None]
    for level in levels[1:]:
        nodes = level[passable[level] > 0.0]
        before = nodes - steps[:, None]
        total = cost[before] + _strides(speed, q[before], q[nodes]) + longer
        best = np.argmin(total, axis=0)
        cost[nodes], came[nodes] = total[best, np.arange(len(nodes))], steps[best]
    path = [int(levels[-1].item())]
    while path[-1] != levels[0]:
        path.append(path[-1] - int(came[path[-1]]))
    return np.stack(np.unravel_index(path[::-1], [n + 1 for n in free.shape]), axis=1) - 1
