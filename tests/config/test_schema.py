"""The JSON Schemas and the starter: both say what the models say, and accept what loads."""

import re

import pytest
import yaml

from projservo_cli.config import load_config, load_sweep
from projservo_cli.config.schema import json_schema, starter, sweep_schema
from projservo_cli.records import InputError
from tests.conftest import SHIPPED, SWEEPS

LINE = re.compile(r"# yaml-language-server: \$schema=(\S+)\n")


@pytest.fixture(scope="module")
def refused():
    """Function that gives the paths of what a schema refuses in a configuration, or in that of a sweep."""
    jsonschema = pytest.importorskip("jsonschema", reason="jsonschema is not installed")
    validators = [jsonschema.Draft202012Validator(schema()) for schema in (json_schema, sweep_schema)]
    for validator in validators:
        validator.check_schema(validator.schema)

    def errors(values, *, sweep=False):
        return [list(error.absolute_path) for error in validators[sweep].iter_errors(values)]

    return errors


def test_schemas_are_in_the_form_of_every_draft_and_ask_for_no_name():
    assert not [schema for schema in (json_schema(), sweep_schema()) if "name" in schema.get("required", [])]
    rig = json_schema()["$defs"]["Rig"]["properties"]
    size, _ = rig["image_size_px"]["anyOf"]  # in the form of every draft
    assert (size["minItems"], size["maxItems"], size["items"]["type"]) == (2, 2, "integer")


def test_shipped_files_name_their_schema_and_satisfy_it(refused):
    for path in (*SHIPPED, *SWEEPS):
        text = path.read_text(encoding="utf-8")
        assert LINE.match(text)[1] == ("sweep.schema.json" if path in SWEEPS else "schema.json"), path
        text = re.sub(r"\bon:", '"on":', text)  # true in YAML 1.1 alone, which editors do not read
        assert not refused(yaml.safe_load(text), sweep=path in SWEEPS), path
    linked = {"keys": ["noise.servo_px", "noise.calibration_px"], "values": [0, 1]}
    assert not refused({"base": "paper.yaml", "grid": {"noise": linked}}, sweep=True)


@pytest.mark.parametrize(
    ("sweep", "key", "value"),
    [
        (False, "control", {"gian_t": 2.5}),
        (False, "control", {"gain_t": -1}),
        (False, "rig", {"image_size_px": [640]}),
        (True, "runs", 0),
        (True, "grid", {"law": []}),
        (True, "tasks", {"random": 0.5}),
    ],
)
def test_the_schemas_refuse_what_loading_refuses(refused, tmp_path, sweep, key, value):
    values = yaml.safe_load((SWEEPS if sweep else SHIPPED)[0].read_text(encoding="utf-8"))
    values[key] = values.get(key, {}) | value if isinstance(value, dict) else value
    assert [(path or [key])[0] for path in refused(values, sweep=sweep)] == [key]
    path = tmp_path / "wrong.yaml"
    path.write_text(yaml.safe_dump(values), encoding="utf-8")
    with pytest.raises(InputError, match=key):
        (load_sweep if sweep else load_config)(path)


def test_the_starter_speaks_of_every_key():
    text = starter()
    schema = json_schema()
    keys = {key for section in (schema, *schema["$defs"].values()) for key in section.get("properties", {})}
    missing = {key for key in keys - {"law"} if not re.search(rf"\b{key}: ?", text)}
    assert not missing, "say in starter.yaml what they mean"


def test_the_starter_loads_and_what_it_calls_defaults_are_defaults(refused):
    text = starter()
    spelled = re.sub(r"^( *)# (\w+: .*)$", r"\1\2", text, flags=re.MULTILINE)
    assert spelled.count("#") < text.count("#") - 40
    plain, full = (load_config("mine.yaml", text=content) for content in (text, spelled))
    assert plain == full
    assert plain.name == "mine"
    assert not refused(yaml.safe_load(spelled))
    assert LINE.match(text)[1] == "projservo.schema.json"
