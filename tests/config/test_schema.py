"""The JSON Schema and the starter: both say what the models say, and accept what loads."""

import re
from pathlib import Path

import pytest
import yaml

from projservo_cli.config import Config, digest, load_config
from projservo_cli.config.robot import Section
from projservo_cli.config.schema import STARTER, json_schema, schema_text, sweep_schema
from projservo_cli.config.sweep import SweepConfig, load_sweep
from tests.conftest import SHIPPED, SWEEPS

ROOT = Path(__file__).parents[2]
WRONG = {
    "unknown key": ("control", "gian_t", 2.5),
    "negative gain": ("control", "gain_t", -1),
    "no such law": ("control", "laws", ["direct_four"]),
    "text for a number": ("noise", "servo_px", "1 px"),
    "short vector": ("rig", "image_size_px", [640]),
    "fraction for a count": ("stop", "max_steps", 1.5),
}


@pytest.fixture(scope="module")
def validator():
    jsonschema = pytest.importorskip("jsonschema", reason="jsonschema is not installed")
    jsonschema.Draft202012Validator.check_schema(json_schema())
    return jsonschema.Draft202012Validator(json_schema())


def test_the_shipped_schema_is_the_one_of_the_models():
    shipped = (ROOT / "configs" / "schema.json").read_text(encoding="utf-8")
    assert shipped == schema_text(json_schema()), "outdated: projservo schema -o configs/schema.json"
    sweeps = (ROOT / "configs" / "sweep.schema.json").read_text(encoding="utf-8")
    assert sweeps == schema_text(sweep_schema()), (
        "outdated: projservo schema sweep -o configs/sweep.schema.json"
    )


@pytest.mark.parametrize("path", [*SHIPPED, STARTER], ids=lambda path: path.stem)
def test_configurations_name_their_schema_and_satisfy_it(validator, path):
    text = path.read_text(encoding="utf-8")
    named = re.fullmatch(r"# yaml-language-server: \$schema=(\S+)", text.splitlines()[0])
    assert named
    assert path == STARTER or (path.parent / named[1]).is_file()
    assert not list(validator.iter_errors(yaml.safe_load(text)))


@pytest.fixture(scope="module")
def of_sweeps():
    jsonschema = pytest.importorskip("jsonschema", reason="jsonschema is not installed")
    jsonschema.Draft202012Validator.check_schema(sweep_schema())
    return jsonschema.Draft202012Validator(sweep_schema())


@pytest.mark.parametrize("path", SWEEPS, ids=lambda path: path.stem)
def test_sweeps_name_their_schema_and_satisfy_it(of_sweeps, path):
    text = path.read_text(encoding="utf-8")
    assert text.splitlines()[0] == "# yaml-language-server: $schema=sweep.schema.json"
    values = yaml.safe_load(text)
    assert not list(of_sweeps.iter_errors(values))
    linked = {"keys": ["noise.servo_px", "noise.calibration_px"], "values": [0, 1]}
    assert not list(of_sweeps.iter_errors(values | {"base": "paper.yaml", "grid": {"noise": linked}}))


@pytest.mark.parametrize(
    ("key", "value"),
    [("runs", 0), ("bases", "paper.yaml"), ("grid", {"law": []}), ("base", 1), ("tasks", {"random": 0.5})],
)
def test_the_schema_of_sweeps_refuses_what_loading_refuses(of_sweeps, tmp_path, key, value):
    values = {"base": "paper.yaml", key: value}
    if key == "bases":
        del values["base"]
    assert list(of_sweeps.iter_errors(values))
    path = tmp_path / "sweep.yaml"
    path.write_text(yaml.safe_dump(values), encoding="utf-8")
    with pytest.raises(ValueError, match=key):
        load_sweep(path)


@pytest.mark.parametrize("case", WRONG)
def test_the_schema_refuses_what_loading_refuses(validator, case):
    values = yaml.safe_load(SHIPPED[0].read_text(encoding="utf-8"))
    section, key, value = WRONG[case]
    values.setdefault(section, {})[key] = value
    (error,) = validator.iter_errors(values)
    assert list(error.absolute_path)[:1] == [section]
    with pytest.raises(ValueError, match=section):
        load_config("x.yaml", text=yaml.safe_dump(values))


def test_vectors_are_said_in_the_form_of_every_draft_and_names_are_optional():
    schema = json_schema()
    assert "prefixItems" not in schema_text(schema)
    assert "name" not in schema.get("required", [])
    assert schema["additionalProperties"] is False
    size = schema["$defs"]["Rig"]["properties"]["image_size_px"]
    assert (size["minItems"], size["maxItems"], size["items"]["type"]) == (2, 2, "integer")


def keys(model):
    """All keys of a model and of the models in it."""
    for name, field in model.model_fields.items():
        yield name
        for inner in inner_models(field.annotation):
            yield from keys(inner)


def inner_models(annotation):
    if isinstance(annotation, type) and issubclass(annotation, Section):
        return [annotation]
    return [model for part in getattr(annotation, "__args__", ()) for model in inner_models(part)]


def test_the_starter_speaks_of_every_key():
    text = STARTER.read_text(encoding="utf-8")
    missing = {key for key in keys(Config) if not re.search(rf"\b{key}: ?", text)}
    assert not missing, f"say in {STARTER.name} what they mean"


def unexplained(model):
    """Keys without a description, by model; a key that holds a section has that of the section."""
    for name, field in model.model_fields.items():
        inner = inner_models(field.annotation)
        if not field.description and not any(part.__doc__ for part in inner):
            yield f"{model.__name__}.{name}"
        for part in inner:
            yield from unexplained(part)


@pytest.mark.parametrize("model", [Config, SweepConfig])
def test_every_key_says_what_it_means(model):
    assert not set(unexplained(model)), "describe them: Field(default, description=...)"


def test_editors_are_told_what_a_key_means():
    schema = json_schema()
    objects = {"Config": schema, **schema["$defs"]}
    silent = [
        f"{name}.{key}"
        for name, value in objects.items()
        for key, inner in value.get("properties", {}).items()
        if "description" not in inner and "$ref" not in str(inner)
    ]
    assert not silent


def test_the_starter_loads_and_what_it_calls_defaults_are_defaults():
    text = STARTER.read_text(encoding="utf-8")
    spelled = re.sub(r"^( *)# (\w+: .*)$", lambda m: m[1] + m[2], text, flags=re.MULTILINE)
    assert spelled.count("\n#") < text.count("\n#") or spelled != text
    plain, full = (load_config("mine.yaml", text=content) for content in (text, spelled))
    assert plain == full
    assert plain.name == "mine"
    sections = tuple(Config.model_fields)
    assert digest(plain, sections) == digest(full, sections)
