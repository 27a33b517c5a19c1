"""Writing files so that a reader never meets half of one."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from projservo_cli.records import InputError


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
    """An open temporary file in ``folder`` for what shall become ``path``."""
    try:
        handle, name = tempfile.mkstemp(dir=folder, prefix=f".{path.name}.", suffix=".part")
    except NotADirectoryError as error:
        raise InputError(f"{path}: cannot be written: {folder} is no folder; choose another") from error
    except OSError as error:
        raise InputError(
            f"{path}: cannot be written: {error.strerror or error}; choose a folder you can write to"
        ) from error
    return handle, Path(name)


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
