"""Quality of a calibration: observability of joints, the verdict in words, and cross-validation."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.sparse.csgraph import connected_components

from projservo_cli.calibration.adjustment import LeastSquares
from projservo_cli.calibration.fit import WARN_RATIO, Expected, Solution, fit_inliers
from projservo_cli.calibration.joint_noise import quantile
from projservo_cli.calibration.prediction import Scene, distance_statistics
from projservo_cli.calibration.readings import (
    MOST_JUDGED,
    MOST_REACHES,
    REACH_M,
    REACH_RAD,
    Readings,
    describe_joints,
    even_choice,
    require_motion,
    require_moved,
)
from projservo_cli.records import (
    BoolArray,
    CrossValidation,
    Errors,
    FloatArray,
    InputError,
    IntArray,
    WorkFailed,
    apart,
)

# Noise of predictions at the reach, in units of the pixel noise, above which a joint is undetermined.
_UNDETERMINED_NOISE = 1000.0
# Share of sightings beyond which outliers are what limits a fit.
_MOST_OUTLIERS = 0.05
# Noise of predictions at the reach, in units of the pixel noise: above it a joint is weak.
WEAK_NOISE = 3.0
# Poses at which predictions are judged; how sure they stay below the bound; halvings of an empty range.
_POSES, _SURE, _HALVINGS = 60, 0.99, 10
# Share of its range by which a joint that stands still may differ, as by play.
_STANDS = 0.03
# Frames of the trial motion that is advised; the least range of it, in reaches, and how often the
# logarithm of the range between it and the farthest is halved: to a twentieth.
_FRAMES, _LEAST_REACHES, _BISECTIONS = 8, 0.01, 7


@dataclass(frozen=True, eq=False)
class _Uncertainty:
    """A fit whose predictions err, judged in twice the image region in which markers were seen."""

    problem: LeastSquares
    scene: Scene
    errors: Errors  # at a noise of one pixel
    which: IntArray  # markers that are looked at; the generators of the screws are those of all
    region: FloatArray  # (2, 2, 2) lower and upper corners (view, coordinate), px

    @classmethod
    def of(cls, solution: Solution, errors: Errors) -> "_Uncertainty":
        """By no more markers than are judged, in the region of all."""
        readings = solution.problem.readings
        low, high = (
            np.stack([extreme(readings.pixels[v][readings.seen[v]], axis=0) for v in (0, 1)])
            for extreme in (np.min, np.max)
        )
        wide = 0.5 * (high - low)
        which = even_choice(len(solution.scene.M), MOST_JUDGED)
        return cls(solution.problem, solution.scene, errors, which, np.stack([low - wide, high + wide]))

    def shown(self, q: FloatArray) -> BoolArray:
        """Which images (2, K, m) at poses (K, n) lie in the region that counts."""
        some = dataclasses.replace(self.scene, M=self.scene.M[self.which])
        pixels = some.seen(q - self.problem.q_reference).swapaxes(0, 1)
        low, high = self.region[:, :, None, None]
        return np.asarray(((pixels >= low) & (pixels <= high)).all(axis=-1))

    def spread(self, q: FloatArray, *, nearer: bool = False) -> FloatArray:
        """Change (rows, r) of coordinates shown at poses (K, n) by independent errors of size one.

        Where no image would count, poses may be taken nearer to the reference, half the way each time.
        """
        q_reference = self.problem.q_reference
        shown = self.shown(q)
        for _ in range(_HALVINGS if nearer else 0):
            if shown.any():
                break
            q = 0.5 * (q + q_reference)
            shown = self.shown(q)
        readings, lens = self.problem.readings.everywhere(q, self.which), self.scene.lens is not None
        there = LeastSquares.of(readings, q_reference, lens)
        common, own = there.predicted(self.scene, self.errors)
        shown = shown.swapaxes(1, 2).reshape(2, -1)  # sightings are in the order of markers
        marker = np.nonzero(shown)[1] // len(q)
        T = apart(common[shown], own[shown], marker[:, None], self.which.size)
        return T.reshape(-1, T.shape[-1])

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
        return REACH_M if self.scene.prismatic[i] else REACH_RAD


def _needed_spans(sure: _Uncertainty, spreads: list[FloatArray]) -> FloatArray:
    """Range (n,) of a trial about the reference that would mend each weak joint, rad or m; NaN where none."""
    needed = np.full(len(spreads), np.nan)
    for i, T in enumerate(spreads):
        low, high = _LEAST_REACHES * sure.reach(i), MOST_REACHES * sure.reach(i)
        if _rms(T) <= WEAK_NOISE or _noise_after(sure, i, high, T) > WEAK_NOISE:
            continue
        for _ in range(_BISECTIONS):
            middle = float(np.sqrt(low * high))
            enough = _noise_after(sure, i, middle, T) <= WEAK_NOISE
            low, high = (low, middle) if enough else (middle, high)
        needed[i] = high
    return needed


def _moved_alone(readings: Readings) -> FloatArray:
    """Widest range (n,) of each joint over poses that differ in it alone, rad or m."""
    q = readings.q[np.unique(readings.pose_of)]
    change = np.abs(q[:, None] - q[None])
    apart = change > _STANDS * np.ptp(q, axis=0)
    alone = [(apart.sum(axis=2) == apart[..., i]) * change[..., i] for i in range(q.shape[1])]
    return np.array([each.max() for each in alone])


def _rms(T: FloatArray) -> float:
    """Noise of predicted images by a ``spread`` (rows, r) of them, in units of the pixel noise."""
    return float(np.sqrt((T**2).sum() / max(len(T), 1)))


def _noise_after(sure: _Uncertainty, i: int, span: float, T: FloatArray) -> float:
    """Noise at the reach after a trial over a span: rms of T (I + Cᵀ C)⁻¹ Tᵀ, C the trial's ``spread``."""
    q = sure.at(i, np.linspace(-0.5 * span, 0.5 * span, _FRAMES))
    C = sure.spread(q)
    root = np.asarray(np.linalg.qr(np.vstack([np.eye(C.shape[1]), C]), mode="r"))
    return _rms(np.linalg.solve(root.T, T.T).T)


def _predicted_error(sure: _Uncertainty) -> tuple[float, float]:
    """Expected error of images at poses of all joints at once, and what 99 of 100 calibrations stay below.

    Root mean squares of the Euclidean error per marker and view, in units of the pixel noise, over poses
    drawn evenly within the ranges that the joints moved through; where no image would count, the ranges
    are halved about the reference. No residual shows on which side of the expectation a calibration came
    to lie: to first order the error of a maximum of the likelihood does not depend on what it leaves.
    """
    q = sure.problem.readings.q
    poses = np.random.default_rng(0).uniform(q.min(axis=0), q.max(axis=0), (_POSES, q.shape[1]))
    spread = sure.spread(poses, nearer=True)
    variances = np.linalg.eigvalsh(spread.T @ spread) / max(len(spread) // 2, 1)
    return float(np.sqrt(variances.sum())), float(np.sqrt(quantile(variances, _SURE)))


@dataclass(frozen=True, eq=False)
class _Judgement:
    """What the data say of each joint, and whether to trust the whole."""

    span: FloatArray  # (n,) range in the data, rad or m
    # (n,) predicted noise of images at its reach, in units of the pixel noise; NaN where unknown
    noise: FloatArray
    # expected error of images at poses of all joints at once and its 99th percentile, px; None where unknown
    error: tuple[float, float] | None
    usable: bool
    reason: str  # why it is usable or not, and what limits it
    advice: tuple[str, ...]  # what to do next, first what limits it


def judged(
    solution: Solution,
    errors: Errors | None,
    expected: Expected,
    left_out: tuple[int, int, int],
    suspicion: str,
) -> _Judgement:
    """Verdict on a fit with its ``errors``, None for the closed form, which tells none.

    From the numbers of outliers, of suspect joint readings and of exchanged markers left out, and a
    suspicion of what may be to blame for more than pixel noise.

    Raises WorkFailed naming a joint that moves no image, or whose operator is not determined.
    """
    prismatic = solution.scene.prismatic
    # Residuals of a method without covariance are its own doing, not noise of the images.
    sigma = expected.sigma_px if errors is None else expected.noise_px(solution)
    span = _require_joints_seen(solution, sigma)
    noise, error = np.full(len(span), np.nan), None
    weak = np.zeros(len(span), dtype=np.bool_)  # by what the joints of the data show, whatever their noise
    advice: list[str] = []
    if errors is not None:
        sure = _Uncertainty.of(solution, errors)
        spreads = sure.at_reach()
        noise = np.array([_rms(T) for T in spreads])
        typical, bound = _predicted_error(sure)
        error = (sigma * typical, sigma * bound)
        needed = _needed_spans(sure, spreads)
        i = int(np.argmax(noise))
        if noise[i] > _UNDETERMINED_NOISE:
            raise WorkFailed(
                f"joint {i + 1} is not determined: near the reference its images would be wrong by "
                f"{noise[i]:.3g} times the pixel noise; "
                + "".join(describe_joints(np.array([i]), span, prismatic, needed))
            )
        weak = noise > WEAK_NOISE
        if weak.any() and solution.problem.tau is not None:
            exact = dataclasses.replace(solution, problem=solution.problem.with_noise(None))
            weak &= (
                np.array([_rms(T) for T in _Uncertainty.of(exact, exact.errors()).at_reach()]) > WEAK_NOISE
            )
        alone = _moved_alone(solution.problem.readings)
        advice += describe_joints(np.flatnonzero(weak), span, prismatic, needed, alone)
    warned, share = expected.warns(solution), expected.ratio(solution)
    found = f"{solution.sigma_px:.3g} px a coordinate"
    wanted = f"the {expected.sigma_px:.3g} px {expected.origin}"
    if errors is None and warned:
        # Kept for comparison: it returns what it finds, marked so.
        short = f"the closed_form method explains the images only to {found}"
        return _Judgement(span, noise, error, False, f"{short}, {share:.3g} times {wanted}: use refined", ())
    reason = f"residuals of {found} agree with {wanted}"
    if warned:
        reason = f"more than pixel noise is left: residuals of {found} are {share:.3g} times {wanted}"
        if "joint readings" in suspicion:
            advice.insert(0, "look for joint readings that lag behind the images")
    outliers, suspects, swaps = left_out
    limit, many = "noise", outliers > _MOST_OUTLIERS * solution.used.shape[1]
    told = f"{outliers} sightings were left out as outliers: check the detection of markers"
    if many:
        advice.append(told)
    if words := _joint_words(solution):
        reason = f"{reason}, with joint readings off by {words}"
        over, effect_px = solution.joint_effect()
        if over > 1.0:
            limit = "joint readings"
            effect = f"these move images by {effect_px:.3g} px, more than pixel noise"
            advice.append(f"joint readings are off, and {effect}: finer or stiffer joints would help")
    if warned or suspicion == "lens":
        limit = suspicion
    elif weak.any():
        few = span[weak] < np.where(prismatic[weak], REACH_M, REACH_RAD)
        limit = "amplitude" if few.any() else "geometry"
    elif many:
        limit = "outliers"
    if suspects:
        advice.append(
            f"{suspects} joint readings disagree with the images: check how poses and images are paired"
        )
    if swaps:
        times = f"{swaps} times" if swaps > 1 else "once"
        advice.append(f"{times} a marker was seen under another's number: check the numbering")
    if outliers and not many:
        advice.append(told)
    return _Judgement(span, noise, error, True, f"{reason}; limited by {limit}", tuple(advice))


def _joint_words(solution: Solution) -> str:
    """How far joint readings are off; empty where they are not, as far as the images show."""
    noise = solution.joint_noise
    if noise is None or noise.sigma_q == 0.0:
        return ""
    return f"{np.degrees(noise.sigma_q):.2g}° rms" + (" (ticks that were counted)" if noise.ticks else "")


def _require_joints_seen(solution: Solution, sigma_px: float) -> FloatArray:
    """Ranges (n,) of the joints; refuse one that moves no image over it, by velocities at the reference."""
    readings, q_reference = solution.problem.readings, solution.problem.q_reference
    span = require_motion(readings)
    there = LeastSquares.of(readings.everywhere(q_reference[None]), q_reference)
    rate = there.joint_derivative(solution.scene)
    motion = np.linalg.norm(rate, axis=2).mean(axis=(0, 1)) * span
    i = int(np.argmin(motion))
    require_moved(i, float(span[i]), bool(readings.prismatic[i]), float(motion[i]), sigma_px)
    return span


# Readings of a joint this near, rad or m, are one: a robot that holds a joint still reads it with jitter.
_SAME_JOINT = 1e-3
_LEAST_FOLDS = 2
_LEAST_READINGS = 4  # of a marker in the other poses, for it to be predicted
_OPEN = "the other poses do not determine the robot"


def cross_validate(
    solution: Solution,
    sigma_px: float,
    folds: int,
    seed: int,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> CrossValidation:
    """Predict every pose from a fit that has not seen it, beside the error its covariance predicts.

    Each fit starts from the whole one and is iterated to its own optimum over its own poses, outliers
    sought anew, so that the held-out poses decide where it starts and not where it ends.

    Parameters
    ----------
    solution : the fit to all poses.
    sigma_px : noise per coordinate, px.
    folds : parts to divide the poses into.
    seed : of the division.
    progress : told after each part.

    Raises
    ------
    InputError
        If there are fewer poses than parts.
    """
    readings = solution.problem.readings
    part, unit = _divide(readings, folds, np.random.default_rng(seed))
    shape = (len(readings.q), 2, readings.marker.size, 2)
    residual, predicted = np.full(shape, np.nan), np.full(shape, np.nan)
    failed = []
    for fold in range(folds):
        try:
            rows, difference, deviation = _predicted(solution, part == fold, sigma_px)
        except WorkFailed as error:
            failed.append(f"part {fold + 1}: {error}")
        else:
            for v in (0, 1):
                at = np.flatnonzero(rows[v])
                where = readings.pose_of[at], v, readings.marker_of[at]
                residual[where], predicted[where] = difference[v, at], deviation[v, at]
        progress(fold + 1, folds)
    distance = np.linalg.norm(residual, axis=3)
    statistics = distance_statistics(distance[np.isfinite(distance)])
    # Two coordinates a distance.
    expected = float(np.sqrt(2.0 * np.nanmean(predicted**2))) if statistics["count"] else None
    return CrossValidation(
        folds=folds,
        seed=seed,
        unit=unit,
        failed=tuple(failed),
        reason=_compared(statistics["rms_px"], expected, len(failed)),
        **statistics,
        predicted_rms_px=expected,
        pose=readings.pose,
        fold=part,
        marker=readings.marker,
        residual=residual,
        predicted=predicted,
    )


def _divide(readings: Readings, folds: int, rng: np.random.Generator) -> tuple[IntArray, str]:
    """Part (K,) of each pose, -1 where nothing was seen, and whether poses or configurations were divided.

    Poses that differ in one joint only, as the spins of a tool, share what is wrong with the others and
    say little about poses elsewhere: they stay together unless a part would then be too large, as with
    trial motions of single joints.
    """
    present = np.unique(readings.pose_of)
    if not _LEAST_FOLDS <= folds <= present.size:
        raise InputError(
            f"cross-validation in {folds} parts: there are {present.size} poses; "
            f"choose {_LEAST_FOLDS} to {present.size} parts"
        )
    q = readings.q[present]
    changed = (np.abs(q[:, None] - q[None]) > _SAME_JOINT).sum(axis=2)
    group = np.asarray(connected_components(changed <= 1, directed=False)[1], dtype=np.int64)
    if np.bincount(group).max() * folds > present.size:
        group = np.arange(present.size)
    members = np.bincount(group)
    size = np.zeros(folds, dtype=np.int64)
    chosen = np.empty(len(members), dtype=np.int64)
    for g in rng.permutation(len(members)):
        chosen[g] = np.argmin(size)
        size[chosen[g]] += members[g]
    part = np.full(len(readings.q), -1, dtype=np.int64)
    part[present] = chosen[group]
    return part, "poses" if members.max() == 1 else "configurations"


def _predicted(
    solution: Solution, held_out: BoolArray, sigma_px: float
) -> tuple[BoolArray, FloatArray, FloatArray]:
    """What a fit to the other poses leaves of those held out (K,): WorkFailed if they leave the robot open.

    Readings (2, N) that are predicted, seen minus predicted (2, N, 2) and its deviation (2, N, 2), px.
    """
    whole, q_reference = solution.problem.readings, solution.problem.q_reference
    training = whole.of_poses(~held_out)
    known = training.count_of(training.seen) >= _LEAST_READINGS
    lens = solution.scene.lens is not None
    tau = solution.problem.tau
    problem = LeastSquares.of(training.of_markers(known), q_reference, lens).with_noise(tau)
    require_motion(problem.readings)
    scene = dataclasses.replace(solution.scene, M=solution.scene.M[known])
    found = fit_inliers(problem, scene, solution.sigma_px)
    if found is None:
        raise WorkFailed(_OPEN)
    found, kept = found.determined()
    known[known] = kept
    place = held_out[whole.pose_of] & known[whole.marker_of]
    test = LeastSquares.of(whole.of_poses(held_out).of_markers(known), q_reference, lens)
    left, weight = test.residual(found.scene), test.readings.weight[..., None]
    variance = sum((part**2).sum(axis=-1) for part in test.predicted(found.scene, found.errors()))
    # A direction the other poses leave open would stay where the whole fit put it.
    if np.sqrt(variance[test.readings.seen].mean()) > _UNDETERMINED_NOISE:
        raise WorkFailed(_OPEN)
    if tau is not None:  # the joints of a pose held out are off by their own noise
        variance += ((test.joint_derivative(found.scene) * tau) ** 2).sum(axis=-1)
    difference, error = np.zeros((2, *whole.seen.shape, 2))
    difference[:, place], error[:, place] = -left / weight, sigma_px * np.sqrt(1.0 + variance) / weight
    return solution.used & place, difference, error


def _compared(rms: float | None, expected: float | None, failed: int) -> str:
    """How the held-out error compares with the predicted one, and what that means."""
    if rms is None or expected is None:
        return "no part could be predicted from the others: record more poses"
    lost = f"; {failed} of the parts not predicted from the others: record more poses" if failed else ""
    ratio = rms / expected
    meaning = ""
    if ratio > WARN_RATIO:
        meaning = ": the poses disagree by more than noise, as from joint readings or a lens"
    return f"held-out images err {ratio:.3g} times as much as the covariance predicts{meaning}{lost}"
