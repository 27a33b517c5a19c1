"""Figures of a sweep: success over a column or over two start offsets, and final errors."""

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from projservo_cli.report import style
from projservo_cli.report.figure_inputs import Data
from projservo_cli.store.sweep_table import SweepTable

_LAW = "law"  # column
_OFFSET = "task.start_offset."  # prefix of the columns of a start offset
_ANGLES = tuple(range(0, 181, 30))  # edges of rotations, deg
_BINS = 8  # bins of a plotted value
_POINTS = 2_000  # points of a curve


def wilson_interval(successes: int, count: int) -> tuple[float, float]:
    """Return the 95 % interval of a proportion from counts.

    Source: E. B. Wilson, "Probable inference, the law of succession, and statistical inference",
    Journal of the American Statistical Association 22 (1927), p. 209.
    """
    from scipy.stats import binomtest  # takes longer to import than all figures

    interval = binomtest(successes, count).proportion_ci(0.95, "wilson")
    return float(interval.low), float(interval.high)


def pictures(table: SweepTable) -> Iterator[tuple[str, Data, Any]]:
    """Every figure that the columns of a sweep allow: the name of its files, its numbers, how it is drawn."""
    axes = [name for name, values in table.axes if len(values) > 1 and {*map(type, values)} <= {int, float}]
    for name in axes:
        yield f"success_over_{name}", _success(table, name, name, None), _draw_success
    drawn = [name for name in table.names if name in table.attributes["random"]]
    for name in (name for name in drawn if table[name].dtype.kind == "f"):
        edges = np.linspace(table[name].min(), np.nextafter(table[name].max(), math.inf), _BINS + 1)
        yield f"success_over_{name}", _success(table, name, name, edges.tolist()), _draw_success
    if np.nanmax(table["rotation_deg"], initial=0.0) - np.nanmin(table["rotation_deg"], initial=180.0) > 1.0:
        data = _success(table, "rotation_deg", "rotation from start to goal (deg)", [*_ANGLES[:-1], 180.1])
        yield "success_over_rotation", data, _draw_success
    offsets = [name for name in axes if name.startswith(_OFFSET)]
    if len(offsets) >= 2:
        yield "basin", _basin(table, offsets[0], offsets[1]), draw_basin
    if errors := _final_errors(table):
        yield "final_error", errors, _draw_final_errors


def _success(table: SweepTable, name: str, label: str, edges: Sequence[float] | None) -> Data:
    """Success of each law over a column, at each of its values or within edges.

    Of each law ``x``, ``runs``, ``rate``, and ``low`` and ``high`` of the interval (k,).
    """
    x, success, law = table[name], table["success"], table[_LAW]
    data: Data = {"label": np.array(label)}
    for one in dict.fromkeys(law.tolist()):
        mine = law == one
        bins = (
            [(float(value), mine & (x == value)) for value in np.unique(x[mine])]
            if edges is None
            else [(0.5 * (low + high), mine & (x >= low) & (x < high)) for low, high in pairwise(edges)]
        )
        counted = [(at, int(these.sum()), int((these & success).sum())) for at, these in bins if these.any()]
        at, count, good = (np.array([row[i] for row in counted]) for i in range(3))
        intervals = [wilson_interval(*pair) for pair in zip(good, count, strict=True)]
        low, high = np.array(intervals).reshape(-1, 2).T
        columns = {"x": at, "runs": count, "rate": good / count, "low": low, "high": high}
        data |= {f"{one}.{key}": values for key, values in columns.items()}
    return data


def _basin(table: SweepTable, first: str, second: str) -> Data:
    x, y, begun = np.unique(table[first]), np.unique(table[second]), table["steps"] >= 0
    data: Data = {"x": x, "y": y, "label_x": np.array(first), "label_y": np.array(second)}
    for law in dict.fromkeys(table[_LAW].tolist()):
        mine = table[_LAW] == law
        share = np.full((len(y), len(x)), np.nan)
        for i, j in np.ndindex(*share.shape):
            these = mine & begun & (table[first] == x[j]) & (table[second] == y[i])
            if these.any():
                share[i, j] = table["success"][these].mean()
        data[f"{law}.share"] = share
    return data


def _final_errors(table: SweepTable) -> Data:
    data: Data = {}
    for law in dict.fromkeys(table[_LAW].tolist()):
        errors = table["position_error_mm"][table[_LAW] == law]
        finite = np.sort(errors[np.isfinite(errors)])
        if len(finite):
            displayed = np.unique(np.linspace(0, len(finite) - 1, _POINTS).astype(np.int64))
            data[f"{law}.error"] = np.maximum(finite[displayed], 1e-6)
            data[f"{law}.share"] = (displayed + 1) / len(errors)
    return data


def _draw_success(data: Data, figure: "style.Figure") -> None:
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


def draw_basin(data: Data, figure: "style.Figure") -> None:
    """Success of each law over two start offsets, as a map with a panel for each; pale if none begins.

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
        axes.set(title=law, facecolor=style.PALE)  # pale if no run can begin
        axes.set_xticks(data["x"][:: max(1, len(data["x"]) // 5)])
        axes.set_yticks(data["y"][:: max(1, len(data["y"]) // 5)])
    for axes in panels[len(laws) :]:
        axes.set_visible(False)
    figure.supxlabel(str(data["label_x"]), fontsize=8)
    figure.supylabel(str(data["label_y"]), fontsize=8)
    figure.colorbar(mesh, ax=panels.tolist(), label="success (%)")


def _draw_final_errors(data: Data, figure: "style.Figure") -> None:
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
