"""A robot of somebody else as the loop sees it, beside what the calibration takes it for."""

import numpy as np

from projservo_cli.calibration.innovation import WINDOW, Innovation
from projservo_cli.geometry.displacement import as_array
from projservo_cli.geometry.kinematics import start_pose
from projservo_cli.plants.foreign import ForeignRobot
from projservo_cli.plants.plant import Plant, observe
from projservo_cli.records import FloatArray, IntArray


class DrivenRobot:
    """A robot with its cameras beside the plant that the calibration takes it for.

    Parameters
    ----------
    robot : what is driven.
    plant : calibrated model and face; image size and joint limits.
    shown : (k,) indices of the markers that the loop is shown among those that the robot observes, the
        face first.
    order : (m,) index there of each marker of the calibration, −1 where it is not observed.
    innovation : test of the images against the calibration; None tests nothing.

    Attributes
    ----------
    q : (n,) joint readings when last asked for, rad or m.
    H, hidden : displacement of the face and self-occlusion as the calibration has them there.
    in_front : a camera sees nothing behind it.
    disturbance : why the images no longer agree with the calibration, or what failed; else empty.
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
        self.robot, self.plant = robot, plant
        self.shown, self.order = shown, order
        self.markers = len(shown)
        self.innovation = innovation
        self.q = np.zeros(len(plant.lower))
        self.H = np.eye(4)
        self.hidden = np.zeros(2)
        self.disturbance = ""

    def joints(self) -> FloatArray:
        """Joint readings (n,), rad or m."""
        self.q = self.robot.joints()
        H = start_pose(self.plant.model, self.q)
        self.H = as_array(H)
        M = np.zeros_like(self.plant.M)
        observe(self.plant, H, M, np.zeros((2, len(M), 2)), self.hidden)
        return self.q.copy()

    def observe(self) -> FloatArray:
        """Pixels (2, k, 2) of the markers shown, NaN where unseen; all markers are tested."""
        s = self.robot.observe()
        if self.innovation is not None:
            known = np.where((self.order < 0)[:, None], np.nan, s[:, self.order])
            self.disturbance = self.innovation.disturbed(self.q, known)
        return np.ascontiguousarray(s[:, self.shown])

    def fits(self) -> str:
        """What is wrong with the images where the robot stands; empty where nothing is."""
        for _ in range(WINDOW):
            self.joints()
            self.observe()
        return self.disturbance

    def distance(self) -> float:
        """No distance is known without a metric: nothing ever recedes."""
        return 0.0

    def command(self, step: FloatArray, period: float) -> None:
        """Move by the joint step (n,), rad or m, within one period, s."""
        self.robot.command(step, period)

    def stop(self) -> None:
        """Come to rest."""
        self.robot.stop()
