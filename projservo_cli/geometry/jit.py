"""JIT compilation of the mathematics: its decorators, and a cache that never serves stale code.

Numba checks cached machine code against the file of the function alone, and would miss an edited helper in
another file. The cache folder therefore carries a hash of the sources of all compiled functions and of their
imports; every installation of the same sources shares it. If no folder is writable, each process compiles the
functions again.
"""

import gc
import hashlib
import os
import re
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from inspect import Parameter, signature
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, cast

import llvmlite.binding
import numba
import numpy as np
from filelock import FileLock
from numba.core import cgutils
from numba.core.caching import UserProvidedCacheLocator
from numba.core.compiler_lock import global_compiler_lock
from numba.core.errors import TypingError
from numba.core.registry import CPUDispatcher
from numba.extending import intrinsic

_Params = ParamSpec("_Params")
_Result = TypeVar("_Result")

_DECORATED = re.compile(rb"^@(?:inline|internal|merged|njit)$|^\w.* = njit\(", re.MULTILINE)
_IMPORT = re.compile(rb"^\s*from projservo_cli(?:\.([\w.]+))? import (\([^)]*\)|[^\n]*)", re.MULTILINE)


def compiled_sources(root: Path) -> dict[str, bytes]:
    """Sources of a package, by their paths in it, with compiled functions, and those that they import."""
    sources = {file.relative_to(root).as_posix(): file.read_bytes() for file in root.rglob("*.py")}
    needed: dict[str, bytes] = {}
    due = [name for name, source in sources.items() if _DECORATED.search(source)]
    while due:
        name = due.pop()
        if name in sources and name not in needed:
            needed[name] = sources[name]
            due += _imported(sources[name])
    return dict(sorted(needed.items()))


def _imported(source: bytes) -> Iterator[str]:
    """Yield paths that imports of a source may name: a module, a package, a module of a package."""
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
    """Folder for machine code of exactly these sources, or None if none is writable."""
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


# Maximum waiting time for a function, s: several times the time of the largest.
_MOST_S = 120.0
# Settings of Numba, attributes made at run time that its types do not list.
SETTINGS: Any = numba.config
# Its functions that write machine code, which have no types.
_CODE: Any = cgutils
# Whether the compiler is enabled.
COMPILED = not SETTINGS.DISABLE_JIT
# Folder of the package.
PACKAGE = Path(__file__).parents[1]
# Folder of the machine code.
CACHE_FOLDER = cache_folder(PACKAGE) if COMPILED else None


def is_cached(function: Any) -> bool:
    """Whether a process that calls a compiled function finds machine code of it."""
    code = function.py_func.__code__
    name = f"{Path(code.co_filename).stem}.{code.co_qualname}-{code.co_firstlineno}.*.nbi"
    return CACHE_FOLDER is not None and any(CACHE_FOLDER.rglob(name))


class _PlaceInPackage(UserProvidedCacheLocator):
    """Locator of machine code by the place of its source in the package, wherever that is installed."""

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> Any:
        """Return the locator of a function of the package, or None for Numba's own of any other."""
        located: Any = super().from_function
        return located(py_func, py_file) if Path(py_file).is_relative_to(PACKAGE) else None

    @classmethod
    def get_suitable_cache_subpath(cls, py_file: str) -> str:
        """Return the subfolder of the cache."""
        return "_".join(Path(py_file).parent.relative_to(PACKAGE).parts)


if CACHE_FOLDER is not None:
    SETTINGS.CACHE_DIR = str(CACHE_FOLDER)
    if "NUMBA_CACHE_LOCATOR_CLASSES" not in os.environ:
        SETTINGS.CACHE_LOCATOR_CLASSES = (
            f"{__name__}.{_PlaceInPackage.__name__},UserProvidedCacheLocator,IPythonCacheLocator"
        )
# The third level of the optimiser takes a sixth more compilation time and saves a tenth of a step.
if "NUMBA_OPT" not in os.environ:
    SETTINGS.OPT = type(SETTINGS.OPT)(2)
# Loops over joints and markers are too short for vectors of numbers, which take a twentieth more.
if "NUMBA_LOOP_VECTORIZE" not in os.environ:
    SETTINGS.LOOP_VECTORIZE = 0


# These functions borrow the arrays of their caller and allocate none, so they need no runtime that counts
# references, which takes a locked instruction for each of thirty arrays of a record.
# Strict arithmetic, without reordering and contraction, makes every mode agree to the bit.
_OPTIONS: dict[str, Any] = {
    "cache": CACHE_FOLDER is not None,
    "error_model": "numpy",
    "fastmath": False,
    "nogil": True,
    "_nrt": False,
    "no_cfunc_wrapper": True,  # no C code calls back
}
_UNCACHED = {name: value for name, value in _OPTIONS.items() if name != "cache"}


def njit(function: Callable[_Params, _Result], *, allocates: bool = False) -> Callable[_Params, _Result]:
    """Compile a function that may be called from Python.

    allocates : whether it makes arrays, or a structure of the compiler.
    """
    return _compiled(_Shared, function, _nrt=allocates)


@contextmanager
def _uncollected() -> Iterator[None]:
    """Hold back the garbage collector, which takes a tenth of the compilation time."""
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()


class _Shared(CPUDispatcher):
    """A compiled function that two processes never compile at the same time: one waits and loads it."""

    separate: Any = None  # function that compiled code calls in its place, if not a copy

    @property
    def _numba_type_(self) -> Any:
        """Type of the function in compiled code."""
        if self.separate is None:
            return super()._numba_type_
        context: Any = self.typingctx
        context.refresh()
        return context.resolve_value_type(self.separate)

    def compile(self, sig: Any) -> Any:
        """Compile the function for a signature, or load it if another process compiled it."""
        if CACHE_FOLDER is None:
            return super().compile(sig)
        path = CACHE_FOLDER / f"{self.py_func.__module__}.{self.py_func.__qualname__}.lock"
        # Locks in this order, as where functions call others.
        with global_compiler_lock, _uncollected(), ExitStack() as held:
            with suppress(OSError, NotImplementedError):  # no locks, or a timeout: both compile
                held.enter_context(FileLock(path, timeout=_MOST_S))
            entry = super().compile(sig)
        # Its callers, too, have to call its prerequisites before it runs: Numba forgets them as it loads.
        for made in cast(Any, self).overloads.values():
            made.library._reload_init.update(made.reload_init)
        return entry


class _Internal(_Shared):
    """A compiled function whose machine code takes no arguments from Python.

    The first call from Python compiles a caller for it; a small function is interpreted instead.
    """

    _caller: Callable[..., Any] | None = None

    def __call__(self, *arguments: Any) -> Any:
        """Call the function from Python."""
        if "forceinline" in self.targetoptions:
            return self.py_func(*arguments)
        if self._caller is None:
            # Not cached: another process could not find it, since its key is the function object.
            self._caller = numba.njit(**_UNCACHED)(lambda *values: self(*values))
        return self._caller(*arguments)


def internal(function: Callable[_Params, _Result], **further: Any) -> Callable[_Params, _Result]:
    """Compile a function that only compiled ones and tests call.

    Without the interface to Python it compiles a fifth faster, for a record of a hundred arrays.
    further : further options of the compiler.
    """
    return _compiled(_Internal, function, no_cpython_wrapper=True, **further)


def _compiled(
    kind: type[_Shared], function: Callable[_Params, _Result], **further: Any
) -> Callable[_Params, _Result]:
    """Return a function of a kind, or as it is without the compiler; further : options of the compiler."""
    if not COMPILED:
        return function
    dispatcher = kind(function, targetoptions={**_UNCACHED, "nopython": True, **further})
    if _OPTIONS["cache"]:
        dispatcher.enable_caching()
    return cast(Callable[_Params, _Result], dispatcher)


def inline(function: Callable[_Params, _Result]) -> Callable[_Params, _Result]:
    """Compile a helper that the optimiser merges into its callers; Python interprets it.

    Interpreted, a function of few calls, as of the begin of a run, needs the machine code of its callees
    alone.
    """
    return internal(function, forceinline=True)


def merged(function: Callable[_Params, _Result]) -> Callable[_Params, _Result]:
    """Merge a function with few callers into them, before the compiler proper sees it.

    A call from Python compiles it on its own.
    """
    return cast(Callable[_Params, _Result], numba.njit(**_OPTIONS, inline="always")(function))


@dataclass(frozen=True)
class _Separate:
    """A compiled function for arguments of some types, which machine code calls by a symbol.

    Machine code that is loaded again calls this first, to have the symbol defined.
    """

    module: str
    function: str
    types: tuple[Any, ...]

    @property
    def symbol(self) -> str:
        """The name for the linker, the same in every process."""
        types = hashlib.sha256(repr(self.types).encode()).hexdigest()
        return f"{self.module}.{self.function}.{types}"

    def __call__(self) -> Any:
        """Compile or load the function, define its symbol, and return its record of the compiler."""
        function = getattr(import_module(self.module), self.function)
        if self.types not in function.overloads:
            function.compile(self.types)
        made = function.overloads[self.types]
        llvmlite.binding.add_symbol(self.symbol, _address(made))
        return made


def _address(made: Any) -> int:
    """Address in this process of the machine code of a compiled function."""
    address: int = made.library.get_pointer_to_function(made.fndesc.llvm_func_name)
    return address


def separate(function: Callable[_Params, _Result]) -> Callable[_Params, _Result]:
    """Let compiled code call a compiled function in place, instead of a separate copy.

    Machine code holds a copy of every function that it calls, and of all that these call, each optimised
    again. A copy of a large function costs more time than the call; a copy of a small one in a loop does not.

    function : without default values.
    """
    if COMPILED:
        cast(Any, function).separate = _caller(function)
    return function


def _caller(function: Any) -> Any:
    """Return the function that compiled code calls in place of another."""
    own = signature(function.py_func)

    def call(typing_context: Any, *given: Any, **named: Any) -> Any:
        types = own.bind(*given, **named).args
        one = _Separate(function.py_func.__module__, function.py_func.__qualname__, types)
        made = one()

        def codegen(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            kind = context.call_conv.get_function_type(signature.return_type, types)
            callee = _CODE.get_or_insert_function(builder.module, kind, one.symbol)
            context.active_code_library._reload_init.add(one)
            return _called(context, builder, callee, signature.return_type, types, values)

        return made.signature, codegen

    stated: Any = call
    typing = Parameter("typing_context", Parameter.POSITIONAL_OR_KEYWORD)
    stated.__signature__ = own.replace(parameters=[typing, *own.parameters.values()])
    return intrinsic(stated)


def _called(context: Any, builder: Any, callee: Any, returned: Any, types: Any, values: Any) -> Any:
    """Write the call of a compiled function, which passes an exception on."""
    status, result = context.call_conv.call_function(builder, callee, returned, types, values)
    with _CODE.if_unlikely(builder, status.is_error):
        context.call_conv.return_status_propagate(builder, status)
    return result


class ByAddress:
    """Compiled functions of the same arguments and an integer result, which compiled code calls by address.

    Machine code holds a copy of every function that it calls by name, and of all that these call. A function
    called by its address is compiled by itself, when its address is first asked for.

    arguments : returns arguments of their types; their values mean nothing.
    """

    def __init__(self, arguments: Callable[[], tuple[Any, ...]]) -> None:
        self._arguments = arguments
        self._addresses: dict[Any, int] = {}
        self._functions: dict[int, Callable[..., int]] = {}

    @cached_property
    def types(self) -> tuple[Any, ...]:
        """The compiler's types of the arguments."""
        return tuple(map(numba.typeof, self._arguments()))

    def address(self, function: Any) -> int:
        """Address of a function in this process, which compiles or loads it."""
        if function not in self._addresses:
            address = id(function)
            if COMPILED:
                address = _address(function.get_compile_result(numba.int64(*self.types)))
            self._addresses[function] = address
            self._functions[address] = function
        return self._addresses[function]

    def caller(self) -> Callable[..., int]:
        """Return the function that calls the one of an address with a tuple of arguments."""
        if not COMPILED:
            return lambda address, arguments: self._functions[address](*arguments)

        @intrinsic
        def call(typing_context: Any, address: Any, arguments: Any) -> Any:
            if arguments.types != self.types:
                raise TypingError(f"called with {arguments.types}, compiled for {self.types}")

            def codegen(context: Any, builder: Any, signature: Any, values: Any) -> Any:
                kind = context.call_conv.get_function_type(signature.return_type, arguments.types)
                callee = builder.inttoptr(values[0], kind.as_pointer())
                unpacked = _CODE.unpack_tuple(builder, values[1])
                return _called(context, builder, callee, signature.return_type, arguments.types, unpacked)

            return numba.int64(address, arguments), codegen

        return cast(Callable[..., int], call)
