"""Inverse kinematics: all goal configurations, by Newton's method from random joints and by whole turns.

The points of the face are first brought to where they are at the goal, in the coordinates of the calibrated
frame scaled to a_inf·A = 1, which is well behaved from everywhere; then its images, which have the last word.
For an arm of more joints than the face has freedoms the solutions are a sample of a continuum.
"""

import math
from typing import NamedTuple

import numpy as np

from projservo_cli.geometry.algebra import Vec4, apply, mat, sub, vec, vec_into, wrapped_angle
from projservo_cli.geometry.jit import internal, merged, njit
from projservo_cli.geometry.kinematics import forward, image_velocity, operators_at
from projservo_cli.geometry.null_space import row_into, solve_normal
from projservo_cli.planning.joint_constraints import (
    DEVIATIONS,
    FINE_PX,
    Constraints,
    Trial,
    clear_by,
    margins_into,
    max_error,
    new_trial,
    twin_of,
)
from projservo_cli.planning.motion_margins import FRONT, IMAGE, column, straight_pixel
from projservo_cli.records import FloatArray

# Maximum number of Newton steps from one start.
_STEPS = 400
# Step at which a start is given up that still has more than this share of its squares.
_JUDGED_AT, _GIVEN_UP = 20, 0.25
_DAMPED = 1e6
# A Newton step below this, rad or m, is the last: of points, which are near then, and of images.
_NEAR, _SETTLED = 1e-3, 1e-7
# Longest Newton step of a joint, rad or m.
_STRIDE = 0.7
# Noise that is allowed for if none is known, px.
_LEAST_SIGMA = 0.2
# Maximum residual of a solution, px, as a multiple of the minimum.
_MUCH = 2.0
_DISTINCT = math.radians(1.0)
# A joint of a solution that deviates more than this, rad or m, is near a singularity: the reach of the model
# there the robot may not. No solution is taken to be nearer to a limit than that by its deviation alone.
_DEFINITE = 0.05
_REDUNDANT = 0.01
# Variance of joints that the images do not determine, rad² or m².
_UNTOLD = 1e6
# Rank, s, from which on goals are unsure.
UNSURE = 1e3
_ROUND_OFF = 1e-9
# Starts; the search for further goals ends early if this multiple of the starts until the last new one, and
# ``_AT_LEAST``, have found none.
STARTS, _PATIENCE, _AT_LEAST = 400, 3, 40
# Whole turns to both sides of the nearest goal that are separate goals.
_TURNS = 2
# Solutions of an arm of more joints than six.
_SAMPLED = 96
# Where the body is at a solution: in sight, or not, or within a region that is kept out of.
_SHOWN, _HIDDEN, _BLOCKED = range(3)


class GoalFeatures(NamedTuple):
    """Images of the goal."""

    A_star: FloatArray  # (m, 4) face at the goal, a_inf·A = 1
    s_star: FloatArray  # (V, m, 2) its images as projective cameras see them, px
    sigma: float  # standard deviation of a coordinate of them, px


class _Solutions(NamedTuple):
    """Joints that show the goal, none of them whole turns of others."""

    q: FloatArray  # (k, n) rad or m
    left: FloatArray  # (k,) their sums of squares, px²; 0 of those known, which are certain
    deviation: FloatArray  # (k, n) standard deviations of their joints, rad or m


class _Scratch(NamedTuple):
    """Workspace of the solver."""

    H_hat: FloatArray  # (n, 4, 4) operators at the joints
    N: FloatArray  # (n, n + 1) normal equations, right-hand side in the last column
    # (m, n + 1, 4 or 2 V) derivatives of points, or their images, by the joints; last the residual
    J: FloatArray
    L: FloatArray  # (n, n + 1) damped and solved
    off: FloatArray  # (2 V,) images by a deviation of the calibration
    q: FloatArray  # (n,) trial


@internal
def _normal_equations_into(
    c: Constraints, goal: GoalFeatures, q: FloatArray, images: bool, scratch: _Scratch
) -> float:
    """Write the normal equations of points, or images, at joints; returns the sum of squares left.

    [RH00] eq. (19) for points; eq. (7), second row corrected, for images.
    """
    n = q.shape[0]
    N = scratch.N
    H = operators_at(c.model, q, scratch.H_hat)
    N[:] = 0.0
    total = 0.0
    for k in range(c.face):
        A, J = apply(H, vec(c.M[k])), scratch.J[k]
        terms = 2 * goal.s_star.shape[0] if images else 4
        if not images:
            vec_into(J[n], sub(vec(goal.A_star[k]), A))
        for i in range(n):
            D = apply(mat(scratch.H_hat[i]), A)
            if images:
                _image_row_into(c.model.P, goal.s_star, k, (A, D), J[i], J[n])
            else:
                vec_into(J[i], D)
        for i in range(n):
            for j in range(i, n + 1):
                N[i, j] += _product(J[i], J[j], terms)
        total += _product(J[n], J[n], terms)
    return total


@merged
def _image_row_into(
    P: FloatArray, s_star: FloatArray, k: int, moving: tuple[Vec4, Vec4], J: FloatArray, off: FloatArray
) -> None:
    """Write the velocities (2 V,) of the images of a point at a velocity, and their errors, px.

    s_star : (V, m, 2) images that are aimed at; both are zero where marker k is not among them.
    """
    A, D = moving
    for view in range(s_star.shape[0]):
        u, v, u_dot, v_dot = image_velocity(P[view], A, D)
        e_u, e_v = float(s_star[view, k, 0]) - u, float(s_star[view, k, 1]) - v
        if not math.isfinite(e_u + e_v):
            u_dot = v_dot = e_u = e_v = 0.0
        J[2 * view], J[2 * view + 1] = u_dot, v_dot
        off[2 * view], off[2 * view + 1] = e_u, e_v


@merged
def _product(x: FloatArray, y: FloatArray, terms: int) -> float:
    """Scalar product of the first terms, an even number, in pairs."""
    total = 0.0
    for i in range(0, terms, 2):
        total += float(x[i]) * float(y[i]) + float(x[i + 1]) * float(y[i + 1])
    return total


@internal
def _damped_step_into(N: FloatArray, damping: float, L: FloatArray) -> bool:
    """Solve (N + damping diag N) x = b; x is left in the last column of L."""
    n = L.shape[0]
    maximum = 0.0
    for i in range(n):
        maximum = max(maximum, N[i, i])
    for i in range(n):
        row_into(L[i], N[i])
        L[i, i] = N[i, i] * (1.0 + damping) + 1e-14 * maximum
    return solve_normal(L, n, 1e-16)


@internal
def _settled(
    c: Constraints, goal: GoalFeatures, images: bool, settled: float, q: FloatArray, scratch: _Scratch
) -> float:
    """Minimize squared errors of points or images by damped Newton steps; return the residual.

    K. Levenberg, Quarterly of Applied Mathematics 2, 1944; scaled as by D. Marquardt, SIAM Journal 11, 1963.
    Compiled for hundreds of starts a goal: SciPy's least squares takes a hundred times as long.
    """
    n = q.shape[0]
    damping = 1e-3
    left = first = _normal_equations_into(c, goal, q, images, scratch)
    for step in range(_STEPS):
        if (step == _JUDGED_AT and left > _GIVEN_UP * first and not images) or not _damped_step_into(
            scratch.N, damping, scratch.L
        ):
            break
        longest = 0.0
        for i in range(n):
            longest = max(longest, abs(scratch.L[i, n]))
        share = min(1.0, _STRIDE / longest) if longest > 0.0 else 1.0
        for i in range(n):
            scratch.q[i] = q[i] + share * scratch.L[i, n]
        trial = _normal_equations_into(c, goal, scratch.q, images, scratch)
        if trial < left:
            left = trial
            row_into(q, scratch.q)
            damping *= 0.1
        elif longest >= settled and damping <= _DAMPED:
            damping *= 10.0
            _normal_equations_into(c, goal, q, images, scratch)
            continue
        if longest < settled:
            break
    return left


@merged
def _apart_into(P: FloatArray, A: Vec4, P_j: FloatArray, A_j: Vec4, off: FloatArray) -> None:
    """Write the differences (2 V,), px, of a point's images by other cameras from another point's."""
    for view in range(P.shape[0]):
        s, s_j = straight_pixel(P[view], A), straight_pixel(P_j[view], A_j)
        off[2 * view], off[2 * view + 1] = s_j[0] - s[0], s_j[1] - s[1]


@internal
def _explained(
    c: Constraints, goal: GoalFeatures, q: FloatArray, scratch: _Scratch, deviation: FloatArray
) -> float:
    """Return the sum of squared residuals, px², that noise and calibration explain at a goal configuration.

    For each error of the calibration, the part that no motion of the joints compensates. The motion
    that makes up for the rest, and for noise, is the error of the joints: its standard deviation (n,), rad
    or m, is written; ``_REDUNDANT`` of an arm of more joints than six, which can move them at will.
    """
    n = q.shape[0]
    noise = goal.sigma * goal.sigma + _LEAST_SIGMA * _LEAST_SIGMA + c.spread.rest * c.spread.rest
    terms = 2 * goal.s_star.shape[0]
    total: float = (float(terms) * c.face - min(n, 6)) * noise
    _normal_equations_into(c, goal, q, True, scratch)
    for i in range(n):
        for j in range(n):
            scratch.N[j, n] = 1.0 if i == j else 0.0
        deviation[i] = _REDUNDANT * _REDUNDANT
        if n <= 6:
            deviation[i] = (
                noise * scratch.L[i, n] if _damped_step_into(scratch.N, 0.0, scratch.L) else _UNTOLD
            )
    H = operators_at(c.model, q, scratch.H_hat)
    for j in range(1, c.spread.P.shape[0]):
        twin = twin_of(c, j)
        H_j = forward(twin, q)
        away = 0.0
        scratch.N[:, n] = 0.0
        for k in range(c.face):
            A, A_j, off = apply(H, vec(c.M[k])), apply(H_j, vec(c.spread.M[j, k])), scratch.off
            _apart_into(c.model.P, A, twin.P, A_j, off)
            away += _product(off, off, terms)
            for i in range(n):
                scratch.N[i, n] += _product(scratch.J[k, i], off, terms)
        if _damped_step_into(scratch.N, 0.0, scratch.L):
            for i in range(n):
                away -= scratch.L[i, n] * scratch.N[i, n]
                deviation[i] += scratch.L[i, n] * scratch.L[i, n] if n <= 6 else 0.0
        total += max(away, 0.0)
    for i in range(n):
        deviation[i] = math.sqrt(deviation[i])
    return DEVIATIONS * DEVIATIONS * total


@merged
def _is_known(c: Constraints, q: FloatArray, base: FloatArray, count: int) -> bool:
    """Whether joints are a solution that was found before, or whole turns of it."""
    for g in range(count):
        maximum = 0.0
        for i in range(q.shape[0]):
            off = q[i] - base[g, i]
            if not c.model.prismatic[i]:
                off = wrapped_angle(off)
            maximum = max(maximum, abs(off))
        if maximum <= _DISTINCT:
            return True
    return False


@njit
def _solutions_into(
    c: Constraints,
    goal: GoalFeatures,
    taught: FloatArray,
    starts: FloatArray,
    solutions: _Solutions,
    scratch: _Scratch,
) -> int:
    """Write solutions; how many. First those taught, which need no proof: the goal was seen there."""
    count, last, maximum = len(taught), 0, solutions.q.shape[0]
    for k in range(count):
        row_into(solutions.q[k], taught[k])
        _explained(c, goal, taught[k], scratch, solutions.deviation[k])
    for k in range(starts.shape[0]):
        if count == maximum or k > _AT_LEAST + _PATIENCE * last:
            break
        q = starts[k]
        # Expressions, as the compiler would compile the function again for each constant.
        _settled(c, goal, k < 0, _NEAR, q, scratch)
        if _is_known(c, q, solutions.q, count):
            continue
        left = _settled(c, goal, k >= 0, _SETTLED, q, scratch)
        explained = _explained(c, goal, q, scratch, solutions.deviation[count])
        if left <= explained and not _is_known(c, q, solutions.q, count):
            row_into(solutions.q[count], q)
            solutions.left[count] = left
            count += 1
            last = k
    return count


@njit
def _where(c: Constraints, q: FloatArray, trial: Trial) -> int:
    """Whether joints (n,) show the goal, but for their limits: ``_SHOWN``, ``_HIDDEN`` or ``_BLOCKED``."""
    margins_into(c, q, trial)
    V = c.O.shape[0]
    for j in range(column(FRONT, V), column(IMAGE, V)):
        if not trial.margins[j] > 0.0:
            return _HIDDEN
    # A goal was chosen, and is seen on arrival: the error of its prediction speaks for it.
    H = forward(c.model, q)
    doubt = min(DEVIATIONS * max_error(c, q, H, trial), FINE_PX)
    return _SHOWN if clear_by(c, H, trial.s) > -doubt else _BLOCKED


def _turns(c: Constraints, start: FloatArray, q: FloatArray, slack: FloatArray) -> FloatArray:
    """Whole turns (t, n) of joints (n,) within the limits and some slack (n,); else nearest to the start.

    No more than ``_TURNS`` to both sides of the nearest: of many joints that turn often there is no end.
    """
    turn, slides = 2.0 * math.pi, c.model.prismatic
    half = np.where(slides, math.inf, 0.5 * turn)
    low = np.where(np.isfinite(c.limits.lower), c.limits.lower, start - half) - slack - q
    high = np.where(np.isfinite(c.limits.upper), c.limits.upper, start + half) + slack - q
    nearest = np.round((start - q) / turn)
    first = np.where(slides, 0.0, np.maximum(np.ceil(low / turn), nearest - _TURNS))
    last = np.minimum(np.floor(high / turn), nearest + _TURNS) + 1.0
    last = np.where(slides, (low <= 0.0) & (high >= 0.0), last)
    counts = np.maximum(last - first, 0.0).astype(int)
    whole = first + np.indices(tuple(counts.tolist())).reshape(len(q), -1, order="F").T
    return np.asarray(q + turn * whole)


def _rank(
    c: Constraints, start: FloatArray, q: FloatArray, deviation: FloatArray, certain: bool
) -> FloatArray:
    """Time from the start (t,), s, to turns (t, n) of a solution of such deviations (n,).

    ``UNSURE`` and more if it may be near a singularity, or beyond a limit if it is not certain: the less
    within in standard deviations, the more.
    """
    sure = np.full(len(q), min(1.0, _DEFINITE / deviation.max()))
    if not certain:
        room = np.minimum(q - c.limits.lower, c.limits.upper - q) / (DEVIATIONS * deviation)
        sure = np.minimum(sure, room.min(axis=1))
    time = (np.abs(q - start) / c.limits.speed).max(axis=1)
    return np.where(sure >= 1.0, time, UNSURE * (1.0 if certain else 2.0 - np.maximum(sure, -1.0)))


def goals_of(
    c: Constraints, goal: GoalFeatures, start: FloatArray, taught: FloatArray, starts: FloatArray
) -> tuple[FloatArray, FloatArray, tuple[int, int, int]]:
    """Return goal configurations (g, n) and their rank (g,), the smallest first.

    Rank is the time from the start, s, or ``UNSURE`` and more. A solution that leaves much more than the best
    is a local minimum next to it.

    start : (n,) joints at the start; taught : (l, n) joints at which the goal was taught.
    starts : (k, n) from which solutions are sought, those taught first; overwritten.
    Also returns how many solutions there are, apart from whole turns; how many of those do not show the face
    or lie beyond the limits; how many lie within a region kept out of.
    """
    n, maximum = len(start), STARTS if len(start) <= 6 else _SAMPLED
    solutions = _Solutions(np.zeros((maximum, n)), np.zeros(maximum), np.zeros((maximum, n)))
    terms = 2 * len(c.O)
    shapes = (n, 4, 4), (n, n + 1), (c.face, n + 1, max(4, terms)), (n, n + 1), (terms,), (n,)
    scratch = _Scratch(*(np.zeros(shape) for shape in shapes))
    count = _solutions_into(c, goal, taught, starts, solutions, scratch)
    minimum = max(solutions.left[len(taught) : count].min(initial=math.inf), 4.0 * c.face * _LEAST_SIGMA**2)
    good = np.flatnonzero(solutions.left[:count] <= _MUCH**2 * minimum)
    goals, ranks, met, trial = [np.zeros((0, n))], [np.zeros(0)], [0, 0, 0], new_trial(c)
    for k in good:
        solution, deviation, certain = solutions.q[k], solutions.deviation[k], solutions.left[k] == 0.0
        slack = _ROUND_OFF + (0.0 if certain else 1.0) * np.minimum(DEVIATIONS * deviation, _DEFINITE)
        turns = _turns(c, start, solution, slack)
        where = _where(c, solution, trial) if len(turns) > 0 else _HIDDEN
        met[where] += 1
        if where == _SHOWN:
            goals.append(np.clip(turns, c.limits.lower, c.limits.upper))
            ranks.append(_rank(c, start, turns, deviation, certain))
    rank = np.concatenate(ranks)
    order = np.argsort(rank, kind="stable")
    return np.vstack(goals)[order], rank[order], (len(good), met[_HIDDEN], met[_BLOCKED])
