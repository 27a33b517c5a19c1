"""Test the glossary against the names of the code."""

import dataclasses
import re

import pytest

from projservo_cli import records
from projservo_cli.config.schema import json_schema, sweep_schema
from projservo_cli.messages.verdict_causes import VERDICTS
from projservo_cli.sweeps.runs import BETWEEN, NUMBERED, measured_columns
from tests.documentation.blocks import DOCS

SCHEMAS = (json_schema(), sweep_schema())


def rows():
    """Cells of each term: term, meaning, names, origin."""
    text = (DOCS / "reference" / "glossary.md").read_text(encoding="utf-8")
    found = [
        [cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line[:1] == "|"
    ]
    return [row for row in found if row[0] not in {"term", "---"}]


def names():
    """All names of the third column."""
    return {name for row in rows() for name in re.findall(r"`([^`]+)`", row[2])}


def values(schema):
    """All values that a JSON Schema lists."""
    if isinstance(schema, dict):
        yield from (str(value) for value in schema.get("enum", ()) or ())
        yield from [schema["const"]] if "const" in schema else []
        for part in schema.values():
            yield from values(part)
    elif isinstance(schema, list):
        for part in schema:
            yield from values(part)


def columns():
    return {column.name for column in (*NUMBERED, *measured_columns(), BETWEEN)}


def keys():
    """Names of all configuration keys."""
    sections = [part for schema in SCHEMAS for part in (schema, *schema["$defs"].values())]
    return {key for part in sections for key in part.get("properties", ())}


def modes_and_profiles():
    sections = SCHEMAS[0]["$defs"]
    parts = (sections["Control"]["properties"]["mode"], sections["Trajectory"]["properties"]["profile"])
    return {value for part in parts for value in values(part)}


NAMES = {
    "verdicts": set(VERDICTS),
    "columns": columns(),
    "configuration": {*SCHEMAS[0]["properties"]},
    "sweep": {*SCHEMAS[1]["properties"]},
    "disturbance": {*SCHEMAS[0]["$defs"]["Disturbance"]["properties"]},
    "stop": {*SCHEMAS[0]["$defs"]["Stop"]["properties"]},
    "laws": set(values(SCHEMAS[0]["properties"]["law"])),
    "modes and profiles": modes_and_profiles(),
}


@pytest.mark.parametrize("kind", NAMES)
def test_names_of_the_code_have_a_term(kind):
    assert NAMES[kind]
    assert NAMES[kind] - names() == set()


def test_names_of_the_glossary_stand_in_the_code():
    fields = {
        field.name
        for kind in vars(records).values()
        if dataclasses.is_dataclass(kind) and isinstance(kind, type)
        for field in records.flat_fields(kind)
    }
    fields |= {name for kind in vars(records).values() for name in getattr(kind, "_fields", ())}
    # A test of the page on commands compares these with the output of the commands.
    output = set(re.findall(r"`(\w+)`", (DOCS / "reference" / "commands.md").read_text(encoding="utf-8")))
    known = fields | output | keys() | columns() | set(VERDICTS)
    known |= {value for schema in SCHEMAS for value in values(schema)}
    assert names() - known == set()


def test_a_term_stands_once_with_one_sentence_and_its_origin():
    terms = [row[0] for row in rows()]
    assert len(terms) == len(set(terms)) > 60
    for row in rows():
        assert len(row) == 4
        assert row[1]
        assert not re.search(r"\.\s", row[1]), row[0]
        assert row[3].startswith(("[RH00]", "field", "projservo", "Kalibr")), row[0]
