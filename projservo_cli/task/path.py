"""Paths of shares μ_t, μ_r, μ_p: what they are worth, their joints, and straighter ones."""

import math

import numpy as np

from projservo_cli.geometry.jit import allocating, internal, njit
from projservo_cli.geometry.kinematics import backward, operators_at
from projservo_cli.geometry.mechanisms import SETTLED, Work, reach
from projservo_cli.records import FloatArray, IntArray
from projservo_cli.task.approach import approach
from projservo_cli.task.lattice import near, put, stride
from projservo_cli.task.margins import (
    CONDITIONING,
    JOINTS,
    Reaching,
    image_distance,
    limit_margin,
    reciprocal_condition,
    view_share,
    visibility_margin,
)
from projservo_cli.task.trajectory import displaced

# A joint that moves more than this between neighbours on a path, rad or m, asks for points between.
MOST_PART = 0.2
MOST_PARTS = 256
# Where the joints may stay behind they do so after fewer parts.
FEW_PARTS = 16
# A joint that moves more than this where it stays behind, rad or m, has left the path.
MOST_LEAP = 0.5
# A straight piece may take this much longer than the steps of the lattice that it replaces.
DETOUR = 1.01
ROUND_OFF = 1e-9


@internal
def continued(
    reaching: Reaching,
    first: FloatArray,
    last: FloatArray,
    parts: int,
    q: FloatArray,
    before: FloatArray,
    work: Work,
    newton: FloatArray,
) -> bool:
    """Carry the joints ``q``, in place, along a straight piece of path in equal parts.

    ``before``, ``work`` and ``newton`` are workspaces.

    Returns
    -------
    False where a part does not settle or moves a joint by more than ``MOST_PART``.
    """
    H_back = backward(reaching.model, reaching.q_start)
    for part in range(1, parts + 1):
        x = part / parts
        put(before, q)
        mu_t = (1.0 - x) * first[0] + x * last[0]
        mu_r = (1.0 - x) * first[1] + x * last[1]
        mu_p = (1.0 - x) * first[2] + x * last[2]
        goal = displaced(reaching.H_hat, reaching.amplitudes, mu_t, mu_r, mu_p)
        if not reach(reaching.model, H_back, goal, reaching.A, q, work, newton, SETTLED):
            return False
        if not near(q, before, MOST_PART):
            return False
    return True


@njit
def follow(
    reaching: Reaching,
    mu: FloatArray,
    q: FloatArray,
    condition: FloatArray,
    miss: FloatArray,
    work: Work,
    scratch: FloatArray,
) -> int:
    """Joints along a path and the reciprocal condition there, continued from the start.

    Where they cannot follow they come as near as the demands ask for.

    Parameters
    ----------
    mu : (s, 3) shares, the first row zero.
    q, condition : (s, n) and (s,) on return rad or m, and reciprocal conditions; NaN where the joints
        cannot follow.
    miss : (s,) on return how far the images of the face stay behind, px.
    work, scratch : workspaces, the former of 4m + n rows, the latter (≥ 4, ≥ max(n, 4)).

    Returns
    -------
    How many rows they can follow.
    """
    rows = len(mu)
    n = reaching.q_start.shape[0]
    newton, before, M = scratch[0, :n], scratch[1, :n], scratch[2:4, :4]
    most_parts = FEW_PARTS if reaching.demands.miss_px > 0.0 else MOST_PARTS
    q[:] = math.nan
    condition[:] = math.nan
    miss[:] = 0.0
    H_back = backward(reaching.model, reaching.q_start)
    operators_at(reaching.model, reaching.q_start, work.H_hat)
    for row in range(rows):
        settled = row == 0
        parts = 1
        put(q[row], reaching.q_start if row == 0 else q[row - 1])
        while not settled and parts <= most_parts:
            settled = continued(reaching, mu[row - 1], mu[row], parts, q[row], before, work, newton)
            if not settled:
                parts *= 2
                put(q[row], q[row - 1])
        H = displaced(reaching.H_hat, reaching.amplitudes, mu[row, 0], mu[row, 1], mu[row, 2])
        if not settled:
            miss[row] = approach(reaching, H_back, H, q[row], work, M, newton)
            if not (miss[row] < reaching.demands.miss_px and near(q[row], q[row - 1], MOST_LEAP)):
                q[row, :] = math.nan
                miss[row] = 0.0
                return row
        condition[row] = reciprocal_condition(reaching, H, work, M, newton)
    return rows


@njit
def view_path(reaching: Reaching, mu: FloatArray, visibility: FloatArray, distance: FloatArray) -> None:
    """Margins of visibility (s, 2) and distances from the image border (s, 2), px, along a path."""
    for row in range(mu.shape[0]):
        H = displaced(reaching.H_hat, reaching.amplitudes, mu[row, 0], mu[row, 1], mu[row, 2])
        for view in range(2):
            visibility[row, view] = visibility_margin(reaching, view, mu[row, 0], mu[row, 1])
            distance[row, view] = image_distance(reaching, view, H)


@njit
def interpolate(field: FloatArray, mu: FloatArray, x: FloatArray) -> None:
    """Value (c,) of a field (a, a, a, c) between its nodes, linearly along each axis."""
    last = field.shape[0] - 1
    i = min(int(mu[0] * last), last - 1)
    j = min(int(mu[1] * last), last - 1)
    k = min(int(mu[2] * last), last - 1)
    u, v, w = mu[0] * last - i, mu[1] * last - j, mu[2] * last - k
    for l in range(x.shape[0]):
        near = (1.0 - v) * field[i, j, k, l] + v * field[i, j + 1, k, l]
        far = (1.0 - v) * field[i + 1, j, k, l] + v * field[i + 1, j + 1, k, l]
        low = (1.0 - u) * near + u * far
        near = (1.0 - v) * field[i, j, k + 1, l] + v * field[i, j + 1, k + 1, l]
        far = (1.0 - v) * field[i + 1, j, k + 1, l] + v * field[i + 1, j + 1, k + 1, l]
        x[l] = (1.0 - w) * low + w * ((1.0 - u) * near + u * far)


@internal
def piece(
    reaching: Reaching,
    field: FloatArray,
    weight: FloatArray,
    near: FloatArray,
    far: FloatArray,
    parts: int,
    work: FloatArray,
) -> tuple[float, float]:
    """Smallest share along a straight piece of path, and the time it takes, by interpolated joints.

    Parameters
    ----------
    field : (a, a, a, n + 1) joints and margin of conditioning at coarse nodes.
    weight : (n,) seconds a rad or m of each joint takes.
    near, far : (3,) its ends.
    work : (3, ≥ max(n + 1, 3)) workspace.
    """
    n = weight.shape[0]
    least = math.inf
    time = 0.0
    mu = work[2]
    for part in range(parts + 1):
        x = part / parts
        for axis in range(3):
            mu[axis] = (1.0 - x) * near[axis] + x * far[axis]
        here = work[part % 2, : n + 1]
        interpolate(field, mu, here)
        least = min(least, view_share(reaching, mu[0], mu[1], mu[2]))
        least = min(least, here[n] / reaching.scale[CONDITIONING])
        least = min(least, limit_margin(here[:n], reaching.demands) / reaching.scale[JOINTS])
        if part > 0:
            time += stride(work[(part + 1) % 2, :n], here[:n], weight)
    return least, time


@allocating
def straightened(
    reaching: Reaching,
    field: FloatArray,
    weight: FloatArray,
    path: IntArray,
    last: int,
    least: float,
    kept: IntArray,
) -> int:
    """Corners of a path of lattice nodes that is left when straight pieces serve as well.

    A piece grows as long as its shares stay at ``least`` and it takes no longer than the nodes.

    Parameters
    ----------
    field, weight : as of ``piece``.
    path : (count, 3) nodes, first to last.
    last : index of the last node along each axis.
    kept : (≥count,) on return the indices of the nodes that are corners, both ends among them.

    Returns
    -------
    How many corners there are.
    """
    nodes = path / last
    work = np.empty((3, max(field.shape[3], 3)))
    kept[0] = 0
    corners = 1
    time = 0.0
    for j in range(1, path.shape[0]):
        _, step = piece(reaching, field, weight, nodes[j - 1], nodes[j], 1, work)
        time += step
        anchor = kept[corners - 1]
        if j - anchor > 1:
            share, straight = piece(reaching, field, weight, nodes[anchor], nodes[j], 2 * (j - anchor), work)
            if share < least - ROUND_OFF or straight > DETOUR * time + ROUND_OFF:
                kept[corners] = j - 1
                corners += 1
                time = step
    kept[corners] = path.shape[0] - 1
    return corners + 1
