"""Accuracy of an arrival: pixels by which images are off, or may be, carried to the face in millimetres."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from projservo_cli.calibration.prediction import Parameters, predict
from projservo_cli.metric.frame import invariant_upgrade
from projservo_cli.monitoring.frame_pairs import FramePair
from projservo_cli.monitoring.statistics import TOLD, ErrorModel, rigid_motions
from projservo_cli.records import MM, PRISMATIC, BoolArray, Calibration, FloatArray, InputError, Model

# Variance of corners from a side that the calibration has not seen, over that of others; chance of a test.
_UNUSUAL, _CHANCE = 2.0, 1e-4
# Steps of Gauss and Newton towards a pose, and the change of pixels, px, that ends them.
_STEPS, _SETTLED_PX = 20, 1e-6


class Posture:
    """A rigid tool at joints: how its motions change its images, and by how much they move its face.

    model : of robot and rig; q : (n,) joint readings, rad or m.
    face : (f, 4) its markers at the reference; lengths : (f, f) between them, m, NaN if unknown.
    ``known``: whether one of these is.
    """

    def __init__(self, model: Model, q: FloatArray, face: FloatArray, lengths: FloatArray) -> None:
        self._model, self._away = model, (q - model.q_reference)[None]
        self._twists = rigid_motions(model.H_hat_0, np.linalg.svd(model.a_inf[None])[2][1:], model.a_inf)
        has: BoolArray = np.isfinite(lengths) & (lengths > 0.0)
        self.known = bool(has.any())
        self._moves = MM / np.sqrt(len(face)) * self._moved(face, has, lengths) if self.known else None

    def _moved(self, face: FloatArray, has: BoolArray, lengths: FloatArray) -> FloatArray:
        """Displacements (d, f 3), m, of the face by motions of the tool.

        Where the axes of the arm leave its metric open they are those across the lines of sight (d, 2 f 2),
        by the pair of corners with the least foreshortening.
        """
        model, d = self._model, len(self._twists)
        try:
            G = invariant_upgrade(model.H_hat_0, model.joint_types == PRISMATIC)
        except (InputError, np.linalg.LinAlgError):
            J, s = self._changes(face)
            span = np.linalg.norm(s[:, :, None] - s[:, None], axis=3)
            m_per_px = 1.0 / np.max(span[:, has] / lengths[has], axis=1)
            across: FloatArray = J * (np.sqrt(0.5) * m_per_px[:, None, None, None])
            return np.moveaxis(across, -1, 0).reshape(d, -1)
        X = face @ G.T
        X = X[:, :3] / X[:, 3:]
        apart = np.linalg.norm(X[:, None] - X[None], axis=2)
        moved = (face @ self._twists.swapaxes(1, 2) @ G[:3].T) / (face @ G[3])[:, None]
        return np.asarray(np.median(lengths[has] / apart[has]) * moved.reshape(d, -1))

    def _changes(self, M: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Derivatives (2, m, 2, d) of pixels of markers (m, 4) by motions of the tool, and the pixels."""
        model, prismatic = self._model, self._model.joint_types == PRISMATIC
        images = Parameters(model.P, model.H_hat_0, prismatic, M, model.lens).everywhere(self._away)
        return images.by_point[-1] @ np.moveaxis(M @ self._twists.swapaxes(1, 2), 0, -1), images.pixels

    def carry(self, M: FloatArray, used: BoolArray) -> FloatArray:
        """Matrix (k, 4 m) from changes of pixels, px, to displacements of the face, mm, whose norm is rms.

        M : (m, 4) markers at the reference; used : (2, m) those by which the tool is measured.
        """
        assert self._moves is not None
        J = np.where(used[..., None, None], self._changes(M)[0], 0.0).reshape(4 * len(M), -1)
        return np.asarray(self._moves.T @ np.linalg.pinv(J))


class RigidFit(NamedTuple):
    """Images of one instant against the calibrated tool in any pose, whether joints reach it or not."""

    rms_px: float  # residual of a coordinate
    limit_px: float  # of it by chance, with the deviations of the images and of the calibration
    seen: BoolArray  # (2, m)
    shift: FloatArray  # (2, 2) by which each image seems to be shifted, u and v, px
    covariance: FloatArray  # (2, 2, 2) of it
    excess: float  # the largest χ² of these over its limit by chance
    moved_px: float  # difference of the images from those at the joints, px rms a marker
    turn: float | None  # angle between both, rad; None where the axes of the arm leave their metric open

    @property
    def agrees(self) -> bool:
        """Whether chance explains what is left, and each shift."""
        return self.rms_px <= self.limit_px and self.excess <= 1.0

    def off_mm(self, posture: Posture, M: FloatArray) -> float:
        """Return how far off the face may be, mm, where one of the images is shifted within chance."""
        carry = posture.carry(M, self.seen).reshape(-1, 2, len(M), 2).sum(axis=2)
        squares = [
            np.square(carry[:, v] @ self.shift[v]).sum()
            + TOLD**2 * np.trace(carry[:, v] @ self.covariance[v] @ carry[:, v].T)
            for v in (0, 1)
        ]
        return float(np.sqrt(max(squares)))


def rigid_fit(calibration: Calibration, q: FloatArray, images: FloatArray, sigma: FloatArray) -> RigidFit:
    """Fit the pose of the tool to images, from joints (n,), rad or m.

    images : (2, m, 2) px of the markers of the calibration, NaN where unseen; sigma : (2, m) deviations.
    """
    c, a_inf = calibration, calibration.a_inf
    twists, seen = rigid_motions(c.H_hat_0, np.linalg.svd(a_inf[None])[2][1:], a_inf), np.isfinite(images)
    for _ in range(_STEPS):
        there = Parameters(c.P, c.H_hat_0, c.prismatic, c.M, c.lens).everywhere((q - c.q_reference)[None])
        J = there.by_point[-1] @ np.moveaxis(c.M @ twists.swapaxes(1, 2), 0, -1)
        step = np.linalg.lstsq(J[seen], (images - there.pixels)[seen], rcond=None)[0]
        c = replace(c, M=c.M @ expm(np.tensordot(step, twists, 1)).T)
        if np.abs(J[seen] @ step).max() < _SETTLED_PX:
            break
    errors = ErrorModel(c, c.sigma_px)
    at = errors.residual(still(q, images, np.maximum(sigma, c.sigma_px)))
    shown = np.repeat(at.seen.ravel(), 2)
    inverse = np.linalg.inv((at.R + at.B @ at.B.T)[np.ix_(shown, shown)])
    J, r = J.reshape(len(shown), -1)[shown], at.r[shown]
    P = inverse - inverse @ J @ np.linalg.pinv(J.T @ inverse @ J) @ J.T @ inverse
    freedom, bias = len(r) - J.shape[1], 2.0 * (np.square(errors.bias_px / at.noise) * at.seen).sum()
    rms = float(np.sqrt(np.mean(r**2)))
    over = float(r @ P @ r) / (_UNUSUAL * chdtri(freedom, _CHANCE) + bias)
    shift, covariance, excess = np.zeros((2, 2)), np.zeros((2, 2, 2)), 0.0
    for v in (0, 1):
        one = (np.arange(2)[:, None, None] == v) & np.ones(at.seen.shape, dtype=np.bool_)[..., None]
        F = (one[..., None] * np.eye(2)).reshape(len(shown), 2)[shown]
        covariance[v] = np.linalg.inv(F.T @ P @ F)
        shift[v] = covariance[v] @ F.T @ P @ r
        gain = float(shift[v] @ F.T @ P @ r)
        excess = max(excess, gain / (_UNUSUAL * chdtri(2, _CHANCE) + bias))
    off = np.square(images - predict(calibration, q[None])[0]).sum(axis=-1)[at.seen]
    moved, turn = float(np.sqrt(off.mean())), _angle(calibration, c.M)
    return RigidFit(rms, rms / np.sqrt(over), at.seen, shift, covariance, excess, moved, turn)


def _angle(calibration: Calibration, M: FloatArray) -> float | None:
    """Angle, rad, by which markers (m, 4) are turned against those of the calibration."""
    try:
        G = invariant_upgrade(calibration.H_hat_0, calibration.prismatic)
    except (InputError, np.linalg.LinAlgError):
        return None
    points = [X[:, :3] / X[:, 3:] for X in (calibration.M @ G.T, M @ G.T)]
    return float(Rotation.align_vectors(*(X - X.mean(axis=0) for X in points))[0].magnitude())


def still(q: FloatArray, images: FloatArray, noise: FloatArray) -> FramePair:
    """Observation of an arm that stands still at joints (n,), of pixels (2, m, 2) with deviations (2, m)."""
    none = np.zeros(2)
    return FramePair(none, np.stack([q, q]), np.zeros((2, len(q))), none, images, noise, np.zeros(len(q)))
