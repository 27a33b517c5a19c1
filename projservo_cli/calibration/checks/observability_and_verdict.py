"""Quality of a calibration: observability of joints, errors of predictions, and findings."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.special import bdtrc

from projservo_cli.calibration.bundle_adjustment import LeastSquares
from projservo_cli.calibration.checks.model_errors import ModelCheck, examine
from projservo_cli.calibration.detections import (
    MAX_JUDGED,
    MAX_REACHES,
    Detections,
    even_choice,
    require_motion,
    require_moved,
    weak_joints,
)
from projservo_cli.calibration.joint_noise import quantile
from projservo_cli.calibration.prediction import Parameters
from projservo_cli.calibration.robust_fit import Expected, Solution
from projservo_cli.findings import LIMITS, NOTE, REACH_M, REACH_RAD, REFUSES, Finding, Subject
from projservo_cli.messages import failed
from projservo_cli.records import BoolArray, Errors, FloatArray, IntArray, apart

# Noise of predictions at the reach, in units of the pixel noise, above which a joint is undetermined.
UNDETERMINED_NOISE = 1000.0
# Share of rejected observations above which outliers limit a fit.
_MAX_OUTLIERS = 0.05
# Probability by chance that as many outliers are of one marker, pose or view, below which it is named.
_CHANCE = 1e-3
# Noise of predictions at the reach, in units of the pixel noise, above which a joint is poorly observable.
WEAK_NOISE = 3.0
# Number of poses at which predictions are assessed.
_POSES = 60
# Probability that the error of predictions stays below its bound.
_SURE = 0.99
# Maximum number of times a range without visible images is halved.
_HALVINGS = 10
# Share of its range by which a joint at rest may differ, as by backlash.
_STANDS = 0.03
# Number of frames of an advised trial motion.
_FRAMES = 8
# Minimum range of an advised trial motion, in reaches.
_MIN_REACHES = 0.01
# Number of bisections of the logarithm of that range, to a twentieth.
_BISECTIONS = 7


@dataclass(frozen=True, eq=False)
class _Uncertainty:
    """Uncertainty of the predictions of a fit, in twice the image region in which markers were seen."""

    problem: LeastSquares
    params: Parameters
    errors: Errors  # at a noise of one pixel
    which: IntArray  # markers assessed; all markers share the generators of the screws
    region: FloatArray  # (2, 2, 2) lower and upper corners (view, coordinate), px

    @classmethod
    def of(cls, solution: Solution, errors: Errors) -> "_Uncertainty":
        """Uncertainty at up to ``MAX_JUDGED`` markers, in the region of all."""
        detections = solution.problem.detections
        low, high = (
            np.stack([extreme(p[s], axis=0) for p, s in zip(detections.pixels, detections.seen, strict=True)])
            for extreme in (np.min, np.max)
        )
        wide = 0.5 * (high - low)
        which = even_choice(len(solution.params.M), MAX_JUDGED)
        return cls(solution.problem, solution.params, errors, which, np.stack([low - wide, high + wide]))

    def in_region(self, q: FloatArray) -> BoolArray:
        """Mask (V, K, m) of images at poses (K, n) in the region."""
        some = replace(self.params, M=self.params.M[self.which])
        pixels = some.predict(q - self.problem.q_reference).swapaxes(0, 1)
        low, high = self.region[:, :, None, None]
        return np.asarray(((pixels >= low) & (pixels <= high)).all(axis=-1))

    def spread(self, q: FloatArray, *, nearer: bool = False) -> FloatArray:
        """Changes (rows, r) of visible coordinates at poses (K, n), in the noise of their markers."""
        found, detections = self.predictions(q, nearer=nearer), self.problem.detections
        marker = found.there.detections.marker_of[np.nonzero(found.inside)[1]]
        square = np.bincount(detections.marker_of, (detections.seen * detections.weight**2).sum(axis=0))
        weight = np.sqrt(square / np.bincount(detections.marker_of, detections.seen.sum(axis=0)))
        return np.repeat(weight[marker], 2)[:, None] * found.T

    def predictions(self, q: FloatArray, *, nearer: bool = False) -> "_Predictions":
        """Predicted images at poses (K, n).

        nearer : halve the distance of the poses from the reference until an image is in the region.
        """
        q_reference = self.problem.q_reference
        inside = self.in_region(q)
        for _ in range(_HALVINGS if nearer else 0):
            if inside.any():
                break
            q = 0.5 * (q + q_reference)
            inside = self.in_region(q)
        detections = self.problem.detections.everywhere(q, self.which)
        there = self.problem.alike(detections)
        common, own = there.predicted(self.params, self.errors)
        inside = inside.swapaxes(1, 2).reshape(len(inside), -1)  # observations are in the order of markers
        marker = np.nonzero(inside)[1] // len(q)
        T = apart(common[inside], own[inside], marker[:, None], self.which.size)
        return _Predictions(there, inside, T.reshape(-1, T.shape[-1]))

    def within_ranges(self) -> "_Predictions":
        """Predicted images at random poses, drawn uniformly within the ranges of the joints."""
        q = self.problem.detections.q
        poses = np.random.default_rng(0).uniform(q.min(axis=0), q.max(axis=0), (_POSES, q.shape[1]))
        return self.predictions(poses, nearer=True)

    def at(self, i: int, offsets: FloatArray) -> FloatArray:
        """Poses (K, n) with joint i at offsets (K,) from the reference, rad or m."""
        q_reference = self.problem.q_reference
        return np.asarray(q_reference + offsets[:, None] * np.eye(len(q_reference))[i])

    def at_reach(self) -> list[FloatArray]:
        """``spread`` of each joint at its reach on both sides."""
        sides = np.array([1.0, -1.0])
        return [
            self.spread(self.at(i, self.reach(i) * sides), nearer=True)
            for i in range(len(self.problem.q_reference))
        ]

    def reach(self, i: int) -> float:
        """Reach of joint i at which predictions are judged, rad or m."""
        return REACH_M if self.params.prismatic[i] else REACH_RAD


class _Predictions(NamedTuple):
    """Predicted images of the markers assessed, and their changes by errors of the parameters."""

    there: LeastSquares  # problem of these images
    inside: BoolArray  # (V, N) whether an image is in the region
    T: FloatArray  # (rows, r) changes of coordinates in the region by independent errors of size one


def _needed_spans(uncertainty: _Uncertainty, spreads: list[FloatArray]) -> FloatArray:
    """Range (n,), rad or m, of a trial about the reference that determines each weak joint; otherwise NaN."""
    needed = np.full(len(spreads), np.nan)
    for i, T in enumerate(spreads):
        low, high = _MIN_REACHES * uncertainty.reach(i), MAX_REACHES * uncertainty.reach(i)
        if _rms(T) <= WEAK_NOISE or _noise_after_trial(uncertainty, i, high, T) > WEAK_NOISE:
            continue
        for _ in range(_BISECTIONS):
            middle = float(np.sqrt(low * high))
            enough = _noise_after_trial(uncertainty, i, middle, T) <= WEAK_NOISE
            low, high = (low, middle) if enough else (middle, high)
        needed[i] = high
    return needed


def _span_alone(detections: Detections) -> FloatArray:
    """Maximum range (n,) of each joint over poses that differ in it alone, rad or m."""
    q = detections.q[np.unique(detections.pose_of)]
    change = np.abs(q[:, None] - q[None])
    apart = change > _STANDS * np.ptp(q, axis=0)
    alone = [(apart.sum(axis=2) == apart[..., i]) * change[..., i] for i in range(q.shape[1])]
    return np.array([each.max() for each in alone])


def _rms(T: FloatArray) -> float:
    """Noise of predicted images from their ``spread`` (rows, r), in units of the pixel noise."""
    return float(np.sqrt((T**2).sum() / max(len(T), 1)))


def _noise_after_trial(uncertainty: _Uncertainty, i: int, span: float, T: FloatArray) -> float:
    """Noise at the reach after a trial over a span: rms of T (I + Cᵀ C)⁻¹ Tᵀ, C its ``spread``."""
    q = uncertainty.at(i, np.linspace(-0.5 * span, 0.5 * span, _FRAMES))
    C = uncertainty.spread(q)
    root = np.asarray(np.linalg.qr(np.vstack([np.eye(C.shape[1]), C]), mode="r"))
    return _rms(np.linalg.solve(root.T, T.T).T)


def _predicted_error(spread: FloatArray) -> tuple[float, float]:
    """Expected error of images with changes (rows, r), and the bound that 99 of 100 calibrations keep.

    Root mean squares of the Euclidean error per marker and view, in units of the pixel noise. No residual
    shows the actual error: to first order the error of a maximum-likelihood estimate is independent of the
    residuals.
    """
    variances = np.linalg.eigvalsh(spread.T @ spread) / max(len(spread) // 2, 1)
    return float(np.sqrt(variances.sum())), float(np.sqrt(quantile(variances, _SURE)))


def check_model(solution: Solution, errors: Errors, sigma_px: float) -> ModelCheck:
    """Test a fit for deviations from the model, by the markers that are ``judged``, at a noise, px."""
    few = solution.judged()
    if few is not solution:
        errors = few.errors()
    detections = solution.problem.detections
    those = np.isin(detections.marker_of, even_choice(detections.marker.size, MAX_JUDGED))
    share = few.used.sum() / solution.used[:, those].sum()
    return examine(few, errors, *_Uncertainty.of(few, errors).within_ranges(), sigma_px, share)


@dataclass(frozen=True, eq=False)
class _Assessment:
    """Excitation and noise of each joint, and the findings on a calibration."""

    span: FloatArray  # (n,) range in the data, rad or m
    noise: FloatArray  # (n,) noise of images at the reach, in units of the pixel noise
    # expected error of images at random poses and its 99th percentile, px
    error: tuple[float, float]
    check: ModelCheck | None  # deviations from the model; None if it is exact, as in a simulation
    findings: tuple[Finding, ...]  # its residuals first, then its limits in order of importance


def assess(
    solution: Solution,
    errors: Errors,
    expected: Expected,
    outlier: IntArray,
    rejected: tuple[int, int],
    suspicion: Finding,
    max_predicted_px: float = np.inf,
) -> _Assessment:
    """Assess a fit.

    errors : of its parameters.
    outlier : (L, 3) rejected observations: pose, marker, index of the view (their number for all).
    rejected : numbers of suspect joint readings and of exchanged marker numbers.
    suspicion : likely cause if residuals exceed pixel noise.
    max_predicted_px : effect of deviations from the model on predictions above which it is not usable.
    Raises WorkFailed naming a joint that moves no image, or whose operator is not determined.
    """
    sigma = expected.noise_px(solution)
    span = _require_joints_seen(solution, sigma)
    warned = expected.warns(solution)
    code, severity = ("residuals", LIMITS) if warned else ("noise", NOTE)
    noise, error, weak = _noise_of_joints(solution, errors, sigma)
    check = None
    if not expected.known:
        check = check_model(solution, errors, sigma)
        factor, effect = check.noise_factor, check.effect_px
        error = (float(np.hypot(factor * error[0], effect)), float(np.hypot(factor * error[1], effect)))
    found = [expected.finding(code, severity, solution)]
    if check is not None:
        found += _deviations(check, max_predicted_px)
    lags = suspicion.code == "lagging_joints" and warned and not (check and check.errors)
    found += [suspicion] if lags or suspicion.code == "unmodelled_lens" else []
    found += [*weak, *_left_out(solution, outlier, rejected, warned and suspicion.code == "outliers")]
    found += _joint_noise(solution)
    return _Assessment(span, noise, error, check, tuple(found))


def _noise_of_joints(
    solution: Solution, errors: Errors, sigma: float
) -> tuple[FloatArray, tuple[float, float], list[Finding]]:
    """Noise (n,) of the joints, expected errors of images, px, and joints that are hardly determined."""
    detections = solution.problem.detections
    uncertainty, span = _Uncertainty.of(solution, errors), require_motion(detections)
    spreads = uncertainty.at_reach()
    noise = np.array([_rms(T) for T in spreads])
    typical, bound = _predicted_error(uncertainty.within_ranges().T)
    needed = _needed_spans(uncertainty, spreads)
    i = int(np.argmax(noise))
    if noise[i] > UNDETERMINED_NOISE:
        (why,) = weak_joints(np.array([i]), span, needed, detections, np.zeros(len(span)))
        of, max_count = Subject(joints=(int(detections.numbers[i]),)), UNDETERMINED_NOISE
        open_ = Finding("joint_undetermined", REFUSES, of, noise[i], limit=max_count, unit="1")
        raise failed([open_, replace(why, severity=REFUSES)], detections.setup)
    weak = noise > WEAK_NOISE
    if weak.any() and solution.problem.tau is not None:  # joints as in the data, whatever their noise
        exact = replace(solution, problem=solution.problem.with_noise(None))
        weak &= np.array([_rms(T) for T in _Uncertainty.of(exact, exact.errors()).at_reach()]) > WEAK_NOISE
    found = weak_joints(np.flatnonzero(weak), span, needed, detections, _span_alone(detections))
    return noise, (sigma * typical, sigma * bound), found


def _deviations(check: ModelCheck, max_predicted_px: float) -> list[Finding]:
    """Deviations from the model, which refuse a calibration if they move predictions too far together."""
    found, effect = list(check.errors), check.effect_px
    refuses = bool(found) and effect > max_predicted_px
    if refuses:
        found[0] = replace(found[0], severity=REFUSES, limit=max_predicted_px)
    if len(found) > 1:
        severity = REFUSES if refuses else NOTE
        found.append(Finding("deviations", severity, limit=max_predicted_px, unit="px", effect_px=effect))
    if check.unshown is not None:
        found.append(Finding("unshown", NOTE, effect_px=check.unshown.effect_px, others=(check.unshown,)))
    return found


def _left_out(
    solution: Solution, outlier: IntArray, rejected: tuple[int, int], suspected: bool
) -> Iterator[Finding]:
    """Observations, joint readings and numbers that were left out, or read otherwise.

    suspected : whether observations that are left out are the likely cause of residuals beyond noise.
    """
    observations, (suspects, swaps) = solution.used.shape[1], rejected
    if len(outlier):
        alike = _shared(outlier, solution.problem.detections)
        limits = suspected or alike or len(outlier) > _MAX_OUTLIERS * observations
        severity = LIMITS if limits else NOTE
        yield Finding("outliers", severity, amount=len(outlier), limit=observations, unit="1", others=alike)
    if suspects:
        yield Finding("suspect_readings", LIMITS, amount=suspects, unit="1")
    if swaps:
        yield Finding("id_switches", LIMITS, amount=swaps, unit="1")


def _shared(outlier: IntArray, detections: Detections) -> tuple[Finding, ...]:
    """Marker, pose or view of most outliers (L, 3), if that is no chance."""
    V = len(detections.view)
    several = ((1, "markers", detections.marker.size), (0, "poses", detections.pose.size), (2, "views", V))
    for column, kind, count in several:
        values, counts = np.unique(outlier[:, column], return_counts=True)
        max_count = int(counts.max(initial=0))
        if 2 * max_count > len(outlier) and bdtrc(max_count - 1, len(outlier), 1.0 / count) < _CHANCE:
            value = int(values[np.argmax(counts)])
            name: Any = (*detections.view, "all")[value] if kind == "views" else value
            of_kind: dict[str, Any] = {kind: (name,)}
            return (Finding("outliers", LIMITS, Subject(**of_kind), max_count, limit=len(outlier), unit="1"),)
    return ()


def _joint_noise(solution: Solution) -> Iterator[Finding]:
    """Noise of joint readings, if the images show any, and whether it exceeds the pixel noise."""
    noise = solution.joint_noise
    if noise is None or noise.sigma_q == 0.0:
        return
    over, moved_px = solution.joint_effect()
    subject = Subject(name="ticks" if noise.ticks else "")
    places = noise.sigma_m if solution.problem.detections.chart is not None else math.nan
    found = Finding("joint_noise", NOTE, subject, noise.sigma_q, limit=places, unit="rad", effect_px=moved_px)
    if over > 1.0:
        yield replace(found, code="coarse_joints", severity=LIMITS)
    yield found


def _require_joints_seen(solution: Solution, sigma_px: float) -> FloatArray:
    """Ranges (n,) of the joints. Raises WorkFailed if one moves no image, by velocities at the reference."""
    detections, q_reference = solution.problem.detections, solution.problem.q_reference
    span = require_motion(detections)
    there = LeastSquares.of(detections.everywhere(q_reference[None]), q_reference)
    rate = there.joint_derivative(solution.params)
    motion = np.linalg.norm(rate, axis=2).mean(axis=(0, 1)) * span
    i = int(np.argmin(motion))
    require_moved(detections.name_of(i), float(span[i]), detections.units[i], float(motion[i]), sigma_px)
    return span
