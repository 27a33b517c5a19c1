"""Figs. 4, 7 and 11 of [RH00], and the overview: paths and errors of the markers in both images."""

from typing import Any

import numpy as np

from projservo_cli.geometry.kinematics import project
from projservo_cli.laws import POINT_LAWS, title_of
from projservo_cli.loop.verdicts import plateau_stretch
from projservo_cli.records import FloatArray
from projservo_cli.report import style
from projservo_cli.report.report_data import DIRECT, VIEWS, Data, ReportData, percent, registered

_OUTSIDE = 0.15  # how far outside an image, as a share of its size, a path is still drawn
_BORDER_SHOWN = 0.08  # share of the image next to its border: paths that reach into it show the border
_PANEL_WIDTH = 2.9  # inches, of one of two panels side by side
_BORDER: style.LineStyle = {"color": style.GREY, "linewidth": 0.8}
_HIDDEN: style.LineStyle = {"color": style.ORANGE, "linewidth": 4.0, "alpha": 0.6}
_PATH: style.LineStyle = {"color": style.BLACK, "linewidth": 0.9}
_PLATEAU: style.LineStyle = {"color": style.VERMILION, "linewidth": 2.0, "marker": "s"}
_MARKER: style.LineStyle = {
    "linewidth": 0.9,
    "markersize": 3.0,
    "linestyle": "-",
}  # how it is broken says u or v
# The overview.
_SHOWN: dict[str, style.LineStyle] = {
    "direct_three": {"color": style.GREEN, "linewidth": 1.2},
    "stacked": {"color": style.VERMILION, "linewidth": 1.1, "linestyle": (0, (4, 1.2))},
}
_IMAGE_WIDTH, _ERRORS_WIDTH = 3.7, 2.1  # inches, of the panels with images and of those next to them
_ASPECTS = (0.45, 0.9)  # height over width of an image, within: an error panel has its height
_PERCENT = (1e-2, 200.0)  # shown of a control error: below, noise of the calibration rules
_NEAR_ZERO = np.radians(1.0)  # rad; a rotation that starts within it may be noise, which is no whole
_LEGEND_ROOM = 20.0  # points between a panel and its title
_BAND: style.LineStyle = {"color": style.ORANGE, "linewidth": 5.0, "alpha": 0.55, "solid_capstyle": "butt"}
_CENTER: style.LineStyle = {"color": style.GREEN, "linewidth": 3.2}
_ERRORS = (("tau_affine", r"$\tau$"), ("theta_r", r"$\theta_r$"), ("theta_p", r"$\theta_p$"))


def _data_classical(report_data: ReportData) -> Data:
    """Image paths of the classical laws that were run, with their hidden and standing stretches."""
    result: Data = {"image_size": report_data.plant.image_size}
    order = report_data.plant.order
    for law in POINT_LAWS:
        if law in report_data.traces:
            trace = report_data.traces[law]
            stretch = plateau_stretch(trace.convergence_error, report_data.stall_periods)
            result |= {
                f"s_{law}": trace.s[:, :, order],
                f"s_star_{law}": trace.s_star[:, order],
                f"hidden_{law}": trace.self_occluded,
                f"plateau_{law}": np.array(stretch if stretch is not None else (-1, -1)),
                f"verdict_{law}": np.array(f"{trace.verdict}, {trace.steps} steps"),
            }
    return result


@registered(
    "fig04_classical",
    "Image trajectories of the classical laws",
    "Fig. 4, section 6",
    _data_classical,
    laws=POINT_LAWS,
    any_law=True,
    alt="A row for each classical law, a panel for each camera: the paths of the markers from start "
    "to goal, with the stretches in which the face is hidden and in which the image error "
    "stands still.",
)
def _draw_classical(data: Data, figure: "style.Figure") -> None:
    """One row a law, one column a camera."""
    laws, size = [law for law in POINT_LAWS if f"s_{law}" in data], data["image_size"]
    panels = [np.concatenate([data[f"s_{law}"], data[f"s_star_{law}"][None]]) for law in laws]
    heights = [_PANEL_WIDTH * style.aspect(both_near(s, size)) for s in panels]
    figure.set_figheight(sum(heights) + 0.62 * len(laws) + 0.45)
    axes = figure.subplots(len(laws), 2, squeeze=False, height_ratios=heights)
    for row, law in enumerate(laws):
        first, last = data[f"plateau_{law}"]
        for view, name in enumerate(VIEWS):
            panel, s, goal = axes[row, view], data[f"s_{law}"][:, view], data[f"s_star_{law}"][view]
            style.hidden_paths(panel, s, data[f"hidden_{law}"][:, view], _HIDDEN)
            style.paths(panel, s, _PATH)
            if first >= 0:
                style.paths(panel, s[first : last + 1], _PLATEAU | {"markevery": [0]})
            panel.plot(*s[-1].T, "x", color=style.BLACK, markersize=4)
            style.face(panel, s[0], style.START, fill=True)
            style.face(panel, goal, style.GOAL)
            title = f"{name} camera" if view else f"{title_of(law)}: {data[f'verdict_{law}']}"
            style.image_axes(panel, title, near_pixels(np.concatenate([s, goal[None]]), size[view]))
            panel.plot(*style.closed(image_border(size[view])).T, **_BORDER)
    line_styles: dict[str, style.LineStyle] = {
        "start": style.START,
        "goal": style.GOAL,
        "path of a marker": _PATH,
    }
    line_styles |= {"face hidden from this camera": _HIDDEN, "plateau of the image error": _PLATEAU}
    line_styles["end of the run"] = {"color": style.BLACK, "marker": "x", "linestyle": "none"}
    every = np.concatenate([near_pixels(s[:, v], size[v]) / size[v] for s in panels for v in (0, 1)])
    if (np.abs(every - 0.5) > 0.5 - _BORDER_SHOWN).any():
        line_styles["border of the image"] = _BORDER
    style.legend_below(figure, line_styles, 4)


def image_border(size: FloatArray) -> FloatArray:
    """Corners (4, 2) of an image of a width and height (2,), px."""
    return np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * size - 0.5


def both_near(pixels: FloatArray, size: FloatArray) -> FloatArray:
    """Pixels (k, 2) of both images (…, 2, m, 2) of sizes (2, 2), as ``near_pixels``."""
    return np.concatenate([near_pixels(pixels[..., view, :, :], size[view]) for view in range(2)])


def near_pixels(pixels: FloatArray, size: FloatArray) -> FloatArray:
    """Of pixels (…, 2) those (k, 2) that were measured, none farther outside the image than is drawn."""
    seen = pixels[np.isfinite(pixels).all(axis=-1)]
    return np.clip(seen, -_OUTSIDE * size, (1.0 + _OUTSIDE) * size)


def _data_direct(report_data: ReportData) -> Data:
    """Image paths of both direct laws."""
    order = report_data.plant.order
    result: Data = {f"s_{law}": report_data.traces[law].s[:, :, order] for law in DIRECT}
    return result | {"s_star": report_data.traces[DIRECT[0]].s_star[:, order]}


@registered(
    "fig07_three_two",
    "directTHREE over directTWO in the images",
    "Fig. 7, section 6",
    _data_direct,
    laws=DIRECT,
    alt="Paths of the markers in both camera images under directTHREE and directTWO.",
)
def _draw_direct(data: Data, figure: "style.Figure") -> None:
    """Both laws over one another, one panel a camera."""
    runs = [data[f"s_{law}"] for law in DIRECT]
    figure.set_figheight(_PANEL_WIDTH * style.aspect(np.concatenate(runs)) + 1.05)
    axes = figure.subplots(1, 2)
    line_styles: tuple[style.LineStyle, ...] = (
        {"color": style.BLACK, "linewidth": 1.1},
        {"color": style.VERMILION, "linewidth": 1.1, "linestyle": (0, (4, 1.5))},
    )
    for view, (panel, name) in enumerate(zip(axes, VIEWS, strict=True)):
        goal = data["s_star"][view]
        for s, line_style in zip(runs, line_styles, strict=True):
            style.paths(panel, s[:, view], line_style)
        style.face(panel, runs[0][0, view], style.START, fill=True)
        style.face(panel, goal, style.GOAL)
        style.image_axes(panel, f"{name} camera", np.concatenate([goal[None], *(s[:, view] for s in runs)]))
    legend: dict[str, style.LineStyle] = {
        title_of(law): line_style for law, line_style in zip(DIRECT, line_styles, strict=True)
    }
    style.legend_below(figure, legend | {"start": style.START, "goal": style.GOAL}, 4)


def _data_errors(report_data: ReportData) -> Data:
    """Image errors of the markers and of the centre under directTHREE, over time."""
    trace = report_data.traces[DIRECT[0]]
    goal = np.append(report_data.goal_center(trace), 1.0)
    return {
        "t_s": trace.period * np.arange(len(trace.s)),
        "e": trace.s - trace.s_star,
        "center_e": report_data.center_image(trace) - project(report_data.plant.model.P, goal[None])[:, 0],
        "law": np.array(title_of(trace.law)),
        "marker": np.array(report_data.numbers),
    }


@registered(
    "fig11_image_errors",
    "Image errors of the markers and of the centre",
    "Fig. 11, section 6",
    _data_errors,
    height=3.2,
    laws=DIRECT[:1],
    goal=True,
    alt="For each camera: the errors of u and v of every marker and of the centre over time.",
)
def draw_image_errors(data: Data, figure: "style.Figure") -> None:
    """One panel a camera; u solid, v dashed, the centre thick, if it is known."""
    axes = figure.subplots(1, 2, sharey=True)
    t = data["t_s"]
    thick: style.LineStyle = {"color": style.GREY, "linewidth": 3.0, "alpha": 0.6}
    thin: style.LineStyle = {"color": style.BLACK, "linewidth": 0.9}
    markers = [style.curve(k, marker=True) | _MARKER for k in range(len(data["marker"]))]
    for view, (panel, name) in enumerate(zip(axes, VIEWS, strict=True)):
        for k, line_style in enumerate(markers):
            u, v = data["e"][:, view, k].T
            every = {"markevery": (k * len(t) // 60, max(1, len(t) // 12))}
            panel.plot(t, u, **line_style, **every)
            panel.plot(t, v, **line_style | every | {"linestyle": (0, (3, 1.2))})
        if "center_e" in data:
            u, v = data["center_e"][:, view].T
            panel.plot(t, u, **thick)
            panel.plot(t, v, linestyle=(0, (2, 1)), **thick)
        panel.set(title=f"{name} camera, {data['law']}", xlabel="time (s)")
    axes[0].set_ylabel("image error $s - s_*$ (px)")
    line_styles = {
        f"marker {number}": line_style for number, line_style in zip(data["marker"], markers, strict=True)
    }
    line_styles |= {"centre": thick} if "center_e" in data else {}
    line_styles |= {"u": thin, "v": thin | {"linestyle": (0, (3, 1.2))}}
    style.legend_below(figure, line_styles, min(len(line_styles), 8))


def _data_overview(report_data: ReportData) -> Data:
    """Paths and image errors of the direct and the stacked law, control errors of the direct one."""
    order = report_data.plant.order
    direct = report_data.traces[DIRECT[0]]
    result: Data = {
        "s_star": direct.s_star[:, order],
        "center": report_data.center_image(direct),
        "period_s": np.array(direct.period),
        **{f"{name}_percent": np.abs(percent(getattr(direct, name))) for name, _ in _ERRORS},
    }
    for name in ("theta_r", "theta_p"):
        if abs(getattr(direct, name)[0]) < _NEAR_ZERO:
            result[f"{name}_percent"] = np.full(len(direct.tau), np.nan)
    for law in _SHOWN:
        trace = report_data.traces[law]
        hidden = trace.self_occluded
        end = f"{trace.verdict} in {trace.steps} steps, face hidden in {hidden.any(axis=1).sum()}"
        result |= {
            f"s_{law}": trace.s[:, :, order],
            f"hidden_{law}": hidden,
            f"image_error_{law}": trace.image_error,
            f"verdict_{law}": np.array(f"{title_of(law)}: {end}"),
        }
    return result


@registered(
    "fig00_overview",
    "One run at a glance: the classical and the direct law in both images, and their errors",
    "not in the paper",
    _data_overview,
    laws=tuple(_SHOWN),
    alt="Left: paths of the markers in both camera images, from the face at the start to the goal, "
    "for directTHREE and the stacked law, with the stretches in which the face is hidden. "
    "Right: control errors of directTHREE and image errors of both laws over time.",
)
def _draw_overview(data: Data, figure: "style.Figure") -> None:
    """Left the images of both cameras, right the errors."""
    panels = [
        np.concatenate(
            [
                data["s_star"][view],
                data["center"][:, view],
                *(data[f"s_{law}"][:, view].reshape(-1, 2) for law in _SHOWN),
            ]
        )
        for view in range(2)
    ]
    aspect = style.aspect(np.concatenate(panels), *_ASPECTS)
    figure.set_figheight(2.0 * _IMAGE_WIDTH * aspect + 1.75 + _LEGEND_ROOM / 72.0)
    axes = figure.subplots(2, 2, width_ratios=(_IMAGE_WIDTH, _ERRORS_WIDTH))
    control, image = axes[:, 1]
    for view, (panel, name) in enumerate(zip(axes[:, 0], VIEWS, strict=True)):
        for law, line_style in reversed(_SHOWN.items()):
            s = data[f"s_{law}"][:, view]
            style.hidden_paths(panel, s, data[f"hidden_{law}"][:, view], _BAND)
            style.paths(panel, s, line_style)
        panel.plot(*data["center"][:, view].T, **_CENTER)
        style.face(panel, data[f"s_{DIRECT[0]}"][0, view], style.START, fill=True)
        style.face(panel, data["s_star"][view], style.GOAL)
        style.image_axes(panel, f"{name} camera", panels[view])
    for index, (name, label) in enumerate(_ERRORS):
        values = data[f"{name}_percent"]
        t, shown = data["period_s"] * np.arange(len(values)), label + " near 0" * bool(np.isnan(values[0]))
        control.plot(t, values, label=shown, **style.curve(index))
    style.log_scale(control)
    control.set(ylabel="error (% of its start)", ylim=_PERCENT)
    control.set_title(f"control errors, {title_of(DIRECT[0])}", pad=_LEGEND_ROOM)
    above: dict[str, Any] = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0), "ncols": len(_ERRORS)}
    control.legend(handlelength=1.5, columnspacing=1.0, **above)
    for law, line_style in _SHOWN.items():
        e, hidden = data[f"image_error_{law}"], data[f"hidden_{law}"].any(axis=1)
        t = data["period_s"] * np.arange(len(e))
        image.plot(t, np.where(hidden, e, np.nan), **_BAND)
        image.plot(t, e, **line_style)
    style.log_scale(image)
    image.set(title="image errors, both laws", ylabel="rms (px)")
    for panel in (control, image):
        panel.set_xlabel("time (s)")
    line_styles = {str(data[f"verdict_{law}"]): line_style for law, line_style in _SHOWN.items()}
    line_styles |= {f"centre under {title_of(DIRECT[0])}": _CENTER, "face at the start": style.START}
    line_styles |= {"face at the goal": style.GOAL, "face hidden from the camera": _BAND}
    style.legend_below(figure, line_styles, 2)
