"""Calls that are killed while they work in a folder that holds a complete run of another seed."""

import multiprocessing
import shutil
import sys
import time
from pathlib import Path

from projservo_cli import cli, store
from projservo_cli.records import InputError
from tests.conftest import ROOT

SETTINGS = (
    *("calibration.frames_per_joint=4", "control.laws=[direct_three, stacked]", "stop.max_steps=12"),
    *("control.must_converge=[]", "control.features=points", "trajectory.n_samples=6"),
)
CONFIG = str(ROOT / "configs" / "paper.yaml")


def files_in(folder: Path) -> set[Path]:
    """All files of a folder, relative to it."""
    return {path.relative_to(folder) for path in folder.rglob("*") if path.is_file()}


def call(folder: Path, seed: int, kill_after: float | None = None) -> int | None:
    """Call the stages in a forked process, where nothing has to be imported anew: the exit code."""
    settings = [part for value in (*SETTINGS, f"seed={seed}") for part in ("--set", value)]
    words = ["calibrate", "plan", "servo", "-q", "-c", CONFIG, "-o", str(folder), *settings]
    child = multiprocessing.get_context("fork").Process(target=lambda: sys.exit(cli.run(words)))
    child.start()
    child.join(kill_after)
    child.kill()
    child.join()
    return child.exitcode


def damage(folder: Path) -> list[str]:
    """Files that are not whole; a lock, or what was being written, begins with a dot."""
    found = []
    for name in files_in(folder):
        try:
            whole = name.name.startswith(".") or (name.name == "run.h5" and store.load(folder / name).results)
        except InputError:
            whole = False
        found += [] if whole else [str(name)]
    return found


def killed(folder: Path, shares: tuple[float, ...]) -> list[list[str]]:
    """What was wrong after a call was killed in ``folder`` at each share of its time, and after the next."""
    whole = [folder.with_name(f"whole{seed}") for seed in range(2)]

    def finished(target: Path, seed: int) -> float:
        began = time.monotonic()
        assert call(target, seed) == 0
        return time.monotonic() - began

    def begun_anew() -> None:
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(whole[0], folder)

    for seed, target in enumerate(whole):
        finished(target, seed)
    begun_anew()
    seconds = finished(folder, 1)
    told = []
    for share in shares:
        begun_anew()
        call(folder, 1, share * seconds)
        found = damage(folder)
        finished(folder, 1)
        found += [f"after the next call: {name}" for name in damage(folder)]
        told.append(found + [f"left: {path}" for path in files_in(folder) ^ files_in(whole[1])])
    return told
