"""What a result was made with."""

import json
import platform
import subprocess
from pathlib import Path

import numpy as np
import pytest

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


def test_it_names_the_commit_of_a_checkout():
    if not (ROOT / ".git").exists():
        pytest.skip("not a checkout")
    head = subprocess.run(
        ["git", "-C", ROOT, "rev-parse", "HEAD"], capture_output=True, text=True, check=True
    )
    provenance._git.cache_clear()
    found = provenance.collect(seed=0)
    assert found["git_commit"] == head.stdout.strip()
    assert isinstance(found["git_dirty"], bool)


def test_without_a_checkout_or_a_package_there_is_nothing_to_name(monkeypatch, tmp_path):
    monkeypatch.setattr(provenance, "__file__", str(tmp_path / "package" / "provenance.py"))
    monkeypatch.setattr(provenance, "_PACKAGES", ("no-such-package",))
    provenance._git.cache_clear()
    found = provenance.collect(seed=0)
    provenance._git.cache_clear()
    assert (found["git_commit"], found["git_dirty"], found["no-such-package"]) == (None, None, None)
