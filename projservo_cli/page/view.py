"""The 3D view of a run: one page of HTML with a time slider, drawn by plotly, that needs no network."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from projservo_cli.figures import style
from projservo_cli.figures.material import VIEWS, title
from projservo_cli.figures.motion import Driven, Motion
from projservo_cli.files import replacing
from projservo_cli.page.template import template
from projservo_cli.records import FloatArray, InputError

HEIGHT = 640  # px of the scene
EYE = 1.75  # distance of the eye, in sizes of the scene
LOWER = 0.15  # that it looks below the middle, where the names of the axes are
TOOLS = ["orbitRotation", "pan3d", "zoom3d", "resetCameraDefault3d", "toImage"]  # none leaves the page
DOTS = 9  # on the planned path
# What is wider than high needs more distance where the page is narrow.
NEARER = """
const plot = document.getElementById("{plot_id}");
const far = Math.min(3, Math.max(1, 1050 / plot.clientWidth));
const {x, y, z} = plot.layout.scene.camera.eye;
Plotly.relayout(plot, {"scene.camera.eye": {x: far * x, y: far * y, z: far * z}});
"""
PAD = 0.03  # around all that is shown, as a share of it
DIGITS = 4  # of coordinates in m: a tenth of a millimetre
FRAME_MS = 80
CAMERA_COLORS = (style.BLUE, style.ORANGE)
SEEN, HIDDEN = style.SKY, style.VERMILION
KEY = (
    ("robot, face at the start", style.BLACK),
    ("face", SEEN),
    ("face, hidden from a camera", HIDDEN),
    ("markers", style.GREY),
    ("left camera", CAMERA_COLORS[0]),
    ("right camera", CAMERA_COLORS[1]),
    ("goal, planned path of the centre", style.PURPLE),
    ("driven path of the centre", style.GREEN),
)
AT_ONCE = {"mode": "immediate", "frame": {"duration": 0, "redraw": True}, "transition": {"duration": 0}}
PLAYING = AT_ONCE | {"frame": {"duration": FRAME_MS, "redraw": True}, "fromcurrent": True}


def plotly() -> Any:
    """The library that draws the view.

    Raises
    ------
    InputError
        If it is not installed.
    """
    try:
        import plotly.graph_objects
    except ImportError as error:
        raise InputError("the 3D view needs plotly: pip install 'projservo[view]'") from error
    return plotly.graph_objects


def write_view(motion: Motion, path: Path, name: str, known: str, page: str) -> None:
    """Write the view of a run.

    Parameters
    ----------
    motion : what it shows.
    path : file to write.
    name : of the run.
    known : where the picture comes from, a sentence.
    page : the report of the run, as seen from the file.

    Raises
    ------
    InputError
        If plotly is not installed or the file cannot be written.
    """
    scene = figure(motion).to_html(
        full_html=False,
        include_plotlyjs=True,
        auto_play=False,
        config={"displaylogo": False, "responsive": True, "modeBarButtons": [TOOLS]},
        div_id="scene",
        post_script=NEARER,
    )
    text = template("view.html").render(name=name, known=known, page=page, scene=Markup(scene), key=KEY)
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def figure(motion: Motion) -> Any:
    """The view as a figure of plotly: what stands still, then four traces a run, and a frame an instant."""
    go = plotly()
    still = [*_still(go, motion)]
    traces, frames, choices = [*still], [], []
    for name, run in motion.runs.items():
        first = len(traces)
        moving = [_moving(go, run, k) for k in range(len(run.seconds))]
        own_traces = [*moving[0], _line(go, run.path, "driven path", style.GREEN, width=5)]
        for trace in own_traces:
            trace.visible = first == len(still)  # a list of all runs chooses another
        traces += own_traces
        own = [f"{name}/{k}" for k in range(len(moving))]
        frames += [
            go.Frame(name=frame, data=data, traces=[first, first + 1, first + 2])
            for frame, data in zip(own, moving, strict=True)
        ]
        choices.append((name, run, own))
    return go.Figure(traces, _layout(motion, len(still), choices), frames)


def _layout(motion: Motion, still: int, choices: list[tuple[str, Driven, list[str]]]) -> dict[str, Any]:
    """Scene, slider and buttons; the first run is shown.

    Parameters
    ----------
    motion : what the view shows.
    still : number of traces that stand still, the first ones; four a run follow.
    choices : name, run and names of the frames of each run.
    """
    each = 4
    buttons = []
    for number, (name, run, own) in enumerate(choices):
        shown = [True] * still + [k // each == number for k in range(each * len(choices))]
        changed: dict[str, Any] = {"sliders": [_slider(run, own)], "updatemenus[1].buttons": _play(own)}
        changed |= {f"scene.{axis}.range": reach for axis, reach in _extent(motion, run).items()}
        buttons.append({"label": title(name), "method": "update", "args": [{"visible": shown}, changed]})
    _, first, own = choices[0]
    place = {"x": 0.0, "xanchor": "left"}
    above = place | {"y": 1.0, "yanchor": "bottom", "pad": {"b": 8}}
    below = place | {"y": 0.0, "yanchor": "top", "pad": {"t": 8}}
    playing = {"type": "buttons", "direction": "left", "showactive": False, "buttons": _play(own)}
    return {
        "height": HEIGHT,
        "margin": {"l": 10, "r": 10, "t": 60, "b": 10},
        "showlegend": False,  # the page has a key that leaves the scene its room
        "font": {"family": "system-ui, DejaVu Sans, sans-serif", "size": 13, "color": style.BLACK},
        "paper_bgcolor": "#ffffff",
        "uirevision": "kept",  # the view stays as it was turned
        "scene": _scene(motion, first),
        "sliders": [_slider(first, own)],
        "updatemenus": [above | {"buttons": buttons}, below | playing],
    }


def _scene(motion: Motion, run: Driven) -> dict[str, Any]:
    """Axes of equal scales, seen from beside the way from the face to the cameras."""
    axis: dict[str, Any] = {"backgroundcolor": "#ffffff", "gridcolor": style.PALE, "showbackground": False}
    towards = motion.cameras[:, 0].mean(axis=0) - motion.start.mean(axis=0)
    azimuth = float(np.arctan2(towards[1], towards[0])) - np.radians(58.0)
    scene: dict[str, Any] = {
        name: axis | {"title": {"text": f"{name[0]} (m)"}, "range": reach}
        for name, reach in _extent(motion, run).items()
    }
    eye = {"x": EYE * np.cos(azimuth), "y": EYE * np.sin(azimuth), "z": 0.5 * EYE}
    camera = {"eye": eye, "center": {"x": 0.0, "y": 0.0, "z": -LOWER}}
    return scene | {"aspectmode": "data", "camera": camera}


def _extent(motion: Motion, run: Driven) -> dict[str, list[float]]:
    """Range of each coordinate that a run keeps to, so that the scene stands still while the robot moves."""
    points = [motion.cameras, motion.start, run.robot, run.markers, run.path, motion.planned]
    points += [] if motion.goal is None else [motion.goal]
    shown = np.concatenate([some.reshape(-1, 3) for some in points])
    low, high = shown.min(axis=0), shown.max(axis=0)
    pad = PAD * float((high - low).max())
    ranges = np.round(np.stack([low - pad, high + pad], axis=1), DIGITS)
    return {f"{name}axis": [float(low), float(high)] for name, (low, high) in zip("xyz", ranges, strict=True)}


def _slider(run: Driven, own: list[str]) -> dict[str, Any]:
    """A step for each instant; what it is labelled with stands above the slider."""
    labels = [_label(seconds, hidden) for seconds, hidden in zip(run.seconds, run.hidden, strict=True)]
    labels[-1] += f", {run.verdict}"
    steps = [
        {"label": label, "method": "animate", "args": [[frame], AT_ONCE], "value": frame}
        for frame, label in zip(own, labels, strict=True)
    ]
    return {
        "steps": steps,
        "active": 0,
        "pad": {"t": 60, "b": 10},
        "currentvalue": {"prefix": "time ", "font": {"size": 14, "color": style.BLACK}},
        "font": {"color": "rgba(0,0,0,0)"},  # no labels below: they would lie over one another
        "ticklen": 0,
        "minorticklen": 0,
    }


def _label(seconds: float, hidden: Any) -> str:
    from_views = " and ".join(name for name, behind in zip(VIEWS, hidden, strict=True) if behind)
    return f"{seconds:.2f} s" + (f", hidden from {from_views}" if from_views else "")


def _play(own: list[str]) -> list[dict[str, Any]]:
    return [
        {"label": "▶ play", "method": "animate", "args": [own, PLAYING]},
        {"label": "❚❚ pause", "method": "animate", "args": [[None], AT_ONCE]},
    ]


def _still(go: Any, motion: Motion) -> Iterator[Any]:
    for pyramid, name, color in zip(motion.cameras, VIEWS, CAMERA_COLORS, strict=True):
        apex, corners = pyramid[:1], style.closed(pyramid[1:])
        edges = np.concatenate([np.concatenate([corner[None], apex, corner[None]]) for corner in corners])
        yield _line(go, edges, f"{name} camera", color, width=3)
    yield _line(go, style.closed(motion.start), "face at the start", style.BLACK, width=3)
    if motion.goal is not None:
        yield _line(go, style.closed(motion.goal), "face at the goal", style.PURPLE, width=4)
    if len(motion.planned):
        dots = np.linspace(0, len(motion.planned) - 1, min(DOTS, len(motion.planned))).astype(int)
        yield _points(go, motion.planned[dots], "planned path", style.PURPLE)


def _moving(go: Any, run: Driven, k: int) -> tuple[Any, Any, Any]:
    """Robot, face and markers at one of the instants."""
    behind = bool(run.hidden[k].any())
    robot = _line(go, run.robot[k], "robot", style.BLACK, width=9)
    robot.update(mode="lines+markers", marker={"size": 5, "color": style.BLACK})
    count = run.face.shape[1]
    fan = np.arange(1, count - 1)
    face = go.Mesh3d(
        **_places(run.face[k]),
        i=np.zeros(count - 2, dtype=int).tolist(),
        j=fan.tolist(),
        k=(fan + 1).tolist(),
        color=HIDDEN if behind else SEEN,
        flatshading=True,
        name="face",
        hoverinfo="name",
    )
    markers = _points(go, run.markers[k], "markers", style.GREY)
    return robot, face, markers


def _line(go: Any, points: FloatArray, name: str, color: str, **look: Any) -> Any:
    return go.Scatter3d(
        **_places(points), mode="lines", line={"color": color} | look, name=name, hoverinfo="name"
    )


def _points(go: Any, points: FloatArray, name: str, color: str) -> Any:
    marker = {"size": 3, "color": color}
    return go.Scatter3d(**_places(points), mode="markers", marker=marker, name=name, hoverinfo="name")


def _places(points: FloatArray) -> dict[str, list[float]]:
    return {name: np.round(points[:, i], DIGITS).tolist() for i, name in enumerate("xyz")}
