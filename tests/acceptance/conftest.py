"""The command line in this process, in a folder of each test's own."""

import json

import pytest

from projservo_cli import cli
from tests.conftest import SHARED


@pytest.fixture
def elsewhere(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    return tmp_path


@pytest.fixture
def answer(elsewhere, capsys):
    """Exit code, JSON and messages of a call."""

    def call(*arguments):
        capsys.readouterr()
        code = cli.run([str(argument) for argument in (*arguments, "--json")])
        captured = capsys.readouterr()
        return code, json.loads(captured.out) if captured.out else None, captured.err

    return call


@pytest.fixture
def case(elsewhere):
    """Function that gives the folder of a case by name; skips where it is absent."""

    def folder(name):
        path = SHARED.parent / "cases" / name
        if not path.is_dir():
            pytest.skip(f"case not found at {path}")
        return path

    return folder


@pytest.fixture
def entered(elsewhere, case):
    """Function that copies the files of a case by name into the working folder."""

    def enter(name):
        for file in case(name).iterdir():
            (elsewhere / file.name).write_bytes(file.read_bytes())

    return enter
