"""Each marker by itself, where cameras and joints are known: its place by consensus, which sightings fit it.

A marker has three unknowns and its sightings nothing else in common, so that all of this is linear in the
number of sightings, whatever share of them is wrong.
"""

import numpy as np
from scipy.special import chdtri

from projservo_cli.calibration.adjustment import LeastSquares
from projservo_cli.calibration.forward import Scene, projection_derivative
from projservo_cli.calibration.readings import per_block
from projservo_cli.geometry.lens import straight_views
from projservo_cli.records import BoolArray, FloatArray, IntArray

# Places tried for each marker: those that single sightings show. Steps to the best place near them.
_PLACES, _STEPS = 6, 4
# Chance with which noise alone drops a reading or a sighting, and so where another sighting of the marker
# does not fit; rounds of tests.
_TAIL, _TAIL_OF_DOUBT, _ROUNDS = 1e-3, 4e-3, 6
# Of sightings of one marker that do not fit, those are dropped at once that are so near to the worst.
_WORST = 0.25
_FAR = 1e6  # px
# Sightings that are dealt with at once, about so many.
_AT_ONCE = 2**15
# Errors beyond so many σ are gross; so many times what chance does is more than chance.
_GROSS, _EXCESS = 5.0, 3.0
# Least information of a coordinate of a marker, over the best known one.
_OPEN = 1e-9


class Tracks:
    """Readings of a problem, marker by marker, seen by the cameras of a scene."""

    def __init__(self, problem: LeastSquares, scene: Scene) -> None:
        self.readings, self.scene = problem.readings, scene
        self.motion = scene.motion(problem.joints(scene))

    def _residual(self, M: FloatArray, rows: IntArray) -> tuple[FloatArray, FloatArray]:
        """Residuals (2, R, 2) of some sightings for places (R, 3), weighed, and derivatives (2, R, 2, 3)."""
        readings, scene = self.readings, self.scene
        motion = self.motion[readings.pose_of[rows]]
        points = (motion[..., :3] @ M[..., None])[..., 0] + motion[..., 3]
        pixels, G, _ = projection_derivative(scene.P, scene.lens, points)
        weight = np.where(readings.seen[:, rows], readings.weight[:, rows], 0.0)[..., None]
        D = (G @ scene.P[:, None]) @ motion[..., :3]
        # A place in the plane of a camera has no image, and fits none.
        residual = np.clip(np.nan_to_num((pixels - readings.pixels[:, rows]) * weight, nan=_FAR), -_FAR, _FAR)
        return residual, np.nan_to_num(D * weight[..., None])

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
                places = np.where(np.isfinite(M), M, _middle(np.concatenate([M, places])))
            places, loss = self._improved(places, rows, sigma)
            better = loss < best
            M[better], best[better] = places[better], loss[better]
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
        P = scene.P[:, None] @ self.motion[readings.pose_of[rows]]
        lines = (pixels[..., None] * P[:, :, 2:] - P[:, :, :2]).swapaxes(0, 1).reshape(len(rows), 4, 4)
        lines /= np.linalg.norm(lines[..., :3], axis=2, keepdims=True)
        A = np.swapaxes(lines[..., :3], 1, 2)
        normal = A @ lines[..., :3]
        normal += _OPEN * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        places = np.full((len(wanted), 3), np.nan)
        places[chosen] = -np.linalg.solve(normal, A @ lines[..., 3:])[..., 0]
        return places

    def _improved(self, M: FloatArray, rows: IntArray, sigma: float) -> tuple[FloatArray, FloatArray]:
        """Places (m, 3) after steps to where more agrees, and the losses (m,), truncated at each reading."""
        marker, best, loss = self.readings.marker_of[rows], M.copy(), np.zeros(len(M))
        firsts = np.unique(np.searchsorted(marker, marker[::_AT_ONCE]))
        for part in np.split(np.arange(rows.size), firsts[1:]) if rows.size else []:
            some = slice(marker[part[0]], marker[part[-1]] + 1)
            best[some], loss[some] = self._stepped(M[some], rows[part], marker[part] - some.start, sigma)
        return best, loss

    def _stepped(
        self, M: FloatArray, rows: IntArray, marker: IntArray, sigma: float
    ) -> tuple[FloatArray, FloatArray]:
        """The same of some markers (m, 3), to which rows (R,) belong as ``marker`` (R,) tells."""
        best, loss = M, np.full(len(M), np.inf)
        limit = 16.0 * sigma
        for _ in range(_STEPS):
            residual, D = self._residual(M[marker], rows)
            square = (residual**2).sum(axis=2) / sigma**2
            here = per_block(marker, np.minimum(square, 16.0).sum(axis=0), len(M))
            better = here < loss
            best, loss = np.where(better[:, None], M, best), np.where(better, here, loss)
            A, g = self._normal(marker, residual, D, square <= (limit / sigma) ** 2, len(M))
            M = M - np.linalg.solve(A, g[..., None])[..., 0]
            limit = max(0.5 * limit, 4.0 * sigma)
        return best, loss

    def _normal(
        self, marker: IntArray, residual: FloatArray, D: FloatArray, used: BoolArray, count: int
    ) -> tuple[FloatArray, FloatArray]:
        """Normal equations (m, 3, 3), (m, 3) of the readings used, regular whatever is left open."""
        D = D * used[..., None, None]
        A = per_block(marker, (np.swapaxes(D, 2, 3) @ D).sum(axis=0), count)
        g = per_block(marker, (np.swapaxes(D, 2, 3) @ residual[..., None])[..., 0].sum(axis=0), count)
        size = np.maximum(np.trace(A, axis1=1, axis2=2), 1e-300)
        return A + (_OPEN * size)[:, None, None] * np.eye(3), g

    def tested(self, sigma: float, used: BoolArray) -> tuple[FloatArray, BoolArray]:
        """Markers (m, 4), and readings (2, N) that fit what the other sightings of their marker predict.

        By χ² of each reading and of each sighting by both views, at a noise σ, px; the worst go first, since
        they spoil what is predicted of the rest. Those given (2, N) where no more than chance are in doubt.
        """
        readings, M = self.readings, self.scene.M[:, :3].copy()
        rows, marker = np.arange(readings.marker_of.size), readings.marker_of
        strict, loose = (chdtri(np.array([2, 4]), tail) * sigma**2 for tail in (_TAIL, _TAIL_OF_DOUBT))
        for number in range(_ROUNDS):
            for _ in range(2):
                residual, D = self._residual(M[marker], rows)
                A, g = self._normal(marker, residual, D, used, len(M))
                M = M - np.linalg.solve(A, g[..., None])[..., 0]
            residual, D = self._residual(M[marker], rows)
            A, _ = self._normal(marker, residual, D, used, len(M))
            one, two = _deleted(A[marker], residual, D, used)
            if number == 0 and not _slipping(one, readings.seen, sigma):
                return self.scene.M, used
            doubt = np.bincount(marker, (readings.seen & ~used).any(axis=0), len(M)) > 0
            limits = np.where(doubt[marker], loose[:, None], strict[:, None])
            excess = np.maximum(one / limits[0], two / limits[1]) * readings.seen
            # Where both views together do not fit, the view alone that does not, else both.
            alone = one > limits[0]
            fits = readings.seen & np.where((two > limits[1]) & ~alone.any(axis=0), False, ~alone)
            worst = np.zeros(len(M))
            np.maximum.at(worst, marker, np.where(used & ~fits, excess, 0.0).max(axis=0))
            drop = used & ~fits & (excess >= _WORST * worst[marker])
            new = (used & ~drop) | (fits & ~used & (worst[marker] == 0.0))
            if np.array_equal(new, used):
                break
            used = new
        return np.hstack([M, np.ones((len(M), 1))]), used


def _middle(places: FloatArray) -> FloatArray:
    """Median (3,) of the places (m, 3) that are known."""
    known = places[np.isfinite(places[:, 0])]
    return np.median(known, axis=0) if len(known) else np.zeros(3)


def _slipping(square: FloatArray, seen: BoolArray, sigma: float) -> bool:
    """Whether many more readings (2, N) are somewhat off than by chance, as of tracks that slip.

    By squares of what they miss by: between what each thousandth exceeds and gross errors.
    """
    low, high = chdtri(2, _TAIL) * sigma**2, _GROSS**2 * sigma**2
    between = np.count_nonzero(seen & (square > low) & (square <= high))
    chance = _TAIL * np.count_nonzero(seen)
    return bool(between > _EXCESS * chance + _EXCESS * np.sqrt(chance))


def _deleted(
    A: FloatArray, residual: FloatArray, D: FloatArray, used: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Squares, in units of their variance, by which sightings miss what the others predict of them.

    Of each reading (2, N) and of both views together (N,): with what a sighting adds to the normal matrix
    A (N, 3, 3) of its marker taken away.
    """
    N = residual.shape[1]
    D, r = (part.swapaxes(0, 1).reshape(N, 4, -1) for part in (D, residual))
    own = D * np.repeat(used.T, 2, axis=1)[..., None]
    without = A - np.swapaxes(own, 1, 2) @ own
    values, axes = np.linalg.eigh(without)
    information = np.trace(A, axis1=1, axis2=2)
    least = 1e-6 * np.maximum(information, np.median(information))[:, None]
    inverse = (axes / np.maximum(values, least)[:, None]) @ np.swapaxes(axes, 1, 2)
    r = r + D @ (inverse @ (np.swapaxes(own, 1, 2) @ r))
    V = np.eye(4) + D @ inverse @ np.swapaxes(D, 1, 2)
    two = (np.swapaxes(r, 1, 2) @ np.linalg.solve(V, r))[:, 0, 0]
    one = [
        (np.swapaxes(part, 1, 2) @ np.linalg.solve(V[:, at, at], part))[:, 0, 0]
        for at in (slice(0, 2), slice(2, 4))
        for part in (r[:, at],)
    ]
    return np.array(one), two
