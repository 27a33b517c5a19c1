"""The keys of configurations as tables, from their JSON Schema."""

from collections.abc import Container, Iterator
from typing import Any

from extensions.tables import table, text
from projservo_cli.config.schema import json_schema
from projservo_cli.config.sweep import SweepConfig

# The unit that ends a key, the longest ending first; gains are in 1/s whatever they end in.
UNITS = {
    "_deg_s": "°/s",
    "_m_s": "m/s",
    "_deg": "°",
    "_rad": "rad",
    "_px": "px",
    "_m": "m",
    "_s": "s",
}


# Whole numbers beyond which a bound is that of the file, not of what is meant.
EXACT = 2**53


def unit(key: str) -> str:
    """Unit of a configuration key by its name."""
    if key.startswith("gain"):
        return "1/s"
    return next((symbol for ending, symbol in UNITS.items() if key.endswith(ending)), "")


def kind(schema: dict[str, Any], sections: Container[str]) -> str:
    """What a value may be, from its JSON Schema, as Markdown; sections have tables of their own."""
    if "$ref" in schema:
        name = named(schema)
        return f"[keys](#keys-{name.lower()})" if name in sections else "any keys"
    if "anyOf" in schema:
        return " or ".join(kind(part, sections) for part in schema["anyOf"])
    if "enum" in schema:
        return ", ".join(f"`{value}`" for value in schema["enum"])
    if "const" in schema:
        return f"`{schema['const']}`"
    if "prefixItems" in schema:
        return "list of " + " and ".join(f"({kind(part, sections)})" for part in schema["prefixItems"])
    if schema.get("type") == "array":
        least, most = schema.get("minItems"), schema.get("maxItems")
        count = f"{least} × " if least is not None and least == most else ""
        few = f", {least} or more" if least and least != most else ""
        return f"list of {count}({kind(schema['items'], sections)}){few}"
    if schema.get("type") == "object":
        inner = schema["additionalProperties"]
        return f"mapping of keys to {kind({} if inner is True else inner, sections)}"
    if "type" not in schema:
        return "any value"
    names = {"number": "number", "integer": "whole number", "string": "text", "boolean": "true or false"}
    bounds = {"exclusiveMinimum": ">", "minimum": "≥", "exclusiveMaximum": "<", "maximum": "≤"}
    limits = [
        f"{sign} {schema[bound]:,}"
        for bound, sign in bounds.items()
        if bound in schema and schema[bound] <= EXACT
    ]
    return ", ".join([names.get(schema["type"], schema["type"]), *limits])


def default(schema: dict[str, Any], required: bool) -> str:
    """Default of a key as YAML would say it."""
    if required:
        return "required"
    if isinstance(schema.get("default", {}), dict):
        return ""  # a section, whose keys have defaults of their own, or what the meaning says
    value = schema["default"]
    words = {None: "null", True: "true", False: "false"}
    if isinstance(value, list):
        return "`[" + ", ".join(map(str, value)) + "]`"
    return f"`{words[value] if value is None or isinstance(value, bool) else value}`"


def named(schema: dict[str, Any]) -> str:
    """Name of the section that a value is, or is a list of; empty for none."""
    inner = [schema.get(part) for part in ("items", "additionalProperties")]
    parts = [schema, *schema.get("anyOf", ()), *(part for part in inner if isinstance(part, dict))]
    return next((part["$ref"].rsplit("/", 1)[1] for part in parts if "$ref" in part), "")


def places(schema: dict[str, Any]) -> dict[str, list[str]]:
    """Sections of a configuration, in its order, each with the keys that it stands at."""
    found: dict[str, list[str]] = {}

    def visit(properties: dict[str, Any], path: str) -> None:
        for key, inner in properties.items():
            section = named(inner)
            keys = schema["$defs"][section].get("properties") if section else None
            if keys:
                place = f"{path}{key}"
                found.setdefault(section, []).append(place)
                visit(keys, f"{place}.")

    visit(schema["properties"], "")
    return found


def keys(schema: dict[str, Any], section: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    """Rows of the table of one section."""
    sections = places(schema)
    for key, inner in section["properties"].items():
        of_section = schema["$defs"].get(named(inner), {}).get("description", "").split("\n\n")[0]
        about = inner.get("description", of_section)
        required = key in section.get("required", ())
        yield f"`{key}`", kind(inner, sections), default(inner, required), unit(key), text(about)


def configuration() -> Iterator[str]:
    """The keys of a configuration, a table for each section."""
    yield from all_keys(json_schema())


def sweep() -> Iterator[str]:
    """The keys of the configuration of a sweep."""
    schema = SweepConfig.model_json_schema()
    schema["required"].remove("name")  # by default that of the file
    yield from all_keys(schema)


def all_keys(schema: dict[str, Any]) -> Iterator[str]:
    """The keys that a JSON Schema allows, a table for each section."""
    titles = ("key", "value", "default", "unit", "meaning")
    yield from table(titles, keys(schema, schema))
    for name, paths in places(schema).items():
        section = schema["$defs"][name]
        heading = ", ".join(f"`{path}`" for path in paths)
        yield from (f"(keys-{name.lower()})=", f"### {heading}", "", text(section.get("description", "")))
        yield from table(titles, keys(schema, section))
