"""Robust fitting: a search from each start, then least squares of the inliers, and the noise they show."""

import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np
from scipy.special import chdtri

from projservo_cli.calibration.bundle_adjustment import JointErrors, LeastSquares, fit_offsets, minimize
from projservo_cli.calibration.detections import (
    MAX_JUDGED,
    RAYLEIGH,
    Detections,
    even_choice,
    medians,
)
from projservo_cli.calibration.initial.epipolar import OUTLIER, ImageGeometry
from projservo_cli.calibration.initial.initialization import Nominal, Search, starting_markers, starts
from projservo_cli.calibration.initial.triangulation import Tracks
from projservo_cli.calibration.joint_noise import NO_JOINT_NOISE, JointNoise
from projservo_cli.calibration.prediction import Parameters
from projservo_cli.findings import LIMITS, REFUSES, Finding, Subject
from projservo_cli.messages import refused
from projservo_cli.records import BoolArray, Errors, FloatArray, IntArray, WorkFailed

# Fitted over expected noise above which residuals exceed pixel noise.
WARN_RATIO = 1.15
# Standard errors above a ratio of one from which residuals exceed pixel noise, if that is less.
_WARN_ERRORS = 4.0
# Fitted over expected noise above which the model does not describe the data.
REFUSE_RATIO = 3.0
# Error of predictions, over the image size, above which a calibration is not usable, if none is set.
MAX_PREDICTED = 0.01
# Probability with which χ² of a true model lies beyond either end of its band.
_CHI2_TAIL = 1e-4
# Relative standard error of stated noise, which is itself an estimate.
_STATED_ERROR = 0.1
# Minimum true over stated noise: below it, the noise is in other units or of another detector.
_MIN_SCALE = 0.3
# Maximum true over stated noise, for the same reason.
_MAX_SCALE = 5.0
# Ratio to the largest singular value below which the data do not determine a direction.
OPEN_DIRECTION = 1e-10
# Numbers of the derivative computed together, in 16 MB.
_AT_ONCE = 2**21
# Maximum number of corners whose squared residuals the record keeps.
_MAX_CORNERS = 50_000
# Maximum number of detections by which a fit is assessed, and minimum number of markers.
_MAX_JUDGED_DETECTIONS, _MIN_JUDGED = 40_000, 8
# Number of markers at each pose with which the robust search of more detections is done.
_SEARCHED = 12
# Maximum number of rounds in which inliers are selected.
_MASK_ROUNDS = 4
# Minimum noise of pixels of exact images, px.
_EXACT_PX = 1e-9
# Share of observations that are wrong above which whole tracks are tested.
_MANY = 0.01
# Share of detections whose change between rounds is ignored.
_FLICKER = 2e-4
# Minimum number of detections of a marker that support each other if others do not fit.
_VERIFIED = 3
# Noise over the noise of the rig above which the model errs and misfits need not be wrong detections.
_RIG = 1.5
# Probability that noise alone rejects all detections of a pose.
_POSE_TAIL = 1e-7
# Minimum share of inliers among the detections of a marker that is part of the model.
_MIN_SHARE = 0.25
# Noise over the noise of the rig after the robust search above which a start is wrong.
_HOPELESS = 10.0
# Minimum relative gain over ``_PATIENCE`` steps of a robust search whose result would be refused at that
# point.
_CRAWL = 0.01
# Number of steps over which this gain is measured.
_PATIENCE = 10
# Usual error of poses of a flange, rad and × 0.3 m/rad, of arms as manufacturers calibrate them.
_USUAL_OF_POSES = 1e-3
# Maximum number of rounds between the fit and the noise of joints.
_NOISE_ROUNDS = 5
# Relative change of the noise of joints that ends them.
_NOISE_SETTLED = 0.01
# Relative difference of squared residuals below which two fits are one.
_SAME_FIT = 1e-4
# Relative difference of residuals below which two fits are the same.
_SAME_LEVEL = 1e-3
# Factors of the best focal length in each pass over the starts: a wrong one often succeeds where it fails.
_FOCAL_FACTORS = ((1.0,), (1.0, 0.6), (1.6, 0.4, 2.5))
# Residual of a pose over the median above which the next pass omits it.
_SPOILT = 8.0
# Maximum number of searches a pass, so that data of no robot are refused within seconds.
_SEARCHES = 5


# Error at left-out poses with estimated noise of joints, over that without, up to which it is accepted.
_NO_WORSE = 1.01
# Minimum share of the squares of a direction that other poses determine.
_MIN_LEFT = 1e-2


class Misfit(WorkFailed):
    """No model of the robot describes the data."""

    @classmethod
    def by(cls, findings: Iterable[Finding], detections: Detections) -> "Misfit":
        """Return the refusal by findings, in words."""
        findings = tuple(findings)
        return cls(refused(findings, detections.setup), findings=findings)


@dataclass(frozen=True, eq=False)
class Solution:
    """Solved problem, its parameters and residuals."""

    problem: LeastSquares
    params: Parameters
    residual: FloatArray  # (V, N, 2) predicted minus seen, px, weighted
    used: BoolArray  # (V, N) detections that count; the rest of those seen are outliers
    dof: int  # degrees of freedom
    joint_noise: JointNoise | None = None  # noise of joint readings; None if not estimated

    @property
    def chi2(self) -> float:
        """Sum of squared residuals of the detections used, and of priors, px²."""
        return float((self.residual[self.used] ** 2).sum()) + self.problem.prior_squares(self.params)

    @property
    def raw(self) -> FloatArray:
        """``residual`` at the joint readings, zero if it does not count."""
        return self.problem.with_noise(None).residual(self.params) * self.used[..., None]

    def joint_effect(self) -> tuple[float, float]:
        """Root mean square motion of a coordinate under the noise of joints: over its own noise, and px."""
        if self.problem.tau is None:
            return 0.0, 0.0
        G = self.problem.joint_derivative(self.params)[self.used] * self.problem.tau
        square, weight = (G**2).sum(axis=-1), self.problem.detections.weight[self.used]
        plain = square / weight[:, None] ** 2
        return float(np.sqrt(square.mean())), self.sigma_px * float(np.sqrt(plain.mean()))

    def corners(self) -> tuple[FloatArray | None, FloatArray | None]:
        """Squared residuals (K, V, m) over their variance, and joints (K, n); None if there are many."""
        detections = self.problem.detections
        shape = (len(detections.q), len(detections.seen), len(detections.marker))
        if math.prod(shape) > _MAX_CORNERS or not self.sigma_px > 0.0:
            return None, None
        squares = np.full(shape, np.nan)
        found = np.where(self.used, np.square(self.residual).mean(axis=-1) / self.sigma_px**2, np.nan)
        for view, of_view in enumerate(found):
            squares[detections.pose_of, view, detections.marker_of] = of_view
        return squares, detections.q.copy()

    @property
    def sigma_px(self) -> float:
        """Noise per coordinate estimated from the residuals, px."""
        return float(np.sqrt(self.chi2 / max(self.dof, 1)))

    @property
    def rms_px(self) -> float:
        """Root mean square of the Euclidean residual per marker and view at the joint readings, px."""
        raw = self.raw / self.problem.detections.weight[..., None]
        return float(np.sqrt((raw[self.used] ** 2).sum() / max(int(self.used.sum()), 1)))

    @property
    def typical_px(self) -> float:
        """Median residual over all detections, outliers included, px."""
        return median_px(self.residual, self.problem.detections.seen)

    def determined(self) -> tuple["Solution", BoolArray]:
        """Remove markers of which hardly any detection counts; the solution, and the rest (m,)."""
        detections = self.problem.detections
        # One detection has fewer numbers than a marker; a few among many wrong ones agree by chance.
        keep = detections.count_of(self.used) >= np.maximum(
            2, _MIN_SHARE * detections.count_of(detections.seen)
        )
        if keep.all():
            return self, keep
        return self.of_markers(keep), keep

    def of_markers(self, keep: BoolArray) -> "Solution":
        """Select markers (m,)."""
        rows = keep[self.problem.detections.marker_of]
        smaller, params = _of_markers(self.problem, self.params, keep)
        used = self.used[:, rows]
        dof = _degrees_of_freedom(smaller, params, used)
        return Solution(smaller, params, self.residual[:, rows], used, dof, self.joint_noise)

    def thinned(self, max_markers: int) -> "Solution":
        """Select at most ``max_markers`` markers, evenly."""
        m = self.problem.detections.marker.size
        return (
            self if m <= max_markers else self.of_markers(np.isin(np.arange(m), even_choice(m, max_markers)))
        )

    @property
    def judged_markers(self) -> IntArray:
        """Markers by which a fit is assessed, evenly: fewer if they have many detections."""
        detections = self.problem.detections
        few = even_choice(detections.marker.size, MAX_JUDGED)
        count = np.bincount(detections.marker_of, self.used.sum(axis=0), detections.marker.size)[few].sum()
        max_markers_judged = int(_MAX_JUDGED_DETECTIONS * few.size / max(count, 1.0))
        return few[even_choice(few.size, max(max_markers_judged, _MIN_JUDGED))]

    def judged(self) -> "Solution":
        """Select the markers by which a fit is assessed."""
        m, which = self.problem.detections.marker.size, self.judged_markers
        return self if which.size == m else self.of_markers(np.isin(np.arange(m), which))

    def kept(self) -> "Solution":
        """Solution of the detections that count alone."""
        detections, rows = self.problem.detections, np.asarray(self.used.any(axis=0))
        some = dataclasses.replace(detections, seen=self.used).rows(rows)
        return dataclasses.replace(
            self,
            problem=dataclasses.replace(self.problem, detections=some),
            residual=self.residual[:, rows],
            used=self.used[:, rows],
        )

    def errors(self) -> Errors:
        """Errors of the parameters at a noise of one pixel, factors of (JᵀS⁻¹J)⁺ if the data determine it.

        Factors of J itself keep the weakest direction, which the normal matrix would lose. Each marker is
        eliminated from its own rows; the rest determines the other parameters, which the markers follow
        (B. Triggs et al., "Bundle adjustment: a modern synthesis", 1999, section 6). Joint offsets are such
        parameters too, unless they outnumber the coordinates of markers: whitening then removes them. A
        direction that the data do not determine has errors of enormous length.
        """
        problem, params = self.problem, self.params
        s, m, offsets = problem.shared, len(params.M), 0 if problem.tau is None else problem.q.size
        gauge, own_place = problem.gauge(params), ~problem.detections.on_board[:, None, None]
        stated = problem.departure_derivative(params)
        if problem.by_pose:
            J = problem.whitened(params, problem.dense(problem.derivative(params), self.used), self.used)
            J = np.vstack([J, np.pad(stated, ((0, 0), (0, J.shape[1] - s)))]) if len(stated) else J
            factor = inverse_root(J, np.linalg.norm(J, axis=0), gauge)
            return Errors(factor[:s], own_place * factor[s:].reshape(m, 3, -1), np.zeros((m, 3, 3)))
        R = np.vstack([np.eye(s + offsets)[s:], np.pad(stated, ((0, 0), (0, offsets)))])
        squares = (R**2).sum(axis=0)
        follows, own = np.zeros((m, 3, s + offsets)), np.zeros((m, 3, 3))
        for markers, A, B in self._tracks(s + offsets):
            U, size, Vt = np.linalg.svd(B, full_matrices=False)
            floor = OPEN_DIRECTION * np.where(size[:, :1] > 0.0, size[:, :1], 1.0)
            U *= (size > floor)[:, None]
            own[markers] = Vt.swapaxes(1, 2) / np.maximum(size, floor)[:, None]
            along = U.swapaxes(1, 2) @ A
            follows[markers] = -own[markers] @ along
            squares += (A**2).sum(axis=(0, 1))
            left = (A - U @ along).reshape(-1, s + offsets)
            R = np.asarray(np.linalg.qr(np.vstack([R, left]), mode="r"))
        free = np.zeros((s + offsets, gauge.shape[1]))
        free[:s] = gauge[:s]
        factor = inverse_root(R, np.sqrt(squares), free)
        return Errors(factor[:s], (follows @ factor) * own_place, own * own_place)

    def _tracks(self, count: int) -> Iterator[tuple[IntArray, FloatArray, FloatArray]]:
        """Yield markers (k,) and derivatives of their images by common parameters and their own.

        Of shapes (k, l, count) and (k, l, 3).
        The common parameters are the shared ones, then joint offsets in units of their noise.
        """
        problem, detections = self.problem, self.problem.detections
        edges = np.searchsorted(detections.marker_of, np.arange(detections.marker.size + 1))
        lengths = np.diff(edges)
        for length in np.unique(lengths[lengths > 0]):
            alike = np.flatnonzero(lengths == length)
            for markers in np.array_split(
                alike, 1 + 2 * len(self.used) * length * count * alike.size // _AT_ONCE
            ):
                at = (edges[markers, None] + np.arange(length)).ravel()
                part, used = problem.rows(at), self.used[:, at, None, None]
                J = part.derivative(self.params) * used
                A = np.zeros((*J.shape[:3], count + 3))
                for v, columns in enumerate(part.columns):
                    A[v][..., columns] = J[v, ..., :-3]
                if problem.tau is not None:
                    n = len(problem.tau)
                    at_pose = problem.shared + n * part.detections.pose_of[:, None, None] + np.arange(n)
                    G = part.joint_derivative(self.params) * problem.tau * used
                    np.put_along_axis(A, at_pose[None], G, axis=3)
                A[..., count:] = J[..., -3:]
                A = A.reshape(len(A), markers.size, length, 2, -1).swapaxes(0, 1)
                A = A.reshape(markers.size, -1, A.shape[-1])
                # One detection has fewer numbers than a marker: rows of zeros leave the rest of it open.
                A = np.pad(A, ((0, 0), (0, max(3 - A.shape[1], 0)), (0, 0)))
                yield markers, A[..., :count], A[..., count:]


def inverse_root(R: FloatArray, scale: FloatArray, gauge: FloatArray) -> FloatArray:
    """L (c, c − g) with L Lᵀ = (RᵀR)⁺ across a gauge (c, g), for R (l, c), its columns in units (c,)."""
    # A parameter without influence on the residuals has no scale: it is open whatever the unit.
    scale = np.where(scale > 0.0, scale, scale.max())
    G = np.linalg.qr(scale[:, None] * gauge)[0]
    free = np.linalg.qr(G, mode="complete")[0][:, G.shape[1] :]
    _, s, Vt = np.linalg.svd(np.linalg.qr((R / scale) @ free, mode="r"))
    # Robots of one or two joints leave more directions open than the gauge. No image depends on them, so
    # their product with a derivative must vanish.
    return np.asarray((free @ (Vt.T / np.maximum(s, OPEN_DIRECTION * s[0]))) / scale[:, None])


@dataclass(frozen=True)
class Expected:
    """Expected noise of a fit, px per coordinate."""

    sigma_px: float  # given noise, otherwise as the epipolar geometry shows
    known: bool  # whether it is the true noise of a simulation, so that χ² decides
    origin: str  # its origin: given, stated, views, body, or stated, by one of these
    error: float  # its relative standard error, zero if given
    scale: float | None = None  # true over stated deviations, if the images determine it
    scale_interval: FloatArray | None = None  # (2,) of 95 %
    evidence: str = ""  # who shows it, for messages
    min_px: float = 0.0  # minimum pixel noise if it is estimated, px; zero if it is known

    @classmethod
    def of(
        cls, epipolar: ImageGeometry, sigma_px: float | None, source: str, stated_px: float | None
    ) -> "Expected":
        """Given or stated noise, px, exact for a ``simulated`` source; otherwise the noise of the rig.

        The noise stated in a recording has an unknown common factor. The epipolar residuals of both views,
        independent of the joints, determine it; it is one if its interval contains one.
        """
        if sigma_px is not None:
            return cls(sigma_px, source == "simulated", "given", 0.0)
        if stated_px is None:
            error = epipolar.relative_error
            return cls(epipolar.noise_px, False, epipolar.origin, error, min_px=epipolar.min_px)
        origin = "stated"
        if source == "simulated":
            return cls(stated_px, True, origin, _STATED_ERROR)
        low, high = interval = epipolar.core.interval / stated_px
        if low <= 1.0 <= high:
            return cls(stated_px, False, origin, _STATED_ERROR, 1.0, interval, min_px=epipolar.min_px)
        scale = epipolar.core.sigma_px / stated_px
        origin = f"{origin}, by {epipolar.origin}"
        stated_px, evidence, min_px = scale * stated_px, epipolar.evidence, epipolar.min_px
        return cls(stated_px, False, origin, _STATED_ERROR, scale, interval, evidence, min_px)

    def require_scale(self, view: Sequence[str]) -> None:
        """Refuse stated deviations that are wrong by more than a detector can explain.

        Raises WorkFailed with the factor and its limits.
        """
        if self.scale is None or self.scale_interval is None:
            return
        low, high = self.scale_interval
        if high < _MIN_SCALE or low > _MAX_SCALE:
            raise WorkFailed(
                f"the stated deviations of the markers are wrong: {self.evidence} {self.scale:.3g} "
                f"times the noise of {' and '.join(f'sigma_{name}' for name in view)} (95 %: {low:.3g} to "
                f"{high:.3g}; {_MIN_SCALE:g} to {_MAX_SCALE:g} times allowed); multiply "
                f"{'both columns' if len(view) == 2 else 'all of them'} by {self.scale:.3g}, or remove them"
            )

    def ratio(self, solution: Solution) -> float:
        """Fitted over expected noise."""
        return solution.sigma_px / self.sigma_px

    def noise_px(self, solution: Solution) -> float:
        """Noise that scales a covariance, px: true for a simulation, otherwise at least the fitted one."""
        return self.sigma_px if self.known else max(self.sigma_px, solution.sigma_px)

    def warns(self, solution: Solution) -> bool:
        """Whether residuals exceed pixel noise; both noises come from finitely many residuals."""
        error = float(np.hypot(self.error, 1.0 / np.sqrt(2.0 * max(solution.dof, 1))))
        return self.ratio(solution) > min(WARN_RATIO, 1.0 + _WARN_ERRORS * error)

    def agrees(self, solution: Solution) -> bool:
        """Whether a fit leaves only the expected noise, so that no other need be tried."""
        if self.known:
            low, high = chi2_band(solution.dof)
            return low <= self.ratio(solution) ** 2 <= high
        return not self.warns(solution)

    def finding(self, code: str, severity: str, solution: Solution) -> Finding:
        """Finding on the residuals of a fit, with the noise and its origin."""
        scale = () if self.scale is None else (Finding("stated_scale", amount=self.scale, unit="1"),)
        numbers = solution.sigma_px, math.nan, self.sigma_px, "px"
        return Finding(code, severity, Subject(name=self.origin), *numbers, others=scale)

    def refusal(self, solution: Solution) -> Finding | None:
        """Return the finding by which a fit must not pass, or None if it may."""
        ratio = self.ratio(solution)
        if self.known and not self.agrees(solution):
            low, high = chi2_band(solution.dof)
            sigma_q = 0.0 if solution.joint_noise is None else solution.joint_noise.sigma_q
            joints = (Finding("joint_noise", amount=sigma_q, unit="rad"),) if sigma_q > 0.0 else ()
            band = Finding("chi2_band", amount=low, limit=high, unit="1")
            of_noise = Finding("noise", amount=self.sigma_px, unit="px")
            return Finding("chi2", REFUSES, amount=ratio**2, unit="1", others=(of_noise, band, *joints))
        return self.finding("misfit", REFUSES, solution) if ratio > REFUSE_RATIO else None


def chi2_band(dof: int) -> tuple[float, float]:
    """Quantiles of χ² per degree of freedom that contain a true model with probability 1 − 2e-4."""
    return float(chdtri(dof, 1.0 - _CHI2_TAIL)) / dof, float(chdtri(dof, _CHI2_TAIL)) / dof


def median_px(residual: FloatArray, mask: BoolArray) -> float:
    """Median length of the residuals (V, N, 2) in a mask (V, N), px."""
    return float(np.median(np.linalg.norm(residual[mask], axis=1)))


def _stall_check(seen: BoolArray, far: float) -> Callable[[FloatArray], bool]:
    """Check, for each step, that a search is farther off than a noise, px, and hardly improves."""
    levels: list[float] = []

    def stalled(residual: FloatArray) -> bool:
        levels.append(median_px(residual, seen))
        if len(levels) <= _PATIENCE or levels[-1] <= RAYLEIGH * far:
            return False
        return levels[-1] > (1.0 - _CRAWL) * levels[-1 - _PATIENCE]

    return stalled


def fit_from(problem: LeastSquares, params: Parameters, epipolar: ImageGeometry) -> Solution | None:
    """Fit from initial parameters, by a robust search and ``fit_inliers``; None if it fails.

    With many detections the search uses some markers; its result places the others.
    """
    few = _searched_markers(problem.detections, np.isfinite(params.M[:, 0]))
    some, smaller = _of_markers(problem, params, few)
    searched, level = _robust_search(some, smaller, some.detections.seen, epipolar)
    M = np.full((few.size, 4), np.nan)
    M[few] = searched.M
    searched = dataclasses.replace(searched, M=M)
    return fit_inliers(problem, searched, level / RAYLEIGH, epipolar.noise_px, hopeless=_HOPELESS)


def fewer(search: Search) -> Search:
    """Search with some markers of many detections."""
    detections = search.problem.detections
    few = _searched_markers(detections, np.ones(detections.marker.size, dtype=np.bool_))
    return dataclasses.replace(search, problem=search.problem.of_markers(few))


def _searched_markers(detections: Detections, placed: BoolArray) -> BoolArray:
    """Mask (m,) of markers to search with: all, or of many detections as many placed ones as a pose needs."""
    every = np.ones(detections.marker.size, dtype=np.bool_)
    if detections.seen.sum() <= _MAX_JUDGED_DETECTIONS:
        return every
    order = np.argsort(-detections.count_of(detections.seen), kind="stable")
    few = detections.covering(order[placed[order]], _SEARCHED)
    kept = (detections.seen & few[detections.marker_of]).sum(axis=1)
    return few if (kept >= 0.5 * few.mean() * detections.seen.sum(axis=1)).all() else every


def _robust_search(
    problem: LeastSquares, params: Parameters, rows: BoolArray, epipolar: ImageGeometry
) -> tuple[Parameters, float]:
    """Minimize a Cauchy loss over some detections (V, N), by the screws, then by all parameters.

    Returns the parameters and the median residual, px.
    """
    if not params.known_arm:
        params = minimize(problem, params, rows, robust=True, cameras=False, max_steps=20).params
    stalled = _stall_check(rows, REFUSE_RATIO * epipolar.noise_px)
    fit = minimize(problem, params, rows, robust=True, max_steps=100, stalled=stalled)
    return fit.params, median_px(fit.residual, rows)


def fit_inliers(
    problem: LeastSquares,
    params: Parameters,
    sigma: float,
    rig_px: float = 0.0,
    *,
    hopeless: float = np.inf,
    min_px: float = 0.0,
) -> Solution | None:
    """Least squares of the inliers, in rounds until they no longer change.

    sigma : robust noise of the initial parameters, px; inliers are within 5σ.
    rig_px : noise of the rig, px; a fit that reaches it also tests tracks.
    hopeless : ratio of both above which no rounds follow.
    min_px : noise of pixels in whose units the offsets of joints count.
    Returns None if the fit leaves no degree of freedom, no detection of a view, or points behind a camera.
    """
    if sigma > hopeless * rig_px:
        if (lost := ~np.isfinite(params.M[:, 0])).any():
            params = dataclasses.replace(params, M=Tracks(problem, params).locate(lost, sigma))
        residual, seen = problem.residual(params), problem.detections.seen
        dof = _degrees_of_freedom(problem, params, seen)
        return Solution(problem, params, residual, seen, dof) if dof > 0 else None
    min_px = max(min_px, _EXACT_PX)
    params, within = _within(problem, params, max(sigma, min_px), max(sigma, min_px), rig_px)
    for _ in range(_MASK_ROUNDS):
        used = within
        if not used.any(axis=1).all():
            return None
        keep = problem.detections.count_of(used) > 0
        some, smaller = _of_markers(problem, params, keep)
        fit = minimize(some, smaller, used[:, keep[problem.detections.marker_of]], robust=False)
        M = params.M.copy()
        M[keep] = fit.params.M
        params = dataclasses.replace(fit.params, M=M)
        dof = _degrees_of_freedom(some, fit.params, used)
        if dof <= 0:
            return None
        # Wrong detections still among them widen the tail and hardly the middle.
        share = float(np.sqrt(2.0 * np.count_nonzero(used) / dof))
        middle = max(share * median_px(problem.residual(params), used) / RAYLEIGH, min_px)
        sigma = max(float(np.sqrt(fit.cost / dof)), min_px)
        updated, within = _within(problem, params, sigma, middle, rig_px)
        if np.count_nonzero(used != within) <= _FLICKER * used.size:
            break
        params = updated
    _, depth = problem.pixels(params)
    sign, ahead = _sides(depth, used)
    if not ahead[used].all():
        return None
    params = dataclasses.replace(params, P=params.P * sign[:, None, None])
    return Solution(problem, params, problem.residual(params), used, dof)


def _of_markers(
    problem: LeastSquares, params: Parameters, keep: BoolArray
) -> tuple[LeastSquares, Parameters]:
    """Select markers (m,) of a problem and its parameters."""
    if keep.all():
        return problem, params
    return problem.of_markers(keep), dataclasses.replace(params, M=params.M[keep])


def _sides(depth: FloatArray, used: BoolArray) -> tuple[FloatArray, BoolArray]:
    """Signs (2,) of the cameras, and whether points of depths (V, N) lie on the side of most used ones."""
    sign = np.sign((depth * used).sum(axis=1))
    return sign, np.sign(depth) == sign[:, None]


def _within(
    problem: LeastSquares, params: Parameters, sigma: float, middle: float, rig_px: float
) -> tuple[Parameters, BoolArray]:
    """Inliers (V, N) at a noise σ, px, and the parameters with markers where most of their detections agree.

    Inliers are within 5σ. If many are not, they agree with the others of their marker, and most of the marker
    do. A pose must have a share of inliers not far below the median and, if joints have noise, residuals that
    this noise explains: a wrong joint reading hides among many small errors.
    """
    detections, limit = problem.detections, OUTLIER * sigma
    if (lost := ~np.isfinite(params.M[:, 0])).any():
        params = dataclasses.replace(params, M=Tracks(problem, params).locate(lost, sigma))
    rested = fit_offsets(problem, params)
    good = _near(problem, rested, limit)
    many = np.mean((detections.seen & ~good).any(axis=0)) > _MANY and middle <= _RIG * rig_px
    if many:
        # Slips along both views alike show in this noise and not in the noise of the rig.
        sigma = min(sigma, middle if middle > WARN_RATIO * rig_px else min(middle, rig_px))
        doubtful = detections.count_of(detections.seen & ~good) > 0
        M = Tracks(problem, rested).locate(doubtful, sigma)
        rested = dataclasses.replace(rested, M=M)
        M, good = Tracks(problem, rested).reject_misfits(sigma, _near(problem, rested, OUTLIER * sigma))
        params, rested = (dataclasses.replace(one, M=M) for one in (params, rested))
    share = detections.count_at(good) / np.maximum(detections.count_at(detections.seen), 1)
    pose_fits = share >= 0.5 * np.median(share[np.unique(detections.pose_of)])
    if problem.tau is not None:
        residual, strain = problem.residual(rested), problem.strain(rested)
        square = problem.at_poses((residual**2 * good[..., None]).sum(axis=(0, 2))) + (strain**2).sum(axis=1)
        allowed = chdtri(np.maximum(2 * detections.count_at(good), 1), _POSE_TAIL) * sigma**2
        pose_fits &= (np.abs(strain) <= limit).all(axis=1) & (square <= allowed)
    good &= pose_fits[detections.pose_of]
    if many:
        at_pose = pose_fits[detections.pose_of]
        kept, of = (detections.count_of(part & at_pose) for part in (good, detections.seen))
        good &= ((kept >= 0.5 * of) & ((kept >= _VERIFIED) | (kept == of)))[detections.marker_of]
    return params, np.asarray(good)


def _near(problem: LeastSquares, params: Parameters, limit: float) -> BoolArray:
    """Mask (V, N) of detections within a limit, px."""
    near = np.linalg.norm(problem.residual(params), axis=2) <= limit
    return np.asarray(problem.detections.seen & near)


def _degrees_of_freedom(problem: LeastSquares, params: Parameters, used: BoolArray) -> int:
    """Number of coordinates used minus the rank of their derivative."""
    return 2 * int(np.count_nonzero(used)) - problem.free + len(problem.gauge(params).T)


def fit_joint_noise(exact: Solution, expected: Expected, given: float | None) -> Solution:
    """Refit with noise of joint readings, rad, as given or estimated by maximum likelihood for None.

    Returns the exact fit if the images show no such noise, none explains them, or the exact fit predicts
    left-out poses better: noise of joints also absorbs other errors, such as motions of a camera.
    """
    if given == 0.0 or exact.joint_noise is not None:
        return exact
    of_poses = given is None and exact.problem.detections.chart is not None
    sigma_px, solution = None if expected.min_px else expected.sigma_px, exact
    if of_poses and exact.problem.tau is None:
        solution = by_usual_noise(exact, expected)
    for _ in range(_NOISE_ROUNDS):
        before = solution.joint_noise
        if given is not None:
            noise = JointNoise(given, None, given / expected.sigma_px)
        else:
            noise = JointNoise.estimated(
                solution.problem, solution.params, solution.used, sigma_px, expected.min_px
            )
        if noise.sigma_q == 0.0:
            return dataclasses.replace(_without_noise(exact), joint_noise=noise)
        if before is not None and abs(noise.sigma_q - before.sigma_q) <= _NOISE_SETTLED * before.sigma_q:
            break
        found = _with_noise(solution, noise, sigma_px or expected.min_px)
        if found is None:
            return dataclasses.replace(_without_noise(exact), joint_noise=NO_JOINT_NOISE)
        solution = dataclasses.replace(found, joint_noise=noise)
    # Else noise of joints is all that explains it. No arm reaches a pose exactly, so that one has no rival.
    alone = given is None and not of_poses and expected.refusal(exact) is None
    if alone and left_out_px(solution) > _NO_WORSE * left_out_px(exact):
        return dataclasses.replace(exact, joint_noise=NO_JOINT_NOISE)
    return solution


def _without_noise(solution: Solution) -> Solution:
    """Fit without noise of joint readings; the same if it has none."""
    if solution.problem.tau is None:
        return solution
    params = dataclasses.replace(solution.params, offsets=None)
    return fit_inliers(solution.problem.with_noise(None), params, solution.sigma_px) or solution


def _with_noise(solution: Solution, noise: JointNoise, min_px: float) -> Solution | None:
    """Fit with a noise of joint readings, robustly at first: a fit without it has absorbed some errors."""
    problem = solution.problem.with_noise(noise.tau(solution.problem.detections.prismatic))
    params = minimize(problem, solution.params, solution.used, robust=True, max_steps=20).params
    return fit_inliers(problem, params, noise.sigma_q / noise.over_pixels, min_px=min_px)


def by_usual_noise(exact: Solution, expected: Expected) -> Solution:
    """Fit poses of a flange with their usual errors, if it keeps as many images as an exact fit."""
    noise = JointNoise(_USUAL_OF_POSES, None, _USUAL_OF_POSES / expected.sigma_px)
    every = dataclasses.replace(exact, used=exact.problem.detections.seen)
    found = _with_noise(every, noise, expected.min_px)
    return exact if found is None or found.used.sum() < exact.used.sum() else found


def left_out_px(solution: Solution) -> float:
    """Typical error of images at the joint readings of a pose, by a fit without this pose to first order, px.

    The geometric mean over poses of the median distance, rejected detections included, so that it compares
    fits that reject different ones.
    """
    few = solution.thinned(MAX_JUDGED)
    error, seen = left_out_errors(few), few.problem.detections.seen
    pose_of = np.broadcast_to(few.problem.detections.pose_of, seen.shape)[seen]
    group = np.unique(pose_of, return_inverse=True)[1]
    distance = np.linalg.norm(error[seen], axis=1)
    return float(np.exp(np.mean(np.log(medians(distance[:, None], group) + 1e-12))))


def left_out_errors(few: Solution) -> FloatArray:
    """Errors (V, N, 2) of images at the joint readings of a pose, by a fit without it to first order, px.

    Residuals of detections that count grow by the leverage of their pose: (I − U Uᵀ)⁻¹, with U Uᵀ the
    projection on changes by the parameters. For few markers.
    """
    problem, params, detections, used = few.problem, few.params, few.problem.detections, few.used
    raw = problem.with_noise(None).residual(params)
    U = problem.whitened(params, problem.dense(problem.derivative(params), used), used) @ few.errors().dense()
    left = problem.whitened(params, few.raw.reshape(-1, 1), used)[:, 0]
    pose_of = np.repeat(np.tile(detections.pose_of, len(used)), 2)
    for k in np.unique(detections.pose_of):
        rows = np.flatnonzero(pose_of == k)
        P, s, _ = np.linalg.svd(U[rows], full_matrices=False)
        left[rows] += P @ (s**2 / np.maximum(1.0 - s**2, _MIN_LEFT) * (P.T @ left[rows]))
    if problem.tau is not None:
        left = JointErrors(problem, params, used, problem.tau).coloured(left[:, None])[:, 0]
    error = np.where(used[..., None], left.reshape(raw.shape), raw) / detections.weight[..., None]
    return np.asarray(error)


def solve(search: Search, expected: Expected, nominal: Nominal | None) -> tuple[Solution, Finding | None]:
    """Best fit, and a finding on a given start that did not lead there.

    A start is accepted if its fit leaves the expected noise; otherwise a search from the images alone
    competes.

    Raises InputError if the start is for other joints or markers; WorkFailed if neither succeeds.
    """
    if nominal is None:
        return _solve_from_images(search, expected), None
    problem, found = search.problem, None
    params = nominal.start(problem.detections, problem.q_reference)
    pixels, depth = problem.pixels(params)
    if np.isfinite(pixels).all() and _sides(depth, problem.detections.seen)[1][problem.detections.seen].all():
        found = fit_from(problem, params, search.epipolar)
    if found is not None:
        explained = fit_joint_noise(found, expected, search.joint_noise)
        if expected.agrees(explained):
            return explained, None
    try:
        searched = _solve_from_images(search, expected)
    except WorkFailed:
        if found is None or expected.refusal(found) is not None:
            raise
        return found, None
    if found is not None and found.typical_px <= (1.0 + _SAME_LEVEL) * searched.typical_px:
        return found, None
    level = math.nan if found is None else found.typical_px
    subject = Subject(name=nominal.where)
    return searched, Finding("unused_start", LIMITS, subject, level, limit=searched.typical_px, unit="px")


def _solve_from_images(search: Search, expected: Expected) -> Solution:
    """Best fit over the starts; the first that leaves only the expected noise ends the search.

    Raises Misfit if no start succeeds; WorkFailed if too little was seen to start from.
    """
    whole, epipolar = search.problem, search.epipolar
    best: Solution | None = None
    trusted = np.ones(len(whole.q), dtype=bool)
    levels: list[float] = []
    for number, factors in enumerate(_FOCAL_FACTORS):
        # Each pass draws other markers if there are many.
        few = starting_markers(whole.detections, epipolar, search.rng)
        problem = whole if few.all() else whole.of_markers(few)
        search, detections = dataclasses.replace(search, problem=problem), problem.detections
        rows = detections.seen & trusted[detections.pose_of]
        guesses = islice(starts(search, detections.of_poses(trusted), factors), _SEARCHES)
        for done, start in enumerate(guesses, number * _SEARCHES):
            search.progress("calibration, starts", done, len(_FOCAL_FACTORS) * _SEARCHES)
            params, level = _robust_search(problem, start, rows, epipolar)
            # Starts that converge to the same parameters are fitted once.
            if any(abs(level - other) < _SAME_LEVEL * other for other in levels):
                # Converging there again without gross misfit, more starts would not improve it.
                if best is not None and expected.ratio(best) <= REFUSE_RATIO:
                    return best
                continue
            levels.append(level)
            hopeless = _HOPELESS if search.joint_noise == 0.0 else np.inf
            M = np.full((len(few), 4), np.nan)
            M[few] = params.M
            params = dataclasses.replace(params, M=M)
            found = fit_inliers(whole, params, level / RAYLEIGH, epipolar.noise_px, hopeless=hopeless)
            if found is None:
                continue
            if best is not None and _same_fit(found, best) and expected.ratio(best) <= REFUSE_RATIO:
                return best
            if best is None or found.typical_px < best.typical_px:
                best = found
                explained = fit_joint_noise(found, expected, search.joint_noise)
                if expected.agrees(explained):
                    return explained
                if explained.problem.tau is None:  # keeps the noise of joints, estimated as zero
                    best = explained
            if factors != _FOCAL_FACTORS[0] and expected.refusal(best) is None:
                return best
        if best is not None:
            if expected.refusal(best) is None:
                return best
            # Wrong joint readings spoil the start, and stand out once the rest is roughly explained.
            before, trusted = trusted, _explained(best)
            if not np.array_equal(before, trusted):
                levels = []
    if best is None:
        raise Misfit.by([Finding("no_start", REFUSES)], whole.detections)
    return best


def _same_fit(one: Solution, other: Solution) -> bool:
    """Whether two fits use the same detections and leave the same residuals, as from one minimum."""
    return np.array_equal(one.used, other.used) and abs(one.chi2 - other.chi2) <= _SAME_FIT * other.chi2


def _explained(solution: Solution) -> BoolArray:
    """Mask (K,) of poses whose median residual is within ``_SPOILT`` times the median of all."""
    detections = solution.problem.detections
    poses, group = np.unique(detections.pose_of[np.nonzero(detections.seen)[1]], return_inverse=True)
    distance = np.linalg.norm(solution.residual[detections.seen], axis=1)
    result = np.ones(len(detections.q), dtype=bool)
    result[poses] = medians(distance[:, None], group)[:, 0] <= _SPOILT * solution.typical_px
    return result
