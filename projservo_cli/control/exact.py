"""Direct control without drift: joint steps whose product of exponentials is the desired displacement.

The paper leaves open how to keep the centre on its line when joint steps are finite. Here the
displacement wanted for one period is solved for the joint step by Newton's method on the projective
forward kinematics alone, [RH00] eqs. (6), (19); no metric quantity enters.
"""

import math
from typing import NamedTuple

from projservo_cli.control.law import (
    MAX_PARTS,
    OK,
    SINGULAR,
    Gains,
    State,
    partitioned,
    put_joint_velocity,
    single_rotation,
    speed_share,
    translation_rate,
)
from projservo_cli.geometry.algebra import Mat4, mul, rotation, translation
from projservo_cli.geometry.jit import internal, merged
from projservo_cli.geometry.kinematics import backward
from projservo_cli.geometry.mechanisms import SETTLED, Seen, reach
from projservo_cli.records import FloatArray, Model
from projservo_cli.task.face import Task
from projservo_cli.task.partition import Parts
from projservo_cli.task.trajectory import following, planned_step, through_joints, under_way

# A joint step of one part of the continuation, rad or m: between its ends linear joint motion strays
# by about 0.1 mm from the path of a robot of a metre's size.
_PART_STEP = math.radians(2.5)
_ROUND_OFF = 1e-13
# Halvings of a step until its end is at a limit: below round-off of a joint reading.
_HALVINGS = 48
_BRANCH_FACTOR = 2.0


class _Step(NamedTuple):
    """Displacement of one period, which is solved for a joint step in so many equal parts."""

    parts: Parts  # translation and rotations that are left
    H_s: Mat4  # operator Ĥ_s of both rotations
    tau: float
    theta: float  # tau, theta: amplitudes of the translation and of that rotation, rad
    sense: float  # factor that scales the joint motion q̂_s to the sense of Ĥ_s
    ahead: float  # share of a period by which a plan is followed
    pieces: int  # how many parts


@merged
def _scaled(step: _Step, share: float, count: int) -> _Step:
    """A share of the displacement."""
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

    Where a plan is followed, the joint motion of its next period is added in the share ``ahead``. NaN
    where the joints cannot make it.
    """
    for i in range(state.xi_dot.shape[0]):
        state.xi_dot[i] = step.tau * state.q_hat[0, i] + step.theta * step.sense * state.q_hat[3, i]
    if not put_joint_velocity(state):
        return math.nan
    most = 0.0
    for i in range(state.q_dot.shape[0]):
        state.q_dot[i] += step.ahead * state.q_ahead[i]
        most = max(most, abs(state.q_dot[i]))
    return most


@internal
def _continued(model: Model, task: Task, q: FloatArray, step: _Step, state: State) -> bool:
    """Solve the displacement in equal parts, each from the one before, into ``state.path``.

    The first part is predicted by the first-order step in ``state.q_dot``, the others by the part
    before. A part more than twice as long as predicted is on another kinematic branch.

    Returns false where a part does not settle or leaves the branch.
    """
    n, count = q.shape[0], step.pieces
    face = Seen(state.A, backward(model, q))
    for i in range(n):
        state.path[0, i] = q[i]
    for j in range(1, count + 1):
        predicted = 0.0
        for i in range(n):
            part = state.q_dot[i] / count if j == 1 else state.path[j - 1, i] - state.path[j - 2, i]
            state.path[j, i] = state.path[j - 1, i] + part
            predicted += part * part
        goal = _desired(step, j / count)
        if following(task.reference) and not through_joints(task.reference):
            ahead = planned_step(model, task.reference, float(state.clock[0]), step.ahead * j / count)
            goal = mul(ahead, goal)
        if not reach(model, face, goal, state.path[j], state.work, SETTLED):
            return False
        taken = 0.0
        for i in range(n):
            part = state.path[j, i] - state.path[j - 1, i]
            taken += part * part
        if taken > _BRANCH_FACTOR * _BRANCH_FACTOR * predicted + _ROUND_OFF * _ROUND_OFF:
            return False
    return True


@merged
def _blocked_joint(q: FloatArray, q_next: FloatArray, gains: Gains) -> int:
    """First joint that a motion from q to q_next takes beyond a limit, or farther beyond it; else −1."""
    for i in range(q.shape[0]):
        if q_next[i] > max(q[i], gains.upper[i]) or q_next[i] < min(q[i], gains.lower[i]):
            return i
    return -1


@merged
def _up_to_limit(model: Model, task: Task, gains: Gains, q: FloatArray, step: _Step, state: State) -> float:
    """Largest share of a step, to round-off, at which no joint passes its limit; its parts in ``state.path``.

    The displacement is shortened along the path by bisection, each time solved for the joints.
    """
    share = 0.0
    width = 0.5
    for _ in range(_HALVINGS):
        trial = _scaled(step, share + width, step.pieces)
        _first_order(trial, state)
        if _continued(model, task, q, trial, state):
            joint = _blocked_joint(q, state.path[step.pieces], gains)
            if joint < 0:
                share += width
            else:
                state.blocked[0] = joint
        width *= 0.5
    last = _scaled(step, share, step.pieces)
    _first_order(last, state)
    if share == 0.0 or not _continued(model, task, q, last, state):
        for j in range(step.pieces + 1):
            for i in range(q.shape[0]):
                state.path[j, i] = q[i]
        share = 0.0
    return share


@merged
def exact(model: Model, task: Task, gains: Gains, s: FloatArray, q: FloatArray, state: State) -> int:
    """Joint velocity whose step moves the face by exp(λ_t τ T Ĥ_t) exp(λ_s θ_s T Ĥ_s) exactly.

    The joint-speed limit shortens the amplitude along the path, by the first-order joint step, before
    any Newton step, and a position limit ends the step on it: the path itself never changes. Long steps
    are continued in parts of about 2.5°; where a part fails there are more of them, up to 128. Across a
    singularity, where none of them can be solved, the first-order step is taken.

    While a plan is followed, the displacement is that of the plan in the next period after the one that
    takes back what the face is off. Along a way through joint space the joints of the plan lead, and to first
    order what takes that back is added.

    Source: [RH00] eqs. (22), (23) as corrected, solved for the joint step through eq. (6).
    """
    status, parts = partitioned(model, task, s, q, state)
    if status != OK:
        return status
    found, theta_s, sense, H_s = single_rotation(model, parts, 1.0, state)
    if not found:
        return SINGULAR
    tau = translation_rate(task, gains, parts, state) * gains.period
    theta = gains.gain_s * theta_s * gains.period
    whole = _Step(parts=parts, H_s=H_s, tau=tau, theta=theta, sense=sense, ahead=1.0, pieces=1)
    if not math.isfinite(_first_order(whole, state)):
        return SINGULAR
    if under_way(task.reference, float(state.clock[0])):
        for i in range(q.shape[0]):
            state.q_dot[i] /= gains.period
        return OK
    share = speed_share(state.q_dot, gains.speed, gains.period)
    step = _scaled(whole, share, 1)
    most = _first_order(step, state)
    count = min(MAX_PARTS, max(1, math.ceil(most / _PART_STEP)))
    step = _scaled(step, 1.0, count)
    while not _continued(model, task, q, step, state):
        if count == MAX_PARTS:
            # Across a singularity the first-order step is all there is.
            _first_order(step, state)
            for i in range(q.shape[0]):
                state.q_dot[i] /= gains.period
            state.share[0], state.parts[0], state.blocked[0] = share, 0, -1
            return OK
        count = min(MAX_PARTS, 2 * count)
        step = _scaled(step, 1.0, count)
    state.blocked[0] = _blocked_joint(q, state.path[count], gains)
    if state.blocked[0] >= 0:
        share *= _up_to_limit(model, task, gains, q, step, state)
    for i in range(q.shape[0]):
        state.q_dot[i] = (state.path[count, i] - q[i]) / gains.period
    state.share[0] = share
    state.parts[0] = count
    return OK
