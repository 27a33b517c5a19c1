"""Every check of the project, or those that are named: `python -m tests.check [NAME ...]`."""

import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).parents[1]
PYTHON = sys.executable
BIN = Path(PYTHON).parent
PYTEST = [
    *(PYTHON, "-m", "pytest", "-q", "-n", "2", "--dist", "worksteal", "--benchmark-disable"),
    "--cov=projservo_cli",
]
# What is compiled, run once more without the compiler: the same bits, and lines that coverage can count.
MATHEMATICS = [f"tests/{folder}" for folder in ("geometry", "task", "control", "loop", "simulation")]
WITHOUT_COMPILER = {"NUMBA_DISABLE_JIT": "1"}

CHECKS: dict[str, tuple[Sequence[str | Path], dict[str, str]]] = {
    "lint": ([BIN / "ruff", "check", "."], {}),
    "format": ([BIN / "ruff", "format", "--check", "."], {}),
    "types": ([BIN / "mypy"], {}),
    "imports": ([BIN / "lint-imports"], {}),
    "documentation": (
        [
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
        ],
        WITHOUT_COMPILER,
    ),
    "mathematics without the compiler": (
        [*PYTEST, "--cov-report=", "-m", "not volume", *MATHEMATICS],
        WITHOUT_COMPILER,
    ),
    # The lines of both passes count.
    "tests": ([*PYTEST, "--cov-append", "--cov-report=term", "--cov-fail-under=90"], {}),
    "speed": ([PYTHON, "-m", "pytest", "-q", "tests/benchmarks"], {}),
}
# Forty minutes: only where it is asked for by name.
STUDIES: dict[str, tuple[Sequence[str | Path], dict[str, str]]] = {
    "rendered": ([PYTHON, "-m", "tests.studies.rendered"], {}),
}


def main(names: Sequence[str]) -> int:
    """Run the named checks, or all, and return how many failed."""
    known = CHECKS | STUDIES
    unknown = [name for name in names if name not in known]
    if unknown:
        print(f"unknown check {unknown[0]!r}: choose among {', '.join(known)}", file=sys.stderr)
        return 2
    failed = []
    for name in names or CHECKS:
        command, environment = known[name]
        print(f"── {name}: {' '.join(str(Path(part).name) for part in command)}", flush=True)
        start = time.monotonic()
        code = subprocess.run(
            command, cwd=ROOT, env={"OPENBLAS_NUM_THREADS": "1", **os.environ, **environment}, check=False
        ).returncode
        outcome = "passed" if code == 0 else "FAILED"
        print(f"── {name}: {outcome} in {time.monotonic() - start:.0f} s\n", flush=True)
        if code != 0:
            failed.append(name)
    print("all checks passed" if not failed else f"failed: {', '.join(failed)}")
    return len(failed)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
