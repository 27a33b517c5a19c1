"""The calibration record of a fit: diagnostics, covariance, what was left out, verdict."""

import dataclasses
from typing import Any

import numpy as np

from projservo_cli.calibration import excitation, quality, reach
from projservo_cli.calibration.culprits import Culprits
from projservo_cli.calibration.frame import ProjectiveScene
from projservo_cli.calibration.quality import Agreement, Expected
from projservo_cli.calibration.readings import Readings, restrict
from projservo_cli.records import (
    NO_LENS,
    PRISMATIC,
    REVOLUTE,
    BoolArray,
    Calibration,
    FloatArray,
    IntArray,
    Model,
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
