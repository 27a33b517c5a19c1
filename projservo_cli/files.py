"""Files replaced as a whole, texts read within bounds, and locks of folders."""

import io
import os
import re
import secrets
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from projservo_cli.records import InputError

_LOCK = ".lock"
_LONGEST = 10_000_000  # bytes of a line that is a line
_TEMPORARY = re.compile(r"\..+\.([0-9]+)\.[0-9a-f]{8}\.part")  # with the number of the process


@contextmanager
def replacing(path: Path, *, lasting: bool = True) -> Iterator[Path]:
    """Yield a temporary neighbour of ``path`` that takes its place when the block succeeds.

    The new content is on the disk before the old name points to it, unless it need not be ``lasting`` since
    it can be made again at any time. Raises InputError when it cannot be written, or the disk is full.
    """
    with _told(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.{secrets.token_hex(4)}.part")
    try:
        with _told(path):
            temporary.touch(exist_ok=False)
            yield temporary
            if lasting:
                _synchronise(temporary)
            temporary.replace(path)
            if lasting:
                _synchronise(path.parent)
    finally:
        with suppress(OSError):  # where nothing can be written, nothing can be removed
            temporary.unlink(missing_ok=True)


def write_whole(path: Path, content: str | bytes) -> Path:
    """Write a file as ``replacing`` does, text in UTF-8; its path."""
    with replacing(path) as temporary:
        temporary.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def text_of(path: Path | str, expected: str, most: int) -> str:
    """The text of a file of at most so many bytes in UTF-8, with or without byte-order mark.

    Raises InputError, with what was ``expected``, when there is none.
    """
    try:
        with Path(path).open("rb") as file:
            content = file.read(most + 1)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}; expected {expected}") from error
    if len(content) > most:
        raise InputError(f"{path}: larger than {most // 1_000_000} MB; expected {expected}")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise InputError(f"{path}:{line}: not UTF-8 text; expected {expected}") from error


def lines_of(path: Path | str, expected: str, most: int) -> Iterator[str]:
    """The lines of a file like that of ``text_of``, with their ends, read one after the other.

    Raises InputError, with the line, where there is none, or one has a NUL byte or no end.
    """
    number, size = 1, 0
    try:
        with Path(path).open("rb") as file:
            while content := file.readline(_LONGEST + 1):
                size += len(content)
                if size > most:
                    raise InputError(f"{path}: larger than {most // 1_000_000} MB; expected {expected}")
                if len(content) > _LONGEST:
                    raise InputError(f"{path}:{number}: a line without an end; expected {expected}")
                if b"\0" in content:
                    raise InputError(f"{path}:{number}: not a text file (it has a NUL byte)")
                text = content.decode("utf-8-sig" if number == 1 else "utf-8")
                yield from io.StringIO(text, newline="")
                number += 1
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}; expected {expected}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}:{number}: not UTF-8 text; expected {expected}") from error


@contextmanager
def working_in(folder: Path, *parts: str, name: str = _LOCK) -> Iterator[None]:
    """Keep other processes from working in a folder, and remove what killed ones left there.

    The lock is the system's: it ends with the process, however that ends.

    folder : is made where there is none, and removed where nothing was written into it.
    parts : folders in it, from which leftovers are removed as well.
    name : of the lock, where not all of the folder is worked on.
    Raises InputError where another process is at work, with its number, or the folder cannot be written to.
    """
    from filelock import FileLock, Timeout

    path, new = folder / name, not folder.exists()
    lock = FileLock(path, timeout=0)
    with _told(folder, "; choose a folder you can write to"):
        folder.mkdir(parents=True, exist_ok=True)
        try:
            lock.acquire()
        except Timeout as error:
            number = ""
            with suppress(OSError):  # it may be gone by now
                number = path.read_text(encoding="ascii", errors="replace").strip()
            owner = f"process {number}" if number.isdecimal() else "another process"
            raise InputError(
                f"{folder}: {owner} is at work there; wait for its end, or choose another folder with -o"
            ) from error
    try:
        with suppress(OSError):  # who it is only serves the message
            path.write_text(f"{os.getpid()}\n", encoding="ascii")
        for part in ("", *parts):
            _clear_leftovers(folder / part)
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
    if (folder / _LOCK).exists():
        with suppress(InputError), working_in(folder, *parts):
            pass


def lies_inside(path: Path, folder: Path) -> bool:
    """Whether a path lies in a folder when all symbolic links are followed."""
    try:
        return path.resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError):  # links that lead in a circle
        return False


def require_inside(path: Path, folder: Path) -> None:
    """Refuse a path that symbolic links lead out of a folder, with an ``InputError``."""
    if not lies_inside(path, folder):
        raise InputError(
            f"{path}: a symbolic link leads out of {folder}; remove it, or choose another folder with -o"
        )


@contextmanager
def _told(path: Path, remedy: str = "") -> Iterator[None]:
    """Tell in one line what keeps a file or a folder from being written."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror or error}{remedy}") from error


def _clear_leftovers(folder: Path) -> None:
    """Remove the temporary files in a folder whose writers were killed; those of processes that run stay."""
    if sys.platform == "win32" or not folder.is_dir():  # no process can be asked for there
        return
    for path in folder.iterdir():
        found = _TEMPORARY.fullmatch(path.name)
        if found is None:
            continue
        try:
            os.kill(int(found[1]), 0)
        except ProcessLookupError:
            path.unlink(missing_ok=True)
        except (PermissionError, OverflowError):  # it runs for somebody else, or is no process
            pass


def _synchronise(path: Path) -> None:
    if path.is_dir() and os.name == "nt":  # a folder cannot be opened there
        return
    descriptor = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
