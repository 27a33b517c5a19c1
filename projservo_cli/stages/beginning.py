"""The task at its start: measured and split into a translation and two rotations."""

import numpy as np

from projservo_cli.control.law import State, new_state
from projservo_cli.geometry.lens import straight_views
from projservo_cli.geometry.span import joint_motion, span_of
from projservo_cli.loop.beginning import begin, new_stage
from projservo_cli.records import FloatArray, Model
from projservo_cli.stages.constrained import CONSTRAINED
from projservo_cli.stages.sight import Sight, measured_task
from projservo_cli.task.face import Task, require_found
from projservo_cli.task.partition import Parts


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
    n, m = len(q_start), s_start.shape[1]
    task = measured_task(model, q_start, s_start, s_star, center, sight)
    seen = straight_views(model.lens, s_start if sight is None else sight.s_start)
    span = span_of(model, task.A_star)
    state, stage = new_state(n, m, span=span), new_stage(model, m, *bounds, span)
    status, parts, arrives = begin(model, task, seen, q_start, rehearses(profile), state, stage)
    require_found(status, 0)
    return state, task, parts, "" if arrives else "; neither sense of the half turn arrived when rehearsed"


def rehearses(profile: str) -> bool:
    """Whether half turns are rehearsed; the profile constrained compares both senses by itself."""
    return profile != CONSTRAINED


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
