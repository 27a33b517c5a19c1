"""Register of the equations of [RH00], as ``equations.yaml`` lists them."""

from dataclasses import dataclass
from pathlib import Path

import yaml


@dataclass(frozen=True)
class _Entry:
    """One equation, or a statement of a section if the number starts with ``§``."""

    number: str
    title: str
    functions: tuple[str, ...]  # dotted names of its implementations: listing them imports nothing
    tests: tuple[str, ...]  # ``file::name`` of those that show it holds
    erratum: str  # the misprint and its correction; may be empty


def _register() -> tuple[_Entry, ...]:
    listed = yaml.safe_load(Path(__file__).with_suffix(".yaml").read_text(encoding="utf-8"))
    return tuple(
        _Entry(
            entry["number"],
            entry["title"],
            tuple(f"projservo_cli.{name}" for name in entry["functions"]),
            tuple(f"tests/{name}" for name in entry["tests"]),
            entry.get("erratum", ""),
        )
        for entry in listed
    )


REGISTER = _register()
