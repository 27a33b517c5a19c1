"""Calls ended by the system at random moments: ``python -m tests.survival.kills 200`` kills so many.

Calls, in turn, work in a folder that holds a complete run of another seed: ``stages`` up to the laws and
``report`` of a recorded calibration; further arguments name others, such as ``all`` for the whole chain. Each
is killed (SIGKILL) at a random moment. Then every file must be the complete old or the complete new one, and
the same call must finish and leave nothing behind that does not belong there. The exit code is 1 where
that failed.
"""

import contextlib
import os
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from projservo_cli import store
from projservo_cli.records import InputError
from tests.conftest import ROOT
from tests.survival.calls import call, prepare, start

FRAMES, FORMATS = "calibration.frames_per_joint=4", "report.formats=[svg, png]"
SIMULATED = (
    *(FRAMES, FORMATS, "stop.max_steps=12", "control.laws=[direct_three, stacked]"),
    *("control.must_converge=[]", "control.observation=points", "trajectory.samples=6"),
)
STAGES = {"stages": ("calibrate", "plan", "servo"), "all": ("calibrate", "plan", "servo", "report")}
CONFIG = str(ROOT / "configs" / "paper.yaml")


def _set(*values: str) -> list[str]:
    return [part for value in values for part in ("--set", value)]


def files_in(folder: Path) -> set[Path]:
    """All files of a folder, relative to it."""
    return {path.relative_to(folder) for path in folder.rglob("*") if path.is_file()}


class Study:
    """Kills of one kind of call within a folder; ``seconds`` is what it takes undisturbed."""

    def __init__(self, folder: Path, kind: str) -> None:
        self.folder, self.kind = folder, kind
        self.references = [folder / f"{kind}{seed}" for seed in range(2)]
        for seed, reference in enumerate(self.references):
            table = str(folder / f"trials{seed}.csv")
            self._done(["record", "-c", CONFIG, "--output", table, *_set(f"seed={seed}", FRAMES), "--force"])
            self._done(self._words(reference, seed))
        self._copy()
        began = time.monotonic()
        self._done(self._words(self._killed, 1))
        self.seconds = time.monotonic() - began

    @property
    def _killed(self) -> Path:
        return self.folder / "killed"

    def _words(self, folder: Path, seed: int) -> list[str]:
        """The call that works in a folder; a report is that of the recorded table of the seed."""
        if self.kind == "report":
            data = ["--data", str(self.folder / f"trials{seed}.csv"), *_set("name=recorded", FORMATS)]
            return ["calibrate", "report", *data, "-q", "-o", str(folder)]
        settings = _set(*SIMULATED, f"seed={seed}")
        return [*STAGES[self.kind], "-q", "-c", CONFIG, "-o", str(folder), *settings]

    def _done(self, words: list[str]) -> None:
        """Nothing can be told of kills where even an undisturbed call fails."""
        if (ending := call(*words)).code != 0:
            raise SystemExit(ending.err)

    def _copy(self) -> None:
        shutil.rmtree(self._killed, ignore_errors=True)
        shutil.copytree(self.references[0], self._killed)

    def kill(self, moment: float) -> tuple[bool, list[str]]:
        """Kill a call after so many seconds: whether it still ran, and all that was wrong after it."""
        self._copy()
        process = start(*self._words(self._killed, 1))
        time.sleep(moment)
        with contextlib.suppress(ProcessLookupError):
            os.kill(process.process, signal.SIGKILL)
        ran = process.end().code == -signal.SIGKILL
        found = self._damage(self.references)
        ending = call(*self._words(self._killed, 1))
        if ending.code != 0:
            found.append(f"the next call: exit code {ending.code}: {ending.err}")
        found += [f"after the next call: {name}" for name in self._damage(self.references[1:])]
        return ran, found + [
            f"left: {path}" for path in files_in(self._killed) ^ files_in(self.references[1])
        ]

    def _damage(self, references: list[Path]) -> list[str]:
        """Files that are neither the complete old nor the complete new ones."""
        found = []
        for name in files_in(self._killed):
            with contextlib.suppress(FileNotFoundError):  # a helper of the call has just replaced it
                # A lock, or what was being written, begins with a dot.
                if not name.name.startswith(".") and not _complete(self._killed / name, name, references):
                    found.append(str(name))
        return found


def _complete(path: Path, name: Path, references: list[Path]) -> bool:
    """Whether a file is one of the complete ones; those that tell the date, whether they are whole."""
    if path.name == "run.h5":
        try:
            return bool(store.load(path).results)
        except InputError:
            return False
    if path.name == "report.html":
        return path.read_text(encoding="utf-8").endswith("</html>\n")
    others = [reference / name for reference in references]
    return path.read_bytes() in [other.read_bytes() for other in others if other.exists()]


def study(count: int, kinds: Sequence[str], seed: int = 1) -> int:
    """Kill so many calls and print what was found; the number of those after which something was wrong."""
    prepare()
    rng = np.random.default_rng(seed)
    running = wrong = 0
    with tempfile.TemporaryDirectory() as name:
        studies = [Study(Path(name), kind) for kind in kinds]
        for number in range(count):
            kills = studies[number % len(studies)]
            moment = float(rng.uniform(0.0, kills.seconds))
            ran, found = kills.kill(moment)
            running, wrong = running + ran, wrong + bool(found)
            if found:
                print(f"kill {number}, {kills.kind} after {moment:.2f} s: {'; '.join(found)}", flush=True)
    print(f"{count} kills, {running} while the call ran: {wrong} left something wrong")
    return wrong


if __name__ == "__main__":
    sys.exit(study(int(sys.argv[1]), sys.argv[2:] or ["stages", "report"]) > 0)
