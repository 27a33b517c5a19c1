"""Noise of joint readings: errors in variables, by restricted maximum likelihood, or encoder counts.

The residual of the images of pose k is r = J x + G δ + ε, with ε ~ N(0, σ² I) and δ ~ N(0, σ_q² I), the true
joints less their readings; its covariance is S = σ² I + σ_q² G Gᵀ. Errors of pixels scatter from marker to
marker, while errors of joints move all markers of a pose together: this separates them.

The likelihood takes the markers with most inliers, since more markers say little more about few joints.

Source of the restricted likelihood: H. D. Patterson, R. Thompson, "Recovery of inter-block information when
block sizes are unequal", Biometrika 58(3), 1971; of the test at the border of the parameters: S. G. Self,
K.-Y. Liang, "Asymptotic properties of maximum likelihood estimators and likelihood ratio tests under
nonstandard conditions", JASA 82, 1987.
"""

from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import brentq, minimize_scalar
from scipy.special import chdtri

from projservo_cli.calibration.bundle_adjustment import JointErrors, LeastSquares
from projservo_cli.calibration.detections import MIN_SIGMA, per_rad
from projservo_cli.calibration.prediction import Parameters
from projservo_cli.records import BoolArray, FloatArray

# Minimum noise of joints searched, rad, as of the best encoders.
_MIN_SIGMA_Q = 1e-6
# Maximum noise of joints searched, rad, beyond the noise of any robot.
_MAX_SIGMA_Q = np.radians(1.0)
# Number of noise ratios in the scan.
_GRID = 33
# Noise of translations over that of rotations that is tried, in units of 0.3 m/rad; steps of a refinement,
# and number of noise ratios in the scan of each.
_LEVERS, _LEVER_STEPS, _ROUGH_GRID = (0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0), 8, 13
# Logarithm by which the lower end of the interval may lie below the scan.
_FARTHER = 5.0
# Deviance if the likelihood is not defined.
_NEVER = 1e30
# Logarithm of a noise ratio of zero.
_NONE = -np.inf
# Minimum share of the residual noise that stays with the pixels.
_SHARE = 0.001
# Information of a direction, over the best known direction, below which images leave it open.
_OPEN = 1e-12
# Deviance that χ² exceeds by chance in 1 of 100 cases at the border of the parameters: Self and Liang.
SIGNIFICANT = 5.412
# Deviance at the ends of a 95 % interval, χ² of one degree of freedom.
_INTERVAL = 3.841
# Probability of the bound on the difference of fits without and with noise.
_CHANCE = 0.999
# Factor on that bound, as the test is of first order.
_LENIENT = 1.5
# Maximum number of markers in the likelihood.
_MAX_MARKERS = 50
# Minimum size of encoder ticks, rad or m.
_MIN_TICK = 1e-5
# Distance of a reading from its tick, in minimum ticks, within which it is on it.
_ON_TICK = 0.01


@dataclass(frozen=True)
class JointNoise:
    """Deviation of joint readings from the true joints, rad; of prismatic joints × 0.3 m/rad."""

    sigma_q: float
    interval: FloatArray | None  # (2,) of 95 %; None if it was given or explains nothing
    over_pixels: float  # sigma_q over the noise of pixels, rad/px
    ticks: bool = False  # whether it is that of encoder ticks
    lever: float = 1.0  # factor on the noise of prismatic joints, estimated for translations of a flange

    def tau(self, prismatic: BoolArray) -> FloatArray:
        """Noise of joint readings (n,) over that of pixels, rad/px or m/px."""
        return self.over_pixels * _units(prismatic, self.lever)

    @property
    def sigma_m(self) -> float:
        """Deviation of prismatic joints, or of positions of a flange, m."""
        return float(self.sigma_q * _units(np.array([True]), self.lever)[0])

    @classmethod
    def estimated(
        cls,
        problem: LeastSquares,
        params: Parameters,
        used: BoolArray,
        sigma_px: float | None,
        min_px: float = 0.0,
    ) -> "JointNoise":
        """Estimate by maximum likelihood from the detections used (V, N).

        sigma_px : noise of pixels, None for any that is at least ``min_px``.

        Zero if it is not significant; the noise of encoder ticks if readings lie on ticks and the interval
        contains it.
        """
        detections = problem.detections
        keep = np.zeros(len(params.M), dtype=np.bool_)
        keep[np.argsort(-detections.count_of(used), kind="stable")[:_MAX_MARKERS]] = True
        if not keep.all():
            used, params = used[:, keep[detections.marker_of]], replace(params, M=params.M[keep])
            problem = problem.of_markers(keep)
        likelihood = _Likelihood(problem, params, used, sigma_px)
        if problem.detections.chart is not None:
            likelihood = likelihood.with_lever()
        # Logarithms of the ratio of both noises, rad/px; at the maximum pixels may have far less noise.
        sigma = max(likelihood.sigma(_NONE), MIN_SIGMA)
        ends = (
            _MIN_SIGMA_Q / sigma,
            _MAX_SIGMA_Q / (sigma if likelihood.given is not None else _SHARE * sigma),
        )
        log_ratios = np.log(np.geomspace(*ends, _GRID))
        values = [likelihood.deviance(log_ratio) for log_ratio in log_ratios]
        best = int(np.argmin(values))
        bounds = log_ratios[max(best - 1, 0)], log_ratios[min(best + 1, _GRID - 1)]
        found = minimize_scalar(likelihood.deviance, bounds=bounds, method="bounded")
        log_ratio, minimum, none = float(found.x), float(found.fun), likelihood.deviance(_NONE)
        if sigma_px is None and likelihood.sigma(log_ratio) < min_px:
            return cls.estimated(problem, params, used, min_px)

        def beyond(at: float) -> float:
            """Deviance beyond the end of the interval."""
            return likelihood.deviance(at) - minimum - _INTERVAL

        low, high = 0.0, _MAX_SIGMA_Q
        low_end = log_ratios[0] - _FARTHER
        # Residuals of tens of px, as of images of two sizes, leave no noise of joints that is too small.
        if none - minimum > _INTERVAL and beyond(low_end) > 0.0:
            low = likelihood.sigma_q(brentq(beyond, low_end, log_ratio))
        if beyond(log_ratios[-1]) > 0.0:
            high = likelihood.sigma_q(brentq(beyond, log_ratio, log_ratios[-1]))
        if high >= _MAX_SIGMA_Q:  # a wrong model asks for any amount of noise
            return NO_JOINT_NOISE
        if none - minimum <= SIGNIFICANT:
            return cls(0.0, np.array([0.0, high]), 0.0)
        if likelihood.contradicted(log_ratio):
            return NO_JOINT_NOISE
        of_joints = problem.detections.chart is None
        counted = _tick_noise(problem.detections.q, problem.detections.prismatic) if of_joints else 0.0
        ticks, sigma_q = low <= counted <= high, likelihood.sigma_q(log_ratio)
        taken = counted if ticks else sigma_q
        over_pixels = float(np.exp(log_ratio)) * taken / sigma_q
        return cls(taken, np.array([low, high]), over_pixels, ticks, likelihood.lever)


NO_JOINT_NOISE = JointNoise(0.0, None, 0.0)  # if no noise of joints explains the residuals


class _Likelihood:
    """Restricted likelihood of the residuals, by the logarithm of the noise of joints over pixels, rad/px."""

    def __init__(
        self,
        problem: LeastSquares,
        params: Parameters,
        used: BoolArray,
        sigma_px: float | None,
        lever: float = 1.0,
    ) -> None:
        self.given, self.lever = sigma_px, lever
        self._data = problem, params, used, sigma_px
        unit, J = _units(problem.detections.prismatic, lever), problem.derivative(params)
        D = problem.dense(J, used)
        A = D.T @ D
        errors, residual = JointErrors(problem, params, used, unit), problem.residual(params)
        if problem.tau is not None:  # at the joint readings
            residual = residual - errors.change(problem.strain(params) * problem.tau / unit)
        residual = used[..., None] * residual
        scale = np.sqrt(np.maximum(np.diagonal(A), 1e-300))
        gauge = scale[:, None] * problem.gauge(params)
        free = np.linalg.qr(gauge, mode="complete")[0][:, gauge.shape[1] :] / scale[:, None]
        values, basis = np.linalg.eigh(free.T @ A @ free)
        # A robot of one or two joints leaves more open than the gauge. Scale so that A is the identity.
        known = values > _OPEN * values[-1]
        free = free @ (basis[:, known] / np.sqrt(values[known]))
        self.dof = 2 * int(np.count_nonzero(used)) - free.shape[1]
        self.eigenvalue = errors.square.ravel()
        self.B = errors.parts(D @ free)
        self.h = errors.parts(residual.ravel())
        self.g = free.T @ (D.T @ residual.ravel())
        self.square = float((residual**2).sum())

    def with_lever(self) -> "_Likelihood":
        """Likelihood with the maximum-likelihood noise of translations over that of rotations."""

        def lowest(log_lever: float) -> float:
            """Lowest deviance with a lever."""
            of = _Likelihood(*self._data, lever=float(np.exp(log_lever)))
            sigma = max(of.sigma(_NONE), MIN_SIGMA)
            scan = np.log(np.geomspace(_MIN_SIGMA_Q / sigma, _MAX_SIGMA_Q / (_SHARE * sigma), _ROUGH_GRID))
            values = [of.deviance(log_ratio) for log_ratio in scan]
            i = int(np.argmin(values))
            ends = scan[max(i - 1, 0)], scan[min(i + 1, _ROUGH_GRID - 1)]
            return float(minimize_scalar(of.deviance, bounds=ends, method="bounded").fun)

        scan = np.log(_LEVERS)
        i = int(np.argmin([lowest(log_lever) for log_lever in scan]))
        ends = scan[max(i - 1, 0)], scan[min(i + 1, len(scan) - 1)]
        found = minimize_scalar(lowest, bounds=ends, method="bounded", options={"maxiter": _LEVER_STEPS})
        return _Likelihood(*self._data, lever=float(np.exp(found.x)))

    def _normal(self, log_ratio: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Normal equations A, g in the free directions, and squared image changes (K n,) by the joints."""
        square = np.exp(2.0 * log_ratio) * self.eigenvalue
        share = square / (1.0 + square)
        A = np.eye(len(self.g)) - (self.B.T * share) @ self.B
        return A, self.g - self.B.T @ (share * self.h), square

    def _parts(self, log_ratio: float) -> tuple[float, float]:
        """Sum of squared residuals, px², and logarithms of determinants."""
        A, g, square = self._normal(log_ratio)
        factor = cho_factor(A)
        left = self.square - float(square / (1.0 + square) @ self.h**2) - float(g @ cho_solve(factor, g))
        logs = 2.0 * float(np.log(np.diagonal(factor[0])).sum())
        return max(left, 1e-300), logs + float(np.log1p(square).sum())

    def contradicted(self, log_ratio: float) -> bool:
        """Whether fits without and with noise of joints differ by more than noise, so the model errs.

        If residuals are noise, both are consistent. If the model errs, as with link deflection, they are
        biased by different amounts: J. A. Hausman, "Specification tests in econometrics", Econometrica 46(6),
        1978. Both are taken to first order, which saves a fit. The second is efficient, so the variance of
        the difference is the difference of the variances.
        """
        A, g, square = self._normal(log_ratio)
        inverse = np.linalg.inv(A)
        apart = self.g - inverse @ g
        variance = np.eye(len(A)) + (self.B.T * square) @ self.B - inverse
        variances = self.sigma(log_ratio) ** 2 * np.maximum(np.linalg.eigvalsh(variance), 0.0)
        return float(apart @ apart) > _LENIENT * quantile(variances, _CHANCE)

    def deviance(self, log_ratio: float) -> float:
        """Twice the negative log-likelihood, up to a constant, at the maximum-likelihood noise of pixels."""
        try:
            left, logs = self._parts(log_ratio)
        except np.linalg.LinAlgError:  # joints that may be anywhere leave the robot undetermined
            return _NEVER
        if self.given is not None:
            return left / self.given**2 + logs
        return float(self.dof * np.log(left) + logs)

    def sigma(self, log_ratio: float) -> float:
        """Noise of pixels, px: as given, otherwise the maximum-likelihood one."""
        if self.given is not None:
            return self.given
        return float(np.sqrt(self._parts(log_ratio)[0] / max(self.dof, 1)))

    def sigma_q(self, log_ratio: float) -> float:
        """Noise of joints, rad."""
        return float(np.exp(log_ratio) * self.sigma(log_ratio))


def _units(prismatic: BoolArray, lever: float) -> FloatArray:
    """Noise of joints (n,) for each rad of that of revolute ones."""
    return np.where(prismatic, lever, 1.0) * per_rad(prismatic)


def _tick_noise(q: FloatArray, prismatic: BoolArray) -> float:
    """Noise, rms of the joints, rad, of readings (K, n) rounded to encoder ticks; 0 without ticks."""
    ticks = np.array([_tick(column) for column in q.T])
    if (ticks == 0.0).any():
        return 0.0
    return float(np.sqrt(np.mean((ticks / per_rad(prismatic)) ** 2) / 12.0))


def _tick(values: FloatArray) -> float:
    """Step of which all distances of values (K,) are multiples; 0 if there is none."""
    steps = np.diff(np.unique(values))
    steps = steps[steps > 0.1 * _MIN_TICK]
    tick = reduce(_common_measure, steps.tolist(), 0.0)
    return float(np.median(steps / np.round(steps / tick))) if len(steps) > 1 and tick >= _MIN_TICK else 0.0


def _common_measure(a: float, b: float) -> float:
    """Greatest common measure of two rounded numbers, by Euclid's algorithm."""
    while b > _ON_TICK * _MIN_TICK:
        a, b = b, abs(a - b * round(a / b))
    return a


def quantile(variances: FloatArray, probability: float) -> float:
    """Quantile of a sum of squares of independent normal variables of variances (r,), by three moments.

    Source: M. J. Buckley, G. K. Eagleson, "An approximation to the distribution of quadratic forms in
    normal random variables", Australian Journal of Statistics 30A, 1988.
    """
    mean, square, cube = (float((variances**power).sum()) for power in (1, 2, 3))
    if cube == 0.0:
        return mean
    freedom = square**3 / cube**2
    return mean + float(np.sqrt(square / freedom) * (chdtri(freedom, 1.0 - probability) - freedom))
