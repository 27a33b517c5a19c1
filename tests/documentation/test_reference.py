"""What the documentation says by itself: all of it, as it is, and nothing that is not there."""

import dataclasses
import importlib
import re

import pytest

from projservo_cli import records
from projservo_cli.cli.commands import COMMANDS
from projservo_cli.config import Config
from projservo_cli.config.schema import json_schema
from projservo_cli.config.sweep import SweepConfig
from projservo_cli.equations import REGISTER
from projservo_cli.sweep.runs import BETWEEN, MEASURED, NUMBERED
from tests.documentation.blocks import DOCS, ROOT, imported

pytest.importorskip("sphinx", reason="Sphinx is not installed: pip install 'projservo[docs]'")
docstrings, keys, links, reference = imported("docstrings", "keys", "links", "reference")

# Sites that pages may link to; none so far.
SITES: frozenset[str] = frozenset()


def cells(lines):
    """Rows of all tables in Markdown, each a list of cells."""
    rows = [line for line in lines if line.startswith("| ")]
    return [[cell.strip() for cell in re.split(r"(?<!\\)\|", row)[1:-1]] for row in rows]


@pytest.mark.parametrize(
    ("schema", "lines"),
    [
        (json_schema(), keys.configuration()),
        (SweepConfig.model_json_schema(), keys.sweep()),
    ],
    ids=["configuration", "sweep"],
)
def test_every_key_has_a_row(schema, lines):
    sections = [schema, *(part for part in schema["$defs"].values() if "properties" in part)]
    wanted = [f"`{key}`" for section in sections for key in section["properties"]]
    rows = [row for row in cells(lines) if row[0].startswith("`")]
    assert sorted(row[0] for row in rows) == sorted(wanted)
    assert all(len(row) == 5 and row[4] for row in rows)


def test_every_column_of_a_sweep_has_a_row():
    columns = {column.name: column for column in (*NUMBERED, *MEASURED, BETWEEN)}
    rows = {row[0].strip("`"): row for row in cells(reference.sweep_columns()) if row[0].startswith("`")}
    assert rows.keys() == columns.keys()
    assert rows["path_length_mm"] == [
        "`path_length_mm`", "number", "mm", "length of the path of the centre, from sample to sample"
    ]  # fmt: skip
    last = list(reference.sweep_columns())[-1]
    assert all(f"`{verdict}`" in last for verdict in ("converged", "not started", "not calibrated"))


@pytest.mark.parametrize(
    ("key", "value", "default", "unit"),
    [
        ("`period_s`", "number, > 0", "`0.04`", "s"),
        ("`joint_speed_limit_deg_s`", "number, > 0 or null", "`125.0`", "°/s"),
        ("`gain_t`", "number, > 0", "`2.5`", "1/s"),
        ("`self_occlusion`", "`transparent`, `opaque`", "`transparent`", ""),
        ("`image_size_px`", "list of 2 × (whole number, ≥ 0)", "required", "px"),
        ("`table`", "text", "required", ""),
        ("`lens`", "true or false", "`false`", ""),
    ],
)
def test_a_key_is_told_as_it_is(key, value, default, unit):
    rows = [row[1:4] for row in cells(keys.configuration()) if row[0] == key]
    assert [value, default, unit] in rows


def test_every_field_of_every_record_has_a_row():
    lines = list(reference.run_file())
    rows = [row for row in cells(lines) if row[0].startswith("`")]
    kinds = [kind for kind in vars(records).values() if dataclasses.is_dataclass(kind)]
    assert set(reference.GROUPS.values()) == set(kinds)
    wanted = sum(len(dataclasses.fields(kind)) for kind in reference.GROUPS.values())
    assert len(rows) == wanted
    assert all(len(row) == 4 and row[1] and row[3] for row in rows)


def test_every_command_and_equation_is_there():
    commands = "\n".join(reference.commands())
    assert re.findall(r"^## projservo ([\w-]+)$", commands, flags=re.MULTILINE) == list(COMMANDS)
    assert len(cells(reference.equations())) == 2 + len(REGISTER)


def test_words_of_the_code_are_shown_as_they_are():
    assert keys.text("t_* with |p_0| `x`") == r"t\_\* with \|p\_0\| \`x\`"


def test_sections_of_docstrings_become_lists():
    text = [
        "Summary.",
        "",
        "Parameters",
        "----------",
        "q, q_dot : (n,) readings,",
        "    rad or m.",
        "",
        "Raises",
        "------",
        "InputError",
        "    If not.",
    ]
    assert docstrings.rewritten(text) == [
        *("Summary.", "", "", "**Parameters**", "", "", "``q``, ``q_dot``", "    (n,) readings,"),
        *("    rad or m.", "", "", "**Raises**", "", "", "``InputError``", "    If not."),
    ]


@pytest.mark.parametrize("page", [ROOT / "README.md", *sorted(DOCS.glob("*.md"))], ids=lambda page: page.stem)
def test_links_lead_somewhere(page):
    text = re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", text):
        site = re.fullmatch(r"https://([\w.-]+)(/\S*)?", target)
        assert site[1] in SITES if site else (page.parent / target).is_file(), target
    assert set(re.findall(r"https?://([\w.-]+)", text)) <= SITES


def test_broken_links_of_built_pages_are_found(tmp_path):
    (tmp_path / "a.html").write_text(
        '<a id="here" href="#here"></a><a href="b.html#there"></a><a href="https://example.org"></a>'
        '<img src="a.html"><a href="b.html#nowhere"></a><a href="c.html"></a>'
        '<script src="https://example.org/x.js"></script><link href="lost.css">'
    )
    (tmp_path / "b.html").write_text('<h1 id="there"></h1>')
    assert sorted(links.broken(tmp_path)) == [
        "a.html: links to b.html#nowhere, a place that is not on the page",
        "a.html: links to c.html, which is not there",
        "a.html: links to lost.css, which is not there",
        "a.html: loads https://example.org/x.js from the network",
    ]


PACKAGES = "geometry|calibration|task|control|loop|plants"


def resolved(name):
    """What a dotted name below the package stands for: a module, or something in one."""
    module, _, last = name.rpartition(".")
    try:
        return importlib.import_module(f"projservo_cli.{name}")
    except ModuleNotFoundError:
        return getattr(importlib.import_module(f"projservo_cli.{module}"), last)


def test_the_mathematics_is_where_the_page_says():
    text = (DOCS / "mathematics.md").read_text(encoding="utf-8")
    names = set(re.findall(rf"`((?:{PACKAGES})(?:\.\w+)+)`", text)) - set(keys_of(Config))
    assert len(names) > 20
    for name in names:
        assert resolved(name) is not None


def keys_of(model):
    """Dotted keys of a configuration, two levels deep, which look like names of modules."""
    for name, field in model.model_fields.items():
        for key in getattr(type(field.default), "model_fields", ()):
            yield f"{name}.{key}"
