"""The whole closed loop of a built-in law and an analytic plant, compiled."""

import math
from typing import NamedTuple

from projservo_cli.control import command
from projservo_cli.control.law import OK, Law, State
from projservo_cli.geometry.algebra import mat, mat_into
from projservo_cli.geometry.jit import merged, njit
from projservo_cli.geometry.kinematics import forward
from projservo_cli.loop.verdicts import (
    RUNNING,
    WAITING,
    Command,
    Instant,
    Limits,
    Log,
    bounded,
    note,
    verdict_at,
)
from projservo_cli.records import FloatArray
from projservo_cli.simulation.analytic_plant import Plant, observe, rig_distance


class Course(NamedTuple):
    """State of a run."""

    plant: Plant
    limits: Limits
    q_start: FloatArray  # (n,) first joints, rad or m


@njit
def run_compiled(law: Law, course: Course, noise: FloatArray, state: State, log: Log) -> tuple[int, int]:
    """Drive a law to its verdict.

    noise : (k, V, m + p, 2) added to the true pixels of the first k instants, px.
    state, log : of this run alone; the log is filled up to the last instant, replacing its contents.
    Returns verdict: code of the verdict; ``RUNNING`` if the noise ended before the run, which needs more
    of it to be redrawn; steps: commands sent; the log has one instant more.
    """
    plant, limits, q_start = course
    n = q_start.shape[0]
    M = log.M[: plant.M.shape[0]]
    dq = log.scratch[0, :n]
    log.events[:] = -1.0
    for i in range(n):
        log.q[0, i] = q_start[i]
        log.read[0, i] = q_start[i]
    mat_into(log.H[0], forward(plant.model, q_start))
    for k in range(limits.max_steps + 1):
        if k == noise.shape[0]:
            return RUNNING, k - 1
        _begin_row(log, k)
        s = log.s[k]
        in_front = observe(plant, mat(log.H[k]), M, s, log.hidden[k])
        distance = rig_distance(plant, M)
        for view in range(s.shape[0]):
            for j in range(s.shape[1]):
                s[view, j, 0] += noise[k, view, j, 0]
                s[view, j, 1] += noise[k, view, j, 1]
        left = note(log, k, law.task.s_star, plant, limits)
        status = OK
        if in_front:
            status = command(law, s, log.read[k], state)
            for i in range(log.errors.shape[1]):
                log.errors[k, i] = state.errors[i]
            for i in range(3):
                log.fit[k, i] = state.fit[i]
            if math.isfinite(state.face_px[0]):
                log.judged[k] = state.face_px[0]
        verdict = verdict_at(
            log,
            k,
            Instant(
                in_front=in_front,
                left=left,
                distance=distance,
                status=status,
                q_dot=state.q_dot,
                noise_ratio=1.0,
            ),
            limits,
        )
        if verdict == WAITING:
            dq[:] = 0.0
        elif verdict == RUNNING:
            asked = Command(
                q_dot=state.q_dot,
                share=state.step.share[0],
                blocked=state.step.blocked[0],
                period=law.gains.period,
                scale=1.0,
            )
            verdict = bounded(log, k, asked, plant, limits)
            if verdict == RUNNING and law.gains.substeps and 0 < state.step.parts[0] < log.path.shape[1]:
                log.parts[k] = state.step.parts[0]
                for j in range(state.step.parts[0] + 1):
                    for i in range(n):
                        log.path[k, j, i] = state.step.path[j, i]
        if verdict >= 0:
            return verdict, k
        for i in range(n):
            log.q[k + 1, i] = log.q[k, i] + dq[i]
            log.read[k + 1, i] = log.q[k + 1, i]
        mat_into(log.H[k + 1], forward(plant.model, log.q[k + 1]))
    return RUNNING, limits.max_steps  # not reached: the last instant has a verdict


@merged
def _begin_row(log: Log, k: int) -> None:
    """Mark the row of a time as without measurement and command."""
    for i in range(log.errors.shape[1]):
        log.errors[k, i] = math.nan
    for i in range(log.fit.shape[1]):
        log.fit[k, i] = math.nan
    for i in range(log.q_dot.shape[1]):
        log.q_dot[k, i] = 0.0
    log.factor[k] = 1.0
    log.parts[k] = 0


@njit
def many_steps(law: Law, course: Course, state: State, log: Log) -> float:
    """Measure, partition, command and limit, once in each state of a log: the cost of steps."""
    total = 0.0
    for k in range(log.s.shape[0]):
        command(law, log.s[k], log.q[k], state)
        asked = Command(q_dot=state.q_dot, share=-1.0, blocked=-1, period=law.gains.period, scale=1.0)
        bounded(log, k, asked, course.plant, course.limits)
        total += log.factor[k]
    return total
