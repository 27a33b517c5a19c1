"""One question of an arm at rest: the change since its calibration, by the frames of one posture."""

from dataclasses import replace

import numpy as np

from projservo_cli.calibration.prediction import predict
from projservo_cli.findings import Finding
from projservo_cli.monitoring.frame_pairs import at_known_markers
from projservo_cli.monitoring.image_monitor import LEAST_MOVED_PX, NAMED_AT, ImageMonitor
from projservo_cli.records import CORNERS, BoolArray, Calibration, FloatArray, IntArray, Observation

# Observations among which one sound one is called faulty by chance.
_SINGLE = 1000


def fault_at_rest(
    calibration: Calibration,
    frames: Observation,
    image_size: FloatArray | None = None,
    *,
    sigma_px: float = 0.0,
    fresh: BoolArray | None = None,
) -> Finding | None:
    """Return the change since the calibration, by frames of an arm at rest; None if there is none.

    Frames are taken in one after the other, as ``servo`` does before the first motion, and then their mean
    is tested. ``doctor``, ``servo``, ``plan``, ``validate`` and ``teach`` ask this question.

    frames : observation of markers that the calibration does not know among others.
    image_size : (V, 2) px, None if unknown.
    sigma_px : pixel noise per coordinate if that is more than the calibration's.
    fresh : (K, V) whether a view has a new frame in each; None all.
    """
    if not calibration.usable:
        return None
    frames = _of_known_markers(calibration, frames)
    sigma_px = max(calibration.sigma_px, calibration.sigma_fitted_px, sigma_px)
    if len(frames.q) == 1:
        return _fault_of_one(calibration, frames, image_size, sigma_px)
    monitor = _monitor_after(calibration, frames, image_size, sigma_px, fresh)
    return monitor.give_up() or fault_of_mean(monitor)


def fault_of_mean(monitor: ImageMonitor) -> Finding | None:
    """Return the fault of a monitor, or that which the mean of its last observations at rest shows."""
    if monitor.fault or monitor.pending or (mean := monitor.mean_at_rest()) is None:
        return monitor.fault
    return _fault_of_one(monitor.calibration, mean, monitor.image_size, monitor.sigma_px)


def _of_known_markers(calibration: Calibration, frames: Observation) -> Observation:
    """Images of the markers of a calibration."""
    images = np.array([at_known_markers(calibration, frames.marker, frame) for frame in frames.images])
    sigma = frames.sigma
    if sigma is not None:
        sigma = np.array([at_known_markers(calibration, frames.marker, frame) for frame in sigma])
    return replace(frames, marker=calibration.marker, images=images, sigma=sigma)


def _monitor_after(
    calibration: Calibration,
    frames: Observation,
    image_size: FloatArray | None,
    sigma_px: float,
    fresh: BoolArray | None = None,
) -> ImageMonitor:
    """Monitor that has taken in all frames."""
    V = len(calibration.P)
    monitor, rest = ImageMonitor(calibration, sigma_px, _SINGLE, image_size=image_size), np.zeros(V)
    for k, (q, images) in enumerate(zip(frames.q, frames.images, strict=True)):
        monitor.observe(
            rest + k,
            np.stack([q] * V),
            np.zeros((V, len(q))),
            rest,
            images,
            np.ones(V, dtype=np.bool_) if fresh is None else fresh[k],
            stated=None if frames.sigma is None else frames.sigma[k],
        )
    return monitor


def _fault_of_one(
    calibration: Calibration, frames: Observation, image_size: FloatArray | None, sigma_px: float
) -> Finding | None:
    """Return the fault in one frame.

    Single tags that are inconsistent by less than ``LEAST_MOVED_PX``, up to half of them, are no change: one
    view of the tool cannot separate a moved tag from a bent or slanted one.
    """
    numbers = calibration.marker

    def fault_of(pixels: FloatArray) -> Finding | None:
        one = replace(frames, images=pixels[None])
        monitor = _monitor_after(calibration, one, image_size, sigma_px)
        if monitor.rejected.any() and not monitor.pending:  # single errors must last
            often = np.zeros(NAMED_AT[-1 if len(pixels) == 1 else 0], dtype=np.int64)
            sigma = None if frames.sigma is None else frames.sigma[often]
            many = replace(frames, q=frames.q[often], images=one.images[often], sigma=sigma)
            monitor = _monitor_after(calibration, many, image_size, sigma_px)
        return monitor.give_up()

    pixels = frames.images[0]
    if (fault := fault_of(pixels)) is None:
        return None
    off, tags = pixels - predict(calibration, frames.q)[0], numbers // CORNERS
    for _ in range(len(np.unique(tags[np.isfinite(off).any(axis=(0, 2))])) // 2):
        tag = _off_alone(off[np.isfinite(off).any(axis=(1, 2))], numbers)
        if not tag.any():
            break
        off, pixels = (np.where(tag[:, None], np.nan, part) for part in (off, pixels))
        if fault_of(pixels) is None:
            return None
    return fault


def _off_alone(off: FloatArray, numbers: IntArray) -> BoolArray:
    """Markers (m,) of the tag that is the farthest off (V, m, 2), px; none if that is far, or most of all.

    Errors of joints move all of them: a tag is compared with the median of the others.
    """
    detected: BoolArray = np.isfinite(off[..., 0])
    tags = numbers // CORNERS
    worst, farthest = np.zeros(len(numbers), dtype=np.bool_), 0.0
    for tag in np.unique(tags):
        of_tag = np.isin(tags, tag)
        own = detected[:, of_tag]
        if (2 * own.sum(axis=1) > detected.sum(axis=1)).any() or not own.any():
            continue
        against = off[:, of_tag] - np.nanmedian(off[:, ~of_tag], axis=1, keepdims=True)
        rms = float(np.sqrt(np.nanmean(np.square(against).sum(axis=-1))))
        if rms > farthest:
            worst, farthest = of_tag, rms
    return worst if farthest < LEAST_MOVED_PX else np.zeros_like(worst)
