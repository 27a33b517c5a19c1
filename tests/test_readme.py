"""What the README says can be done is done."""

import json
import re
import shlex
import sys
from pathlib import Path

import numpy as np
import pytest

import projservo_cli
from projservo_cli import cli
from projservo_cli.config import load_config
from projservo_cli.stages.truth import truth_of
from tests.detection.rendering import render, square

ROOT = Path(__file__).parents[1]


def blocks(language):
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```$", text, flags=re.MULTILINE | re.DOTALL)


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


def show_tags(folder):
    """Two pairs of images with a tag, and their joint readings."""
    cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed: pip install 'projservo[detect]'")
    tags = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    for side in ("left", "right"):
        (folder / "images" / side).mkdir(parents=True)
        for k in range(2):
            image = render(cv2, tags, (160, 120), [(k, square((80 + 5 * k, 60), 50, 0.2 * k))])
            (folder / "images" / side / f"{k}.png").write_bytes(cv2.imencode(".png", image)[1].tobytes())
    (folder / "readings.csv").write_text("q1,q2\n0.1,0.2\n0.1,0.3\n")


def show_sheet(folder):
    """The simulated robot of a configuration as a data sheet."""
    truth = truth_of(load_config(folder / "configs" / "stanford.yaml"))
    twists = truth.robot.H_hat_0
    sheet = {
        "screws": [{"w": [T[2, 1], T[0, 2], T[1, 0]], "v": T[:3, 3].tolist()} for T in twists],
        "q_reference": truth.robot.q_reference.tolist(),
        "camera_left": truth.P[0].tolist(),
        "camera_right": truth.P[1].tolist(),
        "markers_tool": truth.M[:, :3].tolist(),
        "marker_numbers": list(truth.number),
        "T_base_tool_at_reference": np.eye(4).tolist(),
    }
    (folder / "sheet.json").write_text(json.dumps(sheet))


def run_all(block):
    for line in block.splitlines():
        program, *words = shlex.split(line, comments=True)
        assert program == "projservo"
        assert cli.run(words) == 0, line


DRIVE = next(block for block in COMMANDS if "mine.yaml" in block)
SERVO, *REST = sorted((block for block in COMMANDS if block != DRIVE), key=lambda block: "servo" not in block)


@pytest.mark.parametrize("block", REST, ids=lambda block: block.split()[1])
def test_commands(folder, block, capsys):
    if "detect" in block:
        show_tags(folder)
    if "--init" in block:
        show_sheet(folder)
    run_all(block)
    assert capsys.readouterr().out


@pytest.mark.volume
def test_commands_that_run_laws_and_what_is_read_from_python(folder, capsys):
    pytest.importorskip("xarray")
    pytest.importorskip("h5netcdf")
    assert cli.run(["servo", "--law", "direct_two", "-q"]) == 0  # part of the first command
    run_all(SERVO)
    capsys.readouterr()
    names = {}
    for block in blocks("python"):
        exec(compile(block, "README.md", "exec"), names)
    assert "converged" in capsys.readouterr().out
    assert names["pixels"].shape == (2, 10, 2)
    assert np.isfinite(names["rates"]).all()


@pytest.mark.volume
def test_a_robot_of_yours(shared_data, tmp_path, monkeypatch, capsys):
    """The example as it stands: recorded, calibrated and driven without a model of robot or cameras."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    (robot,) = (block for block in blocks("python") if "class UR5" in block)
    (tmp_path / "my_robot.py").write_text(robot, encoding="utf-8")
    (tmp_path / "mine.yaml").write_text(blocks("yaml")[0], encoding="utf-8")
    (tmp_path / "truth.json").symlink_to(shared_data / "ur5" / "truth.json")
    run_all(DRIVE)
    assert capsys.readouterr().out.count("at rest") == 3  # once a recording and once a law
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
    assert len([line for line in robot.splitlines() if line.strip()]) <= 32
    assert "projservo" not in robot


def test_every_block_is_known():
    assert len(COMMANDS) == 5
    assert len(blocks("python")) == 3
    assert len(blocks("yaml")) == 1
    assert "servo" in SERVO
