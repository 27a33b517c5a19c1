"""Classical image-based and position-based laws: stacked views, each view by itself, points in metres."""

from projservo_cli.control.law import LOST, OK, SINGULAR, Gains, State, measure, pseudo_inverse, view_into
from projservo_cli.geometry.algebra import apply, mat, vec
from projservo_cli.geometry.jit import merged
from projservo_cli.laws import CODES
from projservo_cli.records import FloatArray, Model
from projservo_cli.task.face import Task

_STACKED, _BLOCKWISE = CODES["stacked"], CODES["blockwise"]


@merged
def classical(
    code: int, model: Model, task: Task, gains: Gains, s: FloatArray, q: FloatArray, state: State
) -> int:
    """Joint velocity −λ J⁺ e of the law of a code, with the Jacobian at each instant."""
    if not measure(model, task, s, q, state):
        return LOST
    if code == _BLOCKWISE:
        return _blockwise(model, task, gains, s, state)
    rows = _stack(model, task, s, state) if code == _STACKED else _euclidean_points(task, state)
    if not pseudo_inverse(state, rows, state.q_dot):
        return SINGULAR
    for i in range(q.shape[0]):
        state.q_dot[i] *= -gains.gain
    return OK


@merged
def _stack(model: Model, task: Task, s: FloatArray, state: State) -> int:
    """Jacobian and error s − s* of all views stacked; the number of rows.

    With one view this is the textbook's monocular law. Source: the law of reference [8] in [RH00], with the
    Jacobian of [RH00] eq. (7) at each instant.
    """
    rows: int = 2 * state.A.shape[0]
    V: int = model.P.shape[0]
    for view in range(V):
        view_into(model, task, s, state, view, view * rows)
    return V * rows


@merged
def _blockwise(model: Model, task: Task, gains: Gains, s: FloatArray, state: State) -> int:
    """Joint velocity −λ (J_left⁺ e_left + J_right⁺ e_right …), each view that shows the face by itself.

    Source: the law of reference [10] in [RH00], with the Jacobian of [RH00] eq. (7) at each instant.
    """
    state.q_dot[:] = 0.0
    for view in range(model.P.shape[0]):
        # An expression, as the compiler would compile the function again for a constant.
        if view_into(model, task, s, state, view, 0 * view) == 0:
            continue
        rows = 2 * state.A.shape[0]
        if not pseudo_inverse(state, rows, state.work.newton):
            return SINGULAR
        for i in range(state.q_dot.shape[0]):
            state.q_dot[i] -= gains.gain * state.work.newton[i]
    return OK


@merged
def _euclidean_points(task: Task, state: State) -> int:
    """Jacobian and error X − X* of points X in metres; the number of rows. The model must be metric.

    Source: "a Jacobian for 3D Euclidean points (like (6) but in Euclidean space)", [RH00] section 6.
    """
    m: int = state.A.shape[0]
    system, operators = state.work.system, state.work.columns
    for i in range(operators.shape[0]):
        operator = mat(operators[i])
        for k in range(m):
            velocity = apply(operator, vec(state.A[k]))
            system.B[i, 3 * k] = velocity[0]
            system.B[i, 3 * k + 1] = velocity[1]
            system.B[i, 3 * k + 2] = velocity[2]
    for k in range(m):
        for j in range(3):
            system.rhs[3 * k + j] = state.A[k, j] - task.A_star[k, j]
    return 3 * m
