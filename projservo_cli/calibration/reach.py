"""How uncertain images are with a joint at its reach, and how far to move it for that to be little."""

import numpy as np

from projservo_cli.calibration.excitation import MOST_REACHES, REACH_M, REACH_RAD, WEAK_NOISE
from projservo_cli.calibration.prediction import marker_pixels, prediction_derivative
from projservo_cli.calibration.readings import Readings
from projservo_cli.records import PRISMATIC, BoolArray, FloatArray, Model

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
