"""The command line called in a process of its own, forked from this one, and what became of it."""

import io
import math
import os
import signal
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from projservo_cli import cli


@dataclass(frozen=True)
class Ending:
    """How a call ended."""

    code: int  # of its exit, negative for the number of a signal
    err: str  # what it said, with characters that are not UTF-8 escaped


def call(*arguments: str, kill_after: float = math.inf) -> Ending:
    """Call ``projservo`` in a forked process, where nothing has to be imported anew; s until it is killed."""
    with tempfile.TemporaryDirectory() as folder:
        said = Path(folder, "err")
        child = os.fork()
        if child == 0:
            _run(arguments, said)
        if math.isfinite(kill_after):
            time.sleep(kill_after)
            os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
        text = said.read_text(encoding="utf-8", errors="backslashreplace") if said.exists() else ""
        return Ending(os.waitstatus_to_exitcode(status), text)


def _run(arguments: tuple[str, ...], err: Path) -> None:
    code = 70
    try:
        os.dup2(os.open(err, os.O_WRONLY | os.O_CREAT, 0o600), 2)
        sys.stdout = sys.stderr = io.TextIOWrapper(io.FileIO(2, "w", closefd=False), encoding="utf-8")
        code = cli.run(arguments)
        sys.stderr.flush()
    finally:
        os._exit(code)
