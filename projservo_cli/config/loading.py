"""From YAML text and overrides to a checked configuration, or to all that is wrong with it."""

import difflib
import json
import math
import pathlib
import re
import types
import typing
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace
from typing import Any

from pydantic import BaseModel, ValidationError, create_model
from pydantic_core import ErrorDetails

from projservo_cli.config.models import Config, problems, written_out
from projservo_cli.config.robot import Section
from projservo_cli.config.yaml_source import MAX_BYTES, MAX_DEPTH, Document, Path, Problem, shortened
from projservo_cli.records import InputError

_PHRASES = {
    "missing": "is missing",
    "finite_number": "must be a finite number",
    "float_type": "must be a number",
    "float_parsing": "must be a number",
    "int_type": "must be a whole number",
    "int_from_float": "must be a whole number",
    "int_parsing_size": "is too large",
    "string_type": "must be text; put it in quotes",
    "model_type": "must be a mapping of keys to values",
    "model_attributes_type": "must be a mapping of keys to values",
    "dict_type": "must be a mapping of keys to values",
    "tuple_type": "must be a list",
    "greater_than": "must be greater than {gt:g}",
    "greater_than_equal": "must be at least {ge:g}",
    "less_than": "must be less than {lt:g}",
    "less_than_equal": "must be at most {le:g}",
    "too_short": "needs {min_length} or more entries, it has {actual_length}",
    "too_long": "takes at most {max_length} entries",
    "string_too_short": "must not be empty",
    "string_too_long": "takes at most {max_length} characters",
    "value_error": "{error}",
}


MOST = 200  # problems that are looked at; who has more has taken another file


def nearest(word: object, valid: Sequence[str]) -> str:
    """The end of a message: the nearest valid word, or all of them."""
    close = difflib.get_close_matches(str(word)[:80], valid, n=1, cutoff=0.5)
    return f"did you mean {close[0]}?" if close else f"valid: {', '.join(valid)}"


def translated(model: type[BaseModel], errors: Sequence[ErrorDetails], values: Any) -> Iterator[Problem]:
    """One problem for each wrong value, whatever number of alternatives pydantic tried on it."""
    seen: dict[Path, Problem] = {}
    for error in errors[:MOST]:
        path = _plain(error["loc"], values)
        if path in seen and error["type"] != "literal_error":  # of alternatives, the named ones say most
            continue
        seen[path] = Problem(path, _phrase(model, error, path))
    for path, problem in seen.items():
        inner = any(len(other) > len(path) and other[: len(path)] == path for other in seen)
        if not inner:  # a list counts only its valid entries, so it also calls itself too short
            yield problem


def _plain(location: Path, values: Any) -> Path:
    """The path without the names of alternatives that pydantic puts in it."""
    path: list[str | int] = []
    for step in location:
        holds = (isinstance(values, Mapping) and step in values) or (
            isinstance(values, list) and isinstance(step, int) and step < len(values)
        )
        if holds:
            values = values[step]
        elif not isinstance(values, (Mapping, list)):
            continue
        else:
            values = None
        path.append(step)
    return tuple(path)


def _phrase(model: type[BaseModel], error: ErrorDetails, path: Path) -> str:
    kind, context = error["type"], error.get("ctx", {})
    if kind == "extra_forbidden":
        return f"unknown key; {nearest(path[-1], valid_keys(model, path[:-1]))}"
    if kind == "string_pattern_mismatch":
        return f"{_shown(error['input'])} must be letters R and P, one a joint"
    if kind == "literal_error":
        valid = [option.strip("'") for option in context["expected"].replace(" or ", ", ").split(", ")]
        return f"{_shown(error['input'])} is not one of them; {nearest(error['input'], valid)}"
    phrase = _PHRASES.get(kind, error["msg"]).format(**context)
    return phrase if kind == "missing" else f"{phrase}{_given(error['input'])}"


def _given(value: Any) -> str:
    """What stands there instead, for short values."""
    return f", not {_shown(value)}" if isinstance(value, (str, int, float)) or value is None else ""


def _shown(value: Any) -> str:
    """A value as it would stand in YAML, shortened."""
    return shortened(json.dumps(value) if value is None or isinstance(value, bool) else repr(value), 40)


def valid_keys(model: type[BaseModel], path: Path) -> list[str]:
    """Keys that the mapping at ``path`` may have; none where there is no mapping of known keys."""
    current: Any = model
    for step in path:
        current = _inside(current, step)
    return sorted(current.model_fields) if current is not None else []


def _inside(current: Any, step: str | int) -> Any:
    """The model found under one step of a path, through optional values and lists."""
    if current is None or (isinstance(step, str) and step not in current.model_fields):
        return None
    if isinstance(step, int):
        return current
    return _model(current.model_fields[step].annotation)


def _model(annotation: Any) -> Any:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    if typing.get_origin(annotation) in (tuple, typing.Union, types.UnionType):
        return next((found for found in map(_model, typing.get_args(annotation)) if found), None)
    return None


# Values that name files, relative to the configuration.
FILES = (("data", "table"), ("calibration", "init"))


_DIGITS = 9  # of a position in a list
MOST_LINES = 50  # that are told of what is wrong


@dataclass(frozen=True)
class Override:
    """A value given on the command line; ``flag`` is how the user wrote it."""

    flag: str
    path: Path
    value: Any

    @classmethod
    def parse(cls, text: str, flag: str = "") -> "Override":
        """Read ``a.b=v``; the value is YAML, list positions are numbers.

        Raises
        ------
        InputError
            When there is no ``=``, no key, or the value is not YAML.
        """
        flag = flag or f"--set {text}"
        key, sign, value = text.partition("=")
        steps = [step.strip() for step in key.split(".")]
        if not sign or not all(steps):
            raise InputError(f"{flag}: expected KEY=VALUE, with a key such as control.gain_t")
        if len(steps) > MAX_DEPTH or any(step.isdecimal() and len(step) > _DIGITS for step in steps):
            raise InputError(f"{shortened(flag)}: there is no such key")
        document = Document(value, flag)
        if document.problems:
            raise InputError(f"{flag}: the value is {document.problems[0].what}")
        path = tuple(int(step) if step.isdecimal() and i else step for i, step in enumerate(steps))
        if path == ("law",):
            return cls(flag, ("control", "laws"), [document.values])
        return cls(flag, path, document.values)


def load_config(
    path: pathlib.Path | str | None, overrides: Sequence[str | Override] = (), *, text: str | None = None
) -> Config:
    """Read and check a configuration.

    Parameters
    ----------
    path : Path, str or None
        The YAML file. None for a blank recorded configuration, which overrides fill.
    overrides : sequence of str or Override
        ``a.b=v`` as for ``--set``, applied in order.
    text : str, optional
        Its content, where it is already at hand; ``path`` then only names it in messages.

    Returns
    -------
    Config
        ``data.table`` and ``calibration.init`` are absolute paths, whatever the working directory later.

    Raises
    ------
    InputError
        All that is wrong, one line ``file:line:column: path: what`` each.
    """
    changes = [change if isinstance(change, Override) else Override.parse(change) for change in overrides]
    document = Document("" if path is None else read_text(path) if text is None else text, str(path or ""))
    found = list(document.problems)
    values = document.values
    if values is None:
        values = {}
    if not isinstance(values, dict):
        raise InputError(f"{document.place(())}: expected keys and values such as name: paper")
    if path is not None and not values and not found:
        found.append(Problem((), "the configuration is empty; start from one of the shipped ones"))
    for change in changes:
        written_out(values)
        found += apply_overrides(values, [change], document)
    written_out(values)
    if not any(problem.path == () for problem in found):
        found += _defects(_defaults(values, path))
    if found:
        raise InputError("\n".join(problem_lines(document, found)))
    return Config.model_validate(values)


def read_text(path: pathlib.Path | str) -> str:
    """Text of a configuration; an InputError where there is none."""
    try:
        with pathlib.Path(path).open("rb") as file:
            content = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    if len(content) > MAX_BYTES:
        raise InputError(f"{path}: larger than {MAX_BYTES} bytes; this is no configuration")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not UTF-8 text; expected a YAML configuration") from error


def apply_overrides(values: dict[str, Any], changes: Sequence[Override], document: Document) -> list[Problem]:
    """Set values in place, in order; what could not be set."""
    problems = [_apply(values, change, document) for change in changes]
    return [problem for problem in problems if problem]


def _apply(values: dict[str, Any], change: Override, document: Document) -> Problem | None:
    """Set one value in place, making the mappings on the way to it."""
    holder: Any = values
    for i, step in enumerate(change.path):
        last = i == len(change.path) - 1
        here = change.path[: i + 1]
        if isinstance(holder, list):
            if not isinstance(step, int) or step >= len(holder):
                return Problem(here, f"expected a list position from 0 to {len(holder) - 1}", change.flag)
        elif isinstance(holder, dict):
            step = str(step)
        else:
            return Problem(here, "there is a plain value where a section is expected", change.flag)
        if last:
            holder[step] = change.value
            document.overridden(here, change.flag)
        elif isinstance(holder, dict) and holder.get(step) is None:
            holder[step] = {}
            document.overridden(here, change.flag)
        holder = holder[step]
    return None


def _defaults(values: dict[str, Any], path: pathlib.Path | str | None) -> dict[str, Any]:
    """Fill the name from the file and make the paths of files absolute."""
    base = pathlib.Path(path).parent if path is not None else pathlib.Path()
    for section, key in FILES:
        part = values.get(section)
        if isinstance(part, dict) and isinstance(part.get(key), str) and part[key]:
            part[key] = str((base / part[key]).resolve())
    data = values.get("data")
    table = data.get("table") if isinstance(data, dict) else None
    if isinstance(table, str) and table:
        values.setdefault("name", pathlib.Path(table).stem)
    if path is not None:
        values.setdefault("name", pathlib.Path(path).stem)
    return values


def _defects(values: dict[str, Any]) -> Iterable[Problem]:
    """Check each section by itself, then what must hold between the well-formed ones."""
    found: list[Problem] = []
    good = SimpleNamespace()
    broken = set()
    for name in Config.model_fields:
        section = _alone(name)
        part = {name: values[name]} if name in values else {}
        try:
            setattr(good, name, getattr(section.model_validate(part), name))
        except ValidationError as error:
            broken.add(name)
            found += translated(Config, error.errors(include_url=False), part)
    unknown = [key for key in values if key not in Config.model_fields]
    found += [Problem((key,), _unknown(key, values)) for key in unknown[:MOST]]
    return found + [Problem(path, what) for path, what in problems(good, frozenset(broken))]


def _unknown(key: str, values: dict[str, Any]) -> str:
    if key == "law":  # else it would have been written out
        text = isinstance(values[key], str)
        return "control.laws is set as well; keep one" if text else "must be the name of one law"
    return f"unknown key; {nearest(key, sorted(Config.model_fields))}"


@cache
def _alone(name: str) -> type[Section]:
    """A model of one section by itself."""
    field = Config.model_fields[name]
    definition: dict[str, Any] = {name: (field.annotation, field)}
    return create_model("Part", __base__=Section, **definition)


def problem_lines(document: Document, found: Sequence[Problem]) -> list[str]:
    """One line a problem, flags last, otherwise in the order of the file; of very many the first."""
    placed = [(problem.source or document.place(problem.path), problem) for problem in found]
    placed.sort(key=lambda item: _position(item[0]))
    lines = [
        ": ".join(part for part in (place, _dotted(problem.path), shortened(problem.what, 1000)) if part)
        for place, problem in placed
    ]
    different = list(dict.fromkeys(lines))
    left = len(different) - MOST_LINES
    return [*different[:MOST_LINES], f"{document.name}: and {left} more"] if left > 0 else different


def _dotted(path: Path) -> str:
    return shortened(".".join(map(str, path)), 200)


def _position(place: str) -> tuple[float, float]:
    numbers = re.search(r":(\d+):(\d+)$", place)
    return (float(numbers[1]), float(numbers[2])) if numbers else (math.inf, math.inf)
