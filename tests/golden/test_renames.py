"""The table of renames: one to one, and every name in it is one of the project."""

import dataclasses
import importlib.util

import numpy as np
import pytest

from projservo_cli.config.schema import json_schema
from projservo_cli.loop.step import VERDICTS
from projservo_cli.records import SIZES, Calibration, Plan, Report, Trace
from tests.golden.renames import renamed, renames, translated

RECORDS = {"calibration": Calibration, "plan": Plan, "trace": Trace, "report": Report}


def keys_of(schema, definitions, path=""):
    """Every path of a JSON Schema, with [] for the items of a list."""
    for branch in (schema, *schema.get("anyOf", ()), *schema.get("oneOf", ())):
        if "$ref" in branch:
            yield from keys_of(definitions[branch["$ref"].rpartition("/")[2]], definitions, path)
        elif branch.get("type") == "array" and isinstance(branch.get("items"), dict):
            yield from keys_of(branch["items"], definitions, f"{path}[]")
        for name, inner in branch.get("properties", {}).items():
            here = f"{path}.{name}".lstrip(".")
            yield here
            yield from keys_of(inner, definitions, here)


def rows(kind):
    return [row for row in renames() if row.kind == kind]


def fields():
    return {f"{name}.{field.name}" for name, kind in RECORDS.items() for field in dataclasses.fields(kind)}


def test_old_and_new_names_are_one_to_one():
    for kind in ("key", "json", "hdf5", "dimension", "module"):
        old, new = zip(*((row.old, row.new) for row in rows(kind)), strict=True)
        assert len(set(old)) == len(old)
        assert len(set(new)) == len(new)
        assert not {*old} & {*new}


def test_keys_are_those_of_the_schema():
    schema = json_schema()
    known = set(keys_of(schema, schema["$defs"]))
    assert {row.new for row in rows("key")} <= known
    assert not {row.old for row in rows("key")} & known


def test_stored_names_and_dimensions_are_those_of_the_records():
    assert {row.new for row in rows("hdf5")} <= fields()
    assert not {row.old for row in rows("hdf5")} & fields()
    dimensions = {
        name
        for kind in RECORDS.values()
        for field in dataclasses.fields(kind)
        for name in field.metadata.get("dims", ())
    } | set(SIZES)
    assert {row.new for row in rows("dimension")} <= dimensions
    assert not {row.old for row in rows("dimension")} & dimensions


def test_modules_and_verdicts_are_there():
    for row in rows("module"):
        assert importlib.util.find_spec(row.new) is not None, row
        parent = row.old.rpartition(".")[0]
        gone = importlib.util.find_spec(parent) is None or importlib.util.find_spec(row.old) is None
        assert gone, row
    verdicts = {row.new for row in rows("value") if row.old.startswith("verdict")}
    assert verdicts <= set(VERDICTS)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("command0/calibrate/joints/3/weak", "command0/calibrate/joints/3/poorly_observable"),
        ("command0/joints/3/weak", "command0/joints/3/poorly_observable"),
        ("command0/calibrate/left_out/tracks/still/0", "command0/calibrate/rejected/tracks/still/0"),
        ("command0/plan/margins/left_view/least", "command0/plan/margins/left_view/min"),
        ("run.h5/servo/exact@searches_anew", "run.h5/servo/exact@replan_attempts"),
        ("run.h5/plan/least@units", "run.h5/plan/min_margin@units"),
        ("run.h5/plan/mu", "run.h5/plan/mu"),
        ("command0/exit_code", "command0/exit_code"),
    ],
)
def test_a_stored_name_has_its_new_name(old, new):
    assert renamed(old) == new


def test_values_and_dimensions_are_translated():
    old = {"run.h5/servo/a@verdict": '"plateau"', "run.h5/servo/a/q@dimensions": '"/servo/a/instant /joint"'}
    new = translated({name: np.array(text) for name, text in old.items()})
    assert [str(text) for text in new.values()] == ['"no progress"', '"/servo/a/time /joint"']
