"""Figure 16: the planned motion in the images, its joints and its margins over time, and search trees."""

from itertools import cycle
from typing import Any

import numpy as np

from projservo_cli.geometry.kinematics import forward_kinematics, project
from projservo_cli.image_size import BEHIND
from projservo_cli.records import FloatArray, Plan
from projservo_cli.report import panels, style
from projservo_cli.report.figure_inputs import Data, ReportData, joint_kinds, joint_units, registered

PIECES = 4  # pieces of each edge of a tree, which is curved in an image
_IMAGES_WIDTH, _ROW = 5.8, 1.5  # inches: of all images, and the height of a row of curves
_HIGHEST = 0.8  # height of an image over its width, at most
_STRIP = 0.085  # share of the time axis for the range of a joint next to the curves
_NEAR, _NEAR_PX = 1.0, 10.0  # margins and distances up to which a scale to ten times as much is linear
_SUBSCRIPTS = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")  # as text, which takes a tenth of formulas
# Dashes of each camera; dotted lines are required values.
_SIDES: tuple[Any, ...] = (style.SOLID, (0, (4, 1.5)), style.DASH_DOTTED, (0, (3, 1, 1, 1, 1, 1)))
_CENTER = style.line(style.GREEN, width=1.6, label="path of the centre")
_CORNER = style.dots(style.VERMILION, "|", "a rounded corner begins, ends", markersize=8.0)
_TREES = {
    "start": style.line(style.SKY, width=0.5, label="tree from the start", alpha=0.7),
    "goals": style.line(style.PURPLE, width=0.5, label="tree from the goals", alpha=0.7),
}
_HATCHED: Any = {"edgecolor": style.VERMILION, "hatch": "////", "linewidth": 0.6}
_KEPT_OUT = style.patch("none", "kept-out region", **_HATCHED)
_REQUIRED = style.line(style.GREY, style.DOTTED, 0.8, label="asked for")
_RANGE: Any = {"linewidth": 3.0, "solid_capstyle": "butt"}  # a projecting cap would lengthen the range
_SHARES = {
    "visibility": style.line(style.VIOLET, label="visibility a·O (start = 1)"),
    "joints": style.line(style.GREEN, label="nearest joint limit (middle = 1)"),
    "conditioning": style.line(style.PURPLE, label="conditioning (start = 1)"),
}
_DISTANCES = {
    "border_px": style.line(style.ORANGE, label="face from the border"),
    "width_px": style.line(style.BLACK, label="width of the face"),
    "clear_px": style.line(style.VERMILION, label="body from kept-out regions"),
}


def _data(report_data: ReportData) -> Data:
    """Images, joints and margins along the plan; trees as lines with NaN between their edges."""
    plan, order, model = report_data.plan, report_data.plant.order, report_data.calibrated
    slides = report_data.robot.prismatic
    unit = joint_units(slides)
    timed, search = bool(np.isfinite(plan.time).all()), plan.search
    name = f"{plan.profile.replace('_', ' ')} profile"
    if plan.profile == "joint_space" and not plan.feasible:
        name = "no path found, linear motion"
    result: Data = {
        "name": np.array(name),
        **({"t_s": plan.time} if timed else {"sigma": plan.path_parameter}),
        "s": plan.s[:, :, order],
        "s_star": plan.s_star[:, order],
        "center": np.moveaxis(project(model.P, plan.H_d @ plan.A_c, model.lens), 0, 1),
        "image_size": report_data.plant.image_size,
        "prismatic": slides,
        "q_deg_or_mm": plan.q * unit,
        "q_start_deg_or_mm": plan.q_start * unit,
        "limits_deg_or_mm": np.stack([report_data.robot.limits.lower, report_data.robot.limits.upper]) * unit,
        "corner_s": np.zeros((0, 2)) if search is None or search.blends is None else search.blends,
        "visibility": plan.margin,
        "joints": plan.joint_margin[:, None],
        "conditioning": (plan.reciprocal_condition / plan.reciprocal_condition[0])[:, None],
        **_distances(plan, report_data.trajectory.border_px),
    }
    for i, region in enumerate(report_data.trajectory.keep_out):
        for view in plan.view:
            if (polygon := getattr(region, view, None)) is not None:
                result[f"kept_out_{view}_{i}"] = np.array(polygon)
    if search is not None and search.tree_q is not None:
        result["nodes"] = np.array([len(search.tree_q), search.tree_nodes])
        M = np.linalg.solve(forward_kinematics(model, plan.q_start), plan.A_c)
        for name, edges in zip(_TREES, tree_edges(plan), strict=True):
            points = np.array([forward_kinematics(model, q) @ M for q in edges.reshape(-1, edges.shape[-1])])
            result[f"tree_{name}"] = with_gaps(np.moveaxis(project(model.P, points, model.lens), 0, 1))
    return result | {"view": np.array(plan.view)}


def _distances(plan: Plan, border_px: float) -> Data:
    """Return distances in px and their required values; for a joint-space path, of its constraints."""
    search = plan.search
    if search is None or search.margins is None or search.required_margins is None:
        distance = np.where(plan.border_distance > BEHIND, plan.border_distance, np.nan)
        return {"border_px": distance, "border_px_asked": np.full_like(distance, border_px)}
    distances: Data = {}
    views = len(plan.view)  # four margins have each view, between margins of the joints and of regions
    width, border, clear = (np.arange(k, k + views) for k in (1 + 2 * views, 1 + 3 * views, 1 + 4 * views))
    for name, columns in (("border_px", border), ("width_px", width), ("clear_px", clear[:1])):
        if np.isfinite(search.margins[:, columns[0]]).all():
            distances[name] = search.margins[:, columns]
            distances[f"{name}_asked"] = search.required_margins[:, columns]
    return distances


def tree_edges(plan: Plan) -> list[FloatArray]:
    """Joints (e, PIECES + 1, n) along the edges of the tree from the start, and of that from the goals."""
    if plan.search is None or plan.search.tree_q is None or plan.search.tree_parent is None:
        return []
    q, parent = plan.search.tree_q, plan.search.tree_parent
    share = np.linspace(0.0, 1.0, PIECES + 1)[:, None]
    second = int(np.append(np.flatnonzero(parent < 0), len(q))[1])
    edges = []
    for nodes in (np.arange(second), np.arange(second, len(q))):
        nodes = nodes[parent[nodes] >= 0]
        start, end = q[parent[nodes], None], q[nodes, None]
        edges.append(start + share * (end - start))
    return edges


def with_gaps(points: FloatArray) -> FloatArray:
    """Points (k, …) of one edge after the other as one line, with NaN after each edge."""
    edges = points.reshape(-1, PIECES + 1, *points.shape[1:])
    gaps = np.full_like(edges[:, :1], np.nan)
    return np.concatenate([edges, gaps], axis=1).reshape(-1, *points.shape[1:])


@registered(
    "fig16_way",
    "The planned motion in the images, its joints and its margins over time",
    "not in the paper, after section 4",
    _data,
    alt="Above, for each camera, the paths of the markers and of the centre of the face, regions that are "
    "kept out of, and the search trees, if any. Below left the joints over time with their "
    "ranges, below right the margins and distances over time, with their required values.",
)
def _draw(data: Data, figure: "style.Figure") -> None:
    """Above the images; below left the joints, by kind, right the constraints."""
    kinds, names = joint_kinds(data["prismatic"]), data["view"].tolist()
    visible = [_visible(data, view) for view in range(len(names))]
    image = _IMAGES_WIDTH / max(2, len(names)) * style.aspect(np.concatenate(visible), upper=_HIGHEST)
    figure.set_figheight(image + 2.0 * _ROW + 2.05)
    images, (joints, shares), (slides, distances) = panels.rows(
        figure, [len(names), 2, 2], [image, _ROW, _ROW]
    )
    for view, panel in enumerate(images):
        _around(panel, data, view)
    panels.images(images, [panels.DrawnRun(data["s"], panels.PATH)], data["s_star"])
    panels.cameras(images, names, str(data["name"]), visible)
    for view, panel in enumerate(images):
        _center(panel, data, data["center"][:, view])
        style.border(panel, data["image_size"][view], visible[view])
    if len(kinds) == 1:
        slides.remove()
        place: Any = joints.get_subplotspec()
        joints.set_subplotspec(place.get_gridspec()[1:, : place.colspan.stop])
    for panel, (chosen, unit) in zip((joints, slides), kinds, strict=False):
        _joints(panel, data, chosen, unit)
    _constraints(shares, data, _SHARES, _NEAR)
    _constraints(distances, data, _DISTANCES, _NEAR_PX)
    shares.set(ylabel="margin (1)", xlabel="")
    shares.tick_params(labelbottom=False)
    distances.set_ylabel("distance (px)")
    notes = [
        style.line(style.GREY, dash, label=f"{name} camera")
        for name, dash in zip(names, cycle(_SIDES), strict=False)
    ]
    if len(names) > 1:
        notes[0]["label"] += ", or both" if len(names) == 2 else ", or all"
    notes += [_REQUIRED, style.line(style.GREY, label="range of a joint", **_RANGE)]
    if "nodes" in data and data["nodes"][0] < data["nodes"][1]:
        stored = "{} of {} joint vectors of trees".format(*data["nodes"])
        notes.append(style.line(style.GREY, style.NO_LINE, label=stored))
    style.legend_below(figure, 3, notes)


def _kept_out(data: Data, view: int) -> list[FloatArray]:
    """Regions (k, 2) of one image that are kept out of."""
    regions = f"kept_out_{data['view'][view]}"
    return [data[name] for name in data if name.rpartition("_")[0] == regions]


def _visible(data: Data, view: int) -> FloatArray:
    """All pixels (k, 2) that are drawn of one image."""
    lines = ["center", *(f"tree_{name}" for name in _TREES if f"tree_{name}" in data)]
    drawn = [data[name][..., view, :, :] for name in ("s", "s_star")]
    drawn += [*(data[name][:, view] for name in lines), *_kept_out(data, view)]
    return style.near_pixels(
        np.concatenate([pixels.reshape(-1, 2) for pixels in drawn]), data["image_size"][view]
    )


def _around(axes: "style.Axes", data: Data, view: int) -> None:
    """Draw kept-out regions and trees in the image of one camera."""
    for region in _kept_out(data, view):
        axes.fill(*region.T, **_KEPT_OUT)
    for name, line in _TREES.items():
        if f"tree_{name}" in data:
            axes.plot(*data[f"tree_{name}"][:, view].T, **line)


def _center(axes: "style.Axes", data: Data, center: FloatArray) -> None:
    """Draw the path (k, 2) of the centre in an image, and where rounded corners of it begin and end."""
    axes.plot(*center.T, **_CENTER)
    if (ends := data["corner_s"].ravel()).size:
        axes.plot(*(np.interp(ends, _time(data)[0], column) for column in center.T), **_CORNER)


def _time(data: Data) -> tuple[FloatArray, str]:
    """Return the abscissa (k,) and its name."""
    return (data["t_s"], "time (s)") if "t_s" in data else (data["sigma"], "path parameter σ (1)")


def _joints(axes: "style.Axes", data: Data, chosen: list[int], unit: str) -> None:
    """Joints over time; right of them a bar for the range of each."""
    t, name = _time(data)
    end = float(t[-1]) or 1.0
    q, limits = data["q_deg_or_mm"], data["limits_deg_or_mm"]
    values = np.concatenate([q[:, chosen].ravel(), limits[:, chosen].ravel()])
    values = values[np.isfinite(values)]
    low, high = (float(values.min()), float(values.max())) if len(values) else (-1.0, 1.0)
    pad = 0.06 * max(high - low, 1e-3)
    named: Any = {"ha": "center", "va": "bottom", "fontsize": 6.5}
    for begin, until in data["corner_s"]:
        axes.axvspan(begin, until, color=style.PALE, linewidth=0)
    axes.axvline(end, color=style.GREY, linewidth=0.6)
    for place, i in enumerate(chosen):
        line, x = style.curve(i), end * (1.0 + _STRIP * (place + 0.7))
        axes.plot(t, q[:, i], **line)
        axes.plot([x, x], np.clip(limits[:, i], low - pad, high + pad), color=line["color"], **_RANGE)
        axes.text(x, high + 1.5 * pad, "q" + str(i + 1).translate(_SUBSCRIPTS), **named)
    colors = [style.curve(i)["color"] for i in chosen]
    axes.scatter(np.zeros(len(chosen)), data["q_start_deg_or_mm"][chosen], 9.0, colors)
    axes.set(xlabel=name, ylabel=f"joint ({unit})", ylim=(low - pad, high + 4.0 * pad))
    axes.set_xlim(-0.03 * end, end * (1.0 + _STRIP * (len(chosen) + 0.4)))
    axes.set_xticks([x for x in axes.get_xticks() if 0.0 <= x <= end])


def _constraints(axes: "style.Axes", data: Data, lines: dict[str, style.LineStyle], near: float) -> None:
    """Draw constraints over time, solid for the first camera or all, and their required values, dotted.

    near : value up to which the scale is linear if they grow beyond ten times as much.
    """
    t, name = _time(data)
    style.zero_line(axes)
    for key, line in lines.items():
        if key in data:
            for column, dash in zip(data[key].T, cycle(_SIDES), strict=False):
                axes.plot(t, column, **line | {"linestyle": dash})
        if f"{key}_asked" in data:
            axes.plot(t, data[f"{key}_asked"], **_REQUIRED | {"color": line["color"], "label": ""})
    axes.set_xlabel(name)
    if np.abs(axes.dataLim.intervaly).max() > 10.0 * near:
        style.near_zero_scale(axes, near)
