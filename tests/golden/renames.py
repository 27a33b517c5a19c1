"""Translate the names of stored numbers by ``renames.csv``: columns kind, old and new, one to one.

Kinds are ``key`` (configuration), ``value`` (of a key or a field), ``json``, ``hdf5`` (record.field),
``dimension`` and ``module``. In paths ``[]`` stands for any index and ``*`` for any name.
"""

import csv
import json
import re
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

TABLE = Path(__file__).with_name("renames.csv")
# Groups of a run file, and of a sweep, that hold a record.
GROUPS = {"calibration": "/calibration", "plan": "/plan", "trace": "/(?:servo|traces)/", "report": "/report"}


class Rename(NamedTuple):
    """One row of the table."""

    kind: str
    old: str
    new: str


@cache
def renames() -> tuple[Rename, ...]:
    """All rows of the table."""
    with TABLE.open(encoding="utf-8", newline="") as file:
        return tuple(Rename(row["kind"], row["old"], row["new"]) for row in csv.DictReader(file))


def _path(path: str) -> str:
    """Regular expression of a JSON path, whose stage is left out where a command makes that stage alone."""
    stage, _, inner = path.partition(".")
    parts = re.escape(inner).replace(r"\.", "/").replace(r"\[\]", r"/(\d+)").replace(r"\*", "([^/]+)")
    return rf"(?P<head>command\d+/(?:{stage}/)?){parts}(?P<tail>/.*)?"


@cache
def _json_rules() -> tuple[tuple[re.Pattern[str], str], ...]:
    rows = sorted((r for r in renames() if r.kind == "json"), key=lambda row: -len(row.old))
    rules = []
    for row in rows:
        count, inner = 0, row.new.partition(".")[2].replace(".", "/").replace("[]", "/*")
        while "*" in inner:
            count += 1
            inner = inner.replace("*", rf"\g<{count + 1}>", 1)
        rules.append((re.compile(_path(row.old)), rf"\g<head>{inner}\g<tail>"))
    return tuple(rules)


@cache
def _stored_rules() -> tuple[tuple[re.Pattern[str], str], ...]:
    rules = []
    for row in (r for r in renames() if r.kind == "hdf5"):
        (record, old), new = row.old.split("."), row.new.split(".")[1]
        rules.append((re.compile(rf"(.*{GROUPS[record]}.*[/@]){re.escape(old)}(@.*)?"), rf"\g<1>{new}\g<2>"))
    for row in (r for r in renames() if r.kind == "key"):  # columns of a sweep are named by keys
        rules.append((re.compile(rf"(sweep\.h5/.*?){re.escape(row.old)}(@.*)?"), rf"\g<1>{row.new}\g<2>"))
    return tuple(rules)


def renamed(name: str) -> str:
    """New name of a number, the same where it has none."""
    rules = _json_rules() if name.startswith("command") else _stored_rules()
    for pattern, new in rules:
        if (found := pattern.fullmatch(name)) is not None:
            return found.expand(new.replace(r"\g<tail>", found["tail"] or "") if "tail" in new else new)
    return name


@cache
def _values() -> dict[str, str]:
    """Values by what they were, with the last name of their field before them."""
    found = {}
    for row in (r for r in renames() if r.kind == "value" and ": " in r.old):
        field, value = row.old.split(": ")
        found[f"{field.rpartition('.')[2]}: {value}"] = row.new
    return found


def translated(numbers: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Stored numbers of before by their new names, with new values and dimensions."""
    return {(new := renamed(name)): _renamed_value(new, value) for name, value in numbers.items()}


def _renamed_value(name: str, value: np.ndarray) -> np.ndarray:
    if value.dtype.kind != "U":
        return value
    if name.endswith("@dimensions"):
        dimensions = {row.old: row.new for row in renames() if row.kind == "dimension"}
        text = re.sub(r"[\w.]+", lambda word: dimensions.get(word[0], word[0]), str(value))
        return np.array(text)
    field = re.split(r"[/@]", name)[-1]
    try:
        stored = json.loads(str(value))
    except ValueError:
        return np.array(_values().get(f"{field}: {value}", str(value)))
    return np.array(json.dumps(_mapped(field, stored)))


def _mapped(field: str, value: object) -> object:
    if isinstance(value, list):
        return [_mapped(field, one) for one in value]
    return _values().get(f"{field}: {value}", value) if isinstance(value, str) else value
