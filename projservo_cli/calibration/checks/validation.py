"""Predictions of poses that no fit has seen: cross-validation, and another recording."""

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.sparse.csgraph import connected_components

from projservo_cli.calibration.checks.board_corner_numbering import BoardNumbering
from projservo_cli.calibration.checks.observability_and_verdict import UNDETERMINED_NOISE
from projservo_cli.calibration.checks.screening import without_placeholders
from projservo_cli.calibration.detections import SAME_READING, Detections, require_motion
from projservo_cli.calibration.initial.epipolar import Epipolar
from projservo_cli.calibration.prediction import predict, prediction_variance, reading_changes
from projservo_cli.calibration.robust_fit import WARN_RATIO, Solution, fit_inliers
from projservo_cli.findings import LIMITS, NOTE, REFUSES, Finding, Subject
from projservo_cli.geometry.lens import undistort
from projservo_cli.messages import failed, lines, setup_of, text
from projservo_cli.records import (
    VIEWS,
    BoolArray,
    Calibration,
    CrossValidation,
    FloatArray,
    HeldOutBlocks,
    InputError,
    IntArray,
    Observation,
    WorkFailed,
)

# Minimum number of parts in a cross-validation.
_MIN_FOLDS = 2
# Divisions of the poses into blocks besides a random one, and the cause of a larger error there.
_BLOCKS = "posture", "time"
# Held-out over predicted error in blocks, over the ratio of random parts, from which it is named.
_BLOCK_RATIO = 1.3
# Held-out error of the other views with a camera over that without, from which it spoils them.
_SPOILS = 1.1
# Minimum number of detections of a marker in the other poses for its prediction.
_MIN_READINGS = 4
_OPEN = Finding("poses_open", REFUSES)
# Median held-out error, in the stated error and the noise of the images together, from which it contradicts.
_CONTRADICTED = 3.0
# Variance of a median of normal numbers over the variance of their mean.
_MEDIAN = 0.5 * np.pi
# Median length of a normal error in the plane over its rms.
_MEDIAN_LENGTH = float(np.sqrt(np.log(2.0)))
# Minimum number of correspondences whose epipolar geometry determines their noise within a seventh.
_NOISE_PAIRS = 32


def cross_validate(
    solution: Solution,
    sigma_px: float,
    folds: int,
    seed: int,
    progress: Callable[[int, int], None] = lambda done, total: None,
    blocks: bool = True,
) -> CrossValidation:
    """Predict every pose from a fit to other poses, and the error of the prediction from its covariance.

    Each fit starts from the whole one and converges over its own poses, with its own outliers, so held-out
    poses influence the start only.

    Parameters
    ----------
    solution : fit to all poses.
    sigma_px : noise per coordinate, px.
    folds : number of parts to divide the poses into.
    seed : seed of the division.
    progress : called after each part with the number done and the total.
    blocks : whether to divide the poses into blocks of posture and of time too, and to leave out each of
        three cameras or more.

    Returns
    -------
    Held-out residuals, their statistics and predicted deviations, px.

    Raises
    ------
    InputError
        If there are fewer poses than parts.
    """
    detections = solution.problem.detections
    part, unit = _divide(detections, folds, np.random.default_rng(seed))
    names, V = _BLOCKS if blocks else (), len(detections.view)
    alone = range(V if blocks and len(VIEWS) < V else 0)  # cameras that are left out in turn
    total, done = folds * (1 + len(names) + len(alone)), 0

    def on_fold() -> None:
        """Count a part."""
        nonlocal done
        done += 1
        progress(done, total)

    residual, predicted, lost = _of_parts(solution, part, sigma_px, on_fold)
    distance = np.linalg.norm(residual, axis=3)
    statistics = _distance_statistics(distance[np.isfinite(distance)])
    expected = _expected_px(predicted)
    of_blocks: dict[str, Any] = {}
    for name in names:
        apart, spread, _ = _of_parts(solution, _blocks(detections, folds, name), sigma_px, on_fold)
        length = np.linalg.norm(apart, axis=3)
        of_blocks[f"{name}_rms_px"] = _distance_statistics(length[np.isfinite(length)])["rms_px"]
        of_blocks[f"{name}_predicted_px"] = _expected_px(spread)
    others = np.array([_of_others(solution, v, part, residual, sigma_px, on_fold) for v in alone])
    found = tuple(_on_held_out(statistics["rms_px"], expected, len(lost), of_blocks))
    found += tuple(_on_others(detections.view, others)) if len(others) else ()
    return CrossValidation(
        folds=folds,
        seed=seed,
        unit=unit,
        failed=tuple(lost),
        reason=text(found),
        findings=found,
        others_px=others if len(others) else None,
        **statistics,
        predicted_rms_px=expected,
        pose=detections.pose,
        fold=part,
        marker=detections.marker,
        residual=residual,
        predicted=predicted,
        blocks=HeldOutBlocks(**of_blocks),
    )


def _of_others(
    solution: Solution,
    v: int,
    part: IntArray,
    residual: FloatArray,
    sigma_px: float,
    on_fold: Callable[[], None],
) -> FloatArray:
    """Held-out rms (2,) of the other views, px, by fits with a view and without it; NaN if there is none.

    residual : (K, V, m, 2) of the fits with all views; both count if both predict.
    """
    whole, keep = solution.problem.detections, [u for u in range(len(residual[0])) if u != v]
    some = whole.of_views(keep)
    known = np.isin(whole.marker, some.marker)
    lens = None if solution.params.lens is None else solution.params.lens[keep]
    params = replace(solution.params, P=solution.params.P[keep], M=solution.params.M[known], lens=lens)
    problem = solution.problem.alike(some).with_noise(solution.problem.tau)
    rows = whole.seen[keep].any(axis=0)
    used = solution.used[keep][:, rows]
    rest = replace(solution, problem=problem, params=params, residual=problem.residual(params), used=used)
    without, _, _ = _of_parts(rest, part, sigma_px, on_fold)
    both = np.stack([residual[:, keep][:, :, known], without])
    squares = np.square(both).sum(axis=-1)[:, np.isfinite(both).all(axis=(0, -1))]
    return np.sqrt(squares.mean(axis=1)) if squares.size else np.full(2, np.nan)


def _on_others(view: tuple[str, ...], others: FloatArray) -> Iterator[Finding]:
    """Name the camera without which the others (V, 2) are predicted best, or say that none spoils them."""
    if not np.isfinite(others).any():
        return
    gain = others[:, 0] / others[:, 1]
    v = int(np.nanargmax(gain))
    subject, (with_it, without) = Subject(views=(view[v],)), others[v].tolist()
    if gain[v] < _SPOILS:
        yield Finding("no_spoiling_camera", NOTE, subject, float(1.0 / gain[v]), limit=_SPOILS)
    else:
        yield Finding("spoiling_camera", LIMITS, subject, with_it, limit=without, unit="px")


def _expected_px(predicted: FloatArray) -> float | None:
    """Expected distance, px, root mean square, from deviations (…) of coordinates, NaN if there is none."""
    # Two coordinates a distance.
    return float(np.sqrt(2.0 * np.nanmean(predicted**2))) if np.isfinite(predicted).any() else None


def _blocks(detections: Detections, folds: int, name: str) -> IntArray:
    """Part (K,) of each pose, -1 without detections: neighbours in time or along the main axis of joints."""
    present, part = np.unique(detections.pose_of), np.full(len(detections.q), -1, dtype=np.int64)
    place = np.arange(present.size, dtype=np.float64)
    if name == "posture":
        q = detections.q[present] / np.maximum(np.ptp(detections.q[present], axis=0), SAME_READING)
        place = (q - q.mean(axis=0)) @ np.linalg.svd(q - q.mean(axis=0), full_matrices=False)[2][0]
    part[present[np.argsort(place, kind="stable")]] = np.arange(present.size) * folds // present.size
    return part


def _of_parts(
    solution: Solution, part: IntArray, sigma_px: float, on_fold: Callable[[], None]
) -> tuple[FloatArray, FloatArray, list[str]]:
    """Residuals of each part (K,) from a fit to the others, their deviations (K, V, m, 2), and failures."""
    detections = solution.problem.detections
    shape = (len(detections.q), len(detections.seen), detections.marker.size, 2)
    residual, predicted = np.full(shape, np.nan), np.full(shape, np.nan)
    lost = []
    for fold in range(int(part.max()) + 1):
        try:
            rows, difference, deviation = _held_out_residuals(solution, part == fold, sigma_px)
        except WorkFailed as error:
            lost.append(f"part {fold + 1}: {error}")
        else:
            for v in range(len(rows)):
                at = np.flatnonzero(rows[v])
                where = detections.pose_of[at], v, detections.marker_of[at]
                residual[where], predicted[where] = difference[v, at], deviation[v, at]
        on_fold()
    return residual, predicted, lost


def _divide(detections: Detections, folds: int, rng: np.random.Generator) -> tuple[IntArray, str]:
    """Part (K,) of each pose, -1 without detections, and whether poses or configurations were divided.

    Poses that differ in one joint only, as the spins of a tool, share the errors of the others and predict
    little elsewhere: they stay together unless a part would then be too large, as with trial motions of
    single joints.
    """
    present = np.unique(detections.pose_of)
    if not _MIN_FOLDS <= folds <= present.size:
        raise InputError(
            f"cross-validation in {folds} parts: there are {present.size} poses; "
            f"choose {_MIN_FOLDS} to {present.size} parts"
        )
    q = detections.q[present]
    changed = (np.abs(q[:, None] - q[None]) > SAME_READING).sum(axis=2)
    group = np.asarray(connected_components(changed <= 1, directed=False)[1], dtype=np.int64)
    if np.bincount(group).max() * folds > present.size:
        group = np.arange(present.size)
    members = np.bincount(group)
    size = np.zeros(folds, dtype=np.int64)
    chosen = np.empty(len(members), dtype=np.int64)
    for g in rng.permutation(len(members)):
        chosen[g] = np.argmin(size)
        size[chosen[g]] += members[g]
    part = np.full(len(detections.q), -1, dtype=np.int64)
    part[present] = chosen[group]
    return part, "poses" if members.max() == 1 else "configurations"


def _held_out_residuals(
    solution: Solution, held_out: BoolArray, sigma_px: float
) -> tuple[BoolArray, FloatArray, FloatArray]:
    """Residuals of held-out poses (K,) from a fit to the others.

    Returns the detections (V, N) predicted, seen minus predicted (V, N, 2) and its deviation (V, N, 2), px.
    Raises WorkFailed if the other poses do not determine the robot.
    """
    whole = solution.problem.detections
    training = whole.of_poses(~held_out)
    known = training.count_of(training.seen) >= _MIN_READINGS
    tau = solution.problem.tau
    problem = solution.problem.alike(training.of_markers(known)).with_noise(tau)
    require_motion(problem.detections)
    params = dataclasses.replace(solution.params, M=solution.params.M[known])
    found = fit_inliers(problem, params, solution.sigma_px)
    if found is None:
        raise failed([_OPEN])
    found, kept = found.determined()
    known[known] = kept
    place = held_out[whole.pose_of] & known[whole.marker_of]
    test = solution.problem.alike(whole.of_poses(held_out).of_markers(known))
    left, weight = test.residual(found.params), test.detections.weight[..., None]
    variance = sum((part**2).sum(axis=-1) for part in test.predicted(found.params, found.errors()))
    # A direction that the other poses leave open keeps its value of the whole fit.
    if np.sqrt(variance[test.detections.seen].mean()) > UNDETERMINED_NOISE:
        raise failed([_OPEN])
    if tau is not None:  # joints of a held-out pose have their own noise
        variance += ((test.joint_derivative(found.params) * tau) ** 2).sum(axis=-1)
    difference, error = np.zeros((2, *whole.seen.shape, 2))
    difference[:, place], error[:, place] = -left / weight, sigma_px * np.sqrt(1.0 + variance) / weight
    return solution.used & place, difference, error


def _on_held_out(
    rms: float | None, expected: float | None, lost: int, blocks: Mapping[str, Any]
) -> Iterator[Finding]:
    """Tell how the held-out error compares with the predicted one, and where blocks of poses err more."""
    if rms is None or expected is None:
        yield Finding("nothing_held_out", LIMITS)
        return
    yield Finding("held_out", NOTE, amount=rms, limit=expected, unit="px")
    ratio = rms / expected
    if ratio > WARN_RATIO:
        yield Finding("poses_disagree", LIMITS, amount=ratio, limit=WARN_RATIO)
    if lost:
        yield Finding("parts_lost", LIMITS, amount=lost, unit="1")
    for name in _BLOCKS:
        apart, predicted = blocks.get(f"{name}_rms_px"), blocks.get(f"{name}_predicted_px")
        if apart is not None and predicted is not None and apart > _BLOCK_RATIO * max(ratio, 1.0) * predicted:
            yield Finding(f"{name}_blocks", LIMITS, amount=apart / predicted, limit=_BLOCK_RATIO)


def residual_statistics(calibration: Calibration, observation: Observation) -> dict[str, Any]:
    """Statistics of the distance between predicted and seen pixels, one for each marker and view.

    calibration : projective kinematics.
    observation : stereo images of the same robot, px; poses in motion do not count.
    Returns ``count``; ``rms_px``, ``median_px``, ``p95_px`` (None without a pair); ``stated_px``, the median
    error that the covariance states at these readings, ``noise_px`` of these images and readings, and
    ``limit_px`` of the median by both (None without a pair); ``views``, the ``view``, ``count``,
    ``median_px`` and ``limit_px`` of each; ``skipped``, the numbers of pairs of unknown markers, behind the
    camera, and missing; ``advice`` about placeholders, which are missing ones;
    ``findings``, on these and on medians beyond their limits.
    Raises InputError if the readings have another number of joints or are not finite.
    """
    observation, told = comparable(calibration, observation)
    images = observation.images
    known = np.isin(observation.marker, calibration.marker)
    numbers = calibration.marker.tolist()
    order = [numbers.index(number) for number in observation.marker[known].tolist()]
    pixels = predict(calibration, observation.q)[:, :, order]
    seen: BoolArray = np.asarray(np.isfinite(images).all(axis=-1))
    ahead = np.isfinite(pixels[..., 0])
    compared = seen[:, :, known] & ahead
    off = np.where(compared[..., None], observation.images[:, :, known] - pixels, np.nan)
    distance = np.linalg.norm(off, axis=-1)
    found = _distance_statistics(distance[compared])
    views = [_distance_statistics(distance[:, v][compared[:, v]]) for v in range(len(calibration.view))]
    stated = noise = limit = None
    limits: list[float | None] = [None] * len(views)
    if found["count"]:
        of_pairs = prediction_variance(calibration, observation.q).sum(axis=-1)[:, :, order]
        of_readings = np.zeros_like(of_pairs)
        if calibration.sigma_q:  # these readings have their own noise
            J = reading_changes(calibration, observation.q)[:, :, order]
            of_readings = (J**2).sum(axis=(-2, -1))
        of_images = _image_noise(calibration, observation)
        stated = float(np.sqrt(np.median(of_pairs[compared])))
        noise = float(np.hypot(of_images, np.sqrt(np.median(of_readings[compared]))))
        limit = _CONTRADICTED * float(np.hypot(stated, noise))
        own = calibration.sigma_view_px if calibration.sigma_view_px is not None else np.zeros(len(views))
        for v in np.flatnonzero(compared.any(axis=(0, 2))).tolist():
            variances = (float(np.median(part[:, v][compared[:, v]])) for part in (of_pairs, of_readings))
            limits[v] = _limit_of_view(off[:, v], max(of_images, float(np.sqrt(2.0) * own[v])), *variances)
    found |= {
        "stated_px": stated,
        "noise_px": noise,
        "limit_px": limit,
        "views": [
            {"view": name, "count": one["count"], "median_px": one["median_px"], "limit_px": allowed}
            for name, one, allowed in zip(calibration.view, views, limits, strict=True)
        ],
        "skipped": {
            "unknown_marker": int(seen[:, :, ~known].sum()),
            "behind_camera": int((seen[:, :, known] & ~ahead).sum()),
            "missing": int((~seen).sum()),
        },
        "advice": list(lines(told, setup_of(calibration))),
    }
    return found | {"findings": [*told, *contradicted_views(found)]}


def comparable(calibration: Calibration, observation: Observation) -> tuple[Observation, tuple[Finding, ...]]:
    """Return images at rest of the views of a calibration, boards turned as there, and findings on them.

    Raises InputError if a view is missing.
    """
    observation = of_views(observation.at_rest, calibration.view)
    images, told = without_placeholders(observation.images, observation.marker)
    board = BoardNumbering.of(replace(observation, images=images))
    board.turn_by(calibration)
    return board.observation, (*told, *board.findings)


def median_limit(found: Mapping[str, Any]) -> Finding:
    """Return the limit of the median of residuals, and the limited quantity, by their statistics."""
    errors = Finding("errors", amount=found["stated_px"], limit=found["noise_px"], unit="px")
    parts = errors, Finding("factor", amount=_CONTRADICTED)
    return Finding(
        "median_limit", NOTE, amount=found["median_px"], limit=found["limit_px"], unit="px", others=parts
    )


def contradicted_views(found: Mapping[str, Any]) -> Iterator[Finding]:
    """Tell by the statistics of residuals whether a median passes its limit: of some views, or of all."""
    limit, median = found["limit_px"], found["median_px"]
    if limit is None:
        return
    beyond = tuple(
        Finding("contradicted_view", LIMITS, Subject((), (one["view"],)), off, limit=most, unit="px")
        for one in found["views"]
        for off, most in [(one["median_px"], one["limit_px"])]
        if one["count"] and most is not None and off > most
    )
    if 0 < len(beyond) < len(found["views"]):
        views = tuple(view for one in beyond for view in one.subject.views)
        yield Finding("contradicted_in_part", REFUSES, Subject(views=views), others=beyond)
    elif beyond or median > limit:
        parts = (median_limit(found),) if median > limit else beyond
        yield Finding("contradicted", REFUSES, amount=median, limit=limit, unit="px", others=parts)


def _limit_of_view(off: FloatArray, noise: float, stated: float, of_readings: float) -> float:
    """Limit, px, of the median length of differences (K, m, 2) from predicted pixels; NaN unseen.

    A camera that turned shifts all its images alike. The median over poses averages the noise out of the
    shift, so the limit is the median that the largest shift by the stated error and by chance would leave.
    noise : Euclidean, px; stated, of_readings : variances of the pixels by the covariance, by readings, px².
    """
    seen = off[np.isfinite(off[..., 0]).any(axis=1)]
    centers = np.nanmedian(seen, axis=1)
    shift = np.median(centers, axis=0)
    between = float(np.median(np.linalg.norm(centers - shift, axis=1))) / _MEDIAN_LENGTH
    of_poses = max(between**2, of_readings) / len(seen)
    chance = max(_MEDIAN**2 * noise**2 / float(np.isfinite(seen[..., 0]).sum()), _MEDIAN * of_poses)
    largest = _CONTRADICTED**2 * (stated + chance)
    left = float(np.nanmedian(np.linalg.norm(seen, axis=-1))) ** 2 - float(shift @ shift)
    together = _CONTRADICTED**2 * (stated + noise**2 + of_readings)
    return float(np.sqrt(min(together, max(left, 0.0) + largest)))


def of_views(observation: Observation, names: tuple[str, ...]) -> Observation:
    """Select the views of a calibration, by their names.

    Raises InputError if one is missing.
    """
    if observation.view == names:
        return observation
    if missing := [name for name in names if name not in observation.view]:
        raise InputError(
            f"the images are of {', '.join(observation.view)}, and the calibration has "
            f"{', '.join(names)}: add {', '.join(missing)}, or calibrate without"
        )
    which = [observation.view.index(name) for name in names]
    some: dict[str, Any] = {"images": observation.images[:, which]}
    for name in ("sigma", "t_view"):
        values = getattr(observation, name)
        some[name] = None if values is None else values[:, which]
    return replace(observation, view=names, **some)


def _image_noise(calibration: Calibration, observation: Observation) -> float:
    """Euclidean noise of the pixels of an observation, px, by its own epipolar geometry.

    That of the calibration if few markers were seen by both cameras, or without parallax.
    """
    detections = Detections.of(observation, calibration.joint_types)
    if calibration.lens is not None:
        straight = undistort(calibration.lens, detections.pixels)
        seen = detections.seen & np.isfinite(straight).all(axis=2)
        detections = replace(detections, pixels=np.where(seen[..., None], straight, 0.0), seen=seen)
    sigma = calibration.fit.sigma_px
    if len(detections.pair) == 2 and np.count_nonzero(detections.both) >= _NOISE_PAIRS:
        with suppress(WorkFailed):
            sigma = Epipolar.of(detections, np.random.default_rng(0)).sigma_px
    return float(np.sqrt(2.0)) * sigma


def _distance_statistics(distance: FloatArray) -> dict[str, Any]:
    """``count``, ``rms_px``, ``median_px``, ``p95_px`` of distances (L,), the last three None without one."""
    some = distance.size > 0
    return {
        "count": int(distance.size),
        "rms_px": float(np.sqrt(np.mean(distance**2))) if some else None,
        "median_px": float(np.median(distance)) if some else None,
        "p95_px": float(np.percentile(distance, 95)) if some else None,
    }
