"""Fig. 3 of [RH00]: robot, stereo rig and face at the start and at the goal."""

from typing import Any

import numpy as np

from projservo_cli.geometry.displacements import homogeneous
from projservo_cli.geometry.kinematics import forward_kinematics, joint_operators
from projservo_cli.image_size import image_corners
from projservo_cli.records import BoolArray, FloatArray
from projservo_cli.report import style
from projservo_cli.report.report_data import Data, ReportData, registered
from projservo_cli.simulation.analytic_plant import Plant
from projservo_cli.simulation.arm import camera_center
from projservo_cli.task.face import center_of

_PYRAMID = 0.16  # length of the drawn viewing pyramids, as a share of the distance to the face
ROBOT: style.LineStyle = {"color": style.BLACK, "linewidth": 2.0, "marker": "o", "markersize": 4}
_CAMERAS: dict[str, style.LineStyle] = {
    "left camera": {"color": style.BLUE, "linewidth": 1.0},
    "right camera": {"color": style.ORANGE, "linewidth": 1.0},
}


def _data(report_data: ReportData) -> Data:
    """Joints, faces and cameras in metres; the robot at the start as a polyline through its axes."""
    plant, robot, q = report_data.plant, report_data.robot, report_data.plan.q_start
    start = forward_kinematics(plant.model, q)
    face = plant.M[plant.order]
    tool = (start @ robot.base_tool)[:3, 3]
    result: Data = {
        "robot": skeleton(joint_operators(plant.model, q), robot.prismatic, tool),
        "face_start": (face @ start.T)[:, :3],
    }
    visible = plant_pyramids(plant, result["face_start"])
    result |= {"cameras": visible[:, 0], "pyramids": visible}
    goals = (trace.goal_pose for trace in report_data.traces.values() if np.isfinite(trace.goal_pose).all())
    if (pose := next(goals, None)) is not None:
        goal = pose @ np.linalg.inv(robot.base_tool)
        result["face_goal"] = (face @ goal.T)[:, :3]
        centers = [center_of(plant.M @ H.T, plant.center)[:3] for H in (start, goal)]
        result["line"] = np.array(centers)
    return result


def skeleton(H_hat: FloatArray, prismatic: BoolArray, tool: FloatArray) -> FloatArray:
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
    """Pyramids (2, 5, 3) of the whole images of a plant, by ``pyramids``."""
    return pyramids(plant.model.P, rectangle(*np.moveaxis(image_corners(plant.image_size), -2, 0)), face)


def pyramids(P: FloatArray, corners: FloatArray, face: FloatArray) -> FloatArray:
    """Optical centre and image corners (2, 5, 3) of metric cameras P (2, 3, 4), m.

    corners : (2, 4, 2) pixels. They are drawn at a depth in front of the camera that goes by the distance of
    a face (m, 3).
    """
    centers = np.stack([camera_center(camera) for camera in P])[:, None]
    depth = _PYRAMID * float(np.linalg.norm(face.mean(axis=0) - centers.mean(axis=0)))
    scale = np.linalg.norm(P[:, 2, :3], axis=1) * np.sign(np.linalg.det(P[:, :, :3]))
    rays = np.linalg.solve(P[:, :, :3], homogeneous(corners).swapaxes(1, 2)).swapaxes(1, 2)
    return np.concatenate([centers, centers + depth * rays * scale[:, None, None]], axis=1)


def rectangle(low: FloatArray, high: FloatArray) -> FloatArray:
    """Corners (2, 4, 2) of the images of both views between pixels low and high (2, 2) or (2,)."""
    share = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    low, high = (np.broadcast_to(end, (2, 2))[:, None] for end in (low, high))
    return np.asarray(low + share * (high - low))


@registered(
    "fig03_scene",
    "Robot, stereo rig, and the face at the start and at the goal",
    "Fig. 3, section 6",
    _data,
    height=4.4,
    alt="The robot's arm at the start in three dimensions, both cameras, the face at the start and "
    "at the goal, and the straight line of its centre between them.",
)
def _draw(data: Data, figure: "style.Figure") -> None:
    """One view in perspective with equal scales."""
    axes = space(figure, data["pyramids"])
    axes.plot(*data["robot"].T, **ROBOT)
    axes.plot(*style.closed(data["face_start"]).T, **style.START)
    line_styles = {"robot at the start": ROBOT, "face at the start": style.START}
    visible = [data["robot"], data["face_start"]]
    if "face_goal" in data:
        goal: style.LineStyle = {"color": style.VERMILION, "linestyle": (0, (3, 1))}
        axes.plot(*style.closed(data["face_goal"]).T, **goal)
        line: style.LineStyle = {"color": style.GREY, "linestyle": (0, (1, 1))}
        axes.plot(*data["line"].T, **line)
        line_styles |= {"face at the goal": goal, "straight line of the centre": line}
        visible.append(data["face_goal"])
    show(axes, figure, data["pyramids"], np.concatenate(visible), line_styles)


def space(figure: "style.Figure", rig: FloatArray) -> Any:
    """Axes in three dimensions with the pyramids (2, 5, 3) of both cameras."""
    axes: Any = figure.add_axes((0, 0, 1, 1), projection="3d", proj_type="persp", focal_length=0.9)
    axes.patch.set_visible(False)
    axes.computed_zorder = False
    for (center, *corners), line_style in zip(rig, _CAMERAS.values(), strict=True):
        axes.plot(*style.closed(np.stack(corners)).T, **line_style)
        for corner in corners:
            axes.plot(*np.stack([center, corner]).T, **line_style)
    return axes


def show(
    axes: Any,
    figure: "style.Figure",
    rig: FloatArray,
    points: FloatArray,
    line_styles: dict[str, style.LineStyle],
) -> None:
    """Show a rig and points (k, 3) with equal scales, seen from the side of the rig, above a legend."""
    from matplotlib.ticker import MultipleLocator

    points = np.concatenate([points, rig.reshape(-1, 3)])
    low, high = points.min(axis=0), points.max(axis=0)
    pad = 0.05 * (high - low).max()
    extent = np.stack([low - pad, high + pad], axis=1)
    for name, (a, b) in zip("xyz", extent, strict=True):
        getattr(axes, f"set_{name}lim")(a, b)
        getattr(axes, f"set_{name}label")(f"{name} (m)", labelpad=1 if name == "z" else 14)
        steps = (step for step, upper in ((0.1, 0.4), (0.25, 0.75), (0.5, 5.0)) if b - a < upper)
        step = next(steps, 0.2 / style.magnification(b - a, 1.0))
        getattr(axes, f"{name}axis").set_major_locator(MultipleLocator(step))
    axes.tick_params(pad=0)
    towards = rig[:, 0].mean(axis=0) - points.mean(axis=0)
    axes.view_init(elev=22, azim=float(np.degrees(np.arctan2(towards[1], towards[0]))) - 62)
    figure.set_layout_engine()
    style.legend_below(figure, line_styles | _CAMERAS, 3)
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
