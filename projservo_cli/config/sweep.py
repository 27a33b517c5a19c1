"""The configuration of a sweep: what is run how often, over which values."""

import json
import pathlib
from collections.abc import Iterator, Mapping
from typing import Annotated, Any

from pydantic import BeforeValidator, Field

from projservo_cli.config.models import FolderName, Plain, one_or_more
from projservo_cli.config.robot import Count, Finding, Positive, Root, Section, Whole
from projservo_cli.nominal import Number

BASE, LAW = "base", "law"  # names of axes with a meaning of their own


class _Linked(Section):
    """Several keys that take the same values together, and further keys that go with a value."""

    keys: tuple[str, ...] = Field(
        min_length=1, description="keys of the configuration, such as noise.servo_px"
    )
    values: tuple[Plain, ...] = Field(min_length=1, description="values that all of them take in turn")
    also: dict[str, dict[str, Plain]] = Field({}, description="values of other keys that go with a value")

    def contradictions(self) -> Iterator[Finding]:
        """Keys that go with nothing."""
        for value in self.also.keys() - {*map(str, self.values)}:
            yield ("also", value), "is none of the values"


def _axis(value: Any) -> Any:
    """Values are those of the key of the name of the axis; a mapping tells what goes with each."""
    if isinstance(value, dict) and not {*_Linked.model_fields} & {*value}:
        return {"keys": [""], "values": list(value), "also": value}
    return {"keys": [""], "values": value} if isinstance(value, list) else value


_Values = Annotated[tuple[Plain, ...], Field(min_length=1)]
_Given = _Linked | _Values | dict[str, dict[str, Plain]]
_Axis = Annotated[_Linked, BeforeValidator(_axis, json_schema_input_type=_Given)]
_Bases = Annotated[tuple[str, ...], Field(min_length=1)]


class Distribution(Section):
    """What a value is drawn from: exactly one of the four."""

    uniform: tuple[Number, Number] | None = Field(None, description="least and largest value")
    log_uniform: tuple[Positive, Positive] | None = Field(
        None, description="least and largest value, of which the logarithm is uniform"
    )
    normal: tuple[Number, Positive] | None = Field(None, description="mean and standard deviation")
    choice: tuple[Plain, ...] | None = Field(None, min_length=1, description="values of equal chances")

    def contradictions(self) -> Iterator[Finding]:
        """None of the four or several, or bounds upside down."""
        given = [(name, value) for name, value in self if value is not None]
        if len(given) != 1:
            yield (), "give exactly one of uniform, log_uniform, normal and choice"
        for name, value in given:
            if name in ("uniform", "log_uniform") and not value[0] < value[1]:
                yield (), f"{name} needs a least value below the largest"


class _Tasks(Section):
    """Reaching tasks instead of that of the base."""

    random: Count = Field(description="number of random tasks, which the runs of a cell take in turn")


class SweepConfig(Root):
    """Closed-loop runs over a grid of values, each drawn by its number alone.

    A cell is one combination of the values of the grid. Run r of a cell has the same task, noise and
    drawn values as run r of every other cell, so that laws are compared on equal terms.
    """

    name: FolderName = Field(description="of the sweep and its folder; by default that of the file")
    seed: Whole = Field(0, description="of all that is drawn: tasks, noise, calibrations and random values")
    base: Annotated[_Bases, BeforeValidator(one_or_more, json_schema_input_type=_Bases | str)] = Field(
        description="configurations (YAML) beside this file; several are an axis of the grid"
    )
    set: dict[str, Plain] = Field({}, description="values that every run takes instead of those of the base")
    runs: Annotated[int, Field(ge=1, le=100_000_000, strict=True)] = Field(
        100, description="runs of each cell"
    )
    grid: dict[str, _Axis] = Field(
        {},
        description="values of each key, or of each value what goes with it; law is short for control.laws",
    )
    random: dict[str, Distribution] = Field(
        {}, description="what the value of a key is drawn from, for each run; for each calibration where "
        "that depends on the key"
    )  # fmt: skip
    tasks: _Tasks | None = Field(None, description="null for the task of the base")
    calibrations: Count = Field(1, description="calibrations of a cell; run r is made with number r mod this")
    traces: tuple[Whole, ...] = Field((), description="numbers of the runs whose whole traces are kept")
    between_samples: Annotated[bool, Field(strict=True)] = Field(
        False, description="whether the deviation of the path is measured between samples too, which is slow"
    )
    chunk: Count | None = Field(None, description="runs made and stored at a time; null for about a second's")

    def between(self, sound: Mapping[str, Any]) -> Iterator[Finding]:
        """Names and values that stand twice."""
        if len(names := {pathlib.Path(base).stem for base in self.base}) < len(self.base):
            yield ("base",), f"two files of one name, {', '.join(sorted(names))}: rename one"
        for name, axis in self.grid.items():
            if name == BASE:
                yield ("grid", BASE), "several configurations are listed under base"
            if axis.keys == ("",) and name in self.random:
                yield ("random", name), "stands in the grid as well; keep one"
            if len({json.dumps(value) for value in axis.values}) < len(axis.values):
                yield ("grid", name), "a value stands there twice"

    def keys_of(self, name: str) -> tuple[str, ...]:
        """Keys of the configuration that an axis of the grid sets."""
        keys = self.grid[name].keys
        return (name,) if keys == ("",) else keys
