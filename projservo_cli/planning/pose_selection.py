"""Selection of the poses whose trial motions would reduce the variance of predictions most."""

from dataclasses import dataclass

import numpy as np

from projservo_cli.calibration.detections import even_choice
from projservo_cli.calibration.prediction import (
    dense_pixel_changes,
    errors_of,
    from_reference,
    parameters_from,
)
from projservo_cli.planning.model_spread import Region, drawn_poses
from projservo_cli.records import (
    Calibration,
    FloatArray,
    InputError,
    Observation,
    WorkFailed,
)

# Poses drawn to choose from, and to judge by; batches before giving up.
_CANDIDATES, _TARGETS = 300, 150
_BATCHES = 20
# Markers that both views must see at a pose that determines the joints.
_LEAST_SEEN = 3
# Markers that suggestions are judged by, at most.
_MOST_SHOWN = 25
# A prediction that errs by more than this share of the image does not say what will be seen.
_VAGUE = 0.02


@dataclass(frozen=True, eq=False)
class Suggestion:
    """A pose to record, in the order of choice."""

    q: FloatArray  # (n,) joint readings, rad or m
    from_pose: int  # number of the nearest pose recorded
    delta: FloatArray  # (n,) the path from it, rad or m
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
    With Λ Λᵀ the covariance, C the derivative of the images of a pose and T that of the targets,
    both times Λ, the pose leaves tr T (I + Cᵀ C / σ²)⁻¹ Tᵀ. Markers count as seen where they are
    predicted within the image; of many markers some stand for all.

    calibration : with its covariance.
    observation : the observations of the calibration.
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
            "use --set calibration.method=bundle_adjustment"
        )
    few = calibration.with_markers(even_choice(len(calibration.M), _MOST_SHOWN))
    sigma = max(calibration.sigma_px, calibration.sigma_fitted_px)
    _, T = _visible_poses(few, targets, _TARGETS, rng)
    q, C = _visible_poses(few, candidates, _CANDIDATES, rng)
    coordinates = np.count_nonzero(T.any(axis=2))
    rows = T.reshape(-1, T.shape[2])
    gram = rows.T @ rows
    C /= sigma
    left = np.ones(len(q), dtype=np.bool_)
    suggestions: list[Suggestion] = []
    for _ in range(min(count, len(q))):
        before = float(np.trace(gram)) / coordinates
        inner = np.eye(C.shape[1]) + C @ np.swapaxes(C, 1, 2)
        gain = np.trace(np.linalg.solve(inner, C @ gram @ np.swapaxes(C, 1, 2)), axis1=1, axis2=2)
        best = int(np.argmax(np.where(left, gain, -np.inf)))
        left[best] = False
        # Λ after the pose: its product with the root of (I + Cᵀ C)⁻¹.
        root = np.linalg.inv(np.linalg.cholesky(np.eye(C.shape[2]) + C[best].T @ C[best])).T
        C, gram = C @ root, root.T @ gram @ root
        after = float(np.trace(gram)) / coordinates
        nearest = int(np.argmin(np.linalg.norm(observation.q - q[best], axis=1)))
        number = int(observation.pose[nearest])
        suggestions.append(
            Suggestion(
                q=q[best],
                from_pose=number,
                delta=q[best] - observation.q[nearest],
                variance_before=before,
                variance_after=after,
            )
        )
    return tuple(suggestions)


def _visible_poses(
    calibration: Calibration, region: Region, count: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Draw random poses (k, n) that show enough markers; with the derivative (k, 4 m, r) of their images.

    Rows of unseen markers are zero.
    """
    scene = parameters_from(calibration)
    poses: list[FloatArray] = []
    rows: list[FloatArray] = []
    for q, in_view in drawn_poses(calibration, region, _BATCHES, rng):
        enough = np.flatnonzero(in_view.all(axis=1).sum(axis=1) >= _LEAST_SEEN)[: count - len(poses)]
        if enough.size:
            J = dense_pixel_changes(scene, errors_of(calibration), from_reference(calibration, q[enough]))
            sharp = np.sqrt((J**2).sum(axis=-1)).max(axis=-1) <= _VAGUE * np.ptp(region.image, axis=1).max()
            in_view = in_view[enough] & sharp
            J[~in_view] = 0.0
            useful = np.flatnonzero(in_view.all(axis=1).sum(axis=1) >= _LEAST_SEEN)
            poses += list(q[enough[useful]])
            rows += list(J.reshape(len(J), -1, J.shape[-1])[useful])
        if len(poses) >= count:
            break
    if not poses:
        raise WorkFailed(
            f"no further pose to suggest: none within the joint ranges shows {_LEAST_SEEN} markers to all "
            "cameras by this calibration; improve it with single-joint trials first"
        )
    return np.array(poses), np.array(rows)
