"""Test every command of README."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest

import projservo_cli
from tests import check
from tests.configured import draw_only
from tests.documentation.blocks import PAGES, ROOT, blocks_of, matches, run_commands

README = ROOT / "README.md"


def blocks(language):
    return [block.text for block in blocks_of(README) if block.language == language]


ENVIRONMENT, MINE, CHECKS = blocks("sh")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with the shipped configurations and nothing else, where commands are run in turn."""
    path = tmp_path_factory.mktemp("readme")
    (path / "configs").symlink_to(ROOT / "configs")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(path)
        yield path


def test_both_first_commands_are_those_of_the_newcomer():
    lines = (ROOT / ".ci" / "run").read_text(encoding="utf-8").splitlines()
    commands = [line for line in lines if line.startswith((".venv", "python3"))]
    assert commands == [ENVIRONMENT.strip(), CHECKS.strip()]


def test_the_documentation_is_a_check_by_itself():
    assert "documentation" in check.TOGETHER
    assert "python -m tests.check documentation" in README.read_text(encoding="utf-8")


@pytest.mark.volume
def test_the_output_of_the_first_command_and_python(folder, first_chain, capsys):
    (shown,) = blocks("text")
    assert matches(shown, (first_chain / "told.txt").read_text(encoding="utf-8"))
    (code,) = blocks("python")
    exec(compile(code, "README.md", "exec"), names := {})
    assert "converged" in capsys.readouterr().out
    assert names["pixels"].shape == (2, 10, 2)
    assert np.isfinite(names["sigma"]).all()


@pytest.mark.volume
def test_your_own_arm_in_five_commands(shared_data, tmp_path, monkeypatch, capsys):
    """The class of the guide and the configuration as they stand, without a model of robot or cameras."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    (robot,) = (block.text for block in blocks_of(PAGES["robot-class"]) if block.file == "my_robot.py")
    (tmp_path / "my_robot.py").write_text(robot, encoding="utf-8")
    draw_only(monkeypatch, "fig13_calibration")
    simulated = blocks("yaml")[0].replace("{port: /dev/ttyUSB0}", "{truth: truth.json}")
    (tmp_path / "mine.yaml").write_text(simulated, encoding="utf-8")
    (tmp_path / "truth.json").symlink_to(shared_data / "ur5" / "truth.json")
    monkeypatch.setattr("sys.stdin", SimpleNamespace(isatty=lambda: True, readline=lambda: "\n"))
    monkeypatch.setattr("click.confirm", lambda question, **_: True)
    run_commands(MINE)
    said = capsys.readouterr().err.splitlines()  # a recording, a goal and a law
    ends = ["ready", "at rest", "closed"]
    assert [line for line in said if line in ends] == ends * 3
    assert projservo_cli.load("results/mine").traces["exact"].verdict == "converged"
    assert (tmp_path / "results" / "mine" / "report.html").is_file()


def test_readme_is_short_and_its_example_too():
    assert len(README.read_text(encoding="utf-8").splitlines()) <= 160
    (robot,) = (block.text for block in blocks_of(PAGES["robot-class"]) if block.file == "my_robot.py")
    assert len([line for line in robot.splitlines() if line.strip()]) <= 36
    assert "projservo" not in robot
    assert len(MINE.splitlines()) == 5


def test_every_block_is_known():
    assert [block.language for block in blocks_of(README)] == [
        "sh",
        "yaml",
        "sh",
        "text",
        "sh",
        "python",
        "bibtex",
    ]
