"""Beside the figures of [RH00]: planning anew in each step against following the plan, section 4."""

from typing import TYPE_CHECKING, Any

import numpy as np

from projservo_cli.records import PRISMATIC, Trace
from projservo_cli.report import style
from projservo_cli.report.material import Data, Material, title
from projservo_cli.report.measures import along_line

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PLANNED: style.Look = {"color": style.GREY, "linewidth": 0.8, "linestyle": (0, (2, 1.5))}
# Runs whose largest distances differ by more than this are shown on a logarithmic scale, down to a share
# of the least of them.
WIDE, LEAST_SHARE = 10.0, 0.02


def _names(data: Data) -> list[str]:
    return [str(name) for name in data["names"]]


def _planned(traces: list[Trace]) -> Data:
    """When the followed plan arrives, s; NaN where none of the traces follows one."""
    times = [trace.planned_s for trace in traces if trace.planned_s is not None]
    return {"planned_s": np.array(times[0] if times else np.nan)}


def data_path(material: Material) -> Data:
    """Way along the line of the centre and distance from it at every instant, mm."""
    names = material.compared()
    result: Data = {"names": np.array(names)}
    for name in names:
        trace = material.traces[name]
        way, off = along_line(trace.center, trace.center[0], material.goal_center(trace))
        result[f"path_mm_{name}"] = 1e3 * np.stack([way, off], axis=1)
    return result


def draw_path(data: Data, figure: "Figure") -> None:
    """Distance of the centre from its line over the way along it, one curve a run."""
    axes = figure.subplots()
    for i, name in enumerate(_names(data)):
        way, off = data[f"path_mm_{name}"].T
        axes.plot(way, off, **style.curve(i))
    axes.set_title("path of the centre")
    axes.set_xlabel("way along the straight line (mm)")
    axes.set_ylabel("distance from it (mm)")
    _log_where_wide(axes, [data[f"path_mm_{name}"][:, 1] for name in _names(data)])
    style.legend_below(figure, _handles(data), 2)


def _log_where_wide(axes: "Axes", values: list[Any]) -> None:
    """Logarithmic scale where the runs differ much at their largest."""
    most = [float(np.max(value)) for value in values]
    if min(most) > 0.0 and max(most) > WIDE * min(most):
        style.log_scale(axes)
        axes.set_ylim(bottom=LEAST_SHARE * min(most))


def data_images(material: Material) -> Data:
    """Image error over time, px rms per marker and view, and when the plan arrives."""
    names = material.compared()
    traces = [material.traces[name] for name in names]
    result: Data = {"names": np.array(names), **_planned(traces)}
    for name, trace in zip(names, traces, strict=True):
        result[f"t_s_{name}"] = trace.period * np.arange(len(trace.image_error))
        result[f"image_error_px_{name}"] = trace.image_error
    return result


def draw_images(data: Data, figure: "Figure") -> None:
    """Left on a linear, right on a logarithmic scale."""
    for panel, axes in enumerate(figure.subplots(1, 2)):
        for i, name in enumerate(_names(data)):
            axes.plot(data[f"t_s_{name}"], data[f"image_error_px_{name}"], **style.curve(i))
        _mark_planned(axes, data)
        axes.set_xlabel("time (s)")
        axes.set_ylabel("image error (px)")
        axes.set_title("image error" + (", logarithmic" if panel else ""))
        if panel:
            style.log_scale(axes)
    style.legend_below(figure, _handles(data), 2)


def data_noise(material: Material) -> Data:
    """Standard deviation over the noise of true centre, mm, and of commands, deg/s, after each step.

    Both are roots of sums of variances, over the axes and over the revolute joints.
    """
    revolute = np.flatnonzero(material.robot.joint_types != PRISMATIC)
    names = [name for name in material.compared() if name in material.noisy]
    first = [material.noisy[name][0] for name in names]
    result: Data = {"names": np.array(names), "noise_px": np.array(material.noise_px), **_planned(first)}
    for name in names:
        runs = material.noisy[name]
        center = np.array([run.center for run in runs])
        q_dot = np.array([run.q_dot[:, revolute] for run in runs])
        result[f"t_s_{name}"] = runs[0].period * np.arange(1, center.shape[1])
        result[f"center_mm_{name}"] = 1e3 * np.sqrt(center[:, 1:].var(axis=0, ddof=1).sum(axis=-1))
        result[f"command_deg_s_{name}"] = np.degrees(np.sqrt(q_dot.var(axis=0, ddof=1).sum(axis=-1)))
    return result


def draw_noise(data: Data, figure: "Figure") -> None:
    """Left the centre, right the commands."""
    panels = (("center_mm", "true centre", "mm"), ("command_deg_s", "commands", "deg/s"))
    for axes, (key, what, unit) in zip(figure.subplots(1, 2), panels, strict=True):
        for i, name in enumerate(_names(data)):
            axes.plot(data[f"t_s_{name}"], data[f"{key}_{name}"], **style.curve(i))
        _mark_planned(axes, data)
        axes.set_xlabel("time (s)")
        axes.set_ylabel(f"standard deviation ({unit})")
        axes.set_title(f"{what}, {float(data['noise_px']):g} px of noise")
        style.log_scale(axes)
    style.legend_below(figure, _handles(data), 2)


def _mark_planned(axes: "Axes", data: Data) -> None:
    if np.isfinite(data["planned_s"]):
        axes.axvline(float(data["planned_s"]), **PLANNED)


def _handles(data: Data) -> list[Any]:
    handles = [style.line_handle(title(name), **style.curve(i)) for i, name in enumerate(_names(data))]
    if np.isfinite(data.get("planned_s", np.array(np.nan))):
        handles.append(style.line_handle("the plan arrives", **PLANNED))
    return handles
