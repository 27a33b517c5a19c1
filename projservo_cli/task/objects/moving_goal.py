"""A goal on an object that moves: where the object has it, by its tracker."""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from projservo_cli.geometry.kinematics import forward_kinematics, image_jacobian, joint_operators, project
from projservo_cli.geometry.least_squares import Equations, levenberg_marquardt
from projservo_cli.records import FloatArray, Model, WorkFailed
from projservo_cli.task.objects.displaced_object import CarriedGoal
from projservo_cli.task.objects.object_bundle_adjustment import ObjectView
from projservo_cli.task.objects.object_tracker import ObjectMotion, ObjectTracker
from projservo_cli.task.target import Place, TaskImages

_STEP = 1e-5  # of a difference, in a coordinate of a motion
_STEPS = 20  # of Newton's method towards joints at a goal, at most
_ENOUGH = 0.01  # fall of the squares, px², that is not worth another step


class Followed(NamedTuple):
    """The goal in a period of a run."""

    t: float  # by the clock of the robot, s
    D: FloatArray  # (4, 4) displacement of the goal since the motion was planned
    s_star: FloatArray  # (V, m, 2) px of the face there
    error: tuple[float, float, float]  # px, mm and deg of the tool from the goal
    sigma_px: float  # stated deviation of the error
    speed: float  # of the object, mm/s or px/s
    unseen_s: float  # since its object was seen
    H: FloatArray = np.full((4, 4), np.nan)  # of the tool as measured


@dataclass(frozen=True, eq=False)
class MovingGoal:
    """A goal of the tool that one object carries."""

    images: TaskImages  # start and goal as a law measures them, with a body, the goal where the plan has it
    model: Model  # calibrated
    tracker: ObjectTracker
    whole: bool  # whether it is the whole pose, instead of incidences
    D_planned: FloatArray  # (4, 4) of the object when the motion was planned
    # Images of the markers of the calibration when it was taught; None of a retreat.
    taught: ObjectView | None = None

    def moved(self, motion: ObjectMotion) -> FloatArray:
        """Displacement (4, 4) of the goal since the motion was planned."""
        return np.asarray(motion.D @ np.linalg.inv(self.D_planned))

    def carried(self, t: float) -> CarriedGoal | None:
        """Return the goal at a time, s, with its errors; None of a retreat, or out of sight."""
        if self.taught is None:
            return None
        try:
            return self.tracker.carry(self.taught, t)
        except WorkFailed:
            return None

    @cached_property
    def H(self) -> FloatArray:
        """Displacement (4, 4) of the body at the goal when the motion was planned."""
        return self.images.displacement_at_goal(self.model)

    def at(self, D: FloatArray) -> TaskImages:
        """Start and goal, with the goal displaced by D (4, 4) since the motion was planned."""
        goal = self.images.goal
        moved = tuple(place._replace(s=self._images(D, place)) for place in goal.locations)
        return self.images._replace(goal=goal._replace(s=self._images(D, Place(goal.s)), locations=moved))

    def _images(self, D: FloatArray, place: Place) -> FloatArray:
        """Images (V, b, 2) of the body at a place, displaced by D (4, 4); what a fit leaves goes along."""
        H, left = self._fits[place.s.tobytes()]
        return self._projected(D @ H) + left

    @cached_property
    def _fits(self) -> dict[bytes, tuple[FloatArray, FloatArray]]:
        """Displacement (4, 4) of the body at each place, and what its fit leaves of the images (V, b, 2)."""
        found, goal = {}, self.images.goal
        for s in (goal.s, *(place.s for place in goal.locations)):
            H = self.images.to(s).displacement_at_goal(self.model)
            found[s.tobytes()] = H, s - self._projected(H)
        return found

    def _projected(self, H: FloatArray) -> FloatArray:
        """Pixels (V, b, 2) of the body displaced by H (4, 4)."""
        return np.asarray(project(self.model.P, self.images.body.M @ H.T, self.model.lens))

    def joints(self, q: FloatArray, D: FloatArray) -> tuple[FloatArray, float]:
        """Joints (n,) near q at the goal displaced by D (4, 4), and the error left there, px rms a marker.

        For a goal that is a whole pose, without lenses.
        """
        M, model = self.images.body.M, self.model
        s = project(model.P, M @ (D @ self.H).T)

        def equations(q: FloatArray) -> Equations:
            A = M @ forward_kinematics(model, q[0]).T
            J = image_jacobian(model.P, A, joint_operators(model, q[0]))
            return Equations.of((project(model.P, A) - s).reshape(1, -1), J.reshape(1, -1, q.shape[1]))

        (found,), there = levenberg_marquardt(
            (q[None],), equations, lambda step, q: (q + step,), _STEPS, _ENOUGH
        )
        return found[0], float(np.sqrt(2.0 * there.cost[0] / s.size))

    def sigma_px(self, motion: ObjectMotion, H: FloatArray) -> float:
        """Deviation of the images of the goal at H (4, 4) by the motion, px rms per marker and view."""
        E = _STEP * (motion.D @ motion.E @ np.linalg.inv(motion.D))
        s = np.stack([self._projected(H), *map(self._projected, H + E @ H)])
        by = (s[1:] - s[0]) / _STEP
        return float(np.sqrt(np.einsum("ivkd,ij,jvkd->", by, motion.covariance, by) / s[0, ..., 0].size))

    def off(self, H: FloatArray, H_star: FloatArray) -> tuple[float, float]:
        """Distance of the body at H (4, 4) from the goal at H_star (4, 4), rms mm, and angle, deg.

        NaN without a known length, or if the joints leave angles open.
        """
        planned, M = self.tracker.planned, self.images.body.M
        rig = planned.rig
        apart = (M @ (rig.G @ (H - H_star)).T)[:, :3]
        turn = (rig.G @ H @ np.linalg.inv(rig.G @ H_star))[:3, :3]
        angle = Rotation.from_matrix(turn).magnitude() if rig.rigid else np.nan
        return float(planned.unit_mm * np.sqrt((apart**2).sum(axis=1).mean())), float(np.degrees(angle))
