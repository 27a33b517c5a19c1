"""``projservo schema``: the JSON Schema of a configuration or of a sweep."""

from pathlib import Path
from typing import Any

import click

from projservo_cli.cli.output import print_json
from projservo_cli.config.schema import json_schema, schema_text, sweep_schema


def run(names: list[str], rest: list[str], options: dict[str, Any]) -> int:
    """Print the schema, or write it into a file; the exit code."""
    del names
    if rest not in ([], ["sweep"]):
        raise click.UsageError(f"schema takes nothing or sweep, got {rest[0]}")
    schema = sweep_schema() if rest else json_schema()
    if options["output"] is None:
        print_json(schema)
        return 0
    from projservo_cli.files import replacing

    with replacing(Path(options["output"])) as path:
        path.write_text(schema_text(schema), encoding="utf-8")
    return 0
