"""Which way to make a half turn within the plane: both are rehearsed."""

import math

import numpy as np

from projservo_cli.control import CODES
from projservo_cli.control.law import ERRORS, Gains, new_state
from projservo_cli.geometry.kinematics import forward_kinematics
from projservo_cli.geometry.span import span_of
from projservo_cli.loop.compiled import new_log
from projservo_cli.loop.compiled import run as run_loop
from projservo_cli.loop.step import CONVERGED, Limits
from projservo_cli.plants.plant import Plant
from projservo_cli.records import FloatArray, Model
from projservo_cli.task.body import NO_BODY
from projservo_cli.task.face import Task

REHEARSAL_STEPS = 300
REHEARSAL_PX = 1.0
REHEARSAL = Gains(0.1, 0.1, 0.1, 0.1, 1.0, 0.1, 1.0, 0.9)


def half_turn_sense(
    model: Model,
    task: Task,
    A: FloatArray,
    q_start: FloatArray,
    q_hat_p: FloatArray,
    bounds: tuple[FloatArray, FloatArray],
) -> tuple[FloatArray, str]:
    """Sense of a half turn within the plane, as the motion ±q̂_p that begins it, in the coordinates given.

    Either sense reaches the goal, but they take the joints elsewhere. Both are rehearsed on the
    calibrated model itself, at a tenth of the error and at most 5° a step; the sense that arrives
    without passing a joint limit is taken, between equals the one that arrives in fewer steps.

    Parameters
    ----------
    A : (m, 4) face at the start.
    bounds : (n,) lower and upper joint limits, rad or m.

    Returns
    -------
    The joint motion, and what to say of it where neither sense arrived.
    """
    n = len(q_start)
    # Cameras have no sign of their own; the plant tells front from back by positive depths.
    depth = model.P[:, 2] @ A.mean(axis=0)
    model = model._replace(P=model.P * np.sign(depth)[:, None, None])
    task = task._replace(body=NO_BODY)
    M = A @ np.linalg.inv(forward_kinematics(model, q_start)).T
    endless = np.full(2, np.inf)
    plant = Plant(
        model, M, task.order, task.center, task.O, task.visible, endless, bounds[0], bounds[1], False
    )
    rate = np.full(n, math.radians(5.0))
    limits = Limits(rate, REHEARSAL_PX, math.inf, 20, REHEARSAL_STEPS, False, False)
    noise = np.zeros((REHEARSAL_STEPS + 1, 2, len(A), 2))
    outcomes = []
    for sign in (1.0, -1.0):
        state = new_state(n, len(A), span=span_of(model, task.A_star))
        log = new_log(n, len(A), REHEARSAL_STEPS, len(ERRORS))
        state.memory.rotation[1] = sign * q_hat_p
        verdict, steps = run_loop(
            CODES["direct_two"], model, task, REHEARSAL, limits, plant, noise, q_start.copy(), state, log
        )
        outcomes.append((verdict != CONVERGED, log.events[1] >= 0.0, steps, -sign))
    best = min(outcomes)
    note = "; neither sense of the half turn arrived when rehearsed" if best[0] else ""
    return -best[3] * q_hat_p, note
