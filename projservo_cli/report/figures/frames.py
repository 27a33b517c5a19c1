"""Figure 17: images of both cameras at the start, in the middle and at the end of a run, with detections."""

import io

import numpy as np

from projservo_cli.laws import BODY_LAWS
from projservo_cli.records import ByteArray, IntArray, Trace
from projservo_cli.report import style
from projservo_cli.report.report_data import VIEWS, Data, Driven, ReportData, registered, title
from projservo_cli.task.face import cyclic_order

_MOMENTS = ("start", "in the middle", "end")
_HALO = 1.2  # points, by which lines over a frame are wider in white
_FOUND: style.LineStyle = {"color": style.ORANGE, "marker": "+", "linestyle": "none", "markersize": 4.0}
_FACE: style.LineStyle = {"color": style.GREEN, "linewidth": 1.2}
_PATH: style.LineStyle = {"color": style.VERMILION, "linewidth": 0.9}


def frames_of(trace: Trace, selected: IntArray | None = None, width: int | None = None) -> ByteArray | None:
    """Frames (k, 2, height, width) of a run, of those kept the ones shown (k,); None where none are kept.

    width : px that they need not exceed, at which they are read faster and smaller.
    """
    from PIL import Image

    if trace.frame_jpeg is None or trace.frame_size is None:
        return None
    ends = np.cumsum(trace.frame_size).reshape(-1, 2)
    selected = np.arange(len(ends)) if selected is None else selected
    pairs = []
    for k in selected:
        pair = []
        for end, size in zip(ends[k], trace.frame_size[k], strict=True):
            image = Image.open(io.BytesIO(trace.frame_jpeg[end - size : end].tobytes()), formats=["JPEG"])
            if width is not None and image.width > width:
                image.draft("L", (width, width * image.height // image.width))
            pair.append(np.asarray(image.convert("L")))
        pairs.append(pair)
    return np.array(pairs)


def _filmed(report_data: Driven | ReportData) -> str:
    """The run that is shown: of those with frames the first of a direct law, else the first."""
    names = [name for name, trace in report_data.traces.items() if trace.frame_index is not None]
    return next((name for name in names if name in BODY_LAWS), names[0])


def _data(report_data: Driven | ReportData) -> Data:
    """Frames of three moments, all that was found in them, the path of the face and its goal."""
    name, order = _filmed(report_data), cyclic_order(report_data.plan.A)
    trace = report_data.traces[name]
    assert trace.frame_index is not None
    assert trace.frame_s is not None
    half = np.abs(trace.image_error[trace.frame_index] - 0.5 * trace.image_error[0])
    selected = np.array([0, int(np.nanargmin(half)), len(half) - 1])
    frames = frames_of(trace, selected)
    assert frames is not None
    return {
        "run": np.array(f"{title(name)}, {trace.verdict}"),
        "instant": trace.frame_index[selected],
        "period_s": np.array(trace.period),
        "found": trace.frame_s[selected],
        "s": trace.s[:, :, order],
        "s_star": trace.s_star[:, order],
        "frames": frames,
    }


def with_halo(axes: "style.Axes") -> None:
    """Draw all lines over a frame with a white margin, so that they show on any ground."""
    from matplotlib.patheffects import withStroke

    for line in axes.lines:
        line.set_path_effects([withStroke(linewidth=line.get_linewidth() + _HALO, foreground="white")])


@registered(
    "fig17_frames",
    "Images of both cameras at the start, in the middle and at the end",
    "not in the paper",
    _data,
    frames=True,
    alt="A row for each camera, with its image at the start, in the middle and at the end. Drawn over "
    "them are the markers that were found, the face with the paths of its markers so far, and the goal.",
)
def _draw(data: Data, figure: "style.Figure") -> None:
    """A row a camera, a column a moment."""
    frames = data["frames"]
    height, width = frames.shape[2:]
    figure.set_figheight(2.0 * style.WIDTH / 3.0 * height / width + 1.1)
    panels = figure.subplots(2, 3)
    for row, view in zip(panels, range(2), strict=True):
        for i, panel in enumerate(row):
            panel.imshow(frames[i, view], cmap="gray", vmin=0, vmax=255)
            s = data["s"][: data["instant"][i] + 1, view]
            style.paths(panel, s, _PATH)
            style.face(panel, s[-1], _FACE)
            style.face(panel, data["s_star"][view], style.GOAL)
            panel.plot(*data["found"][i, view].T, **_FOUND)
            with_halo(panel)
            panel.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xticks=[], yticks=[])
            seconds = data["instant"][i] * float(data["period_s"])
            run = f"{data['run']}\n" if not (view or i) else ""
            panel.set_title(f"{run}{VIEWS[view]} camera, {_MOMENTS[i]}, {seconds:.2f} s")
    line_styles = {"markers found": _FOUND, "face": _FACE, "path of a marker": _PATH, "goal": style.GOAL}
    style.legend_below(figure, line_styles, 4)
