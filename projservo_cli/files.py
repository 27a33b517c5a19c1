"""Writing files so that a reader never meets half of one."""

import hashlib
import os
import platform
import re
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from projservo_cli.records import InputError

_SUFFIX = ".part"
_TEMPORARY = re.compile(r"\.(?P<name>.+)\.(?P<machine>[0-9a-f]{8})\.(?P<process>[0-9]+)\.[^.]+\.part")


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary neighbour of ``path`` that takes its place when the block succeeds.

    The new content is on the disk before the old name points to it. When the block raises, the
    temporary file is removed and whatever stood at ``path`` before stays.

    Raises
    ------
    InputError
        When the folder cannot be made or written to, or the disk is full.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error
    clear_leftovers(path.parent, path.name)
    handle, temporary = _neighbour(path, path.parent)
    os.close(handle)
    try:
        yield temporary
        _synchronise(temporary)
        temporary.chmod(0o666 & ~_umask())  # mkstemp makes files that only their owner can read
        temporary.replace(path)
        _synchronise(path.parent)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error
    finally:
        temporary.unlink(missing_ok=True)


def require_writable(path: Path) -> None:
    """Make sure that ``path`` could be written, before the work whose result it shall hold.

    Nothing is left behind: where folders lack, the nearest one there is stands for them.

    Raises
    ------
    InputError
        When there is no such folder, or it cannot be written to.
    """
    folder = next(parent for parent in path.absolute().parents if parent.exists())
    handle, temporary = _neighbour(path, folder)
    os.close(handle)
    temporary.unlink()


def _neighbour(path: Path, folder: Path) -> tuple[int, Path]:
    """An open temporary file in ``folder`` for what shall become ``path``, named after who writes it."""
    prefix = f".{path.name}.{_machine()}.{os.getpid()}."
    try:
        handle, name = tempfile.mkstemp(dir=folder, prefix=prefix, suffix=_SUFFIX)
    except NotADirectoryError as error:
        raise InputError(f"{path}: cannot be written: {folder} is no folder; choose another") from error
    except OSError as error:
        raise InputError(
            f"{path}: cannot be written: {error.strerror or error}; choose a folder you can write to"
        ) from error
    return handle, Path(name)


def clear_leftovers(folder: Path, name: str | None = None) -> None:
    """Remove temporary files whose writers were killed, of one file or of all in a folder.

    Those of processes that run, or that ran on another machine, stay.
    """
    if sys.platform == "win32" or not folder.is_dir():  # no process can be asked for there
        return
    for path in folder.iterdir():
        found = _TEMPORARY.fullmatch(path.name)
        if found is None or found["machine"] != _machine() or name not in (None, found["name"]):
            continue
        if not _runs(int(found["process"])):
            path.unlink(missing_ok=True)


def _machine() -> str:
    return hashlib.sha256(platform.node().encode()).hexdigest()[:8]


def _runs(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True


def require_inside(path: Path, folder: Path) -> None:
    """Refuse a path that symbolic links lead out of a folder.

    Raises
    ------
    InputError
        When it does.
    """
    if not inside(path, folder):
        raise InputError(
            f"{path}: a symbolic link leads out of {folder}; remove it, or choose another folder with -o"
        )


def inside(path: Path, folder: Path) -> bool:
    """Whether a path lies in a folder when all symbolic links are followed."""
    try:
        return path.resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError):  # links that lead in a circle
        return False


def _synchronise(path: Path) -> None:
    if path.is_dir() and os.name == "nt":  # a folder cannot be opened there
        return
    descriptor = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


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
