"""Mistaken configurations and tables end in messages, and calls that are killed leave whole files."""

import os
import time
import traceback
from pathlib import Path

import numpy as np
import pytest

from projservo_cli.config import load_config
from projservo_cli.config.schema import starter
from projservo_cli.config.sweep import load_sweep
from projservo_cli.records import InputError
from projservo_cli.store import load
from projservo_cli.tables import read_joints, read_table
from tests.conftest import ROOT
from tests.store.sound import sound_file
from tests.survival.calls import call
from tests.survival.changes import CSV, YAML, Change
from tests.survival.kills import Study

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="calls are forked here")
SECONDS = 30.0  # of the processor; 7 where lines are counted. What unfolds without bounds takes minutes
SAMPLE = 50  # every so many-th goes through the command line


def sources() -> list[tuple[str, bytes, dict[str, Change]]]:
    """Name, content and changes of each sound file."""
    configs = [
        ROOT / "configs" / name for name in ("paper.yaml", "ur5.yaml", "stanford.yaml", "sweep_noise.yaml")
    ]
    found = [(path.name, path.read_bytes(), YAML) for path in configs]
    found.append(("starter.yaml", starter().encode(), YAML))
    rows = [
        f"{k},{m},{0.1 * k},{-0.2 * k},{k + m}.5,{2 * k},{3 * m}.25,4" for k in range(12) for m in range(5)
    ]
    table = "pose,marker,q1,q2,u_left,v_left,u_right,v_right\n" + "\n".join(rows) + "\n"
    joints = "pose,q1,q2\n" + "\n".join(f"{k},{0.1 * k},{0.2 * k}" for k in range(20)) + "\n"
    return [
        *found,
        ("table.csv", table.encode(), CSV),
        ("table.csv", table.encode(), CSV),
        ("joints.csv", joints.encode(), CSV),
    ]


def mutated(number: int) -> tuple[str, str, bytes]:
    """Name, kind of the change and content of the mutated file of a number."""
    rng = np.random.default_rng([30_001, number])
    found = sources()
    name, data, changes = found[number % len(found)]
    kind = [*changes][rng.integers(len(changes))]
    return name, kind, changes[kind](data, rng)


def read(path: Path) -> None:
    """Read a file as the commands do."""
    if path.suffix == ".csv":
        (read_joints if path.name == "joints.csv" else read_table)(path)
    else:
        (load_sweep if path.name.startswith("sweep") else load_config)(path)


def by_command(path: Path, run: Path) -> str:
    """What is wrong with how the command line ends on a file; empty where nothing is."""
    words = {
        "table.csv": ["validate", str(run), "--data", str(path)],
        "joints.csv": ["record", "-n", "--output", "none.csv", "--motions", str(path)],
        "sweep_noise.yaml": ["sweep", "-n", "-c", str(path), "-o", "none"],
    }.get(path.name, ["calibrate", "-n", "-c", str(path), "-o", "none"])
    ending = call(*words)
    return ending.wrong_refusal() if ending.code != 0 else ""


def wrong_reading(path: Path) -> str:
    """What is wrong with how a file is read, or refused; empty where nothing is."""
    began, wrong = time.process_time(), ""
    try:
        read(path)
    except InputError as error:
        if not str(error) or "\n\n" in str(error) or max(map(len, str(error).splitlines())) > 2000:
            wrong = f"message {str(error)[:200]!r}"
    except Exception:
        wrong = traceback.format_exc(limit=-3)
    seconds = time.process_time() - began
    return wrong or (f"{seconds:.1f} s" if seconds > SECONDS else "")


@pytest.mark.parametrize("first", range(0, 200, 100))
def test_mistaken_configurations_and_tables_end_in_messages(tmp_path, first):
    run = tmp_path / "run.h5"
    run.write_bytes(sound_file())
    for number in range(first, first + 100):
        name, kind, data = mutated(number)
        path = tmp_path / name
        path.write_bytes(data)
        wrong = wrong_reading(path) or (by_command(path, run) if number % SAMPLE == 0 else "")
        assert wrong == "", (number, name, kind)


def test_a_refusal_of_the_command_line_is_told_from_an_answer(tmp_path):
    path = tmp_path / "run.h5"
    path.write_bytes(sound_file())
    ending = call("show", str(path), "--json")
    assert (ending.code, ending.err) == (0, "")
    assert ending.wrong_refusal() != ""
    path.write_bytes(sound_file()[:-1])
    assert call("show", str(path), "--json").wrong_refusal() == ""


@pytest.mark.volume
def test_a_killed_call_leaves_whole_files_and_is_finished_by_the_next(tmp_path):
    kills = Study(tmp_path)
    for share in (0.3, 0.8):
        assert kills.kill(share * kills.seconds) == []
    assert load(tmp_path / "killed").traces.keys() == {"direct_three", "stacked"}
