"""Every check of the project, or those that are named: `python -m tests.check [NAME ...]`."""

import os
import shlex
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).parents[1]
PYTHON = sys.executable
BIN = Path(PYTHON).parent
# A third process uses the time in which emulated arms, which move in real time, leave a processor idle.
PYTEST = [PYTHON, "-m", "pytest", "-q", "-n", "3", "--dist", "worksteal", "--benchmark-disable"]
SPHINX = [
    PYTHON,
    "-m",
    "sphinx",
    "-q",
    "-W",
    "-n",
    "--keep-going",
    "-d",
    "build/doctrees",
    "docs",
    "build/docs",
]
TUTORIAL = [PYTHON, "-m", "pytest", "-q", "tests/studies/so101_tutorial.py", "-k"]
PACKAGE = ROOT / "projservo_cli"
# Sections of parameters are what is looked at, and few files have any.
DESCRIBED = [path for path in PACKAGE.rglob("*.py") if "Parameters\n" in path.read_text(encoding="utf-8")]
DOCSTRINGS = [PYTHON, "-m", "numpydoc", "lint", *sorted(map(str, DESCRIBED))]
# Tests of compiled functions, once more without the compiler, where indices are looked at. Whole runs of all
# laws are compared by tests/loop/test_bits.py. Of the functions that find objects, those of lenses alone are
# compiled, and tested in tests/geometry.
MATHEMATICS = ["tests/geometry", "tests/task", "tests/control", "tests/simulation/test_ideal.py"]
BY_NUMPY = ["tests/task/test_object_tracker.py", "tests/task/test_displaced_object.py"]
UNCOMPILED = ["-m", "not volume", *MATHEMATICS, *(f"--ignore={path}" for path in BY_NUMPY)]
WITHOUT_COMPILER = {"NUMBA_DISABLE_JIT": "1"}

# The emulator runs in real time, on a machine that others may use: it is tried again.
ATTEMPTS = {"tutorial": 2}

Check = tuple[Sequence[str | Path], dict[str, str]]
# Three at a time, in this order: the tutorial, whose emulator runs in real time, and the others behind it, in
# the time that it leaves.
TOGETHER: dict[str, Check] = {
    "tutorial": ([*TUTORIAL, "not one_webcam and not refitted"], {}),
    "types": ([BIN / "mypy"], {}),
    "mathematics without the compiler": (
        [PYTHON, "-m", "pytest", "-q", "--benchmark-disable", *UNCOMPILED],
        WITHOUT_COMPILER,
    ),
    "documentation": (SPHINX, WITHOUT_COMPILER),
    "lint": ([BIN / "ruff", "check", "."], {}),
    "format": ([BIN / "ruff", "format", "--check", "."], {}),
    "imports": ([BIN / "lint-imports"], {}),
    "docstrings": (DOCSTRINGS, {}),
    "tests": ([*PYTEST, "--ignore=tests/benchmarks"], {}),
}
# Timed, when nothing else runs.
ALONE: dict[str, Check] = {"speed": ([PYTHON, "-m", "pytest", "-q", "tests/benchmarks"], {})}
# Only by name. Coverage doubles the time of the first pass and adds a fifth to the second; lines of both add
# up, one after the other. The rendered study takes forty minutes, the tutorials with one webcam and with a
# part two and five.
BY_NAME: dict[str, Check] = {
    "coverage without the compiler": (
        [*PYTEST, "--cov=projservo_cli", "--cov-report=", *UNCOMPILED, "tests/loop"],
        WITHOUT_COMPILER,
    ),
    "coverage": (
        [*PYTEST, "--cov=projservo_cli", "--cov-append", "--cov-report=term", "--cov-fail-under=90"],
        {},
    ),
    "rendered": ([PYTHON, "-m", "tests.studies.rendered"], {}),
    "one webcam": ([*TUTORIAL, "one_webcam"], {}),
    "refit": ([*TUTORIAL, "refitted"], {}),
    "part": ([PYTHON, "-m", "pytest", "-q", "tests/studies/pick_and_place.py"], {}),
}


def run(name: str, check: Check) -> bool:
    """Run a check, print what it says once it is over, and return whether it passed."""
    command, environment = check
    behind = ["nice", "-n", "10"] if name in TOGETHER and name != "tutorial" else []
    start = time.monotonic()
    for _ in range(ATTEMPTS.get(name, 1)):
        done = subprocess.run(
            [*behind, *command],
            cwd=ROOT,
            env={"OPENBLAS_NUM_THREADS": "1", **os.environ, **environment},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
        )
        if done.returncode == 0:
            break
    outcome = "passed" if done.returncode == 0 else "FAILED"
    words = shlex.join(Path(part).name for part in command[:9])
    print(
        f"── {name}: {words}\n{done.stdout}── {name}: {outcome} in {time.monotonic() - start:.0f} s\n",
        flush=True,
    )
    return done.returncode == 0


def main(names: Sequence[str]) -> int:
    """Run the named checks, or all, and return how many failed."""
    known = TOGETHER | ALONE | BY_NAME
    unknown = [name for name in names if name not in known]
    if unknown:
        print(f"unknown check {unknown[0]!r}: choose among {', '.join(known)}", file=sys.stderr)
        return 2
    names = names or [*TOGETHER, *ALONE]
    passed: dict[str, bool] = {}
    for group, processors in ((TOGETHER, 3), (ALONE | BY_NAME, 1)):
        chosen = [name for name in names if name in group]
        with ThreadPoolExecutor(processors) as pool:
            passed |= dict(zip(chosen, pool.map(run, chosen, [group[name] for name in chosen]), strict=True))
    failed = [name for name, good in passed.items() if not good]
    print("all checks passed" if not failed else f"failed: {', '.join(failed)}")
    return len(failed)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
