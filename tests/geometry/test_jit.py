"""Where machine code is cached: keyed by every source it depends on, or not at all."""

import importlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from numba.core.registry import CPUDispatcher

import projservo_cli
from projservo_cli.geometry.jit import cache_folder, compiled_sources
from tests.conftest import INTERPRETED

PACKAGE = Path(projservo_cli.__file__).parent


@pytest.fixture
def copy(tmp_path):
    """Copy of the package whose sources may be edited."""
    root = tmp_path / "package"
    shutil.copytree(PACKAGE, root, ignore=shutil.ignore_patterns("__pycache__"))
    return root


@pytest.mark.parametrize(
    "name", ["records.py", "control/law.py", "geometry/stereo.py", "simulation/analytic_plant.py"]
)
def test_an_edited_helper_or_a_new_kernel_makes_another_cache(copy, name, tmp_path, monkeypatch):
    monkeypatch.setenv("PROJSERVO_CACHE_DIR", str(tmp_path / "cache"))
    before = cache_folder(copy)
    assert before.parent == tmp_path / "cache" / "projservo"
    assert before.is_dir()
    assert before == cache_folder(copy) == cache_folder(PACKAGE)
    file = copy / name
    file.write_text(file.read_text(encoding="utf-8") + "\n# edited\n", encoding="utf-8")
    edited = cache_folder(copy)
    (copy / "cli" / "new.py").write_text("", encoding="utf-8")
    assert cache_folder(copy) == edited != before
    (copy / "cli" / "new.py").write_text("@njit\ndef f(x):\n    return x\n", encoding="utf-8")
    assert cache_folder(copy) not in (before, edited)


@pytest.mark.skipif(INTERPRETED, reason="nothing is compiled: NUMBA_DISABLE_JIT is set")
def test_what_a_compiled_function_calls_lies_in_a_hashed_source():
    """By the globals of all that the compiler took in, where the hash goes by imports."""
    hashed = compiled_sources(PACKAGE).keys()
    for file in PACKAGE.rglob("*.py"):
        importlib.import_module(".".join(["projservo_cli", *file.relative_to(PACKAGE).with_suffix("").parts]))
    functions = {
        value
        for name, module in list(sys.modules.items())
        if name.startswith("projservo_cli")
        for value in vars(module).values()
        if isinstance(value, CPUDispatcher)
    }
    assert len(functions) > 100
    for function in functions:
        names = function.py_func.__code__.co_names
        used = [function.py_func, *(function.py_func.__globals__.get(name) for name in names)]
        for value in used:
            home = getattr(value, "__module__", None) or ""
            if home.startswith("projservo_cli"):
                path = home.removeprefix("projservo_cli.").replace(".", "/")
                assert {f"{path}.py", f"{path}/__init__.py"} & hashed, (function, value)


def test_no_cache_where_nothing_can_be_written(copy, tmp_path, monkeypatch):
    (tmp_path / "occupied").write_text("a file, not a folder", encoding="utf-8")
    monkeypatch.setenv("PROJSERVO_CACHE_DIR", str(tmp_path / "occupied"))
    assert cache_folder(copy) is None


CALL = """
import json
import numpy as np
from projservo_cli.geometry.jit import CACHE_FOLDER
from projservo_cli.geometry.kernels import least_squares, new_system
from projservo_cli.task.visibility import margin_coefficients
values = margin_coefficients((1.0, 2.0, 3.0, 4.0), (0.5,) * 16, (1.0, 1.0, 0.0, 2.0))
# One that only compiled functions call is called from Python by way of another, and cached as well.
system, x = new_system(2, 3), np.zeros(2)
system.B[:, :3], system.rhs[:3] = [[1.0, 2.0, 3.0], [4.0, 0.0, 6.0]], [9.0, 2.0, 15.0]
assert least_squares(system, 3, x)
assert np.allclose(x, [1.0, 2.0])
hits = [sum(function.stats.cache_hits.values()) for function in (margin_coefficients, least_squares)]
print(json.dumps([values, CACHE_FOLDER is not None, *hits]))
"""


def called(root, **environment):
    """What the script says of a kernel and its cache, in a fresh interpreter."""
    kept = {k: v for k, v in os.environ.items() if k not in ("PROJSERVO_CACHE_DIR", "XDG_CACHE_HOME")}
    environment = {**kept, "PYTHONPATH": str(root.parent), "PYTHONDONTWRITEBYTECODE": "1", **environment}
    done = subprocess.run(
        [sys.executable, "-c", CALL],
        env=environment,
        cwd=root.parent,
        capture_output=True,
        text=True,
        check=True,
    )
    return json.loads(done.stdout)


@pytest.mark.volume
def test_installed_read_only_with_an_edit_and_without_a_home(copy):
    """Cached from a read-only install for all; an edit in another file is never missed; no home, no cache."""
    root = copy.rename(copy.parent / "projservo_cli")
    writable = {path: path.stat().st_mode for path in [root, *root.rglob("*")]}
    for path, mode in writable.items():
        path.chmod(mode & ~0o222)
    home = root.parent / "home"
    try:
        first = called(root, HOME=str(home))
        assert first == [[51.0, -20.0, -40.0], True, 0, 0]
        elsewhere = shutil.copytree(root, root.parent / "elsewhere" / root.name)
        assert called(elsewhere, HOME=str(home)) == [first[0], True, 1, 1]
    finally:
        for path, mode in writable.items():
            path.chmod(mode)
    algebra = root / "geometry" / "algebra.py"
    text = algebra.read_text(encoding="utf-8")
    edited = text.replace("return (a[0] * A[0] + a[1] * A[1])", "return 7.0 + (a[0] * A[0] + a[1] * A[1])")
    assert edited != text
    algebra.write_text(edited, encoding="utf-8")
    values, _, *hits = called(root, HOME=str(home))
    assert values != first[0]
    assert hits[0] == 0
    assert called(root, HOME=os.devnull) == [values, False, 0, 0]
