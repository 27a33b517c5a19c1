"""A motion that keeps its distance from everything that must not happen: [RH00] section 4.3.

The coupled constraint of the paper on μ_t and μ_r, for both cameras, beside the image borders, the
joint limits and the conditioning of the operators. Of all monotone paths from (0, 0, 0) to (1, 1, 1)
on a lattice of shares μ_t, μ_r, μ_p the one whose smallest share of ``guidance.margins`` is largest is
taken, among equals the quickest.
"""

import math
from typing import NamedTuple

import numpy as np

from projservo_cli.geometry.algebra import mat, vec
from projservo_cli.geometry.jit import merged, njit
from projservo_cli.geometry.kernels import put_row
from projservo_cli.guidance.margins import (
    IMAGE,
    VISIBILITY,
    WORST,
    Along,
    Carrier,
    Motion,
    Reaching,
    along_shares,
    carrier_of,
    carry_joints,
    limit_margin,
    put_displaced,
    put_images,
    put_path_margins,
    room_along,
    scale_of,
)
from projservo_cli.guidance.timing import least_time
from projservo_cli.guidance.validity import time_between
from projservo_cli.records import BoolArray, FloatArray, IntArray
from projservo_cli.task.visibility import margin_coefficients

NODES = 25
# Joints are solved at so many values of each share and interpolated between; if no path shows, at more.
COARSE = (9, 13)
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


def duration(motion: Motion) -> float:
    """Time a motion takes at the joint-speed limit, s; NaN where nothing limits or joints cannot follow."""
    speed = motion.reaching.demands.speed
    return float(least_time(speed, motion.along.q)[-1]) if np.isfinite(speed).any() else math.nan


def evenly(motion: Motion, sigma: FloatArray) -> FloatArray:
    """Shares (k, 3) at parts sigma (k,) of the duration, or of the motion of the joint that moves most.

    Where the joints cannot follow or nothing moves, of the length of the path in shares.
    """
    time = least_time(motion.reaching.demands.speed, motion.along.q)
    if not time[-1] > 0.0:
        time = least_time(np.ones(3), motion.mu)
    mu = np.stack([np.interp(sigma * time[-1], time, column) for column in motion.mu.T], axis=1)
    mu[sigma <= 0.0], mu[sigma >= 1.0] = motion.mu[0], motion.mu[-1]
    return mu


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


def plan_path(reaching: Reaching) -> Motion:
    """Path whose smallest share is largest, and among those the quickest.

    Both senses of the rotation within the plane are looked at where either may be the better: from a
    quarter turn on, or where the shorter one leads through what must not happen. Where no path keeps all
    constraints, one is taken that keeps at least the face in sight and in both images.
    """
    tau, _, theta_p = (float(x) for x in reaching.amplitudes)
    theta_r = turning_sense(reaching)
    angles = [theta_p] if theta_p == 0.0 else [theta_p, theta_p - math.copysign(2.0 * math.pi, theta_p)]
    views: list[_Lattice] = []
    paths: list[Motion] = []
    for coarse in COARSE:
        found: list[_Lattice] = []
        good = 0.0
        for k, angle in enumerate(angles):
            if k > 0 and good > 0.0 and abs(theta_p) <= 0.5 * math.pi:
                break
            if k == len(views):
                views.append(_in_view(reaching._replace(amplitudes=np.array([tau, theta_r, angle]))))
            # No joints make up for what is not in view.
            if views[k].value[-1] > good:
                found.append(_with_joints(views[k], coarse))
                good = max(good, EQUALLY * found[-1].value[-1])
        paths += [_quickest(lattice) for lattice in found if lattice.value[-1] > good]
        if any(path.holds() for path in paths):
            return _best_of(paths)
    return _best_of([*paths, _quickest(max(views, key=lambda lattice: lattice.value[-1]))])


def _best_of(paths: list[Motion]) -> Motion:
    """Of the paths in view, or of all if none is, the quickest whose smallest share is as good as any."""
    in_view = [path for path in paths if path.shares()[:, [VISIBILITY, IMAGE]].min() > 0.0]
    paths = in_view or paths
    least = [float(path.shares().min()) for path in paths]
    good = min(EQUALLY * max(least), max(least))
    paths = [path for path, share in zip(paths, least, strict=True) if share >= good]
    return min(paths, key=lambda path: duration(path) if math.isfinite(duration(path)) else math.inf)


class _Lattice(NamedTuple):
    """Shares of the constraints over μ_t, μ_r, μ_p in one choice of senses; k³ nodes in the order of C."""

    reaching: Reaching  # the task in these senses
    scale: FloatArray  # (2,) margins of visibility and image that shares are of
    # (a, a, a, n + 1) joints, and the smaller share of their limits and of conditioning, between which is
    # interpolated; the shares μ themselves in place of joints where those need not follow
    field: FloatArray
    speed: FloatArray  # (n,) limits, rad/s or m/s
    q: FloatArray  # (k³, n) joints
    value: FloatArray  # (k³,) the largest smallest share of all monotone paths up to a node

    def worth(self, mu: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Smallest share (s,) of all constraints at shares mu (s, 3), and the joints (s, n) there."""
        between = _between(self.field, mu)
        views = _view_margins(self.reaching, mu) / self.scale
        return np.minimum(views.min(axis=1), between[:, -1]), between[:, :-1]


def _grid(size: int) -> FloatArray:
    """Shares (size³, 3) at the nodes of a lattice."""
    return np.ascontiguousarray(np.indices((size, size, size)).reshape(3, -1).T / (size - 1.0))


def _view_margins(reaching: Reaching, mu: FloatArray) -> FloatArray:
    """Margins of visibility and image (s, 2) at shares mu (s, 3)."""
    margins = np.empty((len(mu), 2))
    _put_view_margins(reaching, mu, room_along(reaching, 1), margins)
    return margins


def _between(field: FloatArray, mu: FloatArray) -> FloatArray:
    """What a field (a, a, a, c) has at shares mu (s, 3): (s, c)."""
    found = np.zeros((len(mu), field.shape[3]))
    _put_between(field, mu, found)
    return found


def _in_view(reaching: Reaching) -> _Lattice:
    """Shares of the views alone, where joints need not follow: what takes time are the shares themselves."""
    grid = _grid(NODES)
    margins = _view_margins(reaching, grid)
    scale = scale_of(margins[0], margins[-1])
    field = np.concatenate([_grid(2), np.ones((8, 1))], axis=1).reshape(2, 2, 2, 4)
    return _Lattice(reaching, scale, field, np.ones(3), grid, widest((margins / scale).min(axis=1)))


def _with_joints(view: _Lattice, coarse: int) -> _Lattice:
    """The same with joints, solved at so many values of each share."""
    reaching, speed, grid = view.reaching, view.reaching.demands.speed, _grid(coarse)
    n, count = len(reaching.q_start), len(grid)
    q, margins = np.tile(reaching.q_start, (count, 1)), np.full((count, 2), WORST)
    _put_coarse(carrier_of(reaching), coarse, grid, q, margins, np.full(count, WORST))
    shares = (margins / scale_of(margins[0], margins[-1])).min(axis=1, keepdims=True)
    field = np.concatenate([q, shares], axis=1).reshape(coarse, coarse, coarse, n + 1)
    nodes = _between(field, _grid(NODES))
    speed = speed if np.isfinite(speed).any() else np.ones(n)
    # Along a path the least of these values is the least share of its views.
    value = widest(np.minimum(view.value, nodes[:, -1]))
    return _Lattice(reaching, view.scale, field, speed, nodes[:, :-1], value)


def _quickest(lattice: _Lattice) -> Motion:
    """Quickest path among those of the largest smallest share, in straight pieces."""
    nodes = shortest(lattice.value >= lattice.value[-1], lattice.q, lattice.speed)
    corners = _straightened(lattice, _grid(NODES)[nodes])
    length = np.r_[0.0, np.cumsum(np.abs(np.diff(corners, axis=0)).max(axis=1))]
    places = np.linspace(0.0, length[-1], CHECKS)
    mu = np.stack([np.interp(places, length, column) for column in corners.T], axis=1)
    return along_shares(lattice.reaching, mu)


def _straightened(lattice: _Lattice, mu: FloatArray) -> FloatArray:
    """Corners (c, 3) of a path of nodes (k, 3) that is left when straight pieces serve as well.

    A piece grows as long as its shares stay as good and it takes no longer than the nodes.
    """
    time = least_time(lattice.speed, lattice.worth(mu)[1])
    kept = [0]
    for j in range(2, len(mu)):
        anchor = kept[-1]
        x = np.linspace(0.0, 1.0, 2 * (j - anchor) + 1)[:, None]
        shares, q = lattice.worth((1.0 - x) * mu[anchor] + x * mu[j])
        late = least_time(lattice.speed, q)[-1] > DETOUR * (time[j] - time[anchor]) + ROUND_OFF
        if late or shares.min() < lattice.value[-1] - ROUND_OFF:
            kept.append(j - 1)
    return mu[[*kept, len(mu) - 1]]


def _size(nodes: FloatArray) -> int:
    """Nodes a side of a lattice of (size³, ...)."""
    return round(math.cbrt(len(nodes)))


def widest(shares: FloatArray) -> FloatArray:
    """Largest smallest share of all monotone paths from the first node up to each, of shares (size³,)."""
    value = np.empty(len(shares))
    _put_widest(shares, _size(shares), value)
    return value


def shortest(free: BoolArray, q: FloatArray, speed: FloatArray) -> IntArray:
    """Nodes (k,) of the monotone path through free ones that takes the least time, first to last.

    free : (size³,) whether a path may pass a node.
    q : (size³, n) joints at the nodes, rad or m.
    speed : (n,) limits, rad/s or m/s.
    """
    came = np.empty(len(q), dtype=np.int64)
    _put_shortest(free, q, speed, _size(q), np.empty(len(q)), came)
    path = [len(q) - 1]
    while path[-1] > 0:
        path.append(int(came[path[-1]]))
    return np.array(path[::-1])


@merged
def _before(node: int, step: int, size: int) -> int:
    """The node a step before another, −1 where there is none; bits of a step are those of μ_t, μ_r, μ_p."""
    a, b, c = step >> 2, step >> 1 & 1, step & 1
    if node // (size * size) < a or node // size % size < b or node % size < c:
        return -1
    return node - (a * size + b) * size - c


@njit
def _put_widest(shares: FloatArray, size: int, value: FloatArray) -> None:
    for node in range(shares.shape[0]):
        best = math.inf if node == 0 else -math.inf
        for step in range(1, 8):
            before = _before(node, step, size)
            if before >= 0:
                best = max(best, value[before])
        value[node] = min(best, shares[node])


@njit
def _put_shortest(
    free: BoolArray, q: FloatArray, speed: FloatArray, size: int, cost: FloatArray, came: IntArray
) -> None:
    """Write the least time (size³,) up to each node, infinite where none leads there, and where from."""
    for node in range(q.shape[0]):
        cost[node] = 0.0 if node == 0 else math.inf
        for step in range(1, 8):
            before = _before(node, step, size)
            if free[node] and before >= 0 and cost[before] < math.inf:
                axes = (step >> 2) + (step >> 1 & 1) + (step & 1)
                total = cost[before] + time_between(speed, q[before], q[node])
                total += STRAIGHTER * math.sqrt(axes)
                if total < cost[node]:
                    cost[node], came[node] = total, before


@njit
def _put_view_margins(reaching: Reaching, mu: FloatArray, found: Along, margins: FloatArray) -> None:
    """Write margins of visibility and image (s, 2) at shares mu (s, 3), by way of a single instant."""
    for i in range(mu.shape[0]):
        put_displaced(reaching, mu[i, 0], mu[i, 1], mu[i, 2], found, 0)
        put_images(reaching, found)
        put_path_margins(reaching, found)
        margins[i, VISIBILITY], margins[i, IMAGE] = found.margins[0, VISIBILITY], found.margins[0, IMAGE]


@njit
def _put_between(field: FloatArray, mu: FloatArray, found: FloatArray) -> None:
    """Add what a field (a, a, a, c) has at shares mu (s, 3), linear in each between its nodes, to (s, c)."""
    last = field.shape[0] - 1
    for s in range(mu.shape[0]):
        x, y, z = mu[s, 0] * last, mu[s, 1] * last, mu[s, 2] * last
        i, j, k = min(int(x), last - 1), min(int(y), last - 1), min(int(z), last - 1)
        for corner in range(8):
            a, b, c = corner >> 2, corner >> 1 & 1, corner & 1
            weight = (x - i if a else 1.0 - x + i) * (y - j if b else 1.0 - y + j)
            weight *= z - k if c else 1.0 - z + k
            for l in range(found.shape[1]):
                found[s, l] += weight * field[i + a, j + b, k + c, l]


@njit
def _put_coarse(
    carrier: Carrier, size: int, mu: FloatArray, q: FloatArray, margins: FloatArray, value: FloatArray
) -> None:
    """Write joints (size³, n), margins of their limits and of conditioning (size³, 2), and the best value.

    Each node, of shares mu (size³, 3), is continued from the best before it. All joints are those at the
    start yet, all margins and values ``WORST``, and stay so where the joints cannot be reached.
    """
    demands = carrier.reaching.demands
    for node in range(q.shape[0]):
        step, best = 0, math.inf if node == 0 else WORST
        for other in range(7, 0, -1):
            before = _before(node, other, size)
            if before >= 0 and value[before] > best:
                step, best = other, value[before]
        before = _before(node, step, size)
        for parts in (1, BETWEEN):
            put_row(q[node], q[before])
            if best == WORST:
                break
            ends = (mu[before], mu[node])
            condition = carry_joints(carrier, ends, parts, ROUGH, MOST_STRIDE / parts, q[node])
            if condition >= 0.0:
                margins[node, 0] = limit_margin(demands, q[node])
                margins[node, 1] = condition - demands.conditioning
                value[node] = max(min(best, margins[node, 0], margins[node, 1]), WORST + 1.0)
                break
        if value[node] == WORST:
            put_row(q[node], q[before])
