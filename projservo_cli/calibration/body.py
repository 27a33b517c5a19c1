"""The marker body and its pose in each stereo image, from a guessed metric reconstruction."""

from dataclasses import dataclass

import numpy as np

from projservo_cli.calibration.epipolar import MAD
from projservo_cli.records import BoolArray, FloatArray

# Shared markers that carry an alignment: four resist one wrong marker, three are the least.
SAFE, LEAST = 4, 3
ROUNDS = 8


@dataclass(frozen=True, eq=False)
class Alignment:
    """The body in its own frame and its rigid motion to each pose.

    Attributes
    ----------
    body : (m, 3) markers, NaN where never merged.
    R : (K, 3, 3) rotations from the body to the pose.
    t : (K, 3) translations.
    merged : (K,) poses whose rotation is known.
    """

    body: FloatArray
    R: FloatArray
    t: FloatArray
    merged: BoolArray


def align(body: FloatArray, points: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rigid motions (R, t) of least squares, points ≈ R body + t, one a row.

    Source: S. Umeyama, "Least-squares estimation of transformation parameters between two point
    patterns", PAMI 13(4), 1991.

    Parameters
    ----------
    body : (m, 3) points of the body.
    points : (K, m, 3) where they were seen.
    weight : (K, m) weights, zero where not seen; three or more positive ones a row.

    Returns
    -------
    (K, 3, 3) rotations and (K, 3) translations.
    """
    total = weight.sum(axis=1)[:, None]
    center_body = (weight @ body) / total
    center_points = np.einsum("km,kmi->ki", weight, points) / total
    moments = np.einsum(
        "km,kmi,kmj->kij", weight, points - center_points[:, None], body[None] - center_body[:, None]
    )
    U, _, Vt = np.linalg.svd(moments)
    U[:, :, 2] *= np.sign(np.linalg.det(U) * np.linalg.det(Vt))[:, None]
    R = U @ Vt
    return R, center_points - np.einsum("kij,kj->ki", R, center_body)


def robust_align(body: FloatArray, points: FloatArray, seen: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Rigid motions under a Cauchy loss by reweighting, its scale the median residual of all poses.

    Parameters are those of ``align``, with ``seen`` (K, m) for the weights.
    """
    weight = seen.astype(np.float64)
    R, t = align(body, points, weight)
    for _ in range(ROUNDS):
        residual = np.linalg.norm(points - body @ np.swapaxes(R, 1, 2) - t[:, None], axis=2)
        scale = max(float(np.median(residual[seen])) / MAD, 1e-12)
        R, t = align(body, points, np.where(seen, 1.0 / (1.0 + (residual / (2.0 * scale)) ** 2), 0.0))
    return R, t


def merge(points: FloatArray, seen: BoolArray) -> Alignment:
    """Grow the body from the fullest pose until no marker and no pose is added.

    Parameters
    ----------
    points : (K, m, 3) guessed metric reconstruction, any value where not seen.
    seen : (K, m) what was reconstructed.
    """
    K = len(seen)
    points = np.where(seen[..., None], points, 0.0)
    R, t = np.tile(np.eye(3), (K, 1, 1)), np.zeros((K, 3))
    seed = _seed(points, seen)
    body = np.where(seen[seed][:, None], points[seed], np.nan)
    merged = np.arange(K) == seed
    for shared in (SAFE, LEAST, LEAST):
        while True:
            known = np.isfinite(body[:, 0])
            usable = seen & known
            rows = usable.sum(axis=1) >= min(shared, int(known.sum()))
            rows &= usable.sum(axis=1) >= LEAST
            if rows.any():
                filled = np.where(known[:, None], body, 0.0)
                R[rows], t[rows] = robust_align(filled, points[rows], usable[rows])
            grown = bool((rows & ~merged).any())
            merged |= rows
            local = np.einsum("kji,kmj->kmi", R, points - t[:, None])
            new = _median_body(local, seen & merged[:, None])
            grown |= int(np.isfinite(new[:, 0]).sum()) > int(known.sum())
            body = new
            if not grown:
                break
    return Alignment(body, R, t, merged)


def _seed(points: FloatArray, seen: BoolArray) -> int:
    """The fullest pose whose markers lie most nearly as in the other poses that show them."""
    full = np.flatnonzero(seen.sum(axis=1) == seen.sum(axis=1).max())
    distance = np.linalg.norm(points[:, :, None] - points[:, None], axis=3)
    together = seen[:, :, None] & seen[:, None]
    typical = np.array(np.nanmedian(_masked(distance, together), axis=0))
    deviation = [
        float(np.median(np.abs(distance[k] - typical)[together[k] & ~np.eye(seen.shape[1], dtype=bool)]))
        for k in full
    ]
    return int(full[np.argmin(deviation)])


def _masked(values: FloatArray, mask: BoolArray) -> FloatArray:
    """Values with NaN outside the mask; an entry masked everywhere becomes zero."""
    result: FloatArray = np.where(mask | ~mask.any(axis=0), np.where(mask, values, 0.0), np.nan)
    return result


def _median_body(local: FloatArray, seen: BoolArray) -> FloatArray:
    """Median over the poses of each marker's place in the body, NaN where never seen."""
    body = np.full(local.shape[1:], np.nan)
    for j in np.flatnonzero(seen.any(axis=0)):
        body[j] = np.median(local[seen[:, j], j], axis=0)
    return body
