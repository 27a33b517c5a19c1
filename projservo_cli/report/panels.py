"""Panels that several figures share: rows of them, images of cameras, and curves."""

import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from projservo_cli.records import BoolArray, FloatArray
from projservo_cli.report import style

PATH = style.line(style.GREY, width=0.8, label="path of a marker")


def rows(
    figure: "style.Figure", counts: Sequence[int], heights: Sequence[float] | None = None
) -> list[list["style.Axes"]]:
    """Rows of panels, with given numbers of panels, of one width in a row and of relative heights."""
    grid = figure.add_gridspec(len(counts), math.lcm(*counts), height_ratios=heights)
    parts = [np.split(np.arange(grid.ncols), count) for count in counts]
    return [
        [figure.add_subplot(grid[row, part[0] : part[-1] + 1]) for part in of_row]
        for row, of_row in enumerate(parts)
    ]


class DrawnRun(NamedTuple):
    """Faces of a run in the images, and how their paths are drawn."""

    s: FloatArray  # (k, V, m, 2) markers in cyclic order, px
    line: style.LineStyle
    hidden: BoolArray | None = None  # (k, V) whether the face is hidden, if that is to be shown


def images(row: Sequence["style.Axes"], runs: Sequence[DrawnRun], s_star: FloatArray) -> None:
    """Draw the paths of the markers, and the face at the start and at the goal (V, m, 2), in each image."""
    for view, panel in enumerate(row):
        for s, line, hidden in runs:
            if hidden is not None:
                style.paths(panel, s[:, view], style.HIDDEN, mask=hidden[:, view])
            style.paths(panel, s[:, view], line)
        style.start_and_goal(panel, runs[0].s[0, view], s_star[view])


def cameras(
    row: Sequence["style.Axes"],
    names: Iterable[str],
    heading: str = "",
    pixels: Sequence[FloatArray | None] | None = None,
) -> None:
    """Title the images of cameras, the first below a heading too, and show all that is drawn, or all pixels.

    pixels : (k, 2) of each image.
    """
    titles(row, names, heading)
    for panel, shown in zip(row, pixels or [None] * len(row), strict=True):
        style.image_axes(panel, shown)


def titles(row: Sequence["style.Axes"], names: Iterable[str], heading: str = "") -> None:
    """Title panels by their cameras, the first below a heading too."""
    for panel, name in zip(row, names, strict=True):
        above = f"{heading}\n" if heading and panel is row[0] else ""
        panel.set_title(f"{above}{name} camera")


def curves(axes: "style.Axes", x: FloatArray, values: FloatArray, lines: Iterable[style.LineStyle]) -> None:
    """Draw each column of values (k, c) over x (k,), in its style."""
    for column, line in zip(values.T, lines, strict=True):
        axes.plot(x, column, **line)


def joints(axes: "style.Axes", t: FloatArray, values: FloatArray, chosen: Iterable[int]) -> None:
    """Draw values (k, n) of the chosen joints over time (k,), in the styles and by the names of joints."""
    for i in chosen:
        axes.plot(t, values[:, i], **style.curve(i, f"$q_{{{i + 1}}}$"))


Curve = tuple[
    npt.NDArray[Any], npt.NDArray[Any], style.LineStyle
]  # abscissa (k,), values (k,), and their style


def errors(axes: "style.Axes", curves: Iterable[Curve], floor: float = 0.0, **names: str) -> None:
    """Draw errors over time on a logarithmic scale, smaller ones at ``floor``.

    names : of the abscissa and the ordinate.
    """
    for t, values, line in curves:
        axes.plot(t, np.maximum(values, floor), **line)
    style.log_scale(axes)
    axes.set(**{"xlabel": "time (s)"} | names)
