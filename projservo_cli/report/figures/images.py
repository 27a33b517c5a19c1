"""Figs. 4, 7 and 11 of [RH00], the overview and frames: paths and errors of the markers in the images."""

import io
import math
import textwrap
from typing import Any

import numpy as np

from projservo_cli.geometry.kinematics import project
from projservo_cli.laws import CLASSICAL_LAWS, PAPER_LAWS, PROJECTIVE_LAWS, title_of
from projservo_cli.loop.verdicts import plateau_stretches
from projservo_cli.records import (
    CORNERS,
    ByteArray,
    FloatArray,
    IncidenceHistory,
    IntArray,
    RecordedFrames,
    Trace,
)
from projservo_cli.report import panels, style
from projservo_cli.report.figure_inputs import DIRECT, Data, Driven, ReportData, percent, registered, title
from projservo_cli.task.face import cyclic_order

# Classical laws of the paper; other laws are among every run.
_CLASSICAL = tuple(law for law in PAPER_LAWS if law in CLASSICAL_LAWS)
_PANELS_WIDTH, _PANEL_WIDTH = 5.8, 3.6  # inches, of all panels side by side, and of one at most
_PATH = style.line(style.BLACK, width=0.9, label="path of a marker")
_PLATEAU = style.line(style.VERMILION, width=2.0, marker="s", label="plateau of the error")
_STOPPED = style.dots(style.BLACK, "x", "end of the run", markersize=4)


def _data_classical(report_data: ReportData) -> Data:
    """Image paths of the classical laws that were run, with their hidden and stationary stretches."""
    result: Data = {"image_size": report_data.plant.image_size}
    order = report_data.plant.order
    for law in _CLASSICAL:
        if law in report_data.traces:
            trace = report_data.traces[law]
            result |= {
                f"s_{law}": trace.s[:, :, order],
                f"s_star_{law}": trace.s_star[:, order],
                f"hidden_{law}": trace.self_occluded,
                f"plateau_{law}": plateau_stretches(trace.convergence_error, report_data.stall_periods),
                f"verdict_{law}": np.array(f"{trace.verdict}, {trace.steps} steps"),
            }
    return result | {"view": np.array(report_data.view)}


def _panel_width(views: int) -> float:
    """Width in inches by which the height of one of V panels side by side is chosen."""
    return min(_PANELS_WIDTH / views, _PANEL_WIDTH)


@registered(
    "fig04_classical",
    "Image trajectories of the classical laws",
    "Fig. 4, section 6",
    _data_classical,
    laws=_CLASSICAL,
    any_law=True,
    alt="A row for each classical law, a panel for each camera: the paths of the markers from start "
    "to goal, with the stretches in which the face is hidden and in which the image error "
    "stands still.",
)
def _draw_classical(data: Data, figure: "style.Figure") -> None:
    """One row per law, one column per camera."""
    laws, size = [law for law in _CLASSICAL if f"s_{law}" in data], data["image_size"]
    names = data["view"]
    drawn = [np.concatenate([data[f"s_{law}"], data[f"s_star_{law}"][None]]) for law in laws]
    near = [[style.near_pixels(s[:, view], size[view]) for view in range(len(names))] for s in drawn]
    heights = [_panel_width(len(names)) * style.aspect(np.concatenate(pixels)) for pixels in near]
    figure.set_figheight(sum(heights) + 0.78 * len(laws) + 0.45)
    rows = panels.rows(figure, [len(names)] * len(laws), heights)
    for row, law, pixels in zip(rows, laws, near, strict=True):
        s = data[f"s_{law}"]
        panels.images(row, [panels.DrawnRun(s, _PATH, data[f"hidden_{law}"])], data[f"s_star_{law}"])
        for view, panel in enumerate(row):
            for first, last in data[f"plateau_{law}"]:
                style.paths(panel, s[first : last + 1, view], _PLATEAU | {"markevery": [0]})
            panel.plot(*s[-1, view].T, **_STOPPED)
            style.border(panel, size[view], pixels[view])
        panels.cameras(row, names, f"{title_of(law)}: {data[f'verdict_{law}']}", pixels)
    style.legend_below(figure, 4)


def _data_direct(report_data: ReportData) -> Data:
    """Image paths of both direct laws."""
    order = report_data.plant.order
    result: Data = {f"s_{law}": report_data.traces[law].s[:, :, order] for law in DIRECT}
    s_star = report_data.traces[DIRECT[0]].s_star[:, order]
    return result | {"s_star": s_star, "view": np.array(report_data.view)}


@registered(
    "fig07_three_two",
    "directTHREE over directTWO in the images",
    "Fig. 7, section 6",
    _data_direct,
    laws=DIRECT,
    alt="Paths of the markers in the camera images under directTHREE and directTWO.",
)
def _draw_direct(data: Data, figure: "style.Figure") -> None:
    """Both laws over one another, one panel a camera."""
    runs = [
        panels.DrawnRun(data[f"s_{law}"], style.LAW_LINES[law] | {"label": title_of(law)}) for law in DIRECT
    ]
    names, aspect = data["view"], style.aspect(np.concatenate([run.s for run in runs]))
    figure.set_figheight(_panel_width(len(names)) * aspect + 1.05)
    (row,) = panels.rows(figure, [len(names)])
    panels.images(row, runs, data["s_star"])
    panels.cameras(row, names)
    style.legend_below(figure, 4)


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
        "view": np.array(trace.view),
    }


_MARKER = {"linewidth": 0.9, "markersize": 3.0}
_CENTER_ERROR = style.line(style.GREY, width=3.0, alpha=0.6)
_COORDINATES = (
    style.line(style.BLACK, width=0.9, label="u"),
    style.line(style.BLACK, (0, (3, 1.2)), 0.9, label="v"),
)


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
def _draw_errors(data: Data, figure: "style.Figure") -> None:
    """One panel a camera; u solid, v dashed, the centre thick, if it is known."""
    t, numbers, names = data["t_s"], data["marker"], data["view"]
    axes = figure.subplots(1, len(names), sharey=True, squeeze=False)[0]
    for view, panel in enumerate(axes):
        for k, number in enumerate(numbers):
            every = {"markevery": (k * len(t) // 60, max(1, len(t) // 12))}
            line = style.curve(k, f"marker {number}", marker=True) | _MARKER | every
            _coordinates(panel, t, data["e"][:, view, k], line)
        if "center_e" in data:
            _coordinates(panel, t, data["center_e"][:, view], _CENTER_ERROR | {"label": "centre"})
        panel.set_xlabel("time (s)")
    panels.titles(axes, names, str(data["law"]))
    axes[0].set_ylabel("image error $s - s_*$ (px)")
    style.legend_below(figure, min(len(numbers) + 3, 8), _COORDINATES)


def _coordinates(axes: "style.Axes", t: FloatArray, pixels: FloatArray, line: style.LineStyle) -> None:
    """Draw u and v of pixels (k, 2) over time (k,), distinguished by their dashes."""
    for values, coordinate in zip(pixels.T, _COORDINATES, strict=True):
        axes.plot(t, values, **line | {"linestyle": coordinate["linestyle"]})


# The overview.
_OVERVIEW_LAWS = ("direct_three", "stacked")
_IMAGE_WIDTH, _ERRORS_WIDTH = 3.7, 2.1  # inches, of the panels with images and of those next to them
_ASPECTS = (0.45, 0.9)  # height over width of an image, within: an error panel has its height
_PERCENT = (1e-2, 200.0)  # shown of a control error: below, noise of the calibration rules
_NEAR_ZERO = np.radians(1.0)  # rad; a rotation that starts within it may be noise, which is no whole
_LEGEND_ROOM = 20.0  # points between a panel and its title
_CENTER = style.line(style.GREEN, width=3.2, label=f"centre under {title_of(DIRECT[0])}")
_ERRORS = {"tau_affine": r"$\tau$", "theta_r": r"$\theta_r$", "theta_p": r"$\theta_p$"}


def _data_overview(report_data: ReportData) -> Data:
    """Paths and image errors of the direct and the stacked law, control errors of the direct one."""
    order = report_data.plant.order
    direct = report_data.traces[DIRECT[0]]
    result: Data = {
        "s_star": direct.s_star[:, order],
        "center": report_data.center_image(direct),
        "period_s": np.array(direct.period),
        **{f"{name}_percent": np.abs(percent(getattr(direct, name))) for name in _ERRORS},
    }
    for name in ("theta_r", "theta_p"):
        if abs(getattr(direct, name)[0]) < _NEAR_ZERO:
            result[f"{name}_percent"] = np.full(len(direct.tau), np.nan)
    for law in _OVERVIEW_LAWS:
        trace = report_data.traces[law]
        hidden = trace.self_occluded
        end = f"{trace.verdict} in {trace.steps} steps, face hidden in {hidden.any(axis=1).sum()}"
        result |= {
            f"s_{law}": trace.s[:, :, order],
            f"hidden_{law}": hidden,
            f"image_error_{law}": trace.image_error,
            f"verdict_{law}": np.array(f"{title_of(law)}: {end}"),
        }
    return result | {"view": np.array(report_data.view)}


@registered(
    "fig00_overview",
    "One run at a glance: the classical and the direct law in the images, and their errors",
    "not in the paper",
    _data_overview,
    laws=_OVERVIEW_LAWS,
    alt="Left: paths of the markers in the camera images, from the face at the start to the goal, "
    "for directTHREE and the stacked law, with the stretches in which the face is hidden. "
    "Right: control errors of directTHREE and image errors of both laws over time.",
)
def _draw_overview(data: Data, figure: "style.Figure") -> None:
    """Left the images of the cameras, right the errors."""
    names = data["view"]
    drawn_parts = ("s_star", "center", *(f"s_{law}" for law in _OVERVIEW_LAWS))
    pixels = np.concatenate([data[name].reshape(-1, 2) for name in drawn_parts])
    aspect, rows = style.aspect(pixels, *_ASPECTS), max(2, len(names))
    figure.set_figheight(rows * _IMAGE_WIDTH * aspect + 1.75 + 0.6 * (rows - 2) + _LEGEND_ROOM / 72.0)
    grid = figure.add_gridspec(rows, 2, width_ratios=(_IMAGE_WIDTH, _ERRORS_WIDTH))
    cells = [grid[:, 0]] if len(names) == 1 else [grid[view, 0] for view in range(rows)]
    images = [figure.add_subplot(cell) for cell in cells]
    control, pixel = figure.add_subplot(grid[0, 1]), figure.add_subplot(grid[1:, 1])
    lines = {law: style.LAW_LINES[law] | {"label": str(data[f"verdict_{law}"])} for law in _OVERVIEW_LAWS}
    runs = [panels.DrawnRun(data[f"s_{law}"], line, data[f"hidden_{law}"]) for law, line in lines.items()]
    panels.images(images, runs[::-1], data["s_star"])
    for view, panel in enumerate(images):
        panel.plot(*data["center"][:, view].T, **_CENTER)
    panels.cameras(images, names)
    _control_errors(control, data)
    curves: list[panels.Curve] = []
    for law, line in lines.items():
        e, hidden = data[f"image_error_{law}"], data[f"hidden_{law}"].any(axis=1)
        t = data["period_s"] * np.arange(len(e))
        curves += [(t, np.where(hidden, e, np.nan), style.HIDDEN), (t, e, line)]
    panels.errors(pixel, curves, title="image errors, both laws", ylabel="rms (px)")
    style.legend_below(figure, 2)


def _control_errors(axes: "style.Axes", data: Data) -> None:
    """Draw the errors of the direct law in % of their start, with a legend above them."""
    curves = []
    for index, (name, label) in enumerate(_ERRORS.items()):
        values = data[f"{name}_percent"]
        line = style.curve(index, label + " near 0" * bool(np.isnan(values[0])))
        curves.append((data["period_s"] * np.arange(len(values)), values, line))
    panels.errors(axes, curves, ylabel="error (% of its start)")
    axes.set_ylim(_PERCENT)
    axes.set_title(f"control errors, {title_of(DIRECT[0])}", pad=_LEGEND_ROOM)
    axes.legend(
        handlelength=1.5, columnspacing=1.0, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=len(_ERRORS)
    )


# Frames.
_SHORT_NAME = 5  # characters of the name of a camera that leave room for a moment in one line
_MOMENTS = ("start", "in the middle", "end")
_HALO = 1.2  # points, by which lines over a frame are wider in white
_FOUND = style.dots(style.ORANGE, "+", "markers found", markersize=4.0)
_FACE = style.line(style.GREEN, width=1.2, label="face")
_DRIVEN = style.line(style.VERMILION, width=0.9, label="path of a marker")
OF_TOOL = style.line(style.GREEN, width=3.6, marker="o", label="features of the tool")
OF_SCENE = style.line(style.BLUE, style.DASHED, 1.4, "o", "features of the scene")
_OF_TOOL_AT_START = OF_TOOL | style.START | {"label": "features of the tool at the start"}
_FINE = {"linewidth": 1.6, "markersize": 2.0}  # over frames
_FAINT_FACE = style.line(style.GREY, width=0.7, label="face at the start and at the end")


def frames_of_run(
    kept: RecordedFrames, selected: IntArray | None = None, width: int | None = None
) -> list[ByteArray]:
    """Frames (k, height, width) of each view of a run, of those kept the selected (k,).

    width : px that they need not exceed, at which they are read faster and smaller.
    """
    from PIL import Image

    ends = np.cumsum(kept.frame_size).reshape(kept.frame_size.shape)
    films = []
    for ends_of_view, sizes in zip(ends.T, kept.frame_size.T, strict=True):
        grey_frames = []
        for k in np.arange(len(sizes)) if selected is None else selected:
            end, size = ends_of_view[k], sizes[k]
            image = Image.open(io.BytesIO(kept.frame_jpeg[end - size : end].tobytes()), formats=["JPEG"])
            if width is not None and image.width > width:
                image.draft("L", (width, width * image.height // image.width))
            grey_frames.append(np.asarray(image.convert("L")))
        films.append(np.array(grey_frames))
    return films


def _runs_with(report_data: Driven | ReportData, part: str) -> list[tuple[str, Trace, Any]]:
    """Names and traces of the runs that have a part, which is the third, first the direct laws."""
    runs = [
        (name, trace, found)
        for name, trace in report_data.traces.items()
        if (found := getattr(trace, part)) is not None
    ]
    return sorted(runs, key=lambda run: run[0] not in PROJECTIVE_LAWS)


def _filmed(report_data: Driven | ReportData) -> bool:
    return bool(_runs_with(report_data, "frames"))


def _data_frames(report_data: Driven | ReportData) -> Data:
    """Frames of three moments, all that was found in them, the path of the face and its goal.

    The run is one of those with frames.
    """
    order = cyclic_order(report_data.plan.A)
    name, trace, kept = _runs_with(report_data, "frames")[0]
    half = np.abs(trace.image_error[kept.frame_index] - 0.5 * trace.image_error[0])
    selected = np.array([0, int(np.nanargmin(half)), len(half) - 1])
    frames = frames_of_run(kept, selected)
    return {
        "run": np.array(f"{title(name)}, {trace.verdict}"),
        "instant": kept.frame_index[selected],
        "period_s": np.array(trace.period),
        "found": kept.frame_s[selected],
        "s": trace.s[:, :, order],
        "s_star": trace.s_star[:, order],
        **_feature_images(trace.of_incidences, kept.frame_index[selected]),
        **{f"frames_{view}": grey_frames for view, grey_frames in enumerate(frames)},
        "view": np.array(trace.view),
    }


def with_halo(axes: "style.Axes") -> None:
    """Draw all lines over a frame with a white margin, so that they show on any ground."""
    from matplotlib.patheffects import withStroke

    for line in axes.lines:
        line.set_path_effects([withStroke(linewidth=line.get_linewidth() + _HALO, foreground="white")])


@registered(
    "fig17_frames",
    "Images of the cameras at the start, in the middle and at the end",
    "not in the paper",
    _data_frames,
    shows=(_filmed, "the robot shows no frames"),
    alt="A row for each camera, with its image at the start, in the middle and at the end. Drawn over "
    "them are the markers that were found, the face with the past paths of its markers, and the goal.",
)
def _draw_frames(data: Data, figure: "style.Figure") -> None:
    """A row per camera, a column per moment."""
    names = data["view"]
    sizes = np.array([data[f"frames_{view}"].shape[1:] for view in range(len(names))])
    heights = style.WIDTH / 3.0 * sizes[:, 0] / sizes[:, 1]
    figure.set_figheight(float(heights.sum()) + 1.1 + 0.4 * max(0, len(names) - 2))
    axes = figure.subplots(len(names), 3, squeeze=False, height_ratios=heights)
    for (view, i), panel in np.ndenumerate(axes):
        height, width = sizes[view]
        panel.imshow(data[f"frames_{view}"][i], cmap="gray", vmin=0, vmax=255)
        s = data["s"][: data["instant"][i] + 1, view]
        style.paths(panel, s, _DRIVEN)
        style.face(panel, s[-1], _FACE)
        style.face(panel, data["s_star"][view], style.GOAL)
        panel.plot(*data["found"][i, view].T, **_FOUND)
        if "feature" in data:
            panel.plot(*style.outlines(data["feature_there"][:, :, view]).T, **OF_SCENE | _FINE)
            panel.plot(*style.outlines(data["feature"][i, :, :, view]).T, **OF_TOOL | _FINE)
        with_halo(panel)
        panel.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xticks=[], yticks=[])
        seconds = data["instant"][i] * float(data["period_s"])
        run = f"{data['run']}\n" if not (view or i) else ""
        apart = ", " if len(names[view]) <= _SHORT_NAME else "\n"
        panel.set_title(f"{run}{names[view]} camera{apart}{_MOMENTS[i]}, {seconds:.2f} s")
    style.legend_below(figure, 4)


_LEAST_PX = 1e-3  # lowest error that is drawn
_ARROW = 0.06  # arrow of free motions, over the size of the drawing
_FREE = style.line(style.PURPLE, width=1.4)
_TITLES = 84  # characters of all titles in a row
_ERRORS_HEIGHT = 3.2  # inches, of the panels of errors with titles and legend
_LEAST_ASPECT = 0.55  # height over width of an image of features
_PANELS = 4  # most panels of errors in a row


def _feature_images(found: IncidenceHistory | None, samples: IntArray) -> Data:
    """Images of the features of the tool at instants (k,) and of features of the scene; none for a pose."""
    if found is None:
        return {}
    return {"feature": found.feature_s[samples], "feature_there": found.feature_s_star}


def _data_incidences(report_data: ReportData | Driven) -> Data:
    """Images of features at both ends of a run, and the error of each incidence over time in all runs.

    Motions of a sequence have separate incidences: those of other runs are NaN.
    """
    name, drawn_parts, there = _runs_with(report_data, "of_incidences")[0]
    result: Data = {
        "run": np.array(title(name)),
        "free_dof": np.array(-1 if there.free_dof is None else there.free_dof),
        "face": drawn_parts.s[[0, -1]][:, :, cyclic_order(report_data.plan.A)],
        "face_at_end": drawn_parts.s[-1],
        "view": np.array(drawn_parts.view),
        **_feature_images(there, np.array([0, -1])),
        **{key: free for key in ("free_motion", "free_s") if (free := getattr(there, key)) is not None},
    }
    every = {name: trace.of_incidences for name, trace in report_data.traces.items()}
    asking = {name: found for name, found in every.items() if found is not None}
    each = list(dict.fromkeys(name for found in asking.values() for name in found.incidences))
    result["incidence"] = np.array(each)
    stated = result["incidence_mm"], result["incidence_deg"] = np.full((2, len(each)), np.nan)
    for name, found in [*asking.items(), ("", there)]:
        own = [each.index(incidence) for incidence in found.incidences]
        for all_stated, one in zip(stated, (found.incidence_mm, found.incidence_deg), strict=True):
            all_stated[own] = one
        if name:
            result[f"t_s_{name}"] = report_data.traces[name].period * np.arange(len(found.incidence_px))
            result[f"px_{name}"] = np.full((len(found.incidence_px), len(each)), np.nan)
            result[f"px_{name}"][:, own] = found.incidence_px
    return result


def _of_features(report_data: Driven | ReportData) -> bool:
    return bool(_runs_with(report_data, "of_incidences"))


@registered(
    "fig19_incidences",
    "Incidences in the images, and their errors",
    "not in the paper",
    _data_incidences,
    shows=(_of_features, "the goal is a whole pose"),
    alt="Above, for each camera: the features of the tool at the start and end of a run, features of the "
    "scene, and how the motions that are left free move the face. Below, for each incidence: its error over "
    "time on a logarithmic scale, a curve for each run.",
)
def _draw_incidences(data: Data, figure: "style.Figure") -> None:
    """Above a panel for each camera, below one for each incidence with a curve for each run."""
    names, count, free = data["view"], len(data["incidence"]), int(data["free_dof"])
    drawn_parts = [
        data["face"],
        np.moveaxis(data["feature"], 3, 1),
        np.moveaxis(data["feature_there"], 2, 0)[None],
    ]
    pixels = [
        np.concatenate([part[:, view].reshape(-1, 2) for part in drawn_parts]) for view in range(len(names))
    ]
    height = _panel_width(len(names)) * style.aspect(np.concatenate(pixels), _LEAST_ASPECT)
    rows = math.ceil(count / _PANELS)
    across = math.ceil(count / rows)
    figure.set_figheight(height + rows * _ERRORS_HEIGHT)
    heights = height, *(_ERRORS_HEIGHT - 1.1,) * rows
    images, *below = panels.rows(figure, [len(names), *[across] * rows], heights)
    for view, panel in enumerate(images):
        for face in data["face"][:, view]:
            style.face(panel, face, _FAINT_FACE)
        start, end = data["feature"][:, :, :, view]
        panel.plot(*style.outlines(start).T, **_OF_TOOL_AT_START)
        panel.plot(*style.outlines(end).T, **OF_TOOL)
        panel.plot(*style.outlines(data["feature_there"][:, :, view]).T, **OF_SCENE)
        extent = np.ptp(pixels[view][np.isfinite(pixels[view][:, 0])], axis=0)
        _draw_free(panel, data, view, _ARROW * extent.max())
    left = f", {free or 'no'} joint motion{'s' * (free != 1)} free" if free >= 0 else ""
    panels.cameras(images, names, f"{data['run']}{left}", pixels)
    errors = [panel for row in below for panel in row]
    for panel in errors[count:]:
        panel.remove()
    for k, (panel, incidence) in enumerate(zip(errors, data["incidence"], strict=False)):
        _errors_of_runs(panel, data, k)
        panel.set_title(textwrap.fill(str(incidence), _TITLES // across) + _within(data, k))
    style.legend_below(figure, 4)


def _pixel_errors(data: Data) -> dict[str, FloatArray]:
    """Errors by the name of their run, px."""
    return {name.removeprefix("px_"): data[name] for name in data if name.startswith("px_")}


def _errors_of_runs(panel: "style.Axes", data: Data, k: int) -> None:
    """Draw the error of an incidence over time, a curve for each run, on the scale of all incidences."""
    runs = _pixel_errors(data)
    curves = [
        (data[f"t_s_{name}"], errors[:, k], style.curve(i, title(name)))
        for i, (name, errors) in enumerate(runs.items())
        if np.isfinite(errors[:, k]).any()
    ]
    panels.errors(panel, curves, _LEAST_PX, ylabel="error (px at one px of noise)")
    every = np.concatenate([errors.ravel() for errors in runs.values()])
    every = np.maximum(every[np.isfinite(every)], _LEAST_PX)
    panel.set_ylim(0.5 * every.min(initial=1.0), 2.0 * every.max(initial=1.0))


def _within(data: Data, k: int) -> str:
    """Error of an incidence as it is stated at the end, in words; empty if it is unknown."""
    units = ("incidence_mm", " mm"), ("incidence_deg", "°")
    said = [f"{data[key][k]:.2g}{unit}" for key, unit in units if np.isfinite(data[key][k])]
    return f"\nwithin {', '.join(said)}" if said else ""


def _draw_free(panel: "style.Axes", data: Data, view: int, length: float) -> None:
    """Draw at the corners of the face at the end how free motions move them, the farthest by a length, px."""
    for i, moved in enumerate(data.get("free_s", ())):
        face, arrow = data["face_at_end"][view], moved[view]
        arrow = arrow * length / max(float(np.linalg.norm(arrow, axis=1).max()), 1e-9)
        ends = np.stack([face - arrow, face + arrow], axis=1)
        panel.plot(*style.outlines(ends).T, **_FREE | ({} if i else {"label": "free motions"}))


def _data_sequence(report_data: Driven) -> Data:
    """Error that decides convergence over time, of one motion of a sequence after the other."""
    result, before = Data(), 0.0
    for name, trace in report_data.traces.items():
        time = trace.period * np.arange(len(trace.convergence_error))
        result |= {f"t_s_{name}": before + time, f"px_{name}": trace.convergence_error}
        before += float(time[-1])
    return result


def _of_motions(report_data: Driven | ReportData) -> bool:
    return isinstance(report_data, Driven) and any("/" in name for name in report_data.traces)


@registered(
    "fig20_sequence",
    "Image errors of the motions of a sequence",
    "not in the paper",
    _data_sequence,
    height=3.2,
    shows=(_of_motions, "the task is one motion"),
    alt="The image error of each motion over time, one after the other, on a logarithmic scale.",
)
def _draw_sequence(data: Data, figure: "style.Figure") -> None:
    """A curve for each motion."""
    panel = figure.subplots()
    curves = [
        (data[f"t_s_{name}"], error, style.curve(i, name.split("/")[0]))
        for i, (name, error) in enumerate(_pixel_errors(data).items())
    ]
    panels.errors(panel, curves, _LEAST_PX, xlabel="time of motion (s)", ylabel="error (px)")
    style.legend_below(figure, 3)


# Objects.
_TAUGHT = style.line(
    style.GREY, width=1.2, marker="o", markersize=2.5, label="object when the goal was taught"
)
_NOW = style.line(style.BLUE, width=1.6, marker="o", markersize=2.5, label="object now")
_MOVED = style.line(style.ORANGE, width=0.8, label="its displacement")
_CARRIED = style.line(style.GREEN, width=1.6, label="face at the carried goal")


def _data_object(report_data: ReportData | Driven) -> Data:
    """Images of the objects of the goal when it was taught and now, and of the face at the carried goals."""
    plan, order = report_data.plan, cyclic_order(report_data.plan.A)
    data: Data = {
        "about": np.array([one.object_words for one in plan.carried]),
        "view": np.array(plan.view),
        "object": np.array([one.object_name for one in plan.carried]),
    }
    for one in plan.carried:
        data |= {
            f"marker_{one.object_name}": one.object_marker,
            f"taught_{one.object_name}": one.s_object_taught,
            f"now_{one.object_name}": one.s_object,
            f"face_{one.object_name}": one.s_carried[:, order],
        }
    return data


def _carried(report_data: Driven | ReportData) -> bool:
    return bool(report_data.plan.carried)


@registered(
    "fig22_object",
    "The object of the goal, and the goal carried along",
    "not in the paper",
    _data_object,
    shows=(_carried, "no object carries the goal"),
    alt="For each camera: the tags of the object when the goal was taught and now, the displacement of each "
    "marker, and the face at the goal that was carried along.",
)
def _draw_object(data: Data, figure: "style.Figure") -> None:
    """A row for each object, with a panel for each camera."""
    names = data["view"]
    rows = panels.rows(figure, [len(names)] * len(data["object"]))
    for row, name in zip(rows, data["object"].tolist(), strict=True):
        tags = data[f"marker_{name}"] // CORNERS
        images = (data[f"{key}_{name}"] for key in ("taught", "now", "face"))
        for panel, taught, now, face in zip(row, *images, strict=True):
            moved = np.stack([taught, now], axis=1)
            panel.plot(*style.outlines(moved[np.isfinite(moved).all(axis=(1, 2))]).T, **_MOVED)
            for drawn_parts, line in ((taught, _TAUGHT), (now, _NOW)):
                each = [
                    style.outlines(drawn_parts[None, tags == tag]) for tag in dict.fromkeys(tags.tolist())
                ]
                panel.plot(*np.concatenate(each).T, **line)
            style.face(panel, face, _CARRIED)
        panels.cameras(row, names, name if len(rows) > 1 else "")
    figure.set_figheight(3.8 * len(rows) + 0.4)
    figure.suptitle("\n".join(textwrap.fill(str(about), 90) for about in data["about"]))
    style.legend_below(figure, 2)
