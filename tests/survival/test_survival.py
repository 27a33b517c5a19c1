"""Mistaken configurations and tables end in messages, and calls that are killed leave whole files."""

import multiprocessing
import os
import shutil
import subprocess
import sys
import time
import traceback
from pathlib import Path

import numpy as np
import pytest

from projservo_cli import cli
from projservo_cli.config import load_config, load_sweep
from projservo_cli.config.schema import starter
from projservo_cli.records import InputError
from projservo_cli.store.observation_tables import read_joint_list, read_table
from projservo_cli.store.run_file import load
from tests.conftest import ROOT
from tests.survival.changes import CSV, YAML, Change

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="calls are forked here")
SECONDS = 30.0  # of the processor; 7 where lines are counted. What unfolds without bounds takes minutes


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
        (read_joint_list if path.name == "joints.csv" else read_table)(path)
    else:
        (load_sweep if path.name.startswith("sweep") else load_config)(path)


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


def test_mistaken_configurations_and_tables_end_in_messages(tmp_path):
    for number in range(32):
        name, kind, data = mutated(number)
        path = tmp_path / name
        path.write_bytes(data)
        assert wrong_reading(path) == "", (number, name, kind)


SETTINGS = (
    *("calibration.frames_per_joint=4", "control.laws=[direct_three, stacked]", "stop.max_steps=12"),
    *("control.must_converge=[]", "control.features=points", "trajectory.n_samples=6"),
)


def call(folder: Path, seed: int, kill_after: float | None = None) -> int | None:
    """Call the stages in a forked process, where nothing has to be imported anew: the exit code."""
    settings = [part for value in (*SETTINGS, f"seed={seed}") for part in ("--set", value)]
    config = str(ROOT / "configs" / "paper.yaml")
    words = ["calibrate", "plan", "servo", "-q", "-c", config, "-o", str(folder), *settings]
    child = multiprocessing.get_context("fork").Process(target=lambda: sys.exit(cli.run(words)))
    child.start()
    child.join(kill_after)
    child.kill()
    child.join()
    return child.exitcode


@pytest.mark.volume
def test_a_killed_call_leaves_whole_files_and_is_finished_by_the_next(tmp_path):
    """In a folder that holds a complete run of another seed."""
    whole, folder = tmp_path / "whole", tmp_path / "killed"
    assert call(whole, 0) == 0
    shutil.copytree(whole, folder)
    began = time.monotonic()
    assert call(folder, 1) == 0
    seconds = time.monotonic() - began
    shutil.rmtree(folder)
    shutil.copytree(whole, folder)
    call(folder, 1, 0.5 * seconds)
    # A lock, or what was being written, begins with a dot.
    assert [path.name for path in folder.iterdir() if path.name[0] != "."] == ["run.h5"]
    assert load(folder).results
    assert call(folder, 1) == 0
    assert [path.name for path in folder.iterdir()] == ["run.h5"]
    assert load(folder).traces.keys() == {"direct_three", "stacked"}


def test_an_interrupted_sweep_ends_although_a_worker_has_sent_a_part_of_its_result():
    command = [sys.executable, "-m", "tests.survival.half_a_result"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 1
    assert done.stderr.startswith("interrupted")
