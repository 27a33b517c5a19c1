"""Data on standard output, messages and progress on standard error."""

import json
import math
import sys
import threading
from pathlib import Path
from typing import Any

import click
import numpy as np

from projservo_cli.cli.options import visible, wrapped

TICK_S = 0.5


def plain(value: Any) -> Any:
    """A value as strict JSON knows it: no NaN or infinity, no NumPy types, no tuples."""
    if isinstance(value, dict):
        return {str(key): plain(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(inner) for inner in value]
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, (np.ndarray, np.generic)):
        return plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def print_json(value: Any) -> None:
    """Print one object of strict JSON in UTF-8, whatever the locale."""
    text = visible(json.dumps(plain(value), ensure_ascii=False, allow_nan=False, indent=2))
    sys.stdout.buffer.write(f"{text}\n".encode())


class Console:
    """What the user wants to see, and a progress bar where someone can watch it."""

    def __init__(self, *, quiet: bool, verbose: bool) -> None:
        self.quiet = quiet
        self.verbose = verbose
        self._bar: Any = None
        self._what = ""
        self._lock = threading.RLock()
        self._ended = threading.Event()

    def say(self, text: str) -> None:
        """A message on standard error."""
        if self.quiet:
            return
        with self._lock:
            if self._bar is not None:
                self._bar.clear()
            click.echo(wrapped(visible(text)), err=True)
            if self._bar is not None:
                self._bar.refresh()

    def detail(self, text: str) -> None:
        """A message that only -v shows."""
        if self.verbose:
            self.say(text)

    def show(self, text: str) -> None:
        """A line of data on standard output."""
        if not self.quiet:
            click.echo(visible(text))

    def progress(self, what: str, done: int, total: int) -> None:
        """Move a progress bar; silent where standard error is not a terminal."""
        if self.quiet or not sys.stderr.isatty():
            return
        with self._lock:
            if self._bar is None or self._what != what:
                self._begin(what, total)
            self._bar.total = total
            self._bar.update(done - self._bar.n)
            if done >= total:
                self.finish()

    def finish(self) -> None:
        """Remove the progress bar."""
        with self._lock:
            self._ended.set()
            if self._bar is not None:
                self._bar.close()
                self._bar = None

    def _begin(self, what: str, total: int) -> None:
        from tqdm import tqdm

        self.finish()
        self._what = what
        self._bar = tqdm(total=total, desc=what, leave=False, ncols=80)
        self._ended = threading.Event()
        threading.Thread(target=self._tick, args=(self._bar, self._ended), daemon=True).start()

    def _tick(self, bar: Any, ended: threading.Event) -> None:
        """Let the clock of a bar go on while its work reports nothing."""
        while not ended.wait(TICK_S):
            with self._lock:
                if not ended.is_set():
                    bar.refresh()
