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
from projservo_cli.task.incidences import SHOWN, linearize_into, rank_of

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
    if rank_of(task.incidences) == 0 or not measure(model, task, s, q, state):
        return LOST
    H = mat(state.pose)
    H_back = inverse(H)
    rank, n, work = rank_of(task.incidences), q.shape[0], state.work
    J, velocity, system, step = work.J[:rank], work.xi[:rank], work.system, work.newton
    linearize_into(task.incidences, H, H_back, work.H_hat, velocity, J)
    _lead_free(task, gains, q, H_back, state)
    for k in range(rank):
        velocity[k] *= gains.gain
        for i in range(n):
            velocity[k] += J[k, i] * state.q_dot[i]
    if rank <= n:
        if not minimum_norm(system, J, velocity, step):
            return SINGULAR
    else:
        for k in range(rank):
            system.rhs[k] = velocity[k]
            for i in range(n):
                system.B[i, k] = J[k, i]
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
    z, n, sight = state.q_dot, q.shape[0], task.incidences.sight
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
    for view in range(task.O.shape[0]):
        O, a, shown = vec(task.O[view]), vec(sight), sight[SHOWN + view]
        share = dot(a, apply(H_back, O)) / shown
        if share < _SIDE:
            push = 1.0 / max(share, 1e-3) - 1.0 / _SIDE
            for i in range(n):
                slope = -dot(a, apply(H_back, apply(mat(state.work.H_hat[i]), O)))
                z[i] += push * slope / shown
    size = 0.0
    for i in range(n):
        size += z[i] * z[i]
    size = math.sqrt(size)
    for i in range(n):
        z[i] *= gains.gain * _FREE * _FREE / (1.0 + _FREE * size)
