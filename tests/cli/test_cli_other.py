"""The commands validate, show and equations."""

import ast
import importlib
import re
from pathlib import Path

import numpy as np
import pytest

from projservo_cli.cli.equations import REGISTER
from projservo_cli.config import load_config
from projservo_cli.store.run_file import load

ROOT = Path(__file__).parents[2]


def test_validate_prints_the_statistics_of_a_table(projservo, reported, statistics, tmp_path):
    for run in (["out"], ["out/run.h5"], ["-o", "out"], ["-o", "out/run.h5"]):
        answer = projservo("validate", *run, "--data", "t.csv", "--json")
        assert answer.json == {
            "run": str(tmp_path / "out/run.h5"),
            **statistics,
            "p95_px": None,
            "findings": [],
        }
    answer = projservo("validate", "out", "--data", "t.csv")
    told = " ".join(answer.out.split())
    assert "2 marker-view pairs; skipped: 1 unknown marker, 0 behind camera, 3 missing" in told
    assert "median 0.25" in told
    assert "1.5 px allowed: 3 times the stated error of 0.3 px and the noise of these images, 0.4 px" in told
    assert (answer.code, answer.err) == (0, "")
    for median, code in ((1.5, 0), (1.51, 1)):
        statistics["median_px"] = median
        answer = projservo("validate", "out", "--data", "t.csv", "--json")
        assert (answer.code, answer.json["median_px"]) == (code, median)
        assert ("median 1.51 px, 1.5 px allowed" in answer.err) == (code == 1)
    statistics["median_px"], (left, right) = 0.25, statistics["views"]
    assert "left camera" not in projservo("validate", "out", "--data", "t.csv").out  # sound: no line a view
    right |= {"count": 1, "median_px": 2.0, "limit_px": 1.2}  # of fewer rows, which the pooled median hides
    answer = projservo("validate", "out", "--data", "t.csv")
    assert (answer.code, "left camera: median 0.25 px of 2 pairs, 1.5 px" in answer.out) == (1, True)
    assert "right camera: median 2 px, 1.2 px allowed" in " ".join(answer.err.split())
    assert "projservo calibrate out --refit right --data t.csv" in " ".join(answer.err.split())
    assert "left camera" not in answer.err
    left |= {"median_px": 1.6}  # both: no camera alone
    assert "--refit" not in projservo("validate", "out", "--data", "t.csv").err
    statistics["limit_px"] = None  # as of poses without a pair
    assert projservo("validate", "out", "--data", "t.csv", "--json").code == 0
    (tmp_path / "one.csv").write_text("pose,marker,q1,u_left,v_left,u_right,v_right\n0,0,1,2,3,4,5\n")
    answer = projservo("validate", "out", "--data", "one.csv")
    assert answer.code == 2
    assert "1 joint columns" in answer.err


def test_show_tells_what_a_run_holds(projservo, reported, tmp_path):
    (tmp_path / "out").rename(tmp_path / "paper")
    (tmp_path / "results").mkdir()
    (tmp_path / "paper").rename(tmp_path / "results/paper")
    value = projservo("show", "--json").json  # the default of -o
    assert value["run"] == str(tmp_path / "results/paper/run.h5")
    assert value["configuration"]["name"] == "tiny"
    assert list(value["made"]) == ["calibrate", "plan", "servo/direct_three", "servo/stacked", "report"]
    assert value["made"]["plan"]["seed"] == 0
    known = {"projservo", "python", "numpy", "numba", "git_commit", "git_dirty", "argv", "host", "date"}
    assert known <= set(value["made"]["plan"])
    text = projservo("show", "results/paper/run.h5").out
    assert "tiny, simulated" in text
    assert [line for line in text.splitlines() if len(line) > 80] == []
    assert "gain_t: 2.5" in projservo("show", "results/paper", "-v").out


# Statements on what the laws integrate to, and a section of one symbol: no function computes them by itself.
CONSEQUENCES = {"21", "22", "§2"}


@pytest.fixture(scope="module")
def called():
    """Names that the package calls, beside where they are defined."""
    lines = (path.read_text(encoding="utf-8") for path in (ROOT / "projservo_cli").rglob("*.py"))
    return set(re.findall(r"(?<!def )\b(\w+)\(", "\n".join(lines)))


@pytest.mark.parametrize("entry", REGISTER, ids=lambda entry: entry.number)
def test_the_register_names_tests_and_functions_that_are_there_and_name_the_equation(entry, called):
    assert entry.functions
    named = set()
    for dotted in entry.functions:
        module, name = dotted.rsplit(".", 1)
        assert name in called, dotted
        words = getattr(importlib.import_module(module), name).__doc__
        named |= set(re.findall(r"\(([0-9]+)\)", words)) | set(re.findall(r"section ([0-9.]+[0-9])", words))
        for first, last in re.findall(r"\(([0-9]+)\)–\(([0-9]+)\)", words):
            named |= {str(i) for i in range(int(first), int(last) + 1)}
    assert entry.number.removeprefix("§") in named or entry.number in CONSEQUENCES
    for test in entry.tests:
        file, name = test.split("::")
        tree = ast.parse((ROOT / file).read_text(encoding="utf-8"))
        assert name in {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}, test


def test_a_goal_is_taught_and_told(projservo, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    at = ("--at", "20,-5,5,-10,80", "--at-unit", "deg", "--frames", "3")
    hobby = ("teach", "-c", ROOT / "configs" / "hobby.yaml")
    answer = projservo(*hobby, *at, "--json")
    assert answer.code == 0, answer.err
    assert answer.json["frames"] == [3, 3]
    assert np.degrees(answer.json["joints"]) == pytest.approx([20, -5, 5, -10, 80])
    assert (answer.json["reached"], answer.json["far"], answer.json["unseen"]) == (None, None, [])
    text = (tmp_path / "goal.yaml").read_text()
    named = ("--set", "task.goals={there: there.yaml}", "-o")
    for file, said in (
        ("there.yaml", "goal there: taught"),
        ("x.yaml", f"set task.goals.x: {tmp_path}/x.yaml"),
    ):
        assert projservo(*hobby, *at, *named, file).out.splitlines()[-1] == said
    again = projservo(*hobby, *at)
    assert (again.code, "goal.yaml: exists already" in again.err) == (2, True)
    assert projservo(*hobby, *at, "--force", "-q").code == 0
    assert (tmp_path / "goal.yaml").read_text() == text
    for wrong, told in (
        ((), "give the joints"),
        (("--at", "1,2,x"), "a number for each joint"),
        (("--at", "1,2"), "2 numbers for 5 joints"),
        (("--at", "0,0,0,0,nan"), "--at: joint 5 is nan"),
        (("--at", "inf,0,0,0,0"), "--at: joint 1 is inf"),
        (("--at", "20,-5,5,-10,80"), "--at-unit deg"),
        (("--at", "0,0,0,0,9"), "beyond its limits"),
        (("--at", "900,0,0,0,0", "--at-unit", "deg"), "beyond its limits"),
    ):
        refused = projservo(*hobby, *wrong, "-o", "other.yaml")
        assert (refused.code, refused.out, refused.err.count("\n")) == (2, "", 1)
        assert told in refused.err
    assert not (tmp_path / "other.yaml").exists()


PICK = """\
images:
  markers: [0, 1, 2]
  left: [[10.0, 20.0], [30.0, 20.0], [10.0, 40.0]]
  right: [[12.0, 20.0], [32.0, 20.0], [12.0, 40.0]]
  joints: {joints: [0.3, 0.1], unit: rad}
"""


def test_servo_goes_to_a_taught_goal_by_its_name(projservo, stages, tmp_path):
    (tmp_path / "pick.yaml").write_text(PICK, encoding="utf-8")
    answer = projservo("servo", "-c", "tiny.yaml", "-o", "out", "--goal", "pick", "-q")
    assert answer.code == 0, answer.err
    images = load_config("out", text=load("out").configuration).task.goal.images
    assert images.left == ((10.0, 20.0), (30.0, 20.0), (10.0, 40.0))
    again = projservo("servo", "-c", "tiny.yaml", "-o", "out", "--goal", "pick.yaml")
    assert "up to date" in again.err
    other = projservo("servo", "-c", "tiny.yaml", "-o", "out", "--goal", "place")
    assert other.code == 2
    assert "place.yaml yet: teach it first, before a recording: projservo teach -c FILE -o " in other.err


def test_a_report_of_a_folder_that_is_not_there_takes_it_for_no_sweep(projservo, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for more in ((), ("--set", "seed=2")):
        answer = projservo("report", "nowhere", *more)
        assert answer.code == 2
        assert "nowhere: there is no such folder: name the folder of a run" in " ".join(answer.err.split())
    assert not list(tmp_path.iterdir())
