"""A calibrated robot and rig with OpenCV's cameras: no skew, and its lens, with the cost of both."""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from projservo_cli.calibration.detections import MIN_SIGMA
from projservo_cli.calibration.prediction import predict
from projservo_cli.geometry.displacements import rigid_inverse
from projservo_cli.geometry.lens import distort, undistort
from projservo_cli.metric.frame import Metric, MetricParameters
from projservo_cli.records import Calibration, FloatArray

# Arrays that move along with the cameras.
_MOVED = ("lens", "poses", "axes", "tool", "markers")


class OpenCV(NamedTuple):
    """Robot and rig whose cameras are OpenCV's, and the loss in accuracy."""

    body: MetricParameters  # without lenses
    distortion: FloatArray  # (V, 5) k1, k2, p1, p2, k3
    skew_chi2: float  # increase of the squared residuals over the squared noise, for no skew
    lens_chi2: float  # the same for its lens, with the rest as it is
    lens_rms_px: float  # difference between both lenses where markers were seen, px

    @property
    def delta_chi2(self) -> float:
        """Increase of the squared residuals over the squared noise, px²/px², at most."""
        return self.skew_chi2 + self.lens_chi2

    def pixels(self, points: FloatArray) -> FloatArray:
        """Pixels (K, V, 2) of points (K, 3) of the frame of the cameras, by view."""
        K, straight = self.body.intrinsics(), self.body.pixels(points)
        distorted = opencv_terms(_normalized(K, straight)) @ self.distortion[:, :, None]
        focal = np.diagonal(K[:, :2, :2], axis1=1, axis2=2)
        return np.asarray(straight + distorted[..., 0].reshape(straight.shape) * focal)


def opencv_cameras(metric: Metric, calibration: Calibration) -> OpenCV:
    """Return the maximum-likelihood robot and rig with cameras without skew, and OpenCV's lens.

    All else moves along by the covariance. The lens is fitted to the calibrated one where markers were seen;
    its two terms of tangential distortion carry it to the principal point.

    calibration : of the metric; one that kept no detections has a lens fitted over its radius.
    """
    K, of_K = metric.K, metric.deviations("K")
    skew = of_K[..., 1]
    e = -np.linalg.pinv(skew.T) @ K[:, 0, 1]  # the maximum-likelihood errors that undo it
    change = {name: np.tensordot(e, metric.deviations(name), 1) for name in _MOVED}
    K[:, (0, 0, 0, 1, 1), (0, 1, 2, 1, 2)] += np.tensordot(e, of_K, 1)
    lens = metric.lens.copy()
    lens[:, 3:] += change["lens"]
    axes, turning = metric.axes + change["axes"], ~metric.prismatic
    w, v = axes[turning, :3], axes[turning, 3:]
    w = w / np.linalg.norm(w, axis=1, keepdims=True)
    axes[turning] = np.concatenate([w, v - w * (w * v).sum(axis=1, keepdims=True)], axis=1)
    rigs = np.array([_shifted(T, by) for T, by in zip(metric.poses, change["poses"], strict=True)])
    tool = _shifted(metric.body.tool, change["tool"][0])
    straight = lens * [1.0, 1.0, 1.0, 0.0, 0.0]
    body = MetricParameters(
        K @ rigid_inverse(rigs)[:, :3], straight, axes, tool, metric.markers + change["markers"]
    )
    seen = _straight_detections(calibration)
    coefficients, off = zip(*(_fitted_lens(K[v], lens[v], seen[v]) for v in range(len(K))), strict=True)
    mean = float(np.concatenate(off).mean())  # px², of a detection
    count = 0.5 * calibration.dof
    return OpenCV(
        body=body,
        distortion=np.array(coefficients),
        skew_chi2=float(e @ e),
        lens_chi2=count * mean / max(metric.sigma_px, MIN_SIGMA) ** 2,
        lens_rms_px=float(np.sqrt(mean)),
    )


def _straight_detections(calibration: Calibration) -> list[FloatArray]:
    """Undistorted pixels (k, 2) of the detections of each view, as predicted; (0, 2) if none are kept."""
    if calibration.corner_q is None or calibration.corner_squares is None or calibration.lens is None:
        return [np.zeros((0, 2))] * len(calibration.P)
    seen = np.isfinite(calibration.corner_squares).swapaxes(0, 1).reshape(len(calibration.P), -1)
    pixels = predict(calibration, calibration.corner_q).swapaxes(0, 1).reshape(len(calibration.P), -1, 2)
    straight = undistort(calibration.lens, np.ascontiguousarray(pixels))
    return [straight[v, seen[v]] for v in range(len(straight))]


def _normalized(K: FloatArray, pixels: FloatArray) -> FloatArray:
    """Undistorted pixels (…, 2) in units of the focal lengths from the principal point."""
    return (pixels - K[..., :2, 2]) / np.diagonal(K[..., :2, :2], axis1=-2, axis2=-1)


def opencv_terms(x: FloatArray) -> FloatArray:
    """Shifts (…, 2, 5) of normalized points (…, 2) by a unit of k1, k2, p1, p2, k3, as OpenCV has them."""
    square = (x**2).sum(axis=-1)[..., None]
    radial = [x * square**power for power in (1, 2, 3)]
    product = 2.0 * x[..., :1] * x[..., 1:]
    p1 = np.concatenate([product, square + 2.0 * x[..., 1:] ** 2], axis=-1)
    p2 = np.concatenate([square + 2.0 * x[..., :1] ** 2, product], axis=-1)
    return np.stack([*radial[:2], p1, p2, radial[2]], axis=-1)


def _fitted_lens(K: FloatArray, lens: FloatArray, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Coefficients (5,) of OpenCV's lens nearest to a lens (5,), and squares (k,) of the residuals, px².

    pixels : (k, 2) undistorted, at which it is fitted; without any, the disk within the radius of the lens.
    """
    if not lens[3:].any():
        return np.zeros(5), np.zeros(1)
    if not len(pixels):
        disk = np.meshgrid(np.linspace(0.1, 1.0, 10), np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False))
        radius, angle = (part.reshape(-1, 1) for part in disk)
        pixels = lens[:2] + lens[2] * radius * np.hstack([np.cos(angle), np.sin(angle)])
    focal = np.diag(K)[:2]
    A = (opencv_terms(_normalized(K, pixels)) * focal[:, None]).reshape(-1, 5)
    target = (distort(lens, pixels) - pixels).ravel()
    scale = np.linalg.norm(A, axis=0)
    found = np.linalg.lstsq(A / scale, target)[0] / scale
    return found, np.square(A @ found - target).reshape(-1, 2).sum(axis=1)


def _shifted(T: FloatArray, change: FloatArray) -> FloatArray:
    """Pose (4, 4) after a rotation vector, rad, and a shift, m, (6,) in the outer frame."""
    moved = T.copy()
    moved[:3, :3] = Rotation.from_rotvec(change[:3]).as_matrix() @ T[:3, :3]
    moved[:3, 3] += change[3:]
    return moved
