"""Files that may crash the library that reads them, read by a process of its own with bounded means."""

import signal
import subprocess
import sys
from pathlib import Path

from projservo_cli.records import InputError

SECONDS = 60  # of time and of a processor; a file of 100 MB takes one
MEMORY = 300_000_000  # bytes, beside what the process has when it begins and some copies of the file
COPIES = 4
_REMEDY = "delete it or use another"


def copied(path: Path, copy: Path) -> None:
    """Read a run file in another process, and write what is sound of it to ``copy``.

    Raises
    ------
    InputError
        What is wrong with the file, or how the process ended that could not read it.
    """
    command = [sys.executable, "-P", "-m", __name__, str(path.absolute()), str(copy), str(path)]
    try:
        ended = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, timeout=SECONDS, check=False
        )
    except subprocess.TimeoutExpired as error:
        raise InputError(f"{path}: damaged: reading it takes more than {SECONDS} s; {_REMEDY}") from error
    said = ended.stdout.decode(errors="replace").strip()
    if ended.returncode == 0:
        return
    if ended.returncode == 2 and said:
        raise InputError(said)
    raise InputError(f"{path}: damaged: reading it ended with {_end(ended.returncode)}; {_REMEDY}")


def _end(code: int) -> str:
    if code < 0:
        return signal.Signals(-code).name
    return "too little memory" if code == _NO_MEMORY else f"exit code {code}"


_NO_MEMORY = 3


def _limit(size: int) -> None:
    """Bound the memory, the time and the files of this process, where the system can."""
    if sys.platform == "win32":
        return
    import resource

    try:
        now = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * resource.getpagesize()
    except OSError:  # no Linux; much of what a process claims there is never used
        now = 2_000_000_000
    limits = {
        resource.RLIMIT_AS: now + MEMORY + COPIES * size,
        resource.RLIMIT_CPU: SECONDS,
        resource.RLIMIT_FSIZE: 1_000_000 + COPIES * size,
        resource.RLIMIT_CORE: 0,
    }
    for kind, limit in limits.items():
        _, most = resource.getrlimit(kind)
        bound = limit if most == resource.RLIM_INFINITY else min(limit, most)
        resource.setrlimit(kind, (bound, most))


def _main(path: Path, copy: Path, name: str) -> int:
    from dataclasses import replace

    from projservo_cli.store import read, save

    _limit(path.stat().st_size)
    try:
        save(replace(read(path), path=copy))
    except InputError as error:
        print(str(error).replace(str(path), name))
        return 2
    except MemoryError:
        return _NO_MEMORY
    return 0


if __name__ == "__main__":
    sys.exit(_main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3]))
