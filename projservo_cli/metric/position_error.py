"""Errors of the metric arm against positions of a point of the tool that another instrument measured."""

from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from projservo_cli.geometry.displacements import aligned
from projservo_cli.metric.frame import Metric
from projservo_cli.records import MM, FloatArray, InputError, IntArray, WorkFailed

# Number of unknowns between both frames: scale, pose, and the point on the tool.
_UNKNOWNS = 10
# Minimum number of positions that a fit takes, three coordinates each, with some to spare.
_MIN_POSITIONS = 6
# Axes of a mirrored frame; it is taken for the frame of the instrument if it leaves less than this of χ².
_MIRROR, _MIRRORED = np.array([1.0, 1.0, -1.0]), 0.01
# Number of parts that a table is divided into when it is fitted itself.
_PARTS = 5


class Positions(NamedTuple):
    """Positions of a point fixed to the tool, in the frame of the instrument."""

    pose: IntArray  # (K,) number of the pose
    q: FloatArray  # (K, n) readings, rad or m
    xyz: FloatArray  # (K, 3) m
    sigma: FloatArray  # (K,) standard deviation of a coordinate, m

    def rows(self, at: Any) -> "Positions":
        """Select positions."""
        return Positions(*(values[at] for values in self))


class _Link(NamedTuple):
    """The instrument's frame and the point on the tool: log scale, rotation vector, shift, point."""

    x: FloatArray  # (10,)

    def turned(self, vectors: FloatArray) -> FloatArray:
        """Vectors (…, 3) of the base frame in the frame of the instrument, m."""
        A = np.exp(self.x[0]) * Rotation.from_rotvec(self.x[1:4]).as_matrix()
        return np.asarray(vectors @ A.T)

    def positions(self, T: FloatArray) -> FloatArray:
        """Positions (K, 3) of the point by poses (K, 4, 4) of the tool, m."""
        return self.turned(T[:, :3, :3] @ self.x[7:] + T[:, :3, 3]) + self.x[4:7]


def _fit_link(metric: Metric, table: Positions) -> _Link:
    """Fit scale, pose and point on the tool by least squares.

    Raises WorkFailed if the table does not determine them, or is of a frame that is left-handed.
    """
    T = metric.pose(table.q)
    fit, mirrored = _least_squares(T, table.xyz), _least_squares(T, table.xyz * _MIRROR)
    if mirrored.cost < _MIRRORED * fit.cost:
        rms = (MM * np.sqrt(2.0 * each.cost / len(table.q)) for each in (fit, mirrored))
        raise WorkFailed(
            "the frame of the instrument is left-handed: positions are {:.3g} mm rms off, with an axis "
            "negated {:.3g} mm; negate x, y or z in the table".format(*rms)
        )
    J = np.asarray(fit.jac)
    if np.linalg.matrix_rank(J / np.maximum(np.linalg.norm(J, axis=0), 1e-300), tol=1e-6) < _UNKNOWNS:
        raise WorkFailed("the positions do not determine the point on the tool: turn the tool about two axes")
    return _Link(fit.x)


def _least_squares(T: FloatArray, xyz: FloatArray) -> Any:
    """Fit of a link to positions (K, 3) at poses (K, 4, 4) of the tool, m."""
    t = T[:, :3, 3]
    centered, target = t - t.mean(axis=0), xyz - xyz.mean(axis=0)
    # Take the point at the tool's origin, and the scale that S. Umeyama gives with the rotation.
    rotation = aligned(centered[None], target[None], np.ones((1, len(t))))[0][0]
    scale = float((target * (centered @ rotation.T)).sum() / (centered**2).sum())
    shift = xyz.mean(axis=0) - scale * rotation @ t.mean(axis=0)
    start = np.r_[np.log(scale), Rotation.from_matrix(rotation).as_rotvec(), shift, np.zeros(3)]

    def residual(x: FloatArray) -> FloatArray:
        return np.asarray((_Link(x).positions(T) - xyz).ravel())

    return least_squares(residual, start, x_scale="jac")


def _jacobian(T: FloatArray, link: _Link) -> FloatArray:
    """Derivative (3 K, 10) of the positions at poses (K, 4, 4) of the tool by the link."""
    step = 1e-6
    columns = [
        (_Link(link.x + d).positions(T) - _Link(link.x - d).positions(T)).ravel() / (2.0 * step)
        for d in step * np.eye(_UNKNOWNS)
    ]
    return np.stack(columns, axis=1)


def _held_out(
    metric: Metric, table: Positions, fit: Positions, arm_std_m: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Errors (K, 3), m, of positions held out of a fit, covariances (K, 3, 3), m², and its scale (1,)."""
    if len(fit.q) < _MIN_POSITIONS:
        raise InputError(
            f"{len(fit.q)} positions to fit: scale, pose and point need {_MIN_POSITIONS} or more"
        )
    link = _fit_link(metric, fit)
    T_fit, T = metric.pose(fit.q), metric.pose(table.q)
    of_fit, changes = (link.turned(metric.point_changes(q, link.x[7:])) for q in (fit.q, table.q))
    carry = _jacobian(T, link) @ np.linalg.pinv(_jacobian(T_fit, link))
    own = np.repeat(np.sqrt(fit.sigma**2 + arm_std_m**2), 3)
    left = changes.reshape(len(changes), -1) - of_fit.reshape(len(of_fit), -1) @ carry.T
    both = np.concatenate([left.T, carry * own], axis=1).reshape(len(table.q), 3, -1)
    noise = (table.sigma**2 + arm_std_m**2)[:, None, None] * np.eye(3)
    return link.positions(T) - table.xyz, both @ both.swapaxes(1, 2) + noise, np.exp(link.x[:1])


def position_errors(
    metric: Metric, table: Positions, fit: Positions | None = None, arm_std_m: float = 0.0
) -> dict[str, Any]:
    """Compare positions by the metric arm with those that another instrument measured.

    Scale, pose and the point on the tool, ten numbers, are fitted to other positions.

    metric : of the calibration, in any scale.
    table, fit : positions to compare, and those to fit; without ``fit`` the table is divided into five parts,
        and each is compared after a fit to the others.
    arm_std_m : deviation of the arm that no image shows, m a coordinate.
    Returns ``count, rms_mm, median_mm, max_mm`` of distances; ``predicted_rms_mm`` by the covariance, and
    ``mahalanobis``, the mean square of errors over it a coordinate; and ``length_m``, the distance of the
    markers ``between`` by the fitted scale, which are the farthest apart.
    Raises InputError if there are too few positions, WorkFailed if they do not determine the ten numbers.
    """
    parts = [(np.arange(len(table.q)), fit)]
    if fit is not None:
        shared = np.intersect1d(table.pose, fit.pose)
        same = [k for k in shared if np.array_equal(table.q[table.pose == k], fit.q[fit.pose == k])]
        if same:
            raise InputError(f"pose {same[0]} is in both tables: remove it from one of them")
    else:
        of = np.arange(len(table.q)) % _PARTS
        parts = [(np.flatnonzero(of == k), table.rows(of != k)) for k in range(min(_PARTS, len(of)))]
    compared = [_held_out(metric, table.rows(at), rest, arm_std_m) for at, rest in parts if rest is not None]
    error, C, scale = (np.concatenate(part) for part in zip(*compared, strict=True))
    distance = MM * np.linalg.norm(error, axis=1)
    apart = np.linalg.norm(metric.markers[:, None] - metric.markers, axis=-1)
    i, j = sorted(int(k) for k in np.unravel_index(int(np.argmax(apart)), apart.shape))
    square = np.einsum("ki,kij,kj->k", error, np.linalg.inv(C), error)
    return {
        "count": len(distance),
        "rms_mm": float(np.sqrt((distance**2).mean())),
        "median_mm": float(np.median(distance)),
        "max_mm": float(distance.max()),
        "predicted_rms_mm": float(MM * np.sqrt(np.trace(C, axis1=1, axis2=2).mean())),
        "mahalanobis": float(square.mean() / 3.0),
        "between": [metric.marker[i], metric.marker[j]],
        "length_m": float(scale.mean() * apart[i, j]),
    }
