"""Classical stereo law: the sum of two monocular laws."""

from projservo_cli.control.law import LOST, OK, SINGULAR, Gains, State, measure, pseudo_inverse, put_view
from projservo_cli.geometry.jit import merged
from projservo_cli.records import FloatArray, Model
from projservo_cli.task.face import Task

CODE = 3


@merged
def blockwise(model: Model, task: Task, gains: Gains, s: FloatArray, q: FloatArray, state: State) -> int:
    """Joint velocity −λ (J_left⁺ e_left + J_right⁺ e_right), each view by itself.

    Source: the law of reference [10] in [RH00], with the Jacobian of [RH00] eq. (7) at each instant.
    """
    if not measure(model, task, s, q, state):
        return LOST
    n = q.shape[0]
    state.q_dot[:] = 0.0
    for view in range(2):
        # Not a constant, for which the compiler would make the function anew.
        put_view(model, task, s, state, view, 0 * view)
        rows = 2 * state.A.shape[0]
        if not pseudo_inverse(state, rows, state.work.newton):
            return SINGULAR
        for i in range(n):
            state.q_dot[i] -= gains.gain * state.work.newton[i]
    return OK
