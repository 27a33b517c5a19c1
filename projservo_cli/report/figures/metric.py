"""Arm, cameras and the tool's uncertainty in metres, and the same in numbers."""

from typing import Any

import numpy as np
from scipy.special import chdtri

from projservo_cli.geometry.displacements import twists
from projservo_cli.geometry.kinematics import joint_operators
from projservo_cli.metric.frame import Metric, links
from projservo_cli.records import MM, VIEWS, FloatArray
from projservo_cli.report import style
from projservo_cli.report.figures.scene import ROBOT, pyramids, rectangle, show, skeleton, space
from projservo_cli.report.report_data import Data, Fit, registered

_POSES, _REGION = 5, 0.95
_SHOWN = 0.05  # size of the ellipsoids as they are drawn, over the distance of the tools
_ELLIPSOID: style.LineStyle = {"color": style.VERMILION, "linewidth": 0.8}


def chosen_poses(metric: Metric, fit: Fit) -> FloatArray:
    """Five readings (5, n) of those in the data: nearest to the reference, then the farthest tools."""
    q = fit.observation.q
    positions = metric.pose(q)[:, :3, 3]
    chosen = [int(np.argmin(np.abs(q - fit.calibration.q_reference).sum(axis=1)))]
    while len(chosen) < min(_POSES, len(q)):
        away = np.linalg.norm(positions[:, None] - positions[chosen], axis=2).min(axis=1)
        chosen.append(int(np.argmax(away)))
    return q[chosen]


def metric_rows(metric: Metric, q: FloatArray) -> list[dict[str, Any]]:
    """Quantities in metres with their standard deviations, plain values; the tool at readings q (k, n)."""
    rows: list[dict[str, Any]] = []

    def row(quantity: str, value: FloatArray, changes: FloatArray, unit: str) -> None:
        """Add a row of values (d,), by their changes (c, d) by independent errors."""
        deviation = np.linalg.norm(np.atleast_2d(changes), axis=0)
        rows.append(
            {
                "quantity": quantity,
                "value": np.atleast_1d(value).tolist(),
                "deviation": deviation.tolist(),
                "unit": unit,
            }
        )

    of_K, of_poses, centers = metric.deviations("K"), metric.deviations("poses"), metric.poses[:, :3, 3]
    for v, view in enumerate(VIEWS):
        K = metric.K[v]
        row(f"{view} camera, focal lengths", K[(0, 1), (0, 1)], of_K[:, v][:, [0, 3]], "px")
        row(f"{view} camera, principal point", K[:2, 2], of_K[:, v][:, [2, 4]], "px")
        row(f"{view} camera, position in the base frame", MM * centers[v], MM * of_poses[:, v, 3:], "mm")
    apart = centers[1] - centers[0]
    distance = np.asarray(np.linalg.norm(apart))
    between = (of_poses[:, 1, 3:] - of_poses[:, 0, 3:]) @ (apart / distance)
    row("distance of the cameras", MM * distance, MM * between[:, None], "mm")
    axes, prismatic = metric.axes, metric.prismatic
    angle, length = links(axes, prismatic, axes)
    changes = metric.changes(lambda body: np.stack(links(body.axes, prismatic, axes), axis=-1))
    for i in range(len(angle)):
        name = f"joint {i + 2}, axis from that of joint {i + 1}"
        row(f"{name}, angle", np.degrees(angle[i]), np.degrees(changes[:, i, :1]), "°")
        if np.isfinite(length[i]):
            row(f"{name}, distance", MM * length[i], MM * changes[:, i, 1:], "mm")
    of_tools = metric.point_changes(q, np.zeros(3))
    for k, T in enumerate(metric.pose(q)):
        row(f"tool at pose {k + 1}", MM * T[:3, 3], MM * of_tools[:, k], "mm")
    return rows


def _data(report_data: Fit) -> Data:
    """Arm at the first of five poses, cameras, and 95 % regions of the tool at all of them, m."""
    metric = report_data.metric
    assert metric is not None
    q = chosen_poses(metric, report_data)
    tools = metric.pose(q)[:, :3, 3]
    arm = report_data.calibration.model()._replace(
        H_hat_0=twists(metric.axes), q_reference=np.zeros(q.shape[1])
    )
    seen = report_data.observation.images
    low, high = np.nanmin(seen, axis=(0, 2)), np.nanmax(seen, axis=(0, 2))
    spread, axes = np.linalg.eigh(metric.pose_covariance(q)[:, 3:, 3:])
    radius = np.sqrt(chdtri(3, 1.0 - _REGION) * np.maximum(spread, 0.0))
    semi_axes = axes.swapaxes(1, 2) * radius[..., None]
    extent = float(np.ptp(tools, axis=0).max()) + float(np.linalg.norm(tools.mean(axis=0)))
    return {
        "q": q,
        "tool": tools,
        "position_std_mm": metric.position_std(q),
        "semi_axes": semi_axes,
        "factor": np.array(style.magnification(float(radius.max()), _SHOWN * extent)),
        "robot": skeleton(joint_operators(arm, q[0]), arm.prismatic, tools[0]),
        "pyramids": pyramids(metric.body.P, rectangle(low, high), tools),
    }


@registered(
    "fig18_metric",
    "Arm, cameras and the tool's uncertainty, to scale",
    "not in the paper",
    _data,
    height=4.4,
    task=False,
    metric=True,
    alt="The arm at one pose in three dimensions, both cameras with pyramids over the pixels in which "
    "markers were seen, and ellipsoids of the tool's position at five poses, magnified.",
)
def _draw(data: Data, figure: "style.Figure") -> None:
    """One view in perspective; regions as three ellipses each."""
    axes = space(figure, data["pyramids"])
    axes.plot(*data["robot"].T, **ROBOT)
    angle = np.linspace(0.0, 2.0 * np.pi, 61)[:, None]
    visible = [data["robot"]]
    for center, semi in zip(data["tool"], float(data["factor"]) * data["semi_axes"], strict=True):
        for a, b in ((0, 1), (1, 2), (2, 0)):
            ring = center + np.cos(angle) * semi[a] + np.sin(angle) * semi[b]
            axes.plot(*ring.T, **_ELLIPSOID)
            visible.append(ring)
    largest = MM * float(np.linalg.norm(data["semi_axes"], axis=2).max())
    region = f"95 % region of the tool, {float(data['factor']):,g} times (at most {largest:.3g} mm)"
    line_styles = {"arm at one pose": ROBOT, region: _ELLIPSOID}
    show(axes, figure, data["pyramids"], np.concatenate(visible), line_styles)
