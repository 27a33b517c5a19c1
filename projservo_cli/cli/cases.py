"""``projservo cases``: degenerate and adverse tasks, and what becomes of them."""

import csv
from pathlib import Path
from typing import Any

from projservo_cli.cli.configuration import SHIPPED, given_overrides, shipped
from projservo_cli.cli.output import Console, plain, print_json
from projservo_cli.config import load_config
from projservo_cli.records import InputError

COLUMNS = (
    "verdict",
    "steps",
    "position_error_mm",
    "rotation_error_deg",
    "self_occluded_steps_left",
    "self_occluded_steps_right",
    "reason",
)


def run(names: list[str], rest: list[str], options: dict[str, Any]) -> int:
    """Run all cases and print the table; the exit code."""
    del names, rest
    console = Console(quiet=options["quiet"], verbose=options["verbose"])
    path = Path(options["output"]) if options["output"] else None
    if path is not None and path.exists() and not options["force"]:
        raise InputError(f"{path}: exists already; choose another with -o, or replace it with --force")
    overrides = given_overrides(options)
    base = load_config(shipped(SHIPPED), overrides)
    from projservo_cli.stages import calibrate
    from projservo_cli.stages.cases import CASES, UNLIMITED, run_cases

    configs = [(case, load_config(shipped(SHIPPED), [*UNLIMITED, *overrides, *case.sets])) for case in CASES]
    console.say(f"{len(CASES)} cases on one calibration of the paper's arm")
    try:
        _, calibration, _ = calibrate.run(base)
        rows = run_cases(configs, calibration, console.progress)
    finally:
        console.finish()
    found = [
        {
            "case": row.case.name,
            "sets": list(row.case.sets),
            "refused": row.refused or None,
            "laws": {
                law: {name: getattr(trace, name) for name in COLUMNS} for law, trace in row.traces.items()
            },
        }
        for row in rows
    ]
    if path is not None:
        _write(path, found)
    if options["json"]:
        print_json({"cases": found})
        return 0
    _show(console, found)
    if path is not None:
        console.show(f"cases: {path}")
    return 0


def _show(console: Console, rows: list[dict[str, Any]]) -> None:
    """The table, a row a case."""
    from projservo_cli.stages.cases import LAWS

    console.show(f"{'':38}" + "".join(f"{law:44}" for law in LAWS).rstrip())
    head = f"{'verdict':14}{'steps':>5}{'mm':>9}{'deg':>9}{'occl.':>6} "
    console.show(f"{'case':38}" + (head * len(LAWS)).rstrip())
    for row in rows:
        console.show(f"{row['case']:38}" + (_cells(row) or f"refused: {row['refused']}"))


def _cells(row: dict[str, Any]) -> str:
    """Verdict, steps, errors and self-occluded steps of both cameras, for each law."""
    return "".join(
        f"{run['verdict']:14}{run['steps']:5}{run['position_error_mm']:9.3g}{run['rotation_error_deg']:9.3g}"
        f"{run['self_occluded_steps_left'] + run['self_occluded_steps_right']:6} "
        for run in row["laws"].values()
    ).rstrip()


def _write(path: Path, rows: list[dict[str, Any]]) -> None:
    """The table as CSV: a row a case, the columns of each law after its name."""
    from projservo_cli.files import replacing
    from projservo_cli.stages.cases import LAWS

    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(["case", "refused", *(f"{law}_{name}" for law in LAWS for name in COLUMNS)])
        for row in rows:
            values = [row["laws"].get(law, {}).get(name) for law in LAWS for name in COLUMNS]
            table.writerow([row["case"], row["refused"] or "", *plain(values)])
