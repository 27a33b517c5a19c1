"""A progress bar on a terminal."""

import sys
import threading
import time
from typing import Any

# Period at which the clock of a bar advances, s.
TICK_S = 0.5


class Bar:
    """Progress bar, one at a time; silent if standard error is no terminal."""

    def __init__(self) -> None:
        self._bar: Any = None

    def __call__(self, what: str, done: int, total: int, note: str = "") -> None:
        """Move the bar of ``what`` to ``done`` of ``total``, with a note, and remove it at the end."""
        if not sys.stderr.isatty():
            return
        if self._bar is None or self._bar.desc != what:
            from tqdm import tqdm

            self.close()
            self._bar = tqdm(total=total, desc=what, leave=False, ncols=80)
            threading.Thread(target=self._tick, args=(self._bar,), daemon=True).start()
        self._bar.total = total
        self._bar.set_postfix_str(note, refresh=False)
        self._bar.update(done - self._bar.n)
        if done >= total:
            self.close()

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
