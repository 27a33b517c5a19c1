"""Accuracy of an arrival: actual or possible image errors, px, carried to the face in millimetres."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm
from scipy.special import chdtri

from projservo_cli.calibration.prediction import Parameters, predict
from projservo_cli.geometry.joint_curve import backwards
from projservo_cli.metric.frame import invariant_upgrade
from projservo_cli.monitoring.frame_pairs import FramePair
from projservo_cli.monitoring.innovation_tests import (
    DISTINCT,
    ErrorModel,
    Residual,
    coordinate_rows,
    farthest_alone,
    relative_noise,
    rigid_motions,
)
from projservo_cli.records import MM, BoolArray, Calibration, FloatArray, InputError, Model, changed

# Variance of corners from a side that the calibration has not seen, over other corners; chance of a test.
_UNUSUAL, _CHANCE = 2.0, 1e-4
# Share of detections that may be inconsistent, and deviation of a pose that is not known, over noise.
_ALONE, _FREE = 0.25, 1e4
# Steps of Gauss and Newton towards a pose that is some degrees away.
_STEPS = 4
# Markers of a view that show the pose of the tool.
_LEAST_MARKERS = 3


def metric_points(model: Model, M: FloatArray) -> FloatArray | None:
    """Points (m, 3) of markers (m, 4) in the metric of the arm, up to scale; None if axes leave it open."""
    try:
        X = M @ invariant_upgrade(model.H_hat_0, model.prismatic).T
    except (InputError, np.linalg.LinAlgError):
        return None
    return np.asarray(X[:, :3] / X[:, 3:])


def metres_a_unit(model: Model, M: FloatArray, lengths: FloatArray) -> float:
    """Metres a unit of the metric of the arm, by lengths (m, m) between markers (m, 4); NaN if unknown."""
    X = metric_points(model, M)
    return math.nan if X is None else float(metres_by(X, lengths))


def metres_by(X: FloatArray, lengths: FloatArray) -> FloatArray:
    """Metres a unit (...) of points (..., k, 3), by lengths (m, m) between the first m; NaN if unknown."""
    i, k = np.nonzero(lengths > 0.0)
    if not len(i):
        return np.full(X.shape[:-2], math.nan)
    apart = np.linalg.norm(X[..., i, :] - X[..., k, :], axis=-1)
    return np.asarray(np.median(lengths[i, k] / apart, axis=-1))


class Posture:
    """A rigid tool at joints: how its motions change its images, and by how much they move its face.

    model : of robot and rig; q : (n,) joint readings, rad or m.
    face : (f, 4) its markers at the reference; lengths : (f, f) between them, m, NaN if unknown.
    ``known``: whether one of these is.
    """

    def __init__(self, model: Model, q: FloatArray, face: FloatArray, lengths: FloatArray) -> None:
        away, H_hat, prismatic, curve = q - model.q_reference, model.H_hat_0, model.prismatic, model.curve
        if model.on_tool:  # the chain of the scene
            away, H_hat, prismatic = -away[::-1], -H_hat[::-1], prismatic[::-1]
            curve = backwards(curve, len(q))
        self._model, self._away, self._chain, self._curve = model, away[None], (H_hat, prismatic), curve
        self._twists = rigid_motions(model.H_hat_0, np.linalg.svd(model.a_inf[None])[2][1:], model.a_inf)
        has: BoolArray = np.isfinite(lengths) & (lengths > 0.0)
        self.known = bool(has.any())
        self._moves = MM / np.sqrt(len(face)) * self._moved(face, has, lengths) if self.known else None

    def _moved(self, face: FloatArray, has: BoolArray, lengths: FloatArray) -> FloatArray:
        """Displacements (d, f 3), m, of the face by motions of the tool.

        If the axes of the arm leave its metric open they are those across the lines of sight (d, V f 2),
        by the pair of corners with the smallest foreshortening.
        """
        d, X = len(self._twists), metric_points(self._model, face)
        if X is None:
            J, s = self._changes(face)
            span = np.linalg.norm(s[:, :, None] - s[:, None], axis=3)
            m_per_px = 1.0 / np.max(span[:, has] / lengths[has], axis=1)
            across: FloatArray = J * (np.sqrt(1.0 / len(J)) * m_per_px[:, None, None, None])
            return np.moveaxis(across, -1, 0).reshape(d, -1)
        apart = np.linalg.norm(X[:, None] - X[None], axis=2)
        moved = [metric_points(self._model, face + face @ twist.T) for twist in self._twists]
        return np.asarray(np.median(lengths[has] / apart[has]) * (np.array(moved) - X).reshape(d, -1))

    def _changes(self, M: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Derivatives (V, m, 2, d) of pixels of markers (m, 4) by motions of the tool, and the pixels."""
        scene = Parameters(self._model.P, *self._chain, M, self._model.lens, curve=self._curve)
        images = scene.everywhere(self._away)
        return images.by_point[-1] @ np.moveaxis(M @ self._twists.swapaxes(1, 2), 0, -1), images.pixels

    def carry(self, M: FloatArray, used: BoolArray) -> FloatArray:
        """Matrix (k, 2 V m) from changes of pixels, px, to displacements of the face, mm, whose norm is rms.

        M : (m, 4) markers at the reference; used : (V, m) those by which the tool is measured.
        """
        assert self._moves is not None
        J = np.where(used[..., None, None], self._changes(M)[0], 0.0).reshape(2 * used.size, -1)
        return np.asarray(self._moves.T @ np.linalg.pinv(J))


class RigidFit(NamedTuple):
    """Images of one instant against the calibrated tool in any pose, whether joints reach it or not."""

    agrees: bool  # whether chance explains the residuals, and the shift
    reached: bool  # whether it explains the residuals where the joints show it best, too
    rms_px: float  # residual of a coordinate
    limit_px: float  # limit of the shift by chance, with the deviations of the images and of the calibration
    seen: BoolArray  # (V, m) without inconsistent detections
    off_px: FloatArray  # (V, m) residual of each detection, px; 0 where unseen
    view: int  # whose image seems to be shifted against the others: of two the first, of more the likeliest
    shift: FloatArray  # (2,) by which, px; nothing by one view
    covariance: FloatArray  # (2, 2) of it
    moved_px: float  # difference of the images from those at the joints, px rms a marker
    turn: float  # angle between both, rad

    def off_mm(self, posture: Posture, M: FloatArray) -> float:
        """Return the possible error of the face, mm, if one of the images is shifted within chance."""
        carry = posture.carry(M, self.seen).reshape(-1, *self.seen.shape, 2)[:, self.view].sum(axis=1)
        may = DISTINCT**2 * np.trace(carry @ self.covariance @ carry.T)
        return float(np.sqrt(np.square(carry @ self.shift).sum() + may))


def rigid_fit(calibration: Calibration, q: FloatArray, images: FloatArray, sigma: FloatArray) -> RigidFit:
    """Fit the pose of the tool to images, from joints (n,), rad or m.

    images : (V, m, 2) px of the markers of the calibration, NaN where unseen; sigma : (V, m) deviations.
    """
    noise = np.maximum(sigma, calibration.sigma_px * relative_noise(calibration))
    pair, n = FramePair.at_rest(q, images, noise), len(q)
    errors, moved = ErrorModel(calibration, calibration.sigma_px), np.eye(4)
    at = by_joints = errors.residual(pair)
    for _ in range(_STEPS):
        step = np.linalg.lstsq(at.F[:, errors.tool], at.r, rcond=None)[0]
        moved = moved @ expm(np.tensordot(step, errors.twists, 1))
        errors = ErrorModel(changed(calibration, M=calibration.M @ moved.T), calibration.sigma_px)
        at = errors.residual(pair)
    free, left = _free(at, at.F[:, errors.tool]), at.seen.ravel().copy()
    V, view_of = len(at.seen), np.arange(len(at.r)) // (2 * at.seen.shape[1])
    for _ in range(int(_ALONE * min(1.0, 2.0 / V) * left.sum())):  # no more than half of a view
        limit = _UNUSUAL * chdtri(2, _CHANCE / left.sum())
        if (stray := farthest_alone(free, at.r, np.flatnonzero(left), limit)) is None:
            break
        left[stray] = False
    rows = coordinate_rows(np.flatnonzero(left))
    P, r, r_joints = np.linalg.inv(free[np.ix_(rows, rows)]), at.r[rows], by_joints.r[rows]
    view_of, shifts = view_of[rows], []
    # One of two images is shifted against the other; a single one shows no more than another pose.
    for view in {*range(V if V > 2 else V - 1)} & {*view_of.tolist()}:
        F = np.eye(2)[rows % 2] * (view_of == view)[:, None]
        covariance = np.linalg.inv(F.T @ P @ F)
        shift = covariance @ F.T @ P @ r
        shifts.append((float(shift @ F.T @ P @ r), view, shift, covariance))
    none = 0.0, 0, np.zeros(2), np.zeros((2, 2))
    chi2, view, shift, covariance = max(shifts, key=lambda found: found[0], default=none)
    joints = np.linalg.solve(_free(by_joints, by_joints.F[:, :n])[np.ix_(rows, rows)], r_joints)
    # χ² of the shift, of the residuals, and of residuals where joints show it best, over their limits.
    bias = 2.0 * float(np.square(errors.bias_px / at.noise).ravel()[left].sum())
    freedom = np.maximum([2, len(rows) - len(errors.twists), len(rows) - n], 1)
    squares = np.array([chi2, r @ P @ r, r_joints @ joints])
    over, rms = squares / (_UNUSUAL * chdtri(freedom, _CHANCE) + bias), np.sqrt(np.mean(r**2))
    return RigidFit(
        agrees=bool(max(over[:2]) <= 1.0),
        reached=bool(over[2] <= 1.0),
        rms_px=float(rms),
        limit_px=float(rms / np.sqrt(max(over[1], 1e-300))),
        seen=left.reshape(at.seen.shape),
        off_px=np.linalg.norm(at.r.reshape(*at.seen.shape, 2), axis=2),
        view=view,
        shift=shift,
        covariance=covariance,
        moved_px=float(np.sqrt(2.0 * np.mean(r_joints**2))),
        turn=float(np.arccos(np.clip(0.5 * np.trace(moved) - 1.0, -1.0, 1.0))),
    )


def resting_error_mm(
    calibration: Calibration, q: FloatArray, face: Sequence[int], lengths: FloatArray, images: FloatArray
) -> float | None:
    """Return how far a face at rest may be from where its joints put it, rms mm, by images that agree.

    The error of the images, and the shift of one of them that no test shows. None if no length is known,
    or less than two views, or the only one, show three markers.

    q : (n,) joint readings, rad or m; face : numbers of its markers; lengths : (f, f) between them, m, NaN if
        unknown.
    images : (V, m, 2) mean pixels of the markers of the calibration, NaN where unseen.
    """
    detected = np.isfinite(images[..., 0])
    enough = (detected.sum(axis=1) >= _LEAST_MARKERS).sum() >= min(2, len(detected))
    if not {*face} <= {*calibration.marker.tolist()} or not enough:
        return None
    M = calibration.M
    posture = Posture(calibration.model(), q, M[calibration.indices_of(face)], lengths)
    if not posture.known:
        return None
    off = np.where(detected[..., None], images - predict(calibration, q[None])[0], 0.0).ravel()
    hidden_mm = rigid_fit(calibration, q, images, np.zeros(detected.shape)).off_mm(posture, M)
    return float(np.hypot(np.linalg.norm(posture.carry(M, detected) @ off), hidden_mm))


def _free(at: Residual, J: FloatArray) -> FloatArray:
    """Covariance (2 V m, 2 V m) of residuals whose changes along J (2 V m, k) are not known."""
    S = at.R + at.B @ at.B.T
    J = J * np.repeat(at.seen.ravel(), 2)[:, None]
    J = J / np.maximum(np.linalg.norm(J, axis=0), 1e-300)
    return np.asarray(S + _FREE * S.diagonal().max() * J @ J.T)
