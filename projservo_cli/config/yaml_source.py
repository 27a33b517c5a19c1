"""YAML read safely, each key and value with the place it stands at.

Numbers and booleans follow the YAML 1.2 core schema: ``1e-3`` is a number, ``on`` and ``12:30`` are
text. Duplicate keys are refused; aliases, nesting and size are bounded.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import yaml

try:  # of a text of the largest size, libyaml makes nodes in half a second, PyYAML itself in five
    from yaml import CSafeLoader as _Parser
except ImportError:
    from yaml import SafeLoader as _Parser  # type: ignore[assignment]  # either will do

Path = tuple[str | int, ...]

MAX_BYTES = 1_000_000
MAX_VALUES = 50_000  # aliases counted as often as they are used
MAX_DEPTH = 32


@dataclass(frozen=True)
class Problem:
    """Something wrong at one place of the configuration.

    ``path`` leads through keys and list positions; ``source`` names a place no path leads to, and
    then wins.
    """

    path: Path
    what: str
    source: str = ""


def shortened(text: str, most: int = 80) -> str:
    """A text for a message, cut where it is long."""
    return text if len(text) <= most else text[: most - 1] + "…"


_STANDARD = "tag:yaml.org,2002:"
_COLLECTIONS = (f"{_STANDARD}map", f"{_STANDARD}seq")


def _boolean(text: str) -> bool:
    return {"true": True, "false": False}[text.lower()]


def _float(text: str) -> float:
    return float(text.lower().replace(".inf", "inf").replace(".nan", "nan"))


# tag: how to convert, what plain text gets the tag, its first characters
_CORE: dict[str, tuple[Callable[[str], Any], str, str]] = {
    "null": (lambda _: None, r"~|null|Null|NULL|", "~nN"),
    "bool": (_boolean, r"true|True|TRUE|false|False|FALSE", "tTfF"),
    "int": (int, r"[-+]?[0-9]+", "-+0123456789"),
    "float": (
        _float,
        r"[-+]?(\.[0-9]+|[0-9]+\.[0-9]*|[0-9]+(?=[eE]))([eE][-+]?[0-9]+)?"
        r"|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
        "-+0123456789.",
    ),
}
_SCALARS: dict[str, Callable[[str], Any]] = {_STANDARD + "str": str}


class _Loader(_Parser):
    """Scalars of the YAML 1.2 core schema."""


_Loader.yaml_implicit_resolvers = {}


for _name, (_convert, _pattern, _first) in _CORE.items():
    _SCALARS[_STANDARD + _name] = _convert
    _Loader.add_implicit_resolver(
        _STANDARD + _name, re.compile(f"(?:{_pattern})$"), [*_first, *([""] if _name == "null" else [])]
    )


class Document:
    """A parsed YAML text: plain values, where each stands, and what was wrong with the text."""

    def __init__(self, text: str, name: str) -> None:
        self.name = name
        self.places: dict[Path, str] = {}
        self.problems: list[Problem] = []
        self.values: Any = None
        self._count = 0
        try:
            self._parse(text)
        except _UnfitError as error:
            self.problems.append(Problem((), str(error), name))

    def _parse(self, text: str) -> None:
        if len(text) > MAX_BYTES:
            raise _UnfitError(f"larger than {MAX_BYTES} bytes; this is no configuration")
        if any("\ud800" <= character <= "\udfff" for character in text):
            raise _UnfitError("not UTF-8 text")
        try:
            _require_bounded(text)
            root = _Loader(text).get_single_node()
        except yaml.MarkedYAMLError as error:
            mark = error.problem_mark or error.context_mark
            place = self._place(mark) if mark else self.name
            self.problems.append(Problem((), f"not valid YAML: {error.problem or error.context}", place))
            return
        except yaml.YAMLError as error:
            what = " ".join(str(error).split())
            self.problems.append(Problem((), f"not valid YAML: {what}", self.name))
            return
        if root is not None:
            self.values = self._value(root, ())

    def _place(self, mark: yaml.Mark) -> str:
        return f"{self.name}:{mark.line + 1}:{mark.column + 1}"

    def _value(self, node: yaml.Node, path: Path) -> Any:
        self._count += 1
        if self._count > MAX_VALUES:
            raise _UnfitError(f"more than {MAX_VALUES} values, aliases expanded")
        if len(path) > MAX_DEPTH:
            raise _UnfitError(f"nested more than {MAX_DEPTH} levels deep, or an alias holds itself")
        self.places.setdefault(path, self._place(node.start_mark))
        if isinstance(node, yaml.CollectionNode) and node.tag not in _COLLECTIONS:
            return self._refused(node, path)
        if isinstance(node, yaml.MappingNode):
            return self._mapping(node, path)
        if isinstance(node, yaml.SequenceNode):
            return [self._value(item, (*path, i)) for i, item in enumerate(node.value)]
        assert isinstance(node, yaml.ScalarNode)
        return self._scalar(node, path)

    def _mapping(self, node: yaml.MappingNode, path: Path) -> dict[str, Any]:
        values: dict[str, Any] = {}
        for key_node, value_node in node.value:
            place = self._place(key_node.start_mark)
            key = key_node.value
            if not isinstance(key_node, yaml.ScalarNode):
                self.problems.append(Problem(path, "a key must be plain text", place))
                continue
            if key in values:
                first = self.places[(*path, key)].removeprefix(f"{self.name}:")
                what = f"the key stands here a second time (first at {first}); keep one"
                self.problems.append(Problem((*path, key), what, place))
                continue
            self.places[(*path, key)] = place
            values[key] = self._value(value_node, (*path, key))
        return values

    def _scalar(self, node: yaml.ScalarNode, path: Path) -> Any:
        convert = _SCALARS.get(node.tag)
        if convert is None:
            return self._refused(node, path)
        try:
            return convert(node.value)
        except (ValueError, KeyError):
            what = f"cannot be read as {node.tag.removeprefix(_STANDARD)}"
            self.problems.append(Problem(path, what, self._place(node.start_mark)))
            return None

    def _refused(self, node: yaml.Node, path: Path) -> None:
        what = f"the tag {shortened(node.tag.replace(_STANDARD, '!!'))} is not allowed; plain values only"
        self.problems.append(Problem(path, what, self._place(node.start_mark)))

    def overridden(self, path: Path, flag: str) -> None:
        """Note that the value at ``path``, and all inside it, now comes from elsewhere."""
        self.places = {known: place for known, place in self.places.items() if known[: len(path)] != path}
        self.places[path] = flag

    def place(self, path: Path) -> str:
        """Where ``path`` stands, or the nearest mapping or list around it."""
        while path and path not in self.places:
            path = path[:-1]
        return self.places.get(path, self.name)


def _require_bounded(text: str) -> None:
    """Refuse what is nested too deep or too long before nodes are made of it, which recurses in C."""
    depth = count = 0
    for event in yaml.parse(text, Loader=_Loader):
        count += isinstance(event, yaml.NodeEvent)
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > MAX_DEPTH:
            raise _UnfitError(f"nested more than {MAX_DEPTH} levels deep")
        if count > 2 * MAX_VALUES:  # keys and values
            raise _UnfitError(f"more than {MAX_VALUES} values")


class _UnfitError(ValueError):
    """The text cannot be that of a configuration."""
