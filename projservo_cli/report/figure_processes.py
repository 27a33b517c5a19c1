"""Drawing of the figures of a report by two processes, from both ends of their list."""

import os
import pickle
import sys
from collections.abc import Iterator, Sequence
from contextlib import suppress
from subprocess import DEVNULL, PIPE, Popen
from threading import Condition, Thread
from typing import Any, NamedTuple

from projservo_cli.report import style
from projservo_cli.report.figure_inputs import Data, FigureSpec

# Processors that figures may be drawn on.
PROCESSORS = os.cpu_count() or 1


class Drawing(NamedTuple):
    """A figure to draw."""

    spec: FigureSpec
    data: Data
    formats: tuple[str, ...]

    def contents(self) -> dict[str, bytes]:
        """Draw the figure; its files by format."""
        return style.contents(self.spec.drawn(self.data), self.formats)


class SecondProcess:
    """A process that draws from the end of a list, while this one draws from its beginning.

    It takes a second to begin, so it is started before the data of the figures are there. Any that it does
    not do, or cannot, this process does.

    useful : whether there will be many figures.
    """

    def __init__(self, *, useful: bool = True) -> None:
        self._useful = useful and PROCESSORS > 1
        self._process: Popen[bytes] | None = None
        self._changed = Condition()
        self._drawn: dict[int, dict[str, bytes]] = {}
        self._working = False

    def __enter__(self) -> "SecondProcess":
        """Start the process, if it is useful and there is a processor for it."""
        if self._useful:
            command = [sys.executable, "-c", f"import {__name__} as drawing; drawing.serve()"]
            with suppress(OSError):  # the system starts no more processes
                self._process = Popen(command, stdin=PIPE, stdout=PIPE, stderr=DEVNULL)
        return self

    def __exit__(self, *_: object) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            with self._process:  # closes the pipes
                pass

    def contents(self, drawings: Sequence[Drawing]) -> Iterator[dict[str, bytes]]:
        """Yield the files of each figure by format, in their order."""
        if self._process is not None:
            self._working = True
            Thread(target=self._receive, args=(self._process, drawings), daemon=True).start()
        for i, drawing in enumerate(drawings):
            with self._changed:
                # A figure that the other process has begun is awaited, but not its first one.
                while self._working and self._drawn and i == len(drawings) - len(self._drawn) - 1:
                    self._changed.wait()
                done = self._drawn.get(i)
            yield drawing.contents() if done is None else done

    def _receive(self, process: "Popen[bytes]", drawings: Sequence[Drawing]) -> None:
        """Send the list, and take figures as they come."""
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            with process.stdin as stream:
                pickle.dump(list(drawings), stream)
            for i in reversed(range(len(drawings))):
                contents: dict[str, bytes] = pickle.load(process.stdout)
                with self._changed:
                    self._drawn[i] = contents
                    self._changed.notify()
        except (OSError, ValueError, EOFError, pickle.UnpicklingError):
            pass  # the process ended
        finally:
            with self._changed:
                self._working = False
                self._changed.notify()


def serve() -> None:
    """Draw figures that another process sends, from the last to the first."""
    import projservo_cli.report.figures  # noqa: F401 - while the other process prepares the data

    drawings: list[Any] = pickle.load(sys.stdin.buffer)
    for drawing in reversed(drawings):
        pickle.dump(drawing.contents(), sys.stdout.buffer)
        sys.stdout.buffer.flush()
