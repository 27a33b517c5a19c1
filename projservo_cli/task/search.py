"""A path for joints that the lattice of interpolated joints does not show.

Where the way taken decides how far a joint has turned, ``task.lattice`` sees one of several, and between
nodes of different ways it interpolates what is not there. Here joints are carried from node to node, and a
node keeps different ones that lead to it.
"""

from projservo_cli.geometry.algebra import Mat4
from projservo_cli.geometry.jit import internal, njit
from projservo_cli.geometry.kinematics import backward, operators_at
from projservo_cli.geometry.mechanisms import COORDINATES, Work, reach
from projservo_cli.records import FloatArray, IntArray
from projservo_cli.task.lattice import ROUGH, near, put
from projservo_cli.task.margins import (
    CONDITIONING,
    JOINTS,
    WORST,
    Reaching,
    limit_margin,
    reciprocal_condition,
)
from projservo_cli.task.trajectory import displaced

# A joint that moves more than this between neighbours of the fine lattice, rad or m, has changed its branch;
# joints at a node that differ by more are different ways to be there. Between neighbours further apart it is
# as much more as they are, but no more than ``FARTHEST``.
MOST_STRIDE = 0.5
FARTHEST = 1.5
# Different joints that are tried at a node.
WAYS = 3


@njit
def best_way(
    value: FloatArray, joints: FloatArray, i: int, j: int, k: int, tried: int, stride: float
) -> tuple[float, int, int]:
    """Best value among the ways to the nodes before, of joints unlike the ``tried`` ones at this node.

    Returns
    -------
    Its value, 0 where there is none; the step from there, coded by bits 4, 2, 1 for t, r, p; which way.
    """
    best = 0.0
    step = origin = 0
    for code in range(7, 0, -1):
        x, y, z = i - (code >> 2), j - (code >> 1 & 1), k - (code & 1)
        if min(x, y, z) < 0:
            continue
        for way in range(WAYS):
            if not value[x, y, z, way] > best:
                continue
            fresh = True
            for other in range(tried):
                fresh = fresh and not near(joints[x, y, z, way], joints[i, j, k, other], stride)
            if fresh:
                best, step, origin = value[x, y, z, way], code, way
    return best, step, origin


@njit
def orientation(H_hat: FloatArray, start: FloatArray, G: FloatArray) -> float:
    """Determinant of six operators in terms of those at the start, up to a positive factor.

    Both span the displacements of one frame. On the way the determinant changes its sign where the joints
    pass a configuration at which the operators are dependent.

    Parameters
    ----------
    H_hat, start : (6, 4, 4).
    G : (≥ 6, ≥ 6) workspace.

    Returns
    -------
    1 for arms of other than six joints, whose operators have no determinant.
    """
    n = H_hat.shape[0]
    if n != COORDINATES:
        return 1.0
    for i in range(n):
        for j in range(n):
            inner = 0.0
            for a in range(4):
                for b in range(4):
                    inner += start[i, a, b] * H_hat[j, a, b]
            G[i, j] = inner
    product = 1.0
    for i in range(n):
        longest = i
        for a in range(i + 1, n):
            if abs(G[a, i]) > abs(G[longest, i]):
                longest = a
        pivot = G[longest, i]
        if pivot == 0.0:
            return 0.0
        product *= pivot if longest == i else -pivot
        for b in range(i, n):
            G[i, b], G[longest, b] = G[longest, b], G[i, b]
        for a in range(i + 1, n):
            factor = G[a, i] / pivot
            for b in range(i, n):
                G[a, b] -= factor * G[i, b]
    return product


@internal
def arrive(
    reaching: Reaching,
    H_back: Mat4,
    q: FloatArray,
    before: FloatArray,
    mu: FloatArray,
    mu_step: tuple[float, float, float],
    parts: int,
    stride: float,
    newton: FloatArray,
    work: Work,
) -> bool:
    """Carry the joints ``q``, in place, to mu (3,) in equal parts; whether they settle on the branch."""
    for part in range(1, parts + 1):
        x = 1.0 - part / parts
        mu_t, mu_r, mu_p = mu[0] - x * mu_step[0], mu[1] - x * mu_step[1], mu[2] - x * mu_step[2]
        H = displaced(reaching.H_hat, reaching.amplitudes, mu_t, mu_r, mu_p)
        if not reach(reaching.model, H_back, H, reaching.A, q, work, newton, ROUGH):
            return False
    return near(q, before, stride)


@internal
def carried(
    reaching: Reaching,
    H_back: Mat4,
    q: FloatArray,
    before: FloatArray,
    mu: FloatArray,
    mu_step: tuple[float, float, float],
    parts: int,
    stride: float,
    start: FloatArray,
    scratch: FloatArray,
    work: Work,
) -> float:
    """Smallest share of joint limits and conditioning of the joints at mu (3,), continued; −1 for none.

    Parameters
    ----------
    H_back : inverse forward kinematics at the start.
    q : (n,) where they are looked for first, rad or m, on return the joints; ``before`` where none are.
    before : (n,) joints at the node before.
    mu_step : (3,) shares from there.
    parts : in which the way is made where it cannot be made in one.
    stride : most that a joint may move, rad or m.
    start : (n, 4, 4) operators at the start.
    scratch, work : workspaces, the former (≥ 9, ≥ max(n, 4)).
    """
    n = reaching.q_start.shape[0]
    newton, M = scratch[0, :n], scratch[1:3, :4]
    H = displaced(reaching.H_hat, reaching.amplitudes, mu[0], mu[1], mu[2])
    settled = arrive(reaching, H_back, q, before, mu, mu_step, 1, stride, newton, work)
    if not settled and parts > 1:
        put(q, before)
        settled = arrive(reaching, H_back, q, before, mu, mu_step, parts, stride, newton, work)
    if not (settled and orientation(work.H_hat, start, scratch[3:]) > 0.0):
        put(q, before)
        return -1.0
    share = limit_margin(q, reaching.demands) / reaching.scale[JOINTS]
    if share > 0.0:
        condition = reciprocal_condition(reaching, H, work, M, newton) - reaching.demands.conditioning
        share = min(share, condition / float(reaching.scale[CONDITIONING]))
    return float(share)


@njit
def carry(
    reaching: Reaching,
    views: FloatArray,
    value: FloatArray,
    joints: FloatArray,
    came: IntArray,
    parts: int,
    start: FloatArray,
    scratch: FloatArray,
    work: Work,
) -> None:
    """Carry joints to every node that they reach along monotone paths, by up to ``WAYS`` different ways.

    Parameters
    ----------
    views : (k, k, k) best smallest share in view of the paths up to each node.
    value : (k, k, k, WAYS) on return the best smallest share of the paths by each way; 0 or less for none.
    joints : (k, k, k, WAYS, n) on return rad or m.
    parts : in which the way to a node is made where it cannot be made in one.
    came : (k, k, k, WAYS) on return the step before and 8 times the way it came by.
    start, scratch, work : workspaces (n, 4, 4), (≥ 10, ≥ max(n, 4)), and of n joints and the face.
    """
    last = views.shape[0] - 1
    stride = min(parts * MOST_STRIDE, FARTHEST)
    H_back = backward(reaching.model, reaching.q_start)
    mu, others = scratch[0], scratch[1:]
    operators_at(reaching.model, reaching.q_start, start)
    value[:] = WORST
    for i in range(last + 1):
        for j in range(last + 1):
            for k in range(last + 1):
                if not views[i, j, k] > 0.0:
                    continue
                mu[0], mu[1], mu[2] = i / last, j / last, k / last
                for way in range(WAYS):
                    best, code, origin = views[i, j, k], 0, 0
                    x = y = z = 0
                    before = earlier = reaching.q_start
                    if i + j + k > 0:
                        best, code, origin = best_way(value, joints, i, j, k, way, stride)
                        x, y, z = code >> 2, code >> 1 & 1, code & 1
                        before = earlier = joints[i - x, j - y, k - z, origin]
                        if came[i - x, j - y, k - z, origin] == 8 * origin + code:
                            earlier = joints[i - 2 * x, j - 2 * y, k - 2 * z, origin]
                    if not best > 0.0 or (way > 0 and i + j + k == 0):
                        break
                    q = joints[i, j, k, way]
                    for l in range(q.shape[0]):
                        q[l] = 2.0 * before[l] - earlier[l]
                    share = carried(
                        reaching,
                        H_back,
                        q,
                        before,
                        mu,
                        (x / last, y / last, z / last),
                        parts,
                        stride,
                        start,
                        others,
                        work,
                    )
                    value[i, j, k, way] = min(share, min(best, views[i, j, k]))
                    came[i, j, k, way] = 8 * origin + code


@njit
def traced(value: FloatArray, came: IntArray, path: IntArray) -> int:
    """Write the nodes of the best path to the last node, first to last, to ``path`` (≥ 3k, 3).

    Returns
    -------
    How many there are; 0 where no path leads there.
    """
    i = j = k = value.shape[0] - 1
    way = 0
    for other in range(1, WAYS):
        if value[i, j, k, other] > value[i, j, k, way]:
            way = other
    if not value[i, j, k, way] > 0.0:
        return 0
    node = path.shape[0]
    while True:
        node -= 1
        path[node, 0], path[node, 1], path[node, 2] = i, j, k
        if i + j + k == 0:
            break
        step = came[i, j, k, way]
        way = step >> 3
        i, j, k = i - (step >> 2 & 1), j - (step >> 1 & 1), k - (step & 1)
    count = path.shape[0] - node
    for step in range(count):
        for axis in range(3):
            path[step, axis] = path[node + step, axis]
    return int(count)
