"""Accuracy of an arrival: pixels by which images are off, or may be, carried to the face in millimetres."""

import numpy as np

from projservo_cli.calibration.prediction import Parameters
from projservo_cli.metric.frame import invariant_upgrade
from projservo_cli.monitoring.statistics import rigid_motions
from projservo_cli.records import MM, PRISMATIC, BoolArray, FloatArray, InputError, Model


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
