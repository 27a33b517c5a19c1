"""``projservo init``: a configuration to start from."""

from pathlib import Path
from typing import Any

from projservo_cli.cli.output import Console, print_json
from projservo_cli.config.schema import json_schema, schema_text, starter
from projservo_cli.files import replacing
from projservo_cli.records import InputError

DEFAULT = "projservo.yaml"
SCHEMA = "projservo.schema.json"  # as the first line of the starter names it


def run(names: list[str], rest: list[str], options: dict[str, Any]) -> int:
    """Write a commented configuration and its schema; the exit code."""
    del names
    path = Path(rest[0] if rest else DEFAULT)
    if path.is_dir():
        path = path / DEFAULT
    if path.suffix not in (".yaml", ".yml"):
        raise InputError(f"{path}: name a YAML file to write, such as {path.with_suffix('.yaml')}")
    if path.exists() and not options["force"]:
        raise InputError(f"{path}: exists already; choose another name, or replace it with --force")
    schema = path.with_name(SCHEMA)
    for file, text in ((path, starter()), (schema, schema_text(json_schema()))):
        with replacing(file) as temporary:
            temporary.write_text(text, encoding="utf-8")
    if options["json"]:
        print_json({"configuration": path.resolve(), "schema": schema.resolve()})
        return 0
    console = Console(quiet=options["quiet"], verbose=options["verbose"])
    console.show(f"init: {path}, with {schema} for editors")
    console.show(f"next: projservo calibrate plan servo report -c {path}")
    return 0
