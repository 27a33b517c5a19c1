"""``projservo show``: what a run holds and how it was made."""

from pathlib import Path
from typing import Any

import click

from projservo_cli.cli.options import wrapped
from projservo_cli.cli.output import Console, print_json

DEFAULT = Path("results") / "paper"


def run(names: list[str], rest: list[str], options: dict[str, Any]) -> int:
    """List the results of a run; the exit code."""
    del names
    if rest and options["output"] is not None:
        raise click.UsageError("show takes one run, as an argument or with -o")
    from projservo_cli.cli.words import summary
    from projservo_cli.config import load_config
    from projservo_cli.report.values import stage_object
    from projservo_cli.store import SERVO, load

    found = load(rest[0] if rest else options["output"] or DEFAULT)
    config = load_config(found.path, text=found.configuration)
    laws = list(found.traces)
    stages = list(dict.fromkeys(name.split("/")[0] for name in found.results))
    values = {stage: stage_object(stage, found, config, laws) for stage in stages}
    made = {name: {"key": r.key, **r.provenance} for name, r in found.results.items()}
    if options["json"]:
        settings = config.model_dump(mode="json")
        print_json({"run": found.path.resolve(), "configuration": settings, "made": made, **values})
        return 0
    console = Console(quiet=options["quiet"], verbose=options["verbose"])
    console.show(f"run: {found.path}")
    console.show(wrapped(f"configuration: {config.name}, {'recorded' if config.recorded else 'simulated'}"))
    for stage, value in values.items():
        console.show(summary(stage, value))
        result = found.results[stage if stage in found.results else SERVO + laws[-1]]
        console.show(wrapped(_made(result.provenance), "  "))
    if options["verbose"]:
        console.show(found.configuration.rstrip())
    return 0


def _made(provenance: Any) -> str:
    told = {name: str(value or "") for name, value in provenance.items()}
    commit = told.get("git_commit", "")[:10]
    source = f" at {commit}{' with changes' if told.get('git_dirty') else ''}" if commit else ""
    versions = ", ".join(f"{name} {told.get(name, '?')}" for name in ("python", "numpy", "numba"))
    return (
        f"made {told.get('date', '?')} on {told.get('host', '?')} "
        f"with projservo {told.get('projservo', '?')}{source}, {versions}"
    )
