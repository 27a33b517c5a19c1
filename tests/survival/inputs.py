"""Configurations and tables as they must never come: ``python -m tests.survival.inputs 10000`` reads so many.

Each is a sound one with one thing changed, by its number alone, or made to exhaust who reads it. Reading
either succeeds or ends in an ``InputError``, within 2 s and 500 MB. Every fiftieth goes through the command
line as well, which must end in exit code 2 with its lines, or 0. The exit code is 1 where one ended in
another way.
"""

import resource
import sys
import tempfile
import time
import traceback
from collections import defaultdict
from pathlib import Path

import numpy as np

from projservo_cli.config import load_config
from projservo_cli.config.schema import starter
from projservo_cli.config.sweep import load_sweep
from projservo_cli.records import InputError
from projservo_cli.tables import read_joints, read_table
from tests.conftest import ROOT
from tests.store.sound import sound_file
from tests.survival.calls import call, prepare
from tests.survival.changes import CSV, YAML, Change

SECONDS, MEGABYTES = 2.0, 500.0
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
    if ending.code != 0 and (wrong := ending.wrong_refusal()):
        return wrong
    return ""


def examine(
    number: int, folder: Path, run: Path | None, limit: float = SECONDS
) -> tuple[str, bool, float, str]:
    """Kind, whether it was refused, seconds and what is wrong of the mutated file of a number."""
    name, kind, data = mutated(number)
    path = folder / name
    path.write_bytes(data)
    refused, wrong = False, ""
    began = time.process_time()
    try:
        read(path)
    except InputError as error:
        refused = True
        if not str(error) or "\n\n" in str(error) or max(map(len, str(error).splitlines())) > 2000:
            wrong = f"message {str(error)[:200]!r}"
    except Exception:
        wrong = traceback.format_exc(limit=-3)
    seconds = time.process_time() - began
    if seconds > limit:
        wrong = wrong or f"{seconds:.1f} s"
    if run is not None and not wrong:
        wrong = by_command(path, run)
    what = f"{'table' if path.suffix == '.csv' else 'configuration'}: {kind}"
    return what, refused, seconds, f"{number} {name} {kind}: {wrong}" if wrong else ""


def study(count: int) -> int:
    """Read so many mutated files and print what became of them; the number of those that ended wrong."""
    prepare()
    ends = defaultdict(list)
    failures = []
    with tempfile.TemporaryDirectory() as name:
        run = Path(name, "run.h5")
        run.write_bytes(sound_file())
        for number in range(count):
            kind, refused, seconds, wrong = examine(number, Path(name), run if number % SAMPLE == 0 else None)
            ends[kind].append((refused, seconds))
            failures += [wrong] if wrong else []
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    print(f"{'change':<40}{'files':>7}{'refused':>9}{'most s':>8}")
    for kind, found in sorted(ends.items()):
        longest = max(seconds for _, seconds in found)
        print(f"{kind:<40}{len(found):>7}{sum(refused for refused, _ in found):>9}{longest:>8.2f}")
    print("\n".join(failures))
    print(f"{count} files, {len(failures)} ended wrong; at most {most:.0f} MB")
    return len(failures) + (most > MEGABYTES)


if __name__ == "__main__":
    sys.exit(study(int(sys.argv[1])) > 0)
