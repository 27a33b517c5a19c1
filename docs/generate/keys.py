"""The keys of configurations as tables, from their JSON Schema."""

import json
from collections.abc import Iterator, Mapping
from typing import Any

from docs.generate.markdown import anchor, table, text

# The unit that ends a key, the longest ending first; gains are in 1/s whatever they end in.
UNITS = {
    "mm_s": "mm/s",
    "mm": "mm",
    "deg_s": "°/s",
    "m_s": "m/s",
    "deg": "°",
    "rad": "rad",
    "px": "px",
    "m": "m",
    "s": "s",
}
# Whole numbers beyond which a bound is that of the file, not of what is meant.
EXACT = 2**53


def unit(key: str) -> str:
    """Unit of a configuration key by its name."""
    if key.startswith("gain"):
        return "1/s"
    return next((symbol for ending, symbol in UNITS.items() if key.endswith(f"_{ending}")), "")


def kind(schema: dict[str, Any], sections: Mapping[str, list[str]]) -> str:
    """What a value may be, from its JSON Schema, as Markdown; sections have tables of their own."""
    if "$ref" in schema:
        name = named(schema)
        return f"[keys](#{anchor(heading(sections[name]))})" if name in sections else "any keys"
    if kinds := schema.get("anyOf") or schema.get("oneOf"):
        return " or ".join(kind(part, sections) for part in kinds)
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
        patterns = schema.get("patternProperties", {})
        inner = next(iter(patterns.values()), schema.get("additionalProperties"))
        return f"mapping of keys to {kind({} if inner is True else inner, sections)}"
    if "type" not in schema:
        return "any value"
    names = {"number": "number", "integer": "whole number", "string": "text", "boolean": "true or false"}
    bounds = {"exclusiveMinimum": ">", "minimum": "≥", "exclusiveMaximum": "<", "maximum": "≤"}
    limits = [
        f"{sign} {schema[key]:,}" for key, sign in bounds.items() if schema.get(key, EXACT + 1) <= EXACT
    ]
    return ", ".join([names.get(schema["type"], schema["type"]), *limits])


def default(schema: dict[str, Any], required: bool) -> str:
    """Default of a key as YAML; empty for a section, whose keys have defaults of their own."""
    value = schema.get("default", {})
    shown = (value or '""') if isinstance(value, str) else json.dumps(value).replace('"', "")
    return "required" if required else "" if isinstance(value, dict) else f"`{shown}`"


def named(schema: Any) -> str:
    """Name of the section that a value is, or holds; empty for none."""
    if isinstance(schema, dict) and "$ref" in schema:
        return str(schema["$ref"]).rsplit("/", 1)[1]
    inner = schema.values() if isinstance(schema, dict) else schema if isinstance(schema, list) else ()
    return next(filter(None, map(named, inner)), "")


def heading(paths: list[str]) -> str:
    """Heading of a section that stands at some paths."""
    return ", ".join(f"`{path}`" for path in paths)


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
                further = schema["$defs"][section].get("additionalProperties")
                visit(keys | ({"NAME": further} if named(further) else {}), f"{place}.")

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


def all_keys(schema: dict[str, Any]) -> Iterator[str]:
    """The keys that a JSON Schema allows, a table for each section."""
    titles = ("key", "value", "default", "unit", "meaning")
    yield from table(titles, keys(schema, schema))
    for name, paths in places(schema).items():
        section = schema["$defs"][name]
        yield from (f"### {heading(paths)}", "", text(section.get("description", "")))
        yield from table(titles, keys(schema, section))
