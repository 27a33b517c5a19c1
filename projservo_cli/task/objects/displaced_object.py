"""Displacement of an object that a goal was taught on, and the goal carried along with it.

Its points and displacements are defined in ``object_bundle_adjustment``. If the joints leave the metric
open, the displacement is affine, for which a frame needs four markers off one plane instead of three off one
line.

Errors come from all images and from the calibration, to first order. A wrong calibration displaces the
object and the tool alike: the common part of both errors drops out of the images of the carried goal.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from operator import itemgetter
from typing import NamedTuple, Self

import numpy as np
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from projservo_cli.findings import REFUSES, Finding, Subject
from projservo_cli.geometry.displacements import generators, homogeneous
from projservo_cli.geometry.lens import undistort
from projservo_cli.geometry.stereo import optical_centers
from projservo_cli.metric.frame import Metric, changes_of
from projservo_cli.records import (
    CORNERS,
    MM,
    TOOL,
    BoolArray,
    Calibration,
    FloatArray,
    InputError,
    IntArray,
    WorkFailed,
)
from projservo_cli.task.objects.object_bundle_adjustment import (
    Bundle,
    BundleFit,
    ObjectView,
    ObjectViewRig,
    UncertainPoints,
    differ,
    unknown,
)

# Number of markers that six coordinates need, and that twelve need; findings on it by these numbers.
RIGID, _AFFINE = 3, 4
# Times of the observations that have to show an object.
_TAUGHT, _NOW = "when the goal was taught", "now"
# Deviation of a turn, rad, or of a stretch, above which it is not seen: first order means nothing there.
_UNSEEN = 0.3
# Difference of χ² below which two poses fit alike: the better one is the wrong one in 1 of 1,000 cases.
_UNDECIDED = 13.8
# Number of minima of a place for known points that the points are then freed from.
_MINIMA = 3
# Chance of residuals beyond which they contradict one rigid object, and error of a finder that all
# images of an object share, px: by rendered tags that lie as they did.
_BY_CHANCE, ALIKE_PX = 1e-4, 0.02
# Chance by which a tag of an object, which lies as it did, seems to have slipped.
_SLIPPED = 1e-3
# Number of markers seen in a frame, of which a single outlier may be left out.
_SHARE = 8
# Cosine of the angle between the axis of a turn and a line of markers, above which it is about that line.
_ALONG = 0.95


class _Placed(NamedTuple):
    """Object at the observations that it has been found in."""

    fit: BundleFit
    frames: tuple[int, ...]  # (L,) indices of the observations
    known: BoolArray  # (k,) markers whose points are known


@dataclass(frozen=True, eq=False)
class _Search:
    """Search for an object in observations of it."""

    rig: ObjectViewRig
    marker: Sequence[int]  # (k,) numbers of its markers
    frames: Sequence[ObjectView]

    @cached_property
    def views(self) -> IntArray:
        """Number of views (L, k) that see each marker in each frame."""
        return np.array([np.isfinite(at_frame.s).all(axis=-1).sum(axis=0) for at_frame in self.frames])

    @property
    def min_markers(self) -> int:
        """Number of markers that a frame needs."""
        return RIGID if self.rig.rigid else _AFFINE

    def of(self, markers: BoolArray, name: str = "", at_frame: int | None = None) -> Subject:
        """Markers (k,) as the subject of a finding, with the time or the number of their observation."""
        poses = () if at_frame is None else (at_frame + 1,)
        return Subject(markers=tuple(np.asarray(self.marker)[markers].tolist()), name=name, poses=poses)

    def bundle(self, frames: Sequence[int], markers: BoolArray, X: FloatArray, fixed: int = -1) -> Bundle:
        """Least squares of frames of markers (k,) near points (k, 4); known points if no frame is fixed."""
        E = generators(self.rig.linear, X[markers, :3].mean(axis=0))
        return self.rig.bundle([self.frames[i].of(markers) for i in frames], E, fixed)

    def points(self, at_frame: int, T: FloatArray) -> FloatArray:
        """Points (k, 4) that two views or more see in a frame, in the frame that T displaces; others NaN."""
        s, X = undistort(self.rig.lens[0], self.frames[at_frame].s), np.full((len(self.marker), 4), np.nan)
        P = self.rig.P[0] @ T
        for k in np.flatnonzero(self.views[at_frame] > 1):
            rows = (P[:, :2] - s[:, k, :, None] * P[:, 2:])[np.isfinite(s[:, k, 0])].reshape(-1, 4)
            X[k] = homogeneous(np.linalg.lstsq(rows[:, :3], -rows[:, 3])[0])
        return X

    def found(self) -> _Placed:
        """The object at all observations that show where it is.

        Raises WorkFailed if the first or the last does not.
        """
        base = int(np.argmax((self.views > 1).sum(axis=1)))
        X = self.points(base, np.eye(4))
        known = np.isfinite(X[:, 0])
        if known.sum() < self.min_markers:
            alone = len(self.frames[0].s) == 1
            of = Subject() if alone else self.of(known, at_frame=base)
            code = "object_without_size" if alone else "object_without_shape"
            raise unknown(Finding(code, REFUSES, of, float(known.sum()), limit=self.min_markers, unit="1"))
        fit = BundleFit.settled(self.bundle([base], known, X, 0), X[known], np.eye(4)[None])
        placed, last = _Placed(fit, (base,), known), len(self.frames) - 1
        for at_frame in dict.fromkeys((last, 0, *range(1, last))):
            try:
                placed = placed if at_frame == base else self._with(placed, at_frame)
            except WorkFailed:
                if at_frame in (0, last):
                    raise
        return placed

    def _with(self, placed: _Placed, at_frame: int) -> _Placed:
        """The object with one more observation of it."""
        when = _TAUGHT if at_frame == 0 else _NOW
        X = np.full((len(self.marker), 4), np.nan)
        X[placed.known] = placed.fit.X
        visible = placed.known & (self.views[at_frame] > 0)
        if visible.sum() < self.min_markers:
            of, seen = self.of(visible, when), float(visible.sum())
            raise unknown(Finding("object_hidden", REFUSES, of, seen, limit=self.min_markers, unit="1"))
        found = []
        for start in self._structures(placed, X):
            T, _ = self.bundle([at_frame], visible, start).poses(start[visible], self.rig.turns)
            found += [self._joined(placed, at_frame, start, there) for there in T[:_MINIMA]]
        if not found:
            raise unknown(Finding("object_unplaced", REFUSES, self.of(visible, when)))
        best, *others = sorted(found, key=lambda one: one.fit.cost)
        in_frame = best.frames.index(at_frame)
        deviation, axis = best.fit.unseen(in_frame)
        if deviation > _UNSEEN:
            raise unknown(self._not_seen(best, self.of(visible, when), deviation, axis))
        for other in others:
            apart = other.fit.cost - best.fit.cost
            ends = [one.fit.T[in_frame] @ X[visible].T for one in (best, other)]
            if apart < _UNDECIDED and differ(ends[0].T, ends[1].T):
                of = self.of(visible, when)
                raise unknown(Finding("object_in_two_places", REFUSES, of, apart, limit=_UNDECIDED))
        return best

    def _structures(self, placed: _Placed, X: FloatArray) -> list[FloatArray]:
        """Points (k, 4) to start from: those known, and with one frame alone their reversal in depth.

        Images of a small object far away hardly separate the two, nor does a short baseline.
        """
        if len(placed.frames) > 1 or not self.rig.rigid:
            return [X]
        middle = placed.fit.X[:, :3].mean(axis=0)
        depth = middle - optical_centers(self.rig.P[0], np.array([0.0, 0.0, 0.0, 1.0]))[:, :3].mean(axis=0)
        depth /= np.linalg.norm(depth)
        reversed_ = X.copy()
        reversed_[:, :3] -= 2.0 * np.outer((X[:, :3] - middle) @ depth, depth)
        return [X, reversed_]

    def _joined(self, placed: _Placed, at_frame: int, X: FloatArray, there: FloatArray) -> _Placed:
        """The minimum with one more observation, from points (k, 4) and their displacement (4, 4) there."""
        at = sorted([*zip(placed.frames, placed.fit.T, strict=True), (at_frame, there)], key=itemgetter(0))
        frames = tuple(i for i, _ in at)
        points = np.where(placed.known[:, None], X, self.points(at_frame, there))
        known = np.isfinite(points[:, 0])
        bundle = self.bundle(frames, known, points, frames.index(placed.frames[placed.fit.bundle.fixed]))
        fit = BundleFit.settled(bundle, points[known], np.array([place for _, place in at]))
        return _Placed(fit, frames, known)

    def _not_seen(self, placed: _Placed, visible: Subject, std: float, axis: FloatArray) -> Finding:
        """Return the freedom that images leave, by the direction (3 or 9,) of its largest deviation."""
        if not self.rig.rigid:
            return Finding("object_stretched", REFUSES, visible, std, limit=_UNSEEN, unit="1")
        numbers, X = np.asarray(self.marker)[placed.known], placed.fit.X[:, :3]
        lines = X[:, None] - X
        cosine = np.abs(lines @ axis) / np.maximum(np.linalg.norm(lines, axis=-1), 1e-300)
        i, j = sorted(np.unravel_index(int(np.argmax(cosine)), cosine.shape))
        line = (Finding("object_line", subject=Subject(markers=(int(numbers[i]), int(numbers[j])))),)
        about = line if cosine[i, j] > _ALONG else ()
        capped = min(std, np.pi)
        return Finding("object_turned", REFUSES, visible, capped, limit=_UNSEEN, unit="rad", others=about)


class _Off(NamedTuple):
    """Markers that do not lie as they did, beyond chance by noise and calibration."""

    times: float
    max_times: float  # times, most: residuals over the noise, and at most by chance
    at_frame: int
    markers: tuple[int, ...]  # frame, markers: the largest outlier, or a tag that moved by itself


class _Left(NamedTuple):
    """Residuals (N,) of the images of a fit, over their deviation, with residuals of shared errors."""

    r: FloatArray
    J: FloatArray  # (N, p) by the coordinates of the fit
    of_calibration: FloatArray  # (N, c) by its errors

    @classmethod
    def of(cls, rig: ObjectViewRig, fit: BundleFit) -> Self:
        """Residuals of a fit."""
        r, J = fit.linearized()
        share = 1.0 / np.hypot(1.0, ALIKE_PX * np.repeat(fit.bundle.weight[fit.bundle.weight > 0.0], 2))
        return cls(share * r, share[:, None] * J, share[:, None] * fit.moved(rig, fit.X))

    def after(self, more: FloatArray) -> tuple[FloatArray, float]:
        """Residuals (N,) that further columns (N, k) leave as well, and their χ² with the calibration."""
        J = np.hstack([self.J, more])
        seen = np.column_stack([self.r, self.of_calibration])
        r, left = np.split(seen - J @ np.linalg.lstsq(J, seen)[0], [1], axis=1)
        r, along = r[:, 0], left.T @ r[:, 0]
        return r, float(r @ r - along @ np.linalg.solve(np.eye(left.shape[1]) + left.T @ left, along))


def _elsewhere(rig: ObjectViewRig, fit: BundleFit, marker: Sequence[int]) -> _Off | None:
    """Find markers (k,) that do not lie as they did; None if all do.

    By all residuals, otherwise by the residuals of one tag that moved by itself since the first frame.
    """
    left, seen = _Left.of(rig, fit), fit.bundle.weight > 0.0
    dof = len(left.r) - left.J.shape[1]
    if dof < 1:
        return None
    r, square = left.after(np.zeros((len(left.r), 0)))
    if square > (max_times := chdtri(dof, _BY_CHANCE)):
        off = np.zeros(seen.shape)
        off[seen] = (r.reshape(-1, 2) ** 2).sum(axis=1)
        in_frame = off.sum(axis=1)
        at_frame, k = np.unravel_index(int(np.argmax(in_frame)), in_frame.shape)
        return _Off(float(np.sqrt(square / dof)), float(np.sqrt(max_times / dof)), int(at_frame), (int(k),))
    tags = _tags(marker)
    for tag in tags if len(tags) > 1 else ():
        by_tag = _by_motion(rig, fit, tag)[seen].reshape(len(left.r), -1)
        fell, g = square - left.after(by_tag)[1], by_tag.shape[1]
        if fell > (max_times := chdtri(g, _SLIPPED / len(tags))):
            return _Off(float(np.sqrt(fell / g)), float(np.sqrt(max_times / g)), len(fit.T) - 1, tag)
    return None


def _tags(marker: Sequence[int]) -> list[tuple[int, ...]]:
    """Positions of the corners of each tag among markers (k,), of tags with all corners."""
    at = {number: k for k, number in enumerate(marker)}
    corners = {CORNERS * (number // CORNERS): None for number in marker}
    whole = [[first + k for k in range(CORNERS)] for first in corners]
    return [tuple(at[number] for number in tag) for tag in whole if all(number in at for number in tag)]


def _by_motion(rig: ObjectViewRig, fit: BundleFit, tag: Sequence[int]) -> FloatArray:
    """Derivatives (L, V, k, 2, g) of images by displacements of some markers in the last frame."""
    bundle, X, T = fit.bundle, fit.X[None], fit.T[None]
    own = bundle._replace(E=generators(rig.linear, fit.X[list(tag), :3].mean(axis=0)))
    moved: FloatArray = own.by_motion(bundle.residuals(X, T)[1], X, T)[0]
    alone = np.zeros_like(moved)
    alone[-1][:, list(tag)] = moved[-1][:, list(tag)]
    return alone


def _of_one_object(
    rig: ObjectViewRig, marker: Sequence[int], frames: Sequence[ObjectView]
) -> tuple[BundleFit, BoolArray, tuple[int, ...]]:
    """The object as observed, its markers (k,) that are known, and numbers of those that were left out.

    A single outlier in one frame, as a finder errs at a covered edge, is left out of that frame,
    one of ``_SHARE`` seen at most. Raises WorkFailed if more err: that is another object.
    """
    frames, left_out = list(frames), list[int]()
    while True:
        fit, found_in, known = _Search(rig, marker, frames).found()
        numbers = np.asarray(marker)[known]
        off = _elsewhere(rig, fit, numbers.tolist())
        if off is None:
            return fit, known, tuple(left_out)
        at_frame, which = found_in[off.at_frame], numbers[list(off.markers)].tolist()
        seen = np.isfinite(frames[at_frame].s).all(axis=-1).any(axis=0)
        if (len(which) + len(left_out)) * _SHARE > seen.sum():
            of = Subject(markers=tuple(which))
            raise unknown(Finding("object_deformed", REFUSES, of, off.times, limit=off.max_times, unit="1"))
        left_out += which
        s = frames[at_frame].s.copy()
        s[:, np.isin(marker, which)] = np.nan
        frames[at_frame] = frames[at_frame]._replace(s=s)


def images_by_motion(c: Calibration, s: FloatArray) -> FloatArray:
    """Derivatives (V, k, 2, g) of the images (V, k, 2) of an object by displacements of it, px.

    NaN for markers that fewer than two views show. Raises WorkFailed as ``ObjectViewRig.of``.
    """
    rig, every = ObjectViewRig.of(c), np.arange(s.shape[1])
    search = _Search(rig, every.tolist(), [ObjectView(s, np.ones(s.shape[:2]))])
    X = search.points(0, np.eye(4))
    known = np.isfinite(X[:, 0])
    found = np.full((*s.shape, len(rig.linear) + 3), np.nan)
    if known.any():
        bundle, at = search.bundle([0], known, X), np.eye(4)[None, None]
        by_point = bundle.residuals(X[known][None], at)[1]
        found[:, known] = bundle.by_motion(by_point, X[known][None], at)[0, 0]
    return found


class Displaced(NamedTuple):
    """Displacement T B of an object since a goal was taught on it, in their frame, with its errors.

    They are steps T exp(ξ E), by independent errors of unit variance.
    """

    T: FloatArray  # (4, 4)
    B: FloatArray  # (4, 4) to the frame of E
    E: FloatArray  # (g, 4, 4) generators
    by_images: FloatArray  # (g, N)
    by_calibration: FloatArray  # (g, c)


@dataclass(frozen=True, eq=False)
class CarriedGoal:
    """Goal of the tool after the displacement of the object that it was taught on, with its errors."""

    s: FloatArray  # (V, m, 2) px of the markers of the tool, in the order of the calibration
    changes: FloatArray  # (c, V, m, 2) of them by independent errors of unit variance, px
    H: FloatArray  # (4, 4) displacement of the tool from its reference, in the calibrated frame
    pose_changes: FloatArray  # (c, 6) translation, unit, and turn about the middle of the tool, rad
    rms_px: float  # deviation of the pose in the images, rms per marker and view, px
    unit_mm: float  # mm in a unit; NaN without a known length

    @property
    def covariance(self) -> FloatArray:
        """Covariance (V m 2, V m 2) of the images, px²."""
        flat = self.changes.reshape(len(self.changes), -1)
        return np.asarray(flat.T @ flat)

    @property
    def pose_covariance(self) -> FloatArray:
        """Covariance (6, 6) of the pose, unit² and rad²."""
        return np.asarray(self.pose_changes.T @ self.pose_changes)

    @property
    def position_mm(self) -> float:
        """Deviation of the middle of the tool, rms distance, mm; NaN without a known length."""
        return float(self.unit_mm * np.linalg.norm(self.pose_changes[:, :3]))

    @property
    def rotation_deg(self) -> float:
        """Deviation of the rotation, rms angle, degrees."""
        return float(np.degrees(np.linalg.norm(self.pose_changes[:, 3:])))


@dataclass(frozen=True, eq=False)
class DisplacedObject:
    """Object as found in observations of it, the first when a goal was taught on it, the last now."""

    marker: tuple[int, ...]  # numbers of the markers that it was found by
    M: FloatArray  # (k, 4) them when the goal was taught, in the calibrated frame, a_inf·M = 1
    D: FloatArray  # (4, 4) displacement from there to now, in the calibrated frame, a_inf D = a_inf
    shift_px: float  # motion of its images, rms per marker and view
    shift_mm: float  # motion of its middle; NaN without a known length
    angle_deg: float  # turn; NaN if the joints do not determine the metric
    noise_factor: float  # residuals over their deviation, rms per degree of freedom
    unit_mm: float  # mm in a unit of the frame that it was found in; NaN without a known length
    left_out: tuple[int, ...]  # numbers of markers that were outliers in a frame, and left out of it
    rig: ObjectViewRig
    _fit: BundleFit

    @property
    def coordinates(self) -> int:
        """Number of coordinates of its displacement: 6, or 12 if the joints do not determine the metric."""
        return len(self._fit.bundle.E)

    @classmethod
    def of(
        cls, c: Calibration, marker: Sequence[int], frames: Sequence[ObjectView], metric: Metric | None = None
    ) -> Self:
        """Find the displacement of an object by all observations of it.

        Looks in between refine its shape; those that do not show where it is are left out. A marker counts
        if two views or more see it at some observation.

        c : calibration with its covariance.
        marker : (k,) numbers of the markers of the object, as messages name them.
        frames : two or more, the first when the goal was taught, the last now; views as of the calibration.
        metric : of the calibration with a known length, for mm.
        Raises InputError for cameras on the tool, and WorkFailed for motions that images or joints do not
        show, which names the freedom that is missing.
        """
        if c.mount == TOOL:
            raise InputError(
                "objects: cameras on the tool see the scene that the goal is on: its own images are the goal"
            )
        rig = ObjectViewRig.of(c)
        fit, known, left_out = _of_one_object(rig, marker, frames)
        numbers = tuple(np.asarray(marker)[known].tolist())
        T, back = fit.T[-1] @ np.linalg.inv(fit.T[0]), np.linalg.inv(rig.G)
        taught, now = fit.X @ fit.T[0].T, fit.X @ fit.T[-1].T
        shift = rig.pixels(now)[0] - rig.pixels(taught)[0]
        unit = np.nan if metric is None else MM * _unit_m(rig, metric)
        r, J = fit.linearized()
        return cls(
            marker=numbers,
            M=taught @ back.T,
            D=back @ T @ rig.G,
            shift_px=float(np.sqrt((shift**2).sum(axis=-1).mean())),
            shift_mm=float(unit * np.linalg.norm((now - taught).mean(axis=0))),
            angle_deg=float(np.degrees(Rotation.from_matrix(T[:3, :3]).magnitude())) if rig.rigid else np.nan,
            noise_factor=float(np.sqrt(fit.cost / max(len(r) - J.shape[1], 1))),
            unit_mm=float(unit),
            left_out=left_out,
            rig=rig,
            _fit=fit,
        )

    def markers(self, numbers: Sequence[int], frame: int = -1) -> UncertainPoints:
        """Return some of its markers (k,) at an observation, NaN where unseen, in their common frame."""
        found = self._fit.points_at(range(len(self._fit.T))[frame], self.rig)
        at = [self.marker.index(number) if number in self.marker else -1 for number in numbers]
        unseen = np.array(at) < 0
        return UncertainPoints(
            *(np.where(unseen[:, None], np.nan, found.X[at]), found.by_images[at], found.by_calibration[at])
        )

    def carry(self, goal: ObjectView | FloatArray, at: Displaced | None = None) -> CarriedGoal:
        """Carry a goal of the tool along that was taught in the first frame.

        goal : images (V, m, 2) of the markers of the tool there, px, in the order of the calibration; NaN
            where unseen.
        at : where the object is; None for the last observation.
        Raises WorkFailed if they do not determine a pose of the tool, or the carried one is out of sight.
        """
        rig, at = self.rig, self._now() if at is None else at
        tool = _tool_at(rig, goal if isinstance(goal, ObjectView) else ObjectView(goal))
        H = at.T @ at.B @ tool.T[0]
        placed = tool.X @ H.T
        if not (placed @ rig.P[0, :, 2].T > 0.0).all():
            raise unknown(Finding("carried_behind", REFUSES))
        s = rig.pixels(placed)[0]
        # All markers in all views; a motion of the object takes the tool along, as one of the tool itself.
        out = rig.bundle([ObjectView(s, np.ones(s.shape[:2]))], tool.bundle.E)
        by_point = out.residuals(placed[None], np.eye(4)[None, None])[1]

        def by(E: FloatArray, points: FloatArray, T: FloatArray) -> FloatArray:
            """Derivatives (V m 2, g) of the images by steps of a displacement of points."""
            motion = out._replace(E=E).by_motion(by_point, points[None], T[None, None])
            return np.asarray(motion.reshape(s.size, -1))

        carried = tool.X @ (at.B @ tool.T[0]).T
        by_goal, by_now = by(tool.bundle.E, tool.X, H), by(at.E, carried, at.T)
        xi, xi_c = at.by_images, at.by_calibration
        goal_s, goal_c = tool.errors(rig, rig.M)
        of_calibration = changes_of(rig.pixels(rig.M @ H.T)).reshape(-1, s.size).T
        of_calibration += by_now @ xi_c + by_goal @ goal_c

        def images(T: FloatArray) -> FloatArray:
            """Images (K, V m 2) after small displacements (K, 4, 4) of the object."""
            exact = rig._replace(P=rig.P[:1], lens=rig.lens[:1])
            return exact.pixels(carried @ (at.T @ T).swapaxes(1, 2)).reshape(len(T), -1)

        second = _second_order(images, at.E, np.hstack([xi, xi_c]))
        changes = np.concatenate([by_now @ xi, by_goal @ goal_s, of_calibration, second], axis=1)
        pose = by(generators(rig.turns, placed[:, :3].mean(axis=0)), placed, np.eye(4))
        pose_changes = np.linalg.pinv(pose) @ changes
        return CarriedGoal(
            s=s,
            changes=changes.T.reshape(-1, *s.shape),
            H=np.linalg.inv(rig.G) @ H @ rig.G,
            pose_changes=pose_changes.T,
            rms_px=float(np.linalg.norm(pose @ pose_changes) / np.sqrt(s.size / 2)),
            unit_mm=self.unit_mm,
        )

    def _now(self) -> Displaced:
        """Displacement to the last observation, with its errors."""
        fit = self._fit
        by_images, by_calibration = fit.errors(self.rig, fit.X)
        xi, xi_c = np.zeros((2, len(fit.bundle.E), 1))
        for at_frame, sign in ((0, -1.0), (len(fit.T) - 1, 1.0)):
            if at_frame != fit.bundle.fixed:
                own = fit.bundle.columns(at_frame, len(fit.X))
                xi, xi_c = xi + sign * by_images[own], xi_c + sign * by_calibration[own]
        return Displaced(fit.T[-1], np.linalg.inv(fit.T[0]), fit.bundle.E, xi, xi_c)


def _second_order(
    images: Callable[[FloatArray], FloatArray], E: FloatArray, errors: FloatArray
) -> FloatArray:
    """Changes (N, c) of second order of images (N,), uncorrelated with each other and with first order.

    The tool is next to the object, so a turn by an error takes it along an arc.
    images : (K, N) of small displacements (K, 4, 4) by generators E (g, 4, 4); errors : (g, c) of it.
    """
    values, vectors = np.linalg.eigh(errors @ errors.T)
    L = vectors * np.sqrt(np.maximum(values, 0.0))

    i, j = np.triu_indices(len(E))
    sums, gaps = (L[:, i] + L[:, j]).T, (L[:, i] - L[:, j]).T
    steps = np.stack([sums, -sums, gaps, -gaps])
    at = images(expm(np.einsum("...g,gij->...ij", steps, E)).reshape(-1, 4, 4))
    second = 0.25 * np.einsum("s,skn->nk", [1.0, 1.0, -1.0, -1.0], at.reshape(4, len(i), -1))
    # Terms of unit variance are z_i z_j and (z_i² − 1)/√2; the mean of z_i² is 1.
    mean = 0.5 * second[:, i == j].sum(axis=1)
    return np.column_stack([np.where(i == j, np.sqrt(0.5), 1.0) * second, mean])


def _unit_m(rig: ObjectViewRig, metric: Metric) -> float:
    """Length of a unit of the frame of a rig, m, by the two markers of the tool farthest apart."""
    X, M = metric.markers, rig.M[0]
    apart = np.linalg.norm(X[:, None] - X, axis=-1)
    i, j = np.unravel_index(int(np.argmax(apart)), apart.shape)
    return float(apart[i, j] / np.linalg.norm(M[i] - M[j]))


def _tool_at(rig: ObjectViewRig, goal: ObjectView) -> BundleFit:
    """Fit the pose of the tool to its images at a goal.

    Raises WorkFailed if they do not determine it.
    """
    M = rig.M[0]
    bundle = rig.bundle([goal], generators(rig.turns, M[:, :3].mean(axis=0)))
    seen = bundle.weight[0].any(axis=0)
    if seen.sum() < RIGID:
        raise unknown(Finding("goal_few_markers", REFUSES, amount=float(seen.sum()), limit=RIGID, unit="1"))
    T, cost = rig.bundle([goal.of(seen)], bundle.E).poses(M[seen], rig.turns)
    if not len(T):
        raise unknown(Finding("goal_unplaced", REFUSES))
    fit = BundleFit(bundle, M, T[:1], float(cost[0]))
    deviation, _ = fit.unseen(0)
    if deviation > _UNSEEN:
        capped = min(deviation, np.pi)
        raise unknown(Finding("goal_turned", REFUSES, amount=capped, limit=_UNSEEN, unit="rad"))
    if len(cost) > 1 and cost[1] - cost[0] < _UNDECIDED:
        apart = float(cost[1] - cost[0])
        raise unknown(Finding("goal_in_two_poses", REFUSES, amount=apart, limit=_UNDECIDED))
    return fit
