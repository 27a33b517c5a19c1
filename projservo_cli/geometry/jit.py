"""JIT compilation of the mathematics: one decorator, and a cache that never serves stale code.

Numba decides whether cached machine code is fresh by the file of the function itself, so an edited
helper in another file would go unnoticed. The cache folder therefore carries a hash of all sources
that compiled functions may come from, by what these import; where no folder can be written, the functions
compile anew in each process.
"""

import hashlib
import os
import re
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, cast

import numba
import numpy as np
from numba.core.registry import CPUDispatcher
from numba.extending import register_jitable

_Params = ParamSpec("_Params")
_Result = TypeVar("_Result")

_DECORATED = re.compile(rb"^@(?:allocating|composed|inline|internal|merged|njit)$", re.MULTILINE)
_IMPORT = re.compile(rb"^\s*from projservo_cli(?:\.([\w.]+))? import (\([^)]*\)|[^\n]*)", re.MULTILINE)


def compiled_sources(root: Path) -> dict[str, bytes]:
    """Sources of a package, by their paths in it, that have compiled functions or are imported by such."""
    sources = {file.relative_to(root).as_posix(): file.read_bytes() for file in root.rglob("*.py")}
    found: dict[str, bytes] = {}
    due = [name for name, source in sources.items() if _DECORATED.search(source)]
    while due:
        name = due.pop()
        if name in sources and name not in found:
            found[name] = sources[name]
            due += _imported(sources[name])
    return dict(sorted(found.items()))


def _imported(source: bytes) -> Iterator[str]:
    """Paths that imports of a source may stand for: a module, a package, a module of a package."""
    for module, names in _IMPORT.findall(source):
        parts = module.decode().split(".") if module else []
        yield "/".join([*parts, "__init__.py"])
        if parts:
            yield "/".join(parts) + ".py"
        for name in re.findall(r"\w+", names.decode()):
            yield "/".join([*parts, f"{name}.py"])


def _source_hash(root: Path) -> str:
    """Hash of the sources that machine code depends on, and of the compiler's version."""
    digest = hashlib.sha256(f"{sys.version}|{numba.__version__}|{np.__version__}".encode())
    for name, source in compiled_sources(root).items():
        digest.update(name.encode())
        digest.update(source)
    return digest.hexdigest()[:16]


def cache_folder(root: Path) -> Path | None:
    """Folder for machine code of exactly these sources, or None where nothing can be written."""
    base = os.environ.get("PROJSERVO_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME")
    if base is None:
        try:
            base = str(Path.home() / ".cache")
        except RuntimeError:
            return None
    folder = Path(base) / "projservo" / f"kernels-{_source_hash(root)}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError:
        return None
    return folder


# The compiler's settings are attributes made at run time, which its types do not list.
SETTINGS: Any = numba.config
COMPILED = not SETTINGS.DISABLE_JIT
CACHE_FOLDER = cache_folder(Path(__file__).parents[1]) if COMPILED else None
if CACHE_FOLDER is not None:
    SETTINGS.CACHE_DIR = str(CACHE_FOLDER)
# The third level of the optimiser costs a sixth of the compilation more and gains a tenth of a step.
if "NUMBA_OPT" not in os.environ:
    SETTINGS.OPT = type(SETTINGS.OPT)(2)


# Machine code of these functions borrows the arrays of its caller and makes none: without the runtime
# that counts references, passing a record of thirty arrays on costs no thirty locked instructions.
# Strict arithmetic, no reordering and no contraction: every mode agrees to the bit.
_OPTIONS: dict[str, Any] = {
    "cache": CACHE_FOLDER is not None,
    "error_model": "numpy",
    "fastmath": False,
    "nogil": True,
    "_nrt": False,
    "no_cfunc_wrapper": True,  # for callbacks of C code, of which there are none
}
_UNCACHED = {name: value for name, value in _OPTIONS.items() if name != "cache"}


def njit(function: Callable[_Params, _Result]) -> Callable[_Params, _Result]:
    """Compile a function that allocates nothing and may be called from Python."""
    return cast(Callable[_Params, _Result], numba.njit(**_OPTIONS)(function))


class _Internal(CPUDispatcher):
    """A compiled function whose machine code takes no arguments from Python.

    Python would call into nowhere; its calls go by way of a compiled caller instead, made at the first, or
    are interpreted where the function is small.
    """

    _caller: Callable[..., Any] | None = None

    def __call__(self, *arguments: Any) -> Any:
        """Call from Python; ``arguments`` and what is returned are those of the function."""
        if "forceinline" in self.targetoptions:
            return self.py_func(*arguments)
        if self._caller is None:
            # Kept in no cache: another process would not find it, for it is known by the function it holds.
            self._caller = numba.njit(**_UNCACHED)(lambda *values: self(*values))
        return self._caller(*arguments)


def internal(function: Callable[_Params, _Result], **given: Any) -> Callable[_Params, _Result]:
    """Compile a function like ``njit`` that only compiled ones call, but for tests.

    To take a record of a hundred arrays from Python would be a fifth of its compilation. Further options of
    the compiler may be ``given``.
    """
    if not COMPILED:
        return function
    options = {**_UNCACHED, "nopython": True, "no_cpython_wrapper": True, **given}
    dispatcher = _Internal(function, targetoptions=options)
    if _OPTIONS["cache"]:
        dispatcher.enable_caching()
    return cast(Callable[_Params, _Result], dispatcher)


def allocating(function: Callable[_Params, _Result]) -> Callable[_Params, _Result]:
    """Compile a function that makes arrays of its own, for sweeps that take milliseconds a call."""
    return cast(Callable[_Params, _Result], numba.njit(**{**_OPTIONS, "_nrt": True})(function))


def composed(function: Callable[_Params, _Result]) -> Callable[_Params, _Result]:
    """Compile a function as a part of those compiled ones that call it.

    Called from Python it is interpreted and calls compiled functions, so that a single run needs no machine
    code but theirs.
    """
    return register_jitable(**_UNCACHED)(function)


def inline(function: Callable[_Params, _Result]) -> Callable[_Params, _Result]:
    """Compile a small helper that the optimiser merges into its callers; Python interprets it."""
    return internal(function, forceinline=True)


def merged(function: Callable[_Params, _Result]) -> Callable[_Params, _Result]:
    """Merge a function into its callers, of which it has few, before the compiler proper sees it.

    On its own it is compiled only where it is called from Python.
    """
    return cast(Callable[_Params, _Result], numba.njit(**_OPTIONS, inline="always")(function))
