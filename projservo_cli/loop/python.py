"""The closed loop in Python: any law on any plant, the same limits, counting and verdicts."""

import math
from typing import Protocol

import numpy as np

from projservo_cli.control.bound import bind, bound_command
from projservo_cli.control.law import ERRORS, LOST, SINGULAR, Gains, new_state
from projservo_cli.geometry.kinematics import beyond_limits
from projservo_cli.geometry.mechanisms import span_of
from projservo_cli.loop.compiled import Log, new_log
from projservo_cli.loop.step import (
    DISTURBED,
    FAILED,
    JOINT_LIMIT,
    MARKERS_LOST,
    MAX_STEPS,
    PLATEAU,
    RUNNING,
    Instant,
    Limits,
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
from projservo_cli.records import FloatArray, Model, WorkFailed
from projservo_cli.robots.simulated import Plant
from projservo_cli.task.face import Task

LEFT_TO_THE_LOOP = (-1.0,)
NOT_FITTED = (np.nan, np.nan, np.nan)
UNKNOWN = (np.nan,)
FREE = (-1,)


class LoopLaw(Protocol):
    """What the Python loop asks of a law.

    A law that keeps the joint-speed limit itself has an attribute ``share`` (1,), the share of the
    amplitude its limit left; the limit is else up to the loop. One that fits a body has an attribute
    ``fit`` (3,), which the log keeps, and ``face_px`` (1,), the image error of the face by which the run
    is judged. One that ends a step at the limit of a joint has an attribute ``blocked`` (1,), that joint
    or −1. One that wants its step sent in parts has an attribute ``path``
    (parts + 1, n), the joints between them.
    """

    errors: FloatArray

    def __call__(self, s: FloatArray, q: FloatArray) -> tuple[int, FloatArray]:
        """Status and joint velocity (n,), rad/s or m/s, for pixels (2, m, 2) and joints (n,).

        Pixels are NaN where a marker was not seen; the status is LOST where too little was.
        """


class LoopPlant(Protocol):
    """What the Python loop asks of a plant.

    Attributes
    ----------
    plant : the truth, or what the calibration takes for it: image size, joint limits.
    q : (n,) joints as they are, or as they were read.
    H : (4, 4) displacement of the face from the reference.
    hidden, in_front : as of ``plants.plant.observe``, when last observed.
    markers : how many are observed, those of the face first.
    disturbance : why the run cannot go on, the images no longer agree with the calibration or something
        failed; empty where it can.
    takes_parts : whether a long step is sent in the parts that the law split it into.
    """

    plant: Plant
    q: FloatArray
    H: FloatArray
    hidden: FloatArray
    in_front: bool
    markers: int
    disturbance: str
    takes_parts: bool

    def joints(self) -> FloatArray:
        """Joint readings (n,), rad or m."""

    def observe(self) -> FloatArray:
        """Pixels (2, markers, 2), NaN where unseen."""

    def distance(self) -> float:
        """Distance of the face from the rig when last observed, m; constant where it is unknown."""

    def command(self, step: FloatArray, period: float) -> None:
        """Move by the joint step (n,), rad or m, within one period, s."""

    def stop(self) -> None:
        """Come to rest."""


class BuiltInLaw:
    """A compiled law as an object of the Python loop.

    Parameters
    ----------
    code : of the law.
    model : what the law believes.
    task : in the frame of the model.
    gains : of the law.
    """

    def __init__(self, code: int, model: Model, task: Task, gains: Gains) -> None:
        self.gains = gains
        span = span_of(model, task.A_star)
        self.state = new_state(len(model.H_hat_0), len(task.A_star), len(task.body.M), span)
        self.bound = bind(code, model, task, gains, self.state)
        self.errors = self.state.errors
        self.share = self.state.share
        self.fit = self.state.fit
        self.face_px = self.state.face_px
        self.blocked = self.state.blocked

    @property
    def path(self) -> FloatArray:
        """Joints (parts + 1, n) between the parts of the last step; one row where it has none."""
        return self.state.path[: self.state.parts[0] + 1] if self.gains.substeps else self.state.path[:1]

    def __call__(self, s: FloatArray, q: FloatArray) -> tuple[int, FloatArray]:
        """Status and joint velocity of one instant."""
        status = bound_command(self.bound, s, q)
        return status, self.state.q_dot.copy()


def run(
    law: LoopLaw, plant: LoopPlant, s_star: FloatArray, period: float, limits: Limits, scale: float = 1.0
) -> tuple[int, int, Log]:
    """Drive a law on a plant to its verdict.

    Parameters
    ----------
    law : any law.
    plant : any plant; it is stopped however the run ends.
    s_star : (2, m, 2) target pixels.
    period : control period, s.
    limits : when the run ends.
    scale : factor of every command.

    Returns
    -------
    verdict, steps, log : as of the compiled loop, to the bit for the built-in laws.

    Raises
    ------
    WorkFailed
        If the plant or the law fails before the first instant is complete.
    """
    reached = [0]
    try:
        log = new_log(len(plant.joints()), plant.markers, limits.max_steps, len(ERRORS))
        for column in (log.read, log.q, log.s, log.error, log.judged):
            column[:] = math.nan
        try:
            verdict, steps = _run(law, plant, s_star, period, limits, scale, log, reached)
        except WorkFailed as error:
            steps = reached[0]
            if steps == 0:
                raise
            verdict, plant.disturbance = FAILED, str(error)
    finally:
        plant.stop()
    return verdict, steps, log


def _run(
    law: LoopLaw,
    plant: LoopPlant,
    s_star: FloatArray,
    period: float,
    limits: Limits,
    scale: float,
    log: Log,
    reached: list[int],
) -> tuple[int, int]:
    """Fill the log and return verdict and steps; the instant it has come to is in ``reached``."""
    first_distance, first_error, waited = 0.0, math.nan, 0
    for k in range(limits.max_steps + 1):
        reached[0] = k
        log.read[k] = plant.joints()
        log.q[k], log.H[k] = plant.q, plant.H
        log.s[k] = plant.observe()
        log.hidden[k] = plant.hidden
        distance = plant.distance()
        first_distance = distance if k == 0 else first_distance
        left = outside(log.s[k], s_star.shape[1], plant.plant.image_size)
        if left and log.events[0] < 0.0:
            log.events[0] = k
        joint = beyond_limits(log.read[k], plant.plant.lower, plant.plant.upper)
        if joint >= 0 and log.events[1] < 0.0 and not limits.stop_at_joint_limit:
            log.events[1], log.events[2] = k, joint
        log.error[k] = log.judged[k] = image_error(log.s[k], s_star)
        if plant.disturbance:
            return DISTURBED, k
        seen, singular, sound, q_dot = True, False, True, np.zeros_like(log.read[k])
        if plant.in_front:
            status, q_dot = law(log.s[k], log.read[k])
            seen, singular, sound = status != LOST, status == SINGULAR, finite(q_dot)
            log.errors[k], log.fit[k] = law.errors, getattr(law, "fit", NOT_FITTED)
            face_px = float(getattr(law, "face_px", UNKNOWN)[0])
            log.judged[k] = face_px if math.isfinite(face_px) else log.judged[k]
        error = float(log.judged[k])
        first_error = error if math.isnan(first_error) else first_error
        within = tolerance(limits, float(log.fit[k, 2]))
        now = Instant(
            plant.in_front, seen, left, error, first_error, within, distance, first_distance, sound, singular
        )
        verdict = verdict_at(now, limits)
        if verdict == MARKERS_LOST and waited < limits.lost_steps and k < limits.max_steps:
            waited += 1
            plant.command(np.zeros_like(q_dot), period)
            continue
        if verdict != RUNNING:
            return verdict, k
        if k == limits.max_steps:
            break
        waited = 0
        share = float(getattr(law, "share", LEFT_TO_THE_LOOP)[0])
        log.factor[k] = share if share >= 0.0 else limit_speed(q_dot, limits.speed)
        q_dot = q_dot * scale
        dq = q_dot * period
        if limits.stop_at_joint_limit:
            joint = shorten(log.read[k], dq, plant.plant.lower, plant.plant.upper)
            if joint >= 0:
                q_dot = dq / period
            joint = max(joint, int(getattr(law, "blocked", FREE)[0]))
            if joint >= 0 and stands_still(dq):
                log.events[2] = joint
                return JOINT_LIMIT, k
        steps = _steps(plant, law, dq, scale)
        for step in steps:
            plant.command(step, time_for(step, period / len(steps), limits.speed * scale))
        log.q_dot[k] = q_dot
    last = limits.max_steps
    return (PLATEAU if on_plateau(log.judged, last, limits.plateau_steps) else MAX_STEPS), last


def _steps(plant: LoopPlant, law: LoopLaw, dq: FloatArray, scale: float) -> FloatArray:
    """The joint steps (parts, n) to send: one, or the parts of a long one that is not scaled down."""
    path = getattr(law, "path", None)
    if path is None or len(path) < 3 or scale < 1.0 or not plant.takes_parts:
        return dq[None]
    return np.asarray(np.diff(path, axis=0))


def time_for(step: FloatArray, period: float, speed: FloatArray) -> float:
    """Time, s, for a joint step (n,): the period, or longer where a joint would be too fast.

    A law that keeps to its path bounds its joint steps to first order only; what it exceeds the limit
    by costs time instead of leaving the path.
    """
    return max(period, float(np.max(np.abs(step) / speed)))
