"""The closed loop in Python: any law on any plant, the same limits, counting and verdicts."""

import math
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np
from numba import types
from numba.experimental import structref

from projservo_cli.control import command
from projservo_cli.control.law import ERRORS, LOST, SINGULAR, Gains, Law, State, new_state
from projservo_cli.geometry.jit import COMPILED, allocating
from projservo_cli.geometry.kinematics import beyond_limits
from projservo_cli.geometry.mechanisms import span_of
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
    Log,
    finite,
    image_error,
    limit_speed,
    new_log,
    on_plateau,
    outside,
    shorten,
    stands_still,
    tolerance,
    verdict_at,
)
from projservo_cli.records import FloatArray, Model, WorkFailed
from projservo_cli.robots.plugins import require_spelt
from projservo_cli.robots.simulated import Plant
from projservo_cli.task.face import Task

# Handing some forty arrays over to compiled code takes longer than a control step. They are handed over
# once and kept in a structure of the compiler; a call then passes the pixels and the joints alone.
_FIELDS = ("code", "model", "task", "gains", "state")

if TYPE_CHECKING or not COMPILED:

    class Bound(NamedTuple):
        """What a law works on."""

        code: int
        model: Model
        task: Task
        gains: Gains
        state: State

else:

    @structref.register
    class BoundType(types.StructRef):
        """The compiler's type of what a law works on."""

    class Bound(structref.StructRefProxy):
        """What a law works on, held by compiled code."""

    structref.define_proxy(Bound, BoundType, _FIELDS)


@allocating
def bind(code: int, model: Model, task: Task, gains: Gains, state: State) -> Any:
    """What the law of a code works on; changes of its arrays are seen, here and there."""
    return Bound(code, model, task, gains, state)


@allocating
def bound_command(bound: Any, s: FloatArray, q: FloatArray) -> int:
    """One command of the bound law, as of ``command``: the status, the rest is written to the state."""
    return command(Law(bound.code, bound.model, bound.task, bound.gains), s, q, bound.state)


# What a law may have beside, and what holds where it has not: the share of the amplitude that its own
# joint-speed limit left, negative where the limit is up to the loop; what fitting a body left, and the image
# error (px) of the face by which the run is judged; the joint at whose limit it ended a step, or −1; joints
# (parts + 1, n) between the parts in which it wants a step sent.
OPTIONAL: dict[str, tuple[float, ...]] = {
    "share": (-1.0,),
    "fit": (math.nan, math.nan, math.nan),
    "face_px": (math.nan,),
    "blocked": (-1,),
    "path": (),
}


class LoopLaw(Protocol):
    """What the Python loop asks of a law; it may also have those of ``OPTIONAL``."""

    errors: FloatArray

    def __call__(self, s: FloatArray, q: FloatArray) -> tuple[int, FloatArray]:
        """Status and joint velocity (n,), rad/s or m/s, for pixels (2, m, 2) and joints (n,).

        Pixels are NaN where a marker was not seen; the status is LOST where too little was.
        """


class _LoopPlant(Protocol):
    """What the Python loop asks of a plant."""

    plant: Plant  # the truth, or what the calibration takes for it: image size, joint limits
    q: FloatArray  # (n,) joints as they are, or as they were read
    H: FloatArray  # (4, 4) displacement of the face from the reference
    hidden: FloatArray
    in_front: bool  # hidden, in_front: as of ``plants.plant.observe``, when last observed
    markers: int  # how many are observed, those of the face first
    # why the run cannot go on, the images no longer agree with the calibration or something failed; empty
    # where it can
    disturbance: str
    takes_parts: bool  # whether a long step is sent in the parts that the law split it into

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

    code : of the law; model : what the law believes; task : in the frame of the model; gains : of the law.
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
    law: LoopLaw, plant: _LoopPlant, s_star: FloatArray, period: float, limits: Limits, scale: float = 1.0
) -> tuple[int, int, Log]:
    """Drive a law on a plant to its verdict.

    law : any law.
    plant : any plant; it is stopped however the run ends.
    s_star : (2, m, 2) target pixels.
    period : control period, s.
    limits : when the run ends.
    scale : factor of every command.
    Returns verdict, steps, log: as of the compiled loop, to the bit for the built-in laws. Raises InputError
    if the law has an attribute that is a misspelt one of ``OPTIONAL``; WorkFailed if the plant or the law
    fails before the first instant is complete.
    """
    try:
        require_spelt(f"law {type(law).__name__}", law, ("errors", *OPTIONAL))
        log = new_log(len(plant.joints()), plant.markers, limits.max_steps, len(ERRORS))
        made = _Run(law, plant, s_star, limits, log)
        for column in (log.read, log.q, log.s, log.error, log.judged):
            column[:] = math.nan
        k, verdict = 0, RUNNING
        while verdict == RUNNING:
            try:
                verdict, q_dot = made.instant(k)
                if verdict == RUNNING:
                    verdict = made.command(k, q_dot, period, scale)
            except WorkFailed as error:
                if k == 0:
                    raise
                verdict, plant.disturbance = FAILED, str(error)
            k += verdict == RUNNING
    finally:
        plant.stop()
    return verdict, k, log


class _Run:
    """A run as far as it has come: the law on the plant, and what is logged of them."""

    def __init__(self, law: LoopLaw, plant: _LoopPlant, s_star: FloatArray, limits: Limits, log: Log) -> None:
        self.law, self.plant, self.s_star, self.limits, self.log = law, plant, s_star, limits, log
        self.first_distance, self.first_error, self.waited = math.nan, math.nan, 0

    def instant(self, k: int) -> tuple[int, FloatArray]:
        """Look and ask the law: the verdict of the instant, and joint velocity (n,), zero while waiting."""
        plant, log, limits, truth = self.plant, self.log, self.limits, self.plant.plant
        log.read[k] = plant.joints()
        log.q[k], log.H[k] = plant.q, plant.H
        log.s[k] = plant.observe()
        log.hidden[k] = plant.hidden
        distance = plant.distance()
        self.first_distance = distance if k == 0 else self.first_distance
        left = outside(log.s[k], self.s_star.shape[1], truth.image_size)
        if left and log.events[0] < 0.0:
            log.events[0] = k
        joint = beyond_limits(log.read[k], truth.lower, truth.upper)
        if joint >= 0 and log.events[1] < 0.0 and not limits.stop_at_joint_limit:
            log.events[1], log.events[2] = k, joint
        log.error[k] = log.judged[k] = image_error(log.s[k], self.s_star)
        seen, singular, sound, q_dot = True, False, True, np.zeros_like(log.read[k])
        if plant.disturbance:
            return DISTURBED, q_dot
        if plant.in_front:
            status, q_dot = self.law(log.s[k], log.read[k])
            seen, singular, sound = status != LOST, status == SINGULAR, finite(q_dot)
            log.errors[k], log.fit[k] = self.law.errors, self.told("fit")
            face_px = float(self.told("face_px")[0])
            log.judged[k] = face_px if math.isfinite(face_px) else log.judged[k]
        error = float(log.judged[k])
        self.first_error = error if math.isnan(self.first_error) else self.first_error
        within = tolerance(limits, float(log.fit[k, 2]))
        now = Instant(
            plant.in_front,
            seen,
            left,
            error,
            self.first_error,
            within,
            distance,
            self.first_distance,
            sound,
            singular,
        )
        verdict = verdict_at(now, limits)
        if verdict == MARKERS_LOST and self.waited < limits.lost_steps and k < limits.max_steps:
            self.waited += 1
            return RUNNING, np.zeros_like(q_dot)
        if verdict == RUNNING and k == limits.max_steps:
            verdict = PLATEAU if on_plateau(log.judged, k, limits.plateau_steps) else MAX_STEPS
        self.waited = 0
        return verdict, q_dot

    def command(self, k: int, q_dot: FloatArray, period: float, scale: float) -> int:
        """Send what the law asks for within the limits; the verdict where a limit leaves no motion."""
        log, limits, plant = self.log, self.limits, self.plant
        if self.waited > 0:
            plant.command(q_dot, period)
            return RUNNING
        share = float(self.told("share")[0])
        log.factor[k] = share if share >= 0.0 else limit_speed(q_dot, limits.speed)
        q_dot = q_dot * scale
        dq = q_dot * period
        if limits.stop_at_joint_limit:
            joint = shorten(log.read[k], dq, plant.plant.lower, plant.plant.upper)
            if joint >= 0:
                q_dot = dq / period
            joint = max(joint, int(self.told("blocked")[0]))
            if joint >= 0 and stands_still(dq):
                log.events[2] = joint
                return JOINT_LIMIT
        path = self.told("path")
        # A long step goes in the parts that the law split it into, where it is not scaled down.
        in_parts = len(path) > 2 and scale >= 1.0 and plant.takes_parts
        steps = np.diff(path, axis=0) if in_parts else dq[None]
        for step in steps:
            plant.command(step, time_for(step, period / len(steps), limits.speed * scale))
        log.q_dot[k] = q_dot
        return RUNNING

    def told(self, name: str) -> Any:
        """What the law says of its last step beside the command."""
        return getattr(self.law, name, OPTIONAL[name])


def time_for(step: FloatArray, period: float, speed: FloatArray) -> float:
    """Time, s, for a joint step (n,): the period, or longer where a joint would be too fast.

    A law that keeps to its path bounds its joint steps to first order only; what it exceeds the limit
    by costs time instead of leaving the path.
    """
    return max(period, float(np.max(np.abs(step) / speed)))
