"""Statistics of a sweep: success rates with Wilson intervals, verdicts, laws compared on the same tasks.

They go into a report, and into the object that a caller in Python gets.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.stats import binomtest

from projservo_cli.config.sweep import LAW
from projservo_cli.records import BoolArray, InputError
from projservo_cli.report import style
from projservo_cli.report.figures.sweep_success import draw_basin, pictures, wilson_interval
from projservo_cli.results import RunTrace
from projservo_cli.stages import Progress
from projservo_cli.store.display import Displayable, pandas, xarray
from projservo_cli.store.files_and_locks import write_whole
from projservo_cli.store.observation_tables import to_csv
from projservo_cli.store.sweep_table import Failure, SweepTable

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


def _of_runs(table: SweepTable, these: BoolArray) -> dict[str, Any]:
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
    """Quantiles of values that are numbers; None if there is none."""
    numbers = values[np.isfinite(values)]
    found = np.quantile(numbers, _QUANTILES).tolist() if len(numbers) else [None] * len(_QUANTILES)
    return {f"{share:g}": value for share, value in zip(_QUANTILES, found, strict=True)}


def _paired(table: SweepTable, laws: Sequence[str] | None = None) -> Iterator[dict[str, Any]]:
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
    """Runs of two laws that share their draws: how often which succeeds, and differences if both do.

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


def _drawn(data: Any, draw: Any) -> Any:
    """Draw a figure in its size; the basin has the larger one."""
    height, width = (4.0, style.WIDTH) if draw is draw_basin else (2.9, 0.65 * style.WIDTH)
    return style.drawn(draw, data, height, width)


def report(path: Path, formats: Sequence[str], progress: Progress) -> tuple[dict[str, Any], list[Path]]:
    """Write statistics and figures of the table of a sweep next to it; return both."""
    table, folder = SweepTable(path), path.parent
    cells = [{"cell": cell, **table.values(cell), **_of_runs(table, these)} for cell, these in table.cells()]
    found = {"runs": table.rows, "total": table.attributes["total"], "cells": cells}
    found["paired"] = list(_paired(table))
    text = json.dumps(found, indent=1, allow_nan=False) + "\n"
    files = [write_whole(folder / "statistics.json", text)]
    figures = list(pictures(table))
    for done, (name, data, draw) in enumerate(figures):
        progress("figures", done, len(figures))
        made = style.contents(_drawn(data, draw), formats)
        files += [write_whole(folder / f"{name}.{kind}", content) for kind, content in made.items()]
        files.append(write_whole(folder / f"{name}.csv", to_csv(data)))
    progress("figures", len(figures), len(figures))
    return found, files


_SHOWN = 9  # cells and failures that are printed
_SHOWN_FAILURES = 3


class Study(Displayable):
    """The runs of a sweep that are done.

    Parameters
    ----------
    table : the stored table.
    names : of laws as their caller calls them, by the names in the table.
    """

    def __init__(self, table: SweepTable, names: Mapping[str, str] | None = None) -> None:
        self._table, self._names = table, dict(names or {})
        for name in table.names:  # stored files are gone when the caller sees the result
            table[name]
        self._traces = {run: RunTrace.of(table.trace(run)) for run in table.traces}
        self.path: Path | None = table.path

    @cached_property
    def table(self) -> Mapping[str, npt.NDArray[Any]]:
        """Columns (k,) of all runs, by name; laws as their caller calls them."""
        found = {name: self._table[name] for name in self._table.names}
        if "law" in found and self._names:
            found["law"] = np.array([self._names.get(law, law) for law in found["law"].tolist()])
        return found

    @property
    def traces(self) -> Mapping[int, RunTrace]:
        """Traces that were kept, by the number of their run."""
        return self._traces

    @property
    def failures(self) -> Mapping[str, Failure]:
        """Runs that failed or did not start, by law: how many ``runs``, the ``first`` and its ``reason``."""
        return {self._names.get(law, law): one for law, one in self._table.failures.items()}

    def success(self) -> list[dict[str, Any]]:
        """Return for each cell its values, ``runs``, ``successes``, ``success_rate`` and its interval.

        ``success_interval`` is Wilson's, of 95 %; ``quantiles`` are of runs that succeeded.
        """
        table = self._table
        return [self._named(table.values(cell)) | _of_runs(table, these) for cell, these in table.cells()]

    def paired(self, first: str | type, second: str | type) -> list[dict[str, Any]]:
        """Return how two laws compare on the same tasks with the same noise, for each combination of values.

        Parameters
        ----------
        first, second : laws of the sweep, by name or class.

        Returns
        -------
        ``pairs``; ``both``, ``only`` (first, second) and ``neither`` succeeded; ``p_success`` of the exact
        test of McNemar; ``median_difference`` first less second if both succeed, and ``p_difference`` of
        the sign test, by measure.

        Raises
        ------
        InputError
            When the sweep has no such law.
        """
        laws = dict(self._table.axes).get("law", ())
        known = {self._names.get(law, law): law for law in laws}
        asked = []
        for law in (first, second):
            name = law if isinstance(law, str) else law.__name__
            if name not in known and name not in known.values():
                raise InputError(f"paired: no law {name} in this sweep; laws: {', '.join(known)}")
            asked.append(known.get(name, name))
        found = _paired(self._table, asked)
        return [one | {"laws": [self._names.get(law, law) for law in one["laws"]]} for one in found]

    def plot(self, name: str | None = None) -> Any:
        """Draw a figure of the sweep, as its report does.

        Parameters
        ----------
        name : of the figure, as in ``study.plot("final_error")``; by default the first that its values allow.

        Raises
        ------
        InputError
            If its values allow no such figure.
        """
        known = {one: (data, draw) for one, data, draw in pictures(self._table)}
        if not known or name not in (None, *known):
            raise InputError(f"plot: figure {name}: this sweep allows {', '.join(known) or 'none'}")
        return _drawn(*known[name or next(iter(known))])

    def to_frame(self) -> Any:
        """Return the table as a pandas table; an InputError without pandas."""
        return pandas().DataFrame(dict(self.table))

    def to_xarray(self) -> Any:
        """Return the table as a Dataset over ``run``; an InputError without xarray."""
        return xarray().Dataset(
            {name: ("run", values) for name, values in self.table.items() if name != "run"},
            {"run": self.table["run"]},
        )

    def summary(self) -> dict[str, str]:
        """Return a summary in words, by name."""
        cells = self.success()
        values = {"runs": f"{len(self.table['run'])} in {len(cells)} cells"}
        failures = [*self._table.failures.items()][:_SHOWN_FAILURES]
        values |= {f"failures of {self._names.get(law, law)}": one.words for law, one in failures}
        n_named = _SHOWN - len(failures)
        for cell in cells[:n_named]:
            low, high = cell["success_interval"]
            place = ", ".join(f"{name} {cell[name]}" for name, _ in self._table.axes)
            values[place] = f"{cell['success_rate']:.1%} of {cell['runs']} succeed ({low:.1%} to {high:.1%})"
        return values | ({"more": f"{len(cells) - n_named} cells"} if len(cells) > n_named else {})

    def _named(self, values: dict[str, Any]) -> dict[str, Any]:
        return values | ({"law": self._names.get(values["law"], values["law"])} if "law" in values else {})
