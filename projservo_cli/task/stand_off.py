"""Displacements of a goal along a line, or along the normal of a plane: stand-off, approach and retreat.

A translation along a line through points A and B, a_inf·A = a_inf·B = 1, goes towards its point at infinity
D = B − A: exp(s D a_infᵀ) = I + s D a_infᵀ. Its image motion hangs on no metric; its length does.
"""

from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from projservo_cli.geometry.kinematics import project
from projservo_cli.geometry.stereo import optical_centers
from projservo_cli.monitoring.arrival_accuracy import metric_points
from projservo_cli.records import BoolArray, FloatArray, InputError, Model, WorkFailed
from projservo_cli.task.body_pose import Body
from projservo_cli.task.incidences import Flat, JointMetric, plane_through, points_of

# Doublings of the distance in search of one that moves images far enough, from this share of the first.
_DOUBLINGS, _FIRST = 30, 1e-3


class StandOff(NamedTuple):
    """A displacement back along a line, or from a plane to the side that the first camera sees."""

    name: str  # name of the feature, as in messages
    along: Flat  # points that span it, by numbers of markers or by their positions in the body
    by_m: float | None  # length; below 0 the other way
    by_px: float | None  # mean motion of the images in the view in which they move most
    of_start: bool = False  # whether it displaces the start instead of the goal

    @property
    def words(self) -> str:
        """Displacement of the goal, as in names of its incidences."""
        by = f"{1e3 * self.by_m:g} mm" if self.by_m is not None else f"{self.by_px:g} px"
        return f"{by} back along {self.name}"


def _direction_back(model: Model, body: Body, H: FloatArray, asked: StandOff) -> FloatArray:
    """Direction (4,) back along the feature of the body at H (4, 4), of any length."""
    points = points_of(body.M, asked.along) @ H.T
    if np.linalg.matrix_rank(points / np.linalg.norm(points, axis=1)[:, None], 1e-6) < len(points):
        raise WorkFailed(f"displaced: the points of {asked.name} span no line or plane: name others")
    if len(points) == 2:
        return np.asarray(points[0] - points[1])
    plane, O = plane_through(points), optical_centers(model.P, model.a_inf)[0]
    normal = JointMetric(model, f"displaced: the normal of {asked.name}").normal(plane)
    return np.asarray(normal * np.sign(plane @ normal) * np.sign(plane @ O))


def displacement_back(
    model: Model, body: Body, H: FloatArray, asked: StandOff, shows: BoolArray, metre: float
) -> FloatArray:
    """Displacement (4, 4) that leads a body at H (4, 4) back along a feature of it, by a length or in images.

    asked : with positions in the body; shows : (V, m) markers whose motion in the images counts.
    metre : metres a unit of the metric that the joints preserve; NaN if unknown.
    Raises InputError if a required length or normal is unknown, WorkFailed where images never move
    so far.
    """
    D = _direction_back(model, body, H, asked)
    if asked.by_m is not None:
        X = metric_points(model, np.array([body.M[0], body.M[0] + D]))
        if X is None or not metre > 0.0:
            raise InputError(
                "displaced: by_m needs a known length between markers of the face, and two revolute joints "
                "that are not parallel: set markers.positions_m, markers.tag_size_m or markers.board.size_m, "
                "or give by_px"
            )
        length = metre * float(np.linalg.norm(X[1] - X[0]))
        return np.asarray(np.eye(4) + asked.by_m / length * np.outer(D, model.a_inf))
    assert asked.by_px is not None
    D = D * np.sign(asked.by_px)
    M = body.M @ H.T
    there = project(model.P, M, model.lens)

    def moved_px(s: float) -> float:
        """Mean motion of the markers, px, in the view in which they move most, less that asked for."""
        apart = np.linalg.norm(project(model.P, M + s * D, model.lens) - there, axis=2)
        views = [float(one[seen].mean()) for one, seen in zip(apart, shows, strict=True) if seen.any()]
        return max(views) - abs(asked.by_px or 0.0)

    size = float(np.linalg.norm(np.ptp(M, axis=0)) / np.linalg.norm(D))
    s = _FIRST * size
    for _ in range(_DOUBLINGS):
        if not moved_px(s) < 0.0:
            break
        s *= 2.0
    if not 0.0 <= moved_px(s) < np.inf or moved_px(0.0) >= 0.0:
        raise WorkFailed(
            f"displaced: no distance along {asked.name} moves the images by {abs(asked.by_px):g} px"
        )
    return np.asarray(np.eye(4) + brentq(moved_px, 0.0, s, xtol=1e-14 * s) * np.outer(D, model.a_inf))
