"""``projservo export``: all arrays of a run as CSV, MATLAB or NumPy files."""

from pathlib import Path
from typing import Any

import click

from projservo_cli.cli.output import Console, print_json
from projservo_cli.records import InputError

DEFAULTS = {"csv": "csv", "mat": "run.mat", "npz": "run.npz"}


def run(names: list[str], rest: list[str], options: dict[str, Any]) -> int:
    """Write the files; the exit code."""
    del names
    kind = options["to"]
    if not rest:
        raise click.UsageError("export needs a run: projservo export RUN --to csv")
    if kind is None:
        raise click.UsageError(f"export needs a kind of file: --to {', --to '.join(DEFAULTS)}")
    from projservo_cli.export import WRITERS
    from projservo_cli.store import load

    found = load(rest[0])
    path = Path(options["output"]) if options["output"] else found.path.parent / DEFAULTS[kind]
    if kind != "csv" and path.suffix != f".{kind}":
        raise InputError(f"{path}: name a file to write that ends in .{kind}")
    if path.exists() and not options["force"]:
        raise InputError(f"{path}: exists already; choose another with -o, or replace it with --force")
    files = WRITERS[kind](found, path)
    if options["json"]:
        print_json({"run": found.path.resolve(), "files": [file.resolve() for file in files]})
        return 0
    console = Console(quiet=options["quiet"], verbose=options["verbose"])
    console.show(f"export: {len(files)} file{'s' * (len(files) > 1)}: {path}")
    return 0
