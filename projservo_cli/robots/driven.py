"""A robot of the contract as the loop drives it: set-points integrated, pace kept, images tested."""

import numpy as np

from projservo_cli.calibration import WINDOW, Innovation
from projservo_cli.geometry.algebra import as_array
from projservo_cli.geometry.kinematics import forward
from projservo_cli.records import FloatArray, IntArray
from projservo_cli.robots.contract import ForeignRobot, Reading
from projservo_cli.robots.simulated import Plant, observe


class Steered:
    """A robot that is sent absolute set-points, the sum of the steps asked for, one a period.

    The set-point never leads the last reading by more than ``bounds.lead``, so that a robot that is held does
    not gather a way to make up for. The robot itself accumulates nothing.

    ``reading``: of the last look. ``target``: (n,) the set-point, at first where the robot is read to stand,
    rad or m. ``overruns``: periods that reading and thinking did not fit into.
    """

    reading: Reading

    def __init__(self, robot: ForeignRobot) -> None:
        self.robot = robot
        self.target: FloatArray | None = None
        self.overruns = 0
        self._due: float | None = None

    def look(self) -> Reading:
        """Read joints and images."""
        self.reading = self.robot.read()
        if self.target is None:
            self.target = self.reading.q.copy()
        return self.reading

    def command(self, step: FloatArray, period: float) -> None:
        """Move the set-point by a step (n,), rad or m, and wait until the period, s, is over."""
        assert self.target is not None
        q, bounds, now = self.reading.q, self.robot.bounds, self.robot.now()
        due = (now if self._due is None else self._due) + period
        if now > due:  # thinking took too long, and no set-point must be due in the past
            due = now + period
            self.overruns += 1
        target = np.clip(self.target + step, q - bounds.lead, q + bounds.lead)
        target = np.clip(target, np.minimum(bounds.lower, q), np.maximum(bounds.upper, q))
        speed = np.clip((target - self.target) / period, -bounds.speed, bounds.speed)
        self.robot.command(target, speed, due)
        self.target, self._due = target, due
        if self.robot.wait_until(due):
            self.overruns += 1


class DrivenRobot:
    """A robot with its cameras beside its truth, or the plant that the calibration takes it for.

    robot : what is driven.
    plant : model and face; image size and joint limits.
    shown : (k,) indices of the markers that the loop is shown among those that the robot observes, the face
        first.
    order : (m,) index there of each marker of the calibration, −1 where it is not observed.
    innovation : test of the images against the calibration; None tests nothing.
    ``q``: (n,) joints when last asked for, rad or m: true ones where the robot tells them, else as read.
    ``H, hidden``: displacement of the face and self-occlusion as the plant has them there. ``in_front``: a
    camera sees nothing behind it. ``disturbance``: why the images no longer agree with the calibration, or
    what failed; else empty.
    """

    in_front = True
    takes_parts = True

    def __init__(
        self,
        robot: ForeignRobot,
        plant: Plant,
        shown: IntArray,
        order: IntArray,
        innovation: Innovation | None,
    ) -> None:
        self.robot, self.steered = robot, Steered(robot)
        self.plant = plant
        self.shown, self.order = shown, order
        self.markers = len(shown)
        self.innovation = innovation
        self.q = np.zeros(len(plant.lower))
        self.H = np.eye(4)
        self.hidden = np.zeros(2)
        self.disturbance = ""

    def joints(self) -> FloatArray:
        """Joint readings (n,), rad or m, of a new look at robot and images."""
        read, truth = self.steered.look().q, self.robot.truth()
        self.q = truth if truth is not None and truth.ndim == 1 else read
        H = forward(self.plant.model, self.q)
        self.H = as_array(H)
        M = np.zeros_like(self.plant.M)
        observe(self.plant, H, M, np.zeros((2, self.markers, 2)), self.hidden)
        return read.copy()

    def observe(self) -> FloatArray:
        """Pixels (2, k, 2) of the markers shown at the last look, NaN where unseen; all are tested."""
        s = self.steered.reading.s
        if self.innovation is not None:
            known = np.where((self.order < 0)[:, None], np.nan, s[:, self.order])
            at_once, at_rest, certain = (
                np.stack([self.steered.reading.q] * 2),
                np.zeros_like(self.q),
                np.zeros(2),
            )
            self.disturbance = self.innovation.disturbed(
                at_once, at_rest, certain, known, np.ones(2, dtype=np.bool_)
            )
        return np.ascontiguousarray(s[:, self.shown])

    def fits(self) -> str:
        """What is wrong with the images where the robot stands; empty where nothing is."""
        looks = 0
        while not self.disturbance and (looks < WINDOW or (self.innovation and self.innovation.doubtful)):
            self.joints()
            self.observe()
            looks += 1
        return self.disturbance

    def distance(self) -> float:
        """No distance is known without a metric: nothing ever recedes."""
        return 0.0

    def command(self, step: FloatArray, period: float) -> None:
        """Move by the joint step (n,), rad or m, within one period, s."""
        self.steered.command(step, period)

    def stop(self) -> None:
        """Come to rest."""
        self.robot.stop()
