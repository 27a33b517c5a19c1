"""The ten commands of the tutorial of the SO-101, typed on an emulated arm and two emulated webcams."""

import json
import os
import re
import time
import types
from contextlib import contextmanager
from itertools import pairwise

import numpy as np
import pytest

from projservo_cli.cli import run
from projservo_cli.hardware import feetech, so101
from projservo_cli.records import InputError
from tests.documentation.blocks import PAGES, blocks_of
from tests.emulated.arm import Arm, Clock, Mechanics
from tests.emulated.cameras import Cameras, Optics
from tests.emulated.servos import Bus

START, GOAL = (0.0, 10.0, -25.0, 15.0, 0.0), (16.0, -2.0, -2.0, -6.0, 35.0)
RATE, DRAWING = 0.7, 0.4  # of the emulated clock, and the share of a processor that drawing may take
# What makes the recording short, and the tags as large as those of the emulator.
SHORTER = {
    "amplitude_deg: 20": "amplitude_deg: 18",
    "frames_per_joint: 6": "frames_per_joint: 2\n  random_poses: 3",
    "averaged_frames: 5": "averaged_frames: 2\n  timeout_s: 10",
    "tag_size_m: 0.03": "tag_size_m: 0.04",
}


def commands():
    """The commands of the page, as lists of words."""
    lines = "\n".join(block.text for block in blocks_of(PAGES["so101"])).splitlines()
    return [line.split()[1:] for line in lines if line.startswith("projservo ")]


def shown():
    """What the page shows that a command prints, by the command."""
    blocks = list(blocks_of(PAGES["so101"]))
    return {before.text.split()[1]: block.text for before, block in pairwise(blocks) if block.excuse}


def without_numbers(text):
    """The first line, which says what became of the command."""
    return re.sub(r"[\d.]+", "#", text.splitlines()[0])


def by_hand(arm, *ways):
    """Somebody who moves an arm to one pose after the other (n,), deg."""

    def move():
        for q in ways:
            arm.put(q, 300.0)
            while np.abs(np.degrees(arm.q) - q).max() > 0.01:
                arm.clock.sleep(0.02)
                arm.advance()
            arm.clock.sleep(0.2)

    return move


def through_all(span=75.0):
    """Poses of one joint after the other at both ends of what is allowed, deg."""
    ends = [np.array(START) + side * span * row for row in np.eye(5) for side in (-1, 1, 0)]
    return [np.clip(q, -130.0, 130.0) for q in ends]


def until_taught(arm):
    """Commands from an empty folder to a taught goal, and what a person does at each Enter."""
    return (
        (["init", "--arm", "so101", "arm.yaml"], []),
        (["limits", "-c", "arm.yaml"], [None, by_hand(arm, *through_all())]),
        (["teach", "--start", "-c", "arm.yaml"], [None, by_hand(arm, START), None]),
        (["teach", "-c", "arm.yaml"], [None, by_hand(arm, GOAL), None]),
    )


@contextmanager
def benched(folder, monkeypatch, rate=RATE, rate_hz=15.0, settings=()):
    """An emulated arm with its cameras, and somebody who presses Enter, in a folder.

    settings : of its configuration, ``a.b=v``.
    """
    monkeypatch.chdir(folder)
    clock = Clock(rate)
    monkeypatch.setattr(so101.tempfile, "gettempdir", lambda: str(folder))
    # Compiling and importing take the bus, which is in this process, its turn for seconds.
    monkeypatch.setattr(feetech, "_PATIENCE_S", 5.0)
    monkeypatch.setattr(so101.SO101, "now", staticmethod(clock.now))
    monkeypatch.setattr(so101.SO101, "sleep", staticmethod(clock.sleep))
    script = []

    def enter():
        if script and (act := script.pop(0)):
            act()
        return "\n"

    monkeypatch.setattr("sys.stdin", types.SimpleNamespace(isatty=lambda: True, readline=enter))
    arm = Arm(clock, START, Mechanics(), settings)
    with Bus(arm) as bus, Cameras(arm, Optics(rate_hz=rate_hz)) as cameras:
        begun = time.process_time()
        time.sleep(1.0)
        clock.slow_down(min(1.0, DRAWING / (time.process_time() - begun)))
        monkeypatch.setattr(so101, "candidate_ports", lambda: [bus.port])
        yield types.SimpleNamespace(arm=arm, bus=bus, cameras=cameras, script=script, folder=folder)


def configure(bench, shorter, *, alone=False):
    """Put the streams of the emulator, and what makes its recording short, into arm.yaml.

    alone : whether there is one camera, ``top``.
    """
    file = bench.folder / "arm.yaml"
    text = file.read_text()
    for before, after in shorter.items():
        assert before in text
        text = text.replace(before, after)
    text = text.replace("source: 0", f"source: '{bench.cameras.left}'")
    if alone:
        text = re.sub(r"  right: .*\n", "", text).replace("  left: ", "  top: ")
    file.write_text(text.replace("source: 2", f"source: '{bench.cameras.right}'"))


@pytest.fixture
def bench(tmp_path, monkeypatch):
    """An emulated arm on its bench."""
    try:
        with benched(tmp_path, monkeypatch) as found:
            yield found
    except InputError as error:
        pytest.skip(str(error))


@pytest.mark.skipif(os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="plans and drives")
def test_ten_commands_lead_from_an_empty_folder_to_the_taught_goal(bench, capsys):
    arm = bench.arm
    acts = {
        "limits": [None, by_hand(arm, *through_all())],
        "teach --start": [None, by_hand(arm, START), None],
        "teach": [None, by_hand(arm, GOAL), lambda: setattr(bench, "taught", arm.link.copy())],
    }
    given = commands()
    assert [words[0] for words in given][:10] == [
        *("init", "tags", "limits", "teach", "teach", "doctor", "record", "plan", "servo", "release")
    ]
    printed = {}
    for words in given[:10]:
        bench.script[:] = acts.get(" ".join(words[: 1 + ("--start" in words)]), [])
        begun = time.monotonic()
        assert run(words) == 0, f"{words}: {''.join(capsys.readouterr())}"
        printed[words[0]] = capsys.readouterr()
        with capsys.disabled():
            print(f"{words[0]} {time.monotonic() - begun:.0f} s", flush=True)
        if words[0] == "init":
            configure(bench, SHORTER)
        if words[0] == "servo":
            bench.reached = arm.link.copy()
    assert "torque is on: the arm holds" in printed["servo"].err
    assert "torque is off" in printed["release"].err
    for command, text in shown().items():
        if command != "doctor":  # the emulated cameras are slow
            assert without_numbers(text) == without_numbers(printed[command].out)
    assert "\ncalibrate: usable: predicts images to " in printed["record"].out
    off = np.degrees(np.abs(bench.reached - bench.taught))
    assert off.max() < 1.5, off  # of 1° of hysteresis and 2° of sag; joints make up for each other
    _homed_since(bench, capsys)


def test_one_webcam_is_enough_to_teach_record_and_calibrate(bench, capsys):
    arm = bench.arm
    for words, acts in (
        *until_taught(arm),
        (["record", "calibrate", "-c", "arm.yaml", "-o", "run"], []),
    ):
        bench.script[:] = acts
        assert run(words) == 0, f"{words}: {''.join(capsys.readouterr())}"
        told = capsys.readouterr().out
        with capsys.disabled():
            print(told, flush=True)
        if words[0] == "init":
            more = SHORTER | {"frames_per_joint: 6": "frames_per_joint: 4\n  random_poses: 12"}
            configure(bench, more, alone=True)
        if words[0] == "record":
            assert "calibrate: usable" in told
            assert "by one camera: top" in told
    assert "u_top,v_top,sigma_top" in (bench.folder / "trials.csv").read_text().splitlines()[0]


def test_a_camera_that_moved_is_refitted_by_the_commands_of_doctor_and_stays_so(bench, capsys):
    """What doctor prints is typed, then servo with the configuration that knows nothing of it."""
    arm = bench.arm

    def call(words, code=0):
        given = run(words)
        told = capsys.readouterr()
        with capsys.disabled():
            print(" ".join(words), told.out, told.err, sep="\n", flush=True)
        assert given == code, f"{words}: {told}"
        return told

    for words, acts in (
        *until_taught(arm),
        (["record", "calibrate", "-c", "arm.yaml", "-o", "results/arm"], []),
    ):
        bench.script[:] = acts
        call(words)
        if words[0] == "init":
            configure(bench, SHORTER)
    call(["calibrate", "results/arm", "--refit", "left", "--data", "trials.csv", "-o", "results/still"], 1)
    assert not (bench.folder / "results/still/run.h5").exists()
    bench.cameras.shift[0] = 12, -7
    time.sleep(2.0)
    mend = json.loads(call(["doctor", "-c", "arm.yaml", "--json", "results/arm"], 1).out)["refit"]
    assert mend["view"] == "left"
    for command in mend["commands"]:
        call(command.split()[1:])
    # The goal shows the left camera where it stood before.
    assert "teach it again" in call(["plan", "-c", "arm.yaml", "-o", "results/arm_refit"], 1).err
    bench.script[:] = [None, by_hand(arm, GOAL), None]
    call(["teach", "results/arm_refit", "-c", "arm.yaml", "--force"])
    told = call(["servo", "-c", "arm.yaml", "-o", "results/arm_refit"])
    assert "calibrate: making" not in told.err
    assert "converged" in told.out


def _homed_since(bench, capsys):
    """An arm that was homed after it was recorded is named before anything moves."""
    servo = bench.bus.servos[3]
    servo.put(31, 2, 40)
    written = len(bench.bus.writes)
    assert run(["servo", "-c", "arm.yaml", "--json", "--force"]) == 1
    told = capsys.readouterr()
    changed = r"readings mean something else .* servo3:.*offset0/mode0 is now servo3:.*offset40/mode0"
    assert re.search(changed, told.err)
    assert json.loads(told.out)
    assert not [row for row in bench.bus.writes[written:] if row[2] == 42]
