"""Poses of the flange in tables: p_base = T p_flange, a row a pose.

Columns ``x, y, z``, m, or ``x_mm, y_mm, z_mm``; with them ``qx, qy, qz, qw`` or ``rx, ry, rz``, a rotation
vector in rad. Or ``T11 … T34`` alone, the rows of the 3×4 matrix, m.
"""

import math
from collections.abc import Sequence
from itertools import product

import numpy as np
from scipy.spatial.transform import Rotation

from projservo_cli.geometry.flange import UNIT, FlangeChart, require_poses
from projservo_cli.records import Calibration, FloatArray, InputError

_METRES, _MILLIMETRES = ("x", "y", "z"), ("x_mm", "y_mm", "z_mm")
_QUATERNION, _VECTOR = ("qx", "qy", "qz", "qw"), ("rx", "ry", "rz")
_MATRIX = tuple(f"t{i}{j}" for i, j in product(range(1, 4), range(1, 5)))
_FORMS = (*product((_METRES, _MILLIMETRES), (_QUATERNION, _VECTOR)), (_MATRIX, ()))
FORMS = "x, y, z (m) or x_mm, y_mm, z_mm with qx, qy, qz, qw or rx, ry, rz (rad); or T11 … T34 (m)"


def flange_columns(names: Sequence[str]) -> tuple[str, ...]:
    """Columns of poses of the flange among some in small letters; none if there are none.

    Raises InputError for poses in two forms, without naming the file.
    """
    found = [(*places, *turns) for places, turns in _FORMS if {*places, *turns} <= {*names}]
    if len(found) > 1:
        raise InputError(f"the header has poses in {len(found)} forms: keep one of {FORMS}")
    return found[0] if found else ()


def poses_of(columns: Sequence[str], values: FloatArray, where: Sequence[str]) -> FloatArray:
    """Poses (K, 4, 4) of rows (K, c) of numbers; ``where`` names each for messages.

    Raises InputError for a row that is no pose.
    """
    at = {name: values[:, i] for i, name in enumerate(columns)}
    T = np.tile(np.eye(4), (len(values), 1, 1))
    if "t11" in at:
        T[:, :3] = np.stack([at[name] for name in _MATRIX], axis=1).reshape(-1, 3, 4)
    else:
        metres = "x" in at
        T[:, :3, 3] = np.stack([at[name] for name in (_METRES if metres else _MILLIMETRES)], axis=1)
        T[:, :3, 3] *= 1.0 if metres else 1e-3
        turns = np.stack([at[name] for name in (_QUATERNION if "qw" in at else _VECTOR)], axis=1)
        (_require_quaternions if "qw" in at else _require_vectors)(turns, where)
        R = Rotation.from_quat(turns) if "qw" in at else Rotation.from_rotvec(turns)
        T[:, :3, :3] = R.as_matrix()
    require_poses(T, where)
    return T


def _require_quaternions(turns: FloatArray, where: Sequence[str]) -> None:
    """Refuse quaternions (K, 4) that are not of unit length."""
    length = np.linalg.norm(turns, axis=1)
    for k in np.flatnonzero(np.abs(length - 1.0) > UNIT)[:1]:
        raise InputError(
            f"{where[k]}: the quaternion qx, qy, qz, qw has length {length[k]:.4g}, not 1: check its columns"
        )


def _require_vectors(turns: FloatArray, where: Sequence[str]) -> None:
    """Refuse rotation vectors (K, 3) that are longer than a turn."""
    angle = np.linalg.norm(turns, axis=1)
    for k in np.flatnonzero(angle > 2.0 * math.pi + UNIT)[:1]:
        raise InputError(
            f"{where[k]}: the rotation vector rx, ry, rz has length {angle[k]:.4g} rad, more than a turn, as "
            "in degrees: multiply it by π/180, and give no Euler angles"
        )


def coordinates_of(
    T: FloatArray, where: str, like: Calibration | None, given: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Coordinates (K, 6) of poses (K, 4, 4), and their chart (2, 4, 4): of a calibration, or as given.

    Raises InputError where the calibration is by joints.
    """
    if like is None:
        own = FlangeChart.from_optional(given) or FlangeChart.of(T)
        return own.coordinates(T), own.record
    chart = FlangeChart.from_optional(like.flange_chart)
    if chart is None:
        raise InputError(
            f"{where}: these rows are poses of the flange, and the calibration is by joint readings: give "
            "columns q1 … qN"
        )
    return chart.coordinates(T), chart.record


def require_joints(where: str, like: Calibration | None) -> None:
    """Refuse joint readings beside a calibration by poses of the flange, with an InputError."""
    if like is not None and like.flange_chart is not None:
        raise InputError(f"{where}: the calibration is by poses of the flange: give columns {FORMS}")


def pose_columns(T: FloatArray) -> dict[str, FloatArray]:
    """Columns of a table of poses (K, 4, 4): positions, m, and quaternions."""
    quaternions = Rotation.from_matrix(T[:, :3, :3]).as_quat()
    places = dict(zip(_METRES, T[:, :3, 3].T, strict=True))
    return places | dict(zip(_QUATERNION, quaternions.T, strict=True))
