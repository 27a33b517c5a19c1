"""All joint vectors that show the goal: Newton's method from random joints, and whole turns of what it finds.

The points of the face are first brought to where they are at the goal, in the coordinates of the calibrated
frame scaled to a_inf·A = 1, which is well behaved from everywhere; then its images, which have the last word.
For an arm of more joints than the face has freedoms what is found is a sample of a continuum.
"""

import math
from typing import NamedTuple

import numpy as np

from projservo_cli.geometry.algebra import apply, mat, put_vec, sub, vec
from projservo_cli.geometry.jit import internal, merged, njit
from projservo_cli.geometry.kinematics import forward, image_velocity, operators_at
from projservo_cli.guidance.margins import straight_pixel
from projservo_cli.guidance.validity import (
    BORDER,
    DEVIATIONS,
    FINE_PX,
    MARGINS,
    Constraints,
    clear_by,
    most_off,
    put_margins,
    put_row,
    time_between,
    twin_of,
)
from projservo_cli.records import PRISMATIC, FloatArray, IntArray

# Newton steps from one start; one that is not near after half of them is given up.
STEPS = 400
# Share of the first squares that is left to one that is given up.
GIVEN_UP = 0.25
DAMPED = 1e6
# A Newton step below this, rad or m, is the last: of points, which are near then, and of images.
NEAR, SETTLED = 1e-3, 1e-7
# Longest Newton step of a joint, rad or m.
STRIDE = 0.7
# Noise that is allowed for where none is known, px.
LEAST_SIGMA = 0.2
# What a solution may leave of the images, px, as a multiple of the least.
MUCH = 2.0
DISTINCT = math.radians(1.0)
# A joint of a solution that deviates more than this, rad or m, is near a singularity: what the model reaches
# there the robot may not. No solution is taken to be nearer to a limit than that by its deviation alone.
DEFINITE = 0.05
REDUNDANT = 0.01
# Rank, s, from which on goals are unsure.
UNSURE = 1e3
ROUND_OFF = 1e-9
# Starts; the search for further goals ends early once so many times the starts until the last new one, and
# ``AT_LEAST``, have found none.
STARTS, PATIENCE, AT_LEAST = 400, 3, 40
# Solutions of an arm of more joints than six.
SAMPLED = 96
BARRED = -1


class Aim(NamedTuple):
    """What the goal shows."""

    A_star: FloatArray  # (m, 4) face at the goal, a_inf·A = 1
    s_star: FloatArray  # (2, m, 2) its images as projective cameras see them, px
    sigma: float  # standard deviation of a coordinate of them, px


class Bench(NamedTuple):
    """Workspace of the solver."""

    H_hat: FloatArray  # (n, 4, 4) operators at the joints
    N: FloatArray  # (n, n + 1) normal equations, right-hand side in the last column
    J: FloatArray  # (n + 1, 4) derivatives of a point, or its images, by the joints; last what is left
    L: FloatArray  # (n, n + 1) damped and factored
    q: FloatArray  # (n,) trial
    M: FloatArray  # (2, 4) a point and its derivative
    base: FloatArray  # (k, n) solutions that are no turns of each other
    left: FloatArray  # (k,) their sums of squares, px²; 0 of those known, which are certain
    deviation: FloatArray  # (k, n) standard deviations of their joints, rad or m
    choice: IntArray  # (n,)
    lowest: FloatArray  # (n,) least of the joints that are whole turns of a solution
    s: FloatArray
    margins: FloatArray  # s, margins: of ``put_margins``


def new_bench(n: int, b: int) -> Bench:
    """Workspace for n joints and b markers; of a redundant arm fewer solutions are looked for."""
    most = STARTS if n <= 6 else SAMPLED
    return Bench(
        np.zeros((n, 4, 4)),
        np.zeros((n, n + 1)),
        np.zeros((n + 1, 4)),
        np.zeros((n, n + 1)),
        np.zeros(n),
        np.zeros((2, 4)),
        np.zeros((most, n)),
        np.zeros(most),
        np.zeros((most, n)),
        np.zeros(n, dtype=np.int64),
        np.zeros(n),
        np.zeros((2, b, 2)),
        np.zeros(MARGINS),
    )


@internal
def _put_equations(c: Constraints, aim: Aim, q: FloatArray, images: bool, bench: Bench) -> float:
    """Write the normal equations of points, or images, at joints; returns the sum of squares left.

    [RH00] eq. (19) for points; eq. (7), second row corrected, for images.
    """
    n = q.shape[0]
    N, J, M = bench.N, bench.J, bench.M
    H = operators_at(c.model, q, bench.H_hat)
    N[:] = 0.0
    total = 0.0
    for k in range(c.face):
        put_vec(M[0], apply(H, vec(c.M[k])))
        put_vec(J[n], sub(vec(aim.A_star[k]), vec(M[0])))
        for i in range(n):
            put_vec(M[1], apply(mat(bench.H_hat[i]), vec(M[0])))
            put_vec(J[i], vec(M[1]))
            for view in range(2 if images else 0):
                u, v, du, dv = image_velocity(c.model.P[view], M[0], M[1])
                J[i, 2 * view], J[i, 2 * view + 1] = du, dv
                J[n, 2 * view] = float(aim.s_star[view, k, 0]) - u
                J[n, 2 * view + 1] = float(aim.s_star[view, k, 1]) - v
        for i in range(n):
            for j in range(i, n + 1):
                N[i, j] += (J[i, 0] * J[j, 0] + J[i, 1] * J[j, 1]) + (J[i, 2] * J[j, 2] + J[i, 3] * J[j, 3])
        e = J[n]
        total += (e[0] * e[0] + e[1] * e[1]) + (e[2] * e[2] + e[3] * e[3])
    return total


@internal
def _put_step(N: FloatArray, damping: float, L: FloatArray) -> bool:
    """Solve (N + damping diag N) x = b by Cholesky's factorisation; x is left in the last column of L."""
    n = L.shape[0]
    most = 0.0
    for i in range(n):
        most = max(most, N[i, i])
    for j in range(n):
        pivot = N[j, j] * (1.0 + damping) + 1e-14 * most
        for k in range(j):
            pivot -= L[k, j] * L[k, j]
        if not pivot > 1e-16 * most:
            return False
        L[j, j] = math.sqrt(pivot)
        for i in range(j + 1, n + 1):
            total = N[j, i]
            for k in range(j):
                total -= L[k, j] * L[k, i]
            L[j, i] = total / L[j, j]
    for j in range(n - 1, -1, -1):
        total = L[j, n]
        for i in range(j + 1, n):
            total -= L[j, i] * L[i, n]
        L[j, n] = total / L[j, j]
    return True


@internal
def _settled(c: Constraints, aim: Aim, images: bool, settled: float, q: FloatArray, bench: Bench) -> float:
    """Bring the joints to the least squares of points or images by damped Newton steps; what is left.

    K. Levenberg, Quarterly of Applied Mathematics 2, 1944; scaled as by D. Marquardt, SIAM Journal 11, 1963.
    """
    n = q.shape[0]
    damping = 1e-3
    left = first = _put_equations(c, aim, q, images, bench)
    for step in range(STEPS):
        if (step == 20 and left > GIVEN_UP * first and not images) or not _put_step(
            bench.N, damping, bench.L
        ):
            break
        longest = 0.0
        for i in range(n):
            longest = max(longest, abs(bench.L[i, n]))
        share = min(1.0, STRIDE / longest) if longest > 0.0 else 1.0
        for i in range(n):
            bench.q[i] = q[i] + share * bench.L[i, n]
        trial = _put_equations(c, aim, bench.q, images, bench)
        if trial < left:
            left = trial
            put_row(q, bench.q)
            damping *= 0.1
        elif longest >= settled and damping <= DAMPED:
            damping *= 10.0
            _put_equations(c, aim, q, images, bench)
            continue
        if longest < settled:
            break
    return left


@internal
def _explained(c: Constraints, aim: Aim, q: FloatArray, bench: Bench, deviation: FloatArray) -> float:
    """Sum of squares, px², that noise and calibration explain of what is left at joints that show the goal.

    Of each way in which the calibration may be off, what no motion of the joints makes up for. The motion
    that makes up for the rest, and for noise, is what the joints may be off: its standard deviation (n,), rad
    or m, is written; ``REDUNDANT`` of an arm of more joints than six, which can move them at will.
    """
    n = q.shape[0]
    L, M = bench.L, bench.M
    noise = aim.sigma * aim.sigma + LEAST_SIGMA * LEAST_SIGMA + c.spread.rest * c.spread.rest
    total: float = (4.0 * c.face - min(n, 6)) * noise
    _put_equations(c, aim, q, True, bench)
    for i in range(n):
        for j in range(n):
            bench.N[j, n] = 1.0 if i == j else 0.0
        deviation[i] = REDUNDANT * REDUNDANT
        if n <= 6:
            deviation[i] = noise * L[i, n] if _put_step(bench.N, 0.0, L) else math.inf
    H = operators_at(c.model, q, bench.H_hat)
    for j in range(1, c.spread.P.shape[0]):
        away = 0.0
        for i in range(n):
            bench.N[i, n] = 0.0
        twin = twin_of(c, j)
        H_j = forward(twin, q)
        for k in range(c.face):
            A, A_j = apply(H, vec(c.M[k])), apply(H_j, vec(c.spread.M[j, k]))
            put_vec(M[0], A)
            for view in range(2):
                (u, v), (u_j, v_j) = straight_pixel(c.model.P[view], A), straight_pixel(twin.P[view], A_j)
                du, dv = u_j - u, v_j - v
                away += du * du + dv * dv
                for i in range(n):
                    put_vec(M[1], apply(mat(bench.H_hat[i]), vec(M[0])))
                    _, _, u_dot, v_dot = image_velocity(c.model.P[view], M[0], M[1])
                    bench.N[i, n] += u_dot * du + v_dot * dv
        if _put_step(bench.N, 0.0, L):
            for i in range(n):
                away -= L[i, n] * bench.N[i, n]
                deviation[i] += L[i, n] * L[i, n] if n <= 6 else 0.0
        total += max(away, 0.0)
    for i in range(n):
        deviation[i] = math.sqrt(deviation[i])
    return DEVIATIONS * DEVIATIONS * total


@merged
def _is_known(c: Constraints, q: FloatArray, base: FloatArray, count: int) -> bool:
    """Whether joints are a solution that was found before, or whole turns of it."""
    for g in range(count):
        most = 0.0
        for i in range(q.shape[0]):
            off = q[i] - base[g, i]
            if c.model.joint_types[i] != PRISMATIC:
                off -= 2.0 * math.pi * math.floor(off / (2.0 * math.pi) + 0.5)
            most = max(most, abs(off))
        if most <= DISTINCT:
            return True
    return False


@merged
def _slack(bench: Bench, k: int, joint: int) -> float:
    """How far beyond a limit, rad or m, the model may put a joint of solution k that is within."""
    doubt = 0.0 if bench.left[k] == 0.0 else DEVIATIONS * float(bench.deviation[k, joint])
    return ROUND_OFF + min(doubt, DEFINITE)


@merged
def _rank(c: Constraints, start: FloatArray, q: FloatArray, bench: Bench, k: int) -> float:
    """Time from the start, s; ``UNSURE`` and more of joints that may be beyond a limit or near a singularity.

    The less they are within the limits, in standard deviations of solution k, the more.
    """
    sure = 1.0
    for i in range(q.shape[0]):
        deviation = float(bench.deviation[k, i])
        if deviation > 0.0:
            sure = min(sure, DEFINITE / deviation)
            if bench.left[k] > 0.0:
                sure = min(sure, min(q[i] - c.lower[i], c.upper[i] - q[i]) / (DEVIATIONS * deviation))
    if sure >= 1.0:
        return time_between(c.speed, start, q)
    return UNSURE if bench.left[k] == 0.0 else UNSURE * (2.0 - max(sure, -1.0))


@internal
def _keep_turns(
    c: Constraints,
    start: FloatArray,
    k: int,
    goals: FloatArray,
    rank: FloatArray,
    bench: Bench,
) -> int:
    """Put the whole turns of a solution within the limits among the goals of least rank; how many.

    ``BARRED`` where it lies within a region that is kept out of, by more than its prediction may be off.
    """
    solution = bench.base[k]
    n, most = solution.shape[0], goals.shape[0]
    q, choice, lowest = bench.q, bench.choice, bench.lowest
    turn = 2.0 * math.pi
    for i in range(n):
        lowest[i], slack = solution[i], _slack(bench, k, i)
        if c.model.joint_types[i] != PRISMATIC:
            low = c.lower[i] if math.isfinite(c.lower[i]) else start[i] - math.pi
            lowest[i] += turn * math.ceil((low - slack - solution[i]) / turn)
        if lowest[i] < c.lower[i] - slack or lowest[i] > c.upper[i] + slack:
            return 0
        choice[i] = 0
        q[i] = lowest[i]
    found = 0
    while True:
        if found == 0:
            # All turns show the same: one test serves them, but for the limits.
            put_margins(c, q, bench.s, bench.margins)
            for j in range(1, BORDER):
                if not bench.margins[j] > 0.0:
                    return 0
            # A goal was chosen, and is seen on arrival: what its prediction may be off speaks for it.
            H = forward(c.model, q)
            left, right = most_off(c, q, H)
            doubt = -min(DEVIATIONS * left, FINE_PX), -min(DEVIATIONS * right, FINE_PX)
            if not clear_by(c, H, bench.s, doubt, math.inf) > 0.0:
                return BARRED
        found += 1
        own = _rank(c, start, q, bench, k)
        if own < rank[most - 1]:
            place = most - 1
            while place > 0 and rank[place - 1] > own:
                rank[place] = rank[place - 1]
                put_row(goals[place], goals[place - 1])
                place -= 1
            rank[place] = own
            for i in range(n):
                goals[place, i] = min(max(q[i], c.lower[i]), c.upper[i])
        i = 0
        while i < n:
            high = c.upper[i] if math.isfinite(c.upper[i]) else start[i] + math.pi
            choice[i] += 1
            q[i] = lowest[i] + choice[i] * turn
            if c.model.joint_types[i] != PRISMATIC and q[i] <= high + _slack(bench, k, i):
                break
            choice[i] = 0
            q[i] = lowest[i]
            i += 1
        if i == n:
            return found


@internal
def _solutions(c: Constraints, aim: Aim, known: FloatArray, starts: FloatArray, bench: Bench) -> int:
    """Write solutions that are no turns of each other, and what is left of each; how many.

    First those known, which need no proof: the goal was seen there, whatever the model says.
    """
    count, last, most = 0, 0, bench.base.shape[0]
    for k in range(known.shape[0]):
        put_row(bench.base[count], known[k])
        _explained(c, aim, known[k], bench, bench.deviation[count])
        bench.left[count] = 0.0
        count += 1
    for k in range(starts.shape[0]):
        if count == most or k > AT_LEAST + PATIENCE * last:
            break
        q = starts[k]
        _settled(c, aim, False, NEAR, q, bench)
        if _is_known(c, q, bench.base, count):
            continue
        left = _settled(c, aim, True, SETTLED, q, bench)
        explained = _explained(c, aim, q, bench, bench.deviation[count])
        if left <= explained and not _is_known(c, q, bench.base, count):
            put_row(bench.base[count], q)
            bench.left[count] = left
            count += 1
            last = k
    return count


@njit
def put_goals(
    c: Constraints,
    aim: Aim,
    start: FloatArray,
    known: FloatArray,
    starts: FloatArray,
    goals: FloatArray,
    rank: FloatArray,
    bench: Bench,
) -> tuple[int, int, int, int]:
    """Write the joints (g, n) that show the goal, and their rank (g,), the least first.

    Rank is the time from the start, s, or ``UNSURE`` and more. A solution that leaves much more than the best
    is a local minimum beside it.

    start : (n,) joints at the start; known : (l, n) joints at which the goal was shown.
    starts : (k, n) from which solutions are sought, those known first; overwritten.
    Returns how many there are, of which the first g are written; how many solutions, apart from whole turns;
    how many of those do not show the face or lie beyond the limits; how many within a region kept out of.
    """
    for g in range(rank.shape[0]):
        rank[g] = math.inf
    count = _solutions(c, aim, known, starts, bench)
    most = math.inf
    for k in range(known.shape[0], count):
        most = min(most, bench.left[k])
    most = MUCH * MUCH * max(most, 4.0 * c.face * LEAST_SIGMA * LEAST_SIGMA)
    solutions, total, hidden, barred = 0, 0, 0, 0
    for k in range(count):
        if bench.left[k] <= most:
            turns = _keep_turns(c, start, k, goals, rank, bench)
            solutions += 1
            total += max(turns, 0)
            hidden += turns == 0
            barred += turns == BARRED
    return total, solutions, hidden, barred
