"""HDF5 files that tell whether they are whole, and what is read of one that anybody may have made.

A line behind the HDF5 data holds their SHA-256. It is part of the one file that is put in place, so
it can neither lag behind nor be lost by copying; every reader of HDF5 passes it over, and one that
changes the file cuts it off. It tells damage, not malice: whatever it says, ``require_plain`` looks
at the structure before anything is read. Data sets carry a checksum of their own (Fletcher-32) and,
from HDF5 1.10 on, so do all structures, for the readers of other programs.
"""

import errno
import hashlib
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from math import prod
from pathlib import Path
from typing import Any

import h5py

from projservo_cli.files import replacing
from projservo_cli.records import InputError

SIGNATURE = b"\x89HDF\r\n\x1a\n"
_SEAL = b"\nprojservo sha256 %s\n"
_SEAL_SIZE = len(_SEAL % bytes(64))
_SEALED = re.compile(rb"\nprojservo sha256 ([0-9a-f]{64})\n")
_VERSION = ("v110", "v110")  # that of the file format, from 2016, with checksums in its structures
_END = {0: 40, 1: 44, 2: 28, 3: 28}  # where files of each version of the format say how long they are
_HEAD = 52  # bytes, with that number in each of them
_OBJECT = 64  # bytes that a group or an array takes at least
_DEPTH = 8  # of groups
_DEFLATED = 1100  # no byte that is stored makes more; the algorithm ends at 1032
_FILTERS = {h5py.h5z.FILTER_FLETCHER32, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_DEFLATE}
_NUMBERS = (h5py.h5t.INTEGER, h5py.h5t.FLOAT)
_ERRORS = (OSError, RuntimeError, KeyError, ValueError, TypeError, AttributeError, OverflowError)


class DamagedError(ValueError):
    """What a file claims about itself does not hold."""


@contextmanager
def new_file(path: Path, size: int | None = None) -> Iterator[h5py.File]:
    """A file to be filled, that takes the place of the one at ``path`` when the block succeeds.

    It is made in memory, since the library neither survives a full disk nor tells of it in one line.

    Parameters
    ----------
    size : bytes it may have, where it is too large for that: the disk must then have them to begin with.

    Raises
    ------
    InputError
        When it cannot be written; the file that stood there stays.
    """
    with replacing(path) as temporary:
        if size is None:
            with h5py.File(temporary, "w", libver=_VERSION, driver="core", backing_store=False) as file:
                yield file
                file.flush()
                image = file.id.get_file_image()
            temporary.write_bytes(image)
        else:
            if shutil.disk_usage(temporary.parent).free < size:
                raise InputError(f"{path}: cannot be written: {os.strerror(errno.ENOSPC)}")
            with h5py.File(temporary, "w", libver=_VERSION, locking=False) as file:
                yield file
        seal(temporary)


def seal(path: Path) -> None:
    """Append the line that tells the checksum of a file's data."""
    digest = digest_of(path)
    with path.open("ab") as stream:
        stream.write(_SEAL % digest.encode())


def _raise_unwritable(path: Path, error: Exception) -> None:
    told = re.search(r"error message = '([^']*)'", str(error))
    if told is None:
        raise error
    raise InputError(f"{path}: cannot be written: {told[1]}") from error


def checksummed(shape: tuple[int, ...]) -> dict[str, Any]:
    """Options of ``create_dataset`` for an array read as a whole; one without data has no checksum."""
    return {"fletcher32": True, "chunks": shape} if prod(shape) else {}


def digest_of(path: Path, size: int | None = None) -> str:
    """SHA-256 of the first ``size`` bytes of a file, in hexadecimal; of all of it by default."""
    digest = hashlib.sha256()
    left = path.stat().st_size if size is None else size
    with path.open("rb") as stream:
        while left > 0 and (block := stream.read(min(left, 1 << 20))):
            digest.update(block)
            left -= len(block)
    return digest.hexdigest()


def sealed(path: Path, remedy: str) -> bool:
    """Whether the line behind the data of a file says that they are as they were written.

    Nothing but that line is interpreted. A file without one may be sound: another program changed it.

    Parameters
    ----------
    remedy : what to do where the file is of no use, the end of the message.

    Raises
    ------
    InputError
        When the file cannot be read, is no HDF5 file, or is cut short or changed since it was written.
    """
    try:
        size = path.stat().st_size
        with path.open("rb") as stream:
            head = stream.read(_HEAD)
            stream.seek(max(0, size - _SEAL_SIZE))
            found = _SEALED.fullmatch(stream.read(_SEAL_SIZE))
        digest = digest_of(path, size - _SEAL_SIZE) if found else ""
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    if size == 0:
        raise InputError(f"{path}: is empty; {remedy}")
    if not head.startswith(SIGNATURE):
        raise InputError(f"{path}: no HDF5 file, so not a run file or sweep of projservo; name another")
    if found is not None and found[1].decode() != digest:
        raise InputError(f"{path}: damaged: its checksum is not that of its data; {remedy}")
    if found is None and _end(head) != size:
        raise InputError(f"{path}: cut short or damaged: its size is not the one it states; {remedy}")
    return found is not None


def _end(head: bytes) -> int:
    """Where the data of a file end, by its first bytes; -1 for a version that is not known."""
    place = _END.get(head[len(SIGNATURE)]) if len(head) == _HEAD else None
    return -1 if place is None else int.from_bytes(head[place : place + 8], "little")


@contextmanager
def opened(path: Path, remedy: str) -> Iterator[h5py.File]:
    """A file to read, of which ``require_plain`` holds; everything wrong with it is an ``InputError``."""
    try:
        with h5py.File(path, "r", locking=False) as file:
            require_plain(file, path.stat().st_size)
            yield file
    except InputError:
        raise
    except _ERRORS as error:
        what = " ".join(str(error).split())
        raise InputError(f"{path}: cut short, damaged or of another kind ({what}); {remedy}") from error


def require_plain(file: h5py.File, size: int) -> None:
    """Refuse whatever is not groups and arrays of numbers or characters that lie in the file itself.

    Links to other files and names, virtual and external data, types beside numbers and characters,
    and arrays larger than what is stored of them are refused, before anything is read.

    Raises
    ------
    DamagedError
        With the name of what is refused.
    """
    stored = 0
    for count, (name, found) in enumerate(_objects(file, "", 0), 1):
        if count * _OBJECT > size:
            raise DamagedError("more objects than a file of that size can hold")
        if isinstance(found, h5py.Dataset):
            stored += _require_plain_array(name, found)
            if stored > size:
                raise DamagedError(f"{name} claims more data than the file has")


def _objects(group: h5py.Group, path: str, depth: int) -> Iterator[tuple[str, Any]]:
    if depth > _DEPTH:
        raise DamagedError(f"{path} is nested more than {_DEPTH} levels deep")
    for name in group:
        where = f"{path}/{name}"
        if group.id.links.get_info(name.encode("utf-8", "surrogateescape")).type != h5py.h5l.TYPE_HARD:
            raise DamagedError(f"{where} is a link to elsewhere")
        found = group[name]
        if isinstance(found, h5py.Datatype):
            raise DamagedError(f"{where} is neither a group nor an array")
        yield where, found
        if isinstance(found, h5py.Group):
            yield from _objects(found, where, depth + 1)


def _require_plain_array(name: str, data: h5py.Dataset) -> int:
    """Bytes that are stored of an array; DamagedError unless they are all of it, in this file."""
    made = data.id.get_create_plist()
    kind = data.id.get_type()
    characters = kind.get_class() == h5py.h5t.STRING and not kind.is_variable_str()
    if kind.get_class() not in _NUMBERS and not characters:
        raise DamagedError(f"{name} holds neither numbers nor characters")
    if made.get_layout() == h5py.h5d.VIRTUAL or made.get_external_count():
        raise DamagedError(f"{name} has its data elsewhere")
    filters = {made.get_filter(i)[0] for i in range(made.get_nfilters())}
    if not filters <= _FILTERS:
        raise DamagedError(f"{name} is stored by a filter of another program")
    stored = int(data.id.get_storage_size())
    most = stored * (_DEFLATED if h5py.h5z.FILTER_DEFLATE in filters else 1)
    if data.shape is None or prod(data.shape) * kind.get_size() > most:
        raise DamagedError(f"{name} claims more data than are stored of it")
    return stored


def attribute(group: h5py.Group, name: str) -> Any:
    """A text or a number among the attributes of a group or an array; a KeyError where it is none."""
    found = h5py.h5a.open(group.id, name.encode())
    kind = found.get_type()
    if found.shape != () or kind.get_class() not in (*_NUMBERS, h5py.h5t.STRING):
        raise DamagedError(f"attribute {name} of {group.name} is neither a number nor a text")
    if kind.get_size() > _longest(group):
        raise DamagedError(f"attribute {name} of {group.name} claims more data than the file has")
    return group.attrs[name]


def _longest(group: h5py.Group) -> int:
    return int(group.file.id.get_filesize())


def text(group: h5py.Group, name: str) -> str:
    """A text among the attributes of a group; a KeyError where there is none."""
    value = attribute(group, name)
    if not isinstance(value, str):
        raise DamagedError(f"attribute {name} of {group.name} is not text")
    return value
