"""The metric of a calibration in other people's files: OpenCV's YAML, URDF, ROS transforms, JSON."""

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np
from scipy.spatial.transform import Rotation

from projservo_cli.calibration.detections import MIN_SIGMA
from projservo_cli.calibration.prediction import predict
from projservo_cli.geometry.displacements import rigid_inverse
from projservo_cli.geometry.lens import distort, undistort
from projservo_cli.image_size import ImageSize, image_sizes
from projservo_cli.metric.frame import Metric, MetricParameters
from projservo_cli.metric.kinematic_errors import KinematicErrors
from projservo_cli.records import VIEWS, Calibration, FloatArray

# Arrays that move along with the cameras.
_MOVED = ("lens", "poses", "axes", "tool", "markers")
# Deviations beyond which the links of a model contradict the known length.
_CONTRADICTED = 4.0
# Relative deviation of a known length that is not given, as by a ruler, and that of an axis by rounding.
_UNMEASURED, _ROUNDING = 0.0025, 1e-9
# Largest distance of a tool or a camera from the base, m.
_FARTHEST = 20.0
# Limits of a URDF joint that no calibration knows: N m or N, and rad/s or m/s.
_EFFORT, _SPEED = 100.0, 1.0


class OpenCV(NamedTuple):
    """Robot and rig whose cameras are OpenCV's, and what that costs."""

    body: MetricParameters  # without lenses
    distortion: FloatArray  # (2, 5) k1, k2, p1, p2, k3
    skew_chi2: float  # increase of the squared residuals over the squared noise, for no skew
    lens_chi2: float  # the same for its lens, all else as it is
    lens_rms_px: float  # difference between both lenses where markers were seen, px

    @property
    def delta_chi2(self) -> float:
        """Increase of the squared residuals over the squared noise, px²/px², at most."""
        return self.skew_chi2 + self.lens_chi2

    def pixels(self, points: FloatArray) -> FloatArray:
        """Pixels (K, 2, 2) of points (K, 3) of the base frame, by view."""
        K, straight = self.body.intrinsics(), self.body.pixels(points)
        distorted = _terms(_normalized(K, straight)) @ self.distortion[:, :, None]
        focal = np.diagonal(K[:, :2, :2], axis1=1, axis2=2)
        return np.asarray(straight + distorted[..., 0].reshape(straight.shape) * focal)


def opencv_cameras(metric: Metric, calibration: Calibration) -> OpenCV:
    """Return the maximum-likelihood robot and rig with cameras without skew, and OpenCV's lens.

    All else moves along by the covariance. The lens is fitted to the calibrated one where markers were seen;
    its two terms of tangential distortion carry it to the principal point.

    calibration : that of the metric; one that kept no detections has a lens fitted over its radius.
    """
    K, of_K = metric.K, metric.deviations("K")
    skew = of_K[..., 1]
    e = -skew @ np.linalg.solve(skew.T @ skew, K[:, 0, 1])  # the maximum-likelihood errors that undo it
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
    coefficients, off = zip(*(_fitted_lens(K[v], lens[v], seen[v]) for v in (0, 1)), strict=True)
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
    """Undistorted pixels (k, 2) of the detections of each view, as predicted; (0, 2) where none are kept."""
    if calibration.corner_q is None or calibration.corner_squares is None or calibration.lens is None:
        return [np.zeros((0, 2))] * 2
    seen = np.isfinite(calibration.corner_squares).swapaxes(0, 1).reshape(2, -1)
    pixels = predict(calibration, calibration.corner_q).swapaxes(0, 1).reshape(2, -1, 2)
    straight = undistort(calibration.lens, np.ascontiguousarray(pixels))
    return [straight[v, seen[v]] for v in (0, 1)]


def _normalized(K: FloatArray, pixels: FloatArray) -> FloatArray:
    """Undistorted pixels (…, 2) in units of the focal lengths from the principal point."""
    return (pixels - K[..., :2, 2]) / np.diagonal(K[..., :2, :2], axis1=-2, axis2=-1)


def _terms(x: FloatArray) -> FloatArray:
    """Shifts (…, 2, 5) of normalized points (…, 2) by a unit of k1, k2, p1, p2, k3, as OpenCV has them."""
    square = (x**2).sum(axis=-1)[..., None]
    radial = [x * square**power for power in (1, 2, 3)]
    product = 2.0 * x[..., :1] * x[..., 1:]
    p1 = np.concatenate([product, square + 2.0 * x[..., 1:] ** 2], axis=-1)
    p2 = np.concatenate([square + 2.0 * x[..., :1] ** 2, product], axis=-1)
    return np.stack([*radial[:2], p1, p2, radial[2]], axis=-1)


def _fitted_lens(K: FloatArray, lens: FloatArray, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Coefficients (5,) of OpenCV's lens nearest to a lens (5,), and squares (k,) of what is left, px².

    pixels : (k, 2) undistorted, at which it is fitted; without any, the disk within the radius of the lens.
    """
    if not lens[3:].any():
        return np.zeros(5), np.zeros(1)
    if not len(pixels):
        disk = np.meshgrid(np.linspace(0.1, 1.0, 10), np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False))
        radius, angle = (part.reshape(-1, 1) for part in disk)
        pixels = lens[:2] + lens[2] * radius * np.hstack([np.cos(angle), np.sin(angle)])
    focal = np.diag(K)[:2]
    A = (_terms(_normalized(K, pixels)) * focal[:, None]).reshape(-1, 5)
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


def opencv_yaml(found: OpenCV, size: ImageSize | None) -> str:
    """Both cameras and the stereo rig for ``cv2.FileStorage``, in the words of OpenCV's calibration samples.

    R and T of a camera map the base frame to it; those of the rig map the left camera to the right one.
    """
    K, poses = found.body.intrinsics(), found.body.camera_poses()
    lines = ["%YAML:1.0", "---", f"delta_chi2: {found.delta_chi2!r}"]
    if size is not None:
        (left, right) = image_sizes(size).astype(int).tolist()
        each = {"": left} if left == right else {"left_": left, "right_": right}
        for name, (width, height) in each.items():
            lines += [f"{name}image_width: {width}", f"{name}image_height: {height}"]
    K[:, 0, 1] = 0.0  # what rounding leaves
    world = rigid_inverse(poses)
    for v, view in enumerate(VIEWS):
        lines += _matrix(f"{view}_camera_matrix", K[v])
        lines += _matrix(f"{view}_distortion_coefficients", found.distortion[v : v + 1])
        lines += _matrix(f"{view}_R", world[v, :3, :3]) + _matrix(f"{view}_T", world[v, :3, 3:])
    stereo = world[1] @ poses[0]
    lines += _matrix("R", stereo[:3, :3]) + _matrix("T", stereo[:3, 3:])
    return "\n".join(lines) + "\n"


def _matrix(name: str, values: FloatArray) -> list[str]:
    numbers = ", ".join(map(repr, values.ravel().tolist()))
    rows, cols = values.shape
    head = [f"{name}: !!opencv-matrix", f"   rows: {rows}", f"   cols: {cols}", "   dt: d"]
    return [*head, f"   data: [{numbers}]"]


def _points(metric: Metric) -> FloatArray:
    """Points (n, 3) of the axes at readings of zero, each the nearest to the one before, m."""
    points, last = [], np.zeros(3)
    for screw, slides in zip(metric.axes, metric.prismatic, strict=True):
        if not slides:
            p = np.cross(screw[:3], screw[3:])
            last = p + screw[:3] * ((last - p) @ screw[:3])
        points.append(last)
    return np.array(points)


def urdf(metric: Metric, names: Sequence[str], limits: FloatArray) -> str:
    """The arm, its tool and both cameras as a URDF, with limits (n, 2) of its joints, rad or m.

    All link frames are parallel to the base at readings of zero.
    """
    places, prismatic = _points(metric), metric.prismatic
    links = ["base_link", *(f"link_{i + 1}" for i in range(len(places))), "tool"]
    links += [f"camera_{view}" for view in VIEWS]
    lines = ['<?xml version="1.0"?>', '<robot name="calibrated">']
    # Masses, which no camera sees, for simulators that ask for some.
    lines += ['  <mujoco><compiler boundmass="0.001" boundinertia="1e-6" fusestatic="false"/></mujoco>']
    lines += [f'  <link name="{link}"/>' for link in links]
    last = np.zeros(3)
    for i, (place, screw) in enumerate(zip(places, metric.axes, strict=True)):
        kind, axis = ("prismatic", screw[3:]) if prismatic[i] else ("revolute", screw[:3])
        axis, (low, high) = axis / np.linalg.norm(axis), limits[i].tolist()
        lines += [
            f'  <joint name={quoteattr(names[i])} type="{kind}">',
            f'    <parent link="{links[i]}"/><child link="{links[i + 1]}"/>',
            f'    <origin xyz="{_numbers(place - last)}" rpy="0 0 0"/><axis xyz="{_numbers(axis)}"/>',
            f'    <limit lower="{low!r}" upper="{high!r}" effort="{_EFFORT}" velocity="{_SPEED}"/>',
            "  </joint>",
        ]
        last = place
    tool = metric.pose(np.zeros(len(places)))
    tool[:3, 3] -= last
    parents = (links[len(places)], "base_link", "base_link")
    for link, parent, T in zip(links[-3:], parents, (tool, *metric.poses), strict=True):
        rpy = Rotation.from_matrix(T[:3, :3]).as_euler("xyz")
        lines += [
            f'  <joint name="{link}_fixed" type="fixed">',
            f'    <parent link="{parent}"/><child link="{link}"/>',
            f'    <origin xyz="{_numbers(T[:3, 3])}" rpy="{_numbers(rpy)}"/>',
            "  </joint>",
        ]
    return "\n".join([*lines, "</robot>"]) + "\n"


def _numbers(values: FloatArray) -> str:
    return " ".join(map(repr, (values + 0.0).tolist()))


def static_transforms(metric: Metric) -> str:
    """A launch file of ROS 2 that publishes where both cameras are in the base frame."""
    lines = ["<launch>"]
    for view, T in zip(VIEWS, metric.poses, strict=True):
        quaternion = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
        values = zip(("x", "y", "z", "qx", "qy", "qz", "qw"), [*T[:3, 3].tolist(), *quaternion], strict=True)
        where = " ".join(f"--{name} {value!r}" for name, value in values)
        frames = f"--frame-id base_link --child-frame-id camera_{view}"
        lines.append(f'  <node pkg="tf2_ros" exec="static_transform_publisher" args="{where} {frames}"/>')
    return "\n".join([*lines, "</launch>"]) + "\n"


def metric_object(metric: Metric) -> dict[str, Any]:
    """All numbers of the metric, with their covariances, for JSON; lengths in m, angles in rad."""
    names = ("K", "lens", "poses", "axes", "markers")
    arrays = {name: getattr(metric, name).tolist() for name in names}
    covariances = {f"{name}_covariance": metric.covariance(name).tolist() for name in names}
    tool = metric.pose(np.zeros(len(metric.joint_types))).tolist()
    return {"joint_types": metric.joint_types, "marker": metric.marker, "tool": tool, **arrays, **covariances}


def to_json(metric: Metric, more: Mapping[str, Any]) -> str:
    """The metric as JSON."""
    return json.dumps({**metric_object(metric), **more}, indent=1, allow_nan=False) + "\n"


def contradictions(metric: Metric, errors: KinematicErrors | None, *, measured: bool) -> Iterator[str]:
    """Yield what contradicts the known length: far cameras, readings of prismatic joints, links of a model.

    measured : whether the deviation of the length is known; otherwise one per cent passes.
    """
    least = _ROUNDING if measured else _UNMEASURED
    of_axes = metric.deviations("axes")
    for i in np.flatnonzero(metric.prismatic):
        v = metric.axes[i, 3:]
        size = float(np.linalg.norm(v))
        std = float(np.linalg.norm(of_axes[:, i, 3:] @ v)) / size
        if abs(size - 1.0) > _CONTRADICTED * np.hypot(std, least):
            yield f"joint {i + 1} moves {size:.4g} ± {std:.1g} m for each m of its readings"
    if errors is not None and abs(errors.length) > _CONTRADICTED * np.hypot(errors.length_std, least):
        wrong = "short" if errors.length > 0.0 else "long"
        share, std = 100.0 * abs(errors.length), 100.0 * errors.length_std
        yield f"the known length is {share:.2g} % ± {std:.1g} % too {wrong} for the links of the model"
    poses = {f"the {view} camera": T for view, T in zip(VIEWS, metric.poses, strict=True)}
    for what, T in {**poses, "the tool at readings of zero": metric.body.tool}.items():
        if (far := float(np.linalg.norm(T[:3, 3]))) > _FARTHEST:
            yield f"{what} is {far:.3g} m from the base, {_FARTHEST:g} m allowed"


def kinematic_words(errors: KinematicErrors, joint_types: str) -> Iterator[str]:
    """Yield what to mend in a model: zeros of joints, then axes, of each the most significant first."""
    zeros = [one for one in errors.joints if one.zero is not None and one.zero_std is not None]
    for one in sorted(zeros, key=lambda one: -abs((one.zero or 0.0) / (one.zero_std or 1.0))):
        scale, unit = (1e3, " mm") if joint_types[one.joint - 1] == "P" else (float(np.degrees(1.0)), "°")
        zero, std = scale * (one.zero or 0.0), scale * (one.zero_std or 0.0)
        summary = f"joint {one.joint}: zero off by {round(zero, 2) + 0.0:+.2f}{unit} ± {std:.2f}{unit}"
        yield summary.replace("-", "\N{MINUS SIGN}")
    for one in sorted(errors.joints, key=lambda one: -one.offset_m / max(one.offset_std_m, 1e-12)):
        yield (
            f"joint {one.joint}: axis off by {1e3 * one.offset_m:.2f} mm ± {1e3 * one.offset_std_m:.2f} mm, "
            f"{np.degrees(one.tilt_rad):.3f}° ± {np.degrees(one.tilt_std_rad):.3f}°"
        )
