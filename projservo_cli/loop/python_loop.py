"""The closed loop in Python: any law on any plant, the same limits, counting and verdicts.

Monitors end a run in this order. Each is given the verdict of those before it and returns its own:

1. the fault monitor holds the robot where images contradict the calibration, and ends the run once it is
   known why, before the law is asked;
2. ``verdict_at``, which alone rules over the compiled loop too;
3. the stall monitor, of a robot that may lag behind its set-points: it has ``converged`` once it is at rest,
   and makes no progress if it rests away from the goal;
4. the execution monitor, of a plan that gives way to another one: it replans instead of ending the run;
5. the fault monitor again: no run ends while images are ambiguous;
6. ``bounded``, over the command of a run that goes on, and the execution monitor over its joint limit.

``failed`` ends a run if a robot or a law of the user raises after its start.
"""

import math
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np
from numba import types
from numba.experimental import structref

from projservo_cli.control import command, make_law
from projservo_cli.control.law import ERRORS, OK, Gains, Law, State, new_state
from projservo_cli.findings import REFUSES, Finding, from_text
from projservo_cli.geometry.jit import COMPILED, njit
from projservo_cli.geometry.mechanisms import make_span
from projservo_cli.loop.verdicts import (
    FAILED,
    FAULT_DETECTED,
    INTERRUPTED,
    RUNNING,
    WAITING,
    Command,
    Instant,
    Limits,
    Log,
    bounded,
    new_log,
    note,
    verdict_at,
)
from projservo_cli.plugins import require_spelt
from projservo_cli.records import FloatArray, Model, WorkFailed
from projservo_cli.simulation.analytic_plant import Plant
from projservo_cli.task.face import Task
from projservo_cli.task.trajectory import NO_REFERENCE

# Handing some forty arrays over to compiled code takes longer than a control step. They are handed over
# once and kept in a structure of the compiler; a call then passes the pixels and the joints alone.
if TYPE_CHECKING or not COMPILED:

    class _Bound(NamedTuple):
        """Scratch memory of a law."""

        law: Law
        state: State

else:

    @structref.register
    class _BoundType(types.StructRef):
        """Compiler type of the scratch memory of a law."""

    class _Bound(structref.StructRefProxy):
        """Scratch memory of a law, held by compiled code."""

    structref.define_proxy(_Bound, _BoundType, ("law", "state"))


def _bind(law: Law, state: State) -> Any:
    """Scratch memory of a law, whose arrays are shared."""
    return _Bound(law, state)


def _bound_command(bound: Any, s: FloatArray, q: FloatArray) -> int:
    """One command of the bound law, as of ``command``: the status, the rest is written to the state."""
    return command(bound.law, s, q, bound.state)


_compiled_bind, _compiled_command = njit(_bind, allocates=True), njit(_bound_command, allocates=True)


# Optional attributes of a law and their defaults: the fraction of the amplitude that its own
# joint-speed limit left, negative if the limit is up to the loop; residual of the fit of a body, and the
# image error (px) of the face by which the run is judged; the joint at whose limit it ended a step, or −1;
# joints (parts + 1, n) between the parts in which it wants a step sent.
_OPTIONAL: dict[str, tuple[float, ...]] = {
    "share": (-1.0,),
    "fit": (math.nan, math.nan, math.nan),
    "face_px": (math.nan,),
    "blocked": (-1,),
    "path": (),
}


class Monitored(Protocol):
    """Interface of a plant for the fault monitor."""

    plant: Plant  # the truth, or its calibrated model: image size, joint limits
    # why the run cannot go on, the images no longer agree with the calibration or something failed; None
    # if it can
    disturbance: Finding | None

    @property
    def holds(self) -> bool:
        """Whether images disagree with the calibration so that nothing should move."""

    @property
    def pending(self) -> bool:
        """Tell whether images disagreed and have not agreed since."""

    def give_up(self) -> None:
        """Return the maximum-likelihood fault without further frames."""


class Monitor(Protocol):
    """Interface of a monitor, which may change the verdict and the joint velocity (n,)."""

    def ruled(self, log: Log, k: int, verdict: int, q_dot: FloatArray) -> int:
        """Return the new verdict."""


class MovingTarget(Monitor, Protocol):
    """Interface of a goal that moves, and of the monitor that rules over its run."""

    def lead(self) -> FloatArray:
        """Give the law the goal where it will be, and return the images (V, m, 2) of the face where it is."""

    def judge(self) -> float:
        """Return the image error by which the run is judged, px, once the law measured."""


class Monitors(NamedTuple):
    """Monitors of a run, asked in the order that the module states."""

    plant: Monitored
    limits: Limits
    goal: MovingTarget | None = None
    stall: Monitor | None = None
    execution: Monitor | None = None

    def of_faults(self, k: int) -> int:
        """Verdict before the law is asked: ``RUNNING`` if it may be."""
        if self.plant.disturbance:
            return FAULT_DETECTED
        if not self.plant.holds:
            return RUNNING
        if k < self.limits.max_steps:
            return WAITING
        self.plant.give_up()
        return FAULT_DETECTED

    def of_instant(self, log: Log, k: int, now: Instant) -> int:
        """Verdict of an instant at which the law was asked."""
        verdict = verdict_at(log, k, now, self.limits)
        for monitor in (self.goal, self.stall, self.execution):
            if monitor is not None:
                verdict = monitor.ruled(log, k, verdict, now.q_dot)
        waits = self.plant.pending and k < self.limits.max_steps
        return WAITING if waits and verdict != RUNNING else verdict

    def of_command(self, log: Log, k: int, asked: Command) -> int:
        """Verdict of a command, which is bounded."""
        verdict = bounded(log, k, asked, self.plant.plant, self.limits)
        for monitor in (self.goal, self.execution):
            if verdict != RUNNING and monitor is not None:
                verdict = monitor.ruled(log, k, verdict, asked.q_dot)
        return verdict


class LoopLaw(Protocol):
    """Interface of a law for the Python loop; it may also have the attributes of ``_OPTIONAL``."""

    errors: FloatArray

    def __call__(self, s: FloatArray, q: FloatArray) -> tuple[int, FloatArray]:
        """Status and joint velocity (n,), rad/s or m/s, for pixels (V, m, 2) and joints (n,).

        Pixels are NaN if a marker was not seen; the status is LOST where too little was.
        """


class _LoopPlant(Monitored, Protocol):
    """Interface of a plant for the Python loop."""

    q: FloatArray  # (n,) joints as they are, or as they were read
    H: FloatArray  # (4, 4) displacement of the face from the reference
    hidden: FloatArray
    in_front: bool  # hidden, in_front: as of ``simulation.analytic_plant.observe``, when last observed
    markers: int  # number that is observed, the face first
    takes_parts: bool  # whether a long step is sent in the parts that the law split it into
    weight: FloatArray | None  # (V, markers) of the pixels last observed in a fit; None for one
    noise_ratio: float  # stated noise of the last pixels over the noise of the run; at least 1

    def joints(self) -> FloatArray:
        """Joint readings (n,), rad or m."""

    def observe(self) -> FloatArray:
        """Pixels (V, markers, 2), NaN where unseen."""

    def distance(self) -> float:
        """Distance of the face from the rig when last observed, m; constant if it is unknown."""

    def command(self, step: FloatArray, period: float) -> None:
        """Move by the joint step (n,), rad or m, within one period, s."""

    def stop(self) -> None:
        """Come to rest."""


class BuiltInLaw:
    """A compiled law as an object of the Python loop, of the parts of ``Law``."""

    def __init__(self, code: int, model: Model, task: Task, gains: Gains) -> None:
        self.gains = gains
        span = make_span(model, task.A_star)
        n, m, V = len(model.H_hat_0), len(task.A_star), len(model.P)
        self.state = new_state(n, m, len(task.body.M), span, V)
        self._weight = np.ones((V, len(task.body.M)))
        self.law = make_law(code, model, self._weighed(task), gains)
        self._bound: Any = None  # until it is called from Python
        self.errors, self.share, self.fit = self.state.errors, self.state.step.share, self.state.fit
        self.face_px, self.blocked = self.state.face_px, self.state.step.blocked

    def follow(self, task: Task) -> None:
        """Follow another plan to the goal from its beginning."""
        self.law = self.law._replace(task=self._weighed(task))
        self.state.plan.clock[0] = 0.0
        self._bound = None

    def lead_to(self, task: Task) -> None:
        """Take another goal, without a plan."""
        self.law = self.law._replace(task=self._weighed(task)._replace(reference=NO_REFERENCE))
        self.state.plan.q_ahead[:] = 0.0  # as the plan that ended left it
        self._bound = None

    @property
    def arrives_in(self) -> float:
        """Periods until the plan that is followed arrives; none, or less, without one."""
        return len(self.law.task.reference.q) - 1 - float(self.state.plan.clock[0])

    def _weighed(self, task: Task) -> Task:
        """The task with the weights of this law, which ``weigh`` changes."""
        return task._replace(body=task.body._replace(weight=self._weight))

    def weigh(self, weight: FloatArray) -> None:
        """Weigh the pixels (V, k) of the next instant in the fit of the body."""
        k = min(weight.shape[1], self._weight.shape[1])
        self._weight[:, :k] = weight[:, :k]

    @property
    def path(self) -> FloatArray:
        """Joints (parts + 1, n) between the parts of the last step; one row if it has none."""
        step = self.state.step
        return step.path[: step.parts[0] + 1] if self.gains.substeps else step.path[:1]

    def __call__(self, s: FloatArray, q: FloatArray) -> tuple[int, FloatArray]:
        """Status and joint velocity of one instant."""
        if self._bound is None:
            self._bound = _compiled_bind(self.law, self.state)
        # Contiguous, as machine code is made for one layout of arrays alone.
        status = _compiled_command(self._bound, np.ascontiguousarray(s), np.ascontiguousarray(q))
        return status, self.state.q_dot.copy()


def run_in_python(
    law: LoopLaw,
    plant: _LoopPlant,
    s_star: FloatArray,
    period: float,
    limits: Limits,
    scale: float = 1.0,
    *,
    goal: MovingTarget | None = None,
    stall: Monitor | None = None,
    execution: Monitor | None = None,
) -> tuple[int, int, Log]:
    """Drive a law on a plant to its verdict.

    plant : any; it is stopped however the run ends.
    s_star : (V, m, 2) target pixels; period : control period, s; scale : factor of every command.
    goal : that moves, in place of the target pixels.
    stall : of a robot that may lag behind its set-points; execution : of a plan that another may replace.
    Returns verdict, steps, log: as of the compiled loop, to the bit for the built-in laws. Raises InputError
    if the law has an attribute that is a misspelt one of ``_OPTIONAL``; WorkFailed if the plant or the law
    fails before the first instant is complete.
    """
    try:
        require_spelt(f"law {type(law).__name__}", law, ("errors", *_OPTIONAL))
        n, V = len(plant.plant.limits.lower), len(s_star)
        log = new_log(n, plant.markers, limits.max_steps, len(ERRORS), views=V)
        for column in (log.read, log.q, log.s, log.error, log.judged):
            column[:] = math.nan
        monitors = Monitors(plant, limits, goal, stall, execution)
        k, verdict = 0, RUNNING
        while verdict < 0:
            try:
                verdict, q_dot = _instant(law, plant, s_star, monitors, log, k)
                if verdict == RUNNING:
                    share, blocked = float(_optional(law, "share")[0]), int(_optional(law, "blocked")[0])
                    asked = Command(q_dot, share, blocked, period, scale)
                    verdict = monitors.of_command(log, k, asked)
                    if verdict == RUNNING:
                        _send(law, plant, log.scratch[0, : len(q_dot)], limits, period, scale)
                if verdict == WAITING:
                    plant.command(np.zeros_like(q_dot), period)
            except WorkFailed as error:
                if k == 0:
                    raise
                verdict, plant.disturbance = FAILED, from_text(str(error), REFUSES)
            except KeyboardInterrupt:
                if k == 0:
                    raise
                verdict = INTERRUPTED
            k += verdict < 0
    finally:
        plant.stop()
    return verdict, k, log


def _instant(
    law: LoopLaw, plant: _LoopPlant, s_star: FloatArray, monitors: Monitors, log: Log, k: int
) -> tuple[int, FloatArray]:
    """Look and ask the law: the verdict of the instant, and the joint velocity (n,) that it asks for."""
    log.read[k] = plant.joints()
    log.q[k], log.H[k] = plant.q, plant.H
    log.s[k] = plant.observe()
    log.hidden[k] = plant.hidden
    distance = plant.distance()
    if monitors.goal is not None:
        s_star = monitors.goal.lead()
    left = note(log, k, s_star, plant.plant, monitors.limits)
    status, q_dot = OK, np.zeros_like(log.read[k])
    verdict = monitors.of_faults(k)
    if verdict != RUNNING:
        return verdict, q_dot
    if plant.in_front:
        if plant.weight is not None and isinstance(law, BuiltInLaw):
            law.weigh(plant.weight)
        status, q_dot = law(log.s[k], log.read[k])
        log.errors[k], log.fit[k] = law.errors, _optional(law, "fit")
        face_px = float(_optional(law, "face_px")[0])
        log.judged[k] = face_px if math.isfinite(face_px) else log.judged[k]
        if monitors.goal is not None:
            log.judged[k] = monitors.goal.judge()
    now = Instant(plant.in_front, left, distance, status, q_dot, plant.noise_ratio)
    return monitors.of_instant(log, k, now), q_dot


def _send(
    law: LoopLaw, plant: _LoopPlant, dq: FloatArray, limits: Limits, period: float, scale: float
) -> None:
    """Send a joint step (n,), or the parts that the law split it into if they lead as far.

    Each part takes as long as the joint-speed limit asks of it, and its share of the time that is left. Parts
    in which joints take turns may ask for more than the period.
    """
    path = _optional(law, "path")
    in_parts = (
        len(path) > 2 and plant.takes_parts and np.allclose(path[-1] - path[0], dq, rtol=0.0, atol=1e-9)
    )
    steps = np.diff(path, axis=0) if in_parts else dq[None].copy()
    shortest = np.max(np.abs(steps) / (limits.speed * scale), axis=1)
    left = max(0.0, period - float(shortest.sum())) / len(steps)
    for step, seconds in zip(steps, shortest.tolist(), strict=True):
        plant.command(step, seconds + left)


def _optional(law: LoopLaw, name: str) -> Any:
    """Report of a law on its last step, in addition to the command."""
    return getattr(law, name, _OPTIONAL[name])
