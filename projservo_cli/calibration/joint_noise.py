"""Noise of joint readings: errors in variables, by restricted maximum likelihood, or encoder counts.

What is left of the images of pose k is r = J x + G δ + ε, with ε ~ N(0, σ² I) and δ ~ N(0, σ_q² I), the true
joints less their readings: of covariance S = σ² I + σ_q² G Gᵀ. Errors of pixels scatter from marker to
marker, those of joints move all markers of a pose together, which is how they are told apart.

It is taken over the markers of which most readings count, for many markers say no more about few joints.

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

from projservo_cli.calibration.adjustment import JointErrors, LeastSquares
from projservo_cli.calibration.prediction import Scene
from projservo_cli.calibration.readings import per_rad
from projservo_cli.records import BoolArray, FloatArray

# Noise of joints that is looked for, rad: of the best encoders, and beyond any robot.
_LEAST, _MOST = 1e-6, np.radians(1.0)
_GRID, _FARTHER, _NEVER, _NONE = 33, 5.0, 1e30, -np.inf
_SHARE = 0.001  # of what is left without noise of joints, that pixels may be to blame for, at least
_OPEN = 1e-12  # information of a direction that images leave open, over that of the best known one
# Twice the gain of the logarithm of the likelihood by chance: in 1 of 100 at the border; 95 % of an interval.
_SIGNIFICANT, _INTERVAL = 5.412, 3.841
# What fits without and with noise may differ by: so many times what they stay below in 999 of 1,000 cases.
_CHANCE, _LENIENT = 0.999, 1.5
# Markers over which the likelihood is taken, at most.
_MOST_MARKERS = 50
# Ticks are no finer than this, rad or m; readings lie on them to this share.
_LEAST_TICK, _ON_TICK = 1e-5, 0.01


@dataclass(frozen=True)
class JointNoise:
    """Deviation of joint readings from the true joints, rad; of prismatic joints × 0.3 m/rad."""

    sigma_q: float
    interval: FloatArray | None  # (2,) of 95 %; None where it was given or explains nothing
    over_pixels: float  # sigma_q over the noise of pixels, rad/px
    ticks: bool = False  # whether it is that of counted ticks

    @classmethod
    def estimated(
        cls, problem: LeastSquares, scene: Scene, used: BoolArray, sigma_px: float | None
    ) -> "JointNoise":
        """What is most likely by the images used (2, N), at a noise of pixels, or of any for None.

        Zero where chance may do as well. Where readings lie on ticks and the interval holds what these make,
        that is taken.
        """
        readings = problem.readings
        keep = np.zeros(len(scene.M), dtype=np.bool_)
        keep[np.argsort(-readings.count_of(used), kind="stable")[:_MOST_MARKERS]] = True
        if not keep.all():
            used, scene = used[:, keep[readings.marker_of]], replace(scene, M=scene.M[keep])
            problem = problem.of_markers(keep)
        likelihood = _Likelihood(problem, scene, used, sigma_px)
        # Ratios of both noises, rad/px, as logarithms: even steps from the least that matters to the most,
        # at which pixels may be left with far less noise.
        sigma = likelihood.sigma(_NONE)
        ends = _LEAST / sigma, _MOST / (sigma if likelihood.given is not None else _SHARE * sigma)
        places = np.log(np.geomspace(*ends, _GRID))
        values = [likelihood.deviance(place) for place in places]
        best = int(np.argmin(values))
        near = places[max(best - 1, 0)], places[min(best + 1, _GRID - 1)]
        found = minimize_scalar(likelihood.deviance, bounds=near, method="bounded")
        place, least, none = float(found.x), float(found.fun), likelihood.deviance(_NONE)

        def beyond(at: float) -> float:
            """How far a place is beyond the interval."""
            return likelihood.deviance(at) - least - _INTERVAL

        low, high = 0.0, _MOST
        if none - least > _INTERVAL:
            low = likelihood.sigma_q(brentq(beyond, places[0] - _FARTHER, place))
        if beyond(places[-1]) > 0.0:
            high = likelihood.sigma_q(brentq(beyond, place, places[-1]))
        if high >= _MOST:  # no noise: a model that is wrong asks for any amount of it
            return NO_JOINT_NOISE
        if none - least <= _SIGNIFICANT:
            return cls(0.0, np.array([0.0, high]), 0.0)
        if likelihood.contradicted(place):
            return NO_JOINT_NOISE
        counted = tick_noise(problem.readings.q, problem.readings.prismatic)
        ticks, sigma_q = low <= counted <= high, likelihood.sigma_q(place)
        taken = counted if ticks else sigma_q
        return cls(taken, np.array([low, high]), float(np.exp(place)) * taken / sigma_q, ticks)


NO_JOINT_NOISE = JointNoise(0.0, None, 0.0)  # where none explains what is left


class _Likelihood:
    """Restricted likelihood of what is left of the images about a scene.

    At a place: the logarithm of the noise of joints over that of pixels, rad/px.
    """

    def __init__(self, problem: LeastSquares, scene: Scene, used: BoolArray, sigma_px: float | None) -> None:
        self.given = sigma_px
        unit, J = per_rad(problem.readings.prismatic), problem.derivative(scene)
        D = problem.dense(J, used)
        A = D.T @ D
        errors, residual = JointErrors(problem, scene, used, unit), problem.residual(scene)
        if problem.tau is not None:  # at the joints as read
            residual = residual - errors.change(problem.strain(scene) * problem.tau / unit)
        residual = used[..., None] * residual
        scale = np.sqrt(np.maximum(np.diagonal(A), 1e-300))
        gauge = scale[:, None] * problem.gauge(scene)
        free = np.linalg.qr(gauge, mode="complete")[0][:, gauge.shape[1] :] / scale[:, None]
        values, basis = np.linalg.eigh(free.T @ A @ free)
        # A robot of one or two joints leaves more open than the gauge. In units in which A is the identity.
        known = values > _OPEN * values[-1]
        free = free @ (basis[:, known] / np.sqrt(values[known]))
        self.dof = 2 * int(np.count_nonzero(used)) - free.shape[1]
        self.eigenvalue = errors.square.ravel()
        self.B = errors.parts(D @ free)
        self.h = errors.parts(residual.ravel())
        self.g = free.T @ (D.T @ residual.ravel())
        self.square = float((residual**2).sum())

    def _normal(self, place: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Normal equations A, g in the free directions, and squares (K n,) of what joints do to images."""
        square = np.exp(2.0 * place) * self.eigenvalue
        share = square / (1.0 + square)
        A = np.eye(len(self.g)) - (self.B.T * share) @ self.B
        return A, self.g - self.B.T @ (share * self.h), square

    def _parts(self, place: float) -> tuple[float, float]:
        """Squares that are left, px², and logarithms of determinants, at a place."""
        A, g, square = self._normal(place)
        factor = cho_factor(A)
        left = self.square - float(square / (1.0 + square) @ self.h**2) - float(g @ cho_solve(factor, g))
        logs = 2.0 * float(np.log(np.diagonal(factor[0])).sum())
        return max(left, 1e-300), logs + float(np.log1p(square).sum())

    def contradicted(self, place: float) -> bool:
        """Whether fits without and with noise of joints predict images that noise alone does not set apart.

        Both are right where what is left is noise, and the first only wastes some of the data. Where the
        model errs, as for links that flex, they are off by different amounts: J. A. Hausman, "Specification
        tests in econometrics", Econometrica 46(6), 1978. Both are taken to first order about the scene,
        so that no fit is made for nothing. The second is the most precise one where there is such noise,
        so that the variance of the difference is the difference of the variances.
        """
        A, g, square = self._normal(place)
        inverse = np.linalg.inv(A)
        apart = self.g - inverse @ g
        variance = np.eye(len(A)) + (self.B.T * square) @ self.B - inverse
        variances = self.sigma(place) ** 2 * np.maximum(np.linalg.eigvalsh(variance), 0.0)
        return float(apart @ apart) > _LENIENT * quantile(variances, _CHANCE)

    def deviance(self, place: float) -> float:
        """Twice the negative logarithm of the likelihood, up to a constant; of the best noise of pixels."""
        try:
            left, logs = self._parts(place)
        except np.linalg.LinAlgError:  # of joints that may be anywhere nothing is left to tell the robot by
            return _NEVER
        if self.given is not None:
            return left / self.given**2 + logs
        return float(self.dof * np.log(left) + logs)

    def sigma(self, place: float) -> float:
        """Noise of pixels at a place: as given, else the most likely one, px."""
        if self.given is not None:
            return self.given
        return float(np.sqrt(self._parts(place)[0] / max(self.dof, 1)))

    def sigma_q(self, place: float) -> float:
        """Noise of joints at a place, rad."""
        return float(np.exp(place) * self.sigma(place))


def tick_noise(q: FloatArray, prismatic: BoolArray) -> float:
    """Deviation of readings (K, n) of whole ticks from the true joints, rms of the joints, rad; 0 without."""
    ticks = np.array([_tick(column) for column in q.T])
    if (ticks == 0.0).any():
        return 0.0
    return float(np.sqrt(np.mean((ticks / per_rad(prismatic)) ** 2) / 12.0))


def _tick(values: FloatArray) -> float:
    """The step of which all distances of values (K,) are multiples; 0 where there is none."""
    steps = np.diff(np.unique(values))
    steps = steps[steps > 0.1 * _LEAST_TICK]
    tick = reduce(_common_measure, steps.tolist(), 0.0)
    return float(np.median(steps / np.round(steps / tick))) if len(steps) > 1 and tick >= _LEAST_TICK else 0.0


def _common_measure(a: float, b: float) -> float:
    """Greatest number that both are multiples of: Euclid's algorithm, on numbers that are rounded."""
    while b > _ON_TICK * _LEAST_TICK:
        a, b = b, abs(a - b * round(a / b))
    return a


def quantile(variances: FloatArray, probability: float) -> float:
    """Quantile of a sum of squares of independent normal variables of variances (r,), by its three moments.

    Source: M. J. Buckley, G. K. Eagleson, "An approximation to the distribution of quadratic forms in
    normal random variables", Australian Journal of Statistics 30A, 1988.
    """
    mean, square, cube = (float((variances**power).sum()) for power in (1, 2, 3))
    if cube == 0.0:
        return mean
    freedom = square**3 / cube**2
    return mean + float(np.sqrt(square / freedom) * (chdtri(freedom, 1.0 - probability) - freedom))
