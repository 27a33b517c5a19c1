"""A path for joints that the coarse lattice of joints does not show: depth first over the fine one.

Between obstacles that lie closer than the nodes at which joints are solved for, ``task.lattice`` sees no
way. Here joints are carried along from node to node, as far as a bounded number of nodes allows.
"""

from projservo_cli.geometry.inverse import reach
from projservo_cli.geometry.jit import njit
from projservo_cli.geometry.kinematics import backward
from projservo_cli.geometry.mechanisms import Work
from projservo_cli.records import FloatArray, IntArray
from projservo_cli.task.lattice import ROUGH
from projservo_cli.task.margins import CONDITIONING, JOINTS, Reaching, limit_margin, reciprocal_condition
from projservo_cli.task.trajectory import displaced

# A joint that moves more than this between neighbours, rad or m, has changed its branch.
MOST_STRIDE = 0.5


@njit
def carried(
    reaching: Reaching, q: FloatArray, before: FloatArray, mu: FloatArray, scratch: FloatArray, work: Work
) -> float:
    """Smallest share of joint limits and conditioning of joints ``q`` carried to mu (3,); −1 for none.

    ``q`` comes with the joints ``before``; scratch (≥ 3, ≥ max(n, 4)) and work are workspaces.
    """
    n = reaching.q_start.shape[0]
    newton, M = scratch[0, :n], scratch[1:3, :4]
    H_back = backward(reaching.model, reaching.q_start)
    H = displaced(reaching.H_hat, reaching.amplitudes, mu[0], mu[1], mu[2])
    if not reach(reaching.model, H_back, H, reaching.A, q, work, newton, ROUGH):
        return -1.0
    for i in range(n):
        if not abs(q[i] - before[i]) <= MOST_STRIDE:
            return -1.0
    share = limit_margin(q, reaching.demands) / reaching.scale[JOINTS]
    if share > 0.0:
        condition = reciprocal_condition(reaching, H, work, M, newton) - reaching.demands.conditioning
        share = min(share, condition / float(reaching.scale[CONDITIONING]))
    return float(share)


@njit
def searched(
    reaching: Reaching,
    views: FloatArray,
    least: float,
    most: int,
    came: IntArray,
    joints: FloatArray,
    stack: IntArray,
    scratch: FloatArray,
    work: Work,
    path: IntArray,
) -> int:
    """Find a monotone path of nodes whose shares are more than ``least``, near the diagonal first.

    Parameters
    ----------
    views : (k, k, k) best smallest share in view of the paths up to each node.
    most : nodes whose joints may be solved for.
    came, joints, stack, scratch, work : workspaces (k, k, k), (k, k, k, n), (≥ 7 most + 1, 5), as of
        ``carried`` with a row more, and its own.
    path : (≥ 3k, 3) on return the nodes, first to last.

    Returns
    -------
    How many nodes the path has, 0 where none was found.
    """
    n = reaching.q_start.shape[0]
    last = views.shape[0] - 1
    mu = scratch[3]
    came[:] = -1
    stack[0, :] = 0
    top = 1
    for _ in range(most):
        if top == 0:
            return 0
        top -= 1
        i, j, k, code = stack[top, 0], stack[top, 1], stack[top, 2], stack[top, 3]
        if came[i, j, k] >= 0:
            continue
        before = (
            reaching.q_start if code == 0 else joints[i - (code >> 2), j - (code >> 1 & 1), k - (code & 1)]
        )
        q = joints[i, j, k]
        for l in range(n):
            q[l] = before[l]
        mu[0], mu[1], mu[2] = i / last, j / last, k / last
        if not carried(reaching, q, before, mu, scratch, work) > least:
            continue
        came[i, j, k] = code
        if i + j + k == 3 * last:
            return traced(came, path)
        top = pushed(views, least, i, j, k, stack, top)
    return 0


@njit
def pushed(views: FloatArray, least: float, i: int, j: int, k: int, stack: IntArray, top: int) -> int:
    """Put the neighbours that come after a node on the stack, that nearest to the diagonal on top."""
    last = views.shape[0] - 1
    first = top
    for code in range(1, 8):
        x, y, z = i + (code >> 2), j + (code >> 1 & 1), k + (code & 1)
        if max(x, y, z) > last or not views[x, y, z] > least:
            continue
        stack[top, 0], stack[top, 1], stack[top, 2], stack[top, 3] = x, y, z, code
        stack[top, 4] = 10 * (max(x, y, z) - min(x, y, z)) - (x + y + z)
        place = top
        while place > first and stack[place - 1, 4] < stack[place, 4]:
            for l in range(5):
                stack[place, l], stack[place - 1, l] = stack[place - 1, l], stack[place, l]
            place -= 1
        top += 1
    return top


@njit
def traced(came: IntArray, path: IntArray) -> int:
    """Write the path to the last node; returns how many nodes it has."""
    i = j = k = came.shape[0] - 1
    count = 1
    while i + j + k > 0:
        code = came[i, j, k]
        i, j, k = i - (code >> 2), j - (code >> 1 & 1), k - (code & 1)
        count += 1
    i = j = k = came.shape[0] - 1
    for node in range(count - 1, -1, -1):
        path[node, 0], path[node, 1], path[node, 2] = i, j, k
        code = came[i, j, k]
        i, j, k = i - (code >> 2), j - (code >> 1 & 1), k - (code & 1)
    return count
