"""The task at its start: measured and partitioned, and which way to make a half turn within the plane."""

import math
from typing import NamedTuple

import numpy as np

from projservo_cli.control import CODES
from projservo_cli.control.law import ERRORS, Gains, State, measure, new_state, reset
from projservo_cli.geometry.displacement import as_array
from projservo_cli.geometry.jit import composed
from projservo_cli.geometry.kinematics import backward
from projservo_cli.geometry.mechanisms import OWN, Span
from projservo_cli.loop.compiled import Log, new_log, run
from projservo_cli.loop.step import CONVERGED, Limits
from projservo_cli.plants.plant import Plant
from projservo_cli.records import FloatArray, Model
from projservo_cli.task.body import NO_BODY
from projservo_cli.task.face import FOUND, MIDPOINT, NOT_MEASURED, NOT_UNIQUE, Task, center_of
from projservo_cli.task.partition import Parts, no_parts, partition

# Closer than this to half a turn, rad, calibration noise alone decides the sign of the angle.
HALF_TURN_BAND = math.radians(2.0)
REHEARSAL_STEPS = 300
REHEARSAL_PX = 1.0
REHEARSAL_STEP = math.radians(5.0)
REHEARSAL = Gains(0.1, 0.1, 0.1, 0.1, 1.0, 0.1, 1.0, 0.9)
DIRECT_TWO = CODES["direct_two"]


class Stage(NamedTuple):
    """Where half turns are rehearsed: a robot that is as the model says, without noise.

    Attributes
    ----------
    limits : at most 5° a step.
    plant : with the limits of the true joints; its model and face are those of the task.
    noise : (k, 2, m, 2) none.
    state, log : of the law and its run.
    """

    limits: Limits
    plant: Plant
    noise: FloatArray
    state: State
    log: Log


def new_stage(model: Model, m: int, lower: FloatArray, upper: FloatArray, span: Span = OWN) -> Stage:
    """Stage for a face of m markers and joint limits (n,), rad or m; an arm of n ≠ 6 joints has a span."""
    n, endless = len(lower), np.full(2, np.inf)
    no_face = (np.zeros((m, 4)), np.zeros(m, dtype=np.int64), MIDPOINT, np.zeros((2, 4)), np.zeros(2))
    return Stage(
        Limits(np.full(n, REHEARSAL_STEP), REHEARSAL_PX, math.inf, 20, REHEARSAL_STEPS, False, False),
        Plant(model, *no_face, endless, lower, upper, False),
        np.zeros((REHEARSAL_STEPS + 1, 2, m, 2)),
        new_state(n, m, span=span),
        new_log(n, m, REHEARSAL_STEPS, len(ERRORS)),
    )


def begin(
    model: Model, task: Task, s: FloatArray, q_start: FloatArray, rehearse: bool, state: State, stage: Stage
) -> tuple[int, Parts, bool]:
    """Measure and partition the task at its start.

    Parameters
    ----------
    model : calibrated.
    task : in its frame.
    s : (2, b, 2) straight pixels at the start.
    q_start : (n,) joints there, rad or m.
    rehearse : whether a half turn is made in the sense that is better when rehearsed.
    state : fresh; on return with the face and the joint motions.

    Returns
    -------
    What is wrong, ``FOUND`` for nothing; the parts; False where neither sense of a half turn arrived.
    """
    status, parts = first_parts(model, task, s, q_start, state)
    if status == FOUND and rehearse and is_half_turn(parts.theta_p):
        parts, arrives = in_better_sense(model, task, q_start, state, stage)
        return FOUND if parts.found else NOT_UNIQUE, parts, arrives
    return status, parts, True


@composed
def first_parts(
    model: Model, task: Task, s: FloatArray, q_start: FloatArray, state: State
) -> tuple[int, Parts]:
    """Measure and partition the task in the sense that the angles have; what is wrong, and the parts."""
    if not measure(model, task, s, q_start, state):
        return NOT_MEASURED, no_parts()
    parts = partition(state.work, task, state.A, state.A_t, state.A_r, state.q_hat, state.memory)
    return FOUND if parts.found else NOT_UNIQUE, parts


@composed
def is_half_turn(theta_p: float) -> bool:
    """Whether the rotation within the plane is so near to half a turn that its sense must be chosen."""
    return math.pi - abs(theta_p) < HALF_TURN_BAND


def in_better_sense(
    model: Model, task: Task, q_start: FloatArray, state: State, stage: Stage
) -> tuple[Parts, bool]:
    """The parts of a task that was partitioned, with its half turn in the better sense, and if it arrives."""
    sense, arrives = half_turn_sense(model, task, state.A, q_start, state.q_hat[2], stage)
    state.memory.rotation[1] = sense * state.q_hat[2]
    parts = partition(state.work, task, state.A, state.A_t, state.A_r, state.q_hat, state.memory)
    return parts, arrives


def half_turn_sense(
    model: Model, task: Task, A: FloatArray, q_start: FloatArray, q_hat_p: FloatArray, stage: Stage
) -> tuple[float, bool]:
    """Sense of a half turn within the plane, 1 for that of the motion q̂_p or −1, and whether it arrives.

    Either sense reaches the goal, but they take the joints elsewhere. Both are rehearsed on the
    calibrated model itself, at a tenth of the error and at most 5° a step; the sense that arrives
    without passing a joint limit is taken, between equals the one that arrives in fewer steps.

    Parameters
    ----------
    A : (m, 4) face at the start.
    q_hat_p : (n,) joint motion, or (6,) coordinates in the span.
    """
    # Cameras have no sign of their own; the plant tells front from back by positive depths.
    depth = model.P[:, 2] @ np.array(center_of(A, MIDPOINT))
    seen = model._replace(P=model.P * np.sign(depth)[:, None, None])
    plant = stage.plant._replace(
        model=seen,
        M=np.ascontiguousarray(A @ as_array(backward(model, q_start)).T),
        order=task.order,
        center=task.center,
        O=task.O,
        visible=task.visible,
    )
    task = task._replace(body=NO_BODY)

    def rehearsed(sense: float, most: int) -> tuple[bool, bool, int]:
        """Whether a sense arrives, whether it keeps within joint limits, and in how many steps."""
        state, log = stage.state, stage.log
        reset(state)
        state.memory.rotation[1] = sense * q_hat_p
        limits = stage.limits._replace(max_steps=most)
        verdict, steps = run(
            DIRECT_TWO, seen, task, REHEARSAL, limits, plant, stage.noise, q_start, state, log
        )
        return verdict == CONVERGED, bool(log.events[1] < 0.0), steps

    arrived, inside, steps = rehearsed(1.0, REHEARSAL_STEPS)
    # Where the first sense does well, the other one is better only if it arrives before.
    most = max(0, steps - 1) if arrived and inside else REHEARSAL_STEPS
    other_arrived, other_inside, other_steps = rehearsed(-1.0, most)
    better = (not other_arrived, not other_inside, other_steps) < (not arrived, not inside, steps)
    return (-1.0 if better else 1.0), arrived or other_arrived
