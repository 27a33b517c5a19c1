"""The configuration of a sweep: the runs, their number and values."""

import json
import pathlib
from collections.abc import Iterator, Mapping
from typing import Annotated, Any

from pydantic import BeforeValidator, Field

from projservo_cli.config.settings_and_rules import FolderName
from projservo_cli.settings.control import one_or_more
from projservo_cli.settings.plant import Plain
from projservo_cli.settings.sections import Count, Note, Number, OneOf, Positive, Root, Section, Whole

BASE, LAW = "base", "law"  # names of axes with a special meaning


class _Linked(Section):
    """Several keys that take the same values together, and further keys that go with a value."""

    keys: tuple[str, ...] = Field(min_length=1, description="configuration keys, such as noise.servo_px")
    values: tuple[Plain, ...] = Field(min_length=1, description="values that all keys take in turn")
    also: dict[str, dict[str, Plain]] = Field(
        {}, description="further keys and their values for each of the values"
    )

    def contradictions(self) -> Iterator[Note]:
        """Keys that go with nothing."""
        for value in self.also.keys() - {*map(str, self.values)}:
            yield ("also", value), "is none of the values"


def _axis(value: Any) -> Any:
    """Values belong to the key that names the axis; a mapping adds further keys to each."""
    if isinstance(value, dict) and not {*_Linked.model_fields} & {*value}:
        return {"keys": [""], "values": list(value), "also": value}
    if isinstance(value, list):
        return {"keys": [""], "values": value}
    if not isinstance(value, dict):
        raise ValueError("must be a list of values")
    return value


_Values = Annotated[tuple[Plain, ...], Field(min_length=1)]
_Given = _Linked | _Values | dict[str, dict[str, Plain]]
_Axis = Annotated[_Linked, BeforeValidator(_axis, json_schema_input_type=_Given)]
_Bases = Annotated[tuple[str, ...], Field(min_length=1)]


class Distribution(OneOf):
    """Distribution of a value: exactly one of the four."""

    one_of = ("uniform", "log_uniform", "normal", "choice")
    uniform: tuple[Number, Number] | None = Field(
        None, description="minimum and maximum of a uniform distribution"
    )
    log_uniform: tuple[Positive, Positive] | None = Field(
        None, description="minimum and maximum of a log-uniform distribution"
    )
    normal: tuple[Number, Positive] | None = Field(
        None, description="mean and standard deviation of a normal distribution"
    )
    choice: tuple[Plain, ...] | None = Field(None, min_length=1, description="values of equal probability")

    def of_kind(self) -> Iterator[Note]:
        """Bounds upside down."""
        bounds = self.uniform or self.log_uniform
        if bounds is not None and not bounds[0] < bounds[1]:
            yield (), f"{self.kind} needs a minimum below the maximum"


class _Tasks(OneOf):
    """Tasks instead of the task of the base, which the runs of a cell take in turn."""

    one_of = ("random", "listed")
    random: Count | None = Field(
        None, description="number of random tasks, which the runs of a cell take in turn"
    )
    rotation_deg: tuple[Number, Number] = Field(
        (0.0, 180.0),
        description="minimum and maximum rotation of random tasks, with as many in each sixth of it",
    )
    listed: Annotated[tuple[dict[str, Plain], ...], Field(min_length=1)] | None = Field(
        None,
        description="tasks instead of random ones, each with keys of task that replace keys of the base",
    )

    @property
    def count(self) -> int:
        """Number of tasks."""
        return len(self.listed) if self.listed is not None else self.random or 0

    def contradictions(self) -> Iterator[Note]:
        """Random and listed tasks, or none; rotations that are no range."""
        yield from super().contradictions()
        if not 0.0 <= self.rotation_deg[0] < self.rotation_deg[1] <= 180.0:
            yield ("rotation_deg",), "needs a minimum below the maximum, both within 0 and 180"


class SweepConfig(Root):
    """Closed-loop runs over a grid of values, each drawn by its number alone.

    A cell is one combination of the values of the grid. Run r of a cell has the same task, noise and
    drawn values as run r of every other cell, so that laws are compared on equal terms.
    """

    name: FolderName = Field(description="name of the sweep and of its folder; default: name of the file")
    seed: Whole = Field(0, description="seed of tasks, noise, calibrations and random values")
    base: Annotated[_Bases, BeforeValidator(one_or_more, json_schema_input_type=_Bases | str)] = Field(
        description="configuration files, relative to this file; several are an axis of the grid"
    )
    set: dict[str, Plain] = Field({}, description="values that replace values of the base in every run")
    runs: Annotated[int, Field(ge=1, le=100_000_000, strict=True)] = Field(
        100, description="number of runs of each cell"
    )
    grid: dict[str, _Axis] = Field(
        {},
        description="values of each key, or of each value the keys that change with it; law stands "
        "for control.laws",
    )
    random: dict[str, Distribution] = Field(
        {}, description="distribution of the value of a key, drawn for each run, or for each calibration "
        "that depends on the key",
    )  # fmt: skip
    tasks: _Tasks | None = Field(None, description="random or listed tasks; null: the task of the base")
    calibrations: Count = Field(
        1, description="number of calibrations of a cell; run r uses number r mod this"
    )
    traces: tuple[Whole, ...] = Field((), description="numbers of the runs whose traces are stored")
    between_samples: Annotated[bool, Field(strict=True)] = Field(
        False, description="whether to measure the path deviation between samples too, which is slow"
    )
    chunk: Count | None = Field(
        None, description="number of runs made and stored together; null: about one second of work"
    )

    @property
    def listed_tasks(self) -> tuple[dict[str, Plain], ...]:
        """Tasks as they are listed; none if they are random, or the task of the base."""
        return () if self.tasks is None else self.tasks.listed or ()

    def between(self, sound: Mapping[str, Any]) -> Iterator[Note]:
        """Names and values that occur twice, and axes without effect."""
        if len(names := {pathlib.Path(base).stem for base in self.base}) < len(self.base):
            yield ("base",), f"two files of one name, {', '.join(sorted(names))}: rename one"
        for name, axis in self.grid.items():
            if name == BASE:
                yield ("grid", BASE), "several configurations are listed under base"
            if axis.keys == ("",) and name in self.random:
                yield ("random", name), "is in the grid as well; keep one"
            if len({json.dumps(value) for value in axis.values}) < len(axis.values):
                yield ("grid", name), "a value occurs there twice"
        yield from self._replaced()

    def _replaced(self) -> Iterator[Note]:
        """Yield axes over keys of task that the tasks take the place of."""
        if self.tasks is None:
            return
        kept = () if self.listed_tasks else ("task.start_offset",)
        axes = [(("grid", name), key) for name in self.grid for key in self.keys_of(name)]
        for place, key in [*axes, *((("random", key), key) for key in self.random)]:
            if f"{key}.".startswith("task.") and not key.startswith(kept):
                remedy = "list tasks with it" if not kept else "use tasks.listed"
                yield place, f"{key} has no effect, since tasks take its place: {remedy}, or leave tasks out"

    def keys_of(self, name: str) -> tuple[str, ...]:
        """Keys of the configuration that an axis of the grid sets."""
        keys = self.grid[name].keys
        return (name,) if keys == ("",) else keys
