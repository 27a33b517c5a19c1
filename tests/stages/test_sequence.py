"""Sequences of motions, actions and waiting: one chain of results, which the first that fails stops."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from projservo_cli import cli
from projservo_cli.config import load_config
from projservo_cli.experiment import Experiment
from projservo_cli.records import InputError
from projservo_cli.settings.task import TaskSettings
from projservo_cli.store.run_file import load
from tests.configured import draw_only, truth_of
from tests.conftest import ROOT

pytestmark = pytest.mark.volume  # a calibration and many steps

IN_HOLE = {
    "joints": {"joints": [10, 10, -5, 20, -65, 0], "unit": "deg"},
    "incidences": [["pin", "hole"], ["tip", "bottom"]],
}
STEPS = [
    {"act": {"gripper": 1.0}},
    {"approach": {"along": "pin", "by_m": 0.05, "to": "in_hole"}},
    {"to": "in_hole", "duration_s": 2.5},
    {"act": {"gripper": 0.3}},
    {"wait_s": 0.5},
    {"retreat": {"along": "pin", "by_px": 40.0}},
]
MOTIONS = ["approach_in_hole", "in_hole", "retreat"]
LAW = ["--law", "exact", "--set", "control.mode=[track]"]


START = {"joints": [24.165, 30.041, -44.148, 42.708, -79.537, -93.516], "unit": "deg"}
PUMA = ROOT / "configs" / "insertion.yaml"


@pytest.fixture(scope="module")
def calibrated(calibrated_run):
    """A run with a calibration and nothing else."""
    return calibrated_run("insertion")


@pytest.fixture
def call(projservo, calibrated, monkeypatch, tmp_path):
    """A command on the calibrated run, with another task."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(calibrated, "run")

    def called(*arguments, stage="servo", law=LAW, **task):
        task = {"start": START, "goals": {"in_hole": IN_HOLE}, "steps": STEPS} | task
        named = ["-c", PUMA, "-o", "run", "--set", f"task={json.dumps(task)}"]
        return projservo(stage, *named, *(law if stage == "servo" else ()), *arguments)

    return called


def pin(trace, truth):
    """Both ends (2, 3) of the pin at the end of a run, m."""
    H = trace.pose[-1] @ np.linalg.inv(truth.robot.base_tool)
    return (truth.of((10, 11)) @ H.T)[:, :3]


def test_a_pin_is_brought_before_its_hole_goes_in_and_comes_out_along_it(call, monkeypatch):
    answer = call("--json")
    assert answer.code == 0, answer.err
    steps, laws = answer.json["steps"], answer.json["laws"]
    names = ["01-gripper", "approach_in_hole", "in_hole", "04-gripper", "wait", "retreat"]
    assert [step["name"] for step in steps] == names
    assert [step["kind"] for step in steps] == ["act", "move", "move", "act", "wait", "move"]
    assert {step["verdict"] for step in steps} == {"done", "converged"}
    assert [law["step"] for law in laws] == MOTIONS
    assert max(law["position_error_mm"] for law in laws) < 0.7
    run = load("run")
    assert list(run.results)[1:] == [f"plan/{name}" for name in MOTIONS] + [
        f"servo/{name}{'/exact_track' * (name in MOTIONS)}" for name in names
    ]
    durations = [run.at_step(name).plan.duration for name in MOTIONS]
    assert durations[1] == pytest.approx(2.5)
    assert max(durations[::2]) < 2.0  # none is given
    truth = truth_of(load_config(PUMA))
    before, inside, after = (pin(trace, truth) for trace in run.traces.values())
    axis = (inside[1] - inside[0]) / np.linalg.norm(inside[1] - inside[0])
    assert (inside - before) @ axis == pytest.approx(0.05, abs=1e-3)
    assert np.linalg.norm(np.cross(before - inside[0], axis), axis=1).max() < 1e-3
    assert (inside - after) @ axis == pytest.approx((inside - after)[0] @ axis, rel=1e-2)
    traces = list(run.traces.values())
    assert [trace.free_dof for trace in traces] == [1, 1, 1]
    for earlier, later, name in zip(
        traces, traces[1:], MOTIONS[1:], strict=False
    ):  # each from where it stands
        np.testing.assert_array_equal(later.q[0], earlier.q[-1])
        np.testing.assert_array_equal(run.at_step(name).plan.q_start, earlier.q[-1])
    again = call("--json")
    assert again.code == 0
    assert again.json["steps"] == steps
    assert "up to date" in again.err
    planned = call(stage="plan").out.splitlines()
    assert [line for line in planned if line.startswith("plan of")] == [
        f"plan of {name}:" for name in MOTIONS
    ]
    draw_only(monkeypatch, "fig20_sequence", "fig01_partition")
    assert cli.run(["report", "run", "-q"]) == 0  # names no law: that of the call before
    page = Path("run/report.html").read_text()
    assert "fig20_sequence" in page
    assert "approach_in_hole: exact, following the plan" in page
    assert "the task is a sequence" in page
    dry = call("-n").out
    assert all(f"servo/{name}" in dry for name in names)


def test_the_first_step_that_fails_stops_and_says_what_is_held(call):
    steps = [{"retreat": {"along": "pin", "by_px": 1.0}}, STEPS[3], STEPS[2], {"wait_s": 1.0}]
    law = ["--law", "incidences", "--set", "control.mode=[regulate]", "--set", "stop.max_steps=80"]
    answer = call("--json", steps=steps, law=law)
    assert answer.code == 1
    assert answer.json["failed"] == "servo/in_hole/incidences"
    assert [step["name"] for step in answer.json["steps"]] == ["retreat", "gripper", "in_hole"]
    (line,) = [line for line in answer.err.splitlines() if line.startswith("projservo: servo/in_hole")]
    assert "the gripper stays at 0.3; wait was not begun; the sequence begins again at its first" in line
    assert "ended in max steps" in line
    assert "servo/wait" not in load("run").results


@pytest.mark.parametrize(
    ("task", "words"),
    [
        ({"steps": [{"to": "there"}], "goal": IN_HOLE}, "there is no goal there under task.goals"),
        ({"steps": [{"wait_s": 1.0}], "goal": IN_HOLE}, "no step moves the arm"),
        ({"steps": [{"to": "in_hole", "wait_s": 1.0}]}, "exactly one of to, approach, retreat, act"),
        ({"steps": [{"act": {"gripper": 1}, "duration_s": 2}, STEPS[2]]}, "duration_s: is of a motion"),
        ({"steps": [{"retreat": {"along": "pin"}}, STEPS[2]]}, "give exactly one of by_m and by_px"),
        ({"steps": [{"retreat": {"along": "tip", "by_m": 0.1}}, STEPS[2]]}, "tip is a point, which has no"),
        ({"steps": [{"retreat": {"along": "hook", "by_m": 0.1}}, STEPS[2]]}, "there is no feature hook;"),
        ({"start": "curent"}, "did you mean current?"),
        ({"start": "current", "start_offset": {"joints": [0] * 6, "unit": "rad"}}, "applies to joints"),
        ({"steps": [{"to": "in_hole"}], "start": "nowhere.yaml"}, "there is no .*nowhere.yaml yet: teach"),
    ],
)
def test_what_makes_no_sequence_is_refused_in_one_line(call, task, words):
    answer = call(**task)
    assert answer.code == 2
    assert len(answer.err.strip().splitlines()) == 1
    assert re.search(words, answer.err), answer.err


def test_one_law_drives_a_sequence(call):
    answer = call(law=["--law", "exact"])
    assert answer.code == 2
    assert "task.steps: one law in one mode drives a sequence, and there are exact, exact_track" in answer.err


def test_goals_are_named_one_after_the_other_and_the_first_from_where_the_arm_stands(call):
    goals = {"in_hole": IN_HOLE, "before": {**IN_HOLE, "displaced": {"along": "pin", "by_m": 0.05}}}
    answer = call("--goal", "before", "--goal", "in_hole", "--json", goals=goals, start="current")
    assert answer.code == 0, answer.err
    assert [step["name"] for step in answer.json["steps"]] == ["before", "in_hole"]
    run = load("run")
    at_rest = load_config(PUMA).calibration.reference.values("RRRRRR")
    np.testing.assert_array_equal(run.traces["before/exact_track"].q[0], at_rest)
    alone = call("--goal", "before", "--json", goals=goals, start="current")
    assert alone.code == 0, alone.err
    assert "steps" not in alone.json
    assert [name for name in load("run").results if "/" in name] == ["servo/exact_track"]


def test_goals_are_named_in_python_too(calibrated):
    run = Experiment(load_config(PUMA, ["control.mode=[track]", f"task.goals={json.dumps({'in': IN_HOLE})}"]))
    run._run = load(calibrated)  # which is in memory from here on
    traces = run.servo("in", "goal", law="exact")
    assert [*traces] == ["in/exact_track", "goal/exact_track"]
    np.testing.assert_array_equal(traces["goal/exact_track"].q[0], traces["in/exact_track"].q[-1])
    assert run.at_step("goal").plan.feasible
    assert [*run.at_step("goal").traces] == ["exact_track"]
    with pytest.raises(InputError, match="there is no motion out; motions: in, goal"):
        run.at_step("out")
    with pytest.raises(InputError, match="name a goal or several"):
        run.servo()


def test_a_retreat_leaves_the_goal_before_it_though_another_one_is_alike():
    at, joints = (
        {"retreat": {"along": "pin", "by_px": 40.0}},
        {"joints": {"joints": [0.0, 0.0], "unit": "rad"}},
    )
    pairs = [["pin", "hole"], ["tip", "bottom"]]
    goals = {name: {**joints, "incidences": [pair]} for name, pair in zip("ab", pairs, strict=True)}
    steps = [{"to": "a"}, at, {"to": "b"}, at]
    task = TaskSettings.model_validate(
        {"start": joints["joints"], "goal": goals["b"], "goals": goals, "steps": steps}
    )
    left = [task.at_step(name).goal.incidences for name in ("02-retreat", "04-retreat")]
    assert left == [(("pin", "hole"),), (("tip", "bottom"),)]
