"""Runs that move: the 3D view, one page of HTML that needs no network, and the animation of the images.

The view is drawn by plotly and has a time slider; the animation has a column per law.
"""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from markupsafe import Markup

from projservo_cli.geometry.kinematics import forward_kinematics
from projservo_cli.image_size import ImageSize, image_sizes
from projservo_cli.laws import CLASSICAL_LAWS, PROJECTIVE_LAWS
from projservo_cli.messages.verdict_causes import arrived
from projservo_cli.records import BoolArray, ByteArray, FloatArray, InputError, IntArray, Plan, Trace
from projservo_cli.report import style
from projservo_cli.report.figure_inputs import PAGE_FILE, title
from projservo_cli.report.figures.images import OF_SCENE, OF_TOOL, frames_of_run, with_halo
from projservo_cli.report.figures.joint_space import tree_edges, with_gaps
from projservo_cli.report.figures.scene import (
    drawn_arm,
    edges_of,
    features_in_space,
    goal_displacement,
    plant_pyramids,
    transformed,
)
from projservo_cli.report.html import html_page
from projservo_cli.simulation.analytic_plant import Plant
from projservo_cli.simulation.arm import SerialArm
from projservo_cli.store.files_and_locks import replacing, write_whole
from projservo_cli.task.face import center_of

_MOST_INSTANTS = 60
_DOTS = 9  # on the planned path
_DIGITS = 4  # digits of coordinates in m: a tenth of a millimetre
_HEIGHT = 640  # px of the scene
_EYE = 1.75  # distance of the eye, in sizes of the scene
_LOWER = 0.15  # that it looks below the middle, if the names of the axes are
_PAD = 0.03  # around all that is shown, as a share of it
FRAME_MS, LAST_MS = 80, 2000  # duration of each frame, and of the animation's last
_TOOLS = ["orbitRotation", "pan3d", "zoom3d", "resetCameraDefault3d", "toImage"]  # none leaves the page
# A scene that is wider than high needs more distance on a narrow page.
_NEARER = """
const plot = document.getElementById("{plot_id}");
const far = Math.min(3, Math.max(1, 1050 / plot.clientWidth));
const {x, y, z} = plot.layout.scene.camera.eye;
Plotly.relayout(plot, {"scene.camera.eye": {x: far * x, y: far * y, z: far * z}});
"""
_SEEN, _HIDDEN = style.SKY, style.VERMILION
_KEY = (
    ("robot, face at the start", style.BLACK),
    ("face, features of the tool", _SEEN),
    ("face, hidden from a camera", _HIDDEN),
    ("markers", style.GREY),
    ("goal, features of the scene, planned path of the {}", style.PURPLE),
    ("driven path of the {}", style.GREEN),
)
_CAMERAS_AT = 4  # place of the cameras in this key
_TREES = (("search tree from the start", "#9cc9e8"), ("search tree from the goals", "#dcb4cd"))
_AT_ONCE = {"mode": "immediate", "frame": {"duration": 0, "redraw": True}, "transition": {"duration": 0}}
_PLAYING = _AT_ONCE | {"frame": {"duration": FRAME_MS, "redraw": True}, "fromcurrent": True}


class _Driven(NamedTuple):
    """One run at the k instants shown, in m."""

    verdict: str
    seconds: FloatArray  # (k,)
    hidden: BoolArray  # (k, V) whether the face is hidden from each camera
    path: FloatArray  # (t, 3) centre of the moving part, face or cameras, at every instant of the run
    robot: FloatArray  # (k, j, 3) from its base to the tool
    face: FloatArray  # (k, m, 3) in cyclic order
    markers: FloatArray  # (k, p, 3)
    cameras: FloatArray  # (k, V, 5, 3) optical centre and image corners of the viewing pyramids
    features: FloatArray  # (k, e, 3) line along the features of the tool


class _Motion(NamedTuple):
    """Static parts of the view, in m in the base frame, and the runs by name."""

    view: tuple[str, ...]  # names of the views
    on_tool: bool  # whether the cameras move, and the face is fixed
    cameras: FloatArray  # (V, 5, 3) optical centre and image corners of the viewing pyramids at the start
    start: FloatArray  # (m, 3) corners of the face
    # (e, 3) line around it, or along the pyramids, at the goal; None if only images of it are known
    goal: FloatArray | None
    # (s, 3) centre of the moving part along the joints of the plan, as far as they follow it
    planned: FloatArray
    # (e, 3) centre of the face along the edges of each search tree, NaN between
    trees: tuple[FloatArray, ...]
    features: FloatArray  # (e, 3) line along the features of the scene
    runs: Mapping[str, _Driven]


def motion_of(
    robot: SerialArm, plant: Plant, markers: FloatArray, plan: Plan, traces: Mapping[str, Trace]
) -> _Motion:
    """Return the view of runs with at least one step; ``markers`` (p, 4) at the robot's reference, m."""
    face = plant.M[plant.order]
    _, of_face, of_rig = drawn_arm(robot, plant, plan.q_start)
    start = (face @ of_face.T)[:, :3]
    rig, goal = plant_pyramids(plant, start), None
    if (displacement := goal_displacement(robot, traces)) is not None:
        gap = np.full((1, 3), np.nan)
        at_goal = [np.concatenate([edges_of(camera), gap]) for camera in transformed(rig, displacement)]
        around = style.closed((face @ displacement.T)[:, :3])
        goal = np.concatenate(at_goal) if plant.model.on_tool else around
    planned = _centers(plant, plan.q[np.isfinite(plan.q).all(axis=1)])
    tool, scene = features_in_space(plant, traces) or np.zeros((2, 0, 3, 3))
    features = transformed(style.outlines(tool), np.asarray(np.linalg.inv(of_face), dtype=np.float64))
    runs = {name: _driven(robot, plant, (markers, features), rig, trace) for name, trace in traces.items()}
    edges = tree_edges(plan)
    trees = tuple(with_gaps(_centers(plant, q.reshape(-1, q.shape[-1]))) for q in edges)
    cameras = transformed(rig, of_rig)
    return _Motion(
        plan.view, plant.model.on_tool, cameras, start, goal, planned, trees, style.outlines(scene), runs
    )


def _sample_times(q: FloatArray) -> IntArray:
    """At most ``_MOST_INSTANTS`` instants of the joints q (t, n), the first and the last among them.

    They are spread half over the time, half over the path of the joints: no end of a run is skipped.
    """
    if len(q) <= _MOST_INSTANTS:
        return np.arange(len(q))
    even = np.linspace(0.0, 1.0, len(q))
    distance = np.append(0.0, np.cumsum(np.abs(np.diff(q, axis=0)).max(axis=1)))
    done = 0.5 * (even + (distance / distance[-1] if distance[-1] > 0.0 else even))
    marks = np.linspace(0.0, 1.0, _MOST_INSTANTS)
    return np.unique(np.minimum(np.searchsorted(done, marks), len(q) - 1))


def _driven(
    robot: SerialArm, plant: Plant, tool: tuple[FloatArray, FloatArray], rig: FloatArray, trace: Trace
) -> _Driven:
    """The run of a trace; ``tool`` are markers (p, 4) and features (e, 3) at the robot's reference, m."""
    markers, features = tool
    instants, positions = _sample_times(trace.q), []
    for q in trace.q[instants]:
        polyline, H, of_rig = drawn_arm(robot, plant, q)
        face, points = ((M @ H.T)[:, :3] for M in (plant.M[plant.order], markers))
        positions.append((polyline, face, points, transformed(rig, of_rig), transformed(features, H)))
    moved = (np.stack(kind) for kind in zip(*positions, strict=True))
    verdict, path = f"{trace.verdict}, {trace.steps} steps", _centers(plant, trace.q)
    return _Driven(
        verdict, trace.period * instants.astype(np.float64), trace.self_occluded[instants], path, *moved
    )


def _centers(plant: Plant, q: FloatArray) -> FloatArray:
    """Centre (k, 3) of the face, or of the cameras if they move, at joints (k, n), m."""
    H = (forward_kinematics(plant.model, joints) for joints in q)
    if plant.model.on_tool:
        middle = plant.O.mean(axis=0)
        return np.array([np.linalg.solve(moved, middle)[:3] for moved in H]).reshape(-1, 3)
    return np.array([center_of(plant.M @ moved.T, plant.center)[:3] for moved in H]).reshape(-1, 3)


def plotly() -> Any:
    """The library that draws the view; an InputError says how to get it."""
    try:
        import plotly.graph_objects
    except ImportError as error:
        raise InputError("the 3D view needs plotly: pip install '.[view]'") from error
    return plotly.graph_objects


def write_view(path: Path, motion: _Motion, *, name: str, known: str) -> None:
    """Write the view of a run next to its report; ``known`` names the source of the picture."""
    scene = _figure(motion).to_html(
        full_html=False,
        include_plotlyjs=True,
        auto_play=False,
        config={"displaylogo": False, "responsive": True, "modeBarButtons": [_TOOLS]},
        div_id="scene",
        post_script=_NEARER,
    )
    cameras = [(line["label"], line["color"]) for line in style.view_lines(motion.view)]
    what = "middle of the cameras" if motion.on_tool else "centre"
    words = [(text.format(what), color) for text, color in _KEY]
    key = [*words[:_CAMERAS_AT], *cameras, *words[_CAMERAS_AT:], *(_TREES if motion.trees else ())]
    text = html_page("view.html", name=name, known=known, page=PAGE_FILE, scene=Markup(scene), key=key)
    write_whole(path, text)


def _figure(motion: _Motion) -> Any:
    """The view as a figure of plotly: the fixed parts, then the traces of each run, a frame per instant."""
    go = plotly()
    menu: list[dict[str, Any]] = []
    traces, frames = [*_still(go, motion)], []
    still = len(traces)
    for number, (name, run) in enumerate(motion.runs.items()):
        moving = [_moving(go, motion, run, k) for k in range(len(run.seconds))]
        names = [f"{name}/{k}" for k in range(len(moving))]
        parts_of_run = len(moving[0]) + 1
        positions = [len(traces) + k for k in range(parts_of_run - 1)]
        frames += [
            go.Frame(name=frame, data=parts, traces=positions)
            for frame, parts in zip(names, moving, strict=True)
        ]
        for trace in (*moving[0], _line(go, run.path, "driven path", style.GREEN, width=5)):
            trace.visible = number == 0  # a list of all runs chooses another
            traces.append(trace)
        of_runs = np.arange(len(motion.runs)).repeat(parts_of_run)
        visible = [True] * still + (of_runs == number).tolist()
        buttons = [
            {"label": "▶ play", "method": "animate", "args": [names, _PLAYING]},
            {"label": "❚❚ pause", "method": "animate", "args": [[None], _AT_ONCE]},
        ]
        changed: dict[str, Any] = {
            "sliders": [_slider(run, names, motion.view)],
            "updatemenus[1].buttons": buttons,
        }
        changed |= {f"scene.{axis}axis.range": limits for axis, limits in _extent(motion, run).items()}
        menu.append({"label": title(name), "method": "update", "args": [{"visible": visible}, changed]})
    first: dict[str, Any] = menu[0]["args"][1]
    buttons = first["updatemenus[1].buttons"]
    left = {"x": 0.0, "xanchor": "left"}
    playing = {"type": "buttons", "direction": "left", "showactive": False, "buttons": buttons}
    layout = {
        "height": _HEIGHT,
        "margin": {"l": 10, "r": 10, "t": 60, "b": 10},
        "showlegend": False,  # the page has a key that leaves the scene its room
        "font": {"family": "system-ui, DejaVu Sans, sans-serif", "size": 13, "color": style.BLACK},
        "paper_bgcolor": "#ffffff",
        "uirevision": "kept",  # the view stays as it was turned
        "scene": _scene(motion, {axis: first[f"scene.{axis}axis.range"] for axis in "xyz"}),
        "sliders": first["sliders"],
        "updatemenus": [
            left | {"y": 1.0, "yanchor": "bottom", "pad": {"b": 8}, "buttons": menu},
            left | {"y": 0.0, "yanchor": "top", "pad": {"t": 8}} | playing,
        ],
    }
    return go.Figure(traces, layout, frames)


def _scene(motion: _Motion, reach: Mapping[str, list[float]]) -> dict[str, Any]:
    """Axes of equal scales, seen from the side of the line from the face to the cameras."""
    axis = {"gridcolor": style.PALE, "showbackground": False}
    towards = motion.cameras[:, 0].mean(axis=0) - motion.start.mean(axis=0)
    azimuth = float(np.arctan2(towards[1], towards[0])) - np.radians(58.0)
    eye = {"x": _EYE * np.cos(azimuth), "y": _EYE * np.sin(azimuth), "z": 0.5 * _EYE}
    scene: dict[str, Any] = {"aspectmode": "data", "camera": {"eye": eye, "center": {"z": -_LOWER}}}
    for name, limits in reach.items():
        scene[f"{name}axis"] = axis | {"title": {"text": f"{name} (m)"}, "range": limits}
    return scene


def _extent(motion: _Motion, run: _Driven) -> dict[str, list[float]]:
    """Range of each coordinate over a run, so that the scene does not shift while the robot moves."""
    points = [motion.cameras, motion.start, run.robot, run.markers, run.path, run.cameras, motion.planned]
    points += [motion.features, run.features]
    points += [*([] if motion.goal is None else [motion.goal]), *motion.trees]
    corners = np.concatenate([part.reshape(-1, 3) for part in points])
    low, high = np.nanmin(corners, axis=0), np.nanmax(corners, axis=0)
    pad = _PAD * float((high - low).max())
    ranges = np.round(np.stack([low - pad, high + pad], axis=1), _DIGITS)
    return {name: reach.tolist() for name, reach in zip("xyz", ranges, strict=True)}


def _slider(run: _Driven, names: list[str], views: tuple[str, ...]) -> dict[str, Any]:
    """A step for each instant; its label is above the slider."""
    steps = []
    for name, seconds, hidden in zip(names, run.seconds, run.hidden, strict=True):
        blind = " and ".join(name for name, behind in zip(views, hidden, strict=True) if behind)
        label = f"{seconds:.2f} s" + (f", hidden from {blind}" if blind else "")
        label += f", {run.verdict}" if name == names[-1] else ""
        steps.append({"label": label, "method": "animate", "args": [[name], _AT_ONCE], "value": name})
    return {
        "steps": steps,
        "active": 0,
        "pad": {"t": 60, "b": 10},
        "currentvalue": {"prefix": "time ", "font": {"size": 14, "color": style.BLACK}},
        "font": {"color": "rgba(0,0,0,0)"},  # no labels below: they would lie over one another
        "ticklen": 0,
        "minorticklen": 0,
    }


def _still(go: Any, motion: _Motion) -> Iterator[Any]:
    if not motion.on_tool:
        yield from _cameras(go, motion, motion.cameras)
    yield _line(go, style.closed(motion.start), "face at the start", style.BLACK, width=3)
    if motion.goal is not None:
        yield _line(go, motion.goal, "goal", style.PURPLE, width=4)
    if len(motion.features):
        yield _features(go, motion.features, "features of the scene", style.PURPLE)
    for points, (name, color) in zip(motion.trees, _TREES, strict=False):
        yield _line(go, points, name, color, width=1)
    if len(motion.planned):
        dots = np.linspace(0, len(motion.planned) - 1, min(_DOTS, len(motion.planned))).astype(int)
        yield _line(go, motion.planned, "planned path", style.PURPLE, width=2)
        yield _line(go, motion.planned[dots], "planned path", style.PURPLE)


def _cameras(go: Any, motion: _Motion, pyramids: FloatArray) -> Iterator[Any]:
    """The pyramids (V, 5, 3) of all cameras."""
    for pyramid, camera in zip(pyramids, style.view_lines(motion.view), strict=True):
        yield _line(go, edges_of(pyramid), camera["label"], camera["color"], width=3)


def _moving(go: Any, motion: _Motion, run: _Driven, k: int) -> list[Any]:
    """Robot, face and markers, and cameras on the tool, at one of the instants."""
    robot = _line(go, run.robot[k], "robot", style.BLACK, width=9)
    robot.update(mode="lines+markers", marker={"size": 5, "color": style.BLACK})
    fan = np.arange(1, run.face.shape[1] - 1)
    triangles = {"i": (0 * fan).tolist(), "j": fan.tolist(), "k": (fan + 1).tolist()}
    color = _HIDDEN if run.hidden[k].any() else _SEEN
    line_style = {"color": color, "flatshading": True, "name": "face", "hoverinfo": "name"}
    face = go.Mesh3d(**_coordinates(run.face[k]), **triangles, **line_style)
    cameras = _cameras(go, motion, run.cameras[k]) if motion.on_tool else ()
    features = [_features(go, run.features[k], "features of the tool", _SEEN)] * bool(run.features.size)
    return [robot, face, _line(go, run.markers[k], "markers", style.GREY), *features, *cameras]


def _line(go: Any, points: FloatArray, name: str, color: str, width: float | None = None) -> Any:
    """A line of a width, or points if there is none."""
    line_style = {"mode": "markers", "marker": {"size": 3, "color": color}}
    if width is not None:
        line_style = {"mode": "lines", "line": {"color": color, "width": width}}
    return go.Scatter3d(**_coordinates(points), **line_style, name=name, hoverinfo="name")


def _features(go: Any, outline: FloatArray, name: str, color: str) -> Any:
    """Points, lines and planes along an outline."""
    return _line(go, outline, name, color, width=6).update(mode="lines+markers", marker={"size": 4})


def _coordinates(points: FloatArray) -> dict[str, list[float]]:
    return {name: np.round(points[:, i], _DIGITS).tolist() for i, name in enumerate("xyz")}


_FRAMES = 60
_MOST_COLUMNS = 4
SEEN, HIDDEN = style.GREEN, style.ORANGE
_PATH = style.line(SEEN, width=0.9, label="path of a marker")
_PANEL, _LEAST_WIDTH = 2.3, 4.0  # inches across one panel, and across the legend
_COLORS, _NEAR_WHITE = 128, 240  # in addition to greys, which frames need
_FILM_WIDTH = 320  # px, of which a panel shows most


def write_animation(
    path: Path,
    traces: Mapping[str, Trace],
    order: IntArray,
    size: ImageSize | None,
    progress: Callable[[str, int, int], None],
) -> None:
    """Write the animation of runs as GIF: the first direct law and the classical ones side by side.

    ``order`` are the markers around the face, ``size`` is the size of the images in px; if it is not known,
    the animation shows the range of all observed pixels. If the runs have frames, these are shown.
    """
    from PIL import Image

    direct = [name for name in traces if name in PROJECTIVE_LAWS]
    pair = [*direct[:1], *(name for name in traces if name in CLASSICAL_LAWS)]
    columns = {name: traces[name] for name in (pair if len(pair) > 1 else [*traces])[:_MOST_COLUMNS]}
    sizes = image_sizes(size, next(iter(traces.values())).view)
    if size is None:
        seen = np.nanmax(np.concatenate([run.s.reshape(-1, 2) for run in traces.values()]), axis=0) + 1.0
        sizes = np.broadcast_to(seen, sizes.shape)
    images = []
    for pixels in _frames(columns, order, sizes):
        images.append(Image.fromarray(pixels))
        progress("animation", len(images), _FRAMES)
    # The last frame has all colours; one palette for all keeps fixed parts the same.
    palette = images[-1].quantize(_COLORS, method=Image.Quantize.MAXCOVERAGE)
    colors = np.array((palette.getpalette() or [])[: 3 * _COLORS]).reshape(-1, 3)
    greys = np.linspace(0, _NEAR_WHITE, 256 - len(colors)).round().astype(np.int64)[:, None].repeat(3, axis=1)
    colors[colors.min(axis=1) >= _NEAR_WHITE] = 255  # else paper takes the nearest shade of them
    palette.putpalette(np.concatenate([colors, greys]).ravel().tolist())
    first, *others = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    with replacing(path) as temporary:
        durations = [*[FRAME_MS] * len(others), LAST_MS]
        first.save(temporary, "GIF", save_all=True, append_images=others, duration=durations, loop=0)


def _frames(traces: Mapping[str, Trace], order: IntArray, sizes: FloatArray) -> Iterator[Any]:
    """Draw one frame after another, a column per run; yields the pixels (height, width, 3) of each.

    They go from the start to the end of the longest run that converged, if any did.
    """
    ends = [run.period * run.steps for run in traces.values() if arrived(run.verdict)]
    end = max(ends or [run.period * run.steps for run in traces.values()])
    every = [t[:, :, order].reshape(-1, 2) for run in traces.values() for t in (run.s, run.s_star[None])]
    size, views = sizes.max(axis=0), len(sizes)
    near = style.near_pixels(np.concatenate(every), size)
    films = {
        name: None if run.frames is None else frames_of_run(run.frames, width=_FILM_WIDTH)
        for name, run in traces.items()
    }
    margin = 0.06
    if any(film is not None for film in films.values()):  # whole images
        near, margin = np.array([[-0.5, -0.5], size - 0.5]), 0.0
    width = max(_LEAST_WIDTH, _PANEL * len(traces) + 0.5)
    columns: list[list[_Panel]] = []

    def draw(runs: Mapping[str, Trace], figure: "style.Figure") -> None:
        axes = figure.subplots(views, len(runs), squeeze=False, sharex=True, sharey=True)
        for column, (name, run) in zip(axes.T, runs.items(), strict=True):
            for view, (panel, camera) in enumerate(zip(column, run.view, strict=True)):
                style.image_axes(panel, near, margin)
                panel.set_title("" if view else f"{title(name)}\nrunning")
                panel.set_ylabel("" if columns else f"{camera} camera\nv (px)")
                panel.set_xlabel("u (px)" if view == views - 1 else "")
            columns.append([_Panel(panel, run, view, order) for view, panel in enumerate(column)])
            if (film := films[name]) is not None and run.frames is not None:
                for panel, frames, extent in zip(columns[-1], film, sizes, strict=True):
                    panel.over(frames, run.frames.frame_index, extent)
        style.legend_below(figure, 4 if len(runs) > 2 else 2)
        figure.suptitle("time 00.00 s", fontsize=9)

    with style.styled():
        figure = style.drawn(draw, traces, views * _PANEL * style.aspect(near) + 1.6, width)
        for seconds in np.linspace(0.0, end, _FRAMES):
            figure.suptitle(f"time {seconds:.2f} s", fontsize=9)
            for column, (name, run) in zip(columns, traces.items(), strict=True):
                now = min(int((seconds + 1e-9) / run.period), run.steps)
                verdict = f"{run.verdict}, {run.steps} steps"
                if now < run.steps:
                    verdict = f"later: {verdict}" if seconds == end else "running"
                column[0].axes.set_title(f"{title(name)}\n{verdict}")
                for panel in column:
                    panel.show(now)
            canvas: Any = figure.canvas
            canvas.draw()
            yield np.array(canvas.buffer_rgba(), dtype=np.uint8)[:, :, :3]


class _Panel:
    """One image under one law: start and goal, and moving parts: paths, a face, hidden or not, and features.

    order : the markers around the face.
    """

    def __init__(self, axes: Any, run: Trace, view: int, order: IntArray) -> None:
        self.axes, self.s, self.hidden = axes, run.s[:, view, order], run.self_occluded[:, view]
        self.features = np.zeros((len(run.s), 0, 3, 2))
        style.start_and_goal(axes, self.s[0], run.s_star[view, order], fill=False)
        if (found := run.of_incidences) is not None:
            self.features = found.feature_s[:, :, :, view]
            axes.plot(*style.outlines(found.feature_s_star[:, :, view]).T, **OF_SCENE)
        self.behind, self.paths = (
            [axes.plot([], [], **line)[0] for _ in order] for line in (style.HIDDEN, _PATH)
        )
        over = {"color": style.BLACK, "linewidth": 2.0, "zorder": 4}
        over["label"] = OF_TOOL["label"] * bool(self.features.size)
        (self.outline,) = axes.plot([], [], **OF_TOOL | over)
        (self.face,) = axes.fill([0.0], [0.0], linewidth=1.2, edgecolor=style.BLACK, alpha=0.9, zorder=3)
        place = {"transform": axes.transAxes, "ha": "center", "va": "bottom"}
        self.word = axes.text(0.5, 0.03, "", fontweight="bold", fontsize=8, **place)
        self.ground: Any = None
        self.instant: IntArray = np.zeros(0, dtype=np.int64)

    def over(self, frames: ByteArray, instant: IntArray, size: FloatArray) -> None:
        """Lay frames (k, height, width) of instants (k,) of images of a size, px, beneath."""
        extent = (-0.5, size[0] - 0.5, size[1] - 0.5, -0.5)
        limits = self.axes.get_xlim(), self.axes.get_ylim()
        self.ground = self.axes.imshow(frames[0], cmap="gray", vmin=0, vmax=255, extent=extent, aspect="auto")
        self.axes.set(xlim=limits[0], ylim=limits[1])
        self.axes.grid(visible=False)
        with_halo(self.axes)
        self.frames, self.instant = frames, instant
        self.face.set_alpha(0.5)

    def show(self, now: int) -> None:
        """Show the paths up to an instant, and the face at it."""
        past, hidden = self.s[: now + 1], self.hidden[: now + 1]
        if self.ground is not None:  # the newest frame that is kept
            self.ground.set_data(self.frames[np.searchsorted(self.instant, now, side="right") - 1])
        for k, (line, behind) in enumerate(zip(self.paths, self.behind, strict=True)):
            line.set_data(*past[:, k].T)
            behind.set_data(*np.where(hidden[:, None], past[:, k], np.nan).T)
        self.outline.set_data(*style.outlines(self.features[now]).T)
        here = past[-1][np.isfinite(past[-1]).all(axis=1)]
        self.face.set_visible(len(here) > 2)
        if len(here) > 2:
            self.face.set_xy(here)
        self.face.set_facecolor(HIDDEN if hidden[-1] else SEEN)
        unseen = "MARKERS NOT SEEN" if len(here) < self.s.shape[1] else ""
        self.word.set_text("FACE HIDDEN" if hidden[-1] else unseen)
