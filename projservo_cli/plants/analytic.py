"""The simulated robot as an object, for the Python loop."""

import numpy as np

from projservo_cli.geometry.displacement import as_array, as_mat
from projservo_cli.geometry.kinematics import start_pose
from projservo_cli.plants.plant import Plant, knock, observe, pose_after, read_joints, rig_distance
from projservo_cli.records import FloatArray


class AnalyticPlant:
    """Simulated robot and rig, with given pixel noise.

    Parameters
    ----------
    plant : the truth, and what befalls it.
    q_start : (n,) first joints, rad or m.
    noise : (k, 2, markers, 2) added to the pixels of each observation in turn, px.

    Attributes
    ----------
    q, H : (n,) true joints, rad or m, and (4, 4) displacement of the face.
    in_front : whether every marker was in front of both cameras when last observed.
    markers : how many are observed, those of the face first.
    hidden : (2,) 1 where the face was self-occluded when last observed.
    disturbance : nothing ever disturbs it; why the law that drove it failed.
    takes_parts : it goes straight to the end of each step; the samples are the same.
    """

    disturbance = ""
    takes_parts = False

    def __init__(self, plant: Plant, q_start: FloatArray, noise: FloatArray) -> None:
        self.plant = plant
        self.noise = noise
        self.q = np.array(q_start, dtype=np.float64)
        self.H = as_array(start_pose(plant.model, self.q))
        self.reading = self.q.copy()
        self.shown: list[FloatArray] = []
        self.observations = 0
        self.M = np.zeros_like(plant.M)
        self.hidden = np.zeros(2)
        self.in_front = True
        self.markers = len(plant.M) + len(plant.pins)

    def joints(self) -> FloatArray:
        """Joint readings (n,), rad or m."""
        return self.reading.copy()

    def observe(self) -> FloatArray:
        """Noisy pixels (2, markers, 2), NaN where unseen; of some periods ago where images are late."""
        s = np.zeros((2, self.markers, 2))
        self.in_front = observe(self.plant, as_mat(self.H), self.M, s, self.hidden)
        self.shown.append(self.H)
        if self.plant.disturbance.delay > 0:
            late = as_mat(self.shown[max(0, self.observations - self.plant.disturbance.delay)])
            observe(self.plant, late, np.zeros_like(self.M), s, np.zeros(2))
        s += self.noise[self.observations]
        self.observations += 1
        return s

    def distance(self) -> float:
        """Distance of the face from the middle of the optical centres when last observed, m."""
        return rig_distance(self.plant, self.M)

    def command(self, step: FloatArray, period: float) -> None:
        """Move by the joint step (n,), rad or m; the simulated robot always arrives."""
        step, q_next, before = step.copy(), np.zeros_like(self.q), self.reading.copy()
        knock(self.plant.disturbance, self.observations, step)
        self.H = as_array(pose_after(self.plant, as_mat(self.H), self.q, step, q_next))
        self.q = q_next
        read_joints(self.plant.disturbance, self.observations, self.q, before, self.reading)

    def stop(self) -> None:
        """Nothing moves between commands."""
