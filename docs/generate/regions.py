"""Generated regions: references written by the code that they describe."""

import inspect
import re
import types
import typing
from collections.abc import Callable, Iterator
from typing import Any

import click

from docs.generate import keys, python
from docs.generate.markdown import escaped, table, text
from projservo_cli import records
from projservo_cli.cli import main
from projservo_cli.cli.equations import REGISTER
from projservo_cli.config.schema import json_schema, sweep_schema
from projservo_cli.laws import FACE_LAWS, INCIDENCES, LAW_SPECS, MODES
from projservo_cli.loop import verdicts as loop_verdicts
from projservo_cli.messages import ROWS
from projservo_cli.messages.verdict_causes import VERDICTS
from projservo_cli.report.figures import FIGURES
from projservo_cli.sweeps.runs import BETWEEN, NUMBERED, measured_columns

# Where a run file holds which record.
GROUPS = {
    "calibrate/observation": records.Observation,
    "calibrate/calibration": records.Calibration,
    "calibrate/cross_validation": records.CrossValidation,
    "plan": records.Plan,
    "servo/<law>": records.Trace,
    "servo/<step>/action": records.Action,
    "report": records.Report,
}


def run_file() -> Iterator[str]:
    """The groups of a run file, with the attributes and arrays of each."""
    for group, record in GROUPS.items():
        about = (record.__doc__ or "").split("\n\n")[0]
        yield from (f"## {text(group)}", "", text(about), "")
        yield from table(("attribute", "type", "unit", "meaning"), fields(record, arrays=False))
        yield from table(("array", "dimensions", "unit", "meaning"), fields(record, arrays=True))


def fields(record: type, *, arrays: bool) -> Iterator[tuple[str, ...]]:
    """Rows of the table of a record's attributes, or of its arrays, with those of its parts."""
    lacking = records.optional_names(record)
    for field in records.flat_fields(record):
        about, dims = field.metadata, field.metadata.get("dims")
        if arrays == (dims is not None):
            hint = typing.get_args(field.type)[0] if "by_view" in about else field.type
            hint = hint | None if field.name in lacking and not records.has_default(field) else hint
            what = plain(hint) if dims is None else text(", ".join(dims))
            units = text(about["units"]) if arrays or "number" in what else ""
            name = f"{field.name}_<view>" if "by_view" in about else field.name
            yield f"`{name}`", what, units, text(about["about"])


def plain(hint: Any) -> str:
    """A type of an attribute in words; what may be missing is None in Python."""
    names = {str: "text", float: "number", int: "whole number", bool: "0 or 1"}
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        inner = [part for part in typing.get_args(hint) if part is not type(None)]
        return f"{plain(inner[0])}, may be missing"
    return names.get(hint, "JSON")


def commands() -> Iterator[str]:
    """The commands, with what each takes."""
    for name, command in main.commands.items():
        with click.Context(main, info_name="projservo", **main.context_settings) as group:
            context = click.Context(command, group, info_name=name)
        summary, *paragraphs = inspect.cleandoc(command.help or "").split("\n\n")
        yield from ("", f"## projservo {name}", "", text(summary), "")
        yield from ("```text", command.get_usage(context).removeprefix("Usage: "), "```", "")
        for paragraph in paragraphs:
            yield from (text(" ".join(paragraph.split())), "")
        yield from (
            "For example:",
            "",
            "```text",
            (command.epilog or "").removeprefix("Example: "),
            "```",
            "",
        )
        for option in command.params:
            if (record := option.get_help_record(context)) is not None:
                yield f"- `{record[0]}`: {text(record[1])}"


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


def sweep_columns() -> Iterator[str]:
    """The columns that the table of every sweep has, and the one that it may have."""
    kinds = {"f": "number", "i": "whole number", "u": "whole number", "S": "text"}
    yield from table(
        ("column", "value", "unit", "meaning"),
        (
            (
                f"`{column.name}`",
                kinds[column.dtype[0]],
                text(column.units.removeprefix("1")),
                text(column.about),
            )
            for column in (*NUMBERED, *measured_columns(), BETWEEN)
        ),
    )
    yield from (
        "",
        f"A sweep with `between_samples` has `{BETWEEN.name}`. Each camera of a rig has its column",
    )
    yield "`self_occluded_steps_<view>`; random tasks show the face to `trajectory.visible_views` of them."


def laws() -> Iterator[str]:
    """The control laws with their formulas, what each measures, and its source."""
    rows = []
    for name, law in LAW_SPECS.items():
        measures = "face" if name in FACE_LAWS else "body, always" if name == INCIDENCES else "body"
        rows.append((f"`{name}`", law.family.value, law.velocity, measures, law.source))
    yield from table(("law", "family", "joint velocity", "measures", "source"), rows)


def modes() -> Iterator[str]:
    """The modes of the laws, and which laws have each."""
    rows = []
    for mode, does in MODES.items():
        able = [f"`{law}`" for law, spec in LAW_SPECS.items() if mode in spec.modes]
        rows.append((f"`{mode}`", does, "all" if len(able) == len(LAW_SPECS) else ", ".join(able)))
    yield from table(("mode (`control.mode`)", "action", "laws"), rows)


def figures() -> Iterator[str]:
    """The figures of a report, what each shows, and the figure of the paper that it follows."""
    rows = ((f"`{spec.name}`", text(spec.title), text(spec.paper)) for spec in FIGURES)
    yield from table(("figure", "shows", "in the paper"), rows)


def verdicts() -> Iterator[str]:
    """All verdicts of a run, and their order."""
    rows = []
    for name, one in VERDICTS.items():
        after = "another path is searched" if one.stopped else ""
        after = "no further motion" if one.ends else after
        rows.append((f"`{name}`", text(one.when), text(one.remedy), after))
    yield from table(("verdict", "cause", "remedy", "then"), rows)
    yield ""
    yield from python.markdown(inspect.cleandoc(loop_verdicts.__doc__ or "").split("\n\n", 1)[1])


def terms_of_verdicts() -> Iterator[str]:
    """The verdicts as terms of the glossary."""
    rows = (
        (name, text(one.when), ", ".join(f"`{each}`" for each in (name, *one.names)), one.origin)
        for name, one in VERDICTS.items()
    )
    yield from table(("term", "meaning", "names", "origin"), rows)


def findings() -> Iterator[str]:
    """All findings by their codes with their sentences; values that depend on the finding are in italics."""
    rows = ((f"`{code}`", _pattern(row.sentence), _pattern(row.remedy)) for code, row in ROWS.items())
    yield from table(("code", "sentence", "remedy"), rows)


def _pattern(sentence: str) -> str:
    """A text of a row, its values by their names."""
    plain, *rest = re.split(r"\{(\w+)[^}]*\}", sentence)
    named = "".join(
        f" *{name.replace('_', ' ')}* {escaped(after)}"
        for name, after in zip(rest[::2], rest[1::2], strict=True)
    )
    return re.sub(r" ([ ,;:)]|$)", r"\1", escaped(plain) + named).replace("( *", "(*").strip()


WRITERS: dict[str, Callable[[], Iterator[str]]] = {
    "configuration-keys": lambda: keys.all_keys(json_schema()),
    "sweep-keys": lambda: keys.all_keys(sweep_schema()),
    "sweep-columns": sweep_columns,
    "run-file-groups": run_file,
    "commands": commands,
    "equations": equations,
    "laws": laws,
    "modes": modes,
    "figures": figures,
    "verdicts": verdicts,
    "terms-of-verdicts": terms_of_verdicts,
    "findings": findings,
    "python-interface": python.python_interface,
    "robot-contract": python.robot_contract,
    "law-contract": python.law_contract,
}
