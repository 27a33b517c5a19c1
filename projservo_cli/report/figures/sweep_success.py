"""Figures of a sweep: success over a column or over two start offsets, and final errors."""

import math
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from projservo_cli.report import style
from projservo_cli.report.report_data import Data


def draw_success(data: Data, figure: Figure) -> None:
    """Success of each law, ``<law>.rate``, from ``.low`` to ``.high``, over ``.x``, which is a ``label``."""
    axes = figure.add_subplot()
    laws = _laws(data, ".rate")
    span = max(float(np.ptp(data[f"{law}.x"])) for law in laws) or 1.0
    for i, law in enumerate(laws):
        x, rate = data[f"{law}.x"], data[f"{law}.rate"]
        offset = 0.006 * span * (i - 0.5 * (len(laws) - 1))  # so that bars of laws do not hide each other
        reach = np.maximum(0.0, [rate - data[f"{law}.low"], data[f"{law}.high"] - rate])
        line = style.curve(i, law, marker=True)
        axes.errorbar(x + offset, 100.0 * rate, 100.0 * reach, capsize=2, elinewidth=0.7, **line)
    axes.set(xlabel=str(data["label"]), ylabel="success (%), bars: 95 %", ylim=(-3, 103))
    style.legend_below(figure, min(3, len(laws)))


def draw_basin(data: Data, figure: Figure) -> None:
    """Success of each law over two start offsets, as a map with a panel for each; pale where none begins.

    ``data`` has ``x`` (k,), ``y`` (j,), ``label_x``, ``label_y`` and for each law ``<law>.share`` (j, k).
    """
    figure.set_layout_engine("constrained")  # leaves the scale of colours its room
    laws = _laws(data, ".share")
    columns = min(3, len(laws))
    panels = figure.subplots(
        math.ceil(len(laws) / columns), columns, sharex=True, sharey=True, squeeze=False
    ).ravel()
    x, y = _edges(data["x"]), _edges(data["y"])
    mesh: Any = None
    for axes, law in zip(panels, laws, strict=False):
        mesh = axes.pcolormesh(x, y, 100.0 * data[f"{law}.share"], vmin=0, vmax=100)
        axes.grid(visible=False)
        axes.set(title=law, facecolor=style.PALE)  # pale where no run can begin
        axes.set_xticks(data["x"][:: max(1, len(data["x"]) // 5)])
        axes.set_yticks(data["y"][:: max(1, len(data["y"]) // 5)])
    for axes in panels[len(laws) :]:
        axes.set_visible(False)
    figure.supxlabel(str(data["label_x"]), fontsize=8)
    figure.supylabel(str(data["label_y"]), fontsize=8)
    figure.colorbar(mesh, ax=panels.tolist(), label="success (%)")


def draw_final_errors(data: Data, figure: Figure) -> None:
    """Share of the runs of each law that end within a distance of the goal.

    ``data`` has for each law ``<law>.error`` (k,), mm, sorted, and ``<law>.share`` (k,) of all its runs.
    """
    axes = figure.add_subplot()
    laws = _laws(data, ".error")
    for i, law in enumerate(laws):
        line = style.curve(i, law)
        axes.plot(data[f"{law}.error"], 100.0 * data[f"{law}.share"], drawstyle="steps-post", **line)
    label = "distance of the centre from the goal at the end (mm)"
    axes.set(xlabel=label, ylabel="runs within it (%)", xscale="log", ylim=(-3, 103))
    style.legend_below(figure, min(3, len(laws)))


def _laws(data: Data, ending: str) -> list[str]:
    return [name.removesuffix(ending) for name in data if name.endswith(ending)]


def _edges(x: Any) -> Any:
    """Edges of the cells around sorted places."""
    middle = 0.5 * (x[1:] + x[:-1])
    return np.concatenate([[1.5 * x[0] - 0.5 * x[1]], middle, [1.5 * x[-1] - 0.5 * x[-2]]])
