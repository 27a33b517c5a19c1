"""Markers that do not move as the tool does: they are fixed, sit on a link, creep, or slipped.

A few of them leave a fit of all others as it is, so each is asked by itself, with the robot as fitted: which
separate motion explains its images. Each such motion is exact or to first order of a small shift.
"""

from collections import Counter
from collections.abc import Iterator
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from projservo_cli.calibration.detections import MAX_JUDGED, STILL_PX, STILL_SHARE, Detections
from projservo_cli.calibration.prediction import projection_derivative
from projservo_cli.calibration.robust_fit import Solution, fit_inliers
from projservo_cli.findings import LIMITS, Finding, Subject
from projservo_cli.geometry.displacements import displacements
from projservo_cli.records import CORNERS, BoolArray, FloatArray, IntArray

# Minimum number of images of a marker, and of markers that are left.
_IMAGES, _LEFT = 6, 3
# Squared residuals of a marker over the others, from which it is tested, and maximum share of them
# that its own motion leaves.
_OFF, _EXPLAINED = 4.0, 0.4
# Gain in squared residuals for each number of a motion, over the others, from which it is named.
_DECISIVE = 50.0
# Motions that corners of a tag have together, and number of them from which it is one.
_OF_TAGS, _OF_A_TAG = ("marker_drift", "marker_step"), 3
# Steps by which a marker is placed, number of onsets that are tried, and share of the markers that may be so.
_STEPS, _ONSETS, _SHARE = 8, 16, 1.0 / 3.0


def motionless(detections: Detections) -> BoolArray:
    """Mask (m,) of markers whose images rest in all views while the others move."""
    pixels = detections.dense()
    seen = np.isfinite(pixels[..., 0])
    count = seen.sum(axis=1)
    asked = count >= _IMAGES
    spread = np.full(count.shape, np.nan)
    for v, j in zip(*np.nonzero(asked), strict=True):
        track = pixels[v, seen[v, :, j], j]
        spread[v, j] = np.median(np.linalg.norm(track - np.median(track, axis=0), axis=1))
    if detections.marker.size > MAX_JUDGED or not asked.any(axis=1).all():
        return np.zeros(detections.marker.size, dtype=np.bool_)
    max_spread = np.array([np.max(of_view[np.isfinite(of_view)]) for of_view in spread])
    still = ~asked | ((spread < STILL_PX) & (spread < STILL_SHARE * max_spread[:, None]))
    found = np.asarray(still.all(axis=0) & asked.any(axis=0))
    return found if (~found).sum() >= _LEFT else np.zeros_like(found)


def motionless_finding(detections: Detections, which: BoolArray) -> Finding:
    """Return the finding on stationary markers (m,)."""
    numbers = tuple(detections.marker[which].tolist())
    return Finding("standing_markers", LIMITS, Subject(markers=numbers), len(numbers), unit="1")


class _Motion(NamedTuple):
    """A motion of a marker by itself."""

    finding: Finding
    square: float  # squared residuals that it leaves
    numbers: int  # that it has beyond a place


def without_strange(solution: Solution, noise_px: float) -> tuple[Solution, tuple[Finding, ...]]:
    """Return a fit without markers that move in their own way, and a finding on each.

    noise_px : of the rig.
    """
    detections = solution.problem.detections
    if detections.marker.size > MAX_JUDGED:  # a fit rejects drifting ones among many tracks
        return solution, ()
    found = {j: motion.finding for j, motion in _strange(solution)}
    # A tag that slips or creeps is found as one tag, by its rejected detections.
    moved = [detections.marker[j] // CORNERS for j, one in found.items() if one.code in _OF_TAGS]
    tags = {tag for tag, count in Counter(moved).items() if count >= _OF_A_TAG}
    found = {j: one for j, one in found.items() if detections.marker[j] // CORNERS not in tags}
    if not found or len(found) > _SHARE * detections.marker.size:
        return solution, ()
    keep = ~np.isin(np.arange(detections.marker.size), [*found])
    less = solution.of_markers(keep)
    again = fit_inliers(less.problem, less.params, less.sigma_px, noise_px)
    return (solution, ()) if again is None else (again, tuple(found.values()))


def _strange(solution: Solution) -> Iterator[tuple[int, _Motion]]:
    """Yield markers, by their index, that a separate motion explains."""
    problem, detections = solution.problem.with_noise(None), solution.problem.detections
    m = detections.marker.size
    squares = np.where(detections.seen, np.square(problem.residual(solution.params)).sum(axis=2), 0.0)
    squares = np.nan_to_num(squares, nan=np.inf)
    count = np.maximum(detections.count_of(detections.seen), 1)
    level = np.bincount(detections.marker_of, squares.sum(axis=0), m) / (2.0 * count)
    usual = max(float(np.median(level)), solution.sigma_px**2, 1e-300)
    for j in np.flatnonzero((level > _OFF * usual) & (count >= _IMAGES)).tolist():
        rows = np.flatnonzero(detections.marker_of == j)
        track = _Track(solution, rows, j)
        best = min(track.motions(), key=lambda one: one.square + usual * _DECISIVE * one.numbers)
        gain = (track.square - best.square) / best.numbers
        if best.square < _EXPLAINED * track.square and gain > _DECISIVE * usual:
            yield j, best


class _Track:
    """Images of one marker, with the robot as fitted."""

    def __init__(self, solution: Solution, rows: IntArray, j: int) -> None:
        problem, self.params = solution.problem, solution.params
        self.detections, self.j = problem.detections.rows(rows), j
        q = problem.joints(self.params)[self.detections.pose_of]
        E = displacements(self.params.H_hat, self.params.prismatic, self.params.turned(q))
        self.motion = np.broadcast_to(np.eye(4), (len(rows), 4, 4))
        self.before = []  # motions (N, 4, 4) of the part that each joint carries, from the base on
        for by_joint in E:
            self.before.append(self.motion)
            self.motion = self.motion @ by_joint
        self.square, self.r, self.J = self._placed(self.motion)
        self.poses = len(problem.q)

    def _placed(self, motion: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        """Place the marker by motions (N, 4, 4): squared residuals, residuals (L,) and derivative (L, 3)."""
        own = self.params.M[self.j]
        best = np.inf, np.zeros(0), np.zeros((0, 3))
        for start in (own, np.nanmean(np.delete(self.params.M, self.j, axis=0), axis=0)):
            best = min(best, self._from(start, motion), key=itemgetter(0))
        return best

    def _from(self, M: FloatArray, motion: FloatArray) -> tuple[float, FloatArray, FloatArray]:
        """Least squares from a place (4,), by steps of Gauss and Newton, until one leads no more down."""
        found, best = self.detections, (np.inf, np.zeros(0), np.zeros((0, 3)))
        weight = (found.weight * found.seen)[..., None]
        for _ in range(_STEPS if np.isfinite(M).all() else 0):
            pixels, G, _ = projection_derivative(self.params.P, self.params.lens, motion @ M)
            r = ((pixels - found.pixels) * weight).ravel()
            by_point = (G @ self.params.P[:, None]) @ motion
            J = (by_point[..., :3] * weight[..., None]).reshape(-1, 3)
            square = float(r @ r)
            if not np.isfinite(square) or square >= best[0] * (1.0 - 1e-6):
                break
            best = square, r, J
            M = M - np.append(np.linalg.lstsq(J, r)[0], 0.0)
        return best

    def motions(self) -> Iterator[_Motion]:
        """Yield separate motions: with a link, or at rest; creeping; slipped at a pose."""
        detections, number = self.detections, int(self.detections.marker[self.j])
        numbers = detections.numbers
        for i, motion in enumerate(self.before):
            carried = sorted(numbers[i:].tolist()) if i else []
            code = "marker_on_link" if i else "standing_markers"
            of = Subject(joints=tuple(carried), markers=(number,))
            yield _Motion(Finding(code, LIMITS, of), self._placed(motion)[0], 1)
        pose_of = np.repeat(np.tile(detections.pose_of, len(detections.seen)), 2)
        times = [("marker_drift", 0, pose_of / max(self.poses - 1, 1) - 0.5)]
        for onset in np.unique(np.linspace(0, self.poses, _ONSETS + 2)[1:-1].astype(int)).tolist():
            times.append(("marker_step", onset, (pose_of >= onset) * 1.0))
        for code, onset, amount in times:
            columns = np.hstack([self.J, self.J * amount[:, None]])
            x = np.linalg.lstsq(columns, self.r)[0]
            square = float(np.square(self.r - columns @ x).sum())
            moved = self.J @ x[3:]
            size = float(np.sqrt(2.0 * np.mean(moved[moved != 0.0] ** 2))) if moved.any() else 0.0
            poses = (int(detections.pose[onset]),) if onset else ()
            of = Subject(markers=(number,), poses=poses)
            yield _Motion(Finding(code, LIMITS, of, size, unit="px"), square, 3 + bool(onset))
