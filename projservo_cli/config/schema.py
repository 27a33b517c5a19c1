"""Aids to writing a configuration: a commented one to start from, and JSON Schemas for editors."""

import json
import re
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel
from pydantic.json_schema import GenerateJsonSchema

from projservo_cli.config.loading import Config
from projservo_cli.config.sweep import SweepConfig

_EXAMPLES = Path(__file__).parent
_DRAFT = "https://json-schema.org/draft/2020-12/schema"


def json_schema() -> dict[str, Any]:
    """Return the schema of a configuration file, without the rules between values."""
    schema = _schema(Config)
    keys = schema["properties"]
    keys["plant"] = {  # the short forms of plant.use
        "anyOf": [keys["plant"], {"type": "string"}],
        "description": "The robot; mujoco or module:Class is short for plant.use.",
    }
    keys["law"] = {  # and of control.laws
        **schema["$defs"]["Control"]["properties"]["laws"]["items"],
        "description": "Short for control.laws with this law alone.",
    }
    task = schema["$defs"]["TaskSettings"]["properties"]
    for key in ("start", "goal"):
        what = f"{task[key].pop('description', 'the goal')}; or the file that projservo teach wrote"
        task[key] = {"anyOf": [task[key], {"type": "string"}], "description": what}
    ((name, one),) = task["goals"]["patternProperties"].items()
    task["goals"]["patternProperties"] = {name: {"anyOf": [one, {"type": "string"}]}}
    schema["$defs"]["TaskSettings"]["required"].remove("goal")  # by default, the goal of the last step
    schema["$defs"]["Goal"]["properties"]["taught"] = {
        "type": "string",
        "description": "File that projservo teach wrote, for use with incidences.",
    }
    return {**schema, "title": "Configuration of projservo"}


def sweep_schema() -> dict[str, Any]:
    """The schema of the configuration of a sweep."""
    return {**_schema(SweepConfig), "title": "Sweep of projservo"}


def as_text(schema: dict[str, Any]) -> str:
    """A schema as the text of a file."""
    return json.dumps(schema, ensure_ascii=False, indent=2) + "\n"


def _schema(model: type[BaseModel]) -> dict[str, Any]:
    schema: dict[str, Any] = _without_titles(model.model_json_schema(schema_generator=_Generator))
    schema["required"].remove("name")  # by default, the name of the file
    return {"$schema": _DRAFT, **schema}


class _Generator(GenerateJsonSchema):
    """Names sections without the underscore of their classes."""

    def normalize_name(self, name: str) -> str:
        return super().normalize_name(name).lstrip("_")


def _without_titles(value: Any) -> Any:
    """Without titles that repeat the key, and with vectors in the form that every draft understands."""
    if isinstance(value, list):
        return [_without_titles(inner) for inner in value]
    if not isinstance(value, dict):
        return value
    kept = {
        key: _without_titles(inner)
        for key, inner in value.items()
        if not (key == "title" and isinstance(inner, str))
    }
    entries = kept.get("prefixItems")
    if isinstance(entries, list) and all(entry == entries[0] for entry in entries):
        kept["items"] = kept.pop("prefixItems")[0]
    return kept


def starter(arm: str | None = None) -> str:
    """A configuration to start from: for a kind of arm that people build, or one that describes every key.

    The latter comments its sections itself, except settings, of which it holds at most values
    that are not the defaults: these are filled from the models.
    """
    if arm is not None:
        return (_EXAMPLES / f"starter_{arm}.yaml").read_text(encoding="utf-8")
    return re.sub(
        r"^(\w+):\n((?:  \w+: .*\n)*)(?=\n|\Z)",
        lambda match: "\n".join(_settings(*match.groups())) + "\n",
        (_EXAMPLES / "starter.yaml").read_text(encoding="utf-8"),
        flags=re.MULTILINE,
    )


def _settings(name: str, example: str) -> Iterator[str]:
    """Lines of a section: each key under its description, behind a # if it shows its default."""
    section = Config.model_fields[name].default
    schema = type(section).model_json_schema()
    defaults = {key: _flow(value) for key, value in section.model_dump(mode="json").items()}
    given = dict(re.findall(r"^  (\w+): (.*)$", example, flags=re.MULTILINE))
    given = given or dict(list(defaults.items())[:1])  # a section of comments alone would be null
    yield from _comment(schema["description"].split("\n\n")[0].replace("`", ""), "")
    yield f"{name}:"
    for key, default in defaults.items():
        about = schema["properties"][key]
        choices = ", ".join(_choices(about))
        yield from _comment(about["description"] + (f" ({choices})" if choices else ""), "  ")
        yield f"  {key}: {given[key]}" if key in given else f"  # {key}: {default}"


def _flow(value: Any) -> str:
    """A value as YAML in one line."""
    return yaml.safe_dump(value, default_flow_style=True, width=1000).removesuffix("...\n").strip()


def _comment(text: str, indent: str) -> list[str]:
    sentence = text[0].upper() + text[1:].rstrip(".") + "."
    return textwrap.wrap(sentence, 108, initial_indent=f"{indent}# ", subsequent_indent=f"{indent}# ")


def _choices(schema: Any) -> list[str]:
    """The words that a value may be, or that a list may hold."""
    inner = schema.values() if isinstance(schema, dict) else schema if isinstance(schema, list) else ()
    found = schema.get("enum") if isinstance(schema, dict) else None
    return found or next(filter(None, map(_choices, inner)), [])
