"""Which further poses would make a calibration predict better: greedy optimum design."""

from dataclasses import dataclass

import numpy as np

from projservo_cli.calibration.prediction import marker_pixels, prediction_derivative
from projservo_cli.calibration.quality import MOST_REACHES, REACH_M, REACH_RAD, WEAK_NOISE
from projservo_cli.calibration.readings import Readings
from projservo_cli.records import (
    PRISMATIC,
    BoolArray,
    Calibration,
    FloatArray,
    InputError,
    Model,
    Observation,
    WorkFailed,
)

# Poses drawn to choose from, and to judge by; draws before giving up, in batches.
CANDIDATES, TARGETS = 300, 150
BATCH, BATCHES = 1500, 20
# Markers that both views must see at a pose for it to tell the joints.
LEAST_SEEN = 3
# A prediction that errs by more than this share of the image does not say what will be seen.
VAGUE = 0.02


@dataclass(frozen=True, eq=False)
class Region:
    """Where poses may lie and markers be seen.

    Attributes
    ----------
    low, high : (n,) joint readings between which candidates are drawn, rad or m.
    image : (2, 2, 2) lower and upper corner of each image, px.
    """

    low: FloatArray
    high: FloatArray
    image: FloatArray


@dataclass(frozen=True, eq=False)
class Suggestion:
    """A pose to record, in the order of choice.

    Attributes
    ----------
    q : (n,) joint readings, rad or m.
    from_pose : number of the nearest pose recorded.
    delta : (n,) the way from it, rad or m.
    variance_before, variance_after : of predicted coordinates over the region of the data, px².
    """

    q: FloatArray
    from_pose: int
    delta: FloatArray
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
    predicted within the image.

    Parameters
    ----------
    calibration : with its covariance.
    observation : what it was made from.
    candidates : region of the poses to choose from.
    targets : region of the poses that are to be predicted well.
    count : poses to suggest.
    rng : draws both.

    Raises
    ------
    InputError
        If the method of the calibration has no covariance.
    WorkFailed
        If no pose of a region shows the markers to both views.
    """
    if not np.isfinite(calibration.covariance).all():
        raise InputError(
            f"suggestions need a covariance, which the method {calibration.method} has not: "
            "use --set calibration.method=refined"
        )
    factor = _factor(calibration.covariance)
    sigma = max(calibration.sigma_px, calibration.sigma_fitted_px)
    _, T = _seen(calibration, targets, TARGETS, factor, rng)
    q, C = _seen(calibration, candidates, CANDIDATES, factor, rng)
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


def _factor(covariance: FloatArray) -> FloatArray:
    """Λ (d, r) with Λ Λᵀ the covariance (d, d), without the directions that have none."""
    spread, basis = np.linalg.eigh(covariance)
    kept = spread > len(spread) * np.finfo(np.float64).eps * spread[-1]
    result: FloatArray = basis[:, kept] * np.sqrt(spread[kept])
    return result


def _seen(
    calibration: Calibration, region: Region, count: int, factor: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Random poses (k, n) that show enough markers, and the derivative (k, 4 m, r) of what they show.

    Rows of what is not seen are zero.
    """
    model, M = calibration.model(), calibration.M
    poses: list[FloatArray] = []
    rows: list[FloatArray] = []
    for _ in range(BATCHES):
        q = rng.uniform(region.low, region.high, (BATCH, len(region.low)))
        seen = _inside(marker_pixels(model, M, q), region.image)
        enough = np.flatnonzero(seen.all(axis=1).sum(axis=1) >= LEAST_SEEN)[: count - len(poses)]
        if enough.size:
            J = prediction_derivative(model, M, q[enough]) @ factor
            sharp = np.sqrt((J**2).sum(axis=-1)).max(axis=-1) <= VAGUE * np.ptp(region.image, axis=1).max()
            seen = seen[enough] & sharp
            J[~seen] = 0.0
            useful = np.flatnonzero(seen.all(axis=1).sum(axis=1) >= LEAST_SEEN)
            poses += list(q[enough[useful]])
            rows += list(J[useful].reshape(len(useful), -1, J.shape[-1]))
        if len(poses) >= count:
            break
    if not poses:
        raise WorkFailed(
            f"no further pose to suggest: none within the joint ranges shows {LEAST_SEEN} markers to both "
            "cameras as far as the calibration can tell; make it better with single-joint trials first"
        )
    return np.array(poses), np.array(rows)


def _inside(pixels: FloatArray, image: FloatArray) -> BoolArray:
    """Which pixels (K, 2, m, 2) lie within the image; none that is NaN, behind the camera, does."""
    inside = (pixels >= image[:, None, 0]) & (pixels <= image[:, None, 1])
    result: BoolArray = np.asarray(inside.all(axis=-1))
    return result


# Frames of the trial motion that is advised; the least range of it, in reaches, and how often the
# logarithm of the range between it and the farthest is halved: to a twentieth.
FRAMES = 8
LEAST_REACHES, HALVINGS = 0.01, 7


def surroundings(readings: Readings) -> FloatArray:
    """Lower and upper corner of twice the image region in which markers were seen, (2, 2, 2) per view."""
    corners = np.empty((2, 2, 2))
    for v in (0, 1):
        seen = readings.pixels[v][readings.seen[v]]
        low, high = seen.min(axis=0), seen.max(axis=0)
        corners[v] = np.array([low - 0.5 * (high - low), high + 0.5 * (high - low)])
    return corners


def _full_reach(model: Model, i: int) -> float:
    """Reach of a joint, rad or m."""
    return REACH_M if model.joint_types[i] == PRISMATIC else REACH_RAD


def _trial(
    model: Model, M: FloatArray, i: int, offsets: FloatArray, around: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Poses (k, n) with one joint at offsets from the reference, and which images (k, 2, m) count."""
    q = np.tile(model.q_reference, (len(offsets), 1))
    q[:, i] += offsets
    pixels = marker_pixels(model, M, q)
    counts = (pixels >= around[:, None, 0]) & (pixels <= around[:, None, 1])
    return q, np.asarray(counts.all(axis=-1))


def reach_spread(model: Model, M: FloatArray, factor: FloatArray, around: FloatArray, i: int) -> FloatArray:
    """Derivative (rows, r) of the coordinates of images with a joint at its reach, to either side.

    Images that leave the surroundings of the data do not count; where all do, the reach is halved.

    Parameters
    ----------
    model : projective robot and rig.
    M : (m, 4) markers at the reference.
    factor : (24 + 16 n + 4 m, r) factor of the covariance at a noise of one pixel.
    around : (2, 2, 2) lower and upper corner of the image region that counts, per view, px.
    i : the joint.
    """
    reach = _full_reach(model, i)
    for _ in range(10):
        q, counts = _trial(model, M, i, np.array([reach, -reach]), around)
        if counts.any():
            break
        reach *= 0.5
    result: FloatArray = prediction_derivative(model, M, q)[counts].reshape(-1, len(factor)) @ factor
    return result


def reach_noise(model: Model, M: FloatArray, factor: FloatArray, around: FloatArray) -> FloatArray:
    """Noise of predicted images (n,) with each joint at its reach, in units of the pixel noise.

    Parameters are those of ``reach_spread``.
    """
    rows = (reach_spread(model, M, factor, around, i) for i in range(len(model.joint_types)))
    return np.array([np.sqrt((T**2).sum() / max(len(T), 1)) for T in rows])


def all_spreads(model: Model, M: FloatArray, factor: FloatArray, around: FloatArray) -> FloatArray:
    """Rows of ``reach_spread`` of all joints."""
    return np.vstack([reach_spread(model, M, factor, around, i) for i in range(len(model.joint_types))])


def needed_spans(
    model: Model, M: FloatArray, factor: FloatArray, around: FloatArray, noise: FloatArray
) -> FloatArray:
    """Range (n,) of a trial motion of each weak joint that would end its weakness, rad or m.

    The trial is of eight frames about the reference, of this joint alone, beside the data there are;
    information adds up. NaN for joints that are not weak or that no trial of sensible range mends.

    Parameters
    ----------
    model, M, factor, around : as for ``reach_spread``.
    noise : (n,) result of ``reach_noise``.
    """
    needed = np.full(len(noise), np.nan)
    for i in np.flatnonzero(noise > WEAK_NOISE):
        T = reach_spread(model, M, factor, around, int(i))
        low, high = (share * _full_reach(model, int(i)) for share in (LEAST_REACHES, MOST_REACHES))
        if _after(model, M, factor, around, int(i), high, T) > WEAK_NOISE:
            continue
        for _ in range(HALVINGS):
            middle = float(np.sqrt(low * high))
            if _after(model, M, factor, around, int(i), middle, T) > WEAK_NOISE:
                low = middle
            else:
                high = middle
        needed[i] = high
    return needed


def _after(
    model: Model, M: FloatArray, factor: FloatArray, around: FloatArray, i: int, span: float, T: FloatArray
) -> float:
    """Noise at the reach after a trial motion over a span: rms of T (I + Cᵀ C)⁻¹ Tᵀ, C the trial's images."""
    q, counts = _trial(model, M, i, np.linspace(-0.5 * span, 0.5 * span, FRAMES), around)
    C = prediction_derivative(model, M, q)[counts].reshape(-1, len(factor)) @ factor
    root = np.asarray(np.linalg.qr(np.vstack([np.eye(C.shape[1]), C]), mode="r"))
    left = np.linalg.solve(root.T, T.T)
    return float(np.sqrt((left**2).sum() / max(len(T), 1)))
