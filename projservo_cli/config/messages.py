"""What pydantic finds, said in the words of the configuration."""

import difflib
import json
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from pydantic import BaseModel
from pydantic_core import ErrorDetails

from projservo_cli.config.yaml_source import Path, Problem, shortened

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
