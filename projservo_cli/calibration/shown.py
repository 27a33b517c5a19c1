"""What the images show before any geometry: places that differ, off a line, moving as the readings say."""

import numpy as np

from projservo_cli.calibration.chance import chi2_quantile
from projservo_cli.calibration.epipolar import MAD
from projservo_cli.calibration.excitation import LEAST_MOTION, describe_still
from projservo_cli.calibration.quality import LEAST_SIGMA, ON_A_LINE
from projservo_cli.calibration.readings import Readings, joint_trials, reference_pose
from projservo_cli.records import BoolArray, FloatArray, WorkFailed

VIEWS = ("left", "right")
# Least spread of a view's pixels across their main direction, in units of the noise.
LEAST_SPREAD = 5.0
# Ratio of both spreads beyond which pixels lie on a line rather than in one place.
ELONGATED = 10.0
# Share of the sightings that may move more than the rest where the robot stands still: wrong ones.
MOST_WRONG = 0.1
# Quantile of noise beyond which the markers of an image are off their best line.
OFF_LINE = 0.9


def require_images(readings: Readings, sigma_px: float | None) -> None:
    """Refuse images that show one place, one line, or no motion, whatever is to be made of them.

    Parameters
    ----------
    readings : what was seen.
    sigma_px : noise per coordinate as far as it is known, px.

    Raises
    ------
    WorkFailed
        Naming the view, or the joint whose trials show no motion.
    """
    sigma = LEAST_SIGMA if sigma_px is None else max(sigma_px, LEAST_SIGMA)
    _require_spread(readings, sigma)
    _require_motion(readings, sigma)
    _require_no_line(readings, sigma)


def spread(pixels: FloatArray) -> FloatArray:
    """Robust deviations (2,) of pixels (N, 2) along and across their main direction, px.

    The direction comes from the second moment of the unit vectors from the median, so that far
    outliers weigh no more than others. Source: S. Visuri, V. Koivunen, H. Oja, "Sign and rank
    covariance matrices", J. Statistical Planning and Inference 91(2), 2000.
    """
    offset = pixels - np.median(pixels, axis=0)
    length = np.linalg.norm(offset, axis=1, keepdims=True)
    signs = offset / np.where(length > 0.0, length, 1.0)
    axes = np.linalg.eigh(signs.T @ signs)[1][:, ::-1]
    result: FloatArray = np.median(np.abs(offset @ axes), axis=0) / MAD
    return result


def _require_spread(readings: Readings, sigma: float) -> None:
    """Refuse a view that saw nothing, or whose pixels do not spread in two directions."""
    for v, view in enumerate(VIEWS):
        if not readings.seen[v].any():
            raise WorkFailed(f"the {view} camera saw no marker: both must see them")
        along, across = spread(readings.pixels[v][readings.seen[v]])
        if across >= LEAST_SPREAD * sigma:
            continue
        if along > ELONGATED * max(across, sigma):
            raise WorkFailed(
                f"the {view} images show all markers at all poses on one line, within {across:.3g} px: check "
                "the pixel columns, and move the robot and its markers in all directions"
            )
        raise WorkFailed(
            f"the {view} images show no more than noise: their markers spread over {along:.3g} px, "
            f"less than {LEAST_SPREAD:g} times the noise of {sigma:.3g} px; check the pixel columns, and "
            "that the left and right pixels of a row are of one marker at one pose"
        )


def image_path(readings: Readings, poses: BoolArray) -> FloatArray:
    """Length of the path that images take over some poses (K,), each marker and view its own, px².

    A point that moves evenly along a path of length L has the variance L² / 12 about its mean.

    Returns
    -------
    (2, m) twelve times the variance of both coordinates, NaN where seen at fewer than two poses.
    """
    m = readings.marker.size
    result = np.full((2, m), np.nan)
    for v in (0, 1):
        rows = readings.seen[v] & poses[readings.pose_of]
        count = np.bincount(readings.marker_of[rows], minlength=m)
        square = np.zeros(m)
        for coordinate in readings.pixels[v, rows].T:
            mean = np.bincount(readings.marker_of[rows], coordinate, m) / np.maximum(count, 1)
            deviation = coordinate - mean[readings.marker_of[rows]]
            square += np.bincount(readings.marker_of[rows], deviation**2, m)
        result[v, count > 1] = 12.0 * square[count > 1] / (count[count > 1] - 1)
    return result


def _require_motion(readings: Readings, sigma: float) -> None:
    """Refuse images that stand still while the readings move: all of them, or those of a joint's trials."""
    limit = LEAST_MOTION * sigma
    if _farthest(readings) < limit:
        raise WorkFailed(
            f"the images stand still within {limit:.3g} px although the joint readings move: check that the "
            "robot moved, and that images and readings belong together"
        )
    home = reference_pose(readings.q)
    if home is None:
        return
    for i, rows in enumerate(joint_trials(readings.q, home)):
        poses = np.zeros(len(readings.q), dtype=bool)
        poses[[home, *rows]] = True
        square = image_path(readings, poses)
        square = square[np.isfinite(square)]
        # Noise alone has the variance of both coordinates.
        path = np.sqrt(max(float(square.mean()) - 24.0 * sigma**2, 0.0)) if square.size else np.inf
        if path < limit:
            span = float(np.ptp(readings.q[poses, i]))
            raise WorkFailed(describe_still(i, span, bool(readings.prismatic[i]), path, sigma))


def _farthest(readings: Readings) -> float:
    """How far sightings are from the median place of their marker in their view, but for the farthest, px."""
    distances = []
    for v in (0, 1):
        for j in range(readings.marker.size):
            pixels = readings.pixels[v][readings.seen[v] & (readings.marker_of == j)]
            if len(pixels) > 1:
                distances.append(np.linalg.norm(pixels - np.median(pixels, axis=0), axis=1))
    return float(np.quantile(np.concatenate(distances), 1.0 - MOST_WRONG)) if distances else np.inf


def _require_no_line(readings: Readings, sigma: float) -> None:
    """Refuse a body whose markers lie on a line in most images, up to the noise: some are wrong."""
    off = []
    for v in (0, 1):
        for k in np.unique(readings.pose_of[readings.seen[v]]):
            pixels = readings.pixels[v][readings.seen[v] & (readings.pose_of == k)]
            if len(pixels) > 2:
                offset = np.linalg.svd(pixels - pixels.mean(axis=0), compute_uv=False)[1]
                off.append(offset**2 > sigma**2 * chi2_quantile(OFF_LINE, len(pixels) - 2))
    if off and np.mean(off) < 0.5:
        raise WorkFailed(ON_A_LINE)
