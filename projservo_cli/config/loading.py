"""From YAML text and overrides to a checked configuration, or to all that is wrong with it; and back.

YAML is read safely, each key and value with its line. Numbers and booleans follow the YAML 1.2
core schema: ``1e-3`` is a number, ``on`` and ``12:30`` are text. Duplicate keys are refused; aliases, nesting
and size are bounded.
"""

import difflib
import json
import math
import pathlib
import re
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, TypeVar

import numpy.typing as npt
import yaml
from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from projservo_cli.config.settings_and_rules import Settings, truth_of
from projservo_cli.config.sweep import SweepConfig
from projservo_cli.passwords import masked
from projservo_cli.records import FloatArray, InputError
from projservo_cli.settings.plant import RENDERED, RenderedOptions
from projservo_cli.settings.sections import CONTRADICTIONS, Note, Section
from projservo_cli.settings.task import CURRENT
from projservo_cli.simulation.from_settings import arm_of
from projservo_cli.simulation.mjcf import read_mjcf
from projservo_cli.simulation.urdf import read_urdf
from projservo_cli.store.display import checked_array, plain, require_radians
from projservo_cli.store.files_and_locks import bytes_of, text_of

try:  # for a text of the largest size, libyaml makes nodes in half a second, PyYAML itself in five
    from yaml import CSafeDumper as _Emitter
    from yaml import CSafeLoader as _Parser
except ImportError:  # either will do
    from yaml import SafeDumper as _Emitter  # type: ignore[assignment]
    from yaml import SafeLoader as _Parser  # type: ignore[assignment]

_PHRASES = {
    "missing": "is missing",
    "finite_number": "must be a finite number",
    "float_type": "must be a number",
    "int_type": "must be a whole number",
    "bool_type": "must be true or false",
    "bool_parsing": "must be true or false",
    "string_type": "must be text; put it in quotes",
    "string_unicode": "must be UTF-8 (rename the file or its folder)",
    "model_type": "must be a mapping of keys to values",
    "dict_type": "must be a mapping of keys to values",
    "tuple_type": "must be a list",
    "greater_than": "must be greater than {gt:g}",
    "greater_than_equal": "must be at least {ge:g}",
    "less_than": "must be less than {lt:g}",
    "less_than_equal": "must be at most {le:g}",
    "too_short": "needs {min_length} or more entries, it has {actual_length}",
    "too_long": "takes at most {max_length} entries",
    "string_too_short": "needs {min_length} or more characters",
    "string_too_long": "takes at most {max_length} characters",
    "value_error": "{error}",
}

# Parts of a position that pydantic adds for each kind that a value may be of.
_KIND = re.compile(r"constrained-\w+|float|(literal|tuple)\[.*")

# Values that name files, relative to the configuration.
_FILES = (
    *(("data", "table"), ("data", "readings")),
    *(("calibration", "init"), ("robot", "mjcf"), ("robot", "urdf")),
)
_YAML = (".yaml", ".yml")
_DIGITS = 9  # digits of a position in a list
_MOST = 200  # problems that are looked at; who has more has taken another file
_Path = tuple[str | int, ...]

_MAX_BYTES = 1_000_000
_MAX_VALUES = 50_000  # aliases counted as often as they are used
_MAX_DEPTH = 32
_MOST_LINES = 50  # of error messages
_EXPECTED = "a configuration (YAML), which projservo init writes"
_STANDARD = "tag:yaml.org,2002:"
_Model = TypeVar("_Model", bound=Section)


def _shortened(text: str, max_length: int = 80) -> str:
    """A text for a message, cut if it is long."""
    return text if len(text) <= max_length else text[: max_length - 1] + "…"


class _Loader(_Parser):
    """Leaves plain text as it is."""


_Loader.yaml_implicit_resolvers = {}

# Plain text with another meaning in YAML, and that meaning.
_CORE: tuple[tuple[re.Pattern[str], Callable[[str], Any]], ...] = (
    (re.compile(r"~|null|Null|NULL|"), lambda text: None),
    (re.compile(r"true|True|TRUE|false|False|FALSE"), lambda text: text.lower() == "true"),
    (re.compile(r"[-+]?[0-9]+"), int),
    (re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?"), float),
    (re.compile(r"[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)"), lambda text: float(text.replace(".", ""))),
)


class _Document:
    """A parsed YAML text: plain values, their places, and the errors of the text."""

    def __init__(self, text: str, name: str) -> None:
        self.name = name
        self.positions: dict[_Path, str] = {}
        self.problems: list[tuple[_Path, str, str]] = []  # path, error, place if no path leads to it
        self.values: Any = None
        self._count = 0
        try:
            if any("\ud800" <= character <= "\udfff" for character in text):
                raise _UnfitError("not UTF-8 text")
            _require_bounded(text)
            root = _Loader(text).get_single_node()
            self.values = None if root is None else self._value(root, ())
        except _UnfitError as error:
            self.wrong((), str(error), name)
        except yaml.MarkedYAMLError as error:
            mark = error.problem_mark or error.context_mark
            place = self._place(mark) if mark else name
            self.wrong((), f"not valid YAML: {error.problem or error.context}", place)
        except yaml.YAMLError as error:
            self.wrong((), f"not valid YAML: {' '.join(str(error).split())}", name)

    def wrong(self, path: _Path, what: str, place: str = "") -> None:
        """Note an error at ``path``, or at a place that no path leads to."""
        self.problems.append((path, what, place))

    @classmethod
    def read(cls, path: pathlib.Path | str, expected: str = _EXPECTED) -> "_Document":
        """The document in a file; an InputError where there is none."""
        return cls(text_of(path, expected, _MAX_BYTES), str(path))

    @classmethod
    def of(cls, values: Any, name: str) -> "_Document":
        """The document of values at hand, which messages call by a name."""
        document = cls("", name)
        document.values = plain(values)
        return document

    def _place(self, mark: yaml.Mark) -> str:
        return f"{self.name}:{mark.line + 1}:{mark.column + 1}"

    def _value(self, node: yaml.Node, path: _Path) -> Any:
        self._count += 1
        if self._count > _MAX_VALUES:
            raise _UnfitError(f"more than {_MAX_VALUES} values, aliases expanded")
        if len(path) > _MAX_DEPTH:
            raise _UnfitError(f"nested more than {_MAX_DEPTH} levels deep, or an alias holds itself")
        self.positions.setdefault(path, self._place(node.start_mark))
        if node.tag not in {_STANDARD + kind for kind in ("map", "seq", "str")}:
            tag = _shortened(node.tag.replace(_STANDARD, "!!"))
            self.wrong(path, f"the tag {tag} is not allowed; plain values only", self._place(node.start_mark))
            return None
        if isinstance(node, yaml.MappingNode):
            return self._mapping(node, path)
        if isinstance(node, yaml.SequenceNode):
            return [self._value(item, (*path, i)) for i, item in enumerate(node.value)]
        if getattr(node, "style", None):  # the text is in quotes, or a block
            return node.value
        meaning = next((meaning for pattern, meaning in _CORE if pattern.fullmatch(node.value)), str)
        try:
            return meaning(node.value)
        except ValueError:  # it has more digits than Python converts
            self.wrong(path, "cannot be read as a number", self._place(node.start_mark))
            return None

    def _mapping(self, node: yaml.MappingNode, path: _Path) -> dict[str, Any]:
        values: dict[str, Any] = {}
        for key_node, value_node in node.value:
            place = self._place(key_node.start_mark)
            key = key_node.value
            if not isinstance(key_node, yaml.ScalarNode):
                self.wrong(path, "a key must be plain text", place)
            elif key in values:
                first = self.positions[(*path, key)].removeprefix(f"{self.name}:")
                self.wrong(
                    (*path, key), f"the key stands here a second time (first at {first}); keep one", place
                )
            else:
                self.positions[(*path, key)] = place
                values[key] = self._value(value_node, (*path, key))
        return values

    def override(self, change: "Override") -> None:
        """Set a value that comes from elsewhere, creating the mappings above it."""
        path, value, flag = change.path, change.value, change.flag
        holder: Any = self.values
        for i, step in enumerate(path):
            here = path[: i + 1]
            key = str(step) if isinstance(holder, dict) else step
            if isinstance(holder, list):
                if not isinstance(step, int) or step >= len(holder):
                    what = f"expected a list position from 0 to {len(holder) - 1}"
                    return self.wrong(here, what, flag)
            elif not isinstance(holder, dict):
                what = "there is a plain value where a section is expected"
                return self.wrong(here, what, flag)
            if here == path or (isinstance(holder, dict) and holder.get(key) is None):
                holder[key] = value if here == path else {}
                positions = {known: at for known, at in self.positions.items() if known[: len(here)] != here}
                self.positions = {**positions, here: flag}
            holder = holder[key]
        return None

    def place(self, path: _Path) -> str:
        """Return the place of ``path``, or of the nearest mapping or list around it."""
        while path and path not in self.positions:
            path = path[:-1]
        return self.positions.get(path, self.name)

    def refused(self) -> InputError:
        """One line a problem, flags last, otherwise in the order of the file; of very many the first."""
        listed = []
        for path, what, source in self.problems:
            place = source or self.place(path)
            parts = (place, _shortened(".".join(map(str, path)), 200), _shortened(what, 1000))
            listed.append((_position(place), ": ".join(part for part in parts if part)))
        different = list(dict.fromkeys(line for _, line in sorted(listed, key=lambda item: item[0])))
        left = len(different) - _MOST_LINES
        more = [f"{self.name}: and {left} more"] if left > 0 else []
        return InputError("\n".join(different[:_MOST_LINES] + more))


def _position(place: str) -> tuple[float, float]:
    numbers = re.search(r":(\d+):(\d+)$", place)
    return (float(numbers[1]), float(numbers[2])) if numbers else (math.inf, math.inf)


def _require_bounded(text: str) -> None:
    """Refuse deep nesting before nodes are made, which recurses in C."""
    depth = 0
    for event in yaml.parse(text, Loader=_Loader):
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > _MAX_DEPTH:
            raise _UnfitError(f"nested more than {_MAX_DEPTH} levels deep")


class _UnfitError(ValueError):
    """The text cannot be a configuration."""


@dataclass(frozen=True)
class Override:
    """A value given on the command line."""

    flag: str  # how the user wrote it
    key: str  # such as control.gain_t
    value: Any

    @property
    def path(self) -> _Path:
        """Steps to the value; list positions are numbers."""
        steps = enumerate(self.key.split("."))
        return tuple(int(step) if step.isdecimal() and i else step for i, step in steps)

    @classmethod
    def parse(cls, setting: str) -> "Override":
        """Read ``a.b=v`` of ``--set``; the value is YAML."""
        flag = f"--set {setting}"
        key, sign, value = setting.partition("=")
        steps = [step.strip() for step in key.split(".")]
        if not sign or not all(steps):
            raise InputError(f"{flag}: expected KEY=VALUE, with a key such as control.gain_t")
        if len(steps) > _MAX_DEPTH or any(step.isdecimal() and len(step) > _DIGITS for step in steps):
            raise InputError(f"{_shortened(flag)}: there is no such key")
        document = _Document(value, flag)
        if document.problems:
            raise InputError(f"{flag}: the value is {document.problems[0][1]}")
        if steps == ["law"]:
            return cls(flag, "control.laws", [document.values])
        return cls(flag, ".".join(steps), document.values)


class Config(Settings):
    """Everything a run depends on.

    ``robot``, ``rig``, ``markers`` and ``task`` may be absent in a recorded run (``data`` set) as
    far as the stages asked for do without them.
    """

    @classmethod
    def load(cls, path: pathlib.Path | str) -> "Config":
        """Read and check a configuration.

        Parameters
        ----------
        path : the YAML file, or the name of a shipped configuration, such as ``ur5``.

        Returns
        -------
        The configuration, with absolute paths.

        Raises
        ------
        InputError
            With a line ``file:line:column: key: message`` for each error.
        """
        return load_config(shipped(path))

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "Config":
        """Return a configuration of values at hand, such as your arm's.

        Parameters
        ----------
        values : by key, as in a YAML file; relative paths start at the working directory.

        Raises
        ------
        InputError
            With a line for each value that does not fit.
        """
        return _configured(_Document.of(values, "values"))

    def __str__(self) -> str:
        """The values that differ from their defaults, as YAML."""
        return plain_yaml(masked(self.model_dump(mode="json", exclude_defaults=True))).rstrip()

    __repr__ = __str__

    def replace(self, values: Mapping[str, Any]) -> "Config":
        """Return the configuration with other values, checked as a whole.

        Parameters
        ----------
        values : by key; nested mappings merge, keys with dots such as ``noise.servo_px`` set their value as
            ``--set`` does: ``task.goal`` the whole goal.

        Raises
        ------
        InputError
            With a line for each value that does not fit, as for ``--set``.
        """
        return overridden(self, _replacements(values))

    def pose(self, q: npt.ArrayLike) -> FloatArray:
        """Return the true pose of the simulated arm's tool in its base frame, before any calibration.

        Parameters
        ----------
        q : (n,) joint readings, rad or m, as in ``config.pose(observations.q[0])``.

        Returns
        -------
        (4, 4) pose, m.

        Raises
        ------
        InputError
            If the configuration describes no arm, or the readings have another shape or look like degrees.
        """
        if self.arm is None:
            raise InputError("pose: the configuration describes no arm: set robot.dh or robot.screws")
        return arm_of(self.arm).pose(self._readings("pose", q))

    def plot(self, q: npt.ArrayLike) -> Any:
        """Draw the simulated arm, its face and the cameras at joints, before any plan.

        Parameters
        ----------
        q : (n,) joint readings, rad or m, as in ``config.plot(observations.q[0])``.

        Raises
        ------
        InputError
            If the configuration lacks arm, rig or markers, or the readings have another shape.
        """
        from projservo_cli.report import figures  # so that those who draw nothing need not import all figures

        return figures.of_scene(truth_of(self), self._readings("plot", q))

    def _readings(self, what: str, q: npt.ArrayLike) -> FloatArray:
        """Joint readings (n,) of a call. Raises InputError for others."""
        types = self.joint_types or ""
        readings = checked_array(f"{what}: q", q, (len(types),), f"({len(types)},), rad or m", finite=True)
        require_radians(f"{what}: q", readings, types)
        return readings


def load_config(
    path: pathlib.Path | str | None,
    overrides: Sequence[str | Override] = (),
    *,
    text: str | None = None,
    teaching: bool = False,
) -> Config:
    """Read and check a configuration; paths in it become absolute.

    path : the YAML file; None for a blank recorded configuration, which overrides fill.
    overrides : ``a.b=v`` as for ``--set``, applied in order.
    text : its content, if it is already at hand; ``path`` then only names it in messages.
    teaching : a goal or a start whose file does not exist yet is still to be taught, and left out.
    Raises InputError, one line ``file:line:column: key: message`` for each error.
    """
    if path is not None and text is None:
        document = _Document.read(path)
    else:
        document = _Document(text or "", str(path or ""))
    return _configured(document, overrides, path, teaching=teaching)


def overridden(config: Config, overrides: Sequence[str | Override]) -> Config:
    """Return a configuration with other values, checked as a whole; raises InputError as ``load_config``."""
    return _configured(_Document.of(_without_unset(config), config.name), overrides)


def _configured(
    document: _Document,
    overrides: Sequence[str | Override] = (),
    path: pathlib.Path | str | None = None,
    *,
    teaching: bool = False,
) -> Config:
    """The configuration of a document, with overrides; paths of files start at the folder of ``path``."""
    changes = [change if isinstance(change, Override) else Override.parse(change) for change in overrides]
    if document.values is None:
        document.values = {}
    if not isinstance(document.values, dict):
        raise InputError(f"{document.place(())}: expected keys and values such as name: paper")
    if path is not None and not document.values and not document.problems:
        document.wrong((), "the configuration is empty; start from one of the shipped ones")
    if "base" in document.values:
        raise InputError(
            f"{path}: configures a sweep and no run: projservo sweep -c {path}, or name its base"
        )
    _spell_out(document.values)
    for change in changes:
        document.override(change)
        _spell_out(document.values)
    _fill_in(document.values, path)
    _fill_in_arm(document)
    _fill_in_taught(document, pathlib.Path(path).parent if path is not None else pathlib.Path(), teaching)
    _check_options(document)
    return _validated(Config, document)


def shipped(name: pathlib.Path | str) -> pathlib.Path:
    """The file of a configuration: a path, or the name of one that is shipped, such as ``ur5``."""
    if not isinstance(name, (str, pathlib.Path)):
        raise InputError(f"a configuration of type {type(name).__name__}: give the path of a file, or a name")
    path, package = pathlib.Path(name), pathlib.Path(__file__).resolve().parent.parent
    if path.suffix or path.parent != pathlib.Path() or path.is_file():
        return path
    folder = package / "configs" if (package / "configs").is_dir() else package.parent / "configs"
    names = sorted(file.stem for file in folder.glob("*.yaml"))
    if str(name) not in names:
        raise InputError(f"{name}: no file, and no shipped configuration; {_nearest(name, names)}")
    return folder / f"{name}.yaml"


def _replacements(values: Mapping[str, Any]) -> list[Override]:
    """Values as overrides: mappings merge, a key with dots sets its value."""
    return [
        Override(_shortened(f"replace: {key}={usual!r}"), key, usual)
        for name, value in ((str(key), value) for key, value in values.items())
        for key, usual in ([(name, plain(value))] if "." in name else _leaves(name, value))
    ]


def _leaves(key: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield the values of mappings in mappings, by keys with dots."""
    if not isinstance(value, Mapping):
        yield key, plain(value)
        return
    for inner, one in value.items():
        yield from _leaves(f"{key}.{inner}", one)


def to_goals(what: str, goals: Sequence[str]) -> list[Override]:
    """Return overrides that messages name ``what``: to goals of some names, one after the other."""
    names = [goal.removesuffix(".yaml") for goal in goals]
    steps = [{"to": name} for name in names] if len(names) > 1 else []
    alone = [] if steps or names == ["goal"] else [Override(what, "task.goal", names[0])]
    return [Override(what, "task.steps", steps), *alone]


def load_sweep(path: pathlib.Path | str, overrides: Sequence[str] = ()) -> SweepConfig:
    """Read and check the configuration of a sweep; ``base`` becomes absolute paths."""
    document = _Document.read(path, "a configuration of a sweep (YAML)")
    if not isinstance(document.values, dict):
        if not document.problems:
            document.wrong((), "expected keys and values such as base: paper.yaml")
        raise document.refused()
    for change in map(Override.parse, overrides):
        document.override(change)
    file = pathlib.Path(path)
    document.values.setdefault("name", file.stem)
    sweep = _validated(SweepConfig, document)
    base = tuple(str((file.parent / name).resolve()) for name in sweep.base)
    return sweep.model_copy(update={"base": base})


def checked_values(what: str, model: type[_Model], values: Mapping[str, Any]) -> _Model:
    """Check values at hand by a section, or a sweep; an InputError with lines ``what: key: message``."""
    return _validated(model, _Document.of(values, what))


def _validated(model: type[_Model], document: _Document) -> _Model:
    """Validated content of a document; an InputError with all of its errors."""
    wrong: list[ErrorDetails] = []
    try:
        if all(path for path, *_ in document.problems):  # a broken text has no other errors
            validated = model.model_validate(document.values)
    except ValidationError as error:
        wrong = error.errors(include_url=False)
    if broken := {part["loc"][0] for part in wrong if part["loc"]}:
        rest = {"name": "-"} | {key: value for key, value in document.values.items() if key not in broken}
        try:
            model.model_validate(rest, context=broken)
        except ValidationError as error:
            more = error.errors(include_url=False)
            wrong = [*(part for part in more if part["type"] == CONTRADICTIONS), *wrong]
    for path, what in _translated(model, wrong):
        document.wrong(path, what)
    if document.problems:
        raise document.refused()
    return validated


def to_yaml(config: Config) -> str:
    """The whole configuration, defaults written out, as YAML that loads to an equal one."""
    return plain_yaml(_without_unset(config))


def stored_yaml(config: Config, names: Mapping[str, str] = MappingProxyType({})) -> str:
    """The configuration as ``to_yaml``, with the passwords of URLs masked: for files and pages.

    names : replacements of texts, such as paths: lines then break alike however long they are.
    """
    return plain_yaml(_renamed(masked(_without_unset(config)), names))


def _renamed(values: Any, names: Mapping[str, str]) -> Any:
    """Plain values with some of their texts replaced."""
    if isinstance(values, dict):
        return {key: _renamed(value, names) for key, value in values.items()}
    if isinstance(values, list):
        return [_renamed(value, names) for value in values]
    return names.get(values, values) if isinstance(values, str) else values


def plain_yaml(values: Any) -> str:
    """Plain values as YAML."""
    return yaml.dump(
        values, Dumper=_Dumper, sort_keys=False, allow_unicode=True, default_flow_style=None, width=100
    )


def _spell_out(values: dict[str, Any]) -> None:
    """Replace ``plant: module:Class`` and ``law: module:Class`` by their keys."""
    if isinstance(values.get("plant"), str):
        values["plant"] = {"use": values["plant"]}
    plant = values.get("plant")
    if isinstance(plant, dict) and plant.get("use") == RENDERED and values.get("markers") is None:
        values["markers"] = {"tags": "roof"}
    control = values.setdefault("control", {}) if isinstance(values.get("law"), str) else None
    if isinstance(control, dict) and "laws" not in control:
        control["laws"] = [values.pop("law")]


def _fill_in(values: dict[str, Any], path: pathlib.Path | str | None) -> None:
    """Fill the name from the file and make the paths of files absolute."""
    base = pathlib.Path(path).parent if path is not None else pathlib.Path()
    for section, key in _FILES:
        part = values.get(section)
        if isinstance(part, dict) and isinstance(part.get(key), str) and part[key]:
            part[key] = str((base / part[key]).resolve())
    calibration = values.get("calibration")
    cameras = calibration.get("intrinsics") if isinstance(calibration, dict) else None
    if isinstance(cameras, dict):
        for name, file in cameras.items():
            cameras[name] = str((base / file).resolve()) if isinstance(file, str) and file else file
    refits = calibration.get("refits") if isinstance(calibration, dict) else None
    for one in list[Any](refits) if isinstance(refits, list) else list[Any]():
        for key in ("table", "readings") if isinstance(one, dict) else ():
            if isinstance(one.get(key), str) and one[key]:
                one[key] = str((base / one[key]).resolve())
    data = values.get("data")
    for file in (data.get("table") if isinstance(data, dict) else None, path):
        if isinstance(file, (str, pathlib.Path)) and str(file):
            values.setdefault("name", pathlib.Path(file).stem)


def _fill_in_arm(document: _Document) -> None:
    """Add the screws of the joints to the name of an MJCF, or replace the name of a URDF by them."""
    robot = document.values.get("robot")
    for kind in ("mjcf", "urdf") if isinstance(robot, dict) else ():
        file, tip = robot.get(kind), robot.get("tip")
        if not (isinstance(file, str) and isinstance(tip, str)) or {"dh", "screws", "limits"} & robot.keys():
            continue
        try:
            if kind == "mjcf":
                robot["screws"] = read_mjcf(file, tip)
            else:
                screws = read_urdf(file, tip, bytes_of(file, "a URDF", _MAX_BYTES))
                rest = {key: value for key, value in robot.items() if key not in ("urdf", "tip")}
                document.values["robot"] = {**rest, "screws": screws}
        except InputError as error:
            raise InputError(f"{document.place(('robot', kind))}: robot.{kind}: {error}") from error


def _fill_in_taught(document: _Document, base: pathlib.Path, teaching: bool) -> None:
    """Replace the names of taught files, relative to the configuration, by their contents.

    While it is being taught, a goal whose file is missing is the start, and without a start there is no task;
    so is one on an object, whose file need not show that.
    A goal that steps name and that is not given is in the file of its name, or is the one called goal; the
    goal of a sequence is by default the last of its steps.
    """
    task = document.values.get("task")
    if not isinstance(task, dict):
        return
    if isinstance(task.get("start"), str) and task["start"] != CURRENT:
        images = _taught(document, ("start",), base, task["start"], teaching)
        if images is None:
            del document.values["task"]
            return
        if not images["images"].get("joints"):
            where = document.place(("task", "start"))
            raise InputError(f"{where}: task.start: {base / task['start']}: has no joints to start from")
        task["start"] = images["images"]["joints"]
    steps = task["steps"] if isinstance(task.get("steps"), list) else list[Any]()
    named = [goal for step in steps if isinstance(step, dict) for goal in _goals_named(step)]
    if named:
        task.setdefault("goals", {})
    goals: dict[str, Any] = task["goals"] if isinstance(task.get("goals"), dict) else {}
    for name in named:
        if name == "goal" and task.get("goal") is not None:
            goals.setdefault("goal", task["goal"])
        if name not in goals and (teaching or (base / f"{name}.yaml").exists()):
            goals[name] = f"{name}.yaml"
    for name in list(goals):
        _fill_in_goal(document, goals, ("goals", name), base, teaching)
    if isinstance(goal := task.get("goal"), str):
        task["goal"] = goals.get(goal, goal if goal.endswith(_YAML) else f"{goal}.yaml")
    elif named and "goal" not in task and named[-1] in goals:
        task["goal"] = goals[named[-1]]
    _fill_in_goal(document, task, ("goal",), base, teaching)


def _goals_named(step: dict[str, Any]) -> list[str]:
    """Return the goal that a step names, if it does."""
    approach = step.get("approach")
    names = step.get("to"), approach.get("to") if isinstance(approach, dict) else None
    return [name for name in names if isinstance(name, str)]


def _fill_in_goal(
    document: _Document, holder: dict[str, Any], path: _Path, base: pathlib.Path, teaching: bool
) -> None:
    """Replace the name of a taught file at a place of the task, which a mapping holds, by its contents."""
    key, further = str(path[-1]), dict[str, Any]()
    if isinstance(holder.get(key), dict) and isinstance(holder[key].get("taught"), str):
        further = {name: value for name, value in holder[key].items() if name != "taught"}
        holder[key] = holder[key]["taught"]
    if isinstance(holder.get(key), str):
        new_object = teaching and document.values.get("objects")  # a file without the object is no goal yet
        taught = None if new_object else _taught(document, path, base, holder[key], teaching)
        start = document.values["task"].get("start")
        still_to_be = {"joints": start} if isinstance(start, dict) else {"roll_deg": 0.0}
        holder[key] = still_to_be if taught is None else {**taught, **further}


def _taught(
    document: _Document, path: _Path, base: pathlib.Path, name: str, teaching: bool
) -> dict[str, Any] | None:
    """Return the contents of a file that ``teach`` wrote, for a place of the task; None if missing."""
    where, file = f"{document.place(('task', *path))}: task.{'.'.join(map(str, path))}", base / name
    if not file.resolve().exists():
        if teaching:
            return None
        of_start = path == ("start",)
        if of_start and difflib.get_close_matches(name, [CURRENT]):
            raise InputError(f"{where}: there is no file {file.resolve()}; {_nearest(name, [CURRENT])}")
        command = f"projservo teach{' --start' * of_start} -c FILE -o {file}"
        raise InputError(
            f"{where}: there is no {file.resolve()} yet: teach it first, before a recording: {command}"
        )
    try:
        taught = _Document.read(file.resolve(), "a file that projservo teach wrote")
    except InputError as error:
        raise InputError(f"{where}: {error}") from error
    images = taught.values.get("images") if isinstance(taught.values, dict) else None
    if taught.problems or not isinstance(images, dict):
        raise InputError(f"{where}: {file.resolve()}: is no file that projservo teach wrote")
    contents: dict[str, Any] = taught.values
    return contents


def _check_options(document: _Document) -> None:
    """Note errors in the options of a built-in plant."""
    plant = document.values.get("plant")
    if not isinstance(plant, dict) or plant.get("use") != RENDERED:
        return
    try:
        RenderedOptions.model_validate(plant.get("options") or {})
    except ValidationError as error:
        for path, what in _translated(RenderedOptions, error.errors(include_url=False)):
            document.wrong(("plant", "options", *path), what)


def _translated(model: type[BaseModel], errors: Sequence[ErrorDetails]) -> Iterator[Note]:
    """Return the findings of pydantic, in words; of a value that may be of several kinds one finding."""
    locations = [
        tuple(part for part in error["loc"] if part != "[key]" and not _is_kind(part)) for error in errors
    ]
    for error, place in list(zip(errors, locations, strict=True))[:_MOST]:
        if error["type"] == CONTRADICTIONS:
            yield from error["ctx"]["found"]
            continue
        inside = any(len(other) > len(place) and other[: len(place)] == place for other in locations)
        of_kind = _is_kind(error["loc"][-1])
        if inside and (of_kind or error["type"] == "too_short"):
            continue  # a list counts only its valid entries, and is of its kind
        kinds = [
            one
            for one, other in zip(errors, locations, strict=True)
            if other == place and _is_kind(one["loc"][-1])
        ]
        if not of_kind or len(kinds) == 1:
            yield place, _phrase(model, error)
        elif error is kinds[0]:
            wanted = " or ".join(map(_wanted, kinds))
            yield place, f"must be {wanted}, not {_displayed(error['input'])}"


def _is_kind(part: int | str) -> bool:
    return isinstance(part, str) and bool(_KIND.fullmatch(part))


def _wanted(error: ErrorDetails) -> str:
    """A value of one kind, in words."""
    words = _words(error)
    return ", ".join(words) if words else _requirement(error).removeprefix("must be ")


def _words(error: ErrorDetails) -> list[str]:
    """The words of which a value must be one; none if it may be any."""
    if error["type"] != "literal_error":
        return []
    return [word.strip("'") for word in error["ctx"]["expected"].replace(" or ", ", ").split(", ")]


def _requirement(error: ErrorDetails) -> str:
    """State the condition that a value violates."""
    phrase = _PHRASES.get(error["type"])
    return error["msg"] if phrase is None else phrase.format(**error.get("ctx", {}))


def _phrase(model: type[BaseModel], error: ErrorDetails) -> str:
    kind, path, given = error["type"], error["loc"], error["input"]
    if kind == "extra_forbidden" or (kind == "model_type" and path and _takes_views(model, path)):
        if path == ("law",):  # else it would have been spelt out
            both = isinstance(given, str)
            return "control.laws is set as well; keep one" if both else "must be the name of one law"
        return f"unknown key; {_nearest(path[-1], sorted(_model_at(model, path[:-1]).model_fields))}"
    if kind == "string_pattern_mismatch":
        return f"{_displayed(given)} must be letters R and P, one per joint"
    if words := _words(error):
        return f"{_displayed(given)} is not one of them; {_nearest(given, words)}"
    plain = isinstance(given, (str, int, float)) or given is None
    return _requirement(error) + (f", not {_displayed(given)}" if plain and kind != "missing" else "")


def _displayed(value: Any) -> str:
    """A value as in YAML, _shortened."""
    return _shortened(json.dumps(value) if value is None or isinstance(value, bool) else repr(value), 40)


def _nearest(word: object, valid: Sequence[str]) -> str:
    """The end of a message: the nearest valid word, or all of them."""
    given = str(word)[:80]
    close = difflib.get_close_matches(given, valid, n=1) or [one for one in valid if one.startswith(given)]
    return f"did you mean {close[0]}?" if close else f"valid: {', '.join(valid)}"


def _takes_views(model: type[BaseModel], path: _Path) -> bool:
    """Whether the last key of a path is taken for the name of a view."""
    above = _model_at(model, path[:-1])
    return above.model_config.get("extra") == "allow" and path[-1] not in above.model_fields


def _model_at(model: type[BaseModel], path: _Path) -> type[BaseModel]:
    """Return the model of the mapping at ``path``."""
    for step in path:
        if step in model.model_fields:  # else a position in a list, or any key of a mapping
            model = next(_models(model.model_fields[str(step)].annotation), model)
        elif isinstance(step, str):
            model = next(_models(model.__annotations__.get("__pydantic_extra__")), model)
    return model


def _models(annotation: Any) -> Iterator[type[BaseModel]]:
    """The model of a value, through optional values, lists and mappings."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for part in typing.get_args(annotation):
        yield from _models(part)


def _without_unset(value: Any) -> Any:
    """Plain values, less those that are absent by default; a null that overrides a default stays."""
    if isinstance(value, BaseModel):
        fields = type(value).model_fields
        return {
            key: _without_unset(inner)
            for key, inner in value
            if inner is not None or (key in fields and fields[key].default is not None)
        }
    if isinstance(value, dict):
        return {key: _without_unset(inner) for key, inner in value.items()}
    return [_without_unset(inner) for inner in value] if isinstance(value, tuple) else value


class _Dumper(_Emitter):
    """Dumps without aliases, so that every value is written where it is read."""

    def ignore_aliases(self, data: Any) -> bool:
        return True
