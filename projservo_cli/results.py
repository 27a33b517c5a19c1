"""A run file as an object: its calibration predicts images, its plan and traces are arrays."""

import dataclasses

import numpy as np

from projservo_cli.calibration import predict
from projservo_cli.geometry.kinematics import forward_kinematics, image_jacobian, joint_operators
from projservo_cli.geometry.kinematics import project as pixels_of
from projservo_cli.geometry.lens import bent_derivative
from projservo_cli.records import Calibration, FloatArray, InputError
from projservo_cli.store import Run

_AT_INFINITY = 1e-12  # of the norms: what rounding leaves of a_inf @ A there


@dataclasses.dataclass(frozen=True, eq=False)
class ImageModel(Calibration):
    """A calibration that says where markers appear: all of its arrays, and three functions.

    Views are left and right, markers in the order of ``marker``, pixels are raw u and v, joint
    readings rad or m. A point that is not in front of a camera has no pixels there: NaN.
    """

    def predict(self, q: FloatArray) -> FloatArray:
        """Pixels of all markers at joint readings, [RH00] eqs. (1), (6).

        Parameters
        ----------
        q : (n,) or (K, n) readings, rad or m.

        Returns
        -------
        (2, m, 2) or (K, 2, m, 2) pixels.

        Raises
        ------
        InputError
            If the readings have another number of joints or are not finite.
        """
        rows, single = self._rows(q)
        pixels = predict(self, rows)
        return pixels[0] if single else pixels

    def jacobian(self, q: FloatArray) -> FloatArray:
        """Derivative of the predicted pixels by the joint readings, [RH00] eqs. (7), (19).

        Parameters
        ----------
        q : (n,) or (K, n) readings, rad or m.

        Returns
        -------
        (2, m, 2, n) or (K, 2, m, 2, n) derivatives, px per rad or m.

        Raises
        ------
        InputError
            If the readings have another number of joints or are not finite.
        """
        rows, single = self._rows(q)
        model = self.model()
        moved = [self.M @ forward_kinematics(model, row).T for row in rows]
        straight = np.array([pixels_of(model.P, A) for A in moved])
        operators = [joint_operators(model, row) for row in rows]
        J = np.array([image_jacobian(model.P, A, H) for A, H in zip(moved, operators, strict=True)])
        J = bent_derivative(model.lens[:, None], straight)[0] @ J
        J[np.isnan(predict(self, rows)[..., 0])] = np.nan
        return np.asarray(J[0] if single else J)

    def project(self, points: FloatArray) -> FloatArray:
        """Pixels of points of the calibration's projective frame, such as ``M``, [RH00] eq. (1).

        Parameters
        ----------
        points : (..., 4) homogeneous points, of any scale.

        Returns
        -------
        (2, ..., 2) pixels; of a point at infinity its vanishing point.

        Raises
        ------
        InputError
            If the points have not four coordinates.
        """
        A = np.asarray(points, dtype=np.float64)
        if A.ndim == 0 or A.shape[-1] != 4:
            raise InputError(f"points of shape {A.shape}: expected four homogeneous coordinates each")
        depth = np.einsum("vj,...j->v...", self.P[:, 2], A)
        side = A @ self.a_inf
        norms = np.linalg.norm(A, axis=-1) * np.linalg.norm(self.a_inf)
        ahead = np.where(np.abs(side) > _AT_INFINITY * norms, depth * side > 0.0, depth != 0.0)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            return np.where(ahead[..., None], pixels_of(self.P, A, self.model().lens), np.nan)

    def _rows(self, q: FloatArray) -> tuple[FloatArray, bool]:
        readings = np.asarray(q, dtype=np.float64)
        n = len(self.joint_types)
        if readings.ndim not in (1, 2) or readings.shape[-1] != n or not np.isfinite(readings).all():
            raise InputError(
                f"joint readings of shape {readings.shape}: expected {n} finite numbers, or rows of them"
            )
        return np.atleast_2d(readings), readings.ndim == 1


@dataclasses.dataclass(frozen=True)
class Experiment(Run):
    """All that a run file holds."""

    @property
    def calibration(self) -> ImageModel:
        """The calibration, with functions that predict images."""
        return ImageModel(**vars(super().calibration))
