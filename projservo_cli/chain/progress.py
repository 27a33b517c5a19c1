"""Who follows a piece of work: messages, and a progress bar on a terminal."""

import sys
import threading
import time
from collections.abc import Callable
from typing import Any, Self

# Period at which the clock of a bar advances, s.
TICK_S = 0.5
# Period of the lines that report progress if there is no terminal, s.
_LINE_S = 60.0


class _Bar:
    """Progress bar, one at a time; a line a minute if standard error is neither terminal nor notebook."""

    def __init__(self) -> None:
        self._bar: Any = None
        self._what, self._told = "", 0.0

    def __call__(self, what: str, done: int, total: int, note: str = "") -> None:
        """Move the bar of ``what`` to ``done`` of ``total``, with a note, and remove it at the end."""
        if not (sys.stderr.isatty() or "ipykernel.zmqshell" in sys.modules):  # the test of tqdm.auto
            self._line(what, done, total)
            return
        if self._bar is None or self._bar.desc != what:
            from tqdm.auto import tqdm

            self.close()
            self._bar = tqdm(total=total, desc=what, leave=False, ncols=80 if sys.stderr.isatty() else None)
            threading.Thread(target=self._tick, args=(self._bar,), daemon=True).start()
        self._bar.total = total
        self._bar.set_postfix_str(note, refresh=False)
        self._bar.update(done - self._bar.n)
        if done >= total:
            self.close()

    def _line(self, what: str, done: int, total: int) -> None:
        """Print the progress of ``what``, once a minute from when it began."""
        now = time.monotonic()
        if what != self._what:
            self._what, self._told = what, now
        elif now - self._told >= _LINE_S and done < total:
            self._told = now
            self.say(f"{what}: {done} of {total}")

    def say(self, text: str) -> None:
        """Print a message on standard error, above a visible bar."""
        if self._bar is not None:
            self._bar.write(text, file=sys.stderr)
        else:
            print(text, file=sys.stderr, flush=True)

    def close(self) -> None:
        """Remove the bar."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None

    def _tick(self, bar: Any) -> None:
        """Advance the clock of a bar while its work reports no progress."""
        while self._bar is bar:
            bar.refresh()
            time.sleep(TICK_S)


class Listener:
    """A caller in Python: is shown progress and messages, and agrees to every motion.

    progress : called as ``progress(what, done, total)``; True for a bar in a terminal, False for none.
    """

    def __init__(self, progress: Callable[[str, int, int], None] | bool = True) -> None:
        self._bar = _Bar()
        self._progress = self._bar if progress is True else progress

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def say(self, text: str) -> None:
        """Print a message on standard error."""
        self._bar.say(text)

    def detail(self, text: str) -> None:
        """Leave a message unread that few want to read."""

    def progress(self, what: str, done: int, total: int, note: str = "") -> None:
        """Show how far the work is; the function of a caller takes no note."""
        del note
        if callable(self._progress):
            self._progress(what, done, total)

    def confirm(self, command: str, plant: Any) -> None:
        """Agree to the first motion of a plant; raises KeyboardInterrupt if the answer is not yes."""
