"""Who ends a run: the monitors of the Python loop, in the order in which they rule.

Each is given the verdict of those before it and returns its own:

1. the fault monitor holds the robot where images contradict the calibration, and ends the run once it is
   known why, before the law is asked;
2. ``verdict_at``, which alone rules over the compiled loop too;
3. the stall monitor, of a robot that may lag behind its set-points: it has ``converged`` once it stands,
   and makes no progress where it stands still away from the goal;
4. the execution monitor, of a plan that gives way to another one: it replans instead of ending the run;
5. the fault monitor again: nothing ends while it is not known what images mean;
6. ``bounded``, over the command of a run that goes on, and the execution monitor over its joint limit.

``failed`` ends a run wherever a robot or a law of somebody else raises once it has begun.
"""

from typing import NamedTuple, Protocol

from projservo_cli.loop.step import (
    FAULT_DETECTED,
    RUNNING,
    WAITING,
    Command,
    Instant,
    Limits,
    Log,
    bounded,
    verdict_at,
)
from projservo_cli.records import FloatArray
from projservo_cli.simulation.ideal import Plant


class Monitored(Protocol):
    """Interface of a plant for the fault monitor."""

    plant: Plant  # the truth, or its calibrated model: image size, joint limits
    # why the run cannot go on, the images no longer agree with the calibration or something failed; empty
    # where it can
    disturbance: str

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


class Monitors(NamedTuple):
    """Monitors of a run, asked in the order that the module states."""

    plant: Monitored
    limits: Limits
    stall: Monitor | None = None
    execution: Monitor | None = None

    def of_faults(self, k: int) -> int:
        """Verdict before the law is asked: ``RUNNING`` where it may be."""
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
        for monitor in (self.stall, self.execution):
            if monitor is not None:
                verdict = monitor.ruled(log, k, verdict, now.q_dot)
        waits = self.plant.pending and k < self.limits.max_steps
        return WAITING if waits and verdict != RUNNING else verdict

    def of_command(self, log: Log, k: int, asked: Command) -> int:
        """Verdict of a command, which is bounded."""
        verdict = bounded(log, k, asked, self.plant.plant, self.limits)
        if verdict != RUNNING and self.execution is not None:
            verdict = self.execution.ruled(log, k, verdict, asked.q_dot)
        return verdict
