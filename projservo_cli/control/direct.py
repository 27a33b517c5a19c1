"""Direct control laws: the laws of the paper, and one without drift.

directTHREE moves by a translation and two rotations, directTWO by a translation and one. The paper leaves
open how to keep the centre on its line with finite joint steps. The exact law solves the desired
displacement of one period for the joint step, by Newton's method on the projective forward kinematics
alone, [RH00] eqs. (6), (19), without metric quantities.
"""

import math
from typing import NamedTuple

from projservo_cli.control.law import (
    MAX_PARTS,
    OK,
    SINGULAR,
    Gains,
    State,
    joint_velocity_into,
    partitioned,
    single_rotation,
    speed_share,
    translation_rate,
)
from projservo_cli.geometry.algebra import Mat4, mul
from projservo_cli.geometry.displacements import rotation, translation
from projservo_cli.geometry.jit import internal, merged
from projservo_cli.geometry.kinematics import backward
from projservo_cli.geometry.mechanisms import SETTLED, MeasuredFace, reach
from projservo_cli.laws import CODES
from projservo_cli.records import FloatArray, Model
from projservo_cli.task.face import Task
from projservo_cli.task.partition import Parts
from projservo_cli.task.trajectory import following, follows_joint_path, on_joint_path, planned_step

_DIRECT_THREE = CODES["direct_three"]
# Joint step of one part of the continuation, rad or m: linear joint motion then deviates from the path of a
# robot of a metre's size by about 0.1 mm.
_PART_STEP = math.radians(2.5)
# Joint step, rad or m, below which it is round-off.
_ROUND_OFF = 1e-13
# Bisections of a step until its end is at a limit, below round-off of a joint reading.
_HALVINGS = 48
# Share of the joint-speed limit aimed at if a solved step is beyond it: joint motion is not quite
# proportional to the amplitude.
_AIM = 0.999
# Length of a part over its prediction above which it is on another kinematic branch.
_BRANCH_FACTOR = 2.0


@merged
def direct(
    code: int, model: Model, task: Task, gains: Gains, s: FloatArray, q: FloatArray, state: State
) -> int:
    """Joint velocity of directTHREE or directTWO by the code, plus the velocity of a plan."""
    status, parts = partitioned(model, task, s, q, state)
    if status != OK:
        return status
    if code == _DIRECT_THREE:
        direct_three(task, gains, parts, state)
    elif not direct_two(model, task, gains, parts, state):
        return SINGULAR
    if not joint_velocity_into(state):
        return SINGULAR
    for i in range(state.q_dot.shape[0]):
        state.q_dot[i] += state.plan.q_ahead[i] / gains.period
    return OK


@merged
def direct_three(task: Task, gains: Gains, parts: Parts, state: State) -> None:
    """Velocity λ_t τ q̂_t + λ_r θ_r q̂_r + λ_p θ_p q̂_p into ``xi_dot``, [RH00] eq. (20) as corrected."""
    t = translation_rate(task, gains, parts, state)
    r = gains.gain_r * parts.theta_r
    p = gains.gain_p * parts.theta_p
    for i in range(state.xi_dot.shape[0]):
        state.xi_dot[i] = t * state.q_hat[0, i] + r * state.q_hat[1, i] + p * state.q_hat[2, i]


@merged
def direct_two(model: Model, task: Task, gains: Gains, parts: Parts, state: State) -> bool:
    """Velocity λ_t τ q̂_t + λ_s θ_s q̂_s into ``xi_dot``, [RH00] eqs. (23)–(25) as corrected.

    Returns False if the joint motion is not unique.
    """
    unique, theta_s, sense, _ = single_rotation(model, parts, gains.ratio_rp, state)
    if not unique:
        return False
    rate = gains.gain_s * theta_s * sense
    t = translation_rate(task, gains, parts, state)
    for i in range(state.xi_dot.shape[0]):
        state.xi_dot[i] = t * state.q_hat[0, i] + rate * state.q_hat[3, i]
    return True


class _Step(NamedTuple):
    """Displacement of one period, to solve for a joint step in equal parts."""

    parts: Parts  # remaining translation and rotations
    H_s: Mat4  # operator Ĥ_s of both rotations
    tau: float  # amplitude of the translation
    theta: float  # amplitude of the rotation Ĥ_s, rad
    sense: float  # factor that scales the joint motion q̂_s to the sense of Ĥ_s
    ahead: float  # share of a period of the plan to follow
    pieces: int  # number of parts


@merged
def _scaled(step: _Step, share: float, count: int) -> _Step:
    """Share of the displacement, in ``count`` parts."""
    tau, theta, ahead = share * step.tau, share * step.theta, share * step.ahead
    return _Step(
        parts=step.parts, H_s=step.H_s, tau=tau, theta=theta, sense=step.sense, ahead=ahead, pieces=count
    )


@merged
def _desired(step: _Step, share: float) -> Mat4:
    """Share of the displacement of one period, exp(share τ Ĥ_t) exp(share θ Ĥ_s), [RH00] eq. (22)."""
    return mul(translation(step.parts.H_t, share * step.tau), rotation(step.H_s, share * step.theta))


@internal
def _first_order(step: _Step, state: State) -> float:
    """First-order joint step τ q̂_t + θ q̂_s of one period into ``state.q_dot``; its largest entry.

    With a plan it adds the share ``ahead`` of the joint motion of the next period. NaN if the joints cannot
    make the motion.
    """
    for i in range(state.xi_dot.shape[0]):
        state.xi_dot[i] = step.tau * state.q_hat[0, i] + step.theta * step.sense * state.q_hat[3, i]
    if not joint_velocity_into(state):
        return math.nan
    largest = 0.0
    for i in range(state.q_dot.shape[0]):
        state.q_dot[i] += step.ahead * state.plan.q_ahead[i]
        largest = max(largest, abs(state.q_dot[i]))
    return largest


@internal
def _continued(model: Model, task: Task, q: FloatArray, step: _Step, settled: float, state: State) -> bool:
    """Solve the displacement in equal parts, each from the previous one, into ``state.step.path``.

    The first-order step in ``state.q_dot`` predicts the first part, the previous part the others. A part more
    than twice as long as predicted is on another kinematic branch.

    Returns false if a part does not settle or leaves the branch.
    """
    n, count = q.shape[0], step.pieces
    face = MeasuredFace(state.A, backward(model, q))
    for i in range(n):
        state.step.path[0, i] = q[i]
    for j in range(1, count + 1):
        predicted = 0.0
        for i in range(n):
            part = state.q_dot[i] / count if j == 1 else state.step.path[j - 1, i] - state.step.path[j - 2, i]
            state.step.path[j, i] = state.step.path[j - 1, i] + part
            predicted += part * part
        goal = _desired(step, j / count)
        if following(task.reference) and not follows_joint_path(task.reference):
            ahead = planned_step(model, task.reference, float(state.plan.clock[0]), step.ahead * j / count)
            goal = mul(ahead, goal)
        if not reach(model, face, goal, state.step.path[j], state.work, settled):
            return False
        taken = 0.0
        for i in range(n):
            part = state.step.path[j, i] - state.step.path[j - 1, i]
            taken += part * part
        if taken > _BRANCH_FACTOR * _BRANCH_FACTOR * predicted + _ROUND_OFF * _ROUND_OFF:
            return False
    return True


@merged
def _within_speed(gains: Gains, q: FloatArray, end: FloatArray, seconds: float, state: State) -> float:
    """Write the velocity of a joint step from q to its end; the share of it within the joint-speed limit."""
    for i in range(q.shape[0]):
        state.q_dot[i] = (end[i] - q[i]) / seconds
    return speed_share(state.q_dot, gains.limits.speed, 1.0)


@merged
def _solved(model: Model, task: Task, gains: Gains, q: FloatArray, step: _Step, state: State) -> float:
    """Solve a displacement in its parts and write its velocity; the share within the limit, 0 if unsolved."""
    if not _continued(model, task, q, step, SETTLED, state):
        return 0.0
    return _within_speed(gains, q, state.step.path[step.pieces], gains.period * gains.scale, state)


@merged
def _blocked_joint(q: FloatArray, q_next: FloatArray, gains: Gains) -> int:
    """First joint that a motion from q to q_next moves beyond a limit, or farther beyond it; otherwise −1."""
    for i in range(q.shape[0]):
        if q_next[i] > max(q[i], gains.limits.upper[i]) or q_next[i] < min(q[i], gains.limits.lower[i]):
            return i
    return -1


@merged
def _up_to_limit(model: Model, task: Task, gains: Gains, q: FloatArray, step: _Step, state: State) -> float:
    """Maximum share of a step, to round-off, within the joint limits; its parts in ``state.step.path``.

    By bisection of the displacement along the path, solved for the joints each time.
    """
    share = 0.0
    width = 0.5
    for _ in range(_HALVINGS):
        trial = _scaled(step, share + width, step.pieces)
        _first_order(trial, state)
        if _continued(model, task, q, trial, SETTLED, state):
            joint = _blocked_joint(q, state.step.path[step.pieces], gains)
            if joint < 0:
                share += width
            else:
                state.step.blocked[0] = joint
        width *= 0.5
    last = _scaled(step, share, step.pieces)
    _first_order(last, state)
    if share == 0.0 or not _continued(model, task, q, last, SETTLED, state):
        for j in range(step.pieces + 1):
            for i in range(q.shape[0]):
                state.step.path[j, i] = q[i]
        share = 0.0
    return share


@merged
def exact(model: Model, task: Task, gains: Gains, s: FloatArray, q: FloatArray, state: State) -> int:
    """Joint velocity whose step moves the face by exp(λ_t τ T Ĥ_t) exp(λ_s θ_s T Ĥ_s) exactly.

    The joint-speed limit shortens the amplitude along the path: by the first-order joint step, before any
    Newton step, then by the solved one. A position limit ends the step on it: the path itself never changes.
    Long steps are solved in parts of about 2.5°, or if a part fails in more, up to 128. Across a singularity,
    if no part can be solved, the law takes the first-order step. If every command is scaled, that share
    of the displacement is solved, since the displacement of the joint step would leave the path.

    With a plan, the displacement is taken from the plan in the next period after the correction of the face.
    Along a joint-space path the joints of the plan lead, and the first-order correction is added.

    Source: [RH00] eqs. (22), (23) as corrected, solved for the joint step through eq. (6).
    """
    status, parts = partitioned(model, task, s, q, state)
    if status != OK:
        return status
    unique, theta_s, sense, H_s = single_rotation(model, parts, 1.0, state)
    if not unique:
        return SINGULAR
    tau = translation_rate(task, gains, parts, state) * gains.period
    theta = gains.gain_s * theta_s * gains.period
    whole = _Step(parts=parts, H_s=H_s, tau=tau, theta=theta, sense=sense, ahead=1.0, pieces=1)
    if not math.isfinite(_first_order(whole, state)):
        return SINGULAR
    if on_joint_path(task.reference, float(state.plan.clock[0])):
        for i in range(q.shape[0]):
            state.q_dot[i] /= gains.period
        return OK
    share, seconds = speed_share(state.q_dot, gains.limits.speed, gains.period), gains.period * gains.scale
    if share < 1.0:
        # One Newton step estimates how far the solved step exceeds the limit.
        step = _scaled(whole, share * gains.scale, 1)
        _first_order(step, state)
        _continued(model, task, q, step, math.inf, state)
        left = _within_speed(gains, q, state.step.path[1], seconds, state)
        if left < 1.0:
            share *= max(_AIM * left, 1.0 / _BRANCH_FACTOR)
    step = _scaled(whole, share * gains.scale, 1)
    largest = _first_order(step, state)
    count = min(MAX_PARTS, max(1, math.ceil(largest / _PART_STEP)))
    left = _solved(model, task, gains, q, _scaled(step, 1.0, count), state)
    while left < 1.0:
        if left > 0.0:
            share *= _AIM * left
        elif count < MAX_PARTS:
            count = min(MAX_PARTS, 2 * count)
        else:
            break
        step = _scaled(whole, share * gains.scale, count)
        _first_order(step, state)
        left = _solved(model, task, gains, q, step, state)
    if left == 0.0:
        # Across a singularity only the first-order step remains.
        _first_order(step, state)
        for i in range(q.shape[0]):
            state.q_dot[i] /= seconds
        state.step.share[0], state.step.parts[0], state.step.blocked[0] = share, 0, -1
        return OK
    state.step.blocked[0] = _blocked_joint(q, state.step.path[count], gains)
    if state.step.blocked[0] >= 0:
        step = _scaled(whole, share * gains.scale, count)
        share *= _up_to_limit(model, task, gains, q, step, state)
        _within_speed(gains, q, state.step.path[count], seconds, state)
    state.step.share[0] = share
    state.step.parts[0] = count
    return OK
