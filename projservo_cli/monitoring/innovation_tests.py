"""Innovation statistics: how images may differ from their prediction without a fault, and tests of that."""

from collections import deque
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_solve, eigh, solve_triangular
from scipy.special import chdtri

from projservo_cli.calibration.detections import MIN_SIGMA, per_rad
from projservo_cli.calibration.prediction import (
    CAMERA,
    Images,
    Parameters,
    dense_pixel_changes,
    errors_of,
    from_reference,
    parameters_from,
)
from projservo_cli.monitoring.frame_pairs import FramePair
from projservo_cli.records import TOOL, BoolArray, Calibration, FloatArray, IntArray

# Observations in a row that must agree: one may be blurred, or a marker taken for another.
WINDOW = 3
# Chance that a run of sound observations is called faulty, were all windows independent. They overlap: it
# comes to a twentieth of that. More of it is spent on the first observations.
_FALSE_ALARM, _SOON = 1e-2, 10.0
# Windows of the search for an onset, one longer than the other by this factor.
_LONGER = 1.5
# Error of the first order of a prediction, at most, as a share of the calibration's own noise.
_BEYOND_FIRST_ORDER = 0.02
# Lasting errors of a joint, by backlash and counts, differ between two times by √2 of their deviation.
_LASTING = np.sqrt(2.0)
# The χ² of the errors that corners keep in one view is taken at this chance, for those that a fault touches:
# two deviations rms for one corner, 1.3 for a camera.
_LASTING_CORNERS = 3e-3
# Size of a direction over the largest, below which it is round-off.
_DEPENDENT = 1e-9
# Differences between successive frames: of one view in motion, of one view at rest, and of two views.
_IN_MOTION, _AT_REST, _BETWEEN_VIEWS = range(3)
# A corner errs as detections of the calibration from within about this angle, rad; this number of typical
# ones counts with them.
_SLANT, _PRIOR_SIGHTINGS = 0.25, 4.0
# Bias, in deviations of the noise, of all corners in a view that the calibration has not seen.
_UNUSUAL = 1.0
# Joints (rad or m) and instants (s) are known no better than this, even if stated better.
LEAST_ERROR = 1e-6
# A direction counts if it keeps this share of its size after the others; ridge for solving.
_RANK, _RIDGE = 1e-6, 1e-9
# Frames that are so near show joints of one reading, s.
_AT_ONCE_S = 1e-4
# A view lasts while markers move by no more than this, px rms; its observations are forgotten at this rate.
_SAME_VIEW_PX, _FORGET = 20.0, 1.0 - 1.0 / 30.0
# Markers that move by no more, px rms, show the same pixels; coordinates of such observations that suffice.
_AT_REST_PX, _ENOUGH = 0.2, 100.0
# Differences between this number of frames at rest show how a detection trembles: the median of χ² with two
# degrees of freedom, which is beyond the second number once in ten thousand.
_DIFFERENCES, _MEDIAN, _MEDIAN_AT_MOST = 9, 1.386, 5.6
# χ² of a detection that may be a single outlier: once in ten thousand by chance.
_OFF_ALONE = 18.4
# Minimum information on a direction, in units of its deviations: one that no image shows has some.
_LEAST_INFORMATION = 1e-12
# Share of the views after which a fault that grows is seen nearly whole.
_NEARLY_WHOLE = 2.0 / 3.0
# Deviations from which a difference is distinguished from none.
DISTINCT = 2.0
# Share of the markers of a view that may be single outliers before the view itself is one.
_MOST_ASIDE = 0.5


class Residual(NamedTuple):
    """Residuals of one observation: rows by view, marker and coordinate, zero where unseen."""

    seen: BoolArray  # (V, m)
    noise: FloatArray  # (V, m) px
    predicted: FloatArray  # (V, m, 2) px
    r: FloatArray  # (2 V m,) seen less predicted, px
    B: FloatArray  # (2 V m, e) derivatives by the errors of the calibration, in units of their deviations
    F: FloatArray  # (2 V m, f) derivatives by possible errors
    R: FloatArray  # (2 V m, 2 V m) covariance of one observation but for the errors of the calibration, px²

    def without(self, aside: BoolArray) -> "Residual":
        """The same without some detections (V, m)."""
        rows = np.repeat(~aside.ravel(), 2)
        r, B, F = (part * (rows if part.ndim == 1 else rows[:, None]) for part in (self.r, self.B, self.F))
        return self._replace(seen=self.seen & ~aside, r=r, B=B, F=F)


class Sums(NamedTuple):
    """Normal equations of observations, all of one view with their common weight."""

    views: int  # views that they come from
    t: float  # when the last was taken, s from the first observation
    normal: FloatArray  # (c, c) of errors of the calibration, of possible errors, and of the residual
    by_corner: FloatArray  # (c - 1, 2 V m) its last column by coordinates that all err by one deviation
    weight: float  # single observations that they are worth
    weight_squares: float  # Σ of its square over views
    seen: FloatArray  # (V, m) coordinates seen of each marker
    bias: FloatArray  # (V, m) squared errors of the model that they may have, over the noise

    def plus(self, other: "Sums", factor: float = 1.0) -> "Sums":
        """Sums and later ones times a factor."""
        return Sums(
            views=self.views + other.views,
            t=other.t,
            normal=self.normal + factor * other.normal,
            by_corner=self.by_corner + factor * other.by_corner,
            weight=self.weight + factor * other.weight,
            weight_squares=self.weight_squares + factor**2 * other.weight_squares,
            seen=self.seen + factor * other.seen,
            bias=self.bias + factor * other.bias,
        )


class ErrorModel:
    """Covariance of images by a calibration, and directions in which faults would change them.

    At given joint readings the calibration predicts the pixels of every marker. Detections differ by

        r = J δ + J_q δq + J_q q̇ δd + c + ε

    to first order: δ ~ N(0, Σ), errors of the calibration, the same all along; δq of the joint readings, the
    same in all views of one instant; δd of the instant of each frame; c, errors of corners that last while
    the view does, and ε, new in each frame, of the variance σ² together.
    """

    def __init__(self, calibration: Calibration, sigma_px: float) -> None:
        m, n, V = len(calibration.M), len(calibration.H_hat_0), len(calibration.P)
        self.calibration, self.scene = calibration, parameters_from(calibration)
        self.errors, self.e = errors_of(calibration), calibration.sqrt_cov_shared.shape[1] + 3 * m
        fit = calibration.fit
        nonlinear = _BEYOND_FIRST_ORDER * fit.sigma_px
        self._least = max(nonlinear, MIN_SIGMA)
        self._sigma, self._of_views = max(sigma_px, self._least), relative_noise(calibration)
        self._stated = self._sigma / max(fit.sigma_px, MIN_SIGMA) * (fit.sigma_scale or 1.0)
        self.bias_px = max(fit.model_px, nonlinear)
        sigma_q = fit.sigma_q or 0.0
        if fit.sigma_q_interval is not None:
            sigma_q = max(sigma_q, float(fit.sigma_q_interval[1]))
        self.sigma_q = np.maximum(sigma_q * per_rad(calibration.prismatic), LEAST_ERROR)
        # Directions of points at infinity, of rigid motions, and of changes of a camera but for its scale.
        self.directions = np.linalg.svd(calibration.a_inf[None])[2][1:]
        self.twists = rigid_motions(calibration.H_hat_0, self.directions, calibration.a_inf)
        self.cameras = [np.linalg.svd(P.reshape(1, CAMERA))[2][1:].T for P in calibration.P]
        self.parts, self.touches, self.f = _directions_of(V, n, m, len(self.twists))
        self.fixed = 2 * n + V  # columns of joints, their drift and instants, before the columns of cameras
        self.tool = slice(self.f - 2 * len(self.twists), self.f - len(self.twists))  # columns of its motions
        # Squares (K, V, m) by which corners erred while it was recorded, and where they were seen from.
        self._squares = calibration.corner_squares
        if self._squares is not None and calibration.corner_q is not None:
            self._counts: BoolArray = np.isfinite(self._squares)
            self._typical = float(self._squares[self._counts].mean()) if self._counts.any() else 1.0
            q = from_reference(calibration, calibration.corner_q)
            self._rays = _rays(self.scene, self.directions, q)

    def noise(self, seen: BoolArray, stated: FloatArray | None) -> FloatArray:
        """Standard deviation (V, m) of pixels, px: those stated, as the calibration found them, if any."""
        common = self._common(seen.shape)
        if stated is None:
            return common.copy()
        return np.where(stated > 0.0, np.maximum(self._stated * stated, self._least), common)

    def raised(self, stated: FloatArray) -> FloatArray:
        """Return deviations (V, m) as stated, px, raised to those that hold if none are stated."""
        return np.fmax(stated, self._common(stated.shape) / self._stated)

    def _common(self, shape: tuple[int, ...]) -> FloatArray:
        """Deviations (V, m) of pixels that hold if none are stated, px."""
        return np.broadcast_to(np.maximum(self._sigma * self._of_views, self._least), shape)

    def residual(self, pair: FramePair) -> Residual:
        """Residuals of an observation and their derivatives, each view at its own joints."""
        scene, away = self.scene, from_reference(self.calibration, pair.q)
        (V, n), m = away.shape, len(scene.M)
        views, rows = np.arange(V), 2 * V * m
        predicted = scene.predict(away)[views, views]
        r = pair.images - predicted
        seen = np.isfinite(r[..., 0])
        noise = pair.noise * np.sqrt(self._corner_variance(away))
        at = scene.everywhere(away)
        B = dense_pixel_changes(scene, self.errors, away, at)[views, views]
        F = self._fault_derivative(at.of_own_poses(), pair)
        for part in (r, B, F):
            part[~seen] = 0.0
        F = F.reshape(rows, -1)
        J_q, sigma_t = F[:, :n], F[:, 2 * n : self.fixed] * pair.sigma_t
        # Errors of joints are the same in all views, but for their motion between frames: then readings are
        # not straight between each other, and round otherwise.
        new = np.concatenate([J_q * self.sigma_q, sigma_t], axis=1)
        if np.ptp(pair.t) > _AT_ONCE_S:
            between = J_q * np.hypot(pair.curved, np.minimum(np.ptp(pair.q, axis=0), self.sigma_q))
            view_of = np.repeat(views, 2 * m)[:, None]
            new = np.concatenate([new, *(between * (view_of == v) for v in views)], axis=1)
        # An instant so uncertain that the arm moves on a curve: half the square of the angle.
        bend = 0.5 * np.abs(pair.q_dot).sum(axis=1).max() * (sigma_t @ pair.sigma_t)
        R = new @ new.T + np.diag(np.repeat(noise.ravel(), 2) ** 2 + bend**2)
        return Residual(
            seen=seen, noise=noise, predicted=predicted, r=r.ravel(), B=B.reshape(rows, -1), F=F, R=R
        )

    def _corner_variance(self, away: FloatArray) -> FloatArray:
        """Variance of corners (V, m) over their noise, as detections of the calibration from near them err.

        A corner that is seen from another side, or under another slant, errs otherwise.
        away : (V, n) joints of the scene at each view, from the reference.
        """
        if self._squares is None:
            return np.ones((len(away), len(self.scene.M)))
        every = range(len(away))
        rays = np.stack([_rays(self.scene, self.directions, away[v : v + 1])[0, v] for v in every])
        apart = 2.0 * (1.0 - np.abs(np.einsum("vmx,kwmx->vmkw", rays, self._rays)))
        near = np.exp(-0.5 * apart / _SLANT**2) * self._counts.transpose(2, 0, 1)
        squares = np.where(self._counts, self._squares, 0.0).transpose(2, 0, 1)
        found = (near * squares).sum(axis=(2, 3)) + _PRIOR_SIGHTINGS * self._typical
        return np.asarray(np.maximum(found / (near.sum(axis=(2, 3)) + _PRIOR_SIGHTINGS), 1.0))

    def slants(self, q: FloatArray) -> int:
        """Number of sides, between which corners err differently, that joints (K, n) show of the tool."""
        away = from_reference(self.calibration, q)
        rays = _rays(self.scene, self.directions, away).reshape(len(q), -1, 3)
        sides: list[FloatArray] = []
        for ray in rays:
            apart = (2.0 * (1.0 - np.abs((ray * side).sum(axis=1)).mean()) for side in sides)
            if all(square > _SLANT**2 for square in apart):
                sides.append(ray)
        return len(sides)

    def _fault_derivative(self, at: Images, pair: FramePair) -> FloatArray:
        """Derivatives (V, m, 2, f) of pixels by possible errors, in the order of ``_directions_of``."""
        (V, n), m, d = pair.q.shape, len(self.scene.M), len(self.twists)
        F = np.zeros((V, m, 2, self.f))
        J_q = at.by_joint(self.scene.H_hat).reshape(V, m, 2, n)
        J_q = -J_q[..., ::-1] if self.calibration.mount == TOOL else J_q
        F[..., :n], F[..., n : 2 * n] = J_q, J_q * pair.t[:, None, None, None]
        by_marker, first = (at.by_point[n] @ self.directions.T).reshape(V, m, 2, 3), self.fixed
        by_camera = at.by_camera.reshape(V, m, 2, CAMERA)
        for v in range(V):
            F[v, ..., 2 * n + v] = -J_q[v] @ pair.q_dot[v]
            F[v, ..., first : first + CAMERA - 1] = by_camera[v] @ self.cameras[v]
            first += CAMERA - 1
        for j in range(m):
            F[:, j, :, first : first + 3] = by_marker[:, j]
            first += 3
        F[..., first : first + d] = at.by_motion(self.twists, -1).reshape(V, m, 2, d)
        F[..., first + d :] = at.by_motion(self.twists, 0).reshape(V, m, 2, d)
        return F

    def sums(self, residual: Residual, t: float) -> Sums:
        """Contribution of one observation to the normal equations."""
        rows = np.concatenate([residual.B, residual.F, residual.r[:, None]], axis=1)
        root = np.linalg.cholesky(residual.R)
        rows = solve_triangular(root, rows, lower=True, check_finite=False)
        by_corner = solve_triangular(root, rows[:, :-1], lower=True, trans="T", check_finite=False).T
        return Sums(
            views=1,
            t=t,
            normal=rows.T @ rows,
            by_corner=by_corner * np.repeat(residual.noise.ravel(), 2),
            weight=1.0,
            weight_squares=1.0,
            seen=np.where(residual.seen, 2.0, 0.0),
            bias=2.0 * residual.seen * (self.bias_px / residual.noise) ** 2,
        )

    def nothing(self) -> Sums:
        """Sums of no observation."""
        c = self.e + self.f + 1
        none = np.zeros((len(self.calibration.P), len(self.calibration.M)))
        return Sums(
            views=0,
            t=0.0,
            normal=np.zeros((c, c)),
            by_corner=np.zeros((c - 1, 2 * none.size)),
            weight=0.0,
            weight_squares=0.0,
            seen=none,
            bias=none,
        )

    def root(self, sums: Sums) -> FloatArray:
        """Root (e, e) of the information on the errors of the calibration."""
        return np.asarray(np.linalg.cholesky(np.eye(self.e) + sums.normal[: self.e, : self.e]))

    def contradicts(self, sums: Sums) -> bool:
        """Whether sums put the calibration where it is not by chance, once in ten thousand."""
        root = self.root(sums)
        off = cho_solve((root, True), sums.normal[: self.e, -1], check_finite=False)
        return bool(off @ off > chdtri(self.e, 1e-4))

    def persistent_prior(self, seconds: float, sigma_t: FloatArray) -> FloatArray:
        """Information (2 n + V, 2 n + V) on errors of joints, their drift with time, and of instants.

        Over that time joints err by a straight line, its middle and its slope by lasting errors.
        """
        n = len(self.sigma_q)
        weight = np.diag((_LASTING * np.concatenate([self.sigma_q, self.sigma_q, sigma_t])) ** -2.0)
        line = np.eye(self.fixed)
        line[:n, n : 2 * n] = 0.5 * seconds * np.eye(n)
        line[n : 2 * n, n : 2 * n] = max(seconds, LEAST_ERROR) / np.sqrt(12.0) * np.eye(n)
        return np.asarray(line.T @ weight @ line)


class MemoryState(NamedTuple):
    """Observations that agreed up to one time."""

    closed: tuple[Sums, ...]  # up to the end of each view, of the older ones fewer
    view: Sums  # observations of the view that lasts, fading
    length: float  # how many these are
    first: FloatArray | None  # (V, m, 2) px predicted at its beginning

    @property
    def views(self) -> int:
        """Number of views."""
        return self.closed[-1].views + (self.length > 0.0)


class _Memory:
    """Observations that agreed, view by view: observations of one view share the errors of their corners."""

    def __init__(self, errors: ErrorModel) -> None:
        self._errors = errors
        self.state = MemoryState((errors.nothing(),), errors.nothing(), 0.0, None)
        self._total: Sums | None = None  # as last asked for
        # The last observation, as ``learn`` is given it.
        self._before: tuple[Residual, BoolArray, bool] | None = None
        # Variance of differences from observation to observation, over σ²: in motion, at rest, and between
        # views.
        self._squares, self._freedom = np.zeros(3), np.zeros(3)
        # Square of each detection (V, m) from one observation at rest to the next, px².
        self._steps: deque[FloatArray] = deque(maxlen=_DIFFERENCES)

    def noise(self, stated: FloatArray) -> FloatArray:
        """Standard deviations (V, m) of pixels, px: those stated, or as they tremble if that is more.

        The median of differences at rest gives it: a step, such as a fault makes, does not move it.
        """
        if len(self._steps) < _DIFFERENCES:
            return stated
        square = np.median(np.array(self._steps), axis=0)
        more = square > _MEDIAN_AT_MOST * stated**2
        return np.sqrt(square / _MEDIAN, where=more, out=stated.copy())

    @property
    def fresh(self) -> float:
        """Share of the variance of a corner that is new in each frame, by differences in a view.

        No more than is sure; a finder that makes the same error in each frame has none.
        """
        return self._sure_share(_AT_REST if self._freedom[_AT_REST] >= _ENOUGH else _IN_MOTION)

    @property
    def persistent(self) -> float:
        """Greatest share of the variance of a corner that lasts beyond a view, by differences of views."""
        return 1.0 - max(self.fresh, self._sure_share(_BETWEEN_VIEWS))

    def _sure_share(self, kind: int) -> float:
        """Share of the variance that differences of a kind have at least, by two deviations."""
        if not self._freedom[kind]:
            return 0.0
        sure = 1.0 - 2.0 * np.sqrt(2.0 / self._freedom[kind])
        return float(np.clip(self._squares[kind] / self._freedom[kind], 0.0, 1.0) * max(0.0, sure))

    def worth(self, observations: float) -> float:
        """Return the effective number of independent observations of a view."""
        return observations / (self.fresh + observations * (1.0 - self.fresh)) if observations else 0.0

    @property
    def total(self) -> Sums:
        """Sums of all observations."""
        if self._total is None:
            self._total = before = self.state.closed[-1]
            if count := self.state.length:
                worth = self.worth(count)
                squares = before.weight_squares + worth**2
                self._total = before.plus(self.state.view, worth / count)._replace(weight_squares=squares)
        return self._total

    def return_to(self, state: MemoryState) -> None:
        """Forget the observations since a state."""
        self.state, self._total = state, None

    def onsets(self) -> list[Sums]:
        """Sums before each time that something may have begun, the earliest first."""
        seen = self.total.seen.sum()
        return [sums for sums in self.state.closed if sums.seen.sum() < seen]

    def keep(self, residual: Residual, t: float, whole: bool) -> None:
        """Add an observation; of earlier views those stay that date an onset to a quarter of its age.

        whole : whether no detection of it is aside. The rest is perhaps of the same hand or blur, and does
        not agree where the calibration would have to err beyond chance.
        """
        new = self._errors.sums(residual, t)
        if not whole and self._errors.contradicts(self.total.plus(new)):
            return
        state = self.state
        if state.first is None or not is_same_view(state.first, residual.predicted):
            closed = _thinned([*state.closed, self.total]) if state.length else state.closed
            state = MemoryState(closed, self._errors.nothing(), 0.0, residual.predicted)
        view = new.plus(state.view, _FORGET)._replace(views=1, t=t)
        self.return_to(state._replace(view=view, length=_FORGET * state.length + 1.0))

    def learn(self, now: Residual, aside: BoolArray, disagrees: bool) -> None:
        """Learn the fresh error of each frame from two in a row, free of errors of joints and instants.

        Those at rest give it, once there are enough: a corner that moves by part of a pixel errs otherwise.
        aside : (V, m) single outliers, of which only the trembling counts.
        disagrees : whether this observation does; a pair of which one does is skipped.
        """
        last, self._before = self._before, (now, aside, disagrees)
        kind = _IN_MOTION if last is None else _kind_of(last[0].predicted, now.predicted)
        if kind != _AT_REST:
            self._steps.clear()
        if last is None or last[2] != disagrees:
            return
        before, n = last[0], len(self._errors.sigma_q)
        in_both = before.seen & now.seen
        rows = np.repeat((in_both & ~aside & ~last[1]).ravel(), 2)
        weight = 1.0 / np.repeat(now.noise.ravel(), 2)[:, None]
        columns = np.r_[:n, 2 * n : self._errors.fixed]  # columns of joints and instants
        off, moved = (now.r - before.r) * weight[:, 0], now.F[:, columns] * weight
        if kind == _BETWEEN_VIEWS:
            moved = np.concatenate([moved, before.F[:, columns] * weight], axis=1)
        # All instants together are a motion of the joints: dependent ones are no separate direction.
        basis, sizes, turned = np.linalg.svd(moved[rows], full_matrices=False)
        independent = sizes > _DEPENDENT * sizes.max(initial=0.0)
        basis, back = basis[:, independent], turned[independent].T / sizes[independent]
        along = basis.T @ off[rows]
        freedom = len(basis) - basis.shape[1]
        if freedom <= 0:
            return
        square = float(off[rows] @ off[rows] - along @ along)
        if kind == _BETWEEN_VIEWS:
            # Errors of the calibration differ between views, by no more than its covariance.
            by_errors = ((now.B - before.B) * weight)[rows]
            square = max(0.0, square - float(np.square(by_errors - basis @ (basis.T @ by_errors)).sum()))
        elif kind == _AT_REST:
            off -= moved @ (back @ along)
            step = 0.5 * np.square(off / weight[:, 0]).reshape(*in_both.shape, 2).sum(axis=2)
            self._steps.append(np.where(in_both, step, np.nan))
        # Fading, so that the errors of a finder in one light do not count for ever.
        self._squares[kind] = 0.99 * self._squares[kind] + 0.5 * square
        self._freedom[kind] = 0.99 * self._freedom[kind] + freedom
        self._total = None


def _thinned(closed: list[Sums]) -> tuple[Sums, ...]:
    """Sums up to the end of each view, of the older ones fewer: dates to a quarter of their age."""
    ages = [max(1, (closed[-1].views - sums.views) // 4) for sums in closed]
    both = zip(closed, ages, strict=True)
    return tuple(sums for sums, age in both if sums.views % (1 << (age.bit_length() - 1)) == 0)


def is_same_view(before: FloatArray, now: FloatArray) -> bool:
    """Whether predicted pixels (V, m, 2) are of one view, of which corners err alike."""
    return _alike(before, now, _SAME_VIEW_PX)


def _kind_of(before: FloatArray, now: FloatArray) -> int:
    """Kind of the difference between two observations by their predicted pixels (V, m, 2)."""
    if not is_same_view(before, now):
        return _BETWEEN_VIEWS
    return _AT_REST if _alike(before, now, _AT_REST_PX) else _IN_MOTION


def _alike(before: FloatArray, now: FloatArray, within_px: float) -> bool:
    """Whether predicted pixels (V, m, 2) are the same within a number of px rms."""
    moved = np.square(now - before).sum(axis=-1)
    return bool(np.nanmean(np.append(moved, 0.0)) <= within_px**2)


class _Reduced(NamedTuple):
    """Normal equations of faults since an onset without nuisance errors: a Schur complement."""

    normal: FloatArray  # (f + 1, f + 1) of possible errors, and of the residual
    minimum: FloatArray  # (f + 1,) its diagonal at least
    root: FloatArray  # (e, e) of the information on errors of the calibration
    along: FloatArray  # (e, f) possible errors along these
    nuisance: IntArray  # (k,) columns of lasting errors of joints and instants
    solved: FloatArray  # (k, f) and possible errors along those
    line: FloatArray  # (f, f) to time from the onset

    def of(self, rows: FloatArray) -> FloatArray:
        """Other right-hand sides (e + f, k) of the equations, (f, k) after the same steps."""
        e = len(self.root)
        reduced = self.line @ rows[e:]
        reduced -= self.along.T @ solve_triangular(self.root, rows[:e], lower=True, check_finite=False)
        return np.asarray(reduced - self.solved.T @ reduced[self.nuisance])


class Tested(NamedTuple):
    """Tests of one observation."""

    disagrees: bool  # whether the whole of it does
    aside: BoolArray  # (V, m) single outliers


class Detector:
    """Tests of observations against a calibration.

    Each observation is tested by itself, each view and each marker; windows of them since an onset by the
    likelihood ratio of each direction that a fault may take, with the errors of the calibration and the
    lasting ones with their priors.

    Source: A. S. Willsky, H. L. Jones, "A Generalized Likelihood Ratio Approach to the Detection and
    Estimation of Jumps in Linear Systems", IEEE Trans. Automatic Control 21 (1976) 108–112.

    errors : covariance of images; max_observations : length of the longest sequence, which sets thresholds.
    """

    def __init__(self, errors: ErrorModel, max_observations: int) -> None:
        self._errors, self.memory = errors, _Memory(errors)
        V, m = len(errors.calibration.P), len(errors.calibration.M)
        tail = _FALSE_ALARM / max_observations
        self._chance = _FALSE_ALARM / np.log1p(max_observations / _SOON)
        self._most_once = np.sqrt(chdtri(np.maximum(np.arange(2 * V * m + 1), 1), tail / (V + 1 + m)))
        self._sizes = np.array([len(columns) for columns in errors.parts])
        self._by_size = [
            (which, np.array([errors.parts[i] for i in which]))
            for which in (np.flatnonzero(self._sizes == size) for size in np.unique(self._sizes))
        ]
        # Excess of each direction at the last test, and its part that was accepted as no fault.
        self._last = np.full(len(self._sizes), -np.inf)
        self._accepted = np.zeros(len(self._sizes))

    def accept(self) -> None:
        """Accept the present excess of windows as no fault: only more of it counts from here on."""
        self._accepted = np.maximum(self._accepted, self._last)

    def tested(self, residual: Residual) -> Tested:
        """Test χ² of each view and each marker in one observation, without single outliers."""
        errors, (V, m) = self._errors, residual.seen.shape
        total = self.memory.total
        columns = np.concatenate([residual.B.T, total.normal[: errors.e, -1:]], axis=1)
        columns = solve_triangular(errors.root(total), columns, lower=True, check_finite=False)
        W = columns[:, :-1]
        S, r = W.T @ W + residual.R, residual.r - W.T @ columns[:, -1]
        rows = np.arange(2 * V * m).reshape(V, m, 2)
        single = self._beyond(S, r, rows.reshape(V * m, 2), residual).reshape(V, m)
        markers = self._beyond(S, r, rows.swapaxes(0, 1).reshape(m, 2 * V), residual)
        aside = (single | (markers & ~single.any(axis=0))) & residual.seen
        parts = [*np.repeat(np.eye(V, dtype=np.bool_), m, axis=1), np.ones(V * m, dtype=np.bool_)]
        off = [self._is_off(S, r, residual, aside, part) for part in parts]
        if any(off):
            aside[:] = False
        return Tested(any(off), aside)

    def _is_off(
        self, S: FloatArray, r: FloatArray, residual: Residual, aside: BoolArray, part: BoolArray
    ) -> bool:
        """Whether a view, or all, disagree even without their worst detections, up to half, which go aside.

        part : (V m,) its detections.
        """
        visible, out = residual.seen & part.reshape(aside.shape), aside.reshape(-1)
        allowed = _MOST_ASIDE * visible.sum(axis=1)
        while ((aside & visible).sum(axis=1) <= allowed).all():
            left = np.flatnonzero(visible.ravel() & ~out)
            if not self._beyond(S, r, coordinate_rows(left)[None], residual)[0]:
                return False
            if (stray := farthest_alone(S, r, left, _OFF_ALONE)) is None:
                return True
            out[stray] = True
        return True

    def _beyond(self, S: FloatArray, r: FloatArray, parts: IntArray, residual: Residual) -> BoolArray:
        """Which parts (h,) of residuals, by their rows (h, p), are beyond chance and errors of the model."""
        detected = np.repeat(residual.seen.ravel(), 2)[parts]
        bias = np.repeat((self._errors.bias_px / residual.noise.ravel()) ** 2, 2)[parts]
        bias = bias + _UNUSUAL**2 * (1.0 - self.memory.fresh)
        maximum = self._most_once[detected.sum(axis=1)] + np.sqrt((detected * bias).sum(axis=1))
        gain = _gains(S, np.where(np.repeat(residual.seen.ravel(), 2), r, 0.0), parts, 0.0)[0]
        return np.asarray(gain > maximum**2)

    def significant(
        self, count: int, sigma_t: FloatArray, free: list[IntArray], thorough: bool
    ) -> Sums | None:
        """Sums before the likeliest onset of residuals beyond chance, if there is one.

        count : of past observations; sigma_t : (V,) deviation of instants, s; free : columns of markers
        that are known to be wrong; thorough : test windows of all lengths, not of another one each time.
        """
        total, onsets = self.memory.total, self.memory.onsets()
        if not onsets or not total.views:
            return None
        lengths = _LONGER ** np.arange(1 + int(np.log(total.views) / np.log(_LONGER)))
        tail = self._chance / (count + _SOON) / len(self._sizes)
        by_chance = np.sqrt(chdtri(self._sizes, tail))
        likeliest: Sums | None = None
        maximum = 0.0
        self._last = np.full(len(self._sizes), -np.inf)
        for length in lengths if thorough else lengths[[count % len(lengths)]]:
            since = min(onsets, key=lambda sums: abs(total.views - length - sums.views))
            excess = self._excess(since, total, self._reduced(since, total, sigma_t, free), by_chance)
            self._last = np.maximum(self._last, excess)
            max_excess = float((excess - self._accepted).max())
            if max_excess > maximum:
                likeliest, maximum = since, max_excess
        return likeliest

    def _reduced(self, since: Sums, total: Sums, sigma_t: FloatArray, free: list[IntArray]) -> _Reduced:
        """Normal equations of faults since an onset without errors of the calibration and lasting ones."""
        e, f, n = self._errors.e, self._errors.f, len(self._errors.sigma_q)
        line = np.eye(f)
        line[n : 2 * n, :n] = -since.t * np.eye(n)
        across = (total.normal - since.normal)[:, e:]
        across[:, :f] = across[:, :f] @ line.T
        across[e:-1] = line @ across[e:-1]
        minimum = _RIDGE * across[e:].diagonal()
        across[:e, -1] = total.normal[:e, -1]
        root = self._errors.root(total)
        along = solve_triangular(root, across[:e], lower=True, check_finite=False)
        normal = across[e:] - along.T @ along
        fixed = self._errors.fixed
        nuisance = np.concatenate([np.arange(fixed), *free]).astype(np.int64)
        weight = np.diag(np.maximum(minimum[nuisance], _RIDGE))
        weight[:fixed, :fixed] = self._errors.persistent_prior(total.t - since.t, sigma_t)
        solved = np.linalg.solve(normal[np.ix_(nuisance, nuisance)] + weight, normal[nuisance])
        normal -= normal[:, nuisance] @ solved
        return _Reduced(
            normal=normal,
            minimum=minimum,
            root=root,
            along=along[:, :f],
            nuisance=nuisance,
            solved=solved[:, :f],
            line=line,
        )

    def _excess(self, since: Sums, total: Sums, reduced: _Reduced, by_chance: FloatArray) -> FloatArray:
        """Root of the gain of each direction (h,) beyond chance, errors of the model and of corners.

        Corners err at their worst in each view; or they do so in one, as independent from view to view, and
        those that last beyond a view add to the covariance of a direction. The bound that allows less holds.
        Of both only the part counts that errors of joints do not cover.
        """
        touches, parts = self._errors.touches, self._errors.parts
        bias = touches @ (total.bias - since.bias).ravel()
        gained = self._root_gains(reduced, 0.0)
        excess = gained - by_chance - np.sqrt(bias)
        beyond = np.flatnonzero(excess > 0.0)
        if not beyond.size:
            return excess
        spread, weight, memory = self._spread(since, total, reduced), total.weight - since.weight, self.memory
        share = np.minimum([_greatest(spread, reduced, parts[i]) / weight for i in beyond], 1.0)
        touched, seen = touches[beyond], (total.seen - since.seen).ravel()
        # Coordinates of a view; of a marker at least those by two cameras, if there are two.
        corners = np.maximum(2.0 * touched @ (seen > 0.0), 2.0 * min(2, len(total.seen)))
        worst = (1.0 - memory.fresh) * chdtri(corners, _LASTING_CORNERS) / corners * share * (touched @ seen)
        one = _one_of(since, total)
        nuisance = self._root_gains(reduced, (1.0 - one) * memory.persistent * spread)
        limits = [by_chance[beyond] + np.sqrt(bias[beyond] + part * worst) for part in (1.0, one)]
        excess[beyond] = np.maximum(gained[beyond] - limits[0], nuisance[beyond] - limits[1])
        return excess

    def _spread(self, since: Sums, total: Sums, reduced: _Reduced) -> FloatArray:
        """Covariance (f, f) of scores by corners that each keep an error of one deviation.

        Markers that err all along change the calibration as seen before the onset, too.
        """
        e, by_corner = self._errors.e, total.by_corner - since.by_corner
        by_corner[:e] = total.by_corner[:e]
        off = reduced.of(by_corner)
        return np.asarray(off @ off.T)

    def undetected(self, carry: FloatArray, at: Residual, sigma_t: FloatArray) -> float:
        """Return the largest error of a measurement that the tests could miss.

        For each direction of a fault except joints and instants: the evidence in observations since the
        first, of a camera also since two thirds of them, since it may drift, and two deviations of that. The
        largest is returned: a fault has one cause.

        carry : (k, 2 V m) from changes of pixels to the measured quantity; at : images at the measurement.
        Source: W. Baarda, "A testing procedure for use in geodetic networks", Delft 1968, on external
        reliability.
        """
        total, onsets, fixed = self.memory.total, self.memory.onsets(), self._errors.fixed
        if not onsets:
            return 0.0
        last_onset, greatest = (
            min(onsets, key=lambda sums: abs(sums.views - _NEARLY_WHOLE * total.views)),
            0.0,
        )
        cameras = fixed + len(total.seen) * (CAMERA - 1)
        for since, end in ((onsets[0], self._errors.f), (last_onset, cameras)):
            reduced = self._reduced(since, total, sigma_t, [])
            persistent_share = max(0.0, 1.0 - _one_of(since, total)) * self.memory.persistent
            persistent_share += (total.bias - since.bias).sum() / (total.seen - since.seen).sum()
            spread = reduced.normal[:-1, :-1] + persistent_share * self._spread(since, total, reduced)
            for part in self._errors.parts:
                if not fixed <= part[0] < end:
                    continue
                size = np.sqrt(np.maximum(reduced.normal.diagonal(), _LEAST_INFORMATION))[part]
                unit, block = np.outer(size, size), np.ix_(part, part)
                inverse = np.linalg.inv(reduced.normal[block] / unit + _RIDGE * np.eye(len(part))) / unit
                by_score = carry @ at.F[:, part] @ inverse
                off = np.square(by_score @ reduced.normal[part, -1]).sum()
                may = np.trace(by_score @ spread[block] @ by_score.T)
                greatest = max(greatest, float(off + DISTINCT**2 * may))
        return float(np.sqrt(greatest))

    def _root_gains(self, reduced: _Reduced, more: FloatArray | float) -> FloatArray:
        """Root (h,) of the gain of each direction, its score with more covariance (f, f)."""
        normal, gain = reduced.normal, np.zeros(len(self._sizes))
        covariance = normal[:-1, :-1] + more
        for which, columns in self._by_size:
            gain[which] = _gains(covariance, normal[:-1, -1], columns, reduced.minimum[:-1])[0]
        return np.sqrt(gain)


def _gains(
    normal: FloatArray, right: FloatArray, parts: IntArray, minimum: FloatArray | float
) -> tuple[FloatArray, FloatArray]:
    """bᵀ A⁻¹ b (h,) and A⁻¹ b (h, p) for parts (h, p) of A x = b, its diagonal not below a minimum."""
    size = np.sqrt(np.maximum(np.maximum(normal.diagonal(), minimum), 1e-300))[parts]
    blocks = normal[parts[:, :, None], parts[:, None, :]] / (size[:, :, None] * size[:, None, :])
    b = right[parts] / size
    x = np.linalg.solve(blocks + _RIDGE * np.eye(parts.shape[1]), b[..., None])[..., 0]
    return np.maximum((b * x).sum(axis=1), 0.0), x / size


def _one_of(since: Sums, total: Sums) -> float:
    """Share of all observations since an onset that one view is."""
    return (total.weight_squares - since.weight_squares) / (total.weight - since.weight) ** 2


def _greatest(spread: FloatArray, reduced: _Reduced, part: IntArray) -> float:
    """Greatest ratio of a covariance (f, f) to the covariance of the score of a direction."""
    own, other = reduced.normal[np.ix_(part, part)], spread[np.ix_(part, part)]
    size = np.sqrt(np.maximum(own.diagonal(), np.maximum(reduced.minimum[part], 1e-300)))
    unit = np.outer(size, size)
    try:
        return float(eigh(other / unit, own / unit + _RANK * np.eye(len(part)), eigvals_only=True)[-1])
    except np.linalg.LinAlgError:  # with large image errors, rounding remains of a direction
        return np.inf


def farthest_alone(S: FloatArray, r: FloatArray, detections: IntArray, limit: float) -> int | None:
    """Return the detection, among some (k,), that is the farthest off given all others; None within a limit.

    Errors of joints move all of them: one by itself hardly shows its own error.

    S, r : covariance and residuals of all coordinates, px² and px; limit : of χ².
    """
    rows, k = coordinate_rows(detections), np.arange(len(detections))
    P = np.linalg.inv(S[np.ix_(rows, rows)])
    u, blocks = (P @ r[rows]).reshape(-1, 2, 1), P.reshape(len(k), 2, len(k), 2)[k, :, k]
    square = (u * np.linalg.solve(blocks, u)).sum(axis=(1, 2))
    return int(detections[np.argmax(square)]) if square.max() > limit else None


def relative_noise(calibration: Calibration) -> FloatArray:
    """Noise (V, 1) of each view over the noise of the calibration."""
    common, own = max(calibration.sigma_px, MIN_SIGMA), calibration.sigma_view_px
    return np.ones((len(calibration.P), 1)) if own is None else own[:, None] / common


def coordinate_rows(detections: IntArray) -> IntArray:
    """Rows (2 k,) of the coordinates of detections (k,)."""
    return np.asarray((2 * detections[:, None] + np.arange(2)).ravel())


def _rays(scene: Parameters, directions: FloatArray, q: FloatArray) -> FloatArray:
    """Lines of sight (K, V, m, 3) of all markers in their own frame, unit vectors but for their sign.

    directions : (3, 4) of points at infinity; q : (K, n) joints of the scene, from the reference.
    """
    by_marker = scene.everywhere(q).by_point[-1].reshape(-1, len(q), len(scene.M), 2, 4) @ directions.T
    ray = np.cross(by_marker[..., 0, :], by_marker[..., 1, :])
    return np.asarray((ray / np.linalg.norm(ray, axis=-1, keepdims=True)).swapaxes(0, 1))


def rigid_motions(H_hat: FloatArray, directions: FloatArray, a_inf: FloatArray) -> FloatArray:
    """Basis (d, 4, 4) of rigid motions: translations, and those that the joints generate together."""
    brackets = [A @ B - B @ A for A in H_hat for B in H_hat]
    motions = np.concatenate([H_hat, np.array(brackets), directions[:, :, None] * a_inf])
    sizes, rows = np.linalg.svd(motions.reshape(-1, 16), full_matrices=False)[1:]
    return np.asarray(rows[:6][sizes[:6] > _RANK * sizes[0]].reshape(-1, 4, 4))


def _directions_of(V: int, n: int, m: int, d: int) -> tuple[list[IntArray], FloatArray, int]:
    """Columns of each direction of a fault, detections (h, V m) that each touches, and how many columns.

    The columns are: joints, joints that go on, instants, cameras, markers, rigid motions of all markers and
    of all cameras.
    """
    everything = np.ones((V, m))
    views = [everything * (np.arange(V)[:, None] == v) for v in range(V)]
    at_camera, free = 2 * n + V, CAMERA - 1
    at_marker = at_camera + V * free
    at_tool = at_marker + 3 * m
    directions = [*((np.array([i]), everything) for i in range(2 * n))]
    directions += [(n + np.arange(n), everything), (np.arange(n), everything)]
    for v in range(V):
        directions += [(np.array([2 * n + v]), views[v]), (at_camera + v * free + np.arange(free), views[v])]
    directions += [(2 * n + np.arange(V), everything)]
    for j in range(m):
        directions += [(at_marker + 3 * j + np.arange(3), everything * (np.arange(m) == j))]
    directions += [(at_tool + np.arange(d), everything), (at_tool + d + np.arange(d), everything)]
    columns, touches = zip(*directions, strict=True)
    return list(columns), np.array([part.ravel() for part in touches]), at_tool + 2 * d
