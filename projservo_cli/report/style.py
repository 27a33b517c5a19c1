"""One look for all figures: print size, fonts, colours that survive grey print, and saving.

matplotlib is imported where it is used and always draws without a display; the same data give the
same bytes in SVG, PDF and PNG.
"""

import hashlib
import io
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from projservo_cli.records import FloatArray
from projservo_cli.report.material import Data, FigureSpec

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FORMATS = ("svg", "pdf", "png")
WIDTH = 6.9  # inches across both columns of a page
_PNG_DPI = 200
Look = dict[str, Any]
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
IMAGE = "image"  # label of axes that show pixels

# M. Okabe, K. Ito, "Color Universal Design", 2008; ordered so that neighbours differ in lightness.
BLACK, ORANGE, BLUE, SKY, VERMILION, GREEN, PURPLE = (
    "#000000",
    "#E69F00",
    "#0072B2",
    "#56B4E9",
    "#D55E00",
    "#009E73",
    "#CC79A7",
)
GREY = "#999999"
PALE = "#DDDDDD"
# Colour, line style and marker change together, so that a curve is known without its colour.
CURVES: tuple[tuple[str, Any, str], ...] = (
    (BLACK, "-", "o"),
    (VERMILION, (0, (5, 1.5)), "s"),
    (BLUE, (0, (1, 1)), "^"),
    (ORANGE, (0, (5, 1.5, 1, 1.5)), "D"),
    (GREEN, (0, (3, 3)), "v"),
    (PURPLE, (0, (3, 1, 1, 1, 1, 1)), "P"),
)

# How the face at the start and at the goal look in every figure.
START: Look = {"color": BLACK, "linewidth": 1.4}
GOAL: Look = {"color": BLUE, "linestyle": (0, (5, 1.5))}
SHARES: dict[str, Look] = {  # equal shares lie on one another: the wider shows beneath
    r"$\mu_t$": {"color": SKY, "linewidth": 3.0},
    r"$\mu_r$": {"color": BLACK, "linewidth": 1.8, "linestyle": (0, (4, 2))},
    r"$\mu_p$": {"color": VERMILION, "linewidth": 1.0, "linestyle": (0, (1, 1))},
}

_RC: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 8.0,
    "axes.titlesize": 8.5,
    "axes.titley": 1.0,  # fixed; looking for what is in its way takes a fifth of the arrangement
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


def new_figure(height: float, width: float = WIDTH) -> "Figure":
    """Empty figure of a size in inches whose parts arrange themselves."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import TightLayoutEngine

    # Without a rectangle it measures each part once; with one, or "constrained", twice, which takes 0.6 s.
    layout: Any = TightLayoutEngine(pad=0.5, rect=None)  # type: ignore[arg-type]
    figure = Figure(figsize=(width, height), layout=layout)
    FigureCanvasAgg(figure)
    return figure


def arrange(figure: "Figure") -> None:
    """Arrange the parts of a figure once, so that every format shows the same."""
    engine: Any = figure.get_layout_engine()
    if engine is None:
        return
    images: list[Any] = [axes for axes in figure.axes if axes.get_label() == IMAGE]
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
    for axes in images:
        axes.apply_aspect()
    figure.set_layout_engine()  # with an engine, even one that does nothing, saving draws twice


def _equal_scales(
    axes: "Axes", u: tuple[float, float], v: tuple[float, float], position: object = None
) -> None:
    """Widen the limits u and v until a pixel is as wide as it is high in the panel as it is."""
    del position
    box = axes.get_window_extent()
    way = np.array([u[1] - u[0], v[1] - v[0]])
    scale = max(abs(way[0]) / box.width, abs(way[1]) / box.height)
    half = 0.5 * scale * np.array([box.width, box.height]) * np.sign(way)
    middle = 0.5 * np.array([sum(u), sum(v)])
    axes.set_xlim(middle[0] - half[0], middle[0] + half[0])
    axes.set_ylim(middle[1] - half[1], middle[1] + half[1])


def drawn(spec: FigureSpec, data: Data, formats: Sequence[str]) -> dict[str, bytes]:
    """A figure of some data as files, by format: ``svg``, ``pdf`` or ``png``."""
    figure = new_figure(spec.height)
    spec.draw(data, figure)
    arrange(figure)
    return contents(figure, formats)


def contents(figure: "Figure", formats: Sequence[str]) -> dict[str, bytes]:
    """An arranged figure as files, by format: ``svg``, ``pdf`` or ``png``."""
    made = {}
    for kind in formats:
        file = io.BytesIO()
        figure.savefig(file, format=kind, dpi=_PNG_DPI, metadata=_METADATA[kind])
        made[kind] = clips_by_content(file.getvalue()) if kind == "svg" else file.getvalue()
    return made


def clips_by_content(svg: bytes) -> bytes:
    """The same picture with outlines that clip named by what they are.

    matplotlib names those that are no rectangles by where they are in memory.
    """
    outlines = re.findall(rb'<clipPath id="(\w+)">(.*?)</clipPath>', svg, re.DOTALL)
    names = {name: b"p" + hashlib.sha256(outline).hexdigest()[:10].encode() for name, outline in outlines}
    return re.sub(rb"p[0-9a-f]{10}", lambda found: names.get(found[0], found[0]), svg)


def pixels(figure: "Figure") -> npt.NDArray[np.uint8]:
    """Pixels (height, width, 3) of a figure as it is now."""
    canvas: Any = figure.canvas
    canvas.draw()
    return np.array(canvas.buffer_rgba(), dtype=np.uint8)[:, :, :3]


def legend_below(figure: "Figure", looks: Mapping[str, Look], columns: int) -> None:
    """Put one legend for the whole figure below all axes; an entry is a line, or a patch if it has a face."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles = [
        Patch(label=label, **look) if "facecolor" in look else Line2D([], [], label=label, **look)
        for label, look in looks.items()
    ]
    figure.legend(handles=handles, loc="lower center", ncols=columns)


def curve(index: int, *, marker: bool = False) -> Look:
    """Look of the curve of a number: colour, line style and, if asked for, marker."""
    color, style, symbol = CURVES[index % len(CURVES)]
    look = {"color": color, "linestyle": style}
    return look | {"marker": symbol} if marker else look


def image_axes(axes: "Axes", title: str) -> None:
    """Axes in pixels of an image with equal scales; the view widens to fill its panel."""
    axes.set(title=title, xlabel="u (px)", ylabel="v (px)", label=IMAGE)


def frame_pixels(axes: "Axes", pixels: FloatArray, margin: float = 0.06) -> None:
    """Show all pixels (…, 2) with a margin; v points down."""
    points = pixels.reshape(-1, 2)
    points = points[np.isfinite(points).all(axis=1)]
    low, high = points.min(axis=0), points.max(axis=0)
    pad = margin * max(float((high - low).max()), 1.0)
    axes.set_xlim(low[0] - pad, high[0] + pad)
    axes.set_ylim(high[1] + pad, low[1] - pad)


def aspect(pixels: FloatArray, least: float = 0.3, most: float = 1.1) -> float:
    """Height over width of what a panel shows of pixels (…, 2), within bounds fit for print."""
    points = pixels.reshape(-1, 2)
    size = np.ptp(points[np.isfinite(points).all(axis=1)], axis=0)
    return float(np.clip(size[1] / max(size[0], 1.0), least, most))


def log_scale(axes: "Axes") -> None:
    """Logarithmic vertical scale with plain powers of ten as labels, about five of them."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axes.set_yscale("log", nonpositive="clip")
    axis = axes.yaxis
    axis.set_major_locator(LogLocator(numticks=5))
    axis.set_major_formatter(FuncFormatter(_power))
    axis.set_minor_formatter(NullFormatter())


def _power(value: float, position: int | None = None) -> str:
    del position
    exponent = round(float(np.log10(value))) if value > 0 else 0
    return "10" + str(exponent).translate(_SUPERSCRIPTS)


def signed(value: float, decimals: int = 1) -> str:
    """Number with a typographic minus."""
    return f"{value:.{decimals}f}".replace("-", "\N{MINUS SIGN}")


def closed(polygon: FloatArray) -> FloatArray:
    """Corners (k, 2) with the first one repeated at the end."""
    return np.concatenate([polygon, polygon[:1]])


def face(axes: "Axes", corners: FloatArray, look: Look, *, fill: bool = False) -> None:
    """Draw a face from its corners (k, 2) in cyclic order; a dot marks the first."""
    loop = closed(corners)
    if fill:
        axes.fill(loop[:, 0], loop[:, 1], color=PALE, alpha=0.35, linewidth=0)
    axes.plot(loop[:, 0], loop[:, 1], **look)
    axes.plot(corners[:1, 0], corners[:1, 1], "o", color=look["color"], markersize=3)
