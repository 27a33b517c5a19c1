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

TRACEBACK = "Traceback (most recent call last)"


@dataclass(frozen=True)
class Ending:
    """How a call ended."""

    code: int  # of its exit, negative for the number of a signal
    out: str  # what it said, with characters that are not UTF-8 escaped
    err: str

    def wrong_refusal(self) -> str:
        """What is wrong with it as a refusal of bad input; empty where nothing is."""
        lines = self.err.splitlines()
        if self.code != 2:
            return f"exit code {self.code}: {' | '.join(lines)[-300:]}"
        if TRACEBACK in self.err or self.out:
            return f"said more than one line: {(self.out + self.err)[:300]}"
        if not lines or not all(line.startswith("projservo: ") for line in lines):
            return f"not a line of projservo: {self.err[:300]!r}"
        return ""


def call(*arguments: str, kill_after: float = math.inf) -> Ending:
    """Call ``projservo`` in a forked process, where nothing has to be imported anew; s until it is killed."""
    with tempfile.TemporaryDirectory() as folder:
        said = [Path(folder, name) for name in ("out", "err")]
        child = os.fork()
        if child == 0:
            _run(arguments, *said)
        if math.isfinite(kill_after):
            time.sleep(kill_after)
            os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
        texts = [p.read_text(encoding="utf-8", errors="backslashreplace") if p.exists() else "" for p in said]
        return Ending(os.waitstatus_to_exitcode(status), *texts)


def _run(arguments: tuple[str, ...], out: Path, err: Path) -> None:
    code = 70
    try:
        for stream, path in ((1, out), (2, err)):
            os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT, 0o600), stream)
        sys.stdout, sys.stderr = (
            io.TextIOWrapper(io.FileIO(stream, "w", closefd=False), encoding="utf-8") for stream in (1, 2)
        )
        code = cli.run(arguments)
        sys.stdout.flush()
        sys.stderr.flush()
    finally:
        os._exit(code)
