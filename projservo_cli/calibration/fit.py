"""Fits: a robust search from each start, then least squares of the readings that count, and their noise."""

import dataclasses
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice

import numpy as np
from scipy.special import chdtri

from projservo_cli.calibration.adjustment import LeastSquares, minimize, settled
from projservo_cli.calibration.epipolar import OUTLIER, Epipolar
from projservo_cli.calibration.initialization import Nominal, Search, carrying, starts
from projservo_cli.calibration.joint_noise import NO_JOINT_NOISE, JointNoise
from projservo_cli.calibration.prediction import Scene
from projservo_cli.calibration.readings import RAYLEIGH, even_choice, medians, per_rad
from projservo_cli.calibration.triangulation import Tracks
from projservo_cli.records import BoolArray, Errors, FloatArray, IntArray, WorkFailed

# Fitted noise over the noise expected: above the first, or so many standard errors above one where that
# is less, more than pixel noise is left; above the last the model does not describe the data.
WARN_RATIO, _WARN_ERRORS, REFUSE_RATIO = 1.15, 4.0, 3.0
_CHI2_TAIL = 1e-4
# Standard error of stated noise as a share of it: who states it estimates it, too.
_STATED_ERROR = 0.1
# Factors of stated noise that are believed: beyond them it is not of this detector, or in other units.
_LEAST_SCALE, _MOST_SCALE = 0.3, 5.0
# A direction whose singular value is this share of the largest is open.
OPEN_DIRECTION = 1e-10
# Numbers of the derivative that are dealt with at once: 16 MB.
_AT_ONCE = 2**21
# Corners whose squared residuals are kept, at most.
_MOST_CORNERS = 50_000


class Misfit(WorkFailed):
    """No model of the robot describes what was seen."""


@dataclass(frozen=True, eq=False)
class Solution:
    """The problem solved, the scene found and what it leaves of the images."""

    problem: LeastSquares
    scene: Scene
    residual: FloatArray  # (2, N, 2) predicted minus seen, px, weighed
    used: BoolArray  # (2, N) readings that count; the rest of those seen are outliers
    dof: int  # degrees of freedom
    joint_noise: JointNoise | None = None  # of joint readings; None where it was not asked for

    @property
    def chi2(self) -> float:
        """Sum of squares of the readings used, px²; joints as far off as their noise allows count too."""
        return float((self.residual[self.used] ** 2).sum() + (self.problem.strain(self.scene) ** 2).sum())

    @property
    def raw(self) -> FloatArray:
        """``residual`` at the joints as read, zero where it does not count."""
        return self.problem.with_noise(None).residual(self.scene) * self.used[..., None]

    def joint_effect(self) -> tuple[float, float]:
        """Root mean square by which joints that are off move a coordinate: over its noise, and px."""
        if self.problem.tau is None:
            return 0.0, 0.0
        G = self.problem.joint_derivative(self.scene)[self.used] * self.problem.tau
        square, weight = (G**2).sum(axis=-1), self.problem.readings.weight[self.used]
        plain = square / weight[:, None] ** 2
        return float(np.sqrt(square.mean())), self.sigma_px * float(np.sqrt(plain.mean()))

    def corners(self) -> tuple[FloatArray | None, FloatArray | None]:
        """Squared residuals (K, 2, m) over their variance, and joints (K, n); None where there are many."""
        readings = self.problem.readings
        shape = (len(readings.q), 2, len(readings.marker))
        if math.prod(shape) > _MOST_CORNERS or not self.sigma_px > 0.0:
            return None, None
        squares = np.full(shape, np.nan)
        found = np.where(self.used, np.square(self.residual).mean(axis=-1) / self.sigma_px**2, np.nan)
        for view in (0, 1):
            squares[readings.pose_of, view, readings.marker_of] = found[view]
        return squares, readings.q.copy()

    @property
    def sigma_px(self) -> float:
        """Noise per coordinate that the residuals show, px."""
        return float(np.sqrt(self.chi2 / max(self.dof, 1)))

    @property
    def rms_px(self) -> float:
        """Root mean square of the Euclidean residual per marker and view at the joints as read, px."""
        raw = self.raw / self.problem.readings.weight[..., None]
        return float(np.sqrt((raw[self.used] ** 2).sum() / max(int(self.used.sum()), 1)))

    @property
    def typical_px(self) -> float:
        """Median residual over all readings seen, outliers included, px."""
        return median_px(self.residual, self.problem.readings.seen)

    def determined(self) -> tuple["Solution", BoolArray]:
        """The solution without markers of which hardly any reading counts, and which markers (m,) stay."""
        readings = self.problem.readings
        # One reading is less than a marker's three coordinates; a few among many wrong ones agree by chance.
        keep = readings.count_of(self.used) >= np.maximum(2, _LEAST_SHARE * readings.count_of(readings.seen))
        if keep.all():
            return self, keep
        return self._of_markers(keep), keep

    def _of_markers(self, keep: BoolArray) -> "Solution":
        """What it says of some of the markers (m,)."""
        rows = keep[self.problem.readings.marker_of]
        smaller, scene = _of_markers(self.problem, self.scene, keep)
        used = self.used[:, rows]
        dof = _degrees_of_freedom(smaller, scene, used)
        return Solution(smaller, scene, self.residual[:, rows], used, dof, self.joint_noise)

    def of_some(self, most: int) -> "Solution":
        """What it says of at most so many of the markers, evenly chosen."""
        m = self.problem.readings.marker.size
        return self if m <= most else self._of_markers(np.isin(np.arange(m), even_choice(m, most)))

    def kept(self) -> "Solution":
        """The solution of the readings that count alone."""
        readings, rows = self.problem.readings, np.asarray(self.used.any(axis=0))
        some = dataclasses.replace(readings, seen=self.used).rows(rows)
        return dataclasses.replace(
            self,
            problem=dataclasses.replace(self.problem, readings=some),
            residual=self.residual[:, rows],
            used=self.used[:, rows],
        )

    def errors(self) -> Errors:
        """Errors of the parameters at a noise of one pixel: (JᵀS⁻¹J)⁺ where readings determine it.

        Factors of J itself keep the weakest direction, which the normal matrix would lose. The columns of a
        marker are projected out of its own rows, what is left tells the other parameters (B. Triggs et al.,
        "Bundle adjustment: a modern synthesis", 1999, section 6), which the markers follow. Offsets of joints
        are such parameters too, unless there are more of them than coordinates of markers: then those are,
        and offsets are left out by whitening. A direction left open has errors of enormous length.
        """
        problem, scene = self.problem, self.scene
        s, m, offsets = problem.shared, len(scene.M), 0 if problem.tau is None else problem.q.size
        gauge = problem.gauge(scene)
        if problem.by_pose:
            J = problem.whitened(scene, problem.dense(problem.derivative(scene), self.used), self.used)
            factor = _inverse_root(J, np.linalg.norm(J, axis=0), gauge)
            return Errors(factor[:s], factor[s:].reshape(m, 3, -1), np.zeros((m, 3, 3)))
        R = np.eye(s + offsets)[s:]
        squares = R.sum(axis=0)
        follows, own = np.zeros((m, 3, s + offsets)), np.zeros((m, 3, 3))
        for markers, A, B in self._tracks(s + offsets):
            U, size, Vt = np.linalg.svd(B, full_matrices=False)
            least = OPEN_DIRECTION * size[:, :1]
            U *= (size > least)[:, None]
            own[markers] = Vt.swapaxes(1, 2) / np.maximum(size, least)[:, None]
            along = U.swapaxes(1, 2) @ A
            follows[markers] = -own[markers] @ along
            squares += (A**2).sum(axis=(0, 1))
            left = (A - U @ along).reshape(-1, s + offsets)
            R = np.asarray(np.linalg.qr(np.vstack([R, left]), mode="r"))
        held = np.zeros((s + offsets, gauge.shape[1]))
        held[:s] = gauge[:s]
        factor = _inverse_root(R, np.sqrt(squares), held)
        return Errors(factor[:s], follows @ factor, own)

    def _tracks(self, count: int) -> Iterator[tuple[IntArray, FloatArray, FloatArray]]:
        """Some markers (k,), and of all their rows the derivatives (k, l, count) and (k, l, 3) by them.

        The first by parameters that are shared, then by offsets of joints in units of their noise.
        """
        problem, readings = self.problem, self.problem.readings
        edges = np.searchsorted(readings.marker_of, np.arange(readings.marker.size + 1))
        lengths = np.diff(edges)
        for length in np.unique(lengths[lengths > 0]):
            alike = np.flatnonzero(lengths == length)
            for markers in np.array_split(alike, 1 + 4 * length * count * alike.size // _AT_ONCE):
                at = (edges[markers, None] + np.arange(length)).ravel()
                part, used = problem.rows(at), self.used[:, at, None, None]
                J = part.derivative(self.scene) * used
                A = np.zeros((*J.shape[:3], count + 3))
                for v, columns in enumerate(part.columns):
                    A[v][..., columns] = J[v, ..., :-3]
                if problem.tau is not None:
                    n = len(problem.tau)
                    at_pose = problem.shared + n * part.readings.pose_of[:, None, None] + np.arange(n)
                    G = part.joint_derivative(self.scene) * problem.tau * used
                    np.put_along_axis(A, at_pose[None], G, axis=3)
                A[..., count:] = J[..., -3:]
                A = (
                    A.reshape(2, markers.size, length, 2, -1)
                    .swapaxes(0, 1)
                    .reshape(markers.size, 4 * length, -1)
                )
                yield markers, A[..., :count], A[..., count:]


def _inverse_root(R: FloatArray, scale: FloatArray, gauge: FloatArray) -> FloatArray:
    """L (c, c − g) with L Lᵀ = (RᵀR)⁺ beside a gauge (c, g), for R (l, c), its columns in units (c,)."""
    # A parameter no residual depends on has no scale of its own: it is open whatever the unit.
    scale = np.where(scale > 0.0, scale, scale.max())
    G = np.linalg.qr(scale[:, None] * gauge)[0]
    free = np.linalg.qr(G, mode="complete")[0][:, G.shape[1] :]
    _, s, Vt = np.linalg.svd(np.linalg.qr((R / scale) @ free, mode="r"))
    # Robots of one or two joints leave more directions open than the gauge, none of which matters
    # to an image: they must come out as zero after the product with its derivative.
    return np.asarray((free @ (Vt.T / np.maximum(s, OPEN_DIRECTION * s[0]))) / scale[:, None])


@dataclass(frozen=True)
class Expected:
    """The noise a fit is measured by, px per coordinate."""

    sigma_px: float  # noise that was given, else that of the epipolar geometry
    known: bool  # whether it is the true noise of a simulation, so that χ² decides
    origin: str  # where it comes from, in words
    error: float  # its own standard error as a share of it, zero where it was given
    scale: float | None = None  # true deviations over those stated, where these are judged by the images
    scale_interval: FloatArray | None = None  # (2,) of 95 %

    @classmethod
    def of(
        cls, epipolar: Epipolar, sigma_px: float | None, source: str, stated_px: float | None
    ) -> "Expected":
        """What was given, px, or is stated, known for a ``simulated`` source; else the noise of the rig.

        What is stated in a recording is stated up to a common factor, which both views tell: no joint has a
        part in their epipolar geometry. It is one where its interval holds one.
        """
        if sigma_px is not None:
            return cls(sigma_px, source == "simulated", "that were given", 0.0)
        if stated_px is None:
            return cls(epipolar.noise_px, False, "that the epipolar geometry shows", epipolar.relative_error)
        origin = "that the sigmas of the markers state"
        if source == "simulated":
            return cls(stated_px, True, origin, _STATED_ERROR)
        low, high = interval = epipolar.core.interval / stated_px
        if low <= 1.0 <= high:
            return cls(stated_px, False, origin, _STATED_ERROR, 1.0, interval)
        scale = epipolar.core.sigma_px / stated_px
        origin = f"{origin}, times {scale:.3g} (95 %: {low:.3g} to {high:.3g}) as both views show"
        return cls(scale * stated_px, False, origin, _STATED_ERROR, scale, interval)

    def require_scale(self) -> None:
        """Refuse deviations that are wrong by a factor beyond what can be a matter of the finder."""
        if self.scale is None or self.scale_interval is None:
            return
        low, high = self.scale_interval
        if high < _LEAST_SCALE or low > _MOST_SCALE:
            raise WorkFailed(
                f"the stated deviations of the markers are wrong: both views disagree by {self.scale:.3g} "
                f"times (95 %: {low:.3g} to {high:.3g}) what sigma_left and sigma_right state, "
                f"{_LEAST_SCALE:g} to {_MOST_SCALE:g} times is believed; state them {self.scale:.3g} times "
                "as large, or leave both columns out"
            )

    def ratio(self, solution: Solution) -> float:
        """Fitted over expected noise."""
        return solution.sigma_px / self.sigma_px

    def noise_px(self, solution: Solution) -> float:
        """Noise a covariance is scaled by, px: the true one of a simulation, else never below the fitted."""
        return self.sigma_px if self.known else max(self.sigma_px, solution.sigma_px)

    def warns(self, solution: Solution) -> bool:
        """Whether more than pixel noise is left: both noises come from finitely many residuals."""
        error = float(np.hypot(self.error, 1.0 / np.sqrt(2.0 * max(solution.dof, 1))))
        return self.ratio(solution) > min(WARN_RATIO, 1.0 + _WARN_ERRORS * error)

    def agrees(self, solution: Solution) -> bool:
        """Whether a fit leaves nothing but the expected noise, so that no other need be sought."""
        if self.known:
            low, high = chi2_band(solution.dof)
            return low <= self.ratio(solution) ** 2 <= high
        return not self.warns(solution)

    def refusal(self, solution: Solution) -> str | None:
        """Why a fit must not pass, or None where it may."""
        ratio = self.ratio(solution)
        if self.known and not self.agrees(solution):
            low, high = chi2_band(solution.dof)
            return (
                f"the fit does not describe the data: χ² per degree of freedom is {ratio**2:.4g} at "
                f"{self.sigma_px:g} px of noise, expected within {low:.4g} and {high:.4g}"
            )
        if ratio > REFUSE_RATIO:
            return (
                f"the fit does not describe the data: residuals of {solution.sigma_px:.3g} px a coordinate "
                f"are {ratio:.3g} times the {self.sigma_px:.3g} px {self.origin}; check the "
                "joint readings, their units and types, and the marker numbers"
            )
        return None


def chi2_band(dof: int) -> tuple[float, float]:
    """Quantiles of χ² per degree of freedom between which a true model stays, all but 2e-4 of the time."""
    return float(chdtri(dof, 1.0 - _CHI2_TAIL)) / dof, float(chdtri(dof, _CHI2_TAIL)) / dof


_MASK_ROUNDS = 4
# Share of the sightings that are wrong beyond which tracks are, too; of the readings that may come and go
# between rounds; least readings of a marker that speak for each other where others do not.
_MANY, _FLICKER, _VERIFIED = 0.01, 2e-4, 3
# Noise over that of the rig beyond which the model errs, and what does not fit it need not be wrong.
_RIG = 1.5
# Chance with which noise alone makes the readings of a pose count for nothing.
_POSE_TAIL = 1e-7
# Least share of the readings of a marker that must count for it to be part of the model.
_LEAST_SHARE = 0.25
# A start that leaves this many times the epipolar noise after the robust search is a wrong one.
_HOPELESS = 10.0
# A robust search that would still be refused and has come nearer by less than this share over so many
# steps is not continued.
_CRAWL, _PATIENCE = 0.01, 10


def median_px(residual: FloatArray, mask: BoolArray) -> float:
    """Median length of the residuals (2, N, 2) in a mask (2, N), px."""
    return float(np.median(np.linalg.norm(residual[mask], axis=1)))


def _crawling(seen: BoolArray, far: float) -> Callable[[FloatArray], bool]:
    """Whether a search is farther off than a noise, px, and hardly comes nearer, asked after each step."""
    levels: list[float] = []

    def stalled(residual: FloatArray) -> bool:
        levels.append(median_px(residual, seen))
        if len(levels) <= _PATIENCE or levels[-1] <= RAYLEIGH * far:
            return False
        return levels[-1] > (1.0 - _CRAWL) * levels[-1 - _PATIENCE]

    return stalled


def fit_from(problem: LeastSquares, scene: Scene, epipolar: Epipolar) -> Solution | None:
    """The fit that a scene leads to: a robust search, then ``fit_inliers``."""
    searched, level = _robust_search(problem, scene, problem.readings.seen, epipolar)
    return fit_inliers(problem, searched, level / RAYLEIGH, epipolar.noise_px, hopeless=_HOPELESS)


def _robust_search(
    problem: LeastSquares, scene: Scene, rows: BoolArray, epipolar: Epipolar
) -> tuple[Scene, float]:
    """Screws alone, then everything, under a Cauchy loss over some readings (2, N): scene, median px."""
    scene = minimize(problem, scene, rows, robust=True, cameras=False, most=20).scene
    stalled = _crawling(rows, REFUSE_RATIO * epipolar.noise_px)
    fit = minimize(problem, scene, rows, robust=True, most=100, stalled=stalled)
    return fit.scene, median_px(fit.residual, rows)


def fit_inliers(
    problem: LeastSquares, scene: Scene, sigma: float, rig_px: float = 0.0, *, hopeless: float = np.inf
) -> Solution | None:
    """Least squares of the readings that count, in rounds until they no longer change.

    Those within 5σ, from a robust noise σ, px; at no more than the noise of the rig, px, also by track.
    Where the first is hopelessly many times the second it is not worth the time. None where the fit does
    not put the points in front of both cameras.
    """
    if sigma > hopeless * rig_px:
        if (lost := ~np.isfinite(scene.M[:, 0])).any():
            scene = dataclasses.replace(scene, M=Tracks(problem, scene).placed(lost, sigma))
        residual, seen = problem.residual(scene), problem.readings.seen
        dof = _degrees_of_freedom(problem, scene, seen)
        return Solution(problem, scene, residual, seen, dof) if dof > 0 else None
    scene, within = _within(problem, scene, max(sigma, 1e-9), max(sigma, 1e-9), rig_px)
    for _ in range(_MASK_ROUNDS):
        used = within
        keep = problem.readings.count_of(used) > 0
        some, smaller = _of_markers(problem, scene, keep)
        fit = minimize(some, smaller, used[:, keep[problem.readings.marker_of]], robust=False)
        M = scene.M.copy()
        M[keep] = fit.scene.M
        scene = dataclasses.replace(fit.scene, M=M)
        dof = _degrees_of_freedom(some, fit.scene, used)
        if dof <= 0:
            return None
        # Wrong ones that are still among them widen the tail and hardly the middle.
        share = float(np.sqrt(2.0 * np.count_nonzero(used) / dof))
        middle = max(share * median_px(problem.residual(scene), used) / RAYLEIGH, 1e-9)
        sigma = max(float(np.sqrt(fit.cost / dof)), 1e-9)
        judged, within = _within(problem, scene, sigma, middle, rig_px)
        if np.count_nonzero(used != within) <= _FLICKER * used.size:
            break
        scene = judged
    _, depth = problem.pixels(scene)
    sign, ahead = _sides(depth, used)
    if not ahead[used].all():
        return None
    scene = dataclasses.replace(scene, P=scene.P * sign[:, None, None])
    return Solution(problem, scene, problem.residual(scene), used, dof)


def _of_markers(problem: LeastSquares, scene: Scene, keep: BoolArray) -> tuple[LeastSquares, Scene]:
    """The problem and the scene of some of the markers (m,)."""
    if keep.all():
        return problem, scene
    return problem.of_markers(keep), dataclasses.replace(scene, M=scene.M[keep])


def _sides(depth: FloatArray, used: BoolArray) -> tuple[FloatArray, BoolArray]:
    """Signs (2,) of the cameras, and which points of depths (2, N) lie on the side of most of those used."""
    sign = np.sign((depth * used).sum(axis=1))
    return sign, np.sign(depth) == sign[:, None]


def _within(
    problem: LeastSquares, scene: Scene, sigma: float, middle: float, rig_px: float
) -> tuple[Scene, BoolArray]:
    """Readings (2, N) that count at a noise σ, px, and the scene with markers where most of theirs agree.

    Those within 5σ; where more are not than single wrong ones, those that agree with the others of their
    marker, but of markers of which most agree. All of them at poses where not far less than elsewhere agrees,
    and where joints have noise, at poses that it explains: a wrong reading hides among many small errors.
    """
    readings, limit = problem.readings, OUTLIER * sigma
    if (lost := ~np.isfinite(scene.M[:, 0])).any():
        scene = dataclasses.replace(scene, M=Tracks(problem, scene).placed(lost, sigma))
    rested = settled(problem, scene)
    good = _near(problem, rested, limit)
    many = np.mean((readings.seen & ~good).any(axis=0)) > _MANY and middle <= _RIG * rig_px
    if many:
        # What slips along both views alike shows in this noise and not in that of the rig.
        sigma = min(sigma, middle if middle > WARN_RATIO * rig_px else min(middle, rig_px))
        doubtful = readings.count_of(readings.seen & ~good) > 0
        M = Tracks(problem, rested).placed(doubtful, sigma)
        rested = dataclasses.replace(rested, M=M)
        M, good = Tracks(problem, rested).tested(sigma, _near(problem, rested, OUTLIER * sigma))
        scene, rested = (dataclasses.replace(one, M=M) for one in (scene, rested))
    share = readings.count_at(good) / np.maximum(readings.count_at(readings.seen), 1)
    most = share >= 0.5 * np.median(share[np.unique(readings.pose_of)])
    if problem.tau is not None:
        residual, strain = problem.residual(rested), problem.strain(rested)
        square = problem.at_poses((residual**2 * good[..., None]).sum(axis=(0, 2))) + (strain**2).sum(axis=1)
        allowed = chdtri(np.maximum(2 * readings.count_at(good), 1), _POSE_TAIL) * sigma**2
        most &= (np.abs(strain) <= limit).all(axis=1) & (square <= allowed)
    good &= most[readings.pose_of]
    if many:
        kept, of = (readings.count_of(part & most[readings.pose_of]) for part in (good, readings.seen))
        good &= ((kept >= 0.5 * of) & ((kept >= _VERIFIED) | (kept == of)))[readings.marker_of]
    return scene, np.asarray(good)


def _near(problem: LeastSquares, scene: Scene, limit: float) -> BoolArray:
    """Readings (2, N) within a limit, px."""
    near = np.linalg.norm(problem.residual(scene), axis=2) <= limit
    return np.asarray(problem.readings.seen & near)


def _degrees_of_freedom(problem: LeastSquares, scene: Scene, used: BoolArray) -> int:
    """Coordinates used minus the rank of their derivative."""
    return 2 * int(np.count_nonzero(used)) - problem.size + len(problem.gauge(scene).T)


_NOISE_ROUNDS, _NOISE_SETTLED = 5, 0.01
# Relative difference of residuals below which two fits have ended at one place.
_SAME_LEVEL = 1e-3


def with_joint_noise(exact: Solution, expected: Expected, given: float | None) -> Solution:
    """A fit adjusted anew with joint readings that err, by so much, rad, or as is most likely for None.

    The fit itself where they do not, as far as the images show, or no noise of joints explains them.
    """
    if given == 0.0 or exact.joint_noise is not None:
        return exact
    sigma_px, solution = expected.sigma_px if expected.known else None, exact
    for _ in range(_NOISE_ROUNDS):
        before = solution.joint_noise
        if given is not None:
            noise = JointNoise(given, None, given / expected.sigma_px)
        else:
            noise = JointNoise.estimated(solution.problem, solution.scene, solution.used, sigma_px)
        if noise.sigma_q == 0.0:
            return dataclasses.replace(exact, joint_noise=noise)
        if before is not None and abs(noise.sigma_q - before.sigma_q) <= _NOISE_SETTLED * before.sigma_q:
            break
        problem = exact.problem.with_noise(noise.over_pixels * per_rad(exact.problem.readings.prismatic))
        # What joints that err did to the scene hides that their noise explains the images.
        scene = minimize(problem, solution.scene, solution.used, robust=True, most=20).scene
        found = fit_inliers(problem, scene, noise.sigma_q / noise.over_pixels)
        if found is None:
            return dataclasses.replace(exact, joint_noise=NO_JOINT_NOISE)
        solution = dataclasses.replace(found, joint_noise=noise)
    return solution


# Passes over the starts until one is good enough: factors of the focal length that fits best, for a
# wrong one often leads where the best does not. After a pass, poses whose residual is so many times
# the median are left out of the next.
_FOCAL_FACTORS = ((1.0,), (1.0, 0.6), (1.6, 0.4, 2.5))
_SPOILT = 8.0
# Most searches a pass: data that fit no robot are refused within seconds.
_SEARCHES = 5


def solve(search: Search, expected: Expected, nominal: Nominal | None) -> tuple[Solution, str]:
    """The best fit, and advice about a given start where it did not lead there, else empty.

    From a start the fit it leads to, if that leaves the expected noise, else the best of it and a search from
    the images alone.

    Raises InputError if the start is one for other joints or markers; WorkFailed if neither leads anywhere.
    """
    if nominal is None:
        return _solve_from_images(search, expected), ""
    problem, found = search.problem, None
    scene = nominal.scene(problem.readings, problem.q_reference)
    pixels, depth = problem.pixels(scene)
    if np.isfinite(pixels).all() and _sides(depth, problem.readings.seen)[1][problem.readings.seen].all():
        found = fit_from(problem, scene, search.epipolar)
    if found is not None:
        explained = with_joint_noise(found, expected, search.joint_noise)
        if expected.agrees(explained):
            return explained, ""
    try:
        searched = _solve_from_images(search, expected)
    except WorkFailed:
        if found is None or expected.refusal(found) is not None:
            raise
        return found, ""
    if found is not None and found.typical_px <= (1.0 + _SAME_LEVEL) * searched.typical_px:
        return found, ""
    leads = (
        "does not put the markers in front of both cameras"
        if found is None
        else f"leads to residuals of {found.typical_px:.3g} px instead of {searched.typical_px:.3g} px"
    )
    return searched, (
        f"{nominal.where} was no start: it {leads}; the search from the images alone was used, "
        "so check whether the file is about this robot and rig"
    )


def _solve_from_images(search: Search, expected: Expected) -> Solution:
    """Best fit over the starts; the first that leaves nothing but the expected noise ends the search.

    Raises Misfit if no start leads anywhere; WorkFailed if too little was seen to start from.
    """
    whole, epipolar = search.problem, search.epipolar
    best: Solution | None = None
    trusted = np.ones(len(whole.q), dtype=bool)
    levels: list[float] = []
    for number, factors in enumerate(_FOCAL_FACTORS):
        # Of many markers other ones each time.
        few = carrying(whole.readings, epipolar.noise_px, search.rng)
        problem = whole if few.all() else whole.of_markers(few)
        search, readings = dataclasses.replace(search, problem=problem), problem.readings
        rows = readings.seen & trusted[readings.pose_of]
        scenes = islice(starts(search, readings.of_poses(trusted), factors), _SEARCHES)
        for done, start in enumerate(scenes, number * _SEARCHES):
            search.tell("calibration, starts", done, len(_FOCAL_FACTORS) * _SEARCHES)
            scene, level = _robust_search(problem, start, rows, epipolar)
            # Different starts that end at one place need not be followed to the end twice.
            if any(abs(level - other) < _SAME_LEVEL * other for other in levels):
                # Twice the same place and no gross misfit: more starts would not better it.
                if best is not None and expected.ratio(best) <= REFUSE_RATIO:
                    return best
                continue
            levels.append(level)
            hopeless = _HOPELESS if search.joint_noise == 0.0 else np.inf
            M = np.full((len(few), 4), np.nan)
            M[few] = scene.M
            scene = dataclasses.replace(scene, M=M)
            found = fit_inliers(whole, scene, level / RAYLEIGH, epipolar.noise_px, hopeless=hopeless)
            if found is None:
                continue
            if best is None or found.typical_px < best.typical_px:
                best = found
                explained = with_joint_noise(found, expected, search.joint_noise)
                if expected.agrees(explained):
                    return explained
                if explained.problem.tau is None:  # which need not be found again
                    best = explained
            if factors != _FOCAL_FACTORS[0] and expected.refusal(best) is None:
                return best
        if best is not None:
            if expected.refusal(best) is None:
                return best
            # Wrong joint readings spoil the start: once the rest is roughly explained they stand out.
            before, trusted = trusted, _explained(best)
            if not np.array_equal(before, trusted):
                levels = []
    if best is None:
        raise Misfit(
            "the data contradict the joint readings from the start: check that they belong to their poses, "
            "their units (rad, m) and types (R or P), and that rows of one pose belong together"
        )
    return best


def _explained(solution: Solution) -> BoolArray:
    """Poses (K,) whose median residual is within some times that of all."""
    readings = solution.problem.readings
    poses, group = np.unique(readings.pose_of[np.nonzero(readings.seen)[1]], return_inverse=True)
    distance = np.linalg.norm(solution.residual[readings.seen], axis=1)
    result = np.ones(len(readings.q), dtype=bool)
    result[poses] = medians(distance[:, None], group)[:, 0] <= _SPOILT * solution.typical_px
    return result
