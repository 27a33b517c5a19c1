"""Calls ended by the system at random moments: ``python -m tests.survival.kills 200`` kills so many.

Calls, in turn, work in a folder that holds a complete run of other settings: ``stages`` up to the laws and
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
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from projservo_cli import store
from projservo_cli.records import InputError
from tests.conftest import ROOT
from tests.survival.calls import Ending, call, prepare, start

SIMULATED = (
    "stop.max_steps=12",
    "control.laws=[direct_three, stacked]",
    "control.must_converge=[]",
    "control.observation=points",
    "trajectory.samples=6",
)
SHARED = ("calibration.frames_per_joint=4", "report.formats=[svg, png]")
CALLS = {
    "stages": ("calibrate", "plan", "servo"),
    "report": ("calibrate", "report", "--data", "{table}", "--set", "name=recorded"),
    "all": ("calibrate", "plan", "servo", "report"),
}
CONFIG = ROOT / "configs" / "paper.yaml"
DATED = ("run.h5", "report.html")  # files that tell when they were made


def arguments(kind: str, folder: Path, seed: int) -> list[str]:
    """A call that works in a folder; a recorded one reads the table of its seed beside the folder."""
    table = folder.parent / f"trials{seed}.csv"
    words = [word.format(table=table) for word in CALLS[kind]]
    if kind == "report":
        return [*words, "-q", "-o", str(folder), "--set", SHARED[1]]
    settings = [part for value in (*SHARED, *SIMULATED, f"seed={seed}") for part in ("--set", value)]
    return [*words, "-q", "-c", str(CONFIG), "-o", str(folder), *settings]


def recorded(folder: Path, seed: int) -> list[str]:
    """The call that records the table of a seed."""
    table = str(folder / f"trials{seed}.csv")
    return ["record", "-c", str(CONFIG), "--output", table, "--set", f"seed={seed}", "--set", SHARED[0]]


def complete(path: Path, references: list[Path]) -> bool:
    """Whether a file is one of the complete ones; those that tell the date, whether they are whole."""
    if path.name == "run.h5":
        try:
            return bool(store.load(path).results)
        except InputError:
            return False
    if path.name in DATED:
        return path.read_text(encoding="utf-8").endswith("</html>\n")
    return path.read_bytes() in [other.read_bytes() for other in references if other.exists()]


def files_in(folder: Path) -> set[Path]:
    """All files of a folder, relative to it."""
    return {path.relative_to(folder) for path in folder.rglob("*") if path.is_file()}


def killed(folder: Path, kind: str, moment: float) -> bool:
    """Kill a call after so many seconds; whether it still ran."""
    process = start(*arguments(kind, folder, 1))
    time.sleep(moment)
    with contextlib.suppress(ProcessLookupError):
        os.kill(process.process, signal.SIGKILL)
    return process.end().code == -signal.SIGKILL


def damage(folder: Path, references: list[Path]) -> list[str]:
    """Files of a folder that are neither the complete old nor the complete new ones."""
    found = []
    for name in files_in(folder):
        if name.name.startswith("."):
            continue  # a lock, or what was being written
        try:
            if not complete(folder / name, [reference / name for reference in references]):
                found.append(str(name))
        except FileNotFoundError:  # a figure that the second process of the call has just replaced
            pass
    return found


def require_done(ending: Ending) -> None:
    """Nothing can be told of kills where even an undisturbed call fails."""
    if ending.code != 0:
        raise SystemExit(ending.err)


@dataclass
class Study:
    """Kills of some calls within a folder.

    Attributes
    ----------
    folder : of all that is made.
    seconds : that each call takes undisturbed, once it is timed.
    """

    folder: Path
    seconds: dict[str, float] = field(default_factory=dict)

    def reference(self, kind: str, seed: int) -> Path:
        """Folder of a complete run."""
        return self.folder / f"{kind}{seed}"

    def begin(self, kinds: Sequence[str]) -> None:
        """Make the complete runs, and time the change from one to the other."""
        for seed in range(2):
            require_done(call(*recorded(self.folder, seed)))
            for kind in kinds:
                require_done(call(*arguments(kind, self.reference(kind, seed), seed)))
        for kind in kinds:
            folder = self.copy(kind)
            began = time.monotonic()
            require_done(call(*arguments(kind, folder, 1)))
            self.seconds[kind] = time.monotonic() - began

    def copy(self, kind: str) -> Path:
        """A complete run of other settings, to be worked on."""
        folder = self.folder / "killed"
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(self.reference(kind, 0), folder)
        return folder

    def kill(self, kind: str, moment: float) -> tuple[bool, list[str]]:
        """Kill a call after so many seconds: whether it still ran, and all that was wrong after it."""
        folder, references = self.copy(kind), [self.reference(kind, seed) for seed in range(2)]
        ran = killed(folder, kind, moment)
        found = damage(folder, references)
        ending = call(*arguments(kind, folder, 1))
        if ending.code != 0:
            found.append(f"the next call: exit code {ending.code}: {ending.err}")
        found += [f"after the next call: {path}" for path in damage(folder, references[1:])]
        return ran, found + [f"left: {path}" for path in files_in(folder) ^ files_in(references[1])]


def study(count: int, kinds: Sequence[str], seed: int = 1) -> int:
    """Kill so many calls and print what was found; the number of those after which something was wrong."""
    prepare()
    rng = np.random.default_rng(seed)
    running = wrong = 0
    with tempfile.TemporaryDirectory() as name:
        kills = Study(Path(name))
        kills.begin(kinds)
        for kind, seconds in kills.seconds.items():
            print(f"{kind}: {' '.join(CALLS[kind][:4])}: {seconds:.1f} s undisturbed", flush=True)
        for number in range(count):
            kind = kinds[number % len(kinds)]
            moment = float(rng.uniform(0.0, kills.seconds[kind]))
            ran, found = kills.kill(kind, moment)
            running, wrong = running + ran, wrong + bool(found)
            if found:
                print(f"kill {number}, {kind} after {moment:.2f} s: {'; '.join(found)}", flush=True)
            elif number % 10 == 9:
                print(f"{number + 1} kills, {wrong} left something wrong", flush=True)
    print(f"{count} kills, {running} while the call ran: {wrong} left something wrong")
    return wrong


if __name__ == "__main__":
    sys.exit(study(int(sys.argv[1]), sys.argv[2:] or ["stages", "report"]) > 0)
