"""The metric of a calibration in other people's files: OpenCV's YAML, URDF, ROS transforms, JSON."""

import json
from collections.abc import Mapping, Sequence
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
from scipy.spatial.transform import Rotation

from projservo_cli.geometry.displacements import rigid_inverse
from projservo_cli.image_size import ImageSize, image_sizes
from projservo_cli.metric.frame import Metric
from projservo_cli.metric.opencv import OpenCV
from projservo_cli.records import NO_CURVE, TOOL, VIEWS, FloatArray, InputError
from projservo_cli.store.camera_files import camera_info

# Limits of a URDF joint that no calibration knows: N m or N, and rad/s or m/s.
_EFFORT, _SPEED = 100.0, 1.0
# Results of ``cv2.calibrateHandEye``, as its documentation names them.
_HAND_EYE = "R_cam2gripper", "t_cam2gripper"
# Links of the base, of the tool with markers, and of the flange with cameras.
_BASE, _TOOL, FLANGE = "base_link", "tool", "flange"


def opencv_yaml(found: OpenCV, size: ImageSize | None, names: Sequence[str], mount: str) -> str:
    """Cameras by their names, and of two the stereo rig, for ``cv2.FileStorage``, in words of its samples.

    R and T of a camera map the base frame to it; R and T of the rig map the first camera to the second.
    Cameras on the tool have their poses in the flange instead, as ``cv2.calibrateHandEye`` returns.
    """
    K, poses = found.body.intrinsics(), found.body.camera_poses()
    lines = ["%YAML:1.0", "---", f"delta_chi2: {found.delta_chi2!r}"]
    if size is not None:
        sizes = image_sizes(size, names).astype(int)
        alike = (sizes == sizes[0]).all()
        each = {"": sizes[0]} if alike else {f"{n}_": one for n, one in zip(names, sizes, strict=True)}
        for name, (width, height) in each.items():
            lines += [f"{name}image_width: {width}", f"{name}image_height: {height}"]
    K[:, 0, 1] = 0.0  # rounding errors
    world = rigid_inverse(poses)
    for v, view in enumerate(names):
        lines += _matrix(f"{view}_camera_matrix", K[v])
        lines += _matrix(f"{view}_distortion_coefficients", found.distortion[v : v + 1])
        (R, T), where = ("RT", world[v]) if mount != TOOL else (_HAND_EYE, poses[v])
        lines += _matrix(f"{view}_{R}", where[:3, :3]) + _matrix(f"{view}_{T}", where[:3, 3:])
    if len(names) == 2:
        stereo = world[1] @ poses[0]
        lines += _matrix("R", stereo[:3, :3]) + _matrix("T", stereo[:3, 3:])
    return "\n".join(lines) + "\n"


def camera_infos(found: OpenCV, size: ImageSize | None, names: Sequence[str]) -> dict[str, str]:
    """Files of the cameras by name for ROS's camera_info_manager, as its calibration writes them.

    size : width and height, px; none are written without it, as ROS needs it.
    """
    if size is None:
        return {}
    K, files = found.body.intrinsics(), {}
    K[:, 0, 1] = 0.0  # rounding errors
    for v, (name, (width, height)) in enumerate(zip(names, image_sizes(size, names), strict=True)):
        size_of = int(width), int(height)
        files[f"{name}_info.yaml"] = camera_info(name, K[v], found.distortion[v], "plumb_bob", size_of)
    return files


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
    """The arm, its tool and the cameras as a URDF, with limits (n, 2) of its joints, rad or m.

    All link frames are parallel to the base at readings of zero. Cameras on the tool are on the flange. By
    poses of the flange this floats in the base, without joints.
    Raises InputError for joints that do not turn as they read.
    """
    _require_ideal(metric, "URDF")
    hand = FLANGE if metric.by_flange or metric.mount == TOOL else _TOOL
    joints = [] if metric.by_flange else [f"link_{i + 1}" for i in range(len(metric.axes))]
    cameras = [f"camera_{view}" for view in metric.view]
    lines = ['<?xml version="1.0"?>', '<robot name="calibrated">']
    # Masses, which no camera sees, for simulators that ask for some.
    lines += ['  <mujoco><compiler boundmass="0.001" boundinertia="1e-6" fusestatic="false"/></mujoco>']
    lines += [f'  <link name="{link}"/>' for link in (_BASE, *joints, hand, *cameras)]
    if metric.by_flange:
        lines += [
            f'  <joint name="{hand}_pose" type="floating">',
            f'    <parent link="{_BASE}"/><child link="{hand}"/>',
            "  </joint>",
        ]
    else:
        lines += _urdf_joints(metric, [_BASE, *joints], hand, names, limits)
    carrier = hand if metric.mount == TOOL else _BASE
    for link, T in zip(cameras, metric.poses, strict=True):
        lines += _fixed(carrier, link, T)
    return "\n".join([*lines, "</robot>"]) + "\n"


def _urdf_joints(
    metric: Metric, links: Sequence[str], hand: str, names: Sequence[str], limits: FloatArray
) -> list[str]:
    """Joints of an arm between links, and what the last of these carries."""
    places, lines, last = _points(metric), list[str](), np.zeros(3)
    for i, (place, screw) in enumerate(zip(places, metric.axes, strict=True)):
        kind, axis = ("prismatic", screw[3:]) if metric.prismatic[i] else ("revolute", screw[:3])
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
    return [*lines, *_fixed(links[-1], hand, tool)]


def _fixed(parent: str, link: str, T: FloatArray) -> list[str]:
    """A fixed joint of a pose (4, 4), m."""
    rpy = Rotation.from_matrix(T[:3, :3]).as_euler("xyz")
    return [
        f'  <joint name="{link}_fixed" type="fixed">',
        f'    <parent link="{parent}"/><child link="{link}"/>',
        f'    <origin xyz="{_numbers(T[:3, 3])}" rpy="{_numbers(rpy)}"/>',
        "  </joint>",
    ]


def _errors_of_place(metric: Metric) -> dict[str, Any]:
    """Map A (3, 3) by which positions of the flange err, p + A (p − c), and c (3,), m; none without."""
    terms = NO_CURVE.terms if metric.curve is None else metric.curve.terms
    if not metric.by_flange or not len(terms) or terms[:, 0].any() or terms[:, 1:3].max() > 2:
        return {}
    A = np.zeros((3, 3))
    A[*terms[:, 1:3].astype(np.int64).T] = terms[:, 3]
    return {"errors_of_place": A.tolist(), "place": metric.pose(metric.q_reference)[:3, 3].tolist()}


def _require_ideal(metric: Metric, kind: str) -> None:
    if metric.curve is not None and not _errors_of_place(metric):
        joints = ", ".join(map(str, np.unique(metric.curve.terms[:, 1].astype(int) + 1)))
        raise InputError(
            f"export: joints {joints} of the calibration turn by a curve of their readings, which a {kind} "
            "file does not hold: take poses from metric.pose in Python, or calibrate without joint_model"
        )


def _numbers(values: FloatArray) -> str:
    return " ".join(map(repr, (values + 0.0).tolist()))


def static_transforms(metric: Metric, flange: str) -> str:
    """A launch file of ROS 2 that publishes where the cameras are in the base frame.

    flange : link that carries cameras on the tool, in whose frame they are.
    """
    carrier = flange if metric.mount == TOOL else _BASE
    lines = ["<launch>"]
    for view, T in zip(metric.view, metric.poses, strict=True):
        quaternion = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
        values = zip(("x", "y", "z", "qx", "qy", "qz", "qw"), [*T[:3, 3].tolist(), *quaternion], strict=True)
        where = " ".join(f"--{name} {value!r}" for name, value in values)
        frames = f"--frame-id {carrier} --child-frame-id camera_{view}"
        lines.append(f'  <node pkg="tf2_ros" exec="static_transform_publisher" args="{where} {frames}"/>')
    return "\n".join([*lines, "</launch>"]) + "\n"


def to_json(metric: Metric, more: Mapping[str, Any]) -> str:
    """All numbers of the metric, with their covariances, as JSON; lengths in m, angles in rad.

    Raises InputError for joints that do not turn as they read.
    """
    _require_ideal(metric, "JSON")
    names = ("K", "lens", "poses", "axes", "markers")
    arrays = {name: getattr(metric, name).tolist() for name in names}
    covariances = {f"{name}_covariance": metric.covariance(name).tolist() for name in names}
    tool = metric.pose(np.zeros(len(metric.joint_types))).tolist()
    about: dict[str, Any] = {"joint_types": metric.joint_types, "marker": metric.marker, "tool": tool}
    if metric.view != VIEWS:
        about["view"] = metric.view
    return (
        json.dumps(
            {**about, **arrays, **covariances, **_errors_of_place(metric), **more}, indent=1, allow_nan=False
        )
        + "\n"
    )
