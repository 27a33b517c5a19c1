"""Statistics of a sweep: success rates with Wilson intervals, verdicts, laws compared on the same tasks."""

import json
import math
from collections.abc import Iterator, Sequence
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.stats import binomtest

from projservo_cli.config.sweep import LAW
from projservo_cli.files import write_whole
from projservo_cli.records import BoolArray
from projservo_cli.report import style
from projservo_cli.report.figures.sweep_success import draw_basin, draw_final_errors, draw_success
from projservo_cli.report.report_data import Data
from projservo_cli.stages import Progress
from projservo_cli.store.sweep_table import SweepTable
from projservo_cli.store.tables import to_csv

QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
MEASURES = (
    "steps",
    "position_error_mm",
    "rotation_error_deg",
    "path_length_ratio",
    "center_deviation_at_samples_mm",
    "effort",
)
PAIRED = ("steps", "position_error_mm", "path_length_ratio")


class Rows:
    """Columns of the table of a sweep as they are needed, and what follows from them."""

    def __init__(self, table: SweepTable) -> None:
        self.table = table
        self.axes: list[tuple[str, list[Any]]] = [(name, values) for name, values in table.attributes["axes"]]
        self._columns: dict[str, npt.NDArray[Any]] = {}

    def __getitem__(self, name: str) -> npt.NDArray[Any]:
        """A column, read once."""
        if name not in self._columns:
            self._columns[name] = self._derived(name)
        return self._columns[name]

    def read(self) -> None:
        """Read all columns of the table."""
        for name in self.table.names:
            self[name]

    def _derived(self, name: str) -> npt.NDArray[Any]:
        if name == "success":
            return np.asarray(self.table.column(name) == 1)
        if name == "converged":
            return np.asarray(self["verdict"] == name)
        if name == LAW and LAW not in self.table.names:  # where an axis of another name sets it
            return np.full(self.table.rows, "all")
        if name == "self_occluded":
            return (self["self_occluded_steps_left"] > 0) | (self["self_occluded_steps_right"] > 0)
        if name == "left_image":
            return self["first_outside_image"] >= 0
        if name == "path_length_ratio":
            straight = self["distance_mm"]
            ratio = np.full(straight.shape, np.nan)
            np.divide(self["path_length_mm"], straight, out=ratio, where=straight > 1.0)
            return ratio
        return self.table.column(name)

    def values(self, cell: int) -> dict[str, Any]:
        """Value of each axis in a cell."""
        positions = np.unravel_index(cell, [len(values) for _, values in self.axes])
        return {name: values[int(i)] for (name, values), i in zip(self.axes, positions, strict=True)}

    def cells(self) -> Iterator[tuple[int, BoolArray]]:
        """Each cell that has runs, and which they are."""
        for cell in np.unique(self["cell"]):
            yield int(cell), self["cell"] == cell


def of_runs(rows: Rows, these: BoolArray) -> dict[str, Any]:
    """Statistics of some runs; quantiles of those that succeeded."""
    count, good = int(these.sum()), these & rows["success"]
    successes = int(good.sum())
    verdicts, counts = np.unique(rows["verdict"][these], return_counts=True)
    return {
        "runs": count,
        "converged": int(rows["converged"][these].sum()),
        "successes": successes,
        "success_rate": successes / count,
        "success_interval": _interval(successes, count),
        "self_occluded_rate": float(rows["self_occluded"][these].mean()),
        "left_image_rate": float(rows["left_image"][these].mean()),
        "verdicts": dict(zip(verdicts.tolist(), counts.tolist(), strict=True)),
        "quantiles": {name: _quantiles(rows[name][good]) for name in MEASURES},
    }


def _interval(successes: int, count: int) -> tuple[float, float]:
    """Return the 95 % interval of a proportion from counts.

    Source: E. B. Wilson, "Probable inference, the law of succession, and statistical inference",
    Journal of the American Statistical Association 22 (1927), p. 209.
    """
    interval = binomtest(successes, count).proportion_ci(0.95, "wilson")
    return float(interval.low), float(interval.high)


def _quantiles(values: npt.NDArray[Any]) -> dict[str, float | None]:
    """Quantiles of values that are numbers; None where there is none."""
    numbers = values[np.isfinite(values)]
    found = np.quantile(numbers, QUANTILES).tolist() if len(numbers) else [None] * len(QUANTILES)
    return {f"{share:g}": value for share, value in zip(QUANTILES, found, strict=True)}


def paired(rows: Rows, laws: Sequence[str] | None = None) -> Iterator[dict[str, Any]]:
    """Each two laws, or two of them, on the same tasks with the same noise, by the other values."""
    names = [name for name, _ in rows.axes]
    if LAW not in names:
        return
    groups: dict[str, dict[str, tuple[dict[str, Any], BoolArray]]] = {}
    for cell, these in rows.cells():
        values = rows.values(cell)
        law = values.pop(LAW)
        groups.setdefault(repr(values), {})[law] = (values, these)
    for group in groups.values():
        for first, second in combinations(group, 2) if laws is None else [laws]:
            values, one = group[first]
            yield {**values, "laws": [first, second], **_compared(rows, one, group[second][1])}


def _compared(rows: Rows, one: BoolArray, other: BoolArray) -> dict[str, Any]:
    """Runs of two laws that share their draws: how often which succeeds, and differences where both do.

    The probabilities are of the exact test of McNemar and of the sign test: how often a difference as
    large or larger would come about between laws that are alike.
    """
    _, i, j = np.intersect1d(rows["draw"][one], rows["draw"][other], return_indices=True)
    a, b = rows["success"][one][i], rows["success"][other][j]
    only = [int((a & ~b).sum()), int((b & ~a).sum())]
    both = a & b
    differences = {name: (rows[name][one][i] - rows[name][other][j])[both] for name in PAIRED}
    return {
        "pairs": len(i),
        "both": int(both.sum()),
        "only": only,
        "neither": int((~a & ~b).sum()),
        "p_success": _chance(*only),
        "median_difference": {name: _quantiles(values)["0.5"] for name, values in differences.items()},
        "p_difference": {
            name: _chance(int((values > 0).sum()), int((values < 0).sum()))
            for name, values in differences.items()
        },
    }


def _chance(first: int, second: int) -> float:
    """Two-sided probability of a split as uneven as this or more, between equals."""
    return float(binomtest(first, first + second).pvalue) if first + second else 1.0


STATISTICS = "statistics.json"
OFFSET = "task.start_offset."
ANGLES = tuple(range(0, 181, 30))
BINS = 8  # of a value that is drawn
POINTS = 2_000  # of a curve


def report(path: Path, formats: Sequence[str], progress: Progress) -> tuple[dict[str, Any], list[Path]]:
    """Write statistics and figures of the table of a sweep next to it; return both."""
    table, folder = SweepTable(path), path.parent
    rows = Rows(table)
    cells = [{"cell": cell, **rows.values(cell), **of_runs(rows, these)} for cell, these in rows.cells()]
    found = {"runs": table.rows, "total": table.attributes["total"], "cells": cells}
    found["paired"] = list(paired(rows))
    text = json.dumps(found, indent=1, allow_nan=False) + "\n"
    files = [write_whole(folder / STATISTICS, text)]
    pictures = list(_pictures(rows))
    for done, (name, data, draw) in enumerate(pictures):
        progress("figures", done, len(pictures))
        height, width = (4.0, style.WIDTH) if draw is draw_basin else (2.9, 0.65 * style.WIDTH)
        made = style.contents(style.drawn(draw, data, height, width), formats)
        files += [write_whole(folder / f"{name}.{kind}", content) for kind, content in made.items()]
        files.append(write_whole(folder / f"{name}.csv", to_csv(data)))
    progress("figures", len(pictures), len(pictures))
    return found, files


def _pictures(rows: Rows) -> Iterator[tuple[str, Data, Any]]:
    """Every figure that the columns of a sweep allow: the name of its files, its numbers, how it is drawn."""
    axes = [name for name, values in rows.axes if len(values) > 1 and {*map(type, values)} <= {int, float}]
    for name in axes:
        yield f"success_over_{name}", _success(rows, name, name, None), draw_success
    drawn = [name for name in rows.table.names if name in rows.table.attributes["random"]]
    for name in (name for name in drawn if rows[name].dtype.kind == "f"):
        edges = np.linspace(rows[name].min(), np.nextafter(rows[name].max(), math.inf), BINS + 1)
        yield f"success_over_{name}", _success(rows, name, name, edges.tolist()), draw_success
    if np.nanmax(rows["rotation_deg"], initial=0.0) - np.nanmin(rows["rotation_deg"], initial=180.0) > 1.0:
        data = _success(rows, "rotation_deg", "rotation from start to goal (deg)", [*ANGLES[:-1], 180.1])
        yield "success_over_rotation", data, draw_success
    offsets = [name for name in axes if name.startswith(OFFSET)]
    if len(offsets) >= 2:
        yield "basin", _basin(rows, offsets[0], offsets[1]), draw_basin
    if errors := _final_errors(rows):
        yield "final_error", errors, draw_final_errors


def _success(rows: Rows, name: str, label: str, edges: Sequence[float] | None) -> Data:
    """Success of each law over a column, at each of its values or within edges.

    Of each law ``x``, ``runs``, ``rate``, and ``low`` and ``high`` of the interval (k,).
    """
    x, success, law = rows[name], rows["success"], rows[LAW]
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
        low, high = np.array([_interval(*pair) for pair in zip(good, count, strict=True)]).reshape(-1, 2).T
        columns = {"x": at, "runs": count, "rate": good / count, "low": low, "high": high}
        data |= {f"{one}.{key}": values for key, values in columns.items()}
    return data


def _basin(rows: Rows, first: str, second: str) -> Data:
    x, y, begun = np.unique(rows[first]), np.unique(rows[second]), rows["steps"] >= 0
    data: Data = {"x": x, "y": y, "label_x": np.array(first), "label_y": np.array(second)}
    for law in dict.fromkeys(rows[LAW].tolist()):
        mine = rows[LAW] == law
        share = np.full((len(y), len(x)), np.nan)
        for i, j in np.ndindex(*share.shape):
            these = mine & begun & (rows[first] == x[j]) & (rows[second] == y[i])
            if these.any():
                share[i, j] = rows["success"][these].mean()
        data[f"{law}.share"] = share
    return data


def _final_errors(rows: Rows) -> Data:
    data: Data = {}
    for law in dict.fromkeys(rows[LAW].tolist()):
        errors = rows["position_error_mm"][rows[LAW] == law]
        finite = np.sort(errors[np.isfinite(errors)])
        if len(finite):
            displayed = np.unique(np.linspace(0, len(finite) - 1, POINTS).astype(np.int64))
            data[f"{law}.error"] = np.maximum(finite[displayed], 1e-6)
            data[f"{law}.share"] = (displayed + 1) / len(errors)
    return data
