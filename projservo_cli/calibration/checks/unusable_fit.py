"""Refusals of a fit, and the causes that its residuals show: joints, poses that changed."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from projservo_cli.calibration.bundle_adjustment import LeastSquares
from projservo_cli.calibration.checks.mismatched_poses import erring_joint, other_order
from projservo_cli.calibration.checks.model_errors import stepped
from projservo_cli.calibration.checks.observability_and_verdict import check_model
from projservo_cli.calibration.checks.outliers import MAX_OF_POSE, Outliers, fits_other_joints
from projservo_cli.calibration.checks.validation import cross_validate
from projservo_cli.calibration.detections import beginning_in
from projservo_cli.calibration.initial.epipolar import ImageGeometry
from projservo_cli.calibration.lens_estimation import undistorted
from projservo_cli.calibration.robust_fit import Expected, Solution
from projservo_cli.findings import REFUSES, Finding, Subject
from projservo_cli.records import BoolArray

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
# Maximum number of markers in the test of joint types.
_TYPED = 20
# Minimum share of the readings by which a prismatic joint does not turn the images, and in deviations of it.
_STRAIGHT, _SURE = 0.5, 6.0
# Minimum share that a fit keeps of the motion of each joint and, if it rejects much, of the detections.
_KEPT = 0.5
# Minimum number of poses in a row that are nearly all rejected where something changed.
_WRONG_RUN = 5
# Joints that are farther than this share of their range from the median have moved; number of poses in which
# several did are rejected at least where readings are in the wrong order, and this share if no order is.
_MOVED, _WRONG_POSES, _WRONG_SHARE = 0.1, 3, 0.5
# Maximum share of the other poses that is rejected there, over the share of these.
_OTHERS_SHARE = 0.25
# Maximum noise of such a fit over the noise of the rig, beyond which no error of it is stated.
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


def unexplained(solution: Solution, found: Outliers, epipolar: ImageGeometry) -> Finding | None:
    """Find rejected observations that both views agree on, which contradict a fit."""
    total = int(solution.problem.detections.both.sum())
    count = int(_doubtful_observations(solution, found, epipolar).sum())
    if count <= max(3.0, _MAX_UNEXPLAINED * total):
        return None
    return Finding("cameras_agree", REFUSES, amount=count, limit=total, unit="1")


def other_motion(solution: Solution, found: Outliers, epipolar: ImageGeometry) -> Finding | None:
    """Find a motion other than the joint readings that rejected observations agree on.

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
        return None
    at = Finding("other_joints", REFUSES, amount=poses, limit=seen, unit="1")
    return Finding("other_joints", REFUSES, amount=count, limit=total, unit="1", others=(at,))


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


def main_deviation(solution: Solution, expected: Expected) -> Finding | None:
    """Find the deviation from the model that explains most of a fit that is refused."""
    if expected.known or solution.dof <= 0:
        return None
    errors = check_model(solution, solution.errors(), expected.noise_px(solution)).errors
    detections = solution.problem.detections
    onset = _change(_rejected_views(solution), detections.view)[0]
    if not onset and errors and errors[0].subject.poses:
        onset = int(np.argmax(detections.pose == errors[0].subject.poses[0]))
    return (stepped(solution, onset) if onset else None) or next(iter(errors), None)


def refusal(solution: Solution, expected: Expected) -> Finding | None:
    """Return the finding by which a fit must not pass, or None: its noise, or the poses that it rejects."""
    if (of_noise := expected.refusal(solution)) is not None:
        return of_noise
    rejected = _rejected_views(solution)
    names = solution.problem.detections.view
    return _change(rejected, names)[1] or _wrong_order(solution, rejected) or _unmoved(solution)


def _unmoved(solution: Solution) -> Finding | None:
    """Find a joint whose motion is mostly rejected, as with a wrong type or wrong readings, or None."""
    detections = solution.problem.detections
    kept = np.unique(detections.pose_of[solution.used.any(axis=0)])
    square = (detections.q - detections.q.mean(axis=0)) ** 2
    short = square[kept].sum(axis=0) < _KEPT * square.sum(axis=0)
    if not short.any():
        return None
    subject = Subject(joints=(int(detections.numbers[np.argmax(short)]),))
    return Finding("rejected_motion", REFUSES, subject)


def _rejected_views(solution: Solution) -> BoolArray:
    """Whether a view (V, K) of a pose is mostly rejected."""
    detections = solution.problem.detections
    V = len(solution.used)
    seen, used = np.zeros((2, V, len(detections.q)))
    for view in range(V):
        np.add.at(seen[view], detections.pose_of, detections.seen[view])
        np.add.at(used[view], detections.pose_of, solution.used[view])
    return np.asarray(used < _KEPT * seen)


def _change(rejected: BoolArray, names: Sequence[str]) -> tuple[int, Finding | None]:
    """Row from or up to which poses are nearly all rejected, and a finding on it; 0 and none without.

    rejected : (V, K) views of poses that mostly are; names : of the views.
    """
    views = [((), rejected.all(axis=0)), *(((name,), rejected[v]) for v, name in enumerate(names))]
    for where, gone in views:
        for which, row in (("first", gone), ("last", gone[::-1])):
            count = beginning_in(row)
            if max(_WRONG_RUN, MUCH * len(row)) <= count < len(row):
                onset = count if which == "first" else len(row) - count
                return onset, Finding(
                    "rejected_poses", REFUSES, Subject(views=where, name=which), count, unit="1"
                )
    return 0, None


def _wrong_order(solution: Solution, rejected: BoolArray) -> Finding | None:
    """Find poses of several joints that are rejected while poses of one are not, or None.

    One joint at a time moves alike whichever column its readings are in: only together they show the order.
    If no other order explains these poses, joints err by more than the readings of trials show: one, or
    several.
    rejected : (V, K) views of poses that mostly are.
    """
    detections, lost = solution.problem.detections, rejected.all(axis=0)
    away = np.abs(detections.q - np.median(detections.q, axis=0)) > _MOVED * np.ptp(detections.q, axis=0)
    several = away.sum(axis=1) > 1
    wrong, alone = np.count_nonzero(several & lost), np.count_nonzero(~several & lost)
    count, others = several.sum(), np.count_nonzero(~several)
    if wrong < _WRONG_POSES or alone * count > _OTHERS_SHARE * wrong * others:
        return None
    code, poses = "joint_order", np.flatnonzero(several & lost)
    if not other_order(solution, poses):
        if wrong < _WRONG_SHARE * count:
            return None
        code = "several_joints"
    of_poses = Finding(code, REFUSES, amount=int(wrong), limit=int(count), unit="1")
    if code == "several_joints" and (one := erring_joint(solution, poses)):
        return dataclasses.replace(one, others=(of_poses,))
    rest = Finding(code, REFUSES, amount=int(alone), limit=int(others), unit="1")
    return dataclasses.replace(of_poses, others=(rest,))


def contradiction(
    whole: Solution, solution: Solution, found: Outliers, epipolar: ImageGeometry, stated_px: float
) -> Finding | None:
    """Find evidence against a fit that rejects much.

    The noise is taken from the images, whatever was given. Of a fit that leaves more than the noise of the
    rig the rejected detections must agree on no other motion.
    """
    total = whole.problem.detections.seen.sum()
    gone = float(1.0 - solution.used.sum() / total)
    if solution.used.sum() < _KEPT * total:
        return Finding("rejects_most", REFUSES, amount=gone, limit=1.0 - _KEPT, unit="1")
    ratio = solution.sigma_px / epipolar.noise_px
    if ratio > _CONTRADICTED_RATIO:
        rest = Finding("residuals", REFUSES, amount=ratio, limit=_CONTRADICTED_RATIO, unit="1")
        return Finding("rest_is_off", REFUSES, amount=gone, unit="1", others=(rest,))
    if ratio > DOUBTED_RATIO and (other := other_motion(solution, found, epipolar)):
        return other
    held_out = cross_validate(solution.kept(), solution.sigma_px, _PARTS, 0, blocks=False)
    rms, predicted = held_out.rms_px, held_out.predicted_rms_px
    if (
        held_out.failed
        or rms is None
        or predicted is None
        or rms > _DOUBTED_ERROR * np.hypot(predicted, stated_px)
    ):
        return Finding("rest_predicts_nothing", REFUSES, amount=gone, unit="1")
    return None
