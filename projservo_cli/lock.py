"""One process at a time in an output folder."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from projservo_cli.files import clear_leftovers
from projservo_cli.records import InputError

LOCK = ".lock"


@contextmanager
def working_in(folder: Path, *parts: str, name: str = LOCK) -> Iterator[None]:
    """Keep other processes from working in a folder, and remove what killed ones left there.

    The lock is the system's: it ends with the process, however that ends. Readers need none, since
    files are put in place as a whole.

    Parameters
    ----------
    folder : is made where there is none, and removed where nothing was written into it.
    parts : folders in it, from which leftovers are removed as well.
    name : of the lock, where not all of the folder is worked on.

    Raises
    ------
    InputError
        Where another process is at work, with its number, or the folder cannot be written to.
    """
    from filelock import FileLock, Timeout

    path, new = folder / name, not folder.exists()
    lock = FileLock(path, timeout=0)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock.acquire()
    except Timeout as error:
        raise InputError(
            f"{folder}: {_owner(path)} is at work there; wait for its end, or choose another folder with -o"
        ) from error
    except OSError as error:
        raise InputError(
            f"{folder}: cannot be written: {error.strerror or error}; choose a folder you can write to"
        ) from error
    try:
        with suppress(OSError):  # who it is only serves the message
            path.write_text(f"{os.getpid()}\n", encoding="ascii")
        for part in ("", *parts):
            clear_leftovers(folder / part)
        yield
    finally:
        with suppress(OSError):
            path.unlink()  # while it is held, so that no other process can hold what is removed
        lock.release()
        if new:
            with suppress(OSError):
                folder.rmdir()


def tidy(folder: Path, *parts: str) -> None:
    """Remove what a killed process left in a folder, where no other works there and nothing is to be done."""
    if (folder / LOCK).exists():
        with suppress(InputError), working_in(folder, *parts):
            pass


def _owner(path: Path) -> str:
    try:
        return f"process {int(path.read_text(encoding='ascii'))}"
    except (OSError, ValueError):
        return "another process"
