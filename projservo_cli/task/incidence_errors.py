"""Distances of features from their incidences, with deviations, in mm and degrees.

Errors come from the images of both poses and from the calibration, to first order; if the calibration is
wrong, both poses and all features err alike, and their common error drops out.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm

from projservo_cli.geometry.displacements import generators
from projservo_cli.metric.frame import changes_of
from projservo_cli.monitoring.arrival_accuracy import metres_by
from projservo_cli.records import MEET, MM, PARALLEL, PERPENDICULAR, Calibration, FloatArray, WorkFailed
from projservo_cli.task.incidences import Incidence, points_of
from projservo_cli.task.objects.object_bundle_adjustment import (
    NO_POINTS,
    BundleFit,
    ObjectView,
    ObjectViewRig,
    UncertainPoints,
)

# Angle between features, rad, by their relation.
_WANTED = {MEET: 0.0, PARALLEL: 0.0, PERPENDICULAR: 0.5 * np.pi}
# Step of the differences by motions of the tool, units and rad.
_STEP = 1e-5


class Separation(NamedTuple):
    """Vectors between features as they are and as an incidence wants them (...), in a metric frame.

    Each vanishes with the error, and changes smoothly with the features.
    """

    # (..., p, 3) between each point of the smaller feature and the other one; p is 0 if they need not meet
    apart: FloatArray
    # (..., 1 or 3) sine of the angle about each axis, or the angle, rad; 0 columns for points
    turned: FloatArray

    @classmethod
    def of(cls, one: Incidence, tool: FloatArray, scene: FloatArray) -> "Separation":
        """Points (..., k, 3) span the features, one, two or three each."""
        small, large = (tool, scene) if tool.shape[-2] <= scene.shape[-2] else (scene, tool)
        apart = small - large[..., :1, :]
        if large.shape[-2] > 1:
            D = large[..., 1:, :] - large[..., :1, :]
            apart = apart - apart @ np.linalg.pinv(D) @ D
        if one.relation != MEET:
            apart = apart[..., :0, :]
        if small.shape[-2] == 1:
            return cls(apart, np.zeros((*apart.shape[:-2], 0)))
        a, b = (_axis(points) for points in (small, large))
        along, wanted = (a * b).sum(axis=-1, keepdims=True), _wanted(one)
        alike = small.shape[-2] == large.shape[-2]
        if wanted == (0.0 if alike else 0.5 * np.pi):  # both axes are one
            return cls(apart, np.cross(a, b))
        angle = np.clip(along, -1.0, 1.0)
        return cls(apart, (np.arccos(angle) if alike else np.arcsin(angle)) - wanted)


def _wanted(one: Incidence) -> float:
    """Angle between features, rad."""
    return _WANTED.get(one.relation, float(np.radians(one.angle_deg)))


def _axis(points: FloatArray) -> FloatArray:
    """Direction (..., 3) of a line through two points (..., 2, 3), or normal of a plane through three."""
    D = points[..., 1:, :] - points[..., :1, :]
    axis = D[..., 0, :] if D.shape[-2] == 1 else np.cross(D[..., 0, :], D[..., 1, :])
    return np.asarray(axis / np.linalg.norm(axis, axis=-1, keepdims=True))


def angle_off(one: Incidence, tool: FloatArray, scene: FloatArray) -> float:
    """Angle, rad, by which features spanned by points (k, 3) deviate; in their sense if both are alike."""
    cosine = float(np.clip(_axis(tool) @ _axis(scene), -1.0, 1.0))
    between = np.arccos(cosine) if len(tool) == len(scene) else abs(np.arcsin(cosine))
    return float(abs(between - _wanted(one)))


class TaughtAndNow(NamedTuple):
    """Taught and present poses of the tool: images (V, k, 2), and displacements to begin with."""

    taught: ObjectView
    now: ObjectView
    H_taught: FloatArray
    H: FloatArray  # H_taught, H: (4, 4) in the calibrated frame
    taught_mm: float = 0.0
    taught_deg: float = 0.0  # taught_mm, taught_deg: deviation of the goal besides that by its images
    of_object: UncertainPoints = NO_POINTS  # markers of the object that carries the goal, where it is now


class IncidenceErrors(NamedTuple):
    """Errors of incidences (g,), and their deviations; NaN if undefined or unknown."""

    mm: FloatArray  # distance of the farthest point, as images show it
    deg: FloatArray
    deviation_mm: FloatArray
    deviation_deg: FloatArray


class Placed(NamedTuple):
    """A body where the goal was taught and where it is, in the metric frame of the arm."""

    M: FloatArray  # (B, k, 4) markers at the reference, as calibrated and changed by its errors
    T: FloatArray  # (2, 4, 4) displacements
    E: FloatArray  # (6, 4, 4) generators of steps of them
    unit_mm: FloatArray  # (B,) mm in a unit; 1 if no length is known
    errors: tuple[FloatArray, FloatArray]  # (6, ...) of each displacement, by independent errors
    of_object: UncertainPoints  # markers where they are, whose positions come after the body's

    def on_object(self, one: Incidence) -> bool:
        """Whether the feature of the scene is of the markers of the object, and none that was taught."""
        return not one.visible_by(range(self.M.shape[1]))

    def features(
        self,
        one: Incidence,
        M: FloatArray | None = None,
        T: FloatArray | None = None,
        X: FloatArray | None = None,
    ) -> tuple[FloatArray, FloatArray]:
        """Points (..., l, 3) that span the feature of the tool, and the feature of the scene.

        Of markers M (..., k, 4) at T (..., 2, 4, 4), and X (..., o, 4) of the object; as found if not given.
        """
        M, T = self.M[0] if M is None else M, self.T if T is None else T
        tool = points_of(M, one.tool) @ np.swapaxes(T[..., 1, :, :], -1, -2)
        if not self.on_object(one):
            return tool[..., :3], (points_of(M, one.scene) @ np.swapaxes(T[..., 0, :, :], -1, -2))[..., :3]
        own = tuple(tuple(number - M.shape[-2] for number in point) for point in one.scene)
        return tool[..., :3], points_of(self.of_object.X if X is None else X, own)[..., :3]

    def vectors(self, one: Incidence, unit_mm: FloatArray, **of: FloatArray) -> FloatArray:
        """Vectors (..., c) of an incidence, mm, then rad, of markers as of ``features``."""
        at = Separation.of(one, *self.features(one, **of))
        apart = unit_mm[..., None, None] * at.apart
        return np.concatenate([apart.reshape(*apart.shape[:-2], -1), at.turned], axis=-1)

    def changes(self, one: Incidence) -> FloatArray:
        """Changes (c, ...) of these by independent errors of unit variance."""
        shared = changes_of(self.vectors(one, self.unit_mm, M=self.M, T=self.T[None])).T
        c = shared.shape[1]  # errors of the calibration come first, and are common
        apart = [self.by_motion(one, 1) @ self.errors[1]]
        if self.on_object(one):
            errors = np.concatenate([self.of_object.by_calibration, self.of_object.by_images], axis=2)
            apart.append(self.by_points(one) @ errors.reshape(-1, errors.shape[2]))
        else:
            apart.append(self.by_motion(one, 0) @ self.errors[0])
        return np.hstack([shared + sum(part[:, :c] for part in apart), *(part[:, c:] for part in apart)])

    def by_motion(self, one: Incidence, which: int) -> FloatArray:
        """Derivatives (c, 6) by steps of one of both displacements."""
        steps = expm(_STEP * np.concatenate([self.E, -self.E]))
        T = np.broadcast_to(self.T, (len(steps), *self.T.shape)).copy()
        T[:, which] = T[:, which] @ steps
        up, down = np.split(self.vectors(one, self.unit_mm[:1], T=T), 2)
        return np.asarray((up - down).T / (2.0 * _STEP))

    def by_points(self, one: Incidence) -> FloatArray:
        """Derivatives (c, 3 o) by coordinates of the markers of the object."""
        X = self.of_object.X
        steps = np.zeros((3 * len(X), *X.shape))
        steps[:, :, :3] = _STEP * np.eye(3 * len(X)).reshape(-1, len(X), 3)
        up, down = np.split(self.vectors(one, self.unit_mm[:1], X=np.concatenate([X + steps, X - steps])), 2)
        return np.asarray((up - down).T / (2.0 * _STEP))


@lru_cache(maxsize=8)
def metric_rig(c: Calibration) -> ObjectViewRig | None:
    """Cameras and tool in the metric of the arm; None if the joints leave it open."""
    try:
        rig = ObjectViewRig.of(c)
    except WorkFailed:
        return None
    return rig if rig.rigid else None


def placed_by(rig: ObjectViewRig, markers: Sequence[int], ends: TaughtAndNow, unit_mm: FloatArray) -> Placed:
    """Fit both poses of the body to their images."""
    M, back = rig.M[:, list(markers)], np.linalg.inv(rig.G)
    E = generators(rig.turns, M[0, :, :3].mean(axis=0))
    fits = [
        BundleFit.settled(rig.bundle([look], E), M[0], (rig.G @ H @ back)[None])
        for look, H in ((ends.taught, ends.H_taught), (ends.now, ends.H))
    ]
    errors = [np.hstack(fit.errors(rig, M)[::-1]) for fit in fits]
    T = np.concatenate([fit.T for fit in fits])
    return Placed(M, T, E, unit_mm, (errors[0], errors[1]), ends.of_object)


def incidence_errors(
    c: Calibration,
    markers: Sequence[int],
    asked: Sequence[Incidence],
    ends: TaughtAndNow,
    lengths: FloatArray,
) -> IncidenceErrors:
    """State how far features are from where incidences want them; NaN if the joints leave the metric open.

    markers : (k,) indices of the markers of the body, of which the face comes first.
    asked : incidences by positions in the body.
    lengths : (m, m) between the markers of the face, m; mm are NaN without any.
    """
    found, rig = np.full((len(asked), 4), np.nan), metric_rig(c)
    if rig is None or not np.isfinite([ends.H_taught, ends.H]).all():
        return IncidenceErrors(*found.T)
    unit = MM * metres_by(rig.M[:, list(markers), :3], lengths)
    known = np.isfinite(unit[0])
    placed = placed_by(rig, markers, ends, unit if known else np.ones(len(unit)))
    for row, one in zip(found, asked, strict=True):
        tool, scene = placed.features(one)
        taught_mm, taught_deg = (0.0, 0.0) if placed.on_object(one) else (ends.taught_mm, ends.taught_deg)
        apart, turned = Separation.of(one, tool, scene)
        variance = np.square(placed.changes(one)).sum(axis=1)
        if apart.size and known:
            off = unit[0] * np.linalg.norm(apart, axis=1)
            k = int(np.argmax(off))
            at_point = variance[: apart.size].reshape(-1, 3)[k].sum()
            row[0], row[2] = off[k], np.hypot(np.sqrt(at_point), taught_mm)
        if turned.size:
            row[1] = np.degrees(angle_off(one, tool, scene))
            row[3] = np.hypot(np.degrees(np.sqrt(variance[apart.size :].sum())), taught_deg)
    return IncidenceErrors(*found.T)
