"""Files replaced as a whole, texts read within bounds, and locks of folders."""

import io
import os
import re
import secrets
import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path

from projservo_cli.records import InputError

_LOCK = ".lock"
_LONGEST = 10_000_000  # maximum size of a line, bytes
_TEMPORARY = re.compile(r"\..+\.([0-9]+)\.[0-9a-f]{8}\.part")  # name with the number of the process


@contextmanager
def replacing(path: Path, *, durable: bool = True) -> Iterator[Path]:
    """Yield a temporary neighbour of ``path`` that replaces it when the block succeeds.

    durable : whether the new content is on the disk before the name points to it; False for files that can be
        made again.
    Raises InputError if it cannot be written, or the disk is full.
    """
    with _errors(path, "written"):
        path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.{secrets.token_hex(4)}.part")
    try:
        with _errors(path, "written"):
            temporary.touch(exist_ok=False)
            yield temporary
            if durable:
                _synchronise(temporary)
            temporary.replace(path)
            if durable:
                _synchronise(path.parent)
    finally:
        with suppress(OSError):  # a folder without write permission
            temporary.unlink(missing_ok=True)


def write_whole(path: Path, content: str | bytes) -> Path:
    """Write a file as ``replacing`` does, text in UTF-8, bytes of paths that are none as in Python."""
    with replacing(path) as temporary:
        temporary.write_bytes(
            content.encode(errors="backslashreplace") if isinstance(content, str) else content
        )
    return path


def bytes_of(path: Path | str, expected: str, max_bytes: int) -> bytes:
    """Content of a file of up to ``max_bytes``. Raises InputError, naming the ``expected`` content."""
    with _errors(path, "read", f"; expected {expected}"), Path(path).open("rb") as file:
        content = file.read(max_bytes + 1)
    if len(content) > max_bytes:
        raise InputError(f"{path}: larger than {max_bytes // 1_000_000} MB; expected {expected}")
    return content


def text_of(path: Path | str, expected: str, max_bytes: int) -> str:
    """Text of a file of up to ``max_bytes`` in UTF-8, with or without byte-order mark.

    Raises InputError, naming the ``expected`` content, if the file is no such text.
    """
    content = bytes_of(path, expected, max_bytes)
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1
        raise InputError(f"{path}:{line}: not UTF-8 text; expected {expected}") from error


def lines_of(path: Path | str, expected: str, max_bytes: int) -> Iterator[str]:
    """Yield the lines, with their ends, of a file as ``text_of`` returns it.

    Raises InputError, with the line, at a NUL byte, a line without end, or if the file is no text.
    """
    number, size = 1, 0
    try:
        with _errors(path, "read", f"; expected {expected}"), Path(path).open("rb") as file:
            while content := file.readline(_LONGEST + 1):
                size += len(content)
                if size > max_bytes:
                    raise InputError(f"{path}: larger than {max_bytes // 1_000_000} MB; expected {expected}")
                if len(content) > _LONGEST:
                    raise InputError(f"{path}:{number}: a line without an end; expected {expected}")
                if b"\0" in content:
                    raise InputError(f"{path}:{number}: not a text file in UTF-8 (it has a NUL byte)")
                text = content.decode("utf-8-sig" if number == 1 else "utf-8")
                yield from io.StringIO(text, newline="")
                number += 1
    except UnicodeDecodeError as error:
        raise InputError(f"{path}:{number}: not UTF-8 text; expected {expected}") from error


@contextmanager
def working_in(folder: Path, *parts: str, name: str = _LOCK) -> Iterator[None]:
    """Lock a folder against other processes, and remove leftovers of killed ones.

    The operating system ends the lock with the process.

    folder : created if missing, and removed if it stays empty.
    parts : folders in it whose leftovers are removed too.
    name : file name of the lock, if it covers a part of the folder.
    Raises InputError if another process holds the lock, with its number, or the folder is not writable.
    """
    from filelock import FileLock, Timeout

    path, new = folder / name, not folder.exists()
    lock = FileLock(path, timeout=0)
    with _errors(folder, "written", "; choose a folder you can write to"):
        folder.mkdir(parents=True, exist_ok=True)
        try:
            lock.acquire()
        except Timeout as error:
            number = ""
            with suppress(OSError):  # the lock may be gone by now
                number = path.read_text(encoding="ascii", errors="replace").strip()
            owner = f"process {number}" if number.isdecimal() else "another process"
            raise InputError(
                f"{folder}: {owner} is at work there; wait for its end, or choose another folder"
            ) from error
    try:
        with suppress(OSError):  # only messages need the number of the process
            path.write_text(f"{os.getpid()}\n", encoding="ascii")
        for part in ("", *parts):
            _clear_leftovers(folder / part)
        yield
    finally:
        with suppress(OSError):
            path.unlink()  # before the release, so that no other process holds a removed lock
        lock.release()
        if new:
            with suppress(OSError):
                folder.rmdir()


def writing(path: Path) -> AbstractContextManager[None]:
    """Make sure, before any work, that a file can be written, and keep other processes from it."""
    return working_in(path.parent, name=f".{path.name}.lock")


def tidy(folder: Path, *parts: str) -> None:
    """Remove leftovers of a killed process from a folder, if no other works there."""
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
    """Raise InputError for a path that symbolic links lead out of a folder."""
    if not lies_inside(path, folder):
        raise InputError(
            f"{path}: a symbolic link leads out of {folder}; remove it, or choose another folder"
        )


@contextmanager
def _errors(path: Path | str, done: str, remedy: str = "") -> Iterator[None]:
    """Turn an OSError, as a file is read or written, into an InputError of one line."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{path}: cannot be {done}: {error.strerror or error}{remedy}") from error


def _clear_leftovers(folder: Path) -> None:
    """Remove the temporary files of processes that no longer run from a folder."""
    if sys.platform == "win32" or not folder.is_dir():  # Windows has no signal 0 to test for a process
        return
    for path in folder.iterdir():
        found = _TEMPORARY.fullmatch(path.name)
        if found is None:
            continue
        try:
            os.kill(int(found[1]), 0)
        except ProcessLookupError:
            path.unlink(missing_ok=True)
        except (PermissionError, OverflowError):  # a process of another user, or no process number
            pass


def _synchronise(path: Path) -> None:
    if path.is_dir() and os.name == "nt":  # Windows opens no folders
        return
    descriptor = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
