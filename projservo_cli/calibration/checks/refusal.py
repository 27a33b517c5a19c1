"""Refusals of a fit, and the cause that the data show: joints, order of images, poses that changed."""

import dataclasses
from collections.abc import Sequence
from itertools import islice

import numpy as np

from projservo_cli.calibration.bundle_adjustment import LeastSquares, minimize
from projservo_cli.calibration.checks.model_error import describe, stepped
from projservo_cli.calibration.checks.outliers import MAX_OF_POSE, Outliers, fits_other_joints
from projservo_cli.calibration.checks.quality import check_model
from projservo_cli.calibration.checks.validation import cross_validate
from projservo_cli.calibration.detections import Detections, beginning_in
from projservo_cli.calibration.epipolar import ImageGeometry
from projservo_cli.calibration.initialization import Search, starting_markers, starts
from projservo_cli.calibration.lens_estimation import undistorted
from projservo_cli.calibration.robust_fit import Expected, Solution, fit_from
from projservo_cli.records import TOOL, WORLD, BoolArray, FloatArray, WorkFailed, letters_of

# Maximum fitted over expected noise of a fit that rejects much, as wrong detections hide in the residuals.
DOUBTED_RATIO = 1.15
# Share of rejected detections, explained ones apart, above which a fit rejects much.
MUCH = 0.1
# Epipolar distance, in units of its noise, below which an observation is no error of detection.
_CONSISTENT = 3.0
# Maximum share of observations that both views agree on and a fit may reject.
_MAX_UNEXPLAINED = 0.02
# Minimum share of a pose's observations that a wrong motion displaces: single slanted corners err along
# the epipolar line.
_MIN_OF_POSE = 0.25
# Minimum number of observations of one pose whose agreement on joints is more than chance.
_AGREEING = 5
# Share of the poses that show another motion above which the joint readings are wrong.
_MANY_POSES = 0.4
# Number of hypotheses about a joint at fault that are fitted completely.
_FOLLOWED = 2
# Number of hypotheses about the mount and the order of images, the first ones.
_ORDERS = 3
# Number of adjustment steps of the screws by which hypotheses are compared before.
_SCREW_STEPS = 8
# Log residual added to a joint of the other type, which explains more: one that stands still is simpler.
_SIMPLER = 0.1
# Maximum number of markers in the test of joint types.
_TYPED = 20
# Minimum share of the readings by which a prismatic joint does not turn the images, and in deviations of it.
_STRAIGHT, _SURE = 0.5, 6.0
# Minimum share that a fit keeps of the motion of each joint and, if it rejects much, of the detections.
_KEPT = 0.5
# Minimum number of poses in a row that are nearly all rejected where something changed.
_WRONG_RUN = 5
# Joints that are farther than this share of their range from the median have moved; so many poses in which
# several did, and this share of them, are rejected at least where readings are in the wrong order.
_MOVED, _WRONG_POSES, _WRONG_SHARE = 0.1, 3, 0.5
# Maximum share of the other poses that is rejected there, over that of these.
_OTHERS_SHARE = 0.25
# Maximum noise of such a fit over that of the rig, beyond which no error of it is stated.
_CONTRADICTED_RATIO = 1.5
# Maximum held-out over predicted error of a fit that rejects much.
_DOUBTED_ERROR = 1.3
# Number of parts in the cross-validation of a fit that rejects much.
_PARTS = 3


def _doubtful_observations(solution: Solution, found: Outliers, epipolar: ImageGeometry) -> BoolArray:
    """Mask (N,) of rejected, unexplained observations that both views agree on, if a pose has several.

    Errors of detection break the epipolar geometry; observations that obey it contradict the robot model.
    """
    detections = undistorted(solution.problem.detections, solution.params.lens)
    both = detections.both
    out = both & ~solution.used.all(axis=0) & ~found.explained.any(axis=0)
    out[both] &= epipolar.within(detections.rows(both), _CONSISTENT)
    at, poses = detections.pose_of, len(detections.q)
    share = np.bincount(at[out], minlength=poses) / np.maximum(np.bincount(at[both], minlength=poses), 1)
    return np.asarray(out & (share >= _MIN_OF_POSE)[at])


def describe_unexplained(solution: Solution, found: Outliers, epipolar: ImageGeometry) -> str:
    """Describe rejected observations that both views agree on, which contradict a fit; else empty."""
    total = int(solution.problem.detections.both.sum())
    count = int(_doubtful_observations(solution, found, epipolar).sum())
    if count <= max(3.0, _MAX_UNEXPLAINED * total):
        return ""
    return (
        f"in {count} of {total} observations both cameras agree with each other but not with the robot; "
        "check the joint readings and types (R or P)"
    )


def describe_other_motion(solution: Solution, found: Outliers, epipolar: ImageGeometry) -> str:
    """Describe a motion other than the joint readings that rejected observations agree on; else empty.

    It takes observations that both views agree on, at poses of which the rest is kept. Corners of an image
    share errors, so it takes a large share of the poses too.
    """
    problem, total = solution.problem, int(solution.problem.detections.both.sum())
    out, count, poses = _doubtful_observations(solution, found, epipolar), 0, 0
    for k in np.unique(problem.detections.pose_of[out]):
        rows = np.flatnonzero(out & (problem.detections.pose_of == k))
        if rows.size < _AGREEING:
            continue
        some = rows[:: max(1, rows.size // MAX_OF_POSE)]
        alone = LeastSquares.of(problem.detections.rows(some), problem.q_reference).with_noise(problem.tau)
        if fits_other_joints(alone, solution.params, problem.q, solution.sigma_px):
            count, poses = count + rows.size, poses + 1
    seen = np.unique(problem.detections.pose_of).size
    if count <= max(3.0, _MAX_UNEXPLAINED * total) or poses <= _MANY_POSES * seen:
        return ""
    return (
        f"{count} of {total} observations, at {poses} of {seen} poses, show other joints than those read; "
        "check how poses and images are paired, and the joint readings and types (R or P)"
    )


def straight_joints(solution: Solution) -> list[int]:
    """Revolute joints that images do not see turn: by their gear, to first order, without a fit.

    A prismatic joint has the same motion as a revolute one with its axis far away that turns by nothing.
    """
    solution = solution.determined()[0].thinned(_TYPED)
    problem, params, used = solution.problem, solution.params, solution.used
    turned = (problem.joints(params) - problem.q_reference)[problem.detections.pose_of, None]
    by_gear = (problem.joint_derivative(params) * turned * used[..., None, None]).reshape(
        -1, turned.shape[-1]
    )
    J = problem.dense(problem.derivative(params), used)
    rows = problem.whitened(params, np.hstack([J, by_gear, solution.raw.reshape(-1, 1)]), used)
    J, by_gear, left = np.split(rows, [J.shape[1], rows.shape[1] - 1], axis=1)
    J = J / np.maximum(np.linalg.norm(J, axis=0), 1e-300)
    apart = by_gear - J @ np.linalg.lstsq(J, by_gear)[0]
    inverse = np.linalg.pinv(apart)
    gear, std = -inverse @ left[:, 0], solution.sigma_px * np.linalg.norm(inverse, axis=1)
    found = ~problem.detections.prismatic & (gear < -_STRAIGHT) & (gear < -_SURE * std)
    return [int(i) for i in np.flatnonzero(found)]


def joint_at_fault(search: Search, max_px: float, straight: Sequence[int] | None = None) -> str:
    """Describe the one change, of a joint or of the order of images, with which the model fits, or "".

    A rough fit compares all changes. The best are fitted completely and accepted only if the fit passes as a
    calibration does, with a noise of at most ``max_px``.

    straight : joints that alone may be of the other type.
    """
    detections = search.problem.detections
    few = detections.of_markers(starting_markers(detections, search.epipolar, search.rng))
    changes = _hypotheses(few, search.problem.q_reference)
    if straight is not None:
        changes = [changes[_ORDERS + i] for i in straight]
    candidates = []
    try:
        for done, (words, changed, handicap) in enumerate(changes):
            search.progress("calibration, joint at fault", done, len(changes))
            seen = changed.detections.seen
            for start in islice(starts(dataclasses.replace(search, problem=changed), changed.detections), 1):
                params = minimize(
                    changed, start, seen, robust=True, cameras=False, max_steps=_SCREW_STEPS
                ).params
                # In logarithms neither a few gross errors nor many small ones outweigh the rest.
                level = np.mean(np.log(np.linalg.norm(changed.residual(params)[seen], axis=1) + 1e-9))
                candidates.append((float(level) + handicap, words, changed, params))
    except WorkFailed:
        return ""
    candidates.sort(key=lambda candidate: candidate[0])
    for _, words, changed, params in candidates[:_FOLLOWED]:
        found = fit_from(changed, params, search.epipolar)
        if found is None or found.sigma_px > max_px:
            continue
        if not describe_unexplained(found, Outliers.empty(changed.detections), search.epipolar):
            return words
    return ""


def _hypotheses(detections: Detections, q_reference: FloatArray) -> list[tuple[str, LeastSquares, float]]:
    """Hypotheses that a joint is of the other type or stands still, or of late images; with a penalty."""
    found, q, numbers = [], detections.q, detections.numbers
    for order, shifted, remedy in (
        ("before", np.vstack([q[:1], q[:-1]]), "let each pose settle for longer (plant.settle_s)"),
        ("after", np.vstack([q[1:], q[-1:]]), "store readings with the image of the same pose"),
    ):
        words = f"each image shows the pose {order} its reading: {remedy}, and take the newest frame"
        found.append((words, LeastSquares.of(dataclasses.replace(detections, q=shifted), q_reference), 0.0))
    other, there = (TOOL, "on the tool") if detections.mount == WORLD else (WORLD, "fixed")
    backwards = dataclasses.replace(
        detections, q=np.ascontiguousarray(-q[:, ::-1]), prismatic=detections.prismatic[::-1], mount=other
    )
    words = f"by the images the cameras are {there}: give --mount {other} (data.mount)"
    found.insert(0, (words, LeastSquares.of(backwards, -q_reference[::-1]), 0.0))
    for i, slides in enumerate(detections.prismatic):
        flipped = detections.prismatic.copy()
        flipped[i] = not slides
        given, fits = ("prismatic", "revolute") if slides else ("revolute", "prismatic")
        letters = letters_of(flipped[numbers.argsort()])
        remedy = f"check the types of joints, --joints or joint_types ({letters} would fit)"
        words = f"by the images joint {numbers[i]} is {fits}, not {given}: {remedy}"
        turned = dataclasses.replace(detections, prismatic=flipped)
        found.append((words, LeastSquares.of(turned, q_reference), _SIMPLER))
    for i in range(len(q_reference) if len(q_reference) > 1 else 0):
        still = f"by the images joint {numbers[i]} stands still while its readings move"
        words = f"{still}: check that they are its own"
        fewer = dataclasses.replace(
            detections, q=np.delete(detections.q, i, axis=1), prismatic=np.delete(detections.prismatic, i)
        )
        found.append((words, LeastSquares.of(fewer, np.delete(q_reference, i)), 0.0))
    return found


def describe_deviation(solution: Solution, expected: Expected) -> str:
    """Describe the deviation from the model that explains most of a fit that is refused; else empty."""
    if expected.known or solution.dof <= 0:
        return ""
    errors = check_model(solution, solution.errors(), expected.noise_px(solution)).errors
    onset, prismatic = (
        _change(_rejected_views(solution), solution.problem.detections.view)[0],
        solution.params.prismatic,
    )
    if not onset and errors and errors[0].first is not None:
        onset = int(np.argmax(solution.problem.detections.pose == errors[0].first))
    found = (stepped(solution, onset) if onset else None) or next(iter(errors), None)
    return "" if found is None else f"the residuals look as if {describe(found, prismatic)[1]}"


def refusal(solution: Solution, expected: Expected) -> str | None:
    """Return the reason why a fit must not pass, or None: its noise, or the poses that it rejects."""
    if (of_noise := expected.refusal(solution)) is not None:
        return of_noise
    rejected = _rejected_views(solution)
    names = solution.problem.detections.view
    return _change(rejected, names)[1] or _describe_order(solution, rejected) or _describe_unmoved(solution)


def _describe_unmoved(solution: Solution) -> str | None:
    """Describe a joint whose motion is mostly rejected, as with a wrong type or wrong readings, or None."""
    detections = solution.problem.detections
    kept = np.unique(detections.pose_of[solution.used.any(axis=0)])
    square = (detections.q - detections.q.mean(axis=0)) ** 2
    short = square[kept].sum(axis=0) < _KEPT * square.sum(axis=0)
    if not short.any():
        return None
    i = int(np.argmax(short))
    number = detections.numbers[i]
    return f"the fit rejects most motion of joint {number}; check its readings and its type (R or P)"


def _rejected_views(solution: Solution) -> BoolArray:
    """Whether a view (V, K) of a pose is mostly rejected."""
    detections = solution.problem.detections
    V = len(solution.used)
    seen, used = np.zeros((2, V, len(detections.q)))
    for view in range(V):
        np.add.at(seen[view], detections.pose_of, detections.seen[view])
        np.add.at(used[view], detections.pose_of, solution.used[view])
    return np.asarray(used < _KEPT * seen)


def _change(rejected: BoolArray, names: Sequence[str]) -> tuple[int, str]:
    """Row from or up to which poses are nearly all rejected, and a sentence on it; 0 and none without.

    rejected : (V, K) views of poses that mostly are; names : of the views.
    """
    views = [
        ("", rejected.all(axis=0)),
        *((f" in the {name} view", rejected[v]) for v, name in enumerate(names)),
    ]
    for where, gone in views:
        for which, row in (("first", gone), ("last", gone[::-1])):
            count = beginning_in(row)
            if max(_WRONG_RUN, MUCH * len(row)) <= count < len(row):
                return count if which == "first" else len(row) - count, (
                    f"the fit rejects nearly all of the {which} {count} poses{where}: the base, a camera, "
                    "the tool or the readings of joints changed there; record again, or remove these poses"
                )
    return 0, ""


def _describe_order(solution: Solution, rejected: BoolArray) -> str | None:
    """Describe poses of several joints that are rejected where those of one are not, or None.

    One joint at a time moves alike whichever column its readings are in: only together they show the order.
    rejected : (V, K) views of poses that mostly are.
    """
    detections, lost = solution.problem.detections, rejected.all(axis=0)
    away = np.abs(detections.q - np.median(detections.q, axis=0)) > _MOVED * np.ptp(detections.q, axis=0)
    several = away.sum(axis=1) > 1
    wrong, alone = np.count_nonzero(several & lost), np.count_nonzero(~several & lost)
    count, others = several.sum(), np.count_nonzero(~several)
    few = wrong < max(_WRONG_POSES, _WRONG_SHARE * count)
    if few or alone * count > _OTHERS_SHARE * wrong * others:
        return None
    return (
        f"the fit rejects {wrong} of the {count} poses in which several joints move, and {alone} of the "
        f"{others} others; check the order of the joints (q1, q2, ...) and the readings of these poses"
    )


def contradiction(
    whole: Solution, solution: Solution, found: Outliers, epipolar: ImageGeometry, stated_px: float
) -> str:
    """Describe evidence against a fit that rejects much, and a remedy; empty if there is none.

    The noise is that of the images, whatever was given. Of a fit that leaves more than the noise of the rig
    the rejected detections must agree on no other motion.
    """
    if solution.used.sum() < _KEPT * whole.problem.detections.seen.sum():
        return "that is most of them; remove markers that are not on the robot, and check the joint readings"
    ratio = solution.sigma_px / epipolar.noise_px
    if ratio > _CONTRADICTED_RATIO:
        return (
            f"the rest errs {ratio:.2g} times as much as noise; check the joint readings and types (R or P)"
        )
    if ratio > DOUBTED_RATIO and (other := describe_other_motion(solution, found, epipolar)):
        return other
    held_out = cross_validate(solution.kept(), solution.sigma_px, _PARTS, 0, blocks=False)
    rms, predicted = held_out.rms_px, held_out.predicted_rms_px
    if held_out.failed or rms is None or predicted is None:
        return "the rest does not predict held-out poses; record more poses and more markers"
    if rms > _DOUBTED_ERROR * np.hypot(predicted, stated_px):
        return "the rest does not predict held-out poses; record more poses and more markers"
    return ""
