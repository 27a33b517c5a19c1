"""Whether to trust a calibration: what the data leave open, the verdict in words, and held-out poses."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.sparse.csgraph import connected_components

from projservo_cli.calibration.adjustment import Problem, Scene, derivative, joint_derivative, prepare
from projservo_cli.calibration.covariance import WEAK_NOISE, ProjectiveScene, marker_factor, spread_factor
from projservo_cli.calibration.fit import WARN_RATIO, Agreement, Expected, Solution, least_squares
from projservo_cli.calibration.prediction import distance_statistics
from projservo_cli.calibration.readings import (
    ON_A_LINE,
    REACH_M,
    REACH_RAD,
    Readings,
    describe_joint,
    require_motion,
    require_moved,
)
from projservo_cli.records import BoolArray, CrossValidation, FloatArray, InputError, IntArray, WorkFailed

# Noise of predictions at the reach, in units of the pixel noise, above which a joint is undetermined.
_UNDETERMINED_NOISE = 1000.0
# Share of sightings beyond which outliers are what limits a fit.
_MOST_OUTLIERS = 0.05
# Least distance of the markers from their best line, in units of its own noise.
_OFF_LINE = 5.0


@dataclass(frozen=True, eq=False)
class Joints:
    """What the data say of each joint."""

    prismatic: BoolArray  # (n,) types
    span: FloatArray  # (n,) range in the data, rad or m
    # (n,) predicted noise of images at its reach, in units of the pixel noise; NaN where unknown
    noise: FloatArray
    needed: FloatArray  # (n,) range of a trial motion that would determine it, rad or m, NaN where none does

    def advice(self, i: int) -> str:
        """How far to move joint i."""
        return describe_joint(i, float(self.span[i]), bool(self.prismatic[i]), float(self.needed[i]))


def require_joints_seen(problem: Problem, scene: Scene, sigma_px: float) -> FloatArray:
    """Ranges (n,) of the joints; refuse one that moves no image over it, by velocities at the reference."""
    readings = problem.readings
    span = require_motion(readings)
    m = len(scene.M)
    once = dataclasses.replace(
        readings,
        q=problem.q_reference[None],
        pose_of=np.zeros(m, dtype=np.int64),
        marker_of=np.arange(m),
        pixels=np.zeros((2, m, 2)),
        seen=np.ones((2, m), dtype=np.bool_),
    )
    rate = joint_derivative(prepare(once, problem.q_reference), scene)[1]
    motion = np.linalg.norm(rate, axis=2).mean(axis=(0, 1)) * span
    i = int(np.argmin(motion))
    require_moved(i, float(span[i]), bool(readings.prismatic[i]), float(motion[i]), sigma_px)
    return span


def require_determined(joints: Joints) -> None:
    """Refuse a joint whose operator the data leave open, the worst of them."""
    i = int(np.argmax(joints.noise))
    if joints.noise[i] > _UNDETERMINED_NOISE:
        raise WorkFailed(
            f"joint {i + 1} is not determined: near the reference its images would be wrong by "
            f"{joints.noise[i]:.3g} times the pixel noise; {joints.advice(i)}"
        )


def require_off_line(result: ProjectiveScene, factor: FloatArray) -> None:
    """Refuse a body that a factor (24 + 16 n + 4 m or more, r) of its covariance cannot tell from a line.

    A line is the span of two points; the markers must be off it by several times the noise of that distance.
    """
    U, extent, Vt = np.linalg.svd(result.M, full_matrices=False)
    m = len(result.M)
    across = np.eye(m) - U[:, :2] @ U[:, :2].T
    noise = across @ (Vt[2:] @ marker_factor(result, factor).reshape(m, 4, -1)).reshape(m, -1)
    if extent[2] < _OFF_LINE * float(np.linalg.norm(noise)):
        raise WorkFailed(ON_A_LINE)


def verdict(
    method: str,
    agreement: Agreement,
    expected: Expected,
    joints: Joints,
    left_out: tuple[int, int, int],
    suspicion: str,
) -> tuple[bool, str, tuple[str, ...]]:
    """Whether and why a calibration is usable, what limits it, and what to do next, in words.

    From the numbers of outliers, of suspect joint readings and of exchanged markers left out, and a
    suspicion of what may be to blame for more than pixel noise. The closed form is kept for comparison: it
    returns what it finds, marked so, for residuals above the noise are its own doing.
    """
    sigma, warned = agreement.sigma_px, expected.warns(agreement)
    outliers, suspects, swaps = left_out
    wanted = f"the {expected.sigma_px:.3g} px {expected.origin}"
    if method != "refined" and warned:
        short = f"the {method} method explains the images only to {sigma:.3g} px a coordinate"
        return False, f"{short}, {expected.ratio(agreement):.3g} times {wanted}: use refined", ()
    weak = np.flatnonzero(joints.noise > WEAK_NOISE)
    advice = [joints.advice(int(i)) for i in weak]
    limit = "noise"
    if warned or suspicion == "lens":
        limit = suspicion
    elif weak.size:
        few = joints.span[weak] < np.where(joints.prismatic[weak], REACH_M, REACH_RAD)
        limit = "amplitude" if few.any() else "geometry"
    elif outliers > _MOST_OUTLIERS * agreement.used.shape[1]:
        limit = "outliers"
    reason = f"residuals of {sigma:.3g} px a coordinate agree with {wanted}"
    if warned:
        left = f"residuals of {sigma:.3g} px a coordinate are {expected.ratio(agreement):.3g} times {wanted}"
        reason = f"more than pixel noise is left: {left}"
        if "joint readings" in suspicion:
            advice.append("look for joint readings that lag behind the images")
    if outliers:
        advice.append(f"{outliers} sightings were left out as outliers: check the detection of markers")
    if suspects:
        advice.append(
            f"{suspects} joint readings disagree with the images: check how poses and images are paired"
        )
    if swaps:
        advice.append(f"{swaps} times a marker was seen under another's number: check the numbering")
    return True, f"{reason}; limited by {limit}", tuple(advice)


# Readings of a joint this near, rad or m, are one: a robot that holds a joint still reads it with jitter.
_SAME_JOINT = 1e-3
_LEAST_FOLDS = 2
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
    known = training.count_of(training.seen) > 0
    lens = solution.scene.lens
    problem = prepare(training.of_markers(known), q_reference, lens is not None)
    require_motion(problem.readings)
    scene = Scene(solution.scene.P, solution.scene.H_hat, solution.scene.M[known], lens)
    found = least_squares(problem, scene, solution.agreement.sigma_px)
    if found is None:
        raise WorkFailed(_OPEN)
    factor = spread_factor(problem, found.scene, found.agreement.used)
    place = held_out[whole.pose_of] & known[whole.marker_of]
    test = prepare(whole.of_poses(held_out).of_markers(known), q_reference, lens is not None)
    pixels, J = derivative(test, found.scene)
    spread = test.dense(J, np.ones_like(test.readings.seen)) @ factor
    variance = (spread**2).sum(axis=1).reshape(pixels.shape)
    # A direction the other poses leave open would stay where the whole fit put it.
    if np.sqrt(variance[test.readings.seen].mean()) > _UNDETERMINED_NOISE:
        raise WorkFailed(_OPEN)
    difference, error = np.zeros((2, *whole.seen.shape, 2))
    difference[:, place], error[:, place] = test.readings.pixels - pixels, sigma_px * np.sqrt(1.0 + variance)
    return solution.agreement.used & place, difference, error


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
