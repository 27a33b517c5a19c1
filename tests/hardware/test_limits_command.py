"""``projservo limits``, ``release`` and ``init --arm`` on an emulated arm, with somebody at the terminal."""

import json
import time
import types

import numpy as np
import pytest
import yaml

from projservo_cli.cli import run
from projservo_cli.config import load_config
from projservo_cli.config.editing import with_limits
from projservo_cli.hardware import so101
from tests.emulated.arm import Arm, Clock
from tests.emulated.servos import Bus

PAIRS = [(-10.0, 20.5), (1.0, 2.0)]
START = (0.0, 10.0, -25.0, 15.0, 0.0)


@pytest.fixture
def arm(tmp_path, monkeypatch):
    """An emulated arm, its configuration arm.yaml in the working folder, and what somebody does at Enters."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(so101.tempfile, "gettempdir", lambda: str(tmp_path))
    monkeypatch.setattr(
        "sys.stdin", types.SimpleNamespace(isatty=lambda: True, readline=lambda: script.pop(0)())
    )
    script = []
    with Bus(Arm(Clock(), START), zeros=(2048, 1800, 2300, 1900, 3000)) as bus:
        monkeypatch.setattr(so101, "candidate_ports", lambda: [bus.port])
        assert run(["init", "--arm", "so101", "arm.yaml"]) == 0
        yield types.SimpleNamespace(bus=bus, script=script, file=tmp_path / "arm.yaml")


def wait_for_readings(bus, count=8):
    """Wait until servos were read so often, as somebody does who moves slowly."""
    now = bus.clock.now()
    while sum(t > now for t, _ in list(bus.servos[1].reads)) < count:
        time.sleep(0.01)


def moved(bus, ways):
    """Somebody moves each joint by ways (n, 2), deg."""

    def move():
        for i, pair in enumerate(ways):
            for angle in pair:
                q = list(START)
                q[i] += angle
                bus.arm.put(q, 600.0)
                while np.abs(np.degrees(bus.arm.q) - q).max() > 0.01:
                    time.sleep(0.01)
                wait_for_readings(bus)
            bus.arm.put(START, 600.0)
            time.sleep(0.3)
        return "\n"

    return move


def test_limits_are_written_where_the_arm_was_moved(arm, capsys):
    ways = [(-60.0, 50.0), (-30, 40), (-40, 30), (-50, 50), (-40, 20)]
    arm.script += [lambda: "\n", moved(arm.bus, ways)]
    before = arm.file.read_text()
    assert run(["limits", "-c", "arm.yaml", "--json"]) == 0
    out = capsys.readouterr().out
    found = json.loads(out[out.index("{") :])["limits_deg"]
    for (low, high), (least, most), sign in zip(found, ways, arm.bus.servos.values(), strict=False):
        assert abs((high - low) - (most - least) + 2.0) < 1.0, sign
    text = arm.file.read_text()
    assert all(line in text for line in before.splitlines())
    assert np.degrees(load_config("arm.yaml", teaching=True).robot.limits.values("RRRRR")).tolist() == [
        pytest.approx(pair) for pair in found
    ]
    assert not arm.bus.arm.torque_on.any()


def test_a_joint_that_was_not_moved_is_named_and_nothing_written(arm, capsys):
    ways = [(-60.0, 50.0), (-30, 40), (-40, 30), (-2, 2), (-40, 20)]
    arm.script += [lambda: "\n", moved(arm.bus, ways)]
    before = arm.file.read_text()
    assert run(["limits", "-c", "arm.yaml"]) == 1
    error = capsys.readouterr().err
    assert "joint 4 (servo 4) was moved by 3.96° (20° at least)" in error or "was moved by 4.0°" in error
    assert "torque is off: nothing holds the arm" in error
    assert arm.file.read_text() == before


def test_a_range_over_the_end_of_a_turn_is_refused_or_shifted(arm, capsys):
    ways = [(-60.0, 50.0), (-30, 40), (-40, 30), (-50, 50), (-30, 120)]
    arm.script += [lambda: "\n", moved(arm.bus, ways)]
    assert run(["limits", "-c", "arm.yaml"]) == 1
    assert "joint 5 (servo 5) was moved over the end of its turn" in capsys.readouterr().err
    assert arm.bus.servos[5].get(31) == 0
    arm.script += [lambda: "\n", moved(arm.bus, ways)]
    assert run(["limits", "-c", "arm.yaml", "--shift", "5"]) == 0
    assert arm.bus.servos[5].get(31) != 0
    assert arm.bus.servos[5].memory[55] == 1  # locked again
    low, high = np.degrees(load_config("arm.yaml", teaching=True).robot.limits.values("RRRRR"))[4]
    assert abs(low + high) < 2.0
    assert abs(high - low - 148.0) < 1.5


def test_all_that_answer_are_released_and_the_others_named(arm, capsys):
    """With limits the wrong way round in the file, which nothing else takes."""
    text = arm.file.read_text()
    arm.file.write_text(with_limits(text, [(10.0, -10.0)] * 5, "arm.yaml"))
    for servo in arm.bus.servos.values():
        servo.write(40, b"\1")
    arm.bus.faults.missing = (2, 6)
    arm.script += [lambda: "\n"]
    assert run(["release", "-c", "arm.yaml"]) == 1
    assert "no answer from joint 2 (servo 2) and servo 6: look" in capsys.readouterr().err
    assert [i for i, servo in arm.bus.servos.items() if servo.on] == [2, 6]


@pytest.mark.parametrize(
    ("registers", "said"),
    [((0, 0), "stores other limits, 0 to 0 counts"), ((2500, 4095), "2500 to 4095")],
)
def test_limits_that_a_servo_stores_are_named_where_they_cut(arm, capsys, registers, said):
    for address, value in zip((9, 11), registers, strict=True):
        arm.bus.servos[2].put(address, 2, value)
    arm.script += [lambda: "\n", moved(arm.bus, [(-15.0, 15.0)] * 5)]
    before = arm.file.read_text()
    assert run(["limits", "-c", "arm.yaml"]) == 1
    assert said in capsys.readouterr().err
    assert arm.file.read_text() == before


@pytest.mark.parametrize("command", ["limits", "release"])
def test_nobody_at_the_terminal_lets_go_of_no_arm(arm, capsys, command):
    for servo in arm.bus.servos.values():
        servo.write(40, b"\1")
    arm.script += [lambda: ""]
    assert run([command, "-c", "arm.yaml"]) == 2
    assert "standard input ended before Enter" in " ".join(capsys.readouterr().err.split())
    assert all(servo.on for servo in arm.bus.servos.values())


@pytest.mark.parametrize(
    "text",
    [
        "name: x # c\nplant: so101\n",
        "robot:\n  # hi\n  limits:\n    joints: [[1, 2]]\n    unit: deg\n  # tail\n# more\ntask: {a: 1}\n",
        "robot:\n  name: foo # n\ntask: 1\n",
        "robot: {name: foo}\n",
        "robot: {limits: {from_data: 0.1}} # z\n",
        "robot: {}\ntask: 1\n",
        "robot:\ntask: 1 # c\n",
    ],
)
def test_limits_take_their_place_in_a_file_and_all_else_stays(text):
    edited = with_limits(text, PAIRS, "f.yaml")
    before, after = yaml.safe_load(text), yaml.safe_load(edited)
    assert after["robot"].pop("limits") == {"joints": [list(pair) for pair in PAIRS], "unit": "deg"}
    (before.get("robot") or {}).pop("limits", None)
    assert after == before | {"robot": before.get("robot") or {}}
    comments = [line.partition("#")[2] for line in text.splitlines() if "#" in line]
    assert all(f"#{comment}" in edited for comment in comments)
