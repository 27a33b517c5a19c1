"""Source files of a plug-in class, found without running any."""

import ast
import hashlib
import os
import sys
import sysconfig
from collections.abc import Iterator
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path

_INSTALLED = tuple({sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")})


def source_hash(target: str) -> str:
    """Return a hash of the module of a class and of all modules of its author that it imports.

    Modules of the author are in the same package, or were not installed. They are found by
    the import statements of each; one that is imported by a name made at run time is not.

    target : ``module:Class``.
    The hash is empty if the module is not found, or has no source.
    """
    module = target.split(":")[0]
    top = module.split(".")[0]
    sources: dict[str, bytes] = {}
    due = [module]
    while due:
        for spec in _specs(due.pop()):
            if spec.name not in sources and (source := _source(spec, top)) is not None:
                sources[spec.name] = source
                due += _imports(spec, source)
    if module not in sources:
        return ""
    digest = hashlib.sha256()
    for name, source in sorted(sources.items()):
        digest.update(f"{name}\0{len(source)}\0".encode() + source)
    return digest.hexdigest()


def _specs(module: str) -> Iterator[ModuleSpec]:
    """Specifications of the packages of a module and of itself, as far as there are any."""
    parts, path = module.split("."), None
    for i in range(len(parts)):
        name = ".".join(parts[: i + 1])
        finders = (finder.find_spec(name, path) for finder in sys.meta_path)
        spec = next((candidate for candidate in finders if candidate is not None), None)
        if spec is None and path is None:
            spec = PathFinder.find_spec(name, [os.getcwd()])
        if spec is None:
            return
        yield spec
        path = spec.submodule_search_locations
        if path is None:
            return


def _source(spec: ModuleSpec, top: str) -> bytes | None:
    """Source of a module of the author whose package is ``top``; None if it is of another or has none."""
    if not spec.has_location or not (spec.origin or "").endswith(".py"):
        return None
    file = Path(spec.origin or "")
    own = spec.name.split(".")[0]
    if own != top and (own == "projservo_cli" or any(file.is_relative_to(folder) for folder in _INSTALLED)):
        return None
    try:
        return file.read_bytes()
    except OSError:
        return None


def _imports(spec: ModuleSpec, source: bytes) -> Iterator[str]:
    """Names of modules that a source imports, or may: a name from a package may be a module of it."""
    try:
        statements = list(ast.walk(ast.parse(source)))
    except (SyntaxError, ValueError):  # its import reports it
        return
    package = spec.name.split(".") if spec.submodule_search_locations else spec.name.split(".")[:-1]
    for statement in statements:
        if isinstance(statement, ast.Import):
            yield from (alias.name for alias in statement.names)
        elif isinstance(statement, ast.ImportFrom):
            above = package[: len(package) + 1 - statement.level] if statement.level else []
            base = ".".join([*above, *(statement.module or "").split(".")]).strip(".")
            if base:
                yield base
                yield from (f"{base}.{alias.name}" for alias in statement.names)
