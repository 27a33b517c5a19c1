"""The closed loop in Python: any law on the simulated plant, the same limits, counting and verdicts."""

from typing import Protocol

import numpy as np

from projservo_cli.control import command
from projservo_cli.control.law import ERRORS, LOST, SINGULAR, Gains, new_state
from projservo_cli.loop.compiled import Log, new_log
from projservo_cli.loop.step import (
    JOINT_LIMIT,
    MAX_STEPS,
    PLATEAU,
    RUNNING,
    Instant,
    Limits,
    beyond_limits,
    finite,
    image_error,
    limit_speed,
    on_plateau,
    outside,
    verdict_at,
)
from projservo_cli.plants.analytic import AnalyticPlant
from projservo_cli.records import FloatArray, Model
from projservo_cli.task.face import Task

LEFT_TO_THE_LOOP = (-1.0,)
NOT_FITTED = (np.nan, np.nan, np.nan)


class LoopLaw(Protocol):
    """What the Python loop asks of a law.

    A law that keeps the joint-speed limit itself has an attribute ``share`` (1,), the share of the
    amplitude its limit left; the limit is else up to the loop. One that fits a body has an attribute
    ``fit`` (3,), which the log keeps.
    """

    errors: FloatArray

    def __call__(self, s: FloatArray, q: FloatArray) -> tuple[int, FloatArray]:
        """Status and joint velocity (n,), rad/s or m/s, for pixels (2, m, 2) and joints (n,).

        Pixels are NaN where a marker was not seen; the status is LOST where too little was.
        """


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
        self.code, self.model, self.task, self.gains = code, model, task, gains
        self.state = new_state(len(model.H_hat_0), len(task.A_star))
        self.errors = self.state.errors
        self.share = self.state.share
        self.fit = self.state.fit

    def __call__(self, s: FloatArray, q: FloatArray) -> tuple[int, FloatArray]:
        """Status and joint velocity of one instant."""
        status = command(self.code, self.model, self.task, self.gains, s, q, self.state)
        return status, self.state.q_dot.copy()


def run(
    law: LoopLaw, plant: AnalyticPlant, s_star: FloatArray, period: float, limits: Limits
) -> tuple[int, int, Log]:
    """Drive a law on a plant to its verdict.

    Parameters
    ----------
    law : any law.
    plant : the simulated robot.
    s_star : (2, m, 2) target pixels.
    period : control period, s.
    limits : when the run ends.

    Returns
    -------
    verdict, steps, log : as of the compiled loop, to the bit for the built-in laws.
    """
    log = new_log(len(plant.joints()), plant.markers, limits.max_steps, len(ERRORS))
    try:
        verdict, steps = _run(law, plant, s_star, period, limits, log)
    finally:
        plant.stop()
    return verdict, steps, log


def _run(
    law: LoopLaw, plant: AnalyticPlant, s_star: FloatArray, period: float, limits: Limits, log: Log
) -> tuple[int, int]:
    """Fill the log and return verdict and steps."""
    truth = plant.plant
    first_distance = 0.0
    for k in range(limits.max_steps + 1):
        log.q[k], log.H[k] = plant.joints(), plant.H
        log.s[k] = plant.observe()
        log.hidden[k] = plant.hidden
        distance = plant.distance()
        first_distance = distance if k == 0 else first_distance
        left = outside(log.s[k], s_star.shape[1], truth.image_size)
        if left and log.events[0] < 0.0:
            log.events[0] = k
        log.error[k] = image_error(log.s[k], s_star)
        seen, singular, sound, q_dot = True, False, True, np.zeros_like(log.q[k])
        if plant.in_front:
            status, q_dot = law(log.s[k], log.q[k])
            seen, singular, sound = status != LOST, status == SINGULAR, finite(q_dot)
            log.errors[k], log.fit[k] = law.errors, getattr(law, "fit", NOT_FITTED)
        error, first_error = log.error[k], log.error[0]
        now = Instant(
            plant.in_front, seen, left, error, first_error, distance, first_distance, sound, singular
        )
        verdict = verdict_at(now, limits)
        if verdict != RUNNING:
            return verdict, k
        if k == limits.max_steps:
            break
        share = float(getattr(law, "share", LEFT_TO_THE_LOOP)[0])
        log.factor[k] = share if share >= 0.0 else limit_speed(q_dot, limits.speed)
        joint = beyond_limits(log.q[k] + q_dot * period, truth.lower, truth.upper)
        if joint >= 0 and log.events[1] < 0.0:
            log.events[1], log.events[2] = k + 1, joint
        if joint >= 0 and limits.stop_at_joint_limit:
            return JOINT_LIMIT, k
        plant.command(q_dot * period, period)
        log.q_dot[k] = q_dot
    last = limits.max_steps
    return (PLATEAU if on_plateau(log.error, last, limits.plateau_steps) else MAX_STEPS), last
