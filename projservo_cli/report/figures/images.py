"""Figs. 4, 7 and 11 of [RH00]: paths and errors of the markers in both images."""

from typing import TYPE_CHECKING

import numpy as np

from projservo_cli.loop.step import plateau_stretch
from projservo_cli.records import FloatArray, Trace
from projservo_cli.report import style
from projservo_cli.report.material import (
    CLASSICAL,
    DIRECT,
    TITLES,
    VIEWS,
    Data,
    Material,
    center_image,
    registered,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# How far outside an image, as a share of its size, a path is still drawn.
_OUTSIDE = 0.15
_BORDER_SHOWN = 0.08  # share of the image next to its border: paths that reach into it show the border
_PANEL_WIDTH = 2.9  # inches, of one of two panels beside one another
_BORDER: style.Look = {"color": style.GREY, "linewidth": 0.8}
_LOOKS: dict[str, style.Look] = {
    "start": style.START,
    "goal": style.GOAL,
    "path of a marker": {"color": style.BLACK, "linewidth": 0.9},
    "face hidden from this camera": {"color": style.ORANGE, "linewidth": 4.0, "alpha": 0.6},
    "plateau of the image error": {"color": style.VERMILION, "linewidth": 2.0, "marker": "s"},
}


def _data_classical(material: Material) -> Data:
    """Image paths of the classical laws that were run, with their hidden and standing stretches."""
    result: Data = {"image_size": material.plant.image_size}
    for law in CLASSICAL:
        if law in material.traces:
            trace = material.traces[law]
            result |= {f"{name}_{law}": value for name, value in _paths(material, trace).items()}
            result[f"verdict_{law}"] = np.array(f"{trace.verdict}, {trace.steps} steps")
    return result


def _paths(material: Material, trace: Trace) -> Data:
    stretch = plateau_stretch(trace.stop_error, material.plateau_steps)
    return {
        "s": trace.s[:, :, material.plant.order],
        "s_star": trace.s_star[:, material.plant.order],
        "hidden": trace.self_occluded,
        "plateau": np.array(stretch if stretch is not None else (-1, -1)),
    }


@registered(
    "fig04_classical",
    "Image trajectories of the classical laws",
    "Fig. 4, section 6",
    8.0,
    _data_classical,
    laws=CLASSICAL,
    any_law=True,
    alt="A row for each classical law, a panel for each camera: the paths of the markers from start "
    "to goal, with the stretches in which the face is hidden and in which the image error "
    "stands still.",
)
def _draw_classical(data: Data, figure: "Figure") -> None:
    """One row a law, one column a camera."""
    laws = [law for law in CLASSICAL if f"s_{law}" in data]
    shown = [
        np.concatenate([data[f"s_{law}"].reshape(-1, 2), data[f"s_star_{law}"].reshape(-1, 2)])
        for law in laws
    ]
    heights = [_PANEL_WIDTH * style.aspect(near_pixels(pixels, data["image_size"])) for pixels in shown]
    figure.set_figheight(sum(heights) + 0.62 * len(laws) + 0.45)
    axes = figure.subplots(len(laws), 2, squeeze=False, height_ratios=heights)
    for row, law in enumerate(laws):
        for view, name in enumerate(VIEWS):
            panel = axes[row, view]
            s, hidden = data[f"s_{law}"][:, view], data[f"hidden_{law}"][:, view]
            _draw_paths(panel, s, hidden, data[f"plateau_{law}"])
            panel.plot(*s[-1].T, "x", color=style.BLACK, markersize=4)
            style.face(panel, s[0], style.START, fill=True)
            goal = data[f"s_star_{law}"][view]
            style.face(panel, goal, style.GOAL)
            title = f"{name} camera" if view else f"{TITLES[law]}: {data[f'verdict_{law}']}"
            style.image_axes(panel, title)
            _frame(panel, np.concatenate([s.reshape(-1, 2), goal]), data["image_size"])
    looks = {**_LOOKS, "end of the run": {"color": style.BLACK, "marker": "x", "linestyle": "none"}}
    every = near_pixels(np.concatenate(shown), data["image_size"]) / data["image_size"]
    if (np.abs(every - 0.5) > 0.5 - _BORDER_SHOWN).any():
        looks["border of the image"] = _BORDER
    style.legend_below(figure, looks, 4)


def _draw_paths(axes: "Axes", s: FloatArray, hidden: FloatArray, plateau: FloatArray) -> None:
    path, behind, still = [*_LOOKS.values()][2:]
    for k in range(s.shape[1]):
        stretch = np.where(hidden[:, None], s[:, k], np.nan)
        axes.plot(*stretch.T, solid_capstyle="butt", **behind)
        axes.plot(*s[:, k].T, **path)
        if plateau[0] >= 0:
            first, last = plateau
            axes.plot(*s[first : last + 1, k].T, markevery=[0], **still)


def _frame(axes: "Axes", pixels: FloatArray, size: FloatArray) -> None:
    """Show the paths as far as they stay near the image, and the image border where it is near."""
    style.frame_pixels(axes, near_pixels(pixels, size))
    border = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * size - 0.5
    limits = axes.get_xlim(), axes.get_ylim()
    axes.plot(*style.closed(border).T, **_BORDER)
    axes.set(xlim=limits[0], ylim=limits[1])


def near_pixels(pixels: FloatArray, size: FloatArray) -> FloatArray:
    """Pixels (k, 2) that were measured, none farther outside the image than is drawn."""
    seen = pixels[np.isfinite(pixels).all(axis=1)]
    return np.clip(seen, -_OUTSIDE * size, (1.0 + _OUTSIDE) * size)


def _data_direct(material: Material) -> Data:
    """Image paths of both direct laws."""
    order = material.plant.order
    first = material.traces[DIRECT[0]]
    result: Data = {f"s_{law}": material.traces[law].s[:, :, order] for law in DIRECT}
    return result | {"s_star": first.s_star[:, order]}


@registered(
    "fig07_three_two",
    "directTHREE over directTWO in the images",
    "Fig. 7, section 6",
    3.4,
    _data_direct,
    laws=DIRECT,
    alt="Paths of the markers in both camera images under directTHREE and directTWO.",
)
def _draw_direct(data: Data, figure: "Figure") -> None:
    """Both laws over one another, one panel a camera."""
    every = np.concatenate([data[f"s_{law}"].reshape(-1, 2) for law in DIRECT])
    figure.set_figheight(_PANEL_WIDTH * style.aspect(every) + 1.05)
    axes = figure.subplots(1, 2)
    looks: tuple[style.Look, ...] = (
        {"color": style.BLACK, "linewidth": 1.1},
        {"color": style.VERMILION, "linewidth": 1.1, "linestyle": (0, (4, 1.5))},
    )
    for view, name in enumerate(VIEWS):
        shown = [data["s_star"][view]]
        for law, look in zip(DIRECT, looks, strict=True):
            s = data[f"s_{law}"][:, view]
            shown.append(s.reshape(-1, 2))
            for k in range(s.shape[1]):
                axes[view].plot(*s[:, k].T, **look)
        style.face(axes[view], data[f"s_{DIRECT[0]}"][0, view], style.START, fill=True)
        style.face(axes[view], data["s_star"][view], style.GOAL)
        style.frame_pixels(axes[view], np.concatenate(shown))
        style.image_axes(axes[view], f"{name} camera")
    legend: dict[str, style.Look] = {TITLES[law]: look for law, look in zip(DIRECT, looks, strict=True)}
    style.legend_below(figure, legend | {"start": style.START, "goal": style.GOAL}, 4)


def _data_errors(material: Material) -> Data:
    """Image errors of the markers and of the centre under directTHREE, over time."""
    trace = material.traces[DIRECT[0]]
    center = center_image(material, trace)
    goal = np.append(material.goal_center(trace), 1.0)
    m = material.plant.model.P @ goal
    return {
        "t_s": trace.period * np.arange(len(trace.s)),
        "e": trace.s - trace.s_star,
        "center_e": center - m[:, :2] / m[:, 2:],
        "law": np.array(TITLES[trace.law]),
        "marker": np.array(material.numbers),
    }


@registered(
    "fig11_image_errors",
    "Image errors of the markers and of the centre",
    "Fig. 11, section 6",
    3.2,
    _data_errors,
    laws=DIRECT[:1],
    goal=True,
    alt="For each camera: the errors of u and v of every marker and of the centre over time.",
)
def _draw_errors(data: Data, figure: "Figure") -> None:
    """One panel a camera; u solid, v dashed, the centre thick."""
    axes = figure.subplots(1, 2, sharey=True)
    t = data["t_s"]
    thick: style.Look = {"color": style.GREY, "linewidth": 3.0, "alpha": 0.6}
    thin: style.Look = {"color": style.BLACK, "linewidth": 0.9}
    for view, name in enumerate(VIEWS):
        e = data["e"][:, view]
        for k in range(e.shape[1]):
            look = _marker_look(k) | {"markevery": (k * len(t) // 60, max(1, len(t) // 12))}
            axes[view].plot(t, e[:, k, 0], **look)
            axes[view].plot(t, e[:, k, 1], linestyle=(0, (3, 1.2)), **look)
        center = data["center_e"][:, view]
        axes[view].plot(t, center[:, 0], **thick)
        axes[view].plot(t, center[:, 1], linestyle=(0, (2, 1)), **thick)
        axes[view].set(title=f"{name} camera, {data['law']}", xlabel="time (s)")
    axes[0].set_ylabel("image error $s - s_*$ (px)")
    looks = {f"marker {number}": _marker_look(k) for k, number in enumerate(data["marker"])}
    looks |= {"centre": thick, "u": thin, "v": thin | {"linestyle": (0, (3, 1.2))}}
    style.legend_below(figure, looks, min(len(looks), 8))


def _marker_look(k: int) -> style.Look:
    """Colour and symbol of a marker; how its curve is broken says u or v."""
    color, _, symbol = style.CURVES[k % len(style.CURVES)]
    return {"color": color, "linewidth": 0.9, "marker": symbol, "markersize": 3.0}
