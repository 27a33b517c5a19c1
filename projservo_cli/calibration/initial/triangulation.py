"""Triangulation of each marker where cameras and joints are known: its place by consensus, and its inliers.

A marker has three unknowns and its observations share no more, so the cost is linear in the number
of observations, whatever share of them is wrong.
"""

from collections.abc import Iterator

import numpy as np
from scipy.special import chdtri

from projservo_cli.calibration.bundle_adjustment import LeastSquares
from projservo_cli.calibration.detections import per_block
from projservo_cli.calibration.initial.epipolar import triangulated
from projservo_cli.calibration.prediction import Parameters, projection_derivative
from projservo_cli.geometry.displacements import homogeneous
from projservo_cli.geometry.lens import undistort
from projservo_cli.records import BoolArray, FloatArray, IntArray

# Number of initial points tried for each marker, triangulated from single observations.
_CANDIDATES = 6
# Number of steps from an initial point to the best point near it.
_STEPS = 4
# Probability that noise alone rejects a detection or an observation.
_TAIL = 5e-4
# The same at the end of a track, where most errors are: a track that has slipped stays so.
_TAIL_AT_END = 1e-2
# Maximum number of rounds of tests.
_ROUNDS = 7
# Excess over the worst misfit of a marker from which misfits are rejected together.
_WORST = 0.25
# Maximum residual, px, which also replaces a point without image.
_FAR = 1e6
# Approximate number of observations processed together.
_AT_ONCE = 2**15
# Residual, in σ, above which an error is gross.
_GROSS = 5.0
# Factor on the number by chance, and on its deviation, above which small errors are too many.
_EXCESS = 3.0
# Probability that noise alone makes a small error.
_THOUSANDTH = 1e-3
# Minimum information of a coordinate of a marker, over the best known one.
_OPEN = 1e-9


class Tracks:
    """Detections of a problem, marker by marker, for cameras and joints of given parameters."""

    def __init__(self, problem: LeastSquares, params: Parameters) -> None:
        self.detections, self.params = problem.detections, params
        self.motion = params.motion(problem.joints(params))

    def _grams(self, M: FloatArray, rows: IntArray, sigma: float) -> FloatArray:
        """Gram matrices (V, R, 4, 4) of derivatives and residuals, in σ, of observations of points (R, 3)."""
        detections, params = self.detections, self.params
        motion = self.motion[detections.pose_of[rows]]
        points = (motion[..., :3] @ M[..., None])[..., 0] + motion[..., 3]
        pixels, G, _ = projection_derivative(params.P, params.lens, points)
        weight = np.where(detections.seen[:, rows], detections.weight[:, rows], 0.0)[..., None]
        D = (G @ params.P[:, None]) @ motion[..., :3]
        # A point in the plane of a camera has no image, and fits none.
        residual = np.clip(
            np.nan_to_num((pixels - detections.pixels[:, rows]) * weight, nan=_FAR), -_FAR, _FAR
        )
        columns = np.concatenate([np.nan_to_num(D * weight[..., None]), residual[..., None]], axis=3) / sigma
        return np.asarray(np.swapaxes(columns, 2, 3) @ columns)

    def locate(self, wanted: BoolArray, sigma: float) -> FloatArray:
        """Move the wanted markers (m,) to where most of their detections agree within a noise σ, px.

        Candidates are the current point, and those triangulated from observations by both views, or from
        two poses if there is one view. Markers on a board of known shape stay.
        """
        detections, M = self.detections, self.params.M[:, :3].copy()
        wanted = wanted & ~detections.on_board
        rows = np.flatnonzero(wanted[detections.marker_of])
        best = np.full(len(M), np.inf)
        for number in range(-1, _CANDIDATES):
            points = self._triangulate(max(number, 0), wanted)
            if number < 0:  # the current point, otherwise the median of all
                points = np.where(np.isfinite(M), M, np.nanmedian(np.concatenate([M, points]), axis=0))
            for part, some, marker in self._parts(rows):
                there, loss = self._refine(points[some], part, marker, sigma)
                better = loss < best[some]
                M[some][better], best[some][better] = there[better], loss[better]
        return np.hstack([M, np.ones((len(M), 1))])

    def _triangulate(self, number: int, wanted: BoolArray) -> FloatArray:
        """Points (m, 3) triangulated from observation ``number`` of each marker, NaN if it has fewer.

        One view takes the observation half a track later, too.
        """
        detections, params = self.detections, self.params
        both = np.flatnonzero(detections.both & wanted[detections.marker_of])
        count = np.bincount(detections.marker_of[both], minlength=len(wanted))
        first = np.cumsum(count) - count
        # Spread evenly over the track.
        chosen = np.flatnonzero(count > number)
        step = np.maximum(count[chosen] / _CANDIDATES, 1.0)
        at = (number * step).astype(np.int64)
        views = detections.pair if len(detections.pair) > 1 else 2 * detections.pair
        later = 0 if len(detections.pair) > 1 else count[chosen] // 2
        rows = both[first[chosen] + np.stack([at, (at + later) % count[chosen]])]  # (2, R)
        pair = np.array(views)[:, None]
        pixels = detections.pixels[pair, rows]
        if params.lens is not None:
            pixels = undistort(params.lens[[*views]], pixels)
        M = triangulated(params.P[pair] @ self.motion[detections.pose_of[rows]], homogeneous(pixels))
        points = np.full((len(wanted), 3), np.nan)
        points[chosen] = M[:, :3] / M[:, 3:]
        return points

    def _parts(self, rows: IntArray) -> Iterator[tuple[IntArray, slice, IntArray]]:
        """Yield rows (R,), all of each marker; these markers, and the index of each row's marker (R,)."""
        marker = self.detections.marker_of[rows]
        firsts = np.unique(np.searchsorted(marker, marker[::_AT_ONCE]))
        for part in np.split(np.arange(rows.size), firsts[1:]) if rows.size else []:
            some = slice(marker[part[0]], marker[part[-1]] + 1)
            yield rows[part], some, marker[part] - some.start

    def _refine(
        self, M: FloatArray, rows: IntArray, marker: IntArray, sigma: float
    ) -> tuple[FloatArray, FloatArray]:
        """Refine points (m, 3) by a loss (m,) truncated at each detection; both.

        marker : (R,) index of the marker of each row.
        """
        best, loss = M, np.full(len(M), np.inf)
        limit = 16.0
        for _ in range(_STEPS):
            grams = self._grams(M[marker], rows, sigma)
            square = grams[..., 3, 3]
            here = per_block(marker, np.minimum(square, 16.0).sum(axis=0), len(M))
            better = here < loss
            best, loss = np.where(better[:, None], M, best), np.where(better, here, loss)
            counted = (grams * (square <= limit**2)[..., None, None]).sum(axis=0)
            M = M - _solve_grams(per_block(marker, counted, len(M)))[0]
            limit = max(0.5 * limit, 4.0)
        return best, loss

    def reject_misfits(self, sigma: float, used: BoolArray) -> tuple[FloatArray, BoolArray]:
        """Markers (m, 4), and detections (V, N) that fit the prediction by the others of their marker.

        By χ² of each detection and of each observation by both views, at a noise σ, px. If no more misfit
        than by chance, the given markers and detections ``used`` (V, N).
        """
        M, used = self.params.M.copy(), used.copy()
        for rows, some, marker in self._parts(np.arange(used.shape[1])):
            M[some, :3], used[:, rows] = self._without_misfits(
                M[some, :3], rows, marker, used[:, rows], sigma
            )
        M[self.detections.on_board] = self.params.M[self.detections.on_board]
        return M, used

    def _without_misfits(
        self, M: FloatArray, rows: IntArray, marker: IntArray, used: BoolArray, sigma: float
    ) -> tuple[FloatArray, BoolArray]:
        """Reject misfits of the markers (m, 3) of some rows (R,); points, and detections (V, R) that fit.

        Ends of tracks after a slip are rejected first, then the worst misfits, since these spoil the
        prediction of the rest.
        """
        seen, given = self.detections.seen[:, rows], M
        for number in range(_ROUNDS):
            for last in (False, False, True):
                grams = self._grams(M[marker], rows, sigma)
                counted = grams * used[..., None, None]
                total = per_block(marker, counted.sum(axis=0), len(M))
                M = M if last else M - _solve_grams(total)[0]
            others = total[marker] - counted.sum(axis=0)
            of_others = _solve_grams(others)[1]
            one = np.stack([_solve_grams(others + gram)[1] - of_others for gram in grams])
            two = _solve_grams(others + grams.sum(axis=0))[1] - of_others
            if number == 0:
                if not _slipping(one, seen):
                    return given, used
                used = used & ~_slipped(counted, used, seen, total, marker)
                continue
            # Errors at the end of a track are more likely than elsewhere.
            at_end = _following(used, marker) == used
            tail = np.where(at_end, _TAIL_AT_END, _TAIL)
            limits = chdtri(2, tail), chdtri(4, tail.min(axis=0))
            excess = np.maximum(one / limits[0], two / limits[1]) * seen
            # If both views together do not fit, reject the view that does not, otherwise both.
            alone = one > limits[0]
            fits = seen & np.where((two > limits[1]) & ~alone.any(axis=0), False, ~alone)
            worst = np.zeros(len(M))
            np.maximum.at(worst, marker, np.where(used & ~fits, excess, 0.0).max(axis=0))
            drop = used & ~fits & (excess >= _WORST * worst[marker])
            new = (used & ~drop) | (fits & ~used & (worst[marker] == 0.0))
            if np.array_equal(new, used):
                break
            used = new
        return M, used


def _solve_grams(gram: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Negative steps (…, 3) to the best points, and squares (…,) left there, of summed Grams (…, 4, 4).

    To first order a detection adds to these squares its squared residual over the variance of the prediction
    by the others. Regularized, so that open directions do no harm.
    """
    A, g = gram[..., :3, :3], gram[..., :3, 3]
    size = np.maximum(np.trace(A, axis1=-2, axis2=-1), 1e-300)
    step = np.linalg.solve(A + (_OPEN * size)[..., None, None] * np.eye(3), g[..., None])[..., 0]
    return step, gram[..., 3, 3] - (step * g).sum(axis=-1)


def _following(values: FloatArray | BoolArray, marker: IntArray) -> FloatArray:
    """Sums (V, N, …) of values (V, N, …) over each observation and its successors in the track."""
    sums = np.zeros((len(values), marker.size + 1, *values.shape[2:]))
    sums[:, :-1] = np.cumsum(values[:, ::-1], axis=1)[:, ::-1]
    return sums[:, :-1] - sums[:, np.searchsorted(marker, marker, side="right")]


def _slipped(
    counted: FloatArray, used: BoolArray, seen: BoolArray, total: FloatArray, marker: IntArray
) -> BoolArray:
    """Detections (V, N) of the end of each track, in a view or both, that fits the rest worst, if it misfits.

    It tests whole ends, since two slips among five observations hide each other. At least half of a
    track stays. From Gram matrices of detections that count (V, N, 4, 4), and their sums (m, 4, 4).
    """
    end, count = _following(counted, marker), _following(used, marker)
    whole, kept = (np.bincount(marker, part.sum(axis=0), len(total)) for part in (seen, used))
    of_all, worst, result = _solve_grams(total)[1][marker], np.zeros(len(total)), np.zeros_like(used)
    V = len(used)
    for views in [*([v] for v in range(V)), *([[*range(V)]] if V > 1 else [])]:
        gone = count[views].sum(axis=0)
        may = (gone > 0) & (2.0 * (kept[marker] - gone) >= whole[marker])
        rest = total[marker] - np.where(may[:, None, None], end[views].sum(axis=0), 0.0)
        excess = of_all - _solve_grams(rest)[1] - chdtri(np.maximum(2.0 * gone, 1.0), _TAIL_AT_END)
        highest = np.zeros(len(total))
        np.maximum.at(highest, marker, np.where(may, excess, 0.0))
        first = np.full(len(total), marker.size)
        at = np.flatnonzero(may & (excess > worst[marker]) & (excess == highest[marker]))
        first[marker[at]] = at
        better = (first < marker.size)[marker]
        here = better & (np.arange(marker.size) >= first[marker])
        result[:, better] = False
        result[views] |= here
        worst = np.maximum(worst, highest)
    return result


def _slipping(square: FloatArray, seen: BoolArray) -> bool:
    """Whether many more detections (V, N) have small errors than by chance, as in tracks that slip.

    square : (V, N) squared residuals; an error is small between the bound of chance and gross errors.
    """
    between = np.count_nonzero(seen & (square > chdtri(2, _THOUSANDTH)) & (square <= _GROSS**2))
    chance = _THOUSANDTH * np.count_nonzero(seen)
    return bool(between > _EXCESS * chance + _EXCESS * np.sqrt(chance))
