"""What the documentation says by itself: all of it, as it is, and nothing that is not there."""

import dataclasses
import importlib
import inspect
import re

import pytest

from docs.generate import files, keys, regions, regions_of
from docs.generate.python import INTERFACE
from projservo_cli import records
from projservo_cli.cli import main
from projservo_cli.cli.equations import REGISTER
from projservo_cli.config import Config
from projservo_cli.config.schema import json_schema, sweep_schema
from projservo_cli.sweeps.runs import BETWEEN, NUMBERED, measured_columns
from tests.documentation.blocks import INDEXES, PAGES, ROOT


def cells(lines):
    """Rows of all tables in Markdown, each a list of cells."""
    rows = [line for line in lines if line.startswith("| ")]
    return [[cell.strip() for cell in re.split(r"(?<!\\)\|", row)[1:-1]] for row in rows]


def told(lines):
    """Rows of all tables in Markdown but their heads."""
    return [row for row in cells(lines) if row[0].startswith("`")]


@pytest.mark.parametrize("schema", [json_schema(), sweep_schema()], ids=["configuration", "sweep"])
def test_every_key_has_a_row(schema):
    sections = [schema, *(part for part in schema["$defs"].values() if "properties" in part)]
    rows = told(keys.all_keys(schema))
    wanted = sorted(f"`{key}`" for part in sections for key in part["properties"])
    assert sorted(row[0] for row in rows) == wanted
    assert all(len(row) == 5 and row[4] for row in rows)


def test_every_column_field_command_and_equation_is_there():
    columns = [row[0].strip("`") for row in told(regions.sweep_columns())]
    assert columns == [column.name for column in (*NUMBERED, *measured_columns(), BETWEEN)]
    rows = told(regions.run_file())
    classes = filter(dataclasses.is_dataclass, vars(records).values())
    named = {kind for kind in classes if dataclasses.fields(kind)[0].metadata}
    kinds = {kind for kind in named if not issubclass(kind, records.RecordPart)}
    assert set(regions.GROUPS.values()) == kinds
    assert len(rows) == sum(len(records.flat_fields(kind)) for kind in kinds)
    assert all(len(row) == 4 and row[1] and row[3] for row in rows)
    commands = "\n".join(regions.commands())
    assert re.findall(r"^## projservo ([\w-]+)$", commands, flags=re.MULTILINE) == list(main.commands)
    assert len(cells(regions.equations())) == 2 + len(REGISTER)


def test_what_is_generated_is_current():
    """``python -m docs.generate`` writes it."""
    pages = {name: page.read_text(encoding="utf-8") for name, page in PAGES.items()}
    found = [name for text in pages.values() for name in regions_of(text)]
    assert sorted(found) == sorted(regions.WRITERS)
    assert [path.name for path, text in files() if path.read_text(encoding="utf-8") != text] == []


ALL = [*(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")), *INDEXES, *PAGES.values()]


@pytest.mark.parametrize("page", ALL, ids=lambda page: f"{page.parent.name}/{page.stem}")
def test_links_lead_to_files_and_to_no_site(page):
    text = re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    assert not re.findall(r"https?://[\w.-]+", text)
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", text):
        assert (page.parent / target).is_file(), target
    for image in re.findall(r"!\[[^\]]*\]\(([^)]+)\)", text):
        assert (page.parent / image).stat().st_size <= 1_500_000, image


def resolved(name):
    """What a dotted name below the package stands for: a module, or something in one."""
    module, _, last = name.rpartition(".")
    try:
        return importlib.import_module(f"projservo_cli.{name}")
    except ModuleNotFoundError:
        return getattr(importlib.import_module(f"projservo_cli.{module}"), last)


def test_the_mathematics_is_where_the_page_says():
    text = PAGES["mathematics"].read_text(encoding="utf-8")
    packages = "geometry|calibration|task|planning|control|loop|robots|monitoring"
    sections = ((name, type(field.default)) for name, field in Config.model_fields.items())
    settings = {f"{name}.{key}" for name, section in sections for key in getattr(section, "model_fields", ())}
    names = set(re.findall(rf"`((?:{packages})(?:\.\w+)+)`", text)) - settings
    assert len(names) > 20
    for name in names:
        assert resolved(name) is not None


SECTION = re.compile(r"^(\w[\w ]*)\n-+$", re.MULTILINE)


def interface_functions():
    """Functions and methods of the documented Python interface by their names."""
    for item, members in INTERFACE.items():
        if inspect.isfunction(item):
            yield item.__name__, item
        for name in members:
            function = inspect.unwrap(getattr(item, name))
            if callable(function):
                yield f"{item.__name__}.{name}", function


@pytest.mark.parametrize(("name", "function"), [*interface_functions()])
def test_sections_of_a_docstring_name_every_argument_and_the_result(name, function):
    doc = inspect.getdoc(function)
    parts = SECTION.split(doc)
    sections = dict(zip(parts[1::2], parts[2::2], strict=True))
    entries = re.findall(r"^(\S.*?)(?: : |$)", sections.get("Parameters", ""), re.MULTILINE)
    documented = {part.strip().lstrip("*") for entry in entries for part in entry.split(",")}
    signature = inspect.signature(function)
    assert set(signature.parameters) - {"self", "cls"} <= documented
    returns = signature.return_annotation not in (None, "None", inspect.Signature.empty)
    assert not returns or {"Returns", "Yields"} & {*sections} or doc.startswith(("Return", "Draw"))
