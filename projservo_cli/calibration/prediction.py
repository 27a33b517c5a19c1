"""What a calibration predicts, how certainly, and which further poses would help."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from projservo_cli.calibration.forward import Images, Scene
from projservo_cli.calibration.readings import even_choice
from projservo_cli.records import (
    BoolArray,
    Calibration,
    Errors,
    FloatArray,
    InputError,
    Observation,
    WorkFailed,
    apart,
)


def scene_of(calibration: Calibration) -> Scene:
    """The scene of a record."""
    c = calibration
    return Scene(c.P, c.H_hat_0, c.prismatic, c.M, c.lens)


def _scene(calibration: Calibration, q: FloatArray) -> tuple[Scene, FloatArray]:
    """The scene of a record, and joint values (K, n) from its reference after a check of the readings."""
    q = np.asarray(q, dtype=np.float64)
    n = len(calibration.H_hat_0)
    if q.ndim != 2 or q.shape[1] != n:
        raise InputError(f"joint readings of shape {q.shape}: expected one row of {n} a pose")
    if not np.isfinite(q).all():
        raise InputError("joint readings must be finite numbers")
    return scene_of(calibration), q - calibration.q_reference


def predict(calibration: Calibration, q: FloatArray) -> FloatArray:
    """Pixels of all markers in both views at joint readings, [RH00] eqs. (1), (6).

    Parameters
    ----------
    calibration : projective kinematics.
    q : (K, n) joint readings, rad or m.

    Returns
    -------
    (K, 2, m, 2) pixels, markers in the order of ``calibration.marker``; NaN for a point that does
    not lie in front of the camera, or beyond where its lens distortion turns back.

    Raises
    ------
    InputError
        If the readings have another number of joints or are not finite.
    """
    scene, q = _scene(calibration, q)
    return scene.seen(q)


def residual_statistics(calibration: Calibration, observation: Observation) -> dict[str, Any]:
    """How far predicted pixels are from seen ones, a distance for each marker and view.

    calibration : projective kinematics; observation : stereo images of the same robot, px; those in motion do
    not count.
    Returns ``count``; ``rms_px``, ``median_px``, ``p95_px`` (None without a pair); ``skipped`` with the
    pairs; of markers the calibration does not know, of points behind the camera, and not seen. Raises
    InputError if the readings have another number of joints or are not finite.
    """
    observation = observation.at_rest
    known = np.isin(observation.marker, calibration.marker)
    numbers = calibration.marker.tolist()
    order = [numbers.index(number) for number in observation.marker[known].tolist()]
    pixels = predict(calibration, observation.q)[:, :, order]
    seen: BoolArray = np.asarray(np.isfinite(observation.images).all(axis=-1))
    ahead = np.isfinite(pixels[..., 0])
    residual = (pixels - observation.images[:, :, known])[seen[:, :, known] & ahead]
    return distance_statistics(np.linalg.norm(residual, axis=1)) | {
        "skipped": {
            "unknown_marker": int(seen[:, :, ~known].sum()),
            "behind_camera": int((seen[:, :, known] & ~ahead).sum()),
            "missing": int((~seen).sum()),
        }
    }


def distance_statistics(distance: FloatArray) -> dict[str, Any]:
    """``count``, ``rms_px``, ``median_px``, ``p95_px`` of distances (L,), the last three None without one."""
    some = distance.size > 0
    return {
        "count": int(distance.size),
        "rms_px": float(np.sqrt(np.mean(distance**2))) if some else None,
        "median_px": float(np.median(distance)) if some else None,
        "p95_px": float(np.percentile(distance, 95)) if some else None,
    }


def prediction_variance(calibration: Calibration, q: FloatArray) -> FloatArray:
    """Variance of predicted pixels from the covariance of the calibration, to first order.

    calibration : projective kinematics with its covariance; q : (K, n) joint readings, rad or m.
    Returns (K, 2, m, 2) variances of u and v, px². Raises InputError if the readings have another number of
    joints or are not finite.
    """
    scene, q = _scene(calibration, q)
    result = np.empty((len(q), 2, len(scene.M), 2))
    for k in range(len(q)):  # a pose at a time, which bounds what is in memory
        common, own = changed(scene, calibration.errors, q[k : k + 1])
        result[k] = ((common**2).sum(axis=-1) + (own**2).sum(axis=-1))[0]
    return result


def changed(
    scene: Scene, errors: Errors, q: FloatArray, images: Images | None = None
) -> tuple[FloatArray, FloatArray]:
    """Change of all pixels (K, 2, m, 2, r) and (K, 2, m, 2, 3) by ``errors``, joints from the reference."""
    shared, by_marker = scene.derivative(q, images)
    return shared @ errors.shared + by_marker @ errors.marker, by_marker @ errors.own


def all_changed(scene: Scene, errors: Errors, q: FloatArray, images: Images | None = None) -> FloatArray:
    """Change of all pixels by all ``errors``, (K, 2, m, 2, r + 3 m): for few markers."""
    m = len(scene.M)
    return apart(*changed(scene, errors, q, images), np.arange(m)[:, None], m)


def error_factor(calibration: Calibration) -> FloatArray:
    """Factor (24 + 16 n + 4 m, r + 3 m) of the covariance of P, H_hat_0, lenses, M: for few markers.

    Gauge fixed: of all errors that change images alike the least. Four rows more before M with lenses.
    """
    factor, free = calibration.errors.dense(), scene_of(calibration).gauge()
    return np.asarray(factor - free @ (free.T @ factor))


def joint_derivative(calibration: Calibration, q: FloatArray) -> FloatArray:
    """Derivative (K, 2, m, 2, n) of predicted pixels by joints (K, n), px per rad or m."""
    scene, q = _scene(calibration, q)
    J = scene.everywhere(q).by_joint(scene.H_hat)
    return np.asarray(J.reshape(2, len(q), len(scene.M), *J.shape[2:]).swapaxes(0, 1))


# Poses drawn to choose from, and to judge by; draws before giving up, in batches.
_CANDIDATES, _TARGETS = 300, 150
_BATCH, _BATCHES = 1500, 20
# Markers that both views must see at a pose for it to tell the joints.
_LEAST_SEEN = 3
# Markers that suggestions are judged by, at most.
_MOST_SHOWN = 25
# A prediction that errs by more than this share of the image does not say what will be seen.
_VAGUE = 0.02


@dataclass(frozen=True, eq=False)
class Region:
    """Where poses may lie and markers be seen."""

    low: FloatArray
    high: FloatArray  # low, high: (n,) joint readings between which candidates are drawn, rad or m
    image: FloatArray  # (2, 2, 2) lower and upper corner of each image, px


@dataclass(frozen=True, eq=False)
class Suggestion:
    """A pose to record, in the order of choice."""

    q: FloatArray  # (n,) joint readings, rad or m
    from_pose: int  # number of the nearest pose recorded
    delta: FloatArray  # (n,) the way from it, rad or m
    # variance_before, variance_after: of predicted coordinates over the region of the data, px²
    variance_before: float
    variance_after: float


def suggest(
    calibration: Calibration,
    observation: Observation,
    candidates: Region,
    targets: Region,
    count: int,
    rng: np.random.Generator,
) -> tuple[Suggestion, ...]:
    """Poses that reduce the mean variance of predictions most, one after the other.

    V-optimality, the mean variance over a region, taken greedily over random candidates: A. C.
    Atkinson, A. N. Donev, R. D. Tobias, "Optimum Experimental Designs, with SAS", 2007, chapter 10.
    With Λ Λᵀ the covariance, C the derivative of what a pose would show and T that of the targets,
    both times Λ, the pose leaves tr T (I + Cᵀ C / σ²)⁻¹ Tᵀ. Markers count as seen where they are
    predicted within the image; of many markers some stand for all.

    calibration : with its covariance.
    observation : what it was made from.
    candidates : region of the poses to choose from.
    targets : region of the poses that are to be predicted well.
    count : poses to suggest.
    rng : draws both.
    Raises InputError if the method of the calibration has no covariance; WorkFailed if no pose of a region
    shows the markers to both views.
    """
    if not calibration.has_covariance:
        raise InputError(
            f"suggestions need a covariance, which the method {calibration.method} has not: "
            "use --set calibration.method=refined"
        )
    few = calibration.with_markers(even_choice(len(calibration.M), _MOST_SHOWN))
    sigma = max(calibration.sigma_px, calibration.sigma_fitted_px)
    _, T = _shown(few, targets, _TARGETS, rng)
    q, C = _shown(few, candidates, _CANDIDATES, rng)
    coordinates = np.count_nonzero(T.any(axis=2))
    rows = T.reshape(-1, T.shape[2])
    gram = rows.T @ rows
    C /= sigma
    left = np.ones(len(q), dtype=np.bool_)
    found: list[Suggestion] = []
    for _ in range(min(count, len(q))):
        before = float(np.trace(gram)) / coordinates
        inner = np.eye(C.shape[1]) + C @ np.swapaxes(C, 1, 2)
        gain = np.trace(np.linalg.solve(inner, C @ gram @ np.swapaxes(C, 1, 2)), axis1=1, axis2=2)
        best = int(np.argmax(np.where(left, gain, -np.inf)))
        left[best] = False
        # What is left of Λ after the pose: its product with the root of (I + Cᵀ C)⁻¹.
        root = np.linalg.inv(np.linalg.cholesky(np.eye(C.shape[2]) + C[best].T @ C[best])).T
        C, gram = C @ root, root.T @ gram @ root
        after = float(np.trace(gram)) / coordinates
        nearest = int(np.argmin(np.linalg.norm(observation.q - q[best], axis=1)))
        number = int(observation.pose[nearest])
        found.append(Suggestion(q[best], number, q[best] - observation.q[nearest], before, after))
    return tuple(found)


def _shown(
    calibration: Calibration, region: Region, count: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Random poses (k, n) that show enough markers, and the derivative (k, 4 m, r) of what they show.

    Rows of what is not seen are zero.
    """
    scene = scene_of(calibration)
    poses: list[FloatArray] = []
    rows: list[FloatArray] = []
    for q, seen in drawn(calibration, region, _BATCHES, rng):
        enough = np.flatnonzero(seen.all(axis=1).sum(axis=1) >= _LEAST_SEEN)[: count - len(poses)]
        if enough.size:
            J = all_changed(scene, calibration.errors, q[enough] - calibration.q_reference)
            sharp = np.sqrt((J**2).sum(axis=-1)).max(axis=-1) <= _VAGUE * np.ptp(region.image, axis=1).max()
            seen = seen[enough] & sharp
            J[~seen] = 0.0
            useful = np.flatnonzero(seen.all(axis=1).sum(axis=1) >= _LEAST_SEEN)
            poses += list(q[enough[useful]])
            rows += list(J.reshape(len(J), -1, J.shape[-1])[useful])
        if len(poses) >= count:
            break
    if not poses:
        raise WorkFailed(
            f"no further pose to suggest: none within the joint ranges shows {_LEAST_SEEN} markers to both "
            "cameras as far as the calibration can tell; make it better with single-joint trials first"
        )
    return np.array(poses), np.array(rows)


def drawn(
    calibration: Calibration, region: Region, batches: int, rng: np.random.Generator
) -> Iterator[tuple[FloatArray, BoolArray]]:
    """Batches of random poses (k, n) of a region, and which images (k, 2, m) lie within it."""
    scene, (low, high) = scene_of(calibration), region.image.swapaxes(0, 1)[:, :, None]
    for _ in range(batches):
        q = rng.uniform(region.low, region.high, (_BATCH, len(region.low)))
        pixels = scene.seen(q - calibration.q_reference)
        yield q, ((pixels >= low) & (pixels <= high)).all(axis=-1)  # none that is NaN, behind the camera
