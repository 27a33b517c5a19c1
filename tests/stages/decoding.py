"""Records again from their canonical bytes, which shows that a key holds all that a stage reads."""

import dataclasses
import json
import sys
from functools import cache

import numpy as np

from projservo_cli.result_hashes import File
from projservo_cli.stages.stage_inputs import Described, ToolMarkers

# Parts of records whose fields count as those of the record.
PARTS = {"PlanInputs": {"described": Described, "markers": ToolMarkers}}


def decoded(content, files):
    """The record of which these are the canonical bytes.

    files : where files lie, by the hash of their content.
    """
    return _value(json.loads(content), files)


def files_in(record):
    """All files of a record, each once."""
    if isinstance(record, File):
        return [record]
    if dataclasses.is_dataclass(record):
        parts = [getattr(record, field.name) for field in dataclasses.fields(record)]
    elif isinstance(record, (tuple, list, dict)):
        parts = record.values() if isinstance(record, dict) else record
    else:
        parts = [getattr(record, name) for name in getattr(type(record), "model_fields", ())]
    return list(dict.fromkeys(file for part in parts for file in files_in(part)))


def _value(plain, files):
    if not isinstance(plain, dict):
        return plain
    ((kind, held),) = plain.items()
    if kind == "file":
        return File(files[held], held)
    if kind == "array":
        dtype, shape, content = held
        return np.frombuffer(bytes.fromhex(content), dtype=dtype).reshape(shape).copy()
    if kind in ("tuple", "list"):
        found = [_value(inner, files) for inner in held]
        return found if kind == "list" else tuple(found)
    values = {name: _value(inner, files) for name, inner in held.items()}
    if kind == "mapping":
        return values
    name = kind.rpartition(":")[2]
    for part, one in PARTS.get(name, {}).items():
        values[part] = one(**{field.name: values.pop(field.name) for field in dataclasses.fields(one)})
    return _type_of(name, tuple(values))(**values)


@cache
def _type_of(name, fields):
    """The type of a name with these fields, wherever it stands."""
    modules = [module for path, module in sys.modules.items() if path.startswith("projservo_cli")]
    named = {vars(module)[name] for module in modules if isinstance(vars(module).get(name), type)}
    found = [kind for kind in named if set(fields) <= {*getattr(kind, "__annotations__", ())}]
    (kind,) = found or named
    return kind
