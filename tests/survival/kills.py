"""Calls that are killed while they work in a folder that holds a complete run of another seed."""

import shutil
import time
from pathlib import Path

from projservo_cli import store
from projservo_cli.records import InputError
from tests.conftest import ROOT
from tests.survival.calls import call

SETTINGS = (
    *("calibration.frames_per_joint=4", "control.laws=[direct_three, stacked]", "stop.max_steps=12"),
    *("control.must_converge=[]", "control.observation=points", "trajectory.samples=6"),
)
CONFIG = str(ROOT / "configs" / "paper.yaml")


def files_in(folder: Path) -> set[Path]:
    """All files of a folder, relative to it."""
    return {path.relative_to(folder) for path in folder.rglob("*") if path.is_file()}


def words(folder: Path, seed: int) -> list[str]:
    settings = [part for value in (*SETTINGS, f"seed={seed}") for part in ("--set", value)]
    return ["calibrate", "plan", "servo", "-q", "-c", CONFIG, "-o", str(folder), *settings]


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
        ending = call(*words(target, seed))
        assert ending.code == 0, ending.err
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
        call(*words(folder, 1), kill_after=share * seconds)
        found = damage(folder)
        finished(folder, 1)
        found += [f"after the next call: {name}" for name in damage(folder)]
        told.append(found + [f"left: {path}" for path in files_in(folder) ^ files_in(whole[1])])
    return told
