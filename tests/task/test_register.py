"""The register of equations names functions that are there and in use."""

import importlib
import re
from pathlib import Path

import pytest

import projservo_cli
from projservo_cli.cli.equations import REGISTER

LINES = [
    line
    for path in Path(projservo_cli.__file__).parent.rglob("*.py")
    for line in path.read_text(encoding="utf-8").splitlines()
]


@pytest.mark.parametrize("entry", REGISTER, ids=lambda entry: entry.number)
def test_registered_functions_are_there_and_in_use(entry):
    for dotted in entry.functions:
        module, name = dotted.rsplit(".", 1)
        assert callable(getattr(importlib.import_module(module), name)), dotted
        use = re.compile(rf"^(?!\s*def )(?=.*\b{name}\().*")  # called, beside its definition
        assert any(use.match(line) for line in LINES), dotted
