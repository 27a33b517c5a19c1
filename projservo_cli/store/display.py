"""Text and table output of records, and their conversion to labelled arrays."""

import dataclasses
import html
import importlib
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from projservo_cli.findings import Finding
from projservo_cli.records import FARTHEST_M, TWO_TURNS, VIEWS, FloatArray, InputError, flat_fields
from projservo_cli.result_hashes import File

_WIDTH = 100  # maximum length of a line, characters


class Printed:
    """Mixin that gives an object a short text, and a table for notebooks. A subclass has ``summary``."""

    def summary(self) -> dict[str, str]:
        """Return a summary in words, by name: eleven entries at most."""
        raise NotImplementedError

    def __repr__(self) -> str:
        summary = self.summary()
        width = max(map(len, summary))
        lines = [f"{name:{width}}  {value}" for name, value in summary.items()]
        short = (line if len(line) <= _WIDTH else line[: _WIDTH - 1] + "…" for line in lines)
        return "\n".join([type(self).__name__, *(f"  {line}" for line in short)])

    def _repr_html_(self) -> str:
        rows = (
            f"<tr><th>{html.escape(k)}</th><td>{html.escape(v)}</td></tr>" for k, v in self.summary().items()
        )
        return f"<table><caption>{type(self).__name__}</caption>{''.join(rows)}</table>"


class Displayable(Printed):
    """Mixin that gives a record labelled arrays too.

    A subclass is a dataclass derived from its record.
    """

    def to_xarray(self) -> Any:
        """Return all arrays and scalars as a Dataset, as in the run file, with coordinates.

        Of a list of parts, such as the objects of a goal, it holds the first.

        Raises
        ------
        InputError
            If xarray is not installed.
        """
        from projservo_cli.store.run_file import dataset_of

        xarray()
        return dataset_of(self.record).assign_coords(self.coordinates())

    @property
    def record(self) -> Any:
        """Record that a run file stores."""
        kind = next(base for base in type(self).__mro__[1:] if dataclasses.is_dataclass(base))
        return kind(**{field.name: getattr(self, field.name) for field in dataclasses.fields(kind)})

    def coordinates(self) -> dict[str, Any]:
        """Return coordinates of dimensions, by their names."""
        sizes: dict[str, int] = {}
        for field in flat_fields(type(self)):
            value = getattr(self, field.name)
            if value is not None and "dims" in field.metadata:
                sizes |= dict(zip(field.metadata["dims"], np.shape(value), strict=True))
        found: dict[str, Any] = {"view": [*getattr(self, "view", VIEWS)], "xy": ["u", "v"]}
        found = {name: values for name, values in found.items() if name in sizes}
        if "joint" in sizes:
            found["joint"] = [f"q{i + 1}" for i in range(sizes["joint"])]
        return found


def plain(value: Any, *, finite: bool = False) -> Any:
    """A value as YAML and JSON know it: no arrays and numbers of NumPy, no tuples, no paths.

    finite : strict JSON, with None in place of NaN and infinity.
    """
    if isinstance(value, Finding):
        value = value.plain()
    if hasattr(value, "tolist"):  # a NumPy value
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return [plain(inner, finite=finite) for inner in value]
    if isinstance(value, Mapping):
        return {str(key): plain(inner, finite=finite) for key, inner in value.items()}
    if finite and isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value


def pandas() -> Any:
    """Return the package pandas. Raises InputError if it is not installed."""
    return _imported("pandas", "to_frame")


def xarray() -> Any:
    """Return the package xarray. Raises InputError if it is not installed."""
    return _imported("xarray", "to_xarray")


def _imported(package: str, method: str) -> Any:
    """Import a package of the extra ``tables``, which a method needs."""
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise InputError(f"{method} needs {package}: pip install '.[tables]'") from error


def require_radians(
    name: str, q: FloatArray, joint_types: str, remedy: str = "convert with numpy.radians"
) -> None:
    """Raise InputError for joint readings (..., n) that can hardly be in rad, or m of a prismatic joint."""
    turning = np.array([letter == "R" for letter in joint_types])
    beyond = np.argwhere(np.abs(q) > np.where(turning, TWO_TURNS, FARTHEST_M))
    if beyond.size:
        value, i = q[tuple(beyond[0])], beyond[0][-1]
        if not turning[i]:
            raise InputError(f"{name}: joint {i + 1}, prismatic, at {value:g} m: millimetres? divide by 1000")
        raise InputError(
            f"{name}: joint {i + 1} at {value:g} is more than two turns in rad: degrees? {remedy}"
        )


def numbers_in(name: str, given: npt.ArrayLike, said: str) -> FloatArray:
    """Convert to an array of real numbers, NaN where masked; an InputError for other values.

    said : the shape, for messages.
    """
    try:
        values: Any = np.ma.array(given)
        if values.dtype.kind != "c":
            return np.array(np.ma.filled(values.astype(np.float64), np.nan))
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: no array of numbers; expected shape {said}") from error
    raise InputError(f"{name}: complex numbers; expected real ones of shape {said}")


def checked_array(
    name: str, given: npt.ArrayLike, shape: Sequence[int | None], said: str, *, finite: bool = False
) -> FloatArray:
    """Convert to an array of numbers and check its shape; None means any length of one or more.

    said : the shape, for messages.
    Raises InputError, naming the array and the shapes.
    """
    array = numbers_in(name, given, said)
    fits = array.ndim == len(shape) and all(
        size > 0 if wanted is None else size == wanted
        for size, wanted in zip(array.shape, shape, strict=False)
    )
    if not fits:
        raise InputError(f"{name} of shape {array.shape}: expected {said}")
    if finite and not np.isfinite(array).all():
        raise InputError(f"{name}: holds a number that is not finite")
    return array


class About(NamedTuple):
    """Configuration as pages show it."""

    name: str
    seed: int
    recorded: bool  # whether the calibration comes from a table
    estimates_noise: bool  # whether its pixel noise is estimated
    joints: tuple[str | None, ...]  # names of the joints
    required: tuple[str, ...] | None  # laws that must converge; None for all but classical ones
    text: tuple[str | File, ...]  # all of it as YAML, of which files are parts

    @property
    def configuration(self) -> str:
        """All of it as YAML."""
        return "".join(part.path if isinstance(part, File) else part for part in self.text)
