"""Poses of the flange as readings: coordinates, their operators in the base, and errors of a pose.

A pose p_base = T p_flange is a translation from a reference along the axes of the base, then turns about
three of its axes through the origin of the flange there: a chain PPPRRR whose operators are known in the
base, m. The map of poses to coordinates is exact; only where the middle turn is 90° do coordinates jump.
"""

from collections.abc import Sequence
from functools import reduce
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from projservo_cli.geometry.displacements import displacements, twists
from projservo_cli.records import FARTHEST_M, FloatArray, InputError, prismatic_of

# Types of the coordinates of a pose.
FLANGE_TYPES = "PPPRRR"
UNIT = 0.01
"""Maximum difference of the length of a quaternion from one."""
# Singular value of the rates of turns below which the middle one is taken to be 90°.
_LOCKED = 1e-6
# Maximum difference of RᵀR from the identity.
_ORTHOGONAL = 1e-3


class FlangeChart(NamedTuple):
    """Coordinates (6,) of poses of the flange: x, y, z of the base, m, then three turns, rad."""

    axes: FloatArray  # (3, 3) a column for each turn, its axis in the base, in the order of the product
    T: FloatArray  # (4, 4) pose where all are zero

    @classmethod
    def of(cls, T: FloatArray) -> "FlangeChart":
        """Choose the chart of poses (K, 4, 4): about their mean, its middle turn the smallest."""
        R, middle = Rotation.from_matrix(T[:, :3, :3]), np.eye(4)
        middle[:3, :3], middle[:3, 3] = R.mean().as_matrix(), np.median(T[:, :3, 3], axis=0)
        charts = [cls(np.roll(np.eye(3), by, axis=1), middle) for by in range(3)]
        return min(charts, key=lambda chart: float(np.abs(chart.coordinates(T)[:, 4]).max()))

    @classmethod
    def from_record(cls, chart: FloatArray) -> "FlangeChart":
        """Return the chart of an array (2, 4, 4) of a record."""
        return cls(chart[0, :3, :3], chart[1])

    @classmethod
    def from_optional(cls, chart: FloatArray | None) -> "FlangeChart | None":
        """Return the chart of an array (2, 4, 4) of a record, None for None."""
        return None if chart is None else cls.from_record(chart)

    @property
    def record(self) -> FloatArray:
        """Array (2, 4, 4) for a record."""
        axes = np.eye(4)
        axes[:3, :3] = self.axes
        return np.stack([axes, self.T])

    @property
    def H_hat(self) -> FloatArray:
        """Operators (6, 4, 4) where all coordinates are zero, in the base, per m and rad."""
        screws = np.zeros((6, 6))
        screws[:3, 3:], screws[3:, :3] = np.eye(3), self.axes.T
        screws[3:, 3:] = np.cross(self.T[:3, 3], self.axes.T)
        return twists(screws)

    def coordinates(self, T: FloatArray) -> FloatArray:
        """Coordinates (K, 6) of poses (K, 4, 4)."""
        turned = self.axes.T @ T[:, :3, :3] @ self.T[:3, :3].T @ self.axes
        angles = Rotation.from_matrix(turned).as_euler("XYZ", suppress_warnings=True)
        return np.hstack([T[:, :3, 3] - self.T[:3, 3], angles])

    def poses(self, q: FloatArray) -> FloatArray:
        """Poses (K, 4, 4) of coordinates (K, 6), [RH00] eq. (6)."""
        moved = displacements(self.H_hat, prismatic_of(FLANGE_TYPES), q)
        return np.asarray(reduce(np.matmul, moved) @ self.T)

    def turn_axes(self, q: FloatArray) -> FloatArray:
        """Axes (3, 3) in the base, a column each, of the turns at coordinates (6,)."""
        a, b = (Rotation.from_rotvec(q[3 + i] * np.eye(3)[i]) for i in range(2))
        columns = [1.0, 0.0, 0.0], a.apply([0.0, 1.0, 0.0]), (a * b).apply([0.0, 0.0, 1.0])
        return np.asarray(self.axes @ np.column_stack(columns))

    def by_twist(self, q: FloatArray) -> FloatArray:
        """Derivatives (K, 6, 6) of coordinates (K, 6) by a twist of the flange, its translation first."""
        a, b, c = (Rotation.from_rotvec(q[:, [3 + i]] * np.eye(3)[i]) for i in range(3))
        to_turns = self.axes.T @ self.T[:3, :3]
        columns = (
            (b * c).inv().apply([1, 0, 0]),
            c.inv().apply([0, 1, 0]),
            np.tile([0.0, 0.0, 1.0], (len(q), 1)),
        )
        result = np.zeros((len(q), 6, 6))
        result[:, :3, :3] = self.axes @ (a * b * c).as_matrix() @ to_turns
        result[:, 3:, 3:] = np.linalg.pinv(np.stack(columns, axis=-1), rcond=_LOCKED) @ to_turns
        return result


def require_poses(T: FloatArray, where: Sequence[str]) -> None:
    """Refuse matrices (K, 4, 4) that are no poses in m, with an InputError; ``where`` names each."""
    for k in np.flatnonzero(~np.isfinite(T).all(axis=(1, 2)))[:1]:
        raise InputError(f"{where[k]}: holds a number that is not finite; leave such poses out")
    _require_rotations(T[:, :3, :3], where)
    far = np.abs(T[:, :3, 3]).max(axis=1)
    if far[k := int(np.argmax(far))] > FARTHEST_M:
        raise InputError(
            f"{where[k]}: a position of {far[k]:g} m looks like millimetres: name the columns x_mm, y_mm, "
            "z_mm, or divide by 1000"
        )


def _require_rotations(R: FloatArray, where: Sequence[str]) -> None:
    """Refuse matrices (K, 3, 3) that are no rotations."""
    off = np.abs(R.swapaxes(1, 2) @ R - np.eye(3)).max(axis=(1, 2))
    for k in np.flatnonzero((off > _ORTHOGONAL) | (np.linalg.det(R) < 0.0))[:1]:
        mirrored = off[k] <= _ORTHOGONAL
        why = "mirrors" if mirrored else f"is not orthogonal, by {off[k]:.2g} ({_ORTHOGONAL:g} at most)"
        raise InputError(
            f"{where[k]}: the rotation of T11 … T33 {why}: give the 3×4 matrix row by row, T11, T12, T13, "
            "T14, T21, …"
        )
