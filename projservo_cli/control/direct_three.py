"""Direct control of translation and two rotations: the paper's directTHREE."""

from projservo_cli.control.law import (
    OK,
    SINGULAR,
    Gains,
    State,
    partitioned,
    put_joint_velocity,
    translation_rate,
)
from projservo_cli.geometry.jit import merged
from projservo_cli.records import FloatArray, Model
from projservo_cli.task.face import Task

CODE = 0


@merged
def direct_three(model: Model, task: Task, gains: Gains, s: FloatArray, q: FloatArray, state: State) -> int:
    """Joint velocity λ_t τ q̂_t + λ_r θ_r q̂_r + λ_p θ_p q̂_p, [RH00] eq. (20) as corrected."""
    status, parts = partitioned(model, task, s, q, state)
    if status != OK:
        return status
    t = translation_rate(task, gains, parts, state)
    r = gains.gain_r * parts.theta_r
    p = gains.gain_p * parts.theta_p
    for i in range(state.xi_dot.shape[0]):
        state.xi_dot[i] = t * state.q_hat[0, i] + r * state.q_hat[1, i] + p * state.q_hat[2, i]
    if not put_joint_velocity(state):
        return SINGULAR
    for i in range(q.shape[0]):
        state.q_dot[i] += state.q_ahead[i] / gains.period
    return OK
