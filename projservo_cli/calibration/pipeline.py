"""``calibrate``: from an observation to projective kinematics and their assessment."""

import dataclasses
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np
from scipy.special import chdtri
from threadpoolctl import threadpool_limits

from projservo_cli.calibration.bundle_adjustment import LeastSquares
from projservo_cli.calibration.checks.image_contradictions import checked_geometry
from projservo_cli.calibration.checks.joint_order import require_enough_poses
from projservo_cli.calibration.checks.markers_not_on_tool import (
    motionless,
    motionless_finding,
    without_strange,
)
from projservo_cli.calibration.checks.mislabelled_data import relabelled
from projservo_cli.calibration.checks.mismatched_poses import findings_on_imaged_poses
from projservo_cli.calibration.checks.model_errors import ModelCheck
from projservo_cli.calibration.checks.observability_and_verdict import WEAK_NOISE, assess
from projservo_cli.calibration.checks.outliers import (
    Outliers,
    moved_images,
    outlier_rows,
    rejection_reasons,
)
from projservo_cli.calibration.checks.unusable_fit import (
    DOUBTED_RATIO,
    MUCH,
    contradiction,
    main_deviation,
    other_motion,
    refusal,
    straight_joints,
    unexplained,
)
from projservo_cli.calibration.detections import (
    Detections,
    require_images,
    require_motion,
    require_no_copies,
    require_size_and_noise,
)
from projservo_cli.calibration.initial.camera_pair import with_best_pair
from projservo_cli.calibration.initial.camera_resection import with_all_views
from projservo_cli.calibration.initial.camera_weights import with_own_noise
from projservo_cli.calibration.initial.epipolar import ImageFrame, ImageGeometry
from projservo_cli.calibration.initial.initialization import Nominal, Progress, Search
from projservo_cli.calibration.joint_model import (
    AUTO,
    Hypothesis,
    fit_errors_of_place,
    fit_joint_model,
    hypotheses_of,
)
from projservo_cli.calibration.known_intrinsics import KnownCameras, with_known_intrinsics
from projservo_cli.calibration.known_shape import with_known_shapes
from projservo_cli.calibration.lens_estimation import (
    about_principal_points,
    fit_lens,
    share_explained,
    undistorted,
)
from projservo_cli.calibration.prediction import LENS, along_the_arm
from projservo_cli.calibration.projective import Projective
from projservo_cli.calibration.robust_fit import (
    MAX_PREDICTED,
    REFUSE_RATIO,
    Expected,
    Misfit,
    Solution,
    by_usual_noise,
    fewer,
    fit_joint_noise,
    solve,
)
from projservo_cli.calibration.time_offset import with_time_offset
from projservo_cli.findings import LIMITS, REFUSES, Finding, Subject, to_columns
from projservo_cli.geometry.lens import K1
from projservo_cli.image_size import ImageSize, border_distance, image_sizes
from projservo_cli.messages import judged, with_findings
from projservo_cli.records import (
    FROM_ONE,
    TOOL,
    WHY_LOST,
    WORLD,
    CalibratedArm,
    CalibratedBody,
    CalibratedRig,
    Calibration,
    Errors,
    FitQuality,
    FloatArray,
    InputError,
    IntArray,
    JointCurve,
    JointEvidence,
    Observation,
    ParameterErrors,
    Rejections,
    StatedBoard,
    StatedErrors,
    changed,
    letters_of,
)

# Fitted over expected noise above which a fit that passes may still have one joint at fault.
_DOUBTFUL_RATIO = 2.0
# Motion of images by the noise of joints over pixel noise, from which it may hide a wrong input.
_DOUBTFUL_JOINTS = 10.0
# Maximum share of the noise that a relabelling leaves if it is right, and if data as given are refuted.
_DOUBTFUL_SHARE, _REFUTED_SHARE = 0.5, 0.2
# Maximum noise of a fit with another type of a joint, over the noise of the fit as given.
_AS_GOOD = 1.05
# Minimum share of the squared residuals that makes a lens the likely cause of a misfit.
_DECISIVE_SHARE = 0.5
# Probability that noise alone exceeds the estimated coefficients of a lens without distortion.
_NO_LENS_TAIL = 0.01
# Share of rejected detections, explained ones included, above which a fit rejects much.
_MAX_REJECTED = 0.4
# Maximum share of the pixels of a view outside its image, as outliers may be.
_STRAYS = 0.1
# The same to estimate the lens, whose middle is the image's.
_LENS_STRAYS = 0.01
# Distance beyond the border of an image, px, within which a search for corners may place one.
_BEYOND_PX = 1.0
# Noise of a camera over that of the quietest one, above which a finding names it.
_NOISY = 2.0


def calibrate(
    observation: Observation,
    joint_types: str,
    *,
    sigma_px: float | None = None,
    source: str = "simulated",
    image_size: ImageSize | None = None,
    seed: int = 0,
    lens: bool = False,
    init: Nominal | None = None,
    joint_noise: float | None = 0.0,
    max_predicted_px: float | None = None,
    mount: str = WORLD,
    joint_model: str | Sequence[str] | None = None,
    boards: Sequence[StatedBoard] = (),
    cameras: KnownCameras | None = None,
    fitted: Callable[[Solution, float], None] | None = None,
    progress: Progress = lambda what, done, total: None,
) -> Calibration:
    """Return the projective kinematics, [RH00] section 2, from pixels and joint readings alone.

    Parameters
    ----------
    observation : stereo images of the markers at a sequence of poses, raw px, NaN where unseen.
    joint_types : one letter a joint, R or P.
    sigma_px : noise per coordinate, px; None takes the median of the observation's ``sigma``,
        for a recording times the common factor that both views show, else estimates it from the epipolar
        geometry. The sigma of a detection sets its weight.
    source : ``simulated`` (χ² decides against ``sigma_px``) or ``recorded``.
    image_size : width and height, px, for the start of the search; None takes the extent of the data.
    seed : seed of the random starts.
    lens : whether to estimate two coefficients of radial distortion a camera, about the image centre or,
        if the images show another one, about that.
    init : robot and rig that ``bundle_adjustment`` tries first as a start; a search follows if that fails.
    joint_noise : standard deviation of joint readings, rad (prismatic × 0.3 m/rad), for
        ``bundle_adjustment``; None estimates it, and takes 0 unless the images show it.
    max_predicted_px : error of predictions by deviations from the model, px, above which the calibration is
        not usable; None takes 1 % of the image size.
    mount : ``world`` for cameras that watch the tool, ``tool`` for cameras on it that watch the scene.
    joint_model : curves of the joints that ``bundle_adjustment`` fits: ``auto`` for those that the images
        show, or some of ``CURVES``, of all joints or of one, as ``scale:2``; None where joints are as they
        read.
    boards : boards whose corners are markers; their shape is used unless the images contradict it.
    cameras : known cameras; their lenses are taken, and their intrinsics are priors unless the images
        contradict them.
    fitted : called with the solution of ``bundle_adjustment`` and its noise, px.
    progress : called with the current task of ``bundle_adjustment``, how much of it is done, and its total.

    Returns
    -------
    The calibration, with ``usable``, ``reason`` and ``advice``.

    Raises
    ------
    InputError
        If an argument is out of its range.
    WorkFailed
        If the data do not support a calibration: which joint or marker, and why.
    """
    if source not in ("simulated", "recorded"):
        raise InputError(f"calibration source {source!r}: choose simulated or recorded")
    require_size_and_noise(image_size, sigma_px)
    if seed < 0:
        raise InputError(f"seed {seed!r}: give a whole number that is not negative")
    if max_predicted_px is not None and not max_predicted_px > 0.0:
        raise InputError(f"max_predicted_px {max_predicted_px!r}: give a positive number, or none")
    if joint_noise is not None and not 0.0 <= joint_noise < np.inf:
        raise InputError(f"joint noise {joint_noise!r}: give a number that is not negative, or none")
    if mount not in (WORLD, TOOL):
        raise InputError(f"mount {mount!r}: choose {WORLD} or {TOOL}")
    if mount == TOOL and init is not None:
        raise InputError("cameras on the tool are calibrated from images alone: leave out init")
    curves = None if joint_model == AUTO else hypotheses_of(joint_model or (), joint_types, mount)
    begin = time.perf_counter()
    # The matrices are small: a second thread costs more than it gives.
    with threadpool_limits(limits=1):
        whole = Detections.of(observation, joint_types, mount)
        still = motionless(whole)
        of_still, numbers = [motionless_finding(whole, still)] if still.any() else [], whole.marker[still]
        whole = whole.of_markers(~still)
        require_motion(whole)
        require_no_copies(whole)
        require_enough_poses(whole)
        if image_size is not None:
            _require_inside(whole, image_size, _LENS_STRAYS if lens else _STRAYS)
        whole = undistorted(whole, None if cameras is None else cameras.lens)
        require_images(whole, sigma_px)
        whole = with_best_pair(whole)
        detections = whole.of_pair()
        rng = np.random.default_rng(seed)
        frame = ImageFrame.of(whole, image_size)
        of_pair = frame.of_views([*whole.pair])
        epipolar = checked_geometry(detections, of_pair, rng)
        expect = partial(Expected.of, sigma_px=sigma_px, source=source, stated_px=detections.stated_px)
        expected = expect(epipolar)
        if not lens:  # else after its estimation, since it bends the epipolar lines
            expected.require_scale(detections.view)
        require_images(whole, max(epipolar.sigma_px, expected.sigma_px))
        problem = LeastSquares.of(detections, detections.reference())
        search = Search(problem, epipolar, of_pair, rng, progress, joint_noise)
        limit = MAX_PREDICTED * float(frame.size.max()) if max_predicted_px is None else max_predicted_px
        asked = lens, init, curves, boards, cameras
        solution, expected, result = _maximum_likelihood(search, whole, frame, expect, asked, limit)
        if of_still:
            still_too = np.column_stack([numbers, np.full(len(numbers), WHY_LOST.index("still"))])
            known = still_too[:0] if result.rejected_markers is None else result.rejected_markers
            lost = np.concatenate([known, still_too])
            result = changed(with_findings(result, of_still), rejected_markers=lost)
        seconds = time.perf_counter() - begin
        if fitted is not None:
            fitted(solution, expected.noise_px(solution))
        if cameras is not None:
            result = changed(result, lens=cameras.lens)
        if mount == TOOL:
            result = along_the_arm(result)
        result = with_time_offset(result, observation)
    return dataclasses.replace(result, source=source, seconds=seconds)


def _require_inside(detections: Detections, image_size: ImageSize, strays: float) -> None:
    """Refuse an image size, width and height in px, with more than a share of a view's pixels outside."""
    pixels, sizes = detections.pixels, image_sizes(image_size, detections.view)
    outside = detections.seen & (border_distance(pixels, sizes[:, None]) < -_BEYOND_PX)
    for view, name in enumerate(detections.view):
        seen = detections.seen[view]
        share = float(outside[view].sum() / max(seen.sum(), 1.0))
        if share > strays:
            i = int(np.argmax(outside[view]))
            u, v = pixels[view, i]
            low, high = np.percentile(pixels[view, seen], [1, 99], axis=0)
            marker, pose = detections.marker[detections.marker_of[i]], detections.pose[detections.pose_of[i]]
            raise InputError(
                f"image size {sizes[view, 0]:.0f}x{sizes[view, 1]:.0f} px: "
                f"{100.0 * share:.3g} % of the pixels of the {name} view "
                f"are outside, more than {100.0 * strays:g} %, such as u {u:.1f}, v {v:.1f} of marker "
                f"{marker} at pose {pose}; that view saw markers at u from {low[0]:.0f} to {high[0]:.0f}, "
                f"v from {low[1]:.0f} to {high[1]:.0f}: give the size of the images, width before height"
            )


def _maximum_likelihood(
    start: Search,
    whole: Detections,
    frame: ImageFrame,
    expect: Callable[[ImageGeometry], Expected],
    asked: tuple[bool, Nominal | None, list[Hypothesis] | None, Sequence[StatedBoard], KnownCameras | None],
    limit_px: float,
) -> tuple[Solution, Expected, Calibration]:
    """Maximum-likelihood solution, its expected noise and its record.

    start : search by the pair of views; whole, frame : detections and images of all views; asked : whether to
        estimate lenses, a start, curves of the joints, None for those that the data show, boards, and known
        cameras.
    Raises Misfit, naming the joint at fault if one explains it.
    """
    search, epipolar, (lens, init, curves, boards, cameras), curved = start, start.epipolar, asked, None
    expected, of_stated = expect(epipolar), list[Finding]()
    try:
        solution, note = solve(start if len(whole.view) <= 2 or init else fewer(start), expected, init)
        if len(whole.view) > 2:
            solution = with_own_noise(with_all_views(solution, whole, epipolar), epipolar)[0]
            search = dataclasses.replace(start, problem=solution.problem, frame=frame)
        if lens:
            search.progress("calibration, lens", 0, 1)
            if solution.params.known_arm and search.joint_noise is None:
                solution = by_usual_noise(solution, expected)
            solution, epipolar = fit_lens(solution, search)
        if len(whole.view) > 2:  # once more with the lenses
            solution, epipolar = with_own_noise(solution, epipolar)
        expected = expect(epipolar)
        if lens:
            expected.require_scale(whole.view)
        if curves is None or curves:
            search.progress("calibration, joint model", 0, 1)
            curved = fit_joint_model(solution, curves, epipolar)
            solution = solution if curved is None else curved.solution
        solution = fit_joint_noise(solution, expected, search.joint_noise)
        if lens and solution.params.known_arm:
            solution = about_principal_points(solution, expected, frame, search.joint_noise)
        if curves == [] and (curved := fit_errors_of_place(solution, expected)) is not None:
            solution, of_stated = curved.solution, [*curved.findings]
        if boards:
            search.progress("calibration, boards", 0, 1)
            solution, boards, of_boards = with_known_shapes(solution, boards, expected)
            of_stated += of_boards
        if cameras is not None:
            solution, of_cameras = with_known_intrinsics(solution, cameras, expected)
            of_stated += of_cameras
        result = _refined(solution, epipolar, expected, frame, limit_px)
        if boards:
            result = changed(
                result, boards=np.array([[np.nan if v is None else v for v in one] for one in boards])
            )
    except Misfit as refused:
        # The joints of a simulation are as configured, so none is at fault.
        last = (
            one for one in refused.findings if one.code == "rejected_poses" and one.subject.name == "last"
        )
        onset = next((len(whole.q) - int(one.amount) for one in last), None)
        found = None if expected.known else relabelled(start, REFUSE_RATIO * expected.sigma_px, onset=onset)
        if found is None:
            raise
        raise Misfit.by([found.finding, *refused.findings], whole) from None
    if not expected.known and (straight := straight_joints(solution)):
        seen = undistorted(search.problem.detections, solution.params.lens).of_pair()
        there = LeastSquares.of(seen, start.problem.q_reference)
        start = dataclasses.replace(start, problem=there, epipolar=epipolar)
        if found := relabelled(start, _AS_GOOD * solution.sigma_px, straight):
            no_turn = Finding("no_turn", REFUSES, found.finding.subject, solution.sigma_px, unit="px")
            raise Misfit.by([found.finding, no_turn], whole)
    ahead = []
    left_px = float(np.hypot(solution.sigma_px, solution.joint_effect()[1]))
    doubtful = expected.ratio(solution) > _DOUBTFUL_RATIO or left_px > _DOUBTFUL_JOINTS * expected.sigma_px
    if not expected.known and doubtful:
        doubted = relabelled(start, _DOUBTFUL_SHARE * left_px)
        if doubted is not None:
            severity = REFUSES if doubted.noise_px < _REFUTED_SHARE * left_px else LIMITS
            ahead.append(dataclasses.replace(doubted.finding, severity=severity))
    if epipolar.sigma_px < expected.min_px:
        ahead.append(Finding("exact_images", LIMITS, amount=epipolar.sigma_px, unit="px"))
    result = with_findings(result, filter(None, [_worst_view(result), note, *of_stated]), ahead)
    if curved is not None and result.joint_curve is not None:
        result = changed(result, joint_curve=np.hstack([result.joint_curve[:, :5], curved.gains]))
    return solution, expected, result


def _refined(
    whole: Solution, epipolar: ImageGeometry, expected: Expected, frame: ImageFrame, limit_px: float
) -> Calibration:
    """Record of the maximum-likelihood solution in its projective frame, with its covariance."""
    share = share_explained(whole, frame)
    detections = whole.problem.detections
    some, strange = without_strange(whole, epipolar.noise_px)
    solution, fitting = some.determined()
    seldom = tuple(some.problem.detections.marker[~fitting].tolist())
    kept = np.isin(detections.marker, solution.problem.detections.marker)
    of_lens = Finding("unmodelled_lens", LIMITS, amount=share, unit="1")
    try:
        if (why := refusal(solution, expected)) is not None:
            raise Misfit.by([why], detections)
        found = Outliers.of(solution)
        doubt = unexplained(solution, found, epipolar)
        kept_by = np.sum([solution.used | found.explained, solution.used], axis=(1, 2))
        out, gone = 1.0 - kept_by / detections.seen.sum()
        much = doubt is not None or out > MUCH or gone > _MAX_REJECTED
        suspicion = Finding("lagging_joints", LIMITS)
        if share:
            suspicion = of_lens
        elif much and solution.sigma_px > DOUBTED_RATIO * epipolar.noise_px:  # not the joints
            suspicion = Finding("outliers", LIMITS)
        require_enough_poses(solution.kept().problem.detections)
        errors = solution.errors()
        record = _record(
            Projective.of(solution), solution, expected, errors, found, suspicion, limit_px=limit_px
        )
        if much:
            why = contradiction(whole, solution, found, epipolar, record.predicted_rms_px or 0.0)
            if why or (doubt and share >= _DECISIVE_SHARE):
                raise Misfit.by(
                    filter(None, [other_motion(solution, found, epipolar) or doubt or why]), detections
                )
    except Misfit as refused:
        hint = main_deviation(solution, expected) if share < _DECISIVE_SHARE else of_lens
        by_joints = refused.findings[0].code in ("several_joints", "erring_joint")  # no other part moved
        if hint is None or (by_joints and not hint.subject.joints):
            raise
        raise Misfit.by([*refused.findings, hint], detections) from None
    more = [*_of_lens(record, frame.known), *strange]
    if kept.all():
        return with_findings(record, more)
    if seldom:
        more.append(Finding("seldom_fitting", LIMITS, Subject(markers=seldom)))
    outlier = np.concatenate(
        [record.outlier, outlier_rows(detections, detections.seen & ~kept[detections.marker_of])]
    )
    outlier = outlier[np.lexsort(outlier.T[::-1])]
    lost = rejection_reasons(whole, kept)
    lost[:, 0] = detections.marker[lost[:, 0]]
    return with_findings(changed(record, outlier=outlier, rejected_markers=lost), more)


def _of_lens(calibration: Calibration, centered: bool) -> Iterator[Finding]:
    """Findings on an estimated lens: that there is none, or that its centre is not known."""
    if calibration.lens is None:
        return
    k, terms = calibration.lens[:, K1:].ravel(), calibration.lens_terms
    first = calibration.P.size + calibration.H_hat_0.size
    of_lenses = calibration.sqrt_cov_shared[first : first + len(calibration.lens) * terms]
    of_lenses = of_lenses.reshape(-1, terms, of_lenses.shape[-1])[:, :LENS].reshape(k.size, -1)
    statistic = k @ np.linalg.solve(of_lenses @ of_lenses.T, k)
    if statistic < chdtri(k.size, _NO_LENS_TAIL):
        yield Finding("no_lens")
    elif terms == LENS and not centered:
        yield Finding("lens_off_center", LIMITS)


def _record(
    result: Projective,
    solution: Solution,
    expected: Expected,
    errors: Errors,
    found: Outliers,
    suspicion: Finding,
    *,
    limit_px: float = np.inf,
) -> Calibration:
    """Record of a fit in its projective frame.

    errors : of its parameters.
    found : explanations of rejected detections.
    suspicion : likely cause if residuals exceed pixel noise.
    limit_px : effect of deviations from the model above which the calibration is not usable.
    Raises WorkFailed if a joint is not determined.
    """
    problem, detections, params = solution.problem, solution.problem.detections, result.params
    outlier = outlier_rows(detections, detections.seen & ~solution.used & ~found.explained)
    counts = len(found.suspect) + len(found.poses), len(found.id_switches)
    verdict = assess(solution, errors, expected, outlier, counts, suspicion, limit_px)
    check, (about, *rest) = verdict.check, verdict.findings
    of_images = (
        *moved_images(detections, found.moved),
        *findings_on_imaged_poses(detections, found.mismatched),
    )
    findings = (about, *rest, *of_images)
    # Deviations hold on average over other poses, with the model's own error.
    factor = 1.0
    if check is not None and check.noise_px > 0.0:
        factor = check.noise_factor * check.predicted_px / check.noise_px
    off = result.errors(solution, errors).scaled(factor * expected.noise_px(solution))
    about_all = judged(findings, detections.setup)
    return Calibration(
        method="bundle_adjustment",
        source="",
        view=detections.view,
        seconds=0.0,
        rig=CalibratedRig(mount=detections.mount, P=params.P, lens=params.lens),
        arm=CalibratedArm(
            joint_types=letters_of(detections.prismatic),
            H_hat_0=params.H_hat,
            q_reference=problem.q_reference,
            a_inf=result.a_inf,
            flange_chart=None if detections.chart is None else detections.chart.record,
            **_curve_fields(params.curve, off),
        ),
        body=CalibratedBody(marker=detections.marker, M=params.M),
        parameter_errors=ParameterErrors(
            sqrt_cov_shared=off.shared, sqrt_cov_marker=off.marker, sqrt_cov_own=off.own
        ),
        verdict=about_all,
        fit=_quality(solution, expected),
        joints=_joint_evidence(result, detections, verdict.span, verdict.noise),
        rejections=_rejections(detections, found, outlier),
        stated=StatedErrors(
            predicted_rms_px=verdict.error[0],
            predicted_p99_px=verdict.error[1],
            **to_columns(about_all.findings),
            **({} if check is None else _model_fields(result, solution, check)),
        ),
    )


def _quality(solution: Solution, expected: Expected) -> FitQuality:
    """Residuals of a fit, and the noise that they show."""
    corner_squares, corner_q = solution.corners()
    used_rows, joint_noise = solution.used.any(axis=0), solution.joint_noise
    detections = solution.problem.detections
    # Residuals beyond noise are an error of the model.
    over = solution.sigma_px**2 - expected.sigma_px**2 if expected.warns(solution) else 0.0
    return FitQuality(
        rms_px=solution.rms_px,
        sigma_px=expected.sigma_px,
        corner_squares=corner_squares,
        corner_q=corner_q,
        sigma_scale=expected.scale,
        sigma_scale_interval=expected.scale_interval,
        sigma_fitted_px=solution.sigma_px,
        sigma_view_px=_noise_of_views(solution),
        chi2_per_dof=expected.ratio(solution) ** 2,
        dof=solution.dof,
        poses_used=int(np.unique(detections.pose_of[used_rows]).size),
        markers_used=int(np.unique(detections.marker_of[used_rows]).size),
        sigma_q=None if joint_noise is None else joint_noise.sigma_q,
        sigma_q_interval=None if joint_noise is None else joint_noise.interval,
        sigma_flange_m=None if joint_noise is None or detections.chart is None else joint_noise.sigma_m,
        encoder_counts=joint_noise is not None and joint_noise.ticks,
        model_px=float(np.sqrt(over)),
    )


def _joint_evidence(
    result: Projective, detections: Detections, span: FloatArray, noise: FloatArray
) -> JointEvidence:
    """Determination of joints by the data of a fit: their span and the noise of predictions, (n,)."""
    operator_defect, trace_defect, plane_defect = result.defects()
    return JointEvidence(
        excitation=span,
        joint_min=detections.q[np.unique(detections.pose_of)].min(axis=0),
        poorly_observable=noise > WEAK_NOISE,
        operator_defect=operator_defect,
        trace_defect=trace_defect,
        plane_defect=plane_defect,
        prediction_noise=noise,
    )


def _rejections(detections: Detections, found: Outliers, outlier: IntArray) -> Rejections:
    """Detections that a fit left out, with their explanations."""
    return Rejections(
        outlier=outlier,
        suspect=np.stack(
            [detections.pose[found.suspect[:, 0]], detections.numbers[found.suspect[:, 1]]], axis=1
        ),
        rejected_poses=detections.pose[found.poses],
        moved_images=np.stack([detections.pose[found.moved[:, 0]], found.moved[:, 1]], axis=1),
        id_switches=np.concatenate(
            [detections.pose[found.id_switches[:, :1]], detections.marker[found.id_switches[:, 1:]]], axis=1
        ),
    )


def _worst_view(calibration: Calibration) -> Finding | None:
    """Find a camera that is much noisier than another."""
    noise = calibration.sigma_view_px
    if noise is None or noise.max() <= _NOISY * noise.min():
        return None
    views = tuple(calibration.view[int(v)] for v in (np.argmax(noise), np.argmin(noise)))
    return Finding(
        "noisy_view", LIMITS, Subject(views=views), float(noise.max()), limit=float(noise.min()), unit="px"
    )


def _noise_of_views(solution: Solution) -> FloatArray | None:
    """Noise of each view per coordinate, px, from the residuals; None for two views, which share one."""
    if len(solution.used) <= 2:
        return None
    squares = (solution.residual / solution.problem.detections.weight[..., None]) ** 2
    count = np.maximum(solution.used.sum(axis=1), 1)
    free = solution.dof / (2.0 * count.sum())
    return np.asarray(np.sqrt((squares.sum(axis=2) * solution.used).sum(axis=1) / (2.0 * count * free)))


def _curve_fields(curve: JointCurve | None, off: Errors) -> dict[str, Any]:
    """Fields of the record on the curve of the joints, without its gains."""
    if curve is None:
        return {}
    deviation = np.linalg.norm(off.shared[-len(curve.terms) :], axis=1)
    rows = [curve.terms + FROM_ONE, deviation[:, None], np.full((len(deviation), 2), np.nan)]
    return {"joint_curve": np.hstack(rows), "joint_curve_arm": curve.arm if len(curve.arm) else None}


def _model_fields(result: Projective, solution: Solution, check: ModelCheck) -> dict[str, Any]:
    """Fields of the record on deviations from the model."""
    fields: dict[str, Any] = {"predicted_recorded_px": check.recorded_px}
    if check.unshown is not None:
        fields["predicted_worst_px"] = float(np.hypot(check.predicted_px, check.unshown.effect_px))
    if check.errors:
        fields["model_error_bias"] = result.bias(solution, check.bias)
    return fields
