"""The task at its start: measured and split into a translation and two rotations."""

import math

import numpy as np

from projservo_cli.control.law import State, measure, new_state
from projservo_cli.geometry.lens import straight_views
from projservo_cli.geometry.span import joint_motion, span_of
from projservo_cli.records import FloatArray, Model, WorkFailed
from projservo_cli.stages.constrained import CONSTRAINED
from projservo_cli.stages.half_turn import half_turn_sense
from projservo_cli.stages.sight import Sight, measured_task
from projservo_cli.task.face import Task
from projservo_cli.task.partition import Parts, partition

# Closer than this to half a turn, rad, calibration noise alone decides the sign of the angle.
HALF_TURN_BAND = math.radians(2.0)


def partitioned_at_start(
    model: Model,
    q_start: FloatArray,
    s_start: FloatArray,
    s_star: FloatArray,
    center: int,
    profile: str,
    bounds: tuple[FloatArray, FloatArray],
    sight: Sight | None,
) -> tuple[State, Task, Parts, str]:
    """Measure and partition the task at its start; the arguments are those of ``plan_task``.

    Returns
    -------
    state : with the face and the joint motions.
    task : in the frame of the model.
    parts : translation and rotations, a half turn in the sense that was rehearsed.
    note : what to say of the rehearsal.

    Raises
    ------
    WorkFailed
        If a marker cannot be triangulated or a motion is not unique.
    """
    m = s_start.shape[1]
    task = measured_task(model, q_start, s_start, s_star, center, sight)
    seen = s_start if sight is None else sight.s_start
    state = new_state(len(q_start), m, span=span_of(model, task.A_star))
    if not measure(model, task, straight_views(model.lens, seen), q_start, state):
        raise WorkFailed(
            "the face cannot be triangulated at the start: both cameras must see all its markers"
        )
    parts = partition(state.work, task, state.A, state.A_t, state.A_r, state.q_hat, state.memory)
    if not parts.found:
        raise WorkFailed(
            "the joint motion of the task is not unique at the start: the robot is near a singularity "
            "or moves the face in fewer than six ways"
        )
    note = ""
    if profile != CONSTRAINED and math.pi - abs(parts.theta_p) < HALF_TURN_BAND:
        forward_sense = state.q_hat[2].copy()
        state.memory.rotation[1], note = half_turn_sense(model, task, state.A, q_start, forward_sense, bounds)
        parts = partition(state.work, task, state.A, state.A_t, state.A_r, state.q_hat, state.memory)
    return state, task, parts, note


def joint_motions(state: State) -> FloatArray:
    """Joint motions t, r, p (3, n) of a partitioned task; zero for one that the joints cannot make."""
    q_hat = np.zeros((3, len(state.q_dot)))
    if len(state.work.span.H_hat) == 0:
        q_hat[:] = state.q_hat[:3]
        return q_hat
    for row in range(3):
        if not joint_motion(state.work, state.q_hat[row], q_hat[row]):
            q_hat[row] = 0.0
    return q_hat
