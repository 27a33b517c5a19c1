"""Quality of a calibration: observability of joints, the verdict in words, and cross-validation."""

import dataclasses
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import bdtrc

from projservo_cli.calibration.bundle_adjustment import LeastSquares
from projservo_cli.calibration.checks.model_error import ModelCheck, describe, examine
from projservo_cli.calibration.detections import (
    MAX_JUDGED,
    MAX_REACHES,
    REACH_M,
    REACH_RAD,
    Detections,
    describe_joints,
    even_choice,
    require_motion,
    require_moved,
)
from projservo_cli.calibration.joint_noise import quantile
from projservo_cli.calibration.prediction import Parameters
from projservo_cli.calibration.robust_fit import Expected, Solution
from projservo_cli.records import BoolArray, Errors, FloatArray, IntArray, WorkFailed, apart

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
# Maximum number of deviations from the model that advice names.
_MAX_NAMED = 3


@dataclass(frozen=True, eq=False)
class _Uncertainty:
    """Uncertainty of the predictions of a fit, in twice the image region in which markers were seen."""

    problem: LeastSquares
    params: Parameters
    errors: Errors  # at a noise of one pixel
    which: IntArray  # markers assessed; the generators of the screws are those of all
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
        some = dataclasses.replace(self.params, M=self.params.M[self.which])
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

    there: LeastSquares  # of these images
    inside: BoolArray  # (V, N) whether an image is in the region
    T: FloatArray  # (rows, r) changes of coordinates in the region by independent errors of size one


def _needed_spans(uncertainty: _Uncertainty, spreads: list[FloatArray]) -> FloatArray:
    """Range (n,), rad or m, of a trial about the reference that would determine each weak joint; else NaN."""
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
    """Test a fit for deviations from the model, by at most ``MAX_JUDGED`` markers, at a noise, px."""
    few = solution.thinned(MAX_JUDGED)
    if few is not solution:
        errors = few.errors()
    return examine(few, errors, *_Uncertainty.of(few, errors).within_ranges(), sigma_px)


@dataclass(frozen=True, eq=False)
class _Assessment:
    """Excitation and noise of each joint, and whether the calibration is usable."""

    span: FloatArray  # (n,) range in the data, rad or m
    noise: FloatArray  # (n,) noise of images at the reach, in units of the pixel noise; NaN if unknown
    # expected error of images at random poses and its 99th percentile, px; None if unknown
    error: tuple[float, float] | None
    check: ModelCheck | None  # deviations from the model; None if it is exact, as in a simulation
    usable: bool
    reason: str  # why it is usable or not, and its limiting factor
    advice: tuple[str, ...]  # next steps, first about the limiting factor
    limit: str  # its limiting factor
    notes: tuple[str, ...]  # advice that noise alone gives, with nothing to mend


def assess(
    solution: Solution,
    errors: Errors | None,
    expected: Expected,
    outlier: IntArray,
    rejected: tuple[int, int],
    suspicion: str,
    max_predicted_px: float = np.inf,
) -> _Assessment:
    """Assess a fit.

    errors : of its parameters; None for the closed form, which has none.
    outlier : (L, 3) rejected observations: pose, marker, index of the view (their number for all).
    rejected : numbers of suspect joint readings and of exchanged marker numbers.
    suspicion : likely cause if residuals exceed pixel noise.
    max_predicted_px : effect of deviations from the model on predictions above which it is not usable.
    Raises WorkFailed naming a joint that moves no image, or whose operator is not determined.
    """
    prismatic, numbers = solution.params.prismatic, solution.problem.detections.numbers
    # Residuals of a method without covariance are its own errors, not noise of the images.
    sigma = expected.sigma_px if errors is None else expected.noise_px(solution)
    span = _require_joints_seen(solution, sigma)
    noise, error, check = np.full(len(span), np.nan), None, None
    weak = np.zeros(len(span), dtype=np.bool_)  # by the joints in the data, whatever their noise
    advice: list[str] = []
    if errors is not None:
        uncertainty = _Uncertainty.of(solution, errors)
        spreads = uncertainty.at_reach()
        noise = np.array([_rms(T) for T in spreads])
        typical, bound = _predicted_error(uncertainty.within_ranges().T)
        error = (sigma * typical, sigma * bound)
        if not expected.known:
            check = check_model(solution, errors, sigma)
            factor, effect = check.noise_factor, check.effect_px
            error = (float(np.hypot(factor * error[0], effect)), float(np.hypot(factor * error[1], effect)))
        needed = _needed_spans(uncertainty, spreads)
        i = int(np.argmax(noise))
        if noise[i] > UNDETERMINED_NOISE:
            raise WorkFailed(
                f"joint {numbers[i]} is not determined: near the reference its predicted images err by "
                f"{noise[i]:.3g} times the pixel noise; "
                + "".join(describe_joints(np.array([i]), span, prismatic, needed, numbers))
            )
        weak = noise > WEAK_NOISE
        if weak.any() and solution.problem.tau is not None:
            exact = dataclasses.replace(solution, problem=solution.problem.with_noise(None))
            weak &= (
                np.array([_rms(T) for T in _Uncertainty.of(exact, exact.errors()).at_reach()]) > WEAK_NOISE
            )
        alone = _span_alone(solution.problem.detections)
        advice += describe_joints(np.flatnonzero(weak), span, prismatic, needed, numbers, alone)
    warned, share = expected.warns(solution), expected.ratio(solution)
    found = f"{solution.sigma_px:.3g} px a coordinate"
    wanted = f"the {expected.sigma_px:.3g} px {expected.origin}"
    if errors is None and warned:
        # A method for comparison returns its result all the same.
        short = f"the closed_form method explains the images only to {found}"
        reason = f"{short}, {share:.3g} times {wanted}: use bundle_adjustment"
        return _Assessment(span, noise, error, None, False, reason, (), "the method", ())
    reason, notes = f"residuals of {found} agree with {wanted}", list[str]()
    if warned:
        reason = f"more than pixel noise is left: residuals of {found} are {share:.3g} times {wanted}"
        if "joint readings" in suspicion and not (check and check.errors):
            notes.append("look for joint readings that lag behind the images")
            advice[:0] = notes
    suspects, swaps = rejected
    outliers, observations = len(outlier), solution.used.shape[1]
    limit, many = "noise", outliers > _MAX_OUTLIERS * observations
    alike = _describe_shared(outlier, solution.problem.detections)
    what = "1 observation was rejected as an outlier"
    if outliers != 1:
        what = f"{outliers} observations were rejected as outliers"
    outlier_advice = f"{what}{alike}: check the detection of markers"
    if many:
        advice.append(outlier_advice)
    if words := _describe_joint_noise(solution):
        reason = f"{reason}, with joint readings off by {words}"
        over, moved_px = solution.joint_effect()
        if over > 1.0:
            moved = f"move images by {moved_px:.3g} px"
            limit = f"joint readings, which {moved}"
            finer = (
                f"errors of joint readings {moved}, more than pixel noise: finer or stiffer joints would help"
            )
            advice.append(finer)
            notes.append(finer)
    of_outliers = f"outliers: {outliers} of {observations}{alike}"
    if warned or suspicion == "lens":
        limit = of_outliers if suspicion == "outliers" else suspicion
    elif weak.any():
        few = span[weak] < np.where(prismatic[weak], REACH_M, REACH_RAD)
        limit = "amplitude" if few.any() else "geometry"
    elif many or alike:
        limit = of_outliers
    usable = True
    if check is not None and check.errors:
        sentences = [describe(one, prismatic) for one in check.errors]
        if check.effect_px > 0.0:
            limit = f"{sentences[0][0]}, which moves predictions by {check.effect_px:.3g} px"
        advice[:0] = [sentence for _, sentence in sentences[:_MAX_NAMED]]
        if check.effect_px > max_predicted_px:
            usable = False
            limit += f", more than calibration.max_predicted_px = {max_predicted_px:.3g}"
    if suspects:
        what = "1 joint reading disagrees" if suspects == 1 else f"{suspects} joint readings disagree"
        advice.append(f"{what} with the images: check how poses and images are paired")
    if swaps:
        times = f"{swaps} times" if swaps > 1 else "once"
        advice.append(f"{times} a marker was seen under the number of another: check the numbering")
    if outliers and not many:
        advice.append(outlier_advice)
    if outliers and not (many and limit == of_outliers):
        notes.append(outlier_advice)
    reason = f"{reason}; limited by {limit}"
    return _Assessment(span, noise, error, check, usable, reason, tuple(advice), limit, tuple(notes))


def _describe_shared(outlier: IntArray, detections: Detections) -> str:
    """Name the marker, pose or view of most outliers (L, 3), if that is no chance; empty otherwise."""
    V = len(detections.view)
    several = ((1, "marker", detections.marker.size), (0, "pose", detections.pose.size), (2, "view", V))
    for column, kind, count in several:
        values, counts = np.unique(outlier[:, column], return_counts=True)
        most = int(counts.max(initial=0))
        if 2 * most > len(outlier) and bdtrc(most - 1, len(outlier), 1.0 / count) < _CHANCE:
            value = int(values[np.argmax(counts)])
            name = (*detections.view, "all")[value] if kind == "view" else value
            return f", {'all' if most == len(outlier) else most} of {kind} {name}"
    return ""


def _describe_joint_noise(solution: Solution) -> str:
    """Describe the noise of joint readings; empty if the images show none."""
    noise = solution.joint_noise
    if noise is None or noise.sigma_q == 0.0:
        return ""
    return f"{np.degrees(noise.sigma_q):.2g}° rms" + (" (ticks that were counted)" if noise.ticks else "")


def _require_joints_seen(solution: Solution, sigma_px: float) -> FloatArray:
    """Ranges (n,) of the joints. Raises WorkFailed if one moves no image, by velocities at the reference."""
    detections, q_reference = solution.problem.detections, solution.problem.q_reference
    span = require_motion(detections)
    there = LeastSquares.of(detections.everywhere(q_reference[None]), q_reference)
    rate = there.joint_derivative(solution.params)
    motion = np.linalg.norm(rate, axis=2).mean(axis=(0, 1)) * span
    i = int(np.argmin(motion))
    require_moved(
        int(detections.numbers[i]), float(span[i]), bool(detections.prismatic[i]), float(motion[i]), sigma_px
    )
    return span
