"""``projservo compare``: runs side by side on one page."""

from pathlib import Path
from typing import Any

import click

from projservo_cli.cli.output import Console, print_json
from projservo_cli.records import InputError

DEFAULT = "compare.html"


def run(names: list[str], rest: list[str], options: dict[str, Any]) -> int:
    """Write the page; the exit code."""
    del names
    if len(rest) < 2:
        raise click.UsageError("compare needs two runs or more: projservo compare RUN RUN")
    from projservo_cli.report.page import write_comparison
    from projservo_cli.store import load

    path = Path(options["output"] or DEFAULT)
    if path.suffix != ".html":
        raise InputError(f"{path}: name a page to write, such as {path.name or 'runs'}.html")
    if path.exists() and not options["force"]:
        raise InputError(f"{path}: exists already; choose another with -o, or replace it with --force")
    runs = [load(target) for target in rest]
    write_comparison(runs, path)
    if options["json"]:
        print_json({"page": path.resolve(), "runs": [found.path.resolve() for found in runs]})
        return 0
    Console(quiet=options["quiet"], verbose=options["verbose"]).show(f"compare: {len(runs)} runs: {path}")
    return 0
