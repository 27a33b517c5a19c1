"""Direct control laws of the paper: directTHREE with translation and two rotations, directTWO with one."""

from projservo_cli.control.law import (
    OK,
    SINGULAR,
    Gains,
    State,
    joint_velocity_into,
    partitioned,
    single_rotation,
    translation_rate,
)
from projservo_cli.geometry.jit import merged
from projservo_cli.records import FloatArray, Model
from projservo_cli.task.face import Task


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
    return _commanded(gains, state)


@merged
def direct_two(model: Model, task: Task, gains: Gains, s: FloatArray, q: FloatArray, state: State) -> int:
    """Joint velocity λ_t τ q̂_t + λ_s θ_s q̂_s, [RH00] eqs. (23)–(25) as corrected."""
    status, parts = partitioned(model, task, s, q, state)
    if status != OK:
        return status
    found, theta_s, sense, _ = single_rotation(model, parts, gains.ratio_rp, state)
    if not found:
        return SINGULAR
    rate = gains.gain_s * theta_s * sense
    t = translation_rate(task, gains, parts, state)
    for i in range(state.xi_dot.shape[0]):
        state.xi_dot[i] = t * state.q_hat[0, i] + rate * state.q_hat[3, i]
    return _commanded(gains, state)


@merged
def _commanded(gains: Gains, state: State) -> int:
    """Convert ``xi_dot`` to the joint velocity, plus that of a plan; the status."""
    if not joint_velocity_into(state):
        return SINGULAR
    for i in range(state.q_dot.shape[0]):
        state.q_dot[i] += state.q_ahead[i] / gains.period
    return OK
