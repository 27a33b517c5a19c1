"""Control law of a list of incidences, with the motions that it leaves free.

q̇ = −λ J⁺ e + (I − J⁺ J) z for the rows of ``task.incidences``; z leads away from limits of joints and from
where a camera loses the face, and does not disturb the task.
"""

import math

from projservo_cli.control.law import LOST, OK, SINGULAR, Gains, State, measure
from projservo_cli.geometry.algebra import Mat4, apply, dot, inverse, mat, vec
from projservo_cli.geometry.jit import internal, merged
from projservo_cli.geometry.kernels import least_squares, minimum_norm
from projservo_cli.records import FloatArray, Model
from projservo_cli.task.face import Task
from projservo_cli.task.incidences import linearize_into

# Part of the range of a joint next to each limit, and of the margin of a view at the goal, in which a free
# motion leads away.
_BAND, _SIDE = 0.1, 0.5
# Free joint motion in a time constant of the law that the steepest slope leads to, rad or m.
_FREE = 0.1


@merged
def incidences(model: Model, task: Task, gains: Gains, s: FloatArray, q: FloatArray, state: State) -> int:
    """Joint velocity −λ J⁺ e + (I − J⁺ J) z of the weighted errors e of all incidences, and their Jacobian J.

    With fewer joints than errors, by least squares.
    """
    state.q_dot[:] = 0.0
    state.errors[:] = math.nan
    if task.incidences.weight.shape[0] == 0 or not measure(model, task, s, q, state):
        return LOST
    H = mat(state.pose)
    H_back = inverse(H)
    linearize_into(task.incidences, H, H_back, state.work.H_hat, state.wanted, state.rates)
    _lead_free(task, gains, q, H_back, state)
    rank, n = state.rates.shape
    for k in range(rank):
        state.wanted[k] *= gains.gain
        for i in range(n):
            state.wanted[k] += state.rates[k, i] * state.q_dot[i]
    system, step = state.work.system, state.work.newton
    if rank <= n:
        if not minimum_norm(system, state.rates, state.wanted, step):
            return SINGULAR
    else:
        for k in range(rank):
            system.rhs[k] = state.wanted[k]
            for i in range(n):
                system.B[i, k] = state.rates[k, i]
        if not least_squares(system, rank, step):
            return SINGULAR
    for i in range(n):
        state.q_dot[i] -= step[i]
    return OK


@internal
def _lead_free(task: Task, gains: Gains, q: FloatArray, H_back: Mat4, state: State) -> None:
    """Write a joint velocity z that leads away from limits, and from where views lose the face.

    Slopes of logarithmic barriers, which begin at the bands; d log(a·O)/dq_i = −aᵀ H⁻¹ Ĥ_i O / (a·O) of the
    plane a of the face and a camera's centre O in the frame of the body.
    """
    z, n, rows = state.q_dot, q.shape[0], task.incidences
    for i in range(n):
        low, high = gains.limits.lower[i], gains.limits.upper[i]
        band = _BAND * (high - low)
        if not math.isfinite(band):
            continue
        near = 1e-3 * band  # at a limit, and beyond it
        if q[i] - low < band:
            z[i] += 1.0 / max(q[i] - low, near) - 1.0 / band
        if high - q[i] < band:
            z[i] -= 1.0 / max(high - q[i], near) - 1.0 / band
    for view in range(rows.shown.shape[0]):
        O, a = vec(task.O[view]), vec(rows.a)
        share = dot(a, apply(H_back, O)) / rows.shown[view]
        if share < _SIDE:
            push = 1.0 / max(share, 1e-3) - 1.0 / _SIDE
            for i in range(n):
                slope = -dot(a, apply(H_back, apply(mat(state.work.H_hat[i]), O)))
                z[i] += push * slope / rows.shown[view]
    size = 0.0
    for i in range(n):
        size += z[i] * z[i]
    size = math.sqrt(size)
    for i in range(n):
        z[i] *= gains.gain * _FREE * _FREE / (1.0 + _FREE * size)
