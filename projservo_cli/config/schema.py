"""JSON Schemas of a configuration and of a sweep, by which editors complete and check them."""

import json
from pathlib import Path
from typing import Any

from projservo_cli.config.models import Config
from projservo_cli.config.sweep import SweepConfig

# A configuration with a comment on every key, to start from.
STARTER = Path(__file__).with_name("starter.yaml")
DRAFT = "https://json-schema.org/draft/2020-12/schema"


def json_schema() -> dict[str, Any]:
    """The schema of a configuration file; what must hold between values, only loading it tells."""
    schema: dict[str, Any] = _plain(Config.model_json_schema())
    schema["required"].remove("name")  # by default that of the file
    keys = schema["properties"]
    keys["plant"] = {  # the short forms of plant.use
        "anyOf": [keys["plant"], {"type": "string"}],
        "description": "What is driven; module:Class is short for plant.use.",
    }
    keys["law"] = {  # and of control.laws
        **schema["$defs"]["Control"]["properties"]["laws"]["items"],
        "description": "Short for control.laws with this law alone.",
    }
    return {"$schema": DRAFT, **schema, "title": "Configuration of projservo"}


def sweep_schema() -> dict[str, Any]:
    """The schema of the configuration of a sweep."""
    schema: dict[str, Any] = _plain(SweepConfig.model_json_schema())
    schema["required"].remove("name")
    keys = schema["properties"]
    described = keys["base"].pop("description")
    keys["base"] = {"anyOf": [keys["base"], {"type": "string"}], "description": described}
    values = schema["$defs"]["Linked"]["properties"]["values"]  # alone: of the key that names the axis
    keys["grid"]["additionalProperties"] = {"anyOf": [keys["grid"]["additionalProperties"], values]}
    return {"$schema": DRAFT, **schema, "title": "Sweep of projservo"}


def schema_text(schema: dict[str, Any]) -> str:
    """A schema as the text of a file."""
    return json.dumps(schema, ensure_ascii=False, indent=2) + "\n"


def _plain(value: Any) -> Any:
    """Without titles that repeat the key, and with vectors in the form that every draft understands."""
    if isinstance(value, list):
        return [_plain(inner) for inner in value]
    if not isinstance(value, dict):
        return value
    kept = {key: _plain(inner) for key, inner in value.items() if not _is_title(key, inner)}
    entries = kept.get("prefixItems")
    if isinstance(entries, list) and all(entry == entries[0] for entry in entries):
        kept["items"] = kept.pop("prefixItems")[0]
    return kept


def _is_title(key: str, inner: Any) -> bool:
    return key == "title" and isinstance(inner, str)
