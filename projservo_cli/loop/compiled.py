"""The whole closed loop of a built-in law and an analytic plant, compiled."""

import math
from typing import NamedTuple

from projservo_cli.control import command
from projservo_cli.control.law import LOST, SINGULAR, Gains, Law, State
from projservo_cli.geometry.algebra import mat, put_mat
from projservo_cli.geometry.jit import merged, njit
from projservo_cli.geometry.kinematics import beyond_limits, forward
from projservo_cli.loop.step import (
    JOINT_LIMIT,
    MARKERS_LOST,
    MAX_STEPS,
    PLATEAU,
    RUNNING,
    Instant,
    Limits,
    Log,
    finite,
    image_error,
    limit_speed,
    on_plateau,
    outside,
    shorten,
    stands_still,
    tolerance,
    verdict_at,
)
from projservo_cli.records import FloatArray, Model
from projservo_cli.robots.simulated import Plant, move, observe, rig_distance
from projservo_cli.task.face import Task


@njit
def run(
    code: int,
    model: Model,
    task: Task,
    gains: Gains,
    limits: Limits,
    plant: Plant,
    noise: FloatArray,
    q_start: FloatArray,
    state: State,
    log: Log,
) -> tuple[int, int]:
    """Drive one law to its verdict.

    code : of the law.
    model : what the law believes; its frame is that of the task.
    noise : (k, 2, m + p, 2) added to the true pixels of the first k instants, px.
    q_start : (n,) first joints, rad or m.
    log : filled up to the last instant, whatever it held before.
    Returns verdict: code of the verdict; ``RUNNING`` where the noise ended before the run, which needs more
    of it to be made anew; steps: commands sent; the log has one instant more.
    """
    n = q_start.shape[0]
    M = log.M[: plant.M.shape[0]]
    dq = log.scratch[0, :n]
    for i in range(log.events.shape[0]):
        log.events[i] = -1.0
    for i in range(n):
        log.q[0, i] = q_start[i]
        log.read[0, i] = q_start[i]
    put_mat(log.H[0], forward(plant.model, q_start))
    first_distance = 0.0
    first_error = math.nan
    waited = 0
    for k in range(limits.max_steps + 1):
        if k == noise.shape[0]:
            return RUNNING, k - 1
        _begin_row(log, k)
        s = log.s[k]
        in_front = observe(plant, mat(log.H[k]), M, s, log.hidden[k])
        distance = rig_distance(plant, M)
        if plant.disturbance.delay > 0:
            observe(plant, mat(log.H[max(0, k - plant.disturbance.delay)]), M, s, log.scratch[1])
        for view in range(2):
            for j in range(s.shape[1]):
                s[view, j, 0] += noise[k, view, j, 0]
                s[view, j, 1] += noise[k, view, j, 1]
        if k == 0:
            first_distance = distance
        left = outside(s, task.s_star.shape[1], plant.image_size)
        if left and log.events[0] < 0.0:
            log.events[0] = k
        joint = beyond_limits(log.read[k], plant.lower, plant.upper)
        if joint >= 0 and log.events[1] < 0.0 and not limits.stop_at_joint_limit:
            log.events[1] = k
            log.events[2] = joint
        log.error[k] = image_error(s, task.s_star)
        log.judged[k] = log.error[k]
        seen = True
        singular = False
        sound = True
        if in_front:
            status = command(Law(code, model, task, gains), s, log.read[k], state)
            seen = status != LOST
            singular = status == SINGULAR
            sound = finite(state.q_dot)
            for i in range(log.errors.shape[1]):
                log.errors[k, i] = state.errors[i]
            for i in range(3):
                log.fit[k, i] = state.fit[i]
            if math.isfinite(state.face_px[0]):
                log.judged[k] = state.face_px[0]
        error = log.judged[k]
        if math.isnan(first_error):
            first_error = error
        within = tolerance(limits, log.fit[k, 2])
        now = Instant(
            in_front, seen, left, error, first_error, within, distance, first_distance, sound, singular
        )
        verdict = verdict_at(now, limits)
        if verdict == MARKERS_LOST and waited < limits.lost_steps and k < limits.max_steps:
            waited += 1
            for i in range(n):
                dq[i] = 0.0
            move(plant, k + 1, dq, log.H[k : k + 2], log.q[k : k + 2], log.read[k : k + 2])
            continue
        if verdict != RUNNING:
            return verdict, k
        if k == limits.max_steps:
            break
        waited = 0
        if state.share[0] >= 0.0:
            log.factor[k] = state.share[0]
        else:
            log.factor[k] = limit_speed(state.q_dot, limits.speed)
        for i in range(n):
            dq[i] = state.q_dot[i] * gains.period
        if limits.stop_at_joint_limit:
            joint = shorten(log.read[k], dq, plant.lower, plant.upper)
            if joint >= 0:
                for i in range(n):
                    state.q_dot[i] = dq[i] / gains.period
            joint = max(joint, state.blocked[0])
            if joint >= 0 and stands_still(dq):
                log.events[2] = joint
                return JOINT_LIMIT, k
        if gains.substeps and 0 < state.parts[0] < log.path.shape[1]:
            log.parts[k] = state.parts[0]
            for j in range(state.parts[0] + 1):
                for i in range(n):
                    log.path[k, j, i] = state.path[j, i]
        for i in range(n):
            log.q_dot[k, i] = state.q_dot[i]
        move(plant, k + 1, dq, log.H[k : k + 2], log.q[k : k + 2], log.read[k : k + 2])
    last = limits.max_steps
    return PLATEAU if on_plateau(log.judged, last, limits.plateau_steps) else MAX_STEPS, last


@merged
def _begin_row(log: Log, k: int) -> None:
    """Make the row of an instant say that nothing was measured nor commanded."""
    for i in range(log.errors.shape[1]):
        log.errors[k, i] = math.nan
    for i in range(log.fit.shape[1]):
        log.fit[k, i] = math.nan
    for i in range(log.q_dot.shape[1]):
        log.q_dot[k, i] = 0.0
    log.factor[k] = 1.0
    log.parts[k] = 0


class Job(NamedTuple):
    """The arguments of ``run``; ``state`` and ``log`` are its own, the rest may be shared."""

    code: int
    model: Model
    task: Task
    gains: Gains
    limits: Limits
    plant: Plant
    noise: FloatArray
    q_start: FloatArray
    state: State
    log: Log


@njit
def many_steps(job: Job) -> float:
    """Measure, partition, command and limit, once in each state of a log: the cost of steps."""
    total = 0.0
    law = Law(job.code, job.model, job.task, job.gains)
    for k in range(job.log.s.shape[0]):
        command(law, job.log.s[k], job.log.q[k], job.state)
        total += limit_speed(job.state.q_dot, job.limits.speed)
    return total
