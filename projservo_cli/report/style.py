"""One grammar for all figures: size, fonts, styles of curves, views and laws, legends, and saving.

A figure draws curves by their line styles, which name them; the legend collects the names. matplotlib is
imported where it is used and always draws without a display; the same data give the same bytes in SVG, PDF
and PNG.
"""

import io
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from projservo_cli.records import BoolArray, FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes as Axes
    from matplotlib.figure import Figure as Figure

FORMATS = ("svg", "pdf", "png")
WIDTH = 6.9  # inches across both columns of a page
_PNG_DPI = 200
LineStyle = dict[str, Any]  # how a curve is drawn, in keywords of matplotlib, and its name in the legend
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_IMAGE = "image"  # label of axes that show pixels

# M. Okabe, K. Ito, "Color Universal Design", 2008; ordered so that neighbours differ in lightness.
BLACK, ORANGE, BLUE, SKY = "#000000", "#E69F00", "#0072B2", "#56B4E9"
VERMILION, GREEN, PURPLE = "#D55E00", "#009E73", "#CC79A7"
# Colours of further cameras: the other ones have their meaning in the same figures.
_BROWN, VIOLET = "#7F4F24", "#5E3C99"
GREY, PALE = "#999999", "#DDDDDD"
SOLID, NO_LINE = "-", "none"
DASHED, DOTTED, DASH_DOTTED = (0, (5, 1.5)), (0, (1, 1)), (0, (5, 1.5, 1, 1.5))
# Colour, line style and marker change together, so that a curve is known without its colour.
_CURVES: tuple[tuple[str, Any, str], ...] = (
    (BLACK, SOLID, "o"),
    (VERMILION, DASHED, "s"),
    (BLUE, DOTTED, "^"),
    (ORANGE, DASH_DOTTED, "D"),
    (GREEN, (0, (3, 3)), "v"),
    (PURPLE, (0, (3, 1, 1, 1, 1, 1)), "P"),
    (SKY, (0, (8, 2)), "X"),  # style of the seventh joint
)


def line(
    color: str, dash: Any = SOLID, width: float | None = None, marker: str = "", label: str = "", **more: Any
) -> LineStyle:
    """Style of a curve: colour, dashes, width in points, marker, and its name in the legend, if any."""
    chosen = {"linewidth": width, "marker": marker, "label": label}
    return {"color": color, "linestyle": dash} | {key: value for key, value in chosen.items() if value} | more


def dots(color: str, marker: str, label: str = "", **more: Any) -> LineStyle:
    """Style of points that no line joins."""
    return line(color, NO_LINE, marker=marker, label=label, **more)


def patch(color: str, label: str = "", **more: Any) -> LineStyle:
    """Style of an area."""
    return {"facecolor": color, "label": label} | more


# The face at the start and at the goal, and the laws look the same in every figure.
START, GOAL = line(BLACK, width=1.4, label="start"), line(BLUE, DASHED, label="goal")
LAW_LINES = {
    "direct_three": line(GREEN, width=1.2),
    "direct_two": line(PURPLE, DASHED, 1.2),
    "stacked": line(VERMILION, DASHED, 1.1),
}
HIDDEN = line(ORANGE, width=4.0, label="face hidden from this camera", alpha=0.6, solid_capstyle="butt")
# Colour and dashes of the views, the same in every figure; from the fifth view on they come again.
_VIEWS: tuple[tuple[str, Any], ...] = (
    *((BLUE, SOLID), (ORANGE, DASHED), (_BROWN, DASH_DOTTED), (VIOLET, (0, (3, 1, 1, 1, 1, 1)))),
)
_FIRST_MARKER = 3.0  # size of the dot on the first marker of a face, points

_RC: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 8.0,
    "axes.titlesize": 8.5,
    "axes.titley": 1.0,  # fixed; its automatic placement takes a fifth of the layout
    "axes.labelsize": 8.0,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "legend.fontsize": 8.0,
    "legend.frameon": False,
    "legend.handlelength": 2.8,
    "legend.columnspacing": 1.6,
    "axes.linewidth": 0.6,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.linewidth": 0.4,
    "grid.color": "#E3E3E3",
    "lines.linewidth": 1.2,
    "lines.markersize": 3.5,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "axes.unicode_minus": True,
    "svg.hashsalt": "projservo",
    "svg.fonttype": "path",
    "pdf.fonttype": 3,
    "image.cmap": "cividis",
    "savefig.facecolor": "white",
}
_METADATA: dict[str, dict[str, Any]] = {
    "svg": {"Date": None, "Creator": "projservo"},
    "pdf": {"CreationDate": None, "ModDate": None, "Creator": "projservo", "Producer": "matplotlib"},
    "png": {"Software": "projservo"},
}


@contextmanager
def styled() -> Iterator[None]:
    """Draw and save in the style of the figures."""
    import matplotlib

    with matplotlib.rc_context(_RC):
        yield


_HALF_LABEL = 0.16  # in, half the width of a label of four digits


def drawn(draw: Callable[[Any, "Figure"], None], data: Any, height: float, width: float = WIDTH) -> "Figure":
    """A figure of a size in inches, drawn from data and arranged, so that every format shows the same."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import TightLayoutEngine

    # Without a rectangle it measures each part once; with one, or "constrained", twice, which takes 0.6 s.
    layout: Any = TightLayoutEngine(pad=0.5, w_pad=1.2, rect=None)  # type: ignore[arg-type]
    with styled():
        figure = Figure(figsize=(width, height), layout=layout)
        FigureCanvasAgg(figure)
        draw(data, figure)
        _arrange(figure)
    return figure


def _arrange(figure: "Figure") -> None:
    """Arrange the parts of a figure once and for all."""
    engine: Any = figure.get_layout_engine()
    if engine is None:
        return
    _name_ordinates_once(figure)
    images: list[Any] = [axes for axes in figure.axes if axes.get_label() == _IMAGE]
    for axes in images:  # matplotlib calls it for each size that it tries, before it looks at tick labels
        axes.apply_aspect = partial(_equal_scales, axes, axes.get_xlim(), axes.get_ylim())
    height = figure.get_figheight()
    legend = sum(below.get_window_extent().y1 for below in figure.legends) / figure.dpi
    figure.set_figheight(height - legend)  # the engine leaves a legend no room, and measures twice in a part
    engine.execute(figure)
    figure.set_figheight(height)
    share, edges = 1.0 - legend / height, figure.subplotpars
    if legend:
        figure.subplots_adjust(bottom=1.0 - share * (1.0 - edges.bottom), top=1.0 - share * (1.0 - edges.top))
    if images:  # the last tick of an image, set when its scales are, may lie at the very edge
        figure.subplots_adjust(right=min(edges.right, 1.0 - _HALF_LABEL / figure.get_figwidth()))
    for axes in images:
        axes.apply_aspect()
    figure.set_layout_engine()  # with an engine, even one that does nothing, saving draws twice


def _name_ordinates_once(figure: "Figure") -> None:
    """Leave the name of an ordinate to the first of more than two panels in a row, which are closer."""
    named: dict[Any, list[Axes]] = {}
    for axes in figure.axes:
        if (place := axes.get_subplotspec()) is not None:
            named.setdefault((place.rowspan.start, axes.get_ylabel()), []).append(axes)
    for same in named.values():
        for axes in same[1:] if len(same) > 2 else ():
            axes.set_ylabel("")


def _equal_scales(
    axes: "Axes", u: tuple[float, float], v: tuple[float, float], position: object = None
) -> None:
    """Widen the limits u and v until a pixel is as wide as it is high in the panel as it is."""
    del position
    box = axes.get_window_extent()
    path = np.array([u[1] - u[0], v[1] - v[0]])
    scale = max(abs(path[0]) / box.width, abs(path[1]) / box.height)
    half = 0.5 * scale * np.array([box.width, box.height]) * np.sign(path)
    middle = 0.5 * np.array([sum(u), sum(v)])
    axes.set_xlim(middle[0] - half[0], middle[0] + half[0])
    axes.set_ylim(middle[1] - half[1], middle[1] + half[1])


def contents(figure: "Figure", formats: Sequence[str]) -> dict[str, bytes]:
    """A figure as files, by format: ``svg``, ``pdf`` or ``png``."""
    files = {}
    for kind in formats:
        file = io.BytesIO()
        with styled():
            figure.savefig(file, format=kind, dpi=_PNG_DPI, metadata=_METADATA[kind])
        files[kind] = file.getvalue()
    return files


def legend_below(figure: "Figure", columns: int, more: Iterable[LineStyle] = ()) -> None:
    """Put one legend for the whole figure below all axes: each name once, as first drawn, then more.

    columns : as many of them as fit.
    """
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: dict[str, Any] = {}
    for axes in figure.axes:
        if axes.get_legend() is None:
            for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
                points = np.asarray(handle.get_xydata() if isinstance(handle, Line2D) else [])
                if not points.size or np.isfinite(points).any():  # else nothing of it is drawn
                    handles.setdefault(label, handle)
    by_joint = sorted(name for name in handles if name.startswith("$q_"))  # whatever panels these are in
    handles |= {name: handles.pop(name) for name in sorted(by_joint, key=len)}
    for extra in more:
        handles[extra["label"]] = Patch(**extra) if "facecolor" in extra else Line2D([], [], **extra)
    for ncols in range(columns, 0, -1):
        legend = figure.legend([*handles.values()], [*handles], loc="lower center", ncols=ncols)
        if ncols == 1 or legend.get_window_extent().width <= figure.bbox.width:
            return
        legend.remove()


def curve(index: int, label: str = "", *, marker: bool = False) -> LineStyle:
    """Style of the curve of a number: colour, line style and, if asked for, marker.

    Those of a second round are thin, and their markers hollow.
    """
    again, place = divmod(index, len(_CURVES))
    color, dash, symbol = _CURVES[place]
    thin: LineStyle = {"linewidth": 0.7} if again else {}
    hollow: LineStyle = {"markerfacecolor": "white"} if again and marker else {}
    return line(color, dash, marker=symbol if marker else "", label=label, **thin, **hollow)


def view_lines(names: Iterable[str]) -> list[LineStyle]:
    """A style for each of the views, which names its camera."""
    return [line(*_VIEWS[v % len(_VIEWS)], label=f"{name} camera") for v, name in enumerate(names)]


def zero_line(axes: "Axes") -> None:
    """Draw the line at which a margin is used up."""
    axes.axhline(0.0, color=BLACK, linewidth=0.6)


def image_axes(axes: "Axes", pixels: FloatArray | None = None, margin: float = 0.06) -> None:
    """Axes of an image, v down, that widen to fill their panel.

    They show all pixels (…, 2), by default all drawn ones, with a margin.
    """
    axes.set(xlabel="u (px)", ylabel="v (px)", label=_IMAGE)
    points = axes.dataLim.get_points() if pixels is None else pixels.reshape(-1, 2)
    points = points[np.isfinite(points).all(axis=1)]
    low, high = points.min(axis=0), points.max(axis=0)
    pad = margin * max(float((high - low).max()), 1.0)
    axes.set_xlim(low[0] - pad, high[0] + pad)
    axes.set_ylim(high[1] + pad, low[1] - pad)


def aspect(pixels: FloatArray, lower: float = 0.3, upper: float = 1.1) -> float:
    """Return height over width of the pixels (…, 2) of a panel, within bounds for print."""
    points = pixels.reshape(-1, 2)
    size = np.ptp(points[np.isfinite(points).all(axis=1)], axis=0)
    return float(np.clip(size[1] / max(size[0], 1.0), lower, upper))


def log_scale(axes: "Axes") -> None:
    """Logarithmic vertical scale with plain powers of ten as labels, about five of them.

    If it shows fewer than two of them, there are numbers between, in half a decade at each tick. Values
    of which none is positive keep their scale.
    """
    from matplotlib.ticker import FuncFormatter, LogLocator

    def between(value: float, _: object) -> str:
        low, high = np.log10(axes.get_ylim())
        few = np.floor(high) - np.ceil(low) < 1.0
        return f"{value:g}" if few and (high - low < 0.5 or f"{value:e}"[0] in "235") else ""

    if axes.has_data() and not np.isfinite(axes.dataLim.minposy):
        return
    axes.set_yscale("log", nonpositive="clip")
    axes.yaxis.set_major_locator(LogLocator(numticks=5))
    axes.yaxis.set_major_formatter(
        FuncFormatter(lambda value, _: power_of_ten(round(float(np.log10(value)))))
    )
    axes.yaxis.set_minor_formatter(FuncFormatter(between))


def positive(values: FloatArray) -> FloatArray:
    """Values with NaN in place of those that a logarithmic scale has no place for."""
    return np.where(values > 0.0, values, np.nan)


def near_zero_scale(axes: "Axes", near: float) -> None:
    """Vertical scale that is linear up to a value and logarithmic beyond, with plain numbers."""
    axes.set_yscale("symlog", linthresh=near)
    axes.yaxis.set_major_formatter("{x:g}")


def magnification(size: float, wanted: float) -> float:
    """Factor 1, 2 or 5 times a power of ten that brings a size near to the wanted one; 1 for no size."""
    if size == 0.0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(wanted / size))
    return float(max(step * power for step in (1.0, 2.0, 5.0) if step * power <= wanted / size * (1 + 1e-12)))


def power_of_ten(exponent: int) -> str:
    """A power of ten as it is written by hand."""
    return "10" + str(exponent).translate(_SUPERSCRIPTS)


def closed(polygon: FloatArray) -> FloatArray:
    """Corners (k, 2) with the first one repeated at the end."""
    return np.concatenate([polygon, polygon[:1]])


def outlines(features: FloatArray) -> FloatArray:
    """One line (k, d) along features that points (g, s, d) span, planes as polygons, NaN between them."""
    gap = np.full((1, features.shape[-1]), np.nan)
    parts = [closed(span[np.isfinite(span).all(axis=1)]) for span in features]
    return np.concatenate([gap[:0], *(part for span in parts for part in (span, gap))])


def face(axes: "Axes", corners: FloatArray, line_style: LineStyle, *, fill: bool = False) -> None:
    """Draw a face from its corners (k, 2) in cyclic order; a dot marks the first."""
    loop = closed(corners)
    if fill:
        axes.fill(*loop.T, color=PALE, alpha=0.35, linewidth=0)
    axes.plot(*loop.T, **line_style)
    axes.plot(*corners[:1].T, "o", color=line_style["color"], markersize=_FIRST_MARKER)


def start_and_goal(axes: "Axes", start: FloatArray, goal: FloatArray, *, fill: bool = True) -> None:
    """Draw the face at the start and at the goal from their corners (k, 2) in cyclic order."""
    face(axes, start, START, fill=fill)
    face(axes, goal, GOAL)


def paths(axes: "Axes", points: FloatArray, line_style: LineStyle, *, mask: BoolArray | None = None) -> None:
    """Draw the paths (k, m, 2) of m points, of all instants or of those selected by a mask (k,)."""
    if mask is not None:
        points = np.where(mask[:, None, None], points, np.nan)
    axes.plot(points[..., 0], points[..., 1], **line_style)


_OUTSIDE = 0.15  # how far outside an image, as a share of its size, a path is still drawn
_NEAR_BORDER = 0.42  # distance from the middle, as a share of the image, from which its border shows
_BORDER = line(GREY, DOTTED, 0.8, label="border of the image")


def border(axes: "Axes", size: FloatArray, pixels: FloatArray) -> None:
    """Draw the border of an image of a size (2,), px; the legend names it where pixels (k, 2) are near it."""
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * size - 0.5
    near = (np.abs(pixels / size - 0.5) > _NEAR_BORDER).any()
    axes.plot(*closed(corners).T, **_BORDER | {"label": _BORDER["label"] if near else ""})


def near_pixels(pixels: FloatArray, size: FloatArray) -> FloatArray:
    """Of pixels (…, 2) those (k, 2) that were measured, none farther outside the image than is drawn."""
    measured = pixels[np.isfinite(pixels).all(axis=-1)]
    return np.clip(measured, -_OUTSIDE * size, (1.0 + _OUTSIDE) * size)
