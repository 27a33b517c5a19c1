"""``projservo doctor``: what is installed, which extras, whether kernels are compiled, where results go."""

import importlib.metadata
import os
import platform
import re
import sys
from pathlib import Path
from typing import Any

from projservo_cli.cli.options import wrapped
from projservo_cli.cli.output import Console, print_json
from projservo_cli.version import __version__


def run(names: list[str], rest: list[str], options: dict[str, Any]) -> int:
    """Look at the installation; the exit code."""
    del names, rest
    packages, extras = requirements()
    missing = [name for name, version in packages.items() if version is None]
    value: dict[str, Any] = {
        "projservo": __version__,
        "package": Path(__file__).resolve().parents[1],
        "python": platform.python_version(),
        "interpreter": sys.executable,
        "processors": os.cpu_count(),
        "packages": packages,
        "missing": missing,
        "extras": {name: sorted(lacking) for name, lacking in extras.items()},
        "kernels": None if missing else _kernels(),
        "results": _results(),
    }
    if options["json"]:
        print_json(value)
    else:
        console = Console(quiet=options["quiet"], verbose=options["verbose"])
        for line in _words(value):
            console.show(wrapped(line))
    return 1 if missing or not value["results"]["writable"] else 0


def requirements() -> tuple[dict[str, str | None], dict[str, list[str]]]:
    """Versions of the packages every run needs, None where one is missing; and what each extra lacks."""
    try:
        needed = importlib.metadata.requires("projservo") or []
    except importlib.metadata.PackageNotFoundError:  # run from sources that were never installed
        needed = []
    packages: dict[str, str | None] = {}
    extras: dict[str, list[str]] = {}
    for text in needed:
        (name,) = re.findall(r"^[\w.-]+", text)
        extra = re.search(r"extra\s*==\s*['\"]([\w.-]+)['\"]", text)
        try:
            version = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            version = None
        if extra is None:
            packages[name] = version
        else:
            extras.setdefault(extra[1], []).extend([name] if version is None else [])
    return packages, extras


def _kernels() -> dict[str, Any]:
    from projservo_cli.geometry.jit import CACHE_FOLDER, COMPILED

    count = 0 if CACHE_FOLDER is None else sum(1 for _ in CACHE_FOLDER.rglob("*.nbi"))
    return {"jit": COMPILED, "cache": CACHE_FOLDER, "compiled": count}


def _results() -> dict[str, Any]:
    folder = Path("results").absolute()
    there = next(path for path in (folder, *folder.parents) if path.exists())
    return {"folder": folder, "writable": there.is_dir() and os.access(there, os.W_OK | os.X_OK)}


def _words(value: dict[str, Any]) -> list[str]:
    versions = [f"{name} {version or 'MISSING'}" for name, version in value["packages"].items()]
    results = value["results"]
    return [
        f"projservo {value['projservo']} in {value['package']}",
        f"python {value['python']} at {value['interpreter']}, {value['processors']} processors",
        f"packages: {', '.join(versions) or 'unknown: projservo is not installed, only run'}",
        *(
            f"extra {name}: "
            + (f"lacks {', '.join(lacking)}: pip install 'projservo[{name}]'" if lacking else "installed")
            for name, lacking in value["extras"].items()
        ),
        f"kernels: {_kernel_words(value['kernels'])}",
        f"results: {results['folder']}" + ("" if results["writable"] else ", which CANNOT be written to"),
    ]


def _kernel_words(kernels: dict[str, Any] | None) -> str:
    if kernels is None:
        return "unknown, packages are missing"
    if not kernels["jit"]:
        return "not compiled at all: NUMBA_DISABLE_JIT is set"
    if kernels["cache"] is None:
        return "compiled anew in every run: no folder can be written; set PROJSERVO_CACHE_DIR"
    if not kernels["compiled"]:
        return f"to be compiled by the first run, once, into {kernels['cache']}"
    return f"{kernels['compiled']} compiled, in {kernels['cache']}"
