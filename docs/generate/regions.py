"""Generated regions: references written by the code that they describe."""

import dataclasses
import inspect
import types
import typing
from collections.abc import Callable, Iterator
from typing import Any

import click

from docs.generate import keys, python
from docs.generate.markdown import table, text
from projservo_cli import records
from projservo_cli.cli import main
from projservo_cli.cli.equations import REGISTER
from projservo_cli.config.schema import json_schema, sweep_schema
from projservo_cli.findings import DEVIATIONS, LIMITS, NOTE, Finding, Subject
from projservo_cli.loop import verdicts as loop_verdicts
from projservo_cli.sweeps.runs import BETWEEN, NUMBERED, measured_columns
from projservo_cli.words import ROWS, line, sentence
from projservo_cli.words.plans import PLANS
from projservo_cli.words.runs import VERDICTS
from projservo_cli.words.table import Setup

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
    """Rows of the table of a record's attributes, or of its arrays: its own, then those of its parts."""
    hints = typing.get_type_hints(record)
    own = vars(record)["__annotations__"]
    for field in sorted(dataclasses.fields(record), key=lambda field: field.name not in own):
        about, dims = field.metadata, field.metadata.get("dims")
        if arrays == (dims is not None):
            hint = typing.get_args(hints[field.name])[0] if "by_view" in about else hints[field.name]
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


def verdicts() -> Iterator[str]:
    """All verdicts of a run, and their order."""
    rows = []
    for name, one in VERDICTS.items():
        after = "another path is searched" if one.stopped else ""
        after = "nothing is driven" if one.ends else after
        rows.append((f"`{name}`", text(one.when), text(one.remedy), after))
    yield from table(("verdict", "cause", "remedy", "then"), rows)
    yield ""
    yield from python.markdown(inspect.cleandoc(loop_verdicts.__doc__ or "").split("\n\n", 1)[1])


def example(code: str) -> Finding:
    """A finding of a code with values for all that its words may name."""
    texts, counted = "".join(ROWS[code]), ("{count}", "{total}", "{times}")
    of_joints = ("joint", "quadratic", "cubic", "harmonic", "sag", "little", "circular", "turned")
    unit, amount, limit, deviation = "px", 0.6, 0.2, 0.1
    of_path = ("margin_joints", "motion_joints", "object_far")
    if code in PLANS and code not in of_path and not any(name in texts for name in counted):
        pixels = code in ("motion_border", "outside_image") or code.startswith("margin_")
        unit, amount, limit = "px" if pixels else "1", 0.06, 0.05
    elif any(name in texts for name in counted):
        unit, amount, limit = "1", 12.0, 400.0
    elif code in ("scale", "coupling") or "{percent}" in texts:
        unit, amount, deviation = "1", 0.02, 0.001
    elif any(word in code for word in of_joints):
        unit, amount, deviation, limit = "rad", 0.0349, 0.00175, 0.2
    names = {"unused_start": "arm.json", "rejected_poses": "first", "placeholders": "u = 9999"}
    names |= dict.fromkeys(("rejected_profile", "face_turned"), "linear") | {"object_far": "tray"}
    names |= dict.fromkeys(("relaxed", "within_region"), "start")
    names |= {"replanned": "joint limit", "replanned_in_vain": "ahead", "moved_object": "tray"}
    names |= {"other_mount": "tool", "joint_type": "RPR", "whole_seconds": "t_q"}
    joints = (2, 3) if code in ("coupling", "undecided_order") else (2,)
    subject = Subject(joints, ("left", "right"), (5, 6), None, (7, 9), names.get(code, "views"))
    of_part = Subject(views=("left",)) if code == "turned_board" else Subject(markers=(5,))
    others = (Finding("noise", NOTE, of_part, 9.0, limit=12.0, unit="1"),) * 2
    if code in ("relaxed", "no_path", "start_beyond"):
        others = (
            Finding("margin_image", subject=Subject(views=("left",)), amount=3.0, limit=8.0, unit="px"),
        )
    elif code == "rejected_profile":
        others = (Finding("no_coupled_path"),)
    elif code in PLANS:
        at = (("mu_t", 0.8), ("mu_r", 0.5), ("mu_p", 0.5))
        share = {"joint_path": 2.0, "goals_hidden": 3.0, "unknown_image_size": 640.0}.get(code, 0.5)
        parts = (Finding("share", subject=Subject(views=("left",)), amount=share, limit=480.0, unit="1"),)
        moved = (Finding("share", subject=Subject(name=name), amount=amount) for name, amount in at)
        others = tuple(moved) if "{at}" in texts else parts
        if code == "motion_joints":
            others = (Finding("range", amount=-0.785, limit=0.035, unit="rad"), *others)
    if code == "unshown":
        others = (Finding("sag", subject=Subject(joints=(3,)), amount=0.01, unit="rad"),)
    return Finding(code, LIMITS, subject, amount, deviation, limit, unit, 1.5, others)


def findings() -> Iterator[str]:
    """All findings by their codes, each with an example and its remedy."""
    rows = []
    for code in (code for code in ROWS if code != "told"):
        one, setup = example(code), Setup()
        one = dataclasses.replace(one, others=()) if code in DEVIATIONS else one
        said, whole = sentence(one, setup), line(one, setup)
        rows.append((f"`{code}`", text(said), text(whole.removeprefix(said).lstrip(";: "))))
    yield from table(("code", "as in", "remedy"), rows)


WRITERS: dict[str, Callable[[], Iterator[str]]] = {
    "configuration-keys": lambda: keys.all_keys(json_schema()),
    "sweep-keys": lambda: keys.all_keys(sweep_schema()),
    "sweep-columns": sweep_columns,
    "run-file-groups": run_file,
    "commands": commands,
    "equations": equations,
    "verdicts": verdicts,
    "findings": findings,
    "python-interface": python.python_interface,
    "robot-contract": python.robot_contract,
    "law-contract": python.law_contract,
}
