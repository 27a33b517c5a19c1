"""References written by the code they describe: directives that take no arguments."""

import dataclasses
import re
import types
import typing
from collections.abc import Container, Iterable, Iterator
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from projservo_cli import records
from projservo_cli.cli.commands import COMMANDS, allowed
from projservo_cli.cli.options import OPTIONS
from projservo_cli.config.schema import json_schema
from projservo_cli.equations import REGISTER

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
# Where a run file holds which record.
GROUPS = {
    "calibrate/observation": records.Observation,
    "calibrate/calibration": records.Calibration,
    "calibrate/cross_validation": records.CrossValidation,
    "plan": records.Plan,
    "servo/<law>": records.Trace,
    "report": records.Report,
}


def text(words: str) -> str:
    """Words of the code as Markdown that shows them as they are."""
    return re.sub(r"([\\`*_{}\[\]<>|#])", r"\\\1", " ".join(words.split()))


def table(titles: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> Iterator[str]:
    """Lines of a table whose cells are Markdown; nothing where it has no rows."""
    found = list(rows)
    if found:
        yield ""
        yield from ("| " + " | ".join(cells) + " |" for cells in (titles, ("---",) * len(titles), *found))
        yield ""


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
    if schema.get("type") == "array":
        least, most = schema.get("minItems"), schema.get("maxItems")
        count = f"{least} × " if least is not None and least == most else ""
        few = f", {least} or more" if least and least != most else ""
        return f"list of {count}({kind(schema['items'], sections)}){few}"
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
    parts = [schema, *schema.get("anyOf", ()), schema.get("items", {})]
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
    schema = json_schema()
    titles = ("key", "value", "default", "unit", "meaning")
    yield from table(titles, keys(schema, schema))
    for name, paths in places(schema).items():
        section = schema["$defs"][name]
        heading = ", ".join(f"`{path}`" for path in paths)
        yield from (f"(keys-{name.lower()})=", f"## {heading}", "", text(section.get("description", "")))
        yield from table(titles, keys(schema, section))


def run_file() -> Iterator[str]:
    """The groups of a run file, with the attributes and arrays of each."""
    for group, record in GROUPS.items():
        about = (record.__doc__ or "").split("\n\n")[0]
        yield from (f"## {text(group)}", "", text(about), "")
        fields = dataclasses.fields(record)
        hints = typing.get_type_hints(record)
        yield from table(
            ("attribute", "type", "unit", "what it is"),
            (
                (
                    f"`{f.name}`",
                    plain(hints[f.name]),
                    text(f.metadata["units"]) if "number" in plain(hints[f.name]) else "",
                    text(f.metadata["about"]),
                )
                for f in fields
                if "dims" not in f.metadata
            ),
        )
        yield from table(
            ("array", "dimensions", "unit", "what it is"),
            (
                (
                    f"`{f.name}`",
                    text(", ".join(f.metadata["dims"])),
                    text(f.metadata["units"]),
                    text(f.metadata["about"]),
                )
                for f in fields
                if "dims" in f.metadata
            ),
        )


def plain(hint: Any) -> str:
    """A type of an attribute in words; what may be missing is None in Python."""
    names = {str: "text", float: "number", int: "whole number", bool: "0 or 1"}
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        inner = [part for part in typing.get_args(hint) if part is not type(None)]
        return f"{plain(inner[0])}, may be missing"
    return names.get(hint, "JSON")


def commands() -> Iterator[str]:
    """The commands, with what each takes."""
    for name, command in COMMANDS.items():
        words = " ".join([name, *command.arguments])
        yield from ("", f"(command-{name})=", f"## projservo {name}", "", text(command.summary), "")
        yield from ("```text", f"projservo {words} [OPTIONS]", "```", "")
        for paragraph in command.about.split("\n\n"):
            yield from (text(paragraph), "")
        yield from ("For example:", "", "```text", command.example, "```", "")
        own = [key for key in OPTIONS if key in allowed([name])]
        yield from options([command.variants.get(key, OPTIONS[key]) for key in own])


def options(found: list[Any]) -> Iterator[str]:
    """A definition list of options of click."""
    import click

    context = click.Context(click.Command("projservo"))
    for option in found:
        record = option.get_help_record(context)
        if record is not None:
            yield from (f"`{record[0]}`", f": {text(record[1])}", "")


def equations() -> Iterator[str]:
    """The equations of the paper, the code of each, and what is misprinted."""
    yield from table(
        ("equation", "in the code", "erratum"),
        (
            (
                f"({entry.number}) {text(entry.title)}",
                " ".join(f"`{name.removeprefix('projservo_cli.')}`" for name in entry.functions),
                text(entry.erratum),
            )
            for entry in REGISTER
        ),
    )


class _Written(SphinxDirective):
    """Markdown from a function of this module, parsed in place."""

    def run(self) -> list[nodes.Node]:
        write = WRITERS[self.name]
        return self.parse_text_to_nodes("\n".join(write()), allow_section_headings=True)


WRITERS = {
    "configuration-keys": configuration,
    "run-file-groups": run_file,
    "commands": commands,
    "equations": equations,
}


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directives."""
    for name in WRITERS:
        app.add_directive(name, _Written)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
