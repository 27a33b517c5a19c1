"""Fixtures every test may use, and the rule for tests that need the compiler."""

import contextlib
import io
import json
import os
import signal
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from filelock import FileLock
from hypothesis import settings

# A busy machine is no failure; what fifty draws do not find the draws of other runs do.
settings.register_profile("tests", deadline=None, max_examples=50)
settings.load_profile("tests")

# In the background of a shell SIGINT is ignored, and by all children: tests of what it does need it back.
signal.signal(signal.SIGINT, signal.default_int_handler)

ROOT = Path(__file__).parents[1]
SHARED = ROOT.parent / "shared" / "data"
CONFIGS = sorted((ROOT / "configs").glob("*.yaml"))
SWEEPS = [path for path in CONFIGS if path.match("sweep_*") or path.stem == "benchmark"]
SHIPPED = [path for path in CONFIGS if path not in SWEEPS]  # configurations of single runs
INTERPRETED = os.environ.get("NUMBA_DISABLE_JIT", "0") not in {"", "0"}


def pytest_collection_modifyitems(items):
    """Skip tests of many runs where each would take a thousand times longer."""
    if not INTERPRETED:
        return
    skip = pytest.mark.skip(reason="many closed loops: only with the compiler (NUMBA_DISABLE_JIT is set)")
    for item in items:
        if item.get_closest_marker("volume"):
            item.add_marker(skip)


@pytest.fixture(scope="session")
def shared_data():
    """Folder of reference data beside the repository; skips where it is absent."""
    if not SHARED.is_dir():
        pytest.skip(f"reference data not found at {SHARED}")
    return SHARED


@pytest.fixture(scope="session")
def reference_truth(shared_data):
    """Function that reads the true screws, cameras and tasks of a reference robot."""

    def read(name):
        with open(shared_data / name / "truth.json", encoding="utf-8") as file:
            return json.load(file)

    return read


@pytest.fixture(scope="session", autouse=True)
def quick():
    """Nothing is forced onto the disk, which may take its time; no figure is drawn by another process."""
    from projservo_cli.report import figure_processes
    from projservo_cli.store import files_and_locks

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(files_and_locks, "_synchronise", lambda path: None)
        patch.setattr(figure_processes, "PROCESSORS", 1)
        yield


@pytest.fixture
def rng():
    """Random numbers that are the same in every run."""
    return np.random.default_rng(20000626)


@dataclass
class Answer:
    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        def refuse(constant: str) -> None:
            raise AssertionError(f"{constant} is not strict JSON")

        return json.loads(self.out, parse_constant=refuse)


@pytest.fixture
def projservo(capsys):
    """Function that calls the command line in this process."""

    def call(*arguments: Any) -> Answer:
        from projservo_cli import cli

        capsys.readouterr()
        code = cli.run([str(argument) for argument in arguments])
        captured = capsys.readouterr()
        return Answer(code, captured.out, captured.err)

    return call


@pytest.fixture(scope="session")
def made_once(tmp_path_factory):
    """Function that has a folder of a name made once for all processes that test."""
    base = tmp_path_factory.getbasetemp()
    root = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base

    def once(name, make):
        folder, made = root / name, root / f"{name}.made"
        with FileLock(root / f"{name}.lock"):
            if not made.exists():
                folder.mkdir(exist_ok=True)  # of an attempt that failed
                make(folder)
                made.touch()
        return folder

    return once


@pytest.fixture(scope="session")
def first_chain(made_once):
    """Folder of the first chain of README, to be copied; with what it printed in told.txt."""
    from projservo_cli import cli

    def make(folder):
        told = io.StringIO()
        with contextlib.redirect_stdout(told), contextlib.redirect_stderr(told):
            stages = ["calibrate", "plan", "servo", "report"]
            code = cli.run([*stages, "-c", str(ROOT / "configs" / "paper.yaml"), "-o", str(folder)])
        assert code == 0, told.getvalue()
        (folder / "told.txt").write_text(told.getvalue(), encoding="utf-8")

    return made_once("first", make)


@pytest.fixture(scope="session")
def calibrated_run(made_once):
    """Function that gives the folder of a run of a shipped configuration, with a calibration and no more."""
    from projservo_cli import cli

    def calibrated(name):
        words = ["calibrate", "-q", "-c", str(ROOT / "configs" / f"{name}.yaml"), "-o"]

        def make(folder):
            assert cli.run([*words, str(folder)]) == 0

        return made_once(f"calibrated {name}", make)

    return calibrated
