"""Run number i of a sweep as an ordinary configuration."""

import json
import math
from collections.abc import ItemsView, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import chain, product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from projservo_cli.config import Config, Override, load_config, overridden, to_yaml
from projservo_cli.config.inputs import calibration_inputs
from projservo_cli.config.settings_and_rules import truth_of
from projservo_cli.config.sweep import BASE, LAW, Distribution, SweepConfig
from projservo_cli.laws import law_and_mode, run_names
from projservo_cli.records import InputError, IntArray
from projservo_cli.result_hashes import digest, key_of, source_hash
from projservo_cli.settings.sections import JointVector
from projservo_cli.settings.task import Goal, TaskSettings
from projservo_cli.simulation.random_tasks import random_tasks
from projservo_cli.store.sweep_table import values_in


def _changed(config: Config, values: Mapping[str, Any], what: str) -> Config:
    """A configuration with other values, or an InputError with their origin."""
    return overridden(config, [_override(what, key, value) for key, value in values.items()])


def _override(what: str, key: str, value: Any) -> Override:
    """Return a value as an override, with its origin for messages."""
    return Override(f"{what}: {key}={json.dumps(value)}", key, value)


# Streams of the sweep's seed.
RUNS, _CALIBRATIONS, _TASKS, _VALUES, _CALIBRATION_VALUES, PROBES = range(6)
_PROBES = 4  # values that show whether a calibration depends on them


def _sample(distribution: Distribution, rng: np.random.Generator) -> Any:
    """One value; as many random numbers for any distribution."""
    uniform, normal = rng.random(), rng.standard_normal()
    match distribution:
        case Distribution(uniform=(low, high)):
            return low + (high - low) * uniform
        case Distribution(log_uniform=(low, high)):
            return math.exp(math.log(low) + (math.log(high) - math.log(low)) * uniform)
        case Distribution(normal=(mean, deviation)):
            return mean + deviation * normal
    values = distribution.choice or ()
    return values[int(uniform * len(values))]


class _Axis(NamedTuple):
    """One dimension of the grid: its name, the keys it sets, its values, and further keys of some of them."""

    name: str
    keys: tuple[str, ...]
    values: tuple[Any, ...]
    also: Mapping[str, Mapping[str, Any]] = {}

    def changes(self, value: Any) -> Iterator[Override]:
        """Yield the overrides of one of the values; a law sets its mode too if its name has one."""
        what = f"grid.{self.name}"
        for key in self.keys:
            change = _override(what, key, value)
            if key == LAW:
                law, mode = law_and_mode(value)
                yield replace(change, key="control.laws", value=[law])
                if law != value:
                    yield replace(change, key="control.mode", value=[mode])
            else:
                yield change
        for key, other in self.also.get(str(value), {}).items():
            yield _override(what, key, other)


class _RunIndex(NamedTuple):
    """Places of runs, arrays (k,): their cells, their numbers in them, and the numbers of shared draws."""

    run: IntArray
    cell: IntArray
    draw: IntArray
    calibration: IntArray
    task: IntArray  # −1 for the task of the base


@dataclass(frozen=True, eq=False)
class Design:
    """A sweep with its bases at hand, so that it needs no file."""

    sweep: SweepConfig  # its configuration
    bases: tuple[tuple[str, str], ...]  # name and resolved YAML of each base

    @classmethod
    def made_of(cls, recipe: Mapping[str, Any]) -> "Design":
        """The design that a recipe is of."""
        bases = tuple((str(name), str(text)) for name, text in recipe["bases"])
        return cls(SweepConfig.model_validate(recipe["sweep"]), bases)

    @cached_property
    def axes(self) -> tuple[_Axis, ...]:
        """Dimensions of the grid, the last one running fastest; there is always one of laws."""
        found = [_Axis(BASE, (), tuple(name for name, _ in self.bases))] if len(self.bases) > 1 else []
        for name, axis in self.sweep.grid.items():
            found.append(_Axis(name, self.sweep.keys_of(name), axis.values, axis.also))
        if all(LAW not in axis.keys for axis in found):
            control = load_config("base", text=self.bases[0][1]).control
            found.append(_Axis(LAW, (LAW,), run_names(control.laws, control.mode)))
        return tuple(found)

    @cached_property
    def cells(self) -> int:
        """Number of cells."""
        return math.prod(len(axis.values) for axis in self.axes)

    @property
    def total(self) -> int:
        """Number of runs."""
        return self.cells * self.sweep.runs

    @cached_property
    def recipe(self) -> dict[str, Any]:
        """All there is, as JSON values; ``made_of`` makes the design of it."""
        return {"sweep": self.sweep.model_dump(mode="json"), "bases": [list(base) for base in self.bases]}

    @cached_property
    def key(self) -> str:
        """Hash of all the results depend on; where files lie and how runs are grouped is not in it."""
        left_out = {"name", "base", "chunk"}
        values = {name: value for name, value in self.recipe["sweep"].items() if name not in left_out}
        text = json.dumps([values, self.recipe["bases"]], sort_keys=True)
        return digest(text.encode())

    @cached_property
    def sources(self) -> dict[str, str]:
        """Hashes of the sources of the user's laws, by ``module:Class``; empty if one is gone."""
        names = {value for axis in self.axes if LAW in axis.keys for value in axis.values}
        names |= {changed[LAW] for axis in self.axes for changed in axis.also.values() if LAW in changed}
        own = {law_and_mode(str(name))[0] for name in names if ":" in str(name)}
        return {law: source_hash(law) for law in sorted(own)}

    def numbers(self, run: int) -> tuple[int, int, int, int]:
        """Cell of a run, and the numbers of its draw, calibration and task; an InputError without one."""
        if not 0 <= run < self.total:
            raise InputError(f"run {run}: the sweep {self.sweep.name} has runs 0 to {self.total - 1}")
        _, cell, draw, calibration, task = (int(of_run[0]) for of_run in self.placed(np.array([run])))
        return cell, draw, calibration, task

    def placed(self, runs: IntArray) -> _RunIndex:
        """Return the places of runs (k,)."""
        cell, draw = np.divmod(runs, self.sweep.runs)
        tasks = self.sweep.tasks
        task = draw % tasks.count if tasks else np.full_like(draw, -1)
        return _RunIndex(runs, cell, draw, draw % self.sweep.calibrations, task)

    def values(self, cell: int) -> dict[str, Any]:
        """Value of each axis in a cell."""
        return values_in(cell, [(axis.name, axis.values) for axis in self.axes])

    def base_of(self, cell: int) -> int:
        """Which base a cell is made from."""
        return cell // (self.cells // len(self.bases))

    def cells_of(self, base: int) -> range:
        """Cells that are made from a base."""
        count = self.cells // len(self.bases)
        return range(base * count, (base + 1) * count)

    @lru_cache(maxsize=1024)  # noqa: B019 - a process has one design
    def cell(self, cell: int) -> Config:
        """Configuration of a cell before anything is drawn."""
        name, text = self.bases[self.base_of(cell)]
        values = self.values(cell)
        changes = [change for axis in self.axes for change in axis.changes(values[axis.name])]
        config = load_config(name, changes, text=text)
        if config.recorded or None in (config.arm, config.rig, config.markers, config.task):
            raise InputError(f"base {name}: a sweep needs a simulated robot with a task, and no data")
        if config.plant.use is not None:
            raise InputError(f"base {name}: a sweep drives the simulated robot; leave plant.use out")
        name_of_run(config)
        _, start = _motion_of(f"base {name}", config)
        control = config.control.model_copy(update={"must_converge": ()})
        reference = config.calibration.reference or start
        calibration = config.calibration.model_copy(update={"reference": reference})
        update = {"name": self.sweep.name, "control": control, "calibration": calibration}
        return config.model_copy(update=update)

    @lru_cache(maxsize=4096)  # noqa: B019 - a process has one design
    def calibrated(self, cell: int, calibration: int) -> Config:
        """Return the configuration of a cell with the seed and the draws of a calibration."""
        config = self.cell(cell)
        if drawn := self._drawn(_CALIBRATION_VALUES, calibration):
            config = _changed(config, drawn, f"calibration {calibration}")
        seed = self.seed(_CALIBRATIONS, calibration)
        update = {"calibration": config.calibration.model_copy(update={"seed": seed})}
        return config.model_copy(update=update)

    @lru_cache(maxsize=4096)  # noqa: B019 - a process has one design
    def calibration_key(self, cell: int, calibration: int) -> str:
        """Hash of all a calibration depends on; cells that share it share the calibration."""
        return key_of(calibration_inputs(self.calibrated(cell, calibration)))

    def _cells_numbers(self) -> Iterator[tuple[int, int]]:
        """Each cell with the number of each of its calibrations."""
        return product(range(self.cells), range(min(self.sweep.calibrations, self.sweep.runs)))

    def calibrations(self) -> ItemsView[str, Config]:
        """Key of each calibration that is needed, each once, and a configuration that needs it."""
        needed: dict[str, Config] = {}
        for place in self._cells_numbers():
            needed.setdefault(self.calibration_key(*place), self.calibrated(*place))
        return needed.items()

    def with_covariance(self) -> set[str]:
        """Keys of the calibrations of which a run needs the covariance, each 0.1 MB."""
        return {
            self.calibration_key(cell, number)
            for cell, number in self._cells_numbers()
            if self.cell(cell).trajectory.needs_covariance
        }

    @cached_property
    def view(self) -> tuple[str, ...]:
        """Names of the views of all cells."""
        keys = [key for axis in self.axes for key in (*axis.keys, *chain(*axis.also.values()))]
        step = 1 if any(key.startswith("rig") for key in keys) else len(self.cells_of(0))
        rigs = [self.cell(cell).rig for cell in range(0, self.cells, step)]
        return tuple(dict.fromkeys(name for rig in rigs if rig is not None for name in rig.cameras))

    @lru_cache(maxsize=64)  # noqa: B019 - a process has one design
    def random_ends(self, base: int) -> list[tuple[JointVector, ...]]:
        """Joints at start and goal of the random tasks of a base, one of each stratum in turn."""
        tasks = self.sweep.tasks
        if tasks is None or tasks.random is None:
            return []
        config = self.cell(self.cells_of(base)[0])
        _, start = _motion_of(f"base {base}", config)
        q_front = np.array(start.values(config.joint_types or ""))
        rng = np.random.default_rng(self._stream(_TASKS))
        min_views = config.trajectory.min_views or 0
        low, high = np.radians(tasks.rotation_deg)
        ends = random_tasks(truth_of(config), q_front, tasks.random, rng, min_views, (low, high))
        joints = ([JointVector(joints=tuple(q), unit="rad") for q in end.tolist()] for end in ends)
        return list(zip(*joints, strict=True))

    @lru_cache(maxsize=1024)  # noqa: B019 - a process has one design
    def listed(self, base: int, number: int) -> TaskSettings:
        """Return a listed task, with missing keys from the task of a base."""
        config, where = self.cell(self.cells_of(base)[0]), f"tasks.listed[{number}]"
        task, _ = _motion_of(where, config)
        given = task.model_dump(mode="json", exclude_defaults=True) | self.sweep.listed_tasks[number]
        change = Override(where, "task", given)
        found, _ = _motion_of(where, overridden(config, [change]))
        return found

    def config(self, run: int) -> Config:
        """Configuration of a run."""
        cell, draw, calibration, task = self.numbers(run)
        config = self.calibrated(cell, calibration)
        if drawn := self._drawn(_VALUES, draw):
            config = _changed(config, drawn, f"run {run}")
        update: dict[str, Any] = {"seed": self.seed(RUNS, draw)}
        if task >= 0:
            update["task"] = self._task(config, self.base_of(cell), task)
        return config.model_copy(update=update)

    def _task(self, config: Config, base: int, number: int) -> TaskSettings:
        """Return a task of a base, random or listed, in the configuration of a run."""
        if self.sweep.listed_tasks:
            return self.listed(base, number)
        task, _ = _motion_of(f"base {base}", config)
        start, goal = self.random_ends(base)[number]
        return TaskSettings(start=start, start_offset=task.start_offset, goal=Goal(joints=goal))

    def drawn(self, run: int) -> dict[str, Any]:
        """Values drawn for a run and for its calibration, in the order of ``random``."""
        _, draw, calibration, _ = self.numbers(run)
        found = self._drawn(_VALUES, draw) | self._drawn(_CALIBRATION_VALUES, calibration)
        return {key: found[key] for key in self.sweep.random}

    def _stream(self, *place: int) -> np.random.SeedSequence:
        """Return the source of the random numbers of a stream, or of one of its draws."""
        return np.random.SeedSequence(self.sweep.seed, spawn_key=place)

    def seed(self, stream: int, number: int) -> int:
        """Seed of one of many draws."""
        return int(self._stream(stream, number).generate_state(1, np.uint64)[0] >> 1)

    @cached_property
    def _of_calibrations(self) -> set[str]:
        """Return the random keys that a calibration depends on, by probing values."""
        rng = np.random.default_rng(self._stream(PROBES))
        probes = [{key: _sample(one, rng) for key, one in self.sweep.random.items()} for _ in range(_PROBES)]
        found = set()
        for key, cell, probe in product(self.sweep.random, range(self.cells), probes[1:]):
            if key not in found:
                cases = (probes[0], probes[0] | {key: probe[key]})
                with suppress(InputError):  # an invalid value is reported at its draw
                    configs = [_changed(self.cell(cell), values, "random") for values in cases]
                    first, second = (key_of(calibration_inputs(config)) for config in configs)
                    found |= {key} if first != second else set()
        return found

    def _drawn(self, stream: int, number: int) -> dict[str, Any]:
        """Values of the keys that a stream is for: whether the calibration depends on them."""
        of_calibration = stream == _CALIBRATION_VALUES
        keys = [key for key in self.sweep.random if (key in self._of_calibrations) is of_calibration]
        if not keys:
            return {}
        rng = np.random.default_rng(self._stream(stream, number))
        return {key: _sample(self.sweep.random[key], rng) for key in keys}


def read_design(sweep: SweepConfig) -> Design:
    """Read the bases of a sweep and check every cell, before any run is made."""
    changes = [_override("set", key, value) for key, value in sweep.set.items()]
    bases = tuple((Path(base).stem, to_yaml(load_config(base, changes))) for base in sweep.base)
    design = Design(sweep, bases)
    require_sound(design)
    return design


def require_sound(design: Design) -> None:
    """Refuse a sweep of which a cell or a value that is drawn makes no configuration, with an InputError."""
    sweep = design.sweep
    for run in (number for number in sweep.traces if number >= design.total):
        raise InputError(f"traces: there is no run {run}; the sweep has runs 0 to {design.total - 1}")
    for cell in range(design.cells):
        design.cell(cell)
    for base, number in product(range(len(design.bases)), range(len(sweep.listed_tasks))):
        design.listed(base, number)
    for draw in range(min(3, sweep.runs) if sweep.random else 0):
        _changed(design.cell(0), design.drawn(draw), f"run {draw}")


def _motion_of(where: str, config: Config) -> tuple[TaskSettings, JointVector]:
    """Return the task of a configuration and the joints at its start.

    Raises InputError for a task that is no single motion from given joints.
    """
    task = config.task
    if task is None or task.steps or task.start_joints is None:
        raise InputError(
            f"{where}: a run of a sweep is one motion from given joints: set task.start, and leave "
            "task.steps out; the motions of a sequence may be listed one by one in tasks.listed"
        )
    return task, task.start_joints


def name_of_run(config: Config) -> str:
    """Name of the only run of a configuration: its law, with the mode if it follows the plan."""
    names = run_names(config.control.laws, config.control.mode)
    if len(names) != 1:
        raise InputError(
            f"a cell runs one law in one mode, not {', '.join(names)}: list them under grid.law, such as "
            "law: [exact, exact_track]"
        )
    return names[0]
