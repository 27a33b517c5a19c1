"""The command line called in a process of its own, forked from this one, and what became of it."""

import io
import os
import sys
import tempfile
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


@dataclass(frozen=True)
class Call:
    """A call that runs; ``process`` is its number, ``folder`` takes what it says."""

    process: int
    folder: tempfile.TemporaryDirectory[str]

    def end(self) -> Ending:
        """Wait for its end."""
        _, status = os.waitpid(self.process, 0)
        with self.folder as folder:
            said = [
                path.read_text(encoding="utf-8", errors="backslashreplace") if path.exists() else ""
                for path in (Path(folder, "out"), Path(folder, "err"))
            ]
        return Ending(os.waitstatus_to_exitcode(status), *said)


def start(*arguments: str) -> Call:
    """Begin to call ``projservo`` in a forked process, where nothing has to be imported anew."""
    folder = tempfile.TemporaryDirectory()
    child = os.fork()
    if child == 0:
        _run(arguments, Path(folder.name, "out"), Path(folder.name, "err"))
    return Call(child, folder)


def call(*arguments: str) -> Ending:
    """Call ``projservo`` with arguments to its end."""
    return start(*arguments).end()


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
