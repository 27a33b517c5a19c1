"""``projservo schema``: the JSON Schema of the configuration."""

from pathlib import Path
from typing import Any

from projservo_cli.cli.output import print_json
from projservo_cli.config.schema import json_schema, schema_text


def run(names: list[str], rest: list[str], options: dict[str, Any]) -> int:
    """Print the schema, or write it into a file; the exit code."""
    del names, rest
    if options["output"] is None:
        print_json(json_schema())
        return 0
    from projservo_cli.files import replacing

    with replacing(Path(options["output"])) as path:
        path.write_text(schema_text(), encoding="utf-8")
    return 0
