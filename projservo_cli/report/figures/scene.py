"""Fig. 3 of [RH00], robot, rig and face; and arm, cameras and the tool's uncertainty to scale, in metres."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import combinations
from typing import Any

import numpy as np
from scipy.special import chdtri

from projservo_cli.geometry.displacements import homogeneous, twists
from projservo_cli.geometry.kinematics import forward_kinematics, joint_operators
from projservo_cli.geometry.lens import undistort
from projservo_cli.image_size import image_corners
from projservo_cli.metric.frame import Metric, links
from projservo_cli.records import MM, TOOL, BoolArray, FloatArray, Trace, WorkFailed
from projservo_cli.report import style
from projservo_cli.report.figure_inputs import Data, Fit, ReportData, registered
from projservo_cli.simulation.analytic_plant import Plant
from projservo_cli.simulation.arm import SerialArm, camera_center, roll_axis
from projservo_cli.task.face import center_of

_PYRAMID = 0.16  # length of the drawn viewing pyramids, as a share of the distance to the face
_ROBOT = style.line(style.BLACK, width=2.0, marker="o", markersize=4)
_GOAL = style.line(style.PURPLE, (0, (3, 1)), 1.6, label="face at the goal")  # blue is the first camera
_RIG_AT_GOAL = style.line(style.PURPLE, width=0.8, label="cameras at the goal")
_FEATURES: style.LineStyle = {"linewidth": 1.4, "marker": ".", "markersize": 5}
# Lines of the scene by their names in the data, the lowest first.
_LINES = {
    "roll_axis": style.line(style.GREEN, style.DASH_DOTTED, 0.9, label="roll axis of the rig"),
    "robot_goal": style.line(
        style.PURPLE, width=1.2, marker="o", markersize=3, label="robot at the goal", alpha=0.6
    ),
    "robot": _ROBOT | {"label": "robot at the start"},
    "line": style.line(style.GREY, style.DOTTED, label="straight line of the centre"),
    "features_start": style.line(style.BLACK, label="features of the tool") | _FEATURES,
    "features_scene": style.line(style.PURPLE, label="features of the scene") | _FEATURES,
}


def _data(report_data: ReportData) -> Data:
    """Joints, faces and cameras in metres; the robot at the start as a polyline through its axes."""
    plant, robot, q_goal = report_data.plant, report_data.robot, report_data.plan.q[-1]
    polyline, start, of_rig = drawn_arm(robot, plant, report_data.plan.q_start)
    face = plant.M[plant.order]
    result: Data = {"robot": polyline, "face_start": (face @ start.T)[:, :3]}
    rig = plant_pyramids(plant, result["face_start"])
    visible = transformed(rig, of_rig)
    result |= {"cameras": visible[:, 0], "pyramids": visible, "view": np.array(report_data.view)}
    with suppress(WorkFailed):  # cameras all around have none
        # From the middle of the rig to where it passes the face, which a task rolls about it.
        point, direction = roll_axis(plant.model.P @ np.linalg.inv(of_rig))
        far = float((result["face_start"].mean(axis=0) - point) @ direction)
        result["roll_axis"] = np.stack([point, point + 1.1 * far * direction])
    if np.isfinite(q_goal).all():
        result["robot_goal"], _, of_rig = drawn_arm(robot, plant, q_goal)
        if plant.model.on_tool:
            result["pyramids_goal"] = transformed(rig, of_rig)
    if plant.model.on_tool:  # the face is fixed
        return result
    if (goal := goal_displacement(robot, report_data.traces)) is not None:
        result["face_goal"] = (face @ goal.T)[:, :3]
        centers = [center_of(plant.M @ H.T, plant.center)[:3] for H in (start, goal)]
        result["line"] = np.array(centers)
    if (spanned := features_in_space(plant, report_data.traces)) is not None:
        result["features_start"], result["features_scene"] = map(style.outlines, spanned)
    return result


def drawn_arm(robot: SerialArm, plant: Plant, q: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Polyline (k, 3) of the robot at joints q (n,), m, and displacements of the face and of the cameras.

    From the reference one of both has moved with the tool: in the base frame the other is fixed.
    """
    arm = robot.model(plant.model.P)
    moved, still = forward_kinematics(arm, q), np.eye(4)
    tool = (moved @ robot.base_tool)[:3, 3]
    polyline = _skeleton(joint_operators(arm, q), robot.prismatic, tool)
    return polyline, *((still, moved) if plant.model.on_tool else (moved, still))


def transformed(points: FloatArray, H: FloatArray) -> FloatArray:
    """Points (…, 3) after a displacement (4, 4)."""
    return points @ H[:3, :3].T + H[:3, 3]


def goal_displacement(robot: SerialArm, traces: Mapping[str, Trace]) -> FloatArray | None:
    """Displacement (4, 4) of the tool from the reference to the goal; None if only images are known."""
    poses = (trace.goal_pose for trace in traces.values() if np.isfinite(trace.goal_pose).all())
    pose = next(poses, None)
    return None if pose is None else np.asarray(pose @ np.linalg.inv(robot.base_tool))


def features_in_space(plant: Plant, traces: Mapping[str, Trace]) -> tuple[FloatArray, FloatArray] | None:
    """Points (g, 3, 3) that span features of the tool at the start and of the scene, m, NaN beyond.

    They are where the true cameras see the measured features; None for a whole pose, by one camera, and of
    cameras that move.
    """
    of_incidences_first = next(
        (found for trace in traces.values() if (found := trace.of_incidences) is not None), None
    )
    if of_incidences_first is None or len(plant.model.P) < 2 or plant.model.on_tool:
        return None
    pixels = np.stack([of_incidences_first.feature_s[0], of_incidences_first.feature_s_star])
    straight = undistort(plant.model.lens, np.moveaxis(pixels, -2, 0).reshape(len(plant.model.P), -1, 2))
    points = np.full((straight.shape[1], 3), np.nan)
    for k in np.flatnonzero(np.isfinite(straight).all(axis=(0, 2))):
        rows = straight[:, k, :, None] * plant.model.P[:, 2:] - plant.model.P[:, :2]
        points[k] = np.linalg.lstsq(rows[..., :3].reshape(-1, 3), -rows[..., 3].ravel())[0]
    tool, scene = points.reshape(*pixels.shape[:3], 3)
    return tool, scene


def _skeleton(H_hat: FloatArray, prismatic: BoolArray, tool: FloatArray) -> FloatArray:
    """Points (k, 3) of a polyline from the base over all revolute axes to the tool, m.

    From each point the perpendicular is dropped onto the next axis, known by the metric operators
    (n, 4, 4) at the current joints; a prismatic joint has a direction but no place.
    """
    points = [np.zeros(3)]
    for operator, slides in zip(H_hat, prismatic, strict=True):
        if slides:
            continue
        w = np.array([operator[2, 1], operator[0, 2], operator[1, 0]])
        on_axis = np.cross(w, operator[:3, 3]) / (w @ w)
        points.append(on_axis + w * (w @ (points[-1] - on_axis)) / (w @ w))
    return np.array([*points, tool])


def plant_pyramids(plant: Plant, face: FloatArray) -> FloatArray:
    """Pyramids (V, 5, 3) of the whole images of a plant, by ``_pyramids``."""
    return _pyramids(plant.model.P, _rectangle(*np.moveaxis(image_corners(plant.image_size), -2, 0)), face)


def _pyramids(P: FloatArray, corners: FloatArray, face: FloatArray) -> FloatArray:
    """Optical centre and image corners (V, 5, 3) of metric cameras P (V, 3, 4), m.

    corners : (V, 4, 2) pixels. They are drawn at a depth in front of the camera that goes by the distance of
    a face (m, 3).
    """
    centers = np.stack([camera_center(camera) for camera in P])[:, None]
    depth = _PYRAMID * float(np.linalg.norm(face.mean(axis=0) - centers.mean(axis=0)))
    scale = np.linalg.norm(P[:, 2, :3], axis=1) * np.sign(np.linalg.det(P[:, :, :3]))
    rays = np.linalg.solve(P[:, :, :3], homogeneous(corners).swapaxes(1, 2)).swapaxes(1, 2)
    return np.concatenate([centers, centers + depth * rays * scale[:, None, None]], axis=1)


def _rectangle(low: FloatArray, high: FloatArray) -> FloatArray:
    """Corners (V, 4, 2) of the images of the views between pixels low and high (V, 2)."""
    share = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    return np.asarray(low[:, None] + share * (high - low)[:, None])


@registered(
    "fig03_scene",
    "Robot, stereo rig, and the face at the start and at the goal",
    "Fig. 3, section 6",
    _data,
    height=4.4,
    alt="The robot's arm at the start and at the goal in three dimensions, the cameras and their roll axis, "
    "the face at the start and at the goal, and the straight line of its centre between them.",
)
def _draw(data: Data, figure: "style.Figure") -> None:
    """One view in perspective with equal scales."""
    lines = [(data[name], line) for name, line in _LINES.items() if name in data]
    lines += [(edges_of(camera), _RIG_AT_GOAL) for camera in data.get("pyramids_goal", ())]
    label = "face" if "pyramids_goal" in data else "face at the start"  # before cameras on the tool it stays
    lines.append((style.closed(data["face_start"]), style.START | {"label": label}))
    if "face_goal" in data:
        lines.append((style.closed(data["face_goal"]), _GOAL))
    _show(figure, data, lines)


def edges_of(pyramid: FloatArray) -> FloatArray:
    """One line (k, 3) along all edges of the pyramid (5, 3) of a camera."""
    apex, corners = pyramid[:1], style.closed(pyramid[1:])
    return np.concatenate([np.concatenate([corner[None], apex, corner[None]]) for corner in corners])


def _show(figure: "style.Figure", data: Data, lines: Sequence[tuple[FloatArray, style.LineStyle]]) -> None:
    """Show the cameras and lines (k, 3), which NaN divides, with equal scales, from the side of the rig."""
    from matplotlib.ticker import MultipleLocator

    axes: Any = figure.add_axes((0, 0, 1, 1), projection="3d", proj_type="persp", focal_length=0.9)
    axes.patch.set_visible(False)
    axes.computed_zorder = False
    rig = data["pyramids"]
    for camera, line in zip(rig, style.view_lines(data["view"]), strict=True):
        axes.plot(*edges_of(camera).T, **line | {"linestyle": style.SOLID, "linewidth": 1.0})
    for points, line in lines:
        axes.plot(*points.T, **line)
    points = np.concatenate([rig.reshape(-1, 3), *(points for points, _ in lines)])
    points = points[np.isfinite(points).all(axis=1)]
    low, high = points.min(axis=0), points.max(axis=0)
    longest = (high - low).max()
    # Room for the numbers of each axis.
    half = np.maximum(0.5 * (high - low) + 0.05 * longest, 0.15 * longest)
    extent = 0.5 * (low + high)[:, None] + np.outer(half, [-1.0, 1.0])
    for name, (a, b) in zip("xyz", extent, strict=True):
        getattr(axes, f"set_{name}lim")(a, b)
        getattr(axes, f"set_{name}label")(f"{name} (m)", labelpad=1 if name == "z" else 14)
        steps = (step for step, upper in ((0.1, 0.4), (0.25, 0.75), (0.5, 5.0)) if b - a < upper)
        step = next(steps, 0.2 / style.magnification(b - a, 1.0))
        getattr(axes, f"{name}axis").set_major_locator(MultipleLocator(step))
    axes.tick_params(pad=0)
    towards = rig[:, 0].mean(axis=0) - points.mean(axis=0)
    above = np.linalg.norm(towards[:2]) < 0.3 * np.linalg.norm(towards)  # a rig that looks along z
    azim = 45.0 if above else float(np.degrees(np.arctan2(towards[1], towards[0]))) - 62.0
    if above:  # its numbers are on the left, and would overlap the axis
        axes.zaxis.set_tick_params(pad=12)
        axes.zaxis.labelpad = 18
    axes.view_init(elev=22, azim=azim)
    figure.set_layout_engine()
    style.legend_below(figure, 3)
    _fit(axes, figure, extent)


def _fit(axes: Any, figure: "style.Figure", extent: FloatArray) -> None:
    """Show the scene as large as its labels and the room above the legend allow."""
    corners = np.array([*np.array(np.meshgrid(*extent)).reshape(3, -1), np.ones(8)])
    size = np.ptp(extent, axis=1)
    side = np.array([1.0, figure.get_figwidth() / figure.get_figheight()])  # a square
    zoom, middle = 1.0, np.array([0.5, 0.5])
    for _ in range(2):
        axes.set_position((*(middle - 0.5 * side), *side))
        axes.set_box_aspect(size, zoom=zoom)
        figure.draw_without_rendering()
        m = axes.get_proj() @ corners
        visible = axes.transData.transform((m[:2] / m[3]).T)
        labels = [axis.get_tightbbox().get_points() for axis in (axes.xaxis, axes.yaxis, axes.zaxis)]
        taken = np.concatenate([visible, *labels])
        low = np.array([0.0, figure.legends[0].get_window_extent().y1])
        room = figure.bbox.get_points()[1] - low
        zoom *= 0.95 * float((room / np.ptp(taken, axis=0)).min())
        off = low + 0.5 * room - 0.5 * (taken.min(axis=0) + taken.max(axis=0))
        middle += off / figure.bbox.size
    axes.set_box_aspect(size, zoom=zoom)
    axes.set_position((*(middle - 0.5 * side), *side))


_POSES, _REGION = 5, 0.95
# Radius of a region, mm, below which the tool is where its readings put it.
_KNOWN_MM = 1e-6
_ELLIPSOID_SIZE = 0.05  # size of the ellipsoids as they are drawn, over the distance of the tools
_ELLIPSOID = style.line(style.VERMILION, width=0.8)


def chosen_poses(metric: Metric, fit: Fit) -> FloatArray:
    """Five readings (5, n) of those in the data: nearest to the reference, then the farthest tools."""
    q = fit.observation.q
    positions = metric.pose(q)[:, :3, 3]
    chosen = [int(np.argmin(np.abs(q - fit.calibration.q_reference).sum(axis=1)))]
    while len(chosen) < min(_POSES, len(q)):
        away = np.linalg.norm(positions[:, None] - positions[chosen], axis=2).min(axis=1)
        chosen.append(int(np.argmax(away)))
    return q[chosen]


def metric_rows(metric: Metric, q: FloatArray) -> Iterator[dict[str, Any]]:
    """Yield quantities in metres with their standard deviations; the tool at readings q (k, n)."""
    of_K, of_poses, centers = metric.deviations("K"), metric.deviations("poses"), metric.poses[:, :3, 3]
    for v, view in enumerate(metric.view):
        K = metric.K[v]
        yield _row(f"{view} camera, focal lengths", K[(0, 1), (0, 1)], of_K[:, v][:, [0, 3]], "px")
        yield _row(f"{view} camera, principal point", K[:2, 2], of_K[:, v][:, [2, 4]], "px")
        yield _row(
            f"{view} camera, position in the {metric.carrier} frame",
            MM * centers[v],
            MM * of_poses[:, v, 3:],
            "mm",
        )
    for u, v in combinations(range(len(centers)), 2):
        apart = centers[v] - centers[u]
        distance = np.asarray(np.linalg.norm(apart))
        between = (of_poses[:, v, 3:] - of_poses[:, u, 3:]) @ (apart / distance)
        pair = f", {metric.view[u]} and {metric.view[v]}" if len(centers) > 2 else ""
        yield _row(f"distance of the cameras{pair}", MM * distance, MM * between[:, None], "mm")
    axes, prismatic = metric.axes, metric.prismatic
    angle, length = links(axes, prismatic, axes)
    changes = metric.changes(lambda body: np.stack(links(body.axes, prismatic, axes), axis=-1))
    for i in range(len(angle)):
        name = f"joint {i + 2}, axis from that of joint {i + 1}"
        yield _row(f"{name}, angle", np.degrees(angle[i]), np.degrees(changes[:, i, :1]), "°")
        if np.isfinite(length[i]):
            yield _row(f"{name}, distance", MM * length[i], MM * changes[:, i, 1:], "mm")
    of_tools = metric.point_changes(q, np.zeros(3))
    for k, T in enumerate(metric.pose(q)):
        yield _row(f"tool at pose {k + 1}", MM * T[:3, 3], MM * of_tools[:, k], "mm")


def _row(quantity: str, value: FloatArray, changes: FloatArray, unit: str) -> dict[str, Any]:
    """Plain values of a quantity (d,) and its deviation, by its changes (c, d) by independent errors."""
    return {
        "quantity": quantity,
        "value": np.atleast_1d(value).tolist(),
        "deviation": np.linalg.norm(np.atleast_2d(changes), axis=0).tolist(),
        "unit": unit,
    }


def _data_metric(report_data: Fit) -> Data:
    """Arm at the first of five poses, cameras, and 95 % regions of the tool at all of them, m."""
    metric = report_data.metric
    assert metric is not None
    q = chosen_poses(metric, report_data)
    tools = metric.pose(q)[:, :3, 3]
    arm = report_data.calibration.model()._replace(
        H_hat_0=twists(metric.axes), q_reference=np.zeros(q.shape[1]), on_tool=False
    )
    seen, pixels = metric.markers if metric.mount == TOOL else tools, report_data.observation.images
    low, high = np.nanmin(pixels, axis=(0, 2)), np.nanmax(pixels, axis=(0, 2))
    spread, axes = np.linalg.eigh(metric.pose_covariance(q)[:, 3:, 3:])
    radius = np.sqrt(chdtri(3, 1.0 - _REGION) * np.maximum(spread, 0.0))
    semi_axes = axes.swapaxes(1, 2) * radius[..., None]
    extent = float(np.ptp(tools, axis=0).max()) + float(np.linalg.norm(tools.mean(axis=0)))
    return {
        "q": q,
        "tool": tools,
        "position_std_mm": metric.position_std(q),
        "semi_axes": semi_axes,
        "factor": np.array(style.magnification(float(radius.max()), _ELLIPSOID_SIZE * extent)),
        "robot": _skeleton(joint_operators(arm, q[0]), arm.prismatic, tools[0]),
        "pyramids": _pyramids(metric.cameras(q[0]), _rectangle(low, high), seen),
        "view": np.array(metric.view),
    }


@registered(
    "fig18_metric",
    "Arm, cameras and the tool's uncertainty, to scale",
    "not in the paper",
    _data_metric,
    height=4.4,
    task=False,
    metric=True,
    alt="The arm at one pose in three dimensions, the cameras with pyramids over the pixels in which "
    "markers were seen, and ellipsoids of the tool's position at five poses, magnified.",
)
def _draw_metric(data: Data, figure: "style.Figure") -> None:
    """One view in perspective; regions as three ellipses each."""
    largest = MM * float(np.linalg.norm(data["semi_axes"], axis=2).max())
    region = f"95 % region of the tool, {float(data['factor']):,g} times (at most {largest:.3g} mm)"
    angle = np.linspace(0.0, 2.0 * np.pi, 61)[:, None]
    lines = [(data["robot"], _ROBOT | {"label": "arm at one pose"})]
    known = largest < _KNOWN_MM  # by poses of the flange
    regions = zip(data["tool"], float(data["factor"]) * data["semi_axes"], strict=True)
    for center, semi in [] if known else regions:
        for a, b in ((0, 1), (1, 2), (2, 0)):
            ring = center + np.cos(angle) * semi[a] + np.sin(angle) * semi[b]
            lines.append((ring, _ELLIPSOID | {"label": region}))
    _show(figure, data, lines)
