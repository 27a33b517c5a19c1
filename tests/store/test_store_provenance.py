"""What a result was made with."""

import json
import platform
from pathlib import Path

import numpy as np

from projservo_cli import __version__, provenance

ROOT = Path(__file__).parents[2]


def test_it_names_versions_machine_command_and_seed(monkeypatch):
    monkeypatch.setattr("sys.argv", ["projservo", "servo"])
    found = provenance.collect(seed=7)
    assert json.loads(json.dumps(found)) == found
    assert (found["projservo"], found["python"]) == (__version__, platform.python_version())
    assert found["numpy"] == np.__version__
    assert (found["seed"], found["argv"]) == (7, ["projservo", "servo"])
    assert found["host"] == platform.node()
    assert found["cpu"]
    assert "T" in found["date"]
