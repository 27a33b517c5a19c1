"""Statistics of a sweep: success rates with Wilson intervals, verdicts, laws compared on the same tasks."""

import json
from collections.abc import Iterator, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.stats import binomtest

from projservo_cli.config.sweep import LAW
from projservo_cli.files import write_whole
from projservo_cli.records import BoolArray
from projservo_cli.report import style
from projservo_cli.report.figures.sweep_success import draw_basin, pictures, wilson_interval
from projservo_cli.stages import Progress
from projservo_cli.store.observation_tables import to_csv
from projservo_cli.store.sweep_table import SweepTable

_QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
_MEASURES = (
    "steps",
    "position_error_mm",
    "rotation_error_deg",
    "path_length_ratio",
    "center_deviation_at_samples_mm",
    "effort",
)
_PAIRED = ("steps", "position_error_mm", "path_length_ratio")


def of_runs(table: SweepTable, these: BoolArray) -> dict[str, Any]:
    """Statistics of some runs; quantiles of those that succeeded."""
    count, good = int(these.sum()), these & table["success"]
    successes = int(good.sum())
    verdicts, counts = np.unique(table["verdict"][these], return_counts=True)
    return {
        "runs": count,
        "converged": int(table["converged"][these].sum()),
        "successes": successes,
        "success_rate": successes / count,
        "success_interval": wilson_interval(successes, count),
        "self_occluded_rate": float(table["self_occluded"][these].mean()),
        "left_image_rate": float(table["left_image"][these].mean()),
        "verdicts": dict(zip(verdicts.tolist(), counts.tolist(), strict=True)),
        "quantiles": {name: _quantiles(table[name][good]) for name in _MEASURES},
    }


def _quantiles(values: npt.NDArray[Any]) -> dict[str, float | None]:
    """Quantiles of values that are numbers; None where there is none."""
    numbers = values[np.isfinite(values)]
    found = np.quantile(numbers, _QUANTILES).tolist() if len(numbers) else [None] * len(_QUANTILES)
    return {f"{share:g}": value for share, value in zip(_QUANTILES, found, strict=True)}


def paired(table: SweepTable, laws: Sequence[str] | None = None) -> Iterator[dict[str, Any]]:
    """Each two laws, or two of them, on the same tasks with the same noise, by the other values."""
    names = [name for name, _ in table.axes]
    if LAW not in names:
        return
    groups: dict[str, dict[str, tuple[dict[str, Any], BoolArray]]] = {}
    for cell, these in table.cells():
        values = table.values(cell)
        law = values.pop(LAW)
        groups.setdefault(repr(values), {})[law] = (values, these)
    for group in groups.values():
        for first, second in combinations(group, 2) if laws is None else [laws]:
            values, one = group[first]
            yield {**values, "laws": [first, second], **_compared(table, one, group[second][1])}


def _compared(table: SweepTable, one: BoolArray, other: BoolArray) -> dict[str, Any]:
    """Runs of two laws that share their draws: how often which succeeds, and differences where both do.

    The probabilities are of the exact test of McNemar and of the sign test: how often a difference as
    large or larger would come about between laws that are alike.
    """
    _, i, j = np.intersect1d(table["draw"][one], table["draw"][other], return_indices=True)
    a, b = table["success"][one][i], table["success"][other][j]
    only = [int((a & ~b).sum()), int((b & ~a).sum())]
    both = a & b
    differences = {name: (table[name][one][i] - table[name][other][j])[both] for name in _PAIRED}
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


_STATISTICS = "statistics.json"


def report(path: Path, formats: Sequence[str], progress: Progress) -> tuple[dict[str, Any], list[Path]]:
    """Write statistics and figures of the table of a sweep next to it; return both."""
    table, folder = SweepTable(path), path.parent
    cells = [{"cell": cell, **table.values(cell), **of_runs(table, these)} for cell, these in table.cells()]
    found = {"runs": table.rows, "total": table.attributes["total"], "cells": cells}
    found["paired"] = list(paired(table))
    text = json.dumps(found, indent=1, allow_nan=False) + "\n"
    files = [write_whole(folder / _STATISTICS, text)]
    figures = list(pictures(table))
    for done, (name, data, draw) in enumerate(figures):
        progress("figures", done, len(figures))
        height, width = (4.0, style.WIDTH) if draw is draw_basin else (2.9, 0.65 * style.WIDTH)
        made = style.contents(style.drawn(draw, data, height, width), formats)
        files += [write_whole(folder / f"{name}.{kind}", content) for kind, content in made.items()]
        files.append(write_whole(folder / f"{name}.csv", to_csv(data)))
    progress("figures", len(figures), len(figures))
    return found, files
