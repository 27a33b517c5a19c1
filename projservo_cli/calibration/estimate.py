"""``calibrate``: from an observation to projective kinematics, with its verdict."""

import dataclasses
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from projservo_cli.calibration import adjustment, closed_form, culprits, distortion, linear, quality
from projservo_cli.calibration import quality as excitation
from projservo_cli.calibration import suggestions as reach
from projservo_cli.calibration.adjustment import Scene
from projservo_cli.calibration.culprits import Culprits, blamed_joint
from projservo_cli.calibration.epipolar import Epipolar
from projservo_cli.calibration.epipolar import estimate as epipolar_geometry
from projservo_cli.calibration.fit import Solution, Tell, determined, solve, tell_nobody
from projservo_cli.calibration.frame import (
    ProjectiveScene,
    isotropic,
    marker_factor,
    output_derivative,
    output_gauge,
    spread_factor,
)
from projservo_cli.calibration.nominal import Nominal, solve_from
from projservo_cli.calibration.optimization import Problem, prepare
from projservo_cli.calibration.prediction import predicted_error
from projservo_cli.calibration.quality import REFUSE_RATIO, Agreement, Expected, Misfit, require_images
from projservo_cli.calibration.readings import Readings, gather, reference_joints, restrict
from projservo_cli.calibration.reconstruction import Frame, image_frame
from projservo_cli.calibration.weakest import worst_determined
from projservo_cli.records import (
    NO_LENS,
    PRISMATIC,
    REVOLUTE,
    BoolArray,
    Calibration,
    FloatArray,
    InputError,
    IntArray,
    Model,
    Observation,
)

LEFT, RIGHT, BOTH = 0, 1, 2
VIEWS = ("left", "right", "both")


def assemble(
    method: str,
    scene: ProjectiveScene,
    readings: Readings,
    q_reference: FloatArray,
    agreement: Agreement,
    expected: Expected,
    factor: FloatArray | None,
    found: Culprits | None = None,
    suspicion: str = "lens or joint readings",
) -> Calibration:
    """Record of a fit in its projective frame.

    Parameters
    ----------
    method : name of the method.
    scene : cameras, operators, markers and plane at infinity.
    readings : what was explained.
    q_reference : (n,) joint readings at the reference, rad or m.
    agreement, expected : what the fit leaves of the images, and what it should.
    factor : (24 + 16 n + 4 m, r) factor of the covariance of P, H_hat_0, M at a noise of one pixel,
        with four rows more for k1 and k2 where lenses were sought; None for a method that has none.
    found : what explains readings left out.
    suspicion : what may be to blame for more than pixel noise.

    Raises
    ------
    WorkFailed
        If a joint is not determined.
    """
    types = np.where(readings.prismatic, PRISMATIC, REVOLUTE).astype(np.int64)
    lens = NO_LENS if scene.lens is None else scene.lens
    model = Model(scene.P, scene.H_hat_0, types, q_reference, scene.a_inf, lens)
    span = excitation.require_motion(readings)
    size = 24 + 16 * len(types) + 4 * len(scene.M) + (0 if scene.lens is None else 4)
    # NaN, not zero: a method without covariance does not claim certainty.
    noise = needed = np.full(len(types), np.nan)
    covariance = np.full((size, size), np.nan)
    # Residuals of a method without covariance are its own doing, not noise of the images.
    sigma = expected.sigma_px if factor is None else expected.noise_px(agreement)
    excitation.require_moved(image_motion(model, scene.M, span), sigma, span, readings.prismatic)
    if factor is not None:
        around = reach.surroundings(readings)
        noise = reach.reach_noise(model, scene.M, factor, around)
        needed = reach.needed_spans(model, scene.M, factor, around, noise)
        excitation.require_determined(noise, span, needed, readings.prismatic)
        covariance = sigma**2 * (factor @ factor.T)
    if found is None:
        found = Culprits(
            np.zeros((0, 2), dtype=np.int64), np.zeros((0, 3), dtype=np.int64), np.zeros_like(readings.seen)
        )
    outlier = outlier_list(readings, agreement.used | found.explained)
    counts = (len(outlier), len(found.suspect), len(found.swapped))
    reason, advice = quality.verdict(
        agreement, expected, noise, span, needed, readings.prismatic, counts, suspicion
    )
    shortfall = quality.shortfall(method, agreement, expected)
    used_rows = agreement.used.any(axis=0)
    return Calibration(
        method=method,
        source="",
        joint_types="".join("P" if slides else "R" for slides in readings.prismatic),
        usable=shortfall is None,
        reason=shortfall or reason,
        advice=advice if shortfall is None else (),
        rms_px=agreement.rms_px,
        sigma_px=expected.sigma_px,
        sigma_fitted_px=agreement.sigma_px,
        chi2_per_dof=expected.ratio(agreement) ** 2,
        dof=agreement.dof,
        seconds=0.0,
        P=scene.P,
        H_hat_0=scene.H_hat_0,
        q_reference=q_reference,
        a_inf=scene.a_inf,
        marker=readings.marker,
        M=scene.M,
        covariance=covariance,
        excitation=span,
        weak=noise > excitation.WEAK_NOISE,
        **defects(scene, readings.prismatic),
        prediction_noise=noise,
        merged_poses=int(np.unique(readings.pose_of[used_rows]).size),
        merged_markers=int(np.unique(readings.marker_of[used_rows]).size),
        outlier=outlier,
        suspect=np.stack([readings.pose[found.suspect[:, 0]], found.suspect[:, 1] + 1], axis=1),
        swapped=np.concatenate(
            [readings.pose[found.swapped[:, :1]], readings.marker[found.swapped[:, 1:]]], axis=1
        ),
        lens=scene.lens,
    )


def image_motion(model: Model, M: FloatArray, span: FloatArray) -> FloatArray:
    """Mean length (n,) of the images' path over each joint's range, from their velocity at the reference, px.

    Parameters
    ----------
    model : projective robot and rig.
    M : (m, 4) markers at the reference.
    span : (n,) range of each joint, rad or m.
    """
    # The path of [RH00] eq. (7), second row corrected: velocities of all markers for all joints.
    velocity = np.einsum("vrc,ncd,md->nvmr", model.P, model.H_hat_0, M)
    m = np.einsum("vrc,mc->vmr", model.P, M)
    pixels = m[..., :2] / m[..., 2:]
    rate = (velocity[..., :2] - pixels * velocity[..., 2:]) / m[..., 2:]
    result: FloatArray = np.linalg.norm(rate, axis=3).mean(axis=(1, 2)) * span
    return result


def defects(scene: ProjectiveScene, prismatic: BoolArray) -> dict[str, Any]:
    """How far the operators are from [RH00] section 2: Ĥ³ = −Ĥ or Ĥ² = 0, no trace, one plane at infinity.

    Parameters
    ----------
    scene : operators and plane at infinity.
    prismatic : (n,) types of the joints.

    Returns
    -------
    Fields ``operator_defect``, ``trace_defect``, ``plane_defect`` of the record, (n,) each.
    """
    H_hat = scene.H_hat_0
    square = H_hat @ H_hat
    law = np.where(prismatic[:, None, None], square, square @ H_hat + H_hat)
    return {
        "operator_defect": np.linalg.norm(law, axis=(1, 2)) / np.linalg.norm(H_hat, axis=(1, 2)),
        "trace_defect": np.abs(np.trace(H_hat, axis1=1, axis2=2)),
        "plane_defect": np.linalg.norm(scene.a_inf @ H_hat, axis=1) / np.linalg.norm(scene.a_inf),
    }


def outlier_list(readings: Readings, used: BoolArray) -> IntArray:
    """Readings that were seen but left out: rows of pose number, marker number, view, (L, 3).

    Parameters
    ----------
    readings : what was seen.
    used : (2, N) what counts.
    """
    out = readings.seen & ~used
    rows = np.flatnonzero(out.any(axis=0))
    view = np.where(out[:, rows].all(axis=0), BOTH, np.where(out[0, rows], LEFT, RIGHT))
    listed = np.stack(
        [readings.pose[readings.pose_of[rows]], readings.marker[readings.marker_of[rows]], view], axis=1
    )
    result: IntArray = listed[np.lexsort(listed.T[::-1])].astype(np.int64)
    return result


def with_lost_markers(record: Calibration, readings: Readings, kept: BoolArray) -> Calibration:
    """Record that also lists the readings of markers that could not be kept, and says so.

    Parameters
    ----------
    record : without these markers.
    readings : of all markers.
    kept : (m,) markers that are part of the model.
    """
    lost = outlier_list(
        restrict(readings, ~kept), np.zeros((2, int((~kept)[readings.marker_of].sum())), bool)
    )
    outlier = np.concatenate([record.outlier, lost])
    names = ", ".join(str(number) for number in readings.marker[~kept])
    advice = f"hardly any reading of marker {names} fits: it is not part of the model; see it more often"
    return dataclasses.replace(
        record, outlier=outlier[np.lexsort(outlier.T[::-1])], advice=(*record.advice, advice)
    )


def findings(calibration: Calibration) -> dict[str, Any]:
    """Single observations that do not fit, and how many do, as plain lists for people and JSON.

    Parameters
    ----------
    calibration : the record.

    Returns
    -------
    ``outliers``, ``suspect_joint_readings``, ``swapped``, ``merged_poses``, ``merged_markers``.
    """
    outliers, suspects, swaps = (
        rows.tolist() for rows in (calibration.outlier, calibration.suspect, calibration.swapped)
    )
    return {
        "outliers": [{"pose": p, "marker": m, "view": VIEWS[v]} for p, m, v in outliers],
        "suspect_joint_readings": [{"pose": p, "joint": j} for p, j in suspects],
        "swapped": [{"pose": p, "markers": [a, b]} for p, a, b in swaps],
        "merged_poses": calibration.merged_poses,
        "merged_markers": calibration.merged_markers,
    }


METHODS = ("refined", "linear", "closed_form")
# Fitted noise over the expected one from which on, though the fit passes, one joint may be to blame: it is
# where its change leaves no more than this share.
DOUBTFUL_RATIO, DOUBTFUL_SHARE = 2.0, 0.5
A_INF = np.array([0.0, 0.0, 0.0, 1.0])
Fitted = Callable[[Solution, float], None]


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
    fitted: Fitted | None = None,
    tell: Tell = tell_nobody,
) -> Calibration:
    """Projective kinematics [RH00] section 2 from pixels and joint readings alone.

    Parameters
    ----------
    observation : stereo images of the markers at a sequence of poses, raw px, NaN where unseen.
    joint_types : one letter a joint, R or P.
    method : ``refined`` (maximum likelihood), ``linear`` (multi-frame) or ``closed_form`` (eqs. 4, 5).
    sigma_px : noise per coordinate, px; None estimates it from the epipolar geometry.
    source : ``simulated`` (χ² decides against ``sigma_px``) or ``recorded``.
    image_size : width and height, px, for the start of the search; None takes the extent of the data.
    seed : of the random starts.
    lens : whether to estimate two coefficients of radial distortion a camera, about the image centre.
    init : robot and rig to try first as a start of ``refined``; the search follows where that misses.
    fitted : told the solution of ``refined`` and its noise, px, for what needs more than the record.
    tell : told how far ``refined`` is: what it does, how much of it is done, and of how much.

    Raises
    ------
    InputError
        If the arguments make no sense.
    WorkFailed
        If the data do not support a calibration: which joint or marker, and why.
    """
    if method not in METHODS:
        raise InputError(f"calibration method {method!r}: choose one of {', '.join(METHODS)}")
    if source not in ("simulated", "recorded"):
        raise InputError(f"calibration source {source!r}: choose simulated or recorded")
    if sigma_px is not None and not 0.0 < sigma_px < np.inf:
        raise InputError(f"pixel noise {sigma_px!r}: give a positive number, or none to estimate it")
    if image_size is not None and not all(0.0 < length < np.inf for length in image_size):
        raise InputError(f"image size {image_size!r}: give a positive width and height, px")
    if seed < 0:
        raise InputError(f"seed {seed!r}: give a whole number that is not negative")
    if lens and method != "refined":
        raise InputError(
            f"calibration method {method!r} estimates no lens: choose refined, or calibrate without"
        )
    begin = time.perf_counter()
    # The matrices are small: a second thread costs more than it gives.
    with threadpool_limits(limits=1):
        readings = gather(observation, joint_types)
        excitation.require_motion(readings)
        if lens and image_size is not None:
            distortion.require_size(readings, image_size)
        require_images(readings, sigma_px)
        rng = np.random.default_rng(seed)
        both = readings.both
        epipolar = epipolar_geometry(readings.pixels[0][both], readings.pixels[1][both], rng)
        expect = partial(quality.expected_noise, sigma_px=sigma_px, source=source)
        expected = expect(epipolar)
        require_images(readings, max(epipolar.sigma_px, expected.sigma_px))
        if method == "refined":
            frame = image_frame(readings, image_size)
            solution, expected, result = _most_likely(
                readings, epipolar, frame, expect, rng, lens=lens, init=init, tell=tell
            )
        elif method == "linear":
            result = _linear(readings, epipolar, expected)
        else:
            result = _closed_form(readings, epipolar, expected)
        seconds = time.perf_counter() - begin
        if method == "refined" and fitted is not None:
            fitted(solution, expected.noise_px(solution.agreement))
    return dataclasses.replace(result, source=source, seconds=seconds)


def _most_likely(
    readings: Readings,
    epipolar: Epipolar,
    frame: Frame,
    expect: Callable[[Epipolar], Expected],
    rng: np.random.Generator,
    *,
    lens: bool,
    init: Nominal | None,
    tell: Tell,
) -> tuple[Solution, Expected, Calibration]:
    """Maximum likelihood, the noise it is measured by, and its record; a misfit names the joint if it can."""
    q_reference = reference_joints(readings.q)
    expected = expect(epipolar)
    search = partial(solve, readings, q_reference, epipolar, frame, rng, expected, tell)

    def blame(most_px: float) -> str:
        return blamed_joint(readings, q_reference, epipolar, frame, most_px, rng, tell)

    try:
        solution, note = (
            (search(), "")
            if init is None
            else solve_from(init, readings, q_reference, epipolar, expected, search)
        )
        straight = epipolar
        if lens:
            tell("calibration, lens", 0, 1)
            solution = distortion.with_lens(solution, frame, epipolar)
            straight = distortion.straight_epipolar(solution, rng)
            expected = expect(straight)
        result = _refined(solution, straight, expected, frame)
    except Misfit as refused:
        # The joints of a simulation are as configured: their types and readings are not to blame.
        cause = "" if expected.known else blame(REFUSE_RATIO * expected.sigma_px)
        if not cause:
            raise
        raise Misfit(f"{cause}; as given, {refused}") from None
    cause = ""
    if not expected.known and expected.ratio(solution.agreement) > DOUBTFUL_RATIO:
        cause = blame(DOUBTFUL_SHARE * solution.agreement.sigma_px)
    advice = (*filter(None, (cause,)), *result.advice, *filter(None, (note,)))
    return solution, expected, dataclasses.replace(result, advice=advice)


def _refined(whole: Solution, epipolar: Epipolar, expected: Expected, frame: Frame) -> Calibration:
    """Record of the maximum likelihood in its projective frame, with its covariance."""
    share = distortion.share_explained(whole, frame) if whole.scene.lens is None else 0.0
    solution, kept = determined(whole)
    refusal = expected.refusal(solution.agreement)
    if refusal is not None:
        raise Misfit(refusal + distortion.hint(share))
    problem, scene, agreement = solution.problem, solution.scene, solution.agreement
    readings = problem.readings
    found = culprits.find(problem, scene, agreement.used, agreement.sigma_px)
    straight = distortion.straight_readings(readings, scene.lens)
    try:
        quality.require_explained(
            *culprits.unexplained(straight, agreement.used, found.explained, epipolar),
            len(np.unique(found.suspect[:, 0])),
            len(readings.q),
        )
    except Misfit as refused:
        raise Misfit(f"{refused}{distortion.hint(share)}") from None
    result = _projective(problem, scene)
    _, J = adjustment.derivative(scene, readings, problem.q)
    used = agreement.used.astype(np.float64)
    factor = spread_factor(problem.dense(J, used), adjustment.gauge(scene, readings, problem.place))
    adjusted = factor
    factor = output_derivative(scene, readings, problem.place, result) @ factor
    gauge = output_gauge(result)
    factor -= gauge @ (gauge.T @ factor)
    quality.require_off_line(result.M, agreement.sigma_px * marker_factor(result, factor))
    suspicion = "lens" if share else "joint readings"
    record = assemble(
        "refined", result, readings, problem.q_reference, agreement, expected, factor, found, suspicion
    )
    advice = (*record.advice, *distortion.advice(record, share, frame.known))
    spread = reach.all_spreads(record.model(), result.M, factor, reach.surroundings(readings))
    sigma = expected.noise_px(agreement)
    error, bound = predicted_error(record.model(), result.M, factor, reach.surroundings(readings), readings.q)
    record = dataclasses.replace(
        record,
        advice=advice,
        worst_determined=worst_determined(problem, scene, adjusted, spread, sigma),
        predicted_rms_px=sigma * error,
        predicted_p99_px=sigma * bound,
    )
    return record if kept.all() else with_lost_markers(record, whole.problem.readings, kept)


def _projective(problem: Problem, scene: Scene) -> ProjectiveScene:
    """The scene in the isotropic projective frame of the points seen."""
    E = adjustment.displacements(scene.H_hat, problem.readings.prismatic, problem.q)
    moved = adjustment.moved_points(E, scene.M, problem.readings)[0]
    return dataclasses.replace(isotropic(scene.P, scene.H_hat, scene.M, A_INF, moved), lens=scene.lens)


def _linear(readings: Readings, epipolar: Epipolar, expected: Expected) -> Calibration:
    """Calibration by the linear multi-frame method, without covariance."""
    scene, q_reference, known = linear.operators(readings, epipolar.F)
    readings = restrict(readings, known)
    result = _projective(prepare(readings, q_reference), scene)
    return _unrefined("linear", result, readings, q_reference, expected)


def _closed_form(readings: Readings, epipolar: Epipolar, expected: Expected) -> Calibration:
    """Calibration by the closed forms [RH00] eqs. (4), (5), without covariance."""
    result, q_reference, known = closed_form.operators(readings, epipolar.F, epipolar.sigma_px)
    return _unrefined("closed_form", result, restrict(readings, known), q_reference, expected)


def _unrefined(
    method: str, result: ProjectiveScene, readings: Readings, q_reference: FloatArray, expected: Expected
) -> Calibration:
    """Record of a method that minimises no image error: all readings count, whatever they show."""
    problem = prepare(readings, q_reference)
    residual = problem.residual(Scene(result.P, result.H_hat_0, result.M))
    dof = 2 * int(np.count_nonzero(readings.seen)) - problem.place.size
    agreement = Agreement(residual, readings.seen, dof)
    return assemble(method, result, readings, q_reference, agreement, expected, None)
