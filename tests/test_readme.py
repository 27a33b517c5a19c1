"""What the README says can be done is done."""

import shutil
import sys

import numpy as np
import pytest

import projservo_cli
from projservo_cli.config import load_config
from tests import check
from tests.documentation.blocks import ROOT, blocks_of, run_commands

README = ROOT / "README.md"


def blocks(language):
    return [block.text for block in blocks_of(README) if block.language == language]


ENVIRONMENT, CHECKS, *COMMANDS = blocks("sh")


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


SERVO, PAGES, RECORD, DRIVE, SWEEP = COMMANDS


def test_a_recording(folder, capsys):
    run_commands(RECORD)
    assert "usable" in capsys.readouterr().out


def test_the_documentation_is_a_check_by_itself():
    *command, name = PAGES.split()
    assert command == CHECKS.split()[-3:]
    assert name in check.CHECKS


@pytest.mark.volume
def test_commands_that_run_laws_and_what_is_read_from_python(folder, first_chain, capsys):
    shutil.copytree(first_chain, folder / "results" / "paper")
    run_commands(SERVO)
    capsys.readouterr()
    names = {}
    for block in blocks("python"):
        exec(compile(block, "README.md", "exec"), names)
    assert "converged" in capsys.readouterr().out
    assert names["pixels"].shape == (2, 10, 2)
    assert np.isfinite(names["sigma"]).all()


@pytest.mark.volume
def test_a_sweep(folder, capsys):
    run_commands(SWEEP)
    told = capsys.readouterr().out
    assert "sweep: 36 runs in 9 cells, all runs are done" in told
    assert "report: 36 of 36 runs" in told
    assert (folder / "results" / "sweep_noise-17" / "run.h5").is_file()


@pytest.mark.volume
def test_a_robot_of_yours(shared_data, tmp_path, monkeypatch, capsys):
    """The example as it stands: recorded, calibrated and driven without a model of robot or cameras."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    (robot,) = (block for block in blocks("python") if "class UR5" in block)
    (tmp_path / "my_robot.py").write_text(robot, encoding="utf-8")
    (tmp_path / "mine.yaml").write_text(blocks("yaml")[0], encoding="utf-8")
    (tmp_path / "truth.json").symlink_to(shared_data / "ur5" / "truth.json")
    run_commands(DRIVE)
    said = capsys.readouterr().err.splitlines()  # once a recording and once a law
    ends = ["ready", "at rest", "closed"]
    assert [line for line in said if line in ends] == ends * 3
    run = projservo_cli.load("results/mine")
    assert {name: trace.verdict for name, trace in run.traces.items()} == {
        "direct_three": "converged",
        "exact": "converged",
    }
    task = load_config("mine.yaml").task
    for trace in run.traces.values():
        np.testing.assert_allclose(trace.q[0], task.start.joints, atol=1e-3)
        # The goal is predicted from 0.5 px of noise, far from the reference: about a pixel, half a degree.
        # Nothing tells of joint limits, so a joint may arrive a whole turn away.
        turns = (trace.q[-1] - task.goal.joints.joints) / (2 * np.pi)
        np.testing.assert_allclose(2 * np.pi * (turns - np.round(turns)), 0.0, atol=np.radians(1.0))
    limit = np.radians(125.0) * 0.5
    assert np.abs(run.traces["direct_three"].q_dot).max() <= limit * (1 + 1e-12)


def test_the_example_is_short():
    (robot,) = (block for block in blocks("python") if "class UR5" in block)
    assert len([line for line in robot.splitlines() if line.strip()]) <= 36
    assert "projservo" not in robot


def test_every_block_is_known():
    assert len(blocks("python")) == 2
    assert len(blocks("yaml")) == 1
    assert "servo" in SERVO
