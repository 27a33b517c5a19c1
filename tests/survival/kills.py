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


class Study:
    """Kills of the stages up to the laws within a folder; ``seconds`` is what they take undisturbed."""

    def __init__(self, folder: Path) -> None:
        self._killed = folder / "killed"
        self.references = [folder / f"whole{seed}" for seed in range(2)]
        for seed, reference in enumerate(self.references):
            self._done(self._words(reference, seed))
        self._copy()
        began = time.monotonic()
        self._done(self._words(self._killed, 1))
        self.seconds = time.monotonic() - began

    def _words(self, folder: Path, seed: int) -> list[str]:
        settings = [part for value in (*SETTINGS, f"seed={seed}") for part in ("--set", value)]
        return ["calibrate", "plan", "servo", "-q", "-c", CONFIG, "-o", str(folder), *settings]

    def _done(self, words: list[str]) -> None:
        """Nothing can be told of kills where even an undisturbed call fails."""
        if (ending := call(*words)).code != 0:
            raise SystemExit(ending.err)

    def _copy(self) -> None:
        shutil.rmtree(self._killed, ignore_errors=True)
        shutil.copytree(self.references[0], self._killed)

    def kill(self, moment: float) -> list[str]:
        """Kill a call after so many seconds: all that was wrong after it, and after the next call."""
        self._copy()
        call(*self._words(self._killed, 1), kill_after=moment)
        found = self._damage()
        ending = call(*self._words(self._killed, 1))
        if ending.code != 0:
            found.append(f"the next call: exit code {ending.code}: {ending.err}")
        found += [f"after the next call: {name}" for name in self._damage()]
        return found + [f"left: {path}" for path in files_in(self._killed) ^ files_in(self.references[1])]

    def _damage(self) -> list[str]:
        """Files that are not whole; a lock, or what was being written, begins with a dot."""
        return [
            str(name)
            for name in files_in(self._killed)
            if not name.name.startswith(".") and not _whole(self._killed / name)
        ]


def _whole(path: Path) -> bool:
    try:
        return path.name == "run.h5" and bool(store.load(path).results)
    except InputError:
        return False
