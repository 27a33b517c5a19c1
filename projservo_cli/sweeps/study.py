"""A sweep as an object: its table as arrays, how often laws succeed, and laws against each other."""

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from projservo_cli.display import Displayable, pandas, xarray
from projservo_cli.records import InputError
from projservo_cli.results import RunTrace
from projservo_cli.store.sweep_table import Failure, SweepTable
from projservo_cli.sweeps.statistics import of_runs, paired


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

        ``success_interval`` is that of Wilson, of 95 %; ``quantiles`` are of runs that succeeded.
        """
        table = self._table
        return [self._named(table.values(cell)) | of_runs(table, these) for cell, these in table.cells()]

    def paired(self, first: str | type, second: str | type) -> list[dict[str, Any]]:
        """Return how two laws compare on the same tasks with the same noise, for each combination of values.

        Parameters
        ----------
        first, second : laws of the sweep, by name or class.

        Returns
        -------
        ``pairs``; ``both``, ``only`` (first, second) and ``neither`` succeeded; ``p_success`` of the exact
        test of McNemar; ``median_difference`` first less second where both succeed, and ``p_difference`` of
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
        found = paired(self._table, asked)
        return [one | {"laws": [self._names.get(law, law) for law in one["laws"]]} for one in found]

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
        values |= {f"failures of {self._names.get(law, law)}": one.words(law) for law, one in failures}
        shown = _SHOWN - len(failures)
        for cell in cells[:shown]:
            low, high = cell["success_interval"]
            place = ", ".join(f"{name} {cell[name]}" for name, _ in self._table.axes)
            values[place] = f"{cell['success_rate']:.1%} of {cell['runs']} succeed ({low:.1%} to {high:.1%})"
        return values | ({"more": f"{len(cells) - shown} cells"} if len(cells) > shown else {})

    def _named(self, values: dict[str, Any]) -> dict[str, Any]:
        return values | ({"law": self._names.get(values["law"], values["law"])} if "law" in values else {})


_SHOWN = 9  # cells and failures that are printed
_SHOWN_FAILURES = 3
