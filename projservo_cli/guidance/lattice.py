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
from projservo_cli.geometry.jit import internal, merged, njit
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
    put_margins,
    room_along,
    scale_of,
)
from projservo_cli.guidance.validity import put_row
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


def least_time(speed: FloatArray, q: FloatArray) -> FloatArray:
    """Time (s,) at which joints q (s, n) are reached where one is always at its speed limit (n,), s.

    Where nothing limits, the motion of the joint that moves most.
    """
    speed = speed if np.isfinite(speed).any() else np.ones_like(speed)
    return np.concatenate([[0.0], np.cumsum((np.abs(np.diff(q, axis=0)) / speed).max(axis=1))])


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
    nodes: FloatArray  # (k³, n + 1) the same at the nodes
    speed: FloatArray  # (n,) limits, rad/s or m/s
    shares: FloatArray  # (k³,) the smallest share
    value: FloatArray  # (k³,) the largest smallest share of all monotone paths up to a node


def _in_view(reaching: Reaching) -> _Lattice:
    """Shares of the views alone, where joints need not follow: what takes time are the shares themselves."""
    margins = np.empty((NODES**3, 2))
    _put_view_margins(reaching, NODES, room_along(reaching, 1), margins)
    scale = scale_of(margins[0], margins[-1])
    field = np.ones((2, 2, 2, 4))
    field[..., :3] = np.moveaxis(np.indices((2, 2, 2)), 0, 3)
    return _valued(reaching, scale, field, np.ones(3), (margins / scale).min(axis=1))


def _with_joints(view: _Lattice, coarse: int) -> _Lattice:
    """The same with joints, solved at so many values of each share."""
    reaching, speed = view.reaching, view.reaching.demands.speed
    n, count = len(reaching.q_start), coarse**3
    q, margins = np.tile(reaching.q_start, (count, 1)), np.full((count, 2), WORST)
    _put_coarse(carrier_of(reaching), coarse, np.full(n, MOST_STRIDE), q, margins, np.full(count, WORST))
    shares = (margins / scale_of(margins[0], margins[-1])).min(axis=1, keepdims=True)
    field = np.concatenate([q, shares], axis=1).reshape(coarse, coarse, coarse, n + 1)
    speed = speed if np.isfinite(speed).any() else np.ones(n)
    return _valued(reaching, view.scale, field, speed, view.shares)


def _valued(
    reaching: Reaching, scale: FloatArray, field: FloatArray, speed: FloatArray, shares: FloatArray
) -> _Lattice:
    nodes = np.empty((NODES**3, field.shape[3]))
    _put_refined(field, NODES, nodes)
    shares = np.minimum(shares, nodes[:, -1])
    return _Lattice(reaching, scale, field, nodes, speed, shares, widest(shares))


def _quickest(lattice: _Lattice) -> Motion:
    """Quickest path among those of the largest smallest share, in straight pieces."""
    nodes = shortest(lattice.value >= lattice.value[-1], lattice.nodes[:, :-1], lattice.speed)
    mu = np.stack(np.unravel_index(nodes, (NODES, NODES, NODES)), axis=1) / (NODES - 1)
    corners = _straightened(lattice, mu)
    length = np.r_[0.0, np.cumsum(np.abs(np.diff(corners, axis=0)).max(axis=1))]
    places = np.linspace(0.0, length[-1], CHECKS)
    mu = np.stack([np.interp(places, length, column) for column in corners.T], axis=1)
    return along_shares(lattice.reaching, mu)


def _straightened(lattice: _Lattice, mu: FloatArray) -> FloatArray:
    """Corners (c, 3) of a path of nodes (k, 3) that is left when straight pieces serve as well.

    A piece grows as long as its shares stay as good and it takes no longer than the nodes.
    """
    kept, stepwise = [0], 0.0
    room = np.empty((2, lattice.nodes.shape[1])), room_along(lattice.reaching, 1)
    for j in range(1, len(mu)):
        _, step = _piece(lattice, mu[j - 1], mu[j], 1, *room)
        least, time = _piece(lattice, mu[kept[-1]], mu[j], 2 * (j - kept[-1]), *room)
        late = time > DETOUR * (stepwise + step) + ROUND_OFF
        if j > kept[-1] + 1 and (late or least < lattice.value[-1] - ROUND_OFF):
            kept.append(j - 1)
            stepwise = 0.0
        stepwise += step
    return mu[[*kept, len(mu) - 1]]


def _size(nodes: FloatArray) -> int:
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


@merged
def _shares_at(node: int, size: int) -> tuple[float, float, float]:
    """Shares μ_t, μ_r, μ_p of a node."""
    last = size - 1
    return node // (size * size) / last, node // size % size / last, node % size / last


@merged
def _time_between(speed: FloatArray, q: FloatArray, r: FloatArray) -> float:
    """Time between joints, s, at the speed limits (n,)."""
    most = 0.0
    for i in range(speed.shape[0]):
        most = max(most, abs(q[i] - r[i]) / speed[i])
    return most


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
                total = cost[before] + _time_between(speed, q[before], q[node])
                total += STRAIGHTER * math.sqrt(axes)
                if total < cost[node]:
                    cost[node], came[node] = total, before


@merged
def _put_view(reaching: Reaching, mu_t: float, mu_r: float, mu_p: float, found: Along) -> None:
    """Write what the views have at shares, of a single instant."""
    put_displaced(reaching, mu_t, mu_r, mu_p, found, 0)
    put_images(reaching, found)
    put_margins(reaching, found)


@njit
def _put_view_margins(reaching: Reaching, size: int, found: Along, margins: FloatArray) -> None:
    """Write margins of visibility and image (size³, 2) at the nodes, by way of a single instant."""
    for node in range(margins.shape[0]):
        mu_t, mu_r, mu_p = _shares_at(node, size)
        _put_view(reaching, mu_t, mu_r, mu_p, found)
        for i in range(2):
            margins[node, i] = found.margins[0, i]


@internal
def _put_between(field: FloatArray, mu_t: float, mu_r: float, mu_p: float, found: FloatArray) -> None:
    """Write what a field (a, a, a, c) has at shares, linear in each between its nodes."""
    last = field.shape[0] - 1
    x, y, z = mu_t * last, mu_r * last, mu_p * last
    i, j, k = min(int(x), last - 1), min(int(y), last - 1), min(int(z), last - 1)
    x, y, z = x - i, y - j, z - k
    for l in range(found.shape[0]):
        found[l] = 0.0
    for corner in range(8):
        a, b, c = corner >> 2, corner >> 1 & 1, corner & 1
        weight = (x if a else 1.0 - x) * (y if b else 1.0 - y) * (z if c else 1.0 - z)
        for l in range(found.shape[0]):
            found[l] += weight * field[i + a, j + b, k + c, l]


@njit
def _put_refined(field: FloatArray, size: int, nodes: FloatArray) -> None:
    """Write what a field has at the nodes (size³, c)."""
    for node in range(nodes.shape[0]):
        mu_t, mu_r, mu_p = _shares_at(node, size)
        _put_between(field, mu_t, mu_r, mu_p, nodes[node])


@njit
def _piece(
    lattice: _Lattice, start: FloatArray, end: FloatArray, parts: int, scratch: FloatArray, found: Along
) -> tuple[float, float]:
    """Smallest share on a straight way between shares (3,), looked at in equal parts, and its time, s.

    scratch : (2, n + 1); found : of a single instant.
    """
    least, time = math.inf, 0.0
    n = lattice.speed.shape[0]
    for part in range(parts + 1):
        x = part / parts
        mu_t = (1.0 - x) * start[0] + x * end[0]
        mu_r = (1.0 - x) * start[1] + x * end[1]
        mu_p = (1.0 - x) * start[2] + x * end[2]
        _put_view(lattice.reaching, mu_t, mu_r, mu_p, found)
        here = scratch[part % 2]
        _put_between(lattice.field, mu_t, mu_r, mu_p, here)
        least = min(least, here[n])
        for i in range(2):
            least = min(least, found.margins[0, i] / lattice.scale[i])
        if part > 0:
            time += _time_between(lattice.speed, scratch[1 - part % 2], here)
    return least, time


@njit
def _put_coarse(
    carrier: Carrier, size: int, stride: FloatArray, q: FloatArray, margins: FloatArray, value: FloatArray
) -> None:
    """Write joints (size³, n), margins of their limits and of conditioning (size³, 2), and the best value.

    Each node is continued from the best before it; all joints are those at the start yet, all margins and
    values ``WORST``, and stay so where the joints cannot be reached.
    stride : (n,) most that a joint may move from node to node, rad or m.
    """
    demands, ends = carrier.reaching.demands, carrier.ends
    for node in range(q.shape[0]):
        taken, best = 0, math.inf if node == 0 else WORST
        for step in range(7, 0, -1):
            before = _before(node, step, size)
            if before >= 0 and value[before] > best:
                taken, best = step, value[before]
        before = _before(node, taken, size)
        earlier = _before(before, taken, size)
        ends[0, 0], ends[0, 1], ends[0, 2] = _shares_at(before, size)
        ends[1, 0], ends[1, 1], ends[1, 2] = _shares_at(node, size)
        for parts in (1, BETWEEN):
            if best == WORST:
                break
            for i in range(q.shape[1]):
                q[node, i] = q[before, i]
                if parts == 1 and earlier >= 0:
                    q[node, i] += q[before, i] - q[earlier, i]
            condition = carry_joints(carrier, ends, parts, ROUGH, math.inf, q[node])
            if condition >= 0.0 and _time_between(stride, q[node], q[before]) <= 1.0:
                margins[node, 0] = limit_margin(demands, q[node])
                margins[node, 1] = condition - demands.conditioning
                value[node] = max(min(best, margins[node, 0], margins[node, 1]), WORST + 1.0)
                break
        if value[node] == WORST:
            put_row(q[node], q[before])
