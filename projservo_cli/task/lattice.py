"""Monotone paths on the lattice of shares μ_t, μ_r, μ_p: the widest, and among those the shortest.

Margins of all nodes come first, in closed form; the widest path is found by one sweep (what a path
is worth is its smallest margin), the shortest among the nodes at least as good by another. A step of
a path takes one share or several of them to the next of ``NODES`` equal values.
"""

import math

from projservo_cli.geometry.algebra import apply, mat, vec
from projservo_cli.geometry.jit import njit
from projservo_cli.geometry.kinematics import backward, row
from projservo_cli.geometry.mechanisms import Work, reach
from projservo_cli.records import FloatArray, IntArray
from projservo_cli.task.approach import approach
from projservo_cli.task.margins import (
    CONDITIONING,
    IMAGE,
    JOINTS,
    VISIBILITY,
    WORST,
    Reaching,
    border_distance,
    image_margin,
    limit_margin,
    reciprocal_condition,
    visibility_margin,
)
from projservo_cli.task.trajectory import displaced, rotated


@njit
def put(q: FloatArray, other: FloatArray) -> None:
    """Write joints to a row."""
    for i in range(q.shape[0]):
        q[i] = other[i]


@njit
def near(q: FloatArray, other: FloatArray, stride: float) -> bool:
    """Whether no joint differs by more than a stride, rad or m."""
    for i in range(q.shape[0]):
        if not abs(q[i] - other[i]) <= stride:
            return False
    return True


@njit
def slowness(speed: FloatArray, weight: FloatArray) -> None:
    """Seconds a rad or m of each joint takes at the joint-speed limit; 1 for all where nothing limits."""
    limited = False
    for i in range(speed.shape[0]):
        weight[i] = 1.0 / speed[i] if math.isfinite(speed[i]) else 0.0
        limited = limited or weight[i] > 0.0
    if not limited:
        weight[:] = 1.0


@njit
def stride(q: FloatArray, other: FloatArray, weight: FloatArray) -> float:
    """Time between joints, s: that of the joint that takes longest."""
    longest = 0.0
    for i in range(weight.shape[0]):
        longest = max(longest, weight[i] * abs(other[i] - q[i]))
    return longest


NODES = 41
# Joints are solved at every fifth node and interpolated between: an eighth of each part apart.
COARSE = 9
# A joint that moves more than this between two such nodes, rad or m, has changed its branch.
MOST_STRIDE = 1.5
# Newton step, rad or m, after which joints at such a node are good enough: they are off by its square.
ROUGH = 1e-2
# Margin of conditioning, at most, where the joints stay behind by an allowed miss: below that of any other.
NEARLY = 1e-6
# Of two paths equally short, that with longer straight steps: a share of the duration of a rad at 1 rad/s.
STRAIGHTER = 1e-4


@njit
def view_shares(reaching: Reaching, shares: FloatArray, lines: FloatArray) -> None:
    """Smallest share of visibility and image over both cameras at all nodes (k, k, k) of t, r, p.

    A translation moves homogeneous pixels along a line, so two pixels a marker serve all of μ_t.

    Parameters
    ----------
    lines : (2m, 7) workspace.
    """
    nodes = shares.shape[0]
    m = reaching.A.shape[0]
    tau = float(reaching.amplitudes[0])
    shift = mat(reaching.H_hat[0])
    for view in range(2):
        for marker in range(m):
            lines[view * m + marker, 6] = row(reaching.model.P[view], 2, vec(reaching.A[marker]))
    for j in range(nodes):
        mu_r = j / (nodes - 1)
        for i in range(nodes):
            mu_t = i / (nodes - 1)
            left = visibility_margin(reaching, 0, mu_t, mu_r)
            right = visibility_margin(reaching, 1, mu_t, mu_r)
            shares[i, j, :] = min(left, right) / reaching.scale[VISIBILITY]
        for k in range(nodes):
            H = rotated(reaching.H_hat, reaching.amplitudes, mu_r, k / (nodes - 1))
            for marker in range(m):
                M = apply(H, vec(reaching.A[marker]))
                D = apply(shift, M)
                for view in range(2):
                    for axis in range(3):
                        lines[view * m + marker, axis] = row(reaching.model.P[view], axis, M)
                        lines[view * m + marker, 3 + axis] = tau * row(reaching.model.P[view], axis, D)
            for i in range(nodes):
                mu_t = i / (nodes - 1)
                least = math.inf
                for line in range(2 * m):
                    x = lines[line]
                    pixel = (x[0] + mu_t * x[3], x[1] + mu_t * x[4], x[2] + mu_t * x[5])
                    distance = border_distance(
                        pixel, x[6], reaching.demands.image_size, reaching.model.lens[line // m]
                    )
                    least = min(least, distance)
                inside = image_margin(least, reaching.demands) / reaching.scale[IMAGE]
                shares[i, j, k] = min(shares[i, j, k], inside)


@njit
def best_before(value: FloatArray, i: int, j: int, k: int) -> tuple[float, int]:
    """Best value among the nodes a path may come from, and which, coded by bits 4, 2, 1 for t, r, p."""
    best = -math.inf
    step = 0
    for code in range(7, 0, -1):
        di, dj, dk = code >> 2, (code >> 1) & 1, code & 1
        if i >= di and j >= dj and k >= dk and value[i - di, j - dj, k - dk] > best:
            best = value[i - di, j - dj, k - dk]
            step = code
    return best, step


@njit
def widest(shares: FloatArray, value: FloatArray) -> float:
    """Largest smallest share of all monotone paths from the first to the last node.

    Parameters
    ----------
    shares : (a, b, c) of the nodes.
    value : (a, b, c) on return the best smallest share of the paths up to each node.
    """
    for i in range(shares.shape[0]):
        for j in range(shares.shape[1]):
            for k in range(shares.shape[2]):
                value[i, j, k] = shares[i, j, k]
                if i + j + k > 0:
                    best, _ = best_before(value, i, j, k)
                    value[i, j, k] = min(shares[i, j, k], best)
    return float(value[-1, -1, -1])


@njit
def solve_joints(
    reaching: Reaching, work: Work, newton: FloatArray, M: FloatArray, value: FloatArray, field: FloatArray
) -> None:
    """Joints and their conditioning at coarse nodes, each continued from the best node before it.

    Parameters
    ----------
    work, newton, M, value : workspaces, the last two (2, 4) and (a, b, c).
    field : (a, b, c, n + 1) on return the joints, rad or m, and the margin of conditioning; where they
        cannot be reached that margin is ``WORST`` and the joints are those before.
    """
    n = reaching.q_start.shape[0]
    a, b, c = field.shape[0] - 1, field.shape[1] - 1, field.shape[2] - 1
    H_back = backward(reaching.model, reaching.q_start)
    for i in range(a + 1):
        for j in range(b + 1):
            for k in range(c + 1):
                q = field[i, j, k, :n]
                before = reaching.q_start
                earlier = before
                best = math.inf
                if i + j + k > 0:
                    best, code = best_before(value, i, j, k)
                    di, dj, dk = code >> 2, (code >> 1) & 1, code & 1
                    before = field[i - di, j - dj, k - dk, :n]
                    earlier = before
                    if i >= 2 * di and j >= 2 * dj and k >= 2 * dk:
                        earlier = field[i - 2 * di, j - 2 * dj, k - 2 * dk, :n]
                for l in range(n):
                    q[l] = 2.0 * before[l] - earlier[l]
                H = displaced(reaching.H_hat, reaching.amplitudes, i / a, j / b, k / c)
                reached = best > WORST and reach(
                    reaching.model, H_back, H, reaching.A, q, work, newton, ROUGH
                )
                if reached and near(q, before, MOST_STRIDE):
                    condition = reciprocal_condition(reaching, H, work, M, newton)
                    field[i, j, k, n] = condition - reaching.demands.conditioning
                else:
                    put(q, before)
                    field[i, j, k, n] = WORST
                    if best > WORST and reaching.demands.miss_px > 0.0:
                        miss = approach(reaching, H_back, H, q, work, M, newton) / reaching.demands.miss_px
                        if miss < 1.0 and near(q, before, MOST_STRIDE):
                            field[i, j, k, n] = NEARLY * (1.0 - miss)
                    if field[i, j, k, n] == WORST:
                        put(q, before)
                        value[i, j, k] = WORST
                        continue
                within = limit_margin(q, reaching.demands)
                value[i, j, k] = max(min(best, min(within, field[i, j, k, n])), WORST + 1.0)


@njit
def with_joints(
    reaching: Reaching, field: FloatArray, line: FloatArray, shares: FloatArray, joints: FloatArray
) -> None:
    """Lower the shares of the views to those of the joints, interpolated linearly between coarse nodes.

    Nodes out of view stay as they are: no path worth its joints passes them.

    Parameters
    ----------
    field : (a, a, a, n + 1) joints and margin of conditioning of the coarse nodes.
    line : (a, n + 1) workspace.
    shares : (k, k, k) of the nodes, k − 1 a multiple of a − 1.
    joints : (k, k, k, n) on return the joints at the nodes in view, rad or m.
    """
    n = joints.shape[3]
    nodes = shares.shape[0]
    ratio = (nodes - 1) // (field.shape[0] - 1)
    for i in range(nodes):
        i0 = min(i // ratio, field.shape[0] - 2)
        x = i / ratio - i0
        for j in range(nodes):
            j0 = min(j // ratio, field.shape[1] - 2)
            y = j / ratio - j0
            for k in range(line.shape[0]):
                for l in range(n + 1):
                    near = (1.0 - y) * field[i0, j0, k, l] + y * field[i0, j0 + 1, k, l]
                    far = (1.0 - y) * field[i0 + 1, j0, k, l] + y * field[i0 + 1, j0 + 1, k, l]
                    line[k, l] = (1.0 - x) * near + x * far
            for k in range(nodes):
                if shares[i, j, k] <= 0.0:
                    continue
                k0 = min(k // ratio, field.shape[2] - 2)
                z = k / ratio - k0
                for l in range(n):
                    joints[i, j, k, l] = (1.0 - z) * line[k0, l] + z * line[k0 + 1, l]
                condition = (1.0 - z) * line[k0, n] + z * line[k0 + 1, n]
                within = limit_margin(joints[i, j, k], reaching.demands)
                least = min(condition / reaching.scale[CONDITIONING], within / reaching.scale[JOINTS])
                shares[i, j, k] = min(shares[i, j, k], least)


@njit
def shortest(
    value: FloatArray,
    least: float,
    joints: FloatArray,
    weight: FloatArray,
    cost: FloatArray,
    came: IntArray,
    path: IntArray,
) -> int:
    """Shortest in time of the monotone paths through nodes whose shares are ``least`` or more.

    Parameters
    ----------
    value : (a, b, c) best smallest share of the paths up to each node; of the last, ``least`` or more.
    joints : (a, b, c, n) at the nodes, rad or m.
    weight : (n,) seconds a rad or m of each joint takes.
    cost, came : (a, b, c) workspaces.
    path : (≥ a + b + c, 3) on return the nodes, first to last.

    Returns
    -------
    How many nodes the path has.
    """
    a, b, c = value.shape
    for i in range(a):
        for j in range(b):
            for k in range(c):
                cost[i, j, k] = 0.0 if i + j + k == 0 else math.inf
                if value[i, j, k] < least:
                    continue
                for code in range(1, 8):
                    di, dj, dk = code >> 2, (code >> 1) & 1, code & 1
                    if i < di or j < dj or k < dk:
                        continue
                    total = cost[i - di, j - dj, k - dk]
                    if total >= cost[i, j, k]:
                        continue
                    total += stride(joints[i - di, j - dj, k - dk], joints[i, j, k], weight)
                    total += STRAIGHTER * math.sqrt(di + dj + dk)
                    if total < cost[i, j, k]:
                        cost[i, j, k] = total
                        came[i, j, k] = code
    last = a + b + c - 3
    i, j, k = a - 1, b - 1, c - 1
    node = last
    path[node, 0], path[node, 1], path[node, 2] = i, j, k
    while i + j + k > 0:
        code = came[i, j, k]
        i -= code >> 2
        j -= (code >> 1) & 1
        k -= code & 1
        node -= 1
        path[node, 0], path[node, 1], path[node, 2] = i, j, k
    count = last + 1 - node
    for step in range(count):
        for axis in range(3):
            path[step, axis] = path[node + step, axis]
    return int(count)
