"""Data on standard output, messages and progress on standard error."""

import json
import math
import re
import sys
import textwrap
import threading
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import click

TICK_S = 0.5
_UNSEEN = re.compile("[\x00-\x09\x0b-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069]")


def wrapped(text: str, indent: str = "") -> str:
    """Text in lines of at most 80 columns; words longer than that stay whole."""
    return textwrap.fill(
        text,
        80,
        initial_indent=indent,
        subsequent_indent=indent,
        break_long_words=False,
        break_on_hyphens=False,
    )


def visible(text: str) -> str:
    """Text whose control characters and changes of direction are written out, line ends apart.

    Texts come from files of others too; a terminal that is sent them must not obey them.
    """
    return _UNSEEN.sub(lambda found: f"\\u{ord(found[0]):04x}", text)


def _plain(value: Any) -> Any:
    """A value as strict JSON knows it: no NaN or infinity, no NumPy types, no tuples."""
    if isinstance(value, dict):
        return {str(key): _plain(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(inner) for inner in value]
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "tolist"):  # of NumPy
        return _plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


class Console:
    """What the user wants to see, and a progress bar where someone can watch it."""

    def __init__(self, *, quiet: bool = False, verbose: bool = False, as_json: bool = False) -> None:
        self.quiet = quiet
        self.verbose = verbose
        self.as_json = as_json
        self._data = sys.stdout  # while a command works, what others print goes elsewhere
        self._bar: Any = None
        self._what = ""
        self._lock = threading.RLock()

    def __enter__(self) -> "Console":
        return self

    def __exit__(self, *_: object) -> None:
        self._finish()

    def tell(self, value: dict[str, Any], lines: Iterable[str]) -> None:
        """Data on standard output: one object of strict JSON in UTF-8, whatever the locale, or in words."""
        if self.as_json:
            text = visible(json.dumps(_plain(value), ensure_ascii=False, allow_nan=False, indent=2))
            self._data.buffer.write(f"{text}\n".encode())
        elif not self.quiet:
            for line in lines:
                click.echo(visible(line), file=self._data)

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

    def confirm(self, command: str, plant: Any) -> None:
        """Ask before the first motion of a robot, by the section ``plant`` of the configuration.

        Raises KeyboardInterrupt where the answer is not yes.
        """
        self._finish()
        try:
            agreed = click.confirm(
                f"{command} will move {plant.use or 'the simulated robot'}, "
                f"speeds times {plant.speed_scale:g}. Go?",
                err=True,
            )
        except click.Abort:
            agreed = False
        if not agreed:
            self.say("not confirmed: nothing was moved")
            raise KeyboardInterrupt

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
                self._finish()

    def _finish(self) -> None:
        """Remove the progress bar."""
        with self._lock:
            if self._bar is not None:
                self._bar.close()
                self._bar = None

    def _begin(self, what: str, total: int) -> None:
        from tqdm import tqdm

        self._finish()
        self._what = what
        self._bar = tqdm(total=total, desc=what, leave=False, ncols=80)
        threading.Thread(target=self._tick, args=(self._bar,), daemon=True).start()

    def _tick(self, bar: Any) -> None:
        """Let the clock of a bar go on while its work reports nothing."""
        while self._bar is bar:
            time.sleep(TICK_S)
            with self._lock:
                if self._bar is bar:
                    bar.refresh()
