"""Triangulation of each marker where cameras and joints are known: its place by consensus, and its inliers.

A marker has three unknowns and its sightings nothing else in common, so that all of this is linear in the
number of sightings, whatever share of them is wrong.
"""

from collections.abc import Iterator

import numpy as np
from scipy.special import chdtri

from projservo_cli.calibration.adjustment import LeastSquares
from projservo_cli.calibration.epipolar import homogeneous, triangulated
from projservo_cli.calibration.prediction import Scene, projection_derivative
from projservo_cli.calibration.readings import per_block
from projservo_cli.geometry.lens import straight_views
from projservo_cli.records import BoolArray, FloatArray, IntArray

# Places tried for each marker: those that single sightings show. Steps to the best place near them.
_PLACES, _STEPS = 6, 4
# Chance with which noise alone drops a reading or a sighting, and so at the end of what counts of its track,
# where most is wrong that is: a track that has slipped stays where it slipped to. Rounds of tests.
_TAIL, _TAIL_AT_END, _ROUNDS = 5e-4, 1e-2, 7
# Of sightings of one marker that do not fit, those are dropped at once that are so near to the worst.
_WORST = 0.25
_FAR = 1e6  # px
# Sightings that are dealt with at once, about so many.
_AT_ONCE = 2**15
# Errors beyond so many σ are gross; so many times what chance does is more than chance.
_GROSS, _EXCESS, _THOUSANDTH = 5.0, 3.0, 1e-3
# Least information of a coordinate of a marker, over the best known one.
_OPEN = 1e-9


class Tracks:
    """Readings of a problem, marker by marker, seen by the cameras of a scene."""

    def __init__(self, problem: LeastSquares, scene: Scene) -> None:
        self.readings, self.scene = problem.readings, scene
        self.motion = scene.motion(problem.joints(scene))

    def _grams(self, M: FloatArray, rows: IntArray, sigma: float) -> FloatArray:
        """Gram matrices (2, R, 4, 4) of derivatives and residuals, in σ, of sightings for places (R, 3)."""
        readings, scene = self.readings, self.scene
        motion = self.motion[readings.pose_of[rows]]
        points = (motion[..., :3] @ M[..., None])[..., 0] + motion[..., 3]
        pixels, G, _ = projection_derivative(scene.P, scene.lens, points)
        weight = np.where(readings.seen[:, rows], readings.weight[:, rows], 0.0)[..., None]
        D = (G @ scene.P[:, None]) @ motion[..., :3]
        # A place in the plane of a camera has no image, and fits none.
        residual = np.clip(np.nan_to_num((pixels - readings.pixels[:, rows]) * weight, nan=_FAR), -_FAR, _FAR)
        columns = np.concatenate([np.nan_to_num(D * weight[..., None]), residual[..., None]], axis=3) / sigma
        return np.asarray(np.swapaxes(columns, 2, 3) @ columns)

    def placed(self, wanted: BoolArray, sigma: float) -> FloatArray:
        """Markers (m, 4): those wanted (m,) where most of their readings agree within a noise σ, px.

        Of the places that its sightings by both views show, and its own if it has one.
        """
        readings, M = self.readings, self.scene.M[:, :3].copy()
        rows = np.flatnonzero(wanted[readings.marker_of])
        best = np.full(len(M), np.inf)
        for number in range(-1, _PLACES):
            places = self._shown(max(number, 0), wanted)
            if number < 0:  # where it is, else among the others, if no sighting shows a place
                places = np.where(np.isfinite(M), M, np.nanmedian(np.concatenate([M, places]), axis=0))
            for part, some, marker in self._parts(rows):
                there, loss = self._stepped(places[some], part, marker, sigma)
                better = loss < best[some]
                M[some][better], best[some][better] = there[better], loss[better]
        return np.hstack([M, np.ones((len(M), 1))])

    def _shown(self, number: int, wanted: BoolArray) -> FloatArray:
        """Places (m, 3) that the sightings of this number by both views show, NaN where there are fewer."""
        readings, scene = self.readings, self.scene
        both = np.flatnonzero(readings.both & wanted[readings.marker_of])
        count = np.bincount(readings.marker_of[both], minlength=len(wanted))
        first = np.cumsum(count) - count
        # Evenly over the track.
        chosen = np.flatnonzero(count > number)
        step = np.maximum(count[chosen] / _PLACES, 1.0)
        rows = both[first[chosen] + (number * step).astype(np.int64)]
        pixels = readings.pixels[:, rows]
        if scene.lens is not None:
            pixels = straight_views(scene.lens, pixels)
        M = triangulated(scene.P[:, None] @ self.motion[readings.pose_of[rows]], homogeneous(pixels))
        places = np.full((len(wanted), 3), np.nan)
        places[chosen] = M[:, :3] / M[:, 3:]
        return places

    def _parts(self, rows: IntArray) -> Iterator[tuple[IntArray, slice, IntArray]]:
        """Some rows (R,) at a time, all of each marker; these markers, and which of them is whose (R,)."""
        marker = self.readings.marker_of[rows]
        firsts = np.unique(np.searchsorted(marker, marker[::_AT_ONCE]))
        for part in np.split(np.arange(rows.size), firsts[1:]) if rows.size else []:
            some = slice(marker[part[0]], marker[part[-1]] + 1)
            yield rows[part], some, marker[part] - some.start

    def _stepped(
        self, M: FloatArray, rows: IntArray, marker: IntArray, sigma: float
    ) -> tuple[FloatArray, FloatArray]:
        """Places (m, 3) after steps to where more agrees, and losses (m,), truncated at each reading.

        Of some markers, to which rows (R,) belong as ``marker`` (R,) tells.
        """
        best, loss = M, np.full(len(M), np.inf)
        limit = 16.0
        for _ in range(_STEPS):
            grams = self._grams(M[marker], rows, sigma)
            square = grams[..., 3, 3]
            here = per_block(marker, np.minimum(square, 16.0).sum(axis=0), len(M))
            better = here < loss
            best, loss = np.where(better[:, None], M, best), np.where(better, here, loss)
            M = (
                M
                - _best(
                    per_block(marker, (grams * (square <= limit**2)[..., None, None]).sum(axis=0), len(M))
                )[0]
            )
            limit = max(0.5 * limit, 4.0)
        return best, loss

    def tested(self, sigma: float, used: BoolArray) -> tuple[FloatArray, BoolArray]:
        """Markers (m, 4), and readings (2, N) that fit what the other sightings of their marker predict.

        By χ² of each reading and of each sighting by both views, at a noise σ, px; those given (2, N) where
        no more than chance are in doubt.
        """
        M, used = self.scene.M.copy(), used.copy()
        for rows, some, marker in self._parts(np.arange(used.shape[1])):
            M[some, :3], used[:, rows] = self._sifted(M[some, :3], rows, marker, used[:, rows], sigma)
        return M, used

    def _sifted(
        self, M: FloatArray, rows: IntArray, marker: IntArray, used: BoolArray, sigma: float
    ) -> tuple[FloatArray, BoolArray]:
        """The same of the markers (m, 3) of some rows (R,).

        The ends of tracks go first from which on nothing fits, then the worst, since they spoil what is
        predicted of the rest.
        """
        seen, given = self.readings.seen[:, rows], M
        for number in range(_ROUNDS):
            for last in (False, False, True):
                grams = self._grams(M[marker], rows, sigma)
                counted = grams * used[..., None, None]
                total = per_block(marker, counted.sum(axis=0), len(M))
                M = M if last else M - _best(total)[0]
            others = total[marker] - counted.sum(axis=0)
            of_others = _best(others)[1]
            one = np.stack([_best(others + gram)[1] - of_others for gram in grams])
            two = _best(others + grams.sum(axis=0))[1] - of_others
            if number == 0:
                if not _slipping(one, seen):
                    return given, used
                used = used & ~_slipped(counted, used, seen, total, marker)
                continue
            # What is wrong at the end of a track is so much more likely than elsewhere.
            at_end = _following(used, marker) == used
            tail = np.where(at_end, _TAIL_AT_END, _TAIL)
            limits = chdtri(2, tail), chdtri(4, tail.min(axis=0))
            excess = np.maximum(one / limits[0], two / limits[1]) * seen
            # Where both views together do not fit, the view alone that does not, else both.
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


def _best(gram: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Steps (…, 3) back to the best places, and the squares (…,) left there, of sums (…, 4, 4) of Grams.

    To first order what a reading adds to these squares is what it misses by, squared, in units of the
    variance of what the others predict. Regular whatever is left open.
    """
    A, g = gram[..., :3, :3], gram[..., :3, 3]
    size = np.maximum(np.trace(A, axis1=-2, axis2=-1), 1e-300)
    step = np.linalg.solve(A + (_OPEN * size)[..., None, None] * np.eye(3), g[..., None])[..., 0]
    return step, gram[..., 3, 3] - (step * g).sum(axis=-1)


def _following(values: FloatArray | BoolArray, marker: IntArray) -> FloatArray:
    """Sums (2, N, …) of values (2, N, …) over each sighting and those that follow in its track."""
    sums = np.zeros((2, marker.size + 1, *values.shape[2:]))
    sums[:, :-1] = np.cumsum(values[:, ::-1], axis=1)[:, ::-1]
    return sums[:, :-1] - sums[:, np.searchsorted(marker, marker, side="right")]


def _slipped(
    counted: FloatArray, used: BoolArray, seen: BoolArray, total: FloatArray, marker: IntArray
) -> BoolArray:
    """Readings (2, N) of the end of each track, in a view or both, that fits the rest worst, if none does.

    Where two of five sightings slip, each alone hides what the other misses by. At least half of a track
    stays. From Gram matrices of what counts (2, N, 4, 4), and their sums (m, 4, 4).
    """
    end, count = _following(counted, marker), _following(used, marker)
    whole, kept = (np.bincount(marker, part.sum(axis=0), len(total)) for part in (seen, used))
    of_all, most, result = _best(total)[1][marker], np.zeros(len(total)), np.zeros_like(used)
    for views in ([0], [1], [0, 1]):
        gone = count[views].sum(axis=0)
        may = (gone > 0) & (2.0 * (kept[marker] - gone) >= whole[marker])
        rest = total[marker] - np.where(may[:, None, None], end[views].sum(axis=0), 0.0)
        excess = of_all - _best(rest)[1] - chdtri(np.maximum(2.0 * gone, 1.0), _TAIL_AT_END)
        highest = np.zeros(len(total))
        np.maximum.at(highest, marker, np.where(may, excess, 0.0))
        first = np.full(len(total), marker.size)
        at = np.flatnonzero(may & (excess > most[marker]) & (excess == highest[marker]))
        first[marker[at]] = at
        better = (first < marker.size)[marker]
        here = better & (np.arange(marker.size) >= first[marker])
        result[:, better] = False
        result[views] |= here
        most = np.maximum(most, highest)
    return result


def _slipping(square: FloatArray, seen: BoolArray) -> bool:
    """Whether many more readings (2, N) are somewhat off than by chance, as of tracks that slip.

    By squares of what they miss by: between what each thousandth exceeds and gross errors.
    """
    between = np.count_nonzero(seen & (square > chdtri(2, _THOUSANDTH)) & (square <= _GROSS**2))
    chance = _THOUSANDTH * np.count_nonzero(seen)
    return bool(between > _EXCESS * chance + _EXCESS * np.sqrt(chance))
