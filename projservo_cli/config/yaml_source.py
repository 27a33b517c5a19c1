"""YAML read safely, each key and value with the place it stands at.

Numbers and booleans follow the YAML 1.2 core schema: ``1e-3`` is a number, ``on`` and ``12:30`` are
text. Duplicate keys are refused; aliases, nesting and size are bounded.
"""

import math
import pathlib
import re
from collections.abc import Callable
from typing import Any

import yaml

from projservo_cli.files import text_of
from projservo_cli.records import InputError

try:  # of a text of the largest size, libyaml makes nodes in half a second, PyYAML itself in five
    from yaml import CSafeLoader as _Parser
except ImportError:
    from yaml import SafeLoader as _Parser  # type: ignore[assignment]  # either will do

Path = tuple[str | int, ...]

_MAX_BYTES = 1_000_000
_MAX_VALUES = 50_000  # aliases counted as often as they are used
MAX_DEPTH = 32
_MOST_LINES = 50  # that are told of what is wrong
_STANDARD = "tag:yaml.org,2002:"


def shortened(text: str, most: int = 80) -> str:
    """A text for a message, cut where it is long."""
    return text if len(text) <= most else text[: most - 1] + "…"


class _Loader(_Parser):
    """Leaves plain text as it stands."""


_Loader.yaml_implicit_resolvers = {}

# Plain text that means something else, and what it means.
_CORE: tuple[tuple[re.Pattern[str], Callable[[str], Any]], ...] = (
    (re.compile(r"~|null|Null|NULL|"), lambda text: None),
    (re.compile(r"true|True|TRUE|false|False|FALSE"), lambda text: text.lower() == "true"),
    (re.compile(r"[-+]?[0-9]+"), int),
    (re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?"), float),
    (re.compile(r"[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)"), lambda text: float(text.replace(".", ""))),
)


class Document:
    """A parsed YAML text: plain values, where each stands, and what was wrong with the text."""

    def __init__(self, text: str, name: str) -> None:
        self.name = name
        self.places: dict[Path, str] = {}
        self.problems: list[tuple[Path, str, str]] = []  # path, what is wrong, place if no path leads to it
        self.values: Any = None
        self._count = 0
        try:
            self._parse(text)
        except _UnfitError as error:
            self.wrong((), str(error), name)
        except yaml.MarkedYAMLError as error:
            mark = error.problem_mark or error.context_mark
            place = self._place(mark) if mark else name
            self.wrong((), f"not valid YAML: {error.problem or error.context}", place)
        except yaml.YAMLError as error:
            self.wrong((), f"not valid YAML: {' '.join(str(error).split())}", name)

    def wrong(self, path: Path, what: str, place: str = "") -> None:
        """Note something wrong, where ``path`` stands or at a place that no path leads to."""
        self.problems.append((path, what, place))

    @classmethod
    def read(cls, path: pathlib.Path | str) -> "Document":
        """The document in a file; an InputError where there is none."""
        return cls(text_of(path, "a configuration (YAML)", _MAX_BYTES), str(path))

    def _parse(self, text: str) -> None:
        if len(text) > _MAX_BYTES:
            raise _UnfitError(f"larger than {_MAX_BYTES} bytes; this is no configuration")
        if any("\ud800" <= character <= "\udfff" for character in text):
            raise _UnfitError("not UTF-8 text")
        _require_bounded(text)
        root = _Loader(text).get_single_node()
        if root is not None:
            self.values = self._value(root, ())

    def _place(self, mark: yaml.Mark) -> str:
        return f"{self.name}:{mark.line + 1}:{mark.column + 1}"

    def _value(self, node: yaml.Node, path: Path) -> Any:
        self._count += 1
        if self._count > _MAX_VALUES:
            raise _UnfitError(f"more than {_MAX_VALUES} values, aliases expanded")
        if len(path) > MAX_DEPTH:
            raise _UnfitError(f"nested more than {MAX_DEPTH} levels deep, or an alias holds itself")
        self.places.setdefault(path, self._place(node.start_mark))
        if node.tag not in {_STANDARD + kind for kind in ("map", "seq", "str")}:
            tag = shortened(node.tag.replace(_STANDARD, "!!"))
            what = f"the tag {tag} is not allowed; plain values only"
            self.wrong(path, what, self._place(node.start_mark))
            return None
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
                self.wrong(path, "a key must be plain text", place)
            elif key in values:
                first = self.places[(*path, key)].removeprefix(f"{self.name}:")
                what = f"the key stands here a second time (first at {first}); keep one"
                self.wrong((*path, key), what, place)
            else:
                self.places[(*path, key)] = place
                values[key] = self._value(value_node, (*path, key))
        return values

    def _scalar(self, node: yaml.ScalarNode, path: Path) -> Any:
        if node.style:  # in quotes, or a block of text
            return node.value
        meaning = next((meaning for pattern, meaning in _CORE if pattern.fullmatch(node.value)), str)
        try:
            return meaning(node.value)
        except ValueError:  # of more digits than Python converts
            what = "cannot be read as a number"
            self.wrong(path, what, self._place(node.start_mark))
            return None

    def override(self, path: Path, value: Any, flag: str) -> None:
        """Set a value that comes from elsewhere, making the mappings on the way to it."""
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
                inside = [known for known in self.places if known[: len(here)] == here]
                for known in inside:
                    del self.places[known]
                self.places[here] = flag
            holder = holder[key]
        return None

    def place(self, path: Path) -> str:
        """Where ``path`` stands, or the nearest mapping or list around it."""
        while path and path not in self.places:
            path = path[:-1]
        return self.places.get(path, self.name)

    def refused(self) -> InputError:
        """One line a problem, flags last, otherwise in the order of the file; of very many the first."""
        told = []
        for path, what, source in self.problems:
            place = source or self.place(path)
            parts = (place, shortened(".".join(map(str, path)), 200), shortened(what, 1000))
            told.append((_position(place), ": ".join(part for part in parts if part)))
        different = list(dict.fromkeys(line for _, line in sorted(told, key=lambda item: item[0])))
        left = len(different) - _MOST_LINES
        more = [f"{self.name}: and {left} more"] if left > 0 else []
        return InputError("\n".join(different[:_MOST_LINES] + more))


def _position(place: str) -> tuple[float, float]:
    numbers = re.search(r":(\d+):(\d+)$", place)
    return (float(numbers[1]), float(numbers[2])) if numbers else (math.inf, math.inf)


def _require_bounded(text: str) -> None:
    """Refuse what is nested too deep before nodes are made of it, which recurses in C."""
    depth = 0
    for event in yaml.parse(text, Loader=_Loader):
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > MAX_DEPTH:
            raise _UnfitError(f"nested more than {MAX_DEPTH} levels deep")


class _UnfitError(ValueError):
    """The text cannot be that of a configuration."""
