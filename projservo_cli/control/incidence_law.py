"""Control law of a list of incidences, with the motions that it leaves free.

q̇ = −λ J⁺ e + (I − J⁺ J) z for the rows of ``task.incidences``; z leads away from limits of joints and from
where a camera loses the face, and does not disturb the task. The rows alone would rest where a feature points
the other way: it is turned first.
"""

import math

from projservo_cli.control.law import LOST, OK, SINGULAR, Gains, State, measure
from projservo_cli.geometry.algebra import Mat4, apply, dot, inverse, mat, vec
from projservo_cli.geometry.jit import inline, internal, merged
from projservo_cli.geometry.null_space import least_squares, minimum_norm
from projservo_cli.records import FloatArray, Model
from projservo_cli.task.face import MIDPOINT, Task, center_of
from projservo_cli.task.incidences import SHOWN, linearize_into, points_away, rank_of, turn_rate

# Part of the range of a joint next to each limit, and of the margin of a view at the goal, in which a free
# motion leads away.
_BAND, _SIDE = 0.1, 0.5
# Free joint motion in a time constant of the law that the steepest slope leads to, rad or m.
_FREE = 0.1
_SHIFTS = 3  # translations, which a turn leaves out


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
    for sense in task.incidences.senses:
        if points_away(sense, H, H_back):
            _turn_over(task, gains, H, H_back, state)
            return OK
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
def _turn_over(task: Task, gains: Gains, H: Mat4, H_back: Mat4, state: State) -> None:
    """Write the velocity that turns features that point the other way, as far as the joints can turn them.

    The steepest way to their sense, of a rad in a time constant, with the middle of the body at its place as
    far as that leaves joints.
    """
    z, n, work, body = state.q_dot, state.q_dot.shape[0], state.work, task.body
    J, shift, step = work.J[:_SHIFTS], work.xi[:_SHIFTS], work.newton
    for sense in task.incidences.senses:
        if points_away(sense, H, H_back):
            for i in range(n):
                step[i] = turn_rate(sense, H, H_back, mat(work.H_hat[i]))
            size = _norm(step)
            for i in range(n):
                z[i] += step[i] / size if size > 0.0 else 1.0
    middle = apply(H, center_of(body.M, MIDPOINT))
    for k in range(_SHIFTS):
        shift[k] = 0.0
        for i in range(n):
            J[k, i] = dot(vec(body.D[k]), apply(mat(work.H_hat[i]), middle))
            shift[k] += J[k, i] * z[i]
    if n > _SHIFTS and minimum_norm(work.system, J, shift, step):
        for i in range(n):
            z[i] -= step[i]
    size = _norm(z)
    for i in range(n):
        z[i] *= gains.gain / size if size > 0.0 else 0.0


@inline
def _norm(x: FloatArray) -> float:
    """Return the norm of a vector (n,)."""
    total = 0.0
    for value in x:
        total += value * value
    return math.sqrt(total)


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
    size = _norm(z)
    for i in range(n):
        z[i] *= gains.gain * _FREE * _FREE / (1.0 + _FREE * size)
