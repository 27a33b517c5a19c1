"""Provenance of a result: versions, machine, date, command, state of the sources.

The package imports this module for its version, so slow imports are inside functions.
"""

import os
import platform
import sys
from datetime import datetime
from functools import cache
from pathlib import Path
from typing import Any

from projservo_cli.passwords import masked

__version__ = "0.1.0"
_PACKAGES = ("numpy", "scipy", "numba", "llvmlite", "h5py", "matplotlib")


def collect(*, seed: int) -> dict[str, Any]:
    """Collect facts that may explain a difference between two runs of a seed; values are JSON."""
    return {
        "projservo": __version__,
        "python": platform.python_version(),
        **{package: version_of(package) for package in _PACKAGES},
        "git_commit": _git("rev-parse", "HEAD"),
        "git_dirty": None if (status := _git("status", "--porcelain", "-uno")) is None else bool(status),
        "argv": masked(list(sys.argv)),
        "seed": seed,
        "jit": os.environ.get("NUMBA_DISABLE_JIT", "0") in ("", "0"),
        "host": platform.node(),
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "cpu": _cpu(),
        "cpu_count": os.cpu_count(),
        "date": datetime.now().astimezone().isoformat(timespec="seconds"),
    }


@cache
def version_of(package: str) -> str | None:
    """Version of an installed package; None if it is not installed."""
    import importlib.metadata

    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


@cache
def _git(*arguments: str) -> str | None:
    """Output of git for the checkout of this package; None outside of one."""
    import subprocess

    root = Path(__file__).resolve().parent.parent
    if not (root / ".git").exists():
        return None
    try:
        answer = subprocess.run(
            ["git", "-C", str(root), *arguments], capture_output=True, text=True, timeout=5, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return answer.stdout.strip()


@cache
def _cpu() -> str:
    """Name of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()
