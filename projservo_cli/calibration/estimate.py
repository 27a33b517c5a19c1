"""``calibrate``: from an observation to projective kinematics, with its verdict."""

import dataclasses
import time
from collections.abc import Callable
from functools import partial

import numpy as np
from scipy.special import chdtri
from threadpoolctl import threadpool_limits

from projservo_cli.calibration.adjustment import LeastSquares
from projservo_cli.calibration.diagnosis import (
    Outliers,
    blamed_joint,
    listed,
    noise_at_free_poses,
    other_motion,
    unexplained,
    why_lost,
)
from projservo_cli.calibration.epipolar import Epipolar, ImageFrame
from projservo_cli.calibration.fit import REFUSE_RATIO, Expected, Misfit, Solution, solve, with_joint_noise
from projservo_cli.calibration.initialization import Nominal, Search, Tell
from projservo_cli.calibration.lens_estimation import share_explained, with_lens
from projservo_cli.calibration.projective import Projective, closed_form_operators
from projservo_cli.calibration.quality import WEAK_NOISE, cross_validate, judged
from projservo_cli.calibration.readings import Readings, require_images, require_motion
from projservo_cli.calibration.time_offset import with_delay
from projservo_cli.geometry.lens import FIRST
from projservo_cli.records import Calibration, Errors, InputError, Observation

_METHODS = ("refined", "closed_form")
# Fitted noise over the expected one from which on, though the fit passes, one joint may be to blame: it is
# where its change leaves no more than this share.
_DOUBTFUL_RATIO, _DOUBTFUL_SHARE = 2.0, 0.5
# Share of the residuals that makes a lens the likely reason of a refusal, and the probability with which
# noise alone exceeds coefficients that show no lens.
_DECISIVE_SHARE, _NO_LENS_TAIL = 0.5, 0.01
# A fit must keep this share of the motion of each joint, and where it leaves out much, of the readings. Then
# it may err by no more than these ratios of what is expected: in its residuals, in which what is wrong and
# stays hides, and when it predicts each of so many parts of the poses.
_KEPT, _DOUBTED_RATIO, _DOUBTED_ERROR, _PARTS = 0.5, 1.15, 1.3, 3
# Shares of the readings that are much to leave out: those that neither exchanges nor joints explain, all.
_MUCH, _MOST = 0.1, 0.4
# Share of readings that may lie outside the images: they are outliers.
_STRAYS = 0.01
# As many lines of advice as fit a screen, and as many examples as a line names.
_MOST_ADVICE, _EXAMPLES = 5, 3


def calibrate(
    observation: Observation,
    joint_types: str,
    *,
    method: str = "refined",
    sigma_px: float | None = None,
    source: str = "simulated",
    image_size: tuple[int, int] | None = None,
    seed: int = 0,
    lens: bool = False,
    init: Nominal | None = None,
    joint_noise: float | None = 0.0,
    fitted: Callable[[Solution, float], None] | None = None,
    tell: Tell = lambda what, done, total: None,
) -> Calibration:
    """Projective kinematics [RH00] section 2 from pixels and joint readings alone.

    Parameters
    ----------
    observation : stereo images of the markers at a sequence of poses, raw px, NaN where unseen.
    joint_types : one letter a joint, R or P.
    method : ``refined`` (maximum likelihood) or ``closed_form`` (eqs. 4, 5).
    sigma_px : noise per coordinate, px; None takes the root mean square of the observation's ``sigma``,
        of a recording times the common factor that both views show, else estimates it from the epipolar
        geometry. Readings with a sigma of their own are weighed by it.
    source : ``simulated`` (χ² decides against ``sigma_px``) or ``recorded``.
    image_size : width and height, px, for the start of the search; None takes the extent of the data.
    seed : of the random starts.
    lens : whether to estimate two coefficients of radial distortion a camera, about the image centre.
    init : robot and rig to try first as a start of ``refined``; the search follows where that misses.
    joint_noise : rms of joint readings less true joints, rad (prismatic × 0.3 m/rad), for ``refined``;
        None estimates it, and takes 0 unless the images show it.
    fitted : told the solution of ``refined`` and its noise, px, for what needs more than the record.
    tell : told how far ``refined`` is: what it does, how much of it is done, and of how much.

    Raises
    ------
    InputError
        If the arguments make no sense.
    WorkFailed
        If the data do not support a calibration: which joint or marker, and why.
    """
    if method not in _METHODS:
        raise InputError(f"calibration method {method!r}: choose one of {', '.join(_METHODS)}")
    if source not in ("simulated", "recorded"):
        raise InputError(f"calibration source {source!r}: choose simulated or recorded")
    if sigma_px is not None and not 0.0 < sigma_px < np.inf:
        raise InputError(f"pixel noise {sigma_px!r}: give a positive number, or none to estimate it")
    if image_size is not None and not all(0.0 < length < np.inf for length in image_size):
        raise InputError(f"image size {image_size!r}: give a positive width and height, px")
    if seed < 0:
        raise InputError(f"seed {seed!r}: give a whole number that is not negative")
    if joint_noise is not None and not 0.0 <= joint_noise < np.inf:
        raise InputError(f"joint noise {joint_noise!r}: give a number that is not negative, or none")
    if lens and method != "refined":
        raise InputError(
            f"calibration method {method!r} estimates no lens: choose refined, or calibrate without"
        )
    begin = time.perf_counter()
    solution = None
    # The matrices are small: a second thread costs more than it gives.
    with threadpool_limits(limits=1):
        readings = Readings.of(observation, joint_types)
        require_motion(readings)
        if lens and image_size is not None:
            _require_size(readings, image_size)
        require_images(readings, sigma_px)
        rng = np.random.default_rng(seed)
        epipolar = Epipolar.of(readings, rng)
        expect = partial(Expected.of, sigma_px=sigma_px, source=source, stated_px=readings.stated_px)
        expected = expect(epipolar)
        if not lens:  # else after it, for it bends the epipolar lines
            expected.require_scale()
        require_images(readings, max(epipolar.sigma_px, expected.sigma_px))
        if method == "closed_form":
            result = _closed_form(readings, epipolar, expected)
        else:
            problem = LeastSquares.of(readings, readings.reference())
            search = Search(problem, epipolar, ImageFrame.of(readings, image_size), rng, tell, joint_noise)
            solution, expected, result = _most_likely(search, expect, lens, init)
        seconds = time.perf_counter() - begin
        if solution is not None and fitted is not None:
            fitted(solution, expected.noise_px(solution))
        if method == "refined":
            result = with_delay(result, observation)
    return dataclasses.replace(result, source=source, seconds=seconds)


def _require_size(readings: Readings, size: tuple[int, int]) -> None:
    """Refuse an image size, width and height in px, that does not hold 99 of 100 pixels seen."""
    seen = readings.pixels[readings.seen]
    if np.mean(((seen >= -0.5) & (seen <= np.array(size) - 0.5)).all(axis=1)) < 1.0 - _STRAYS:
        low, high = np.percentile(seen, [1, 99], axis=0)
        raise InputError(
            f"image size {size[0]}x{size[1]} px: markers were seen at u from {low[0]:.0f} to {high[0]:.0f}, "
            f"v from {low[1]:.0f} to {high[1]:.0f}; give the size of the images, width before height"
        )


def _most_likely(
    search: Search, expect: Callable[[Epipolar], Expected], lens: bool, init: Nominal | None
) -> tuple[Solution, Expected, Calibration]:
    """Maximum likelihood, the noise it is measured by, and its record; a misfit names the joint if it can."""
    epipolar = search.epipolar
    expected = expect(epipolar)
    try:
        solution, note = solve(search, expected, init)
        if lens:
            search.tell("calibration, lens", 0, 1)
            solution, epipolar = with_lens(solution, search)
            expected = expect(epipolar)
            expected.require_scale()
        solution = with_joint_noise(solution, expected, search.joint_noise)
        result = _refined(solution, epipolar, expected, search.frame)
    except Misfit as refused:
        # The joints of a simulation are as configured: their types and readings are not to blame.
        cause = "" if expected.known else blamed_joint(search, REFUSE_RATIO * expected.sigma_px)
        if not cause:
            raise
        raise Misfit(f"{cause}; as given, {refused}") from None
    cause = ""
    if not expected.known and expected.ratio(solution) > _DOUBTFUL_RATIO:
        cause = blamed_joint(search, _DOUBTFUL_SHARE * solution.sigma_px)
    advice = tuple(filter(None, (cause, *result.advice, note)))
    return solution, expected, dataclasses.replace(result, advice=advice[:_MOST_ADVICE])


def _refined(whole: Solution, epipolar: Epipolar, expected: Expected, frame: ImageFrame) -> Calibration:
    """Record of the maximum likelihood in its projective frame, with its covariance."""
    share = share_explained(whole, frame)
    solution, kept = whole.determined()
    try:
        refusal = expected.refusal(solution) or _unmoved(solution)
        if refusal is not None:
            raise Misfit(refusal)
        found = Outliers.of(solution)
        doubt = unexplained(solution, found, epipolar)
        kept_by = np.sum([solution.used | found.explained, solution.used], axis=(1, 2))
        out, gone = 1.0 - kept_by / whole.problem.readings.seen.sum()
        suspicion = "lens" if share else "joint readings"
        if doubt or out > _MUCH or gone > _MOST:
            why = _contradiction(whole, solution, found, epipolar)
            if not share and solution.sigma_px > _DOUBTED_RATIO * epipolar.noise_px:  # joints are cleared
                suspicion = "outliers"
            if why or (doubt and share >= _DECISIVE_SHARE):
                told = f"{100.0 * gone:.0f} % of the readings do not fit it, and {why}"
                told = other_motion(solution, found, epipolar) or doubt or told
                raise Misfit(f"the fit does not describe the data: {told}")
    except Misfit as refused:
        if share < _DECISIVE_SHARE:
            raise
        hint = f"lens distortion would explain {100.0 * share:.0f} % of their squares: try --lens"
        raise Misfit(f"{refused}; {hint}") from None
    errors = solution.errors()
    record = _record(Projective.of(solution), solution, expected, errors, found, suspicion)
    lens = _lens_advice(record, share, frame.known)
    advice = (*lens, *record.advice) if share else (*record.advice, *lens)
    if kept.all():
        return dataclasses.replace(record, advice=advice)
    readings = whole.problem.readings
    names = ", ".join(map(str, readings.marker[~kept][:_EXAMPLES]))
    more = f" and {few} more" if (few := np.count_nonzero(~kept) - _EXAMPLES) > 0 else ""
    seldom = f"hardly any reading of marker {names}{more} fits: not part of the model; see it more often"
    outlier = np.concatenate([record.outlier, listed(readings, readings.seen & ~kept[readings.marker_of])])
    outlier = outlier[np.lexsort(outlier.T[::-1])]
    lost = why_lost(whole, kept)
    lost[:, 0] = readings.marker[lost[:, 0]]
    return dataclasses.replace(record, outlier=outlier, lost=lost, advice=(*advice, seldom))


def _unmoved(solution: Solution) -> str | None:
    """A joint that moves in what is left out, as of a wrong type or wrong readings, in words, or None."""
    readings = solution.problem.readings
    kept = np.unique(readings.pose_of[solution.used.any(axis=0)])
    square = (readings.q - readings.q.mean(axis=0)) ** 2
    short = square[kept].sum(axis=0) < _KEPT * square.sum(axis=0)
    if not short.any():
        return None
    i = int(np.argmax(short))
    return f"the fit leaves out most motion of joint {i + 1}; check its readings and its type (R or P)"


def _contradiction(whole: Solution, solution: Solution, found: Outliers, epipolar: Epipolar) -> str:
    """What speaks against what is kept where much is not, in words, and what would help; empty if nothing.

    By noise that the images show themselves, whatever was said about it. Where a fit leaves more than that
    of the rig, it must leave no more than bodies that move freely would, as points that slip do, and what is
    left out must agree on no other motion.
    """
    if solution.used.sum() < _KEPT * whole.problem.readings.seen.sum():
        return "that is most of them; leave out what is not on the robot, and check the joint readings"
    if solution.sigma_px > _DOUBTED_RATIO * epipolar.noise_px:
        ratio = solution.sigma_px / max(epipolar.noise_px, noise_at_free_poses(solution))
        if ratio > _DOUBTED_RATIO:
            return (
                f"the rest errs {ratio:.2g} times as much as noise; check the joint readings and types "
                "(R or P)"
            )
        if other := other_motion(solution, found, epipolar):
            return other
    held_out = cross_validate(solution.kept(), solution.sigma_px, _PARTS, 0)
    rms, predicted = held_out.rms_px, held_out.predicted_rms_px
    if held_out.failed or rms is None or predicted is None or rms > _DOUBTED_ERROR * predicted:
        return "the rest does not predict poses that it has not seen; record more poses and more markers"
    return ""


def _lens_advice(calibration: Calibration, share: float, centered: bool) -> tuple[str, ...]:
    """What to do about the lens: where none was sought by the share it explains, else by its uncertainty."""
    if calibration.lens is None:
        if share == 0.0:
            return ()
        return (f"lens distortion would explain {100.0 * share:.0f} % of the squared residuals: try --lens",)
    k = calibration.lens[:, FIRST:].ravel()
    of_lenses = calibration.shared_error[-k.size :]
    statistic = k @ np.linalg.solve(of_lenses @ of_lenses.T, k)
    if statistic < chdtri(k.size, _NO_LENS_TAIL):
        return ("the images show no lens distortion: leave out --lens",)
    if not centered:
        return (
            "the lens distortion is centred on the region where markers were seen: give --image-size, and "
            "it is centred on the image",
        )
    return ()


def _closed_form(readings: Readings, epipolar: Epipolar, expected: Expected) -> Calibration:
    """Record of the closed forms [RH00] eqs. (4), (5): all readings count, and there is no covariance."""
    result, q_reference, known = closed_form_operators(readings, epipolar.F, epipolar.sigma_px)
    problem = LeastSquares.of(readings.of_markers(known), q_reference)
    seen = problem.readings.seen
    dof = 2 * int(np.count_nonzero(seen)) - problem.size
    solution = Solution(problem, result.scene, problem.residual(result.scene), seen, dof)
    found = Outliers.nothing(problem.readings)
    return _record(result, solution, expected, None, found, "lens or joint readings")


def _record(
    result: Projective,
    solution: Solution,
    expected: Expected,
    errors: Errors | None,
    found: Outliers,
    suspicion: str,
) -> Calibration:
    """Record of a fit in its projective frame; WorkFailed if a joint is not determined.

    ``errors`` are those of its parameters, None for a method without; ``found`` explains readings left out,
    and ``suspicion`` is what may be to blame for more than pixel noise.
    """
    method = "closed_form" if errors is None else "refined"
    problem, readings, scene = solution.problem, solution.problem.readings, result.scene
    if errors is None:
        m, unknown = len(scene.M), np.full(scene.P.size + scene.H_hat.size, np.nan)
        off = Errors(unknown[:, None], np.full((m, 4, 1), np.nan), np.full((m, 4, 3), np.nan))
    else:
        off = result.errors(solution, errors).scaled(expected.noise_px(solution))
    outlier = listed(readings, readings.seen & ~solution.used & ~found.explained)
    counts = (len(outlier), len(found.suspect) + len(found.poses), len(found.swapped))
    verdict = judged(solution, errors, expected, counts, suspicion)
    operator_defect, trace_defect, plane_defect = result.defects()
    corner_squares, corner_q = solution.corners()
    used_rows, joint_noise = solution.used.any(axis=0), solution.joint_noise
    # More than noise, as far as the readings tell.
    over = solution.sigma_px**2 - expected.sigma_px**2 if expected.warns(solution) else 0.0
    return Calibration(
        method=method,
        source="",
        joint_types="".join("P" if slides else "R" for slides in readings.prismatic),
        usable=verdict.usable,
        reason=verdict.reason,
        advice=verdict.advice,
        rms_px=solution.rms_px,
        sigma_px=expected.sigma_px,
        corner_squares=corner_squares,
        corner_q=corner_q,
        sigma_scale=expected.scale,
        sigma_scale_interval=expected.scale_interval,
        sigma_fitted_px=solution.sigma_px,
        chi2_per_dof=expected.ratio(solution) ** 2,
        dof=solution.dof,
        seconds=0.0,
        P=scene.P,
        H_hat_0=scene.H_hat,
        q_reference=problem.q_reference,
        a_inf=result.a_inf,
        marker=readings.marker,
        M=scene.M,
        shared_error=off.shared,
        marker_error=off.marker,
        own_error=off.own,
        excitation=verdict.span,
        lowest=readings.q[np.unique(readings.pose_of)].min(axis=0),
        weak=verdict.noise > WEAK_NOISE,
        operator_defect=operator_defect,
        trace_defect=trace_defect,
        plane_defect=plane_defect,
        prediction_noise=verdict.noise,
        merged_poses=int(np.unique(readings.pose_of[used_rows]).size),
        merged_markers=int(np.unique(readings.marker_of[used_rows]).size),
        outlier=outlier,
        suspect=np.stack([readings.pose[found.suspect[:, 0]], found.suspect[:, 1] + 1], axis=1),
        lost_poses=readings.pose[found.poses],
        swapped=np.concatenate(
            [readings.pose[found.swapped[:, :1]], readings.marker[found.swapped[:, 1:]]], axis=1
        ),
        predicted_rms_px=None if verdict.error is None else verdict.error[0],
        predicted_p99_px=None if verdict.error is None else verdict.error[1],
        lens=scene.lens,
        sigma_q=None if joint_noise is None else joint_noise.sigma_q,
        sigma_q_interval=None if joint_noise is None else joint_noise.interval,
        ticks=joint_noise is not None and joint_noise.ticks,
        model_px=float(np.sqrt(over)),
    )
