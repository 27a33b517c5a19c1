"""Cross-validation over poses: each part of them predicted by a fit to the others."""

from collections.abc import Callable

import numpy as np
from scipy.sparse.csgraph import connected_components

from projservo_cli.calibration import adjustment
from projservo_cli.calibration.fit import Solution, least_squares
from projservo_cli.calibration.frame import spread_factor
from projservo_cli.calibration.optimization import prepare
from projservo_cli.calibration.quality import UNDETERMINED_NOISE, WARN_RATIO, require_motion
from projservo_cli.calibration.readings import Readings, of_poses, restrict
from projservo_cli.records import BoolArray, CrossValidation, FloatArray, InputError, IntArray, WorkFailed

# Readings of a joint this near, rad or m, are one: a robot that holds a joint still reads it with jitter.
SAME_JOINT = 1e-3
LEAST_FOLDS = 2
OPEN = "the other poses do not determine the robot"

Told = Callable[[int, int], None]


def cross_validate(
    solution: Solution, sigma_px: float, folds: int, seed: int, progress: Told = lambda done, total: None
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
    part, unit = divide(readings, folds, np.random.default_rng(seed))
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
    return _record(readings, part, unit, folds, seed, tuple(failed), residual, predicted)


def divide(readings: Readings, folds: int, rng: np.random.Generator) -> tuple[IntArray, str]:
    """Part (K,) of each pose, -1 where nothing was seen, and whether poses or configurations were divided.

    Poses that differ in one joint only, as the spins of a tool, share what is wrong with the others and
    say little about poses elsewhere: they stay together unless a part would then be too large, as with
    trial motions of single joints.

    Parameters
    ----------
    readings : what was seen.
    folds : parts.
    rng : draws the parts.

    Raises
    ------
    InputError
        If there are fewer poses than parts.
    """
    present = np.unique(readings.pose_of)
    if not LEAST_FOLDS <= folds <= present.size:
        raise InputError(
            f"cross-validation in {folds} parts: there are {present.size} poses; "
            f"choose {LEAST_FOLDS} to {present.size} parts"
        )
    q = readings.q[present]
    changed = (np.abs(q[:, None] - q[None]) > SAME_JOINT).sum(axis=2)
    group = np.asarray(connected_components(changed <= 1, directed=False)[1], dtype=np.int64)
    unit = "configurations"
    if np.bincount(group).max() * folds > present.size:
        group, unit = np.arange(present.size), "poses"
    members = np.bincount(group)
    if members.max() == 1:
        unit = "poses"
    size = np.zeros(folds, dtype=np.int64)
    chosen = np.empty(len(members), dtype=np.int64)
    for g in rng.permutation(len(members)):
        chosen[g] = np.argmin(size)
        size[chosen[g]] += members[g]
    part = np.full(len(readings.q), -1, dtype=np.int64)
    part[present] = chosen[group]
    return part, unit


def _predicted(
    solution: Solution, held_out: BoolArray, sigma_px: float
) -> tuple[BoolArray, FloatArray, FloatArray]:
    """What a fit to the other poses leaves of those held out.

    Parameters
    ----------
    solution : the fit to all poses.
    held_out : (K,) poses to predict.
    sigma_px : noise per coordinate, px.

    Returns
    -------
    Readings (2, N) that are predicted, seen minus predicted (2, N, 2) and its deviation (2, N, 2), px.

    Raises
    ------
    WorkFailed
        If the other poses do not determine the robot.
    """
    whole = solution.problem.readings
    training = of_poses(whole, ~held_out)
    known = np.bincount(training.marker_of, training.seen.sum(axis=0), whole.marker.size) > 0
    lens = solution.scene.lens
    problem = prepare(restrict(training, known), solution.problem.q_reference, lens is not None)
    require_motion(problem.readings)
    scene = adjustment.Scene(solution.scene.P, solution.scene.H_hat, solution.scene.M[known], lens)
    found = least_squares(problem, scene, solution.agreement.sigma_px, np.inf)
    if found is None:
        raise WorkFailed(OPEN)
    J = adjustment.derivative(found.scene, problem.readings, problem.q)[1]
    factor = spread_factor(
        problem.dense(J, found.agreement.used.astype(np.float64)),
        adjustment.gauge(found.scene, problem.readings, problem.place),
    )
    place = held_out[whole.pose_of] & known[whole.marker_of]
    test = prepare(restrict(of_poses(whole, held_out), known), problem.q_reference, lens is not None)
    pixels, J = adjustment.derivative(found.scene, test.readings, test.q)
    spread = test.dense(J, np.ones(test.readings.seen.shape)) @ factor
    variance = (spread**2).sum(axis=1).reshape(pixels.shape)
    # A direction the other poses leave open would stay where the whole fit put it.
    if np.sqrt(variance[test.readings.seen].mean()) > UNDETERMINED_NOISE:
        raise WorkFailed(OPEN)
    deviation = sigma_px * np.sqrt(1.0 + variance)
    difference, error = np.zeros((2, *whole.seen.shape, 2))
    difference[:, place], error[:, place] = test.readings.pixels - pixels, deviation
    return solution.agreement.used & place, difference, error


def _record(
    readings: Readings,
    part: IntArray,
    unit: str,
    folds: int,
    seed: int,
    failed: tuple[str, ...],
    residual: FloatArray,
    predicted: FloatArray,
) -> CrossValidation:
    """Record of the residuals with their statistics."""
    distance = np.linalg.norm(residual, axis=3)
    distance = distance[np.isfinite(distance)]
    some = distance.size > 0
    rms = float(np.sqrt(np.mean(distance**2))) if some else None
    # Two coordinates a distance.
    expected = float(np.sqrt(2.0 * np.nanmean(predicted**2))) if some else None
    return CrossValidation(
        folds=folds,
        seed=seed,
        unit=unit,
        failed=failed,
        reason=_words(rms, expected, len(failed)),
        count=int(distance.size),
        rms_px=rms,
        median_px=float(np.median(distance)) if some else None,
        p95_px=float(np.percentile(distance, 95)) if some else None,
        predicted_rms_px=expected,
        pose=readings.pose,
        fold=part,
        marker=readings.marker,
        residual=residual,
        predicted=predicted,
    )


def _words(rms: float | None, expected: float | None, failed: int) -> str:
    """How the held-out error compares with the predicted one, and what that means."""
    if rms is None or expected is None:
        return "no part could be predicted from the others: record more poses"
    lost = f"; {failed} of the parts not predicted from the others: record more poses" if failed else ""
    ratio = rms / expected
    if ratio > WARN_RATIO:
        return (
            f"held-out images err {ratio:.3g} times as much as the covariance predicts: the poses disagree "
            f"by more than noise, as from joint readings or a lens{lost}"
        )
    return f"held-out images err {ratio:.3g} times as much as the covariance predicts{lost}"
