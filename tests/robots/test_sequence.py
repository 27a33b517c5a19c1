"""Sequences on a robot of somebody's: one connection, and a grip that is kept on every way out."""

import json

import numpy as np
import pytest

from projservo_cli.config import load_config
from projservo_cli.store.run_file import load
from tests.configured import truth_of
from tests.robots.conftest import UR5
from tests.robots.robots import CALLS
from tests.robots.test_servo import HERE, OPTIONS, commands

pytestmark = pytest.mark.volume  # a calibration and many steps

GOALS = {
    "near": {"joints": {"joints": [3.66, -1.68, -1.65, 0.28, 1.26, 3.43], "unit": "rad"}},
    "there": {
        "joints": {"joints": [3.46, -1.78, -1.55, 0.08, 1.36, 3.33], "unit": "rad"},
        "incidences": [["plate", "wall", "parallel"], ["middle", "spot"]],
    },
}
FEATURES = {
    "plate": {"on": "tool", "plane": [0, 1, 2]},
    "wall": {"on": "scene", "plane": "plate"},
    "middle": {"on": "tool", "point": [0, 1, 2, 3]},
    "spot": {"on": "scene", "point": "middle"},
}
BACK = {"retreat": {"along": "plate", "by_m": 0.03}}
STEPS = [
    {"act": {"gripper": 1}},
    {"to": "near"},
    {"to": "there"},
    {"act": {"gripper": 0.3}},
    {"wait_s": 0.2},
    BACK,
]


def asked(robot="Gripping", options="", **task):
    """Options of the command line for a sequence."""
    task = {"start": "current", "goals": GOALS, "steps": STEPS} | task
    values = {"features": FEATURES, "task": task}
    plant = f"plant={{use: '{HERE}:{robot}', {OPTIONS}{options}}}}}"
    return [
        "--set",
        plant,
        "--set",
        "control.gain=8",
        *(f"--set={key}={json.dumps(value)}" for key, value in values.items()),
        "--json",
    ]


def once(name):
    return [call for call in CALLS if isinstance(call, str)].count(name)


def test_one_connection_serves_plans_motions_and_actions(servo, projservo):
    answer = servo(*asked(), law="exact")
    assert answer.code == 0, answer.err
    names = ["01-gripper", "near", "there", "04-gripper", "wait", "retreat"]
    assert [(step["name"], step["verdict"]) for step in answer.json["steps"]] == [
        (name, "converged" if name in ("near", "there", "retreat") else "done") for name in names
    ]
    assert [step["seconds"] for step in answer.json["steps"] if step["kind"] != "move"] == [0.4, 0.4, 0.2]
    assert [once(call) for call in ("open", "stop", "close", "gripper 1", "gripper 0.3")] == [1] * 5
    assert CALLS[-2:] == ["stop", "close"]
    first = next(i for i, call in enumerate(CALLS) if isinstance(call, tuple))
    assert CALLS.index("gripper 1") < first  # held from where it stood, with the gripper open
    held = commands()[: round(0.4 / 0.04)]
    assert max(np.abs(sent.step).max() for sent in held) == 0.0
    # The retreat is along the normal, as far as asked for, from where the arm stands.
    arm, traces = truth_of(load_config(UR5)).robot, load("run").traces
    before, after = (arm.pose(traces[f"{name}/exact"].q[-1]) for name in ("there", "retreat"))
    moved = np.linalg.inv(before) @ after
    assert np.linalg.norm(moved[:3, 3]) == pytest.approx(0.03, abs=2e-3)
    assert np.degrees(np.arccos(moved[2, 2])) < 0.5  # the turn about the normal stays free
    assert [trace.free_dof for trace in traces.values()] == [None, 1, 1]
    calls = len(CALLS)
    alone = projservo("plan", "-o", "run", "--force")  # which would read where the arm stands
    assert alone.code == 2
    assert "is named by the stored run alone, which starts no code" in alone.err
    assert len(CALLS) == calls


def test_an_interrupt_keeps_the_grip_and_says_so(servo):
    answer = servo(*asked(options=", interrupted: 15"), law="exact")
    assert answer.code == 130
    assert CALLS[-2:] == ["stop", "close"]
    said = " ".join(answer.err.split())
    held = "the gripper stays at 1; there, 04-gripper, wait, retreat were not begun"
    assert f"servo/near/exact: interrupted; {held}" in said
    assert once("gripper 0.3") == 0


def test_a_robot_without_actions_is_refused_before_it_moves(servo):
    answer = servo(*asked("Sound"), law="exact")
    assert answer.code == 2
    assert "has no act(), which task.steps need: leave gripper out" in answer.err
    assert not commands()
