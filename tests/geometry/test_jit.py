"""Where machine code is cached: keyed by every source it depends on, or not at all."""

import importlib
import os
import shutil
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from filelock import FileLock
from numba.core.registry import CPUDispatcher

import projservo_cli
from projservo_cli.geometry import jit
from projservo_cli.geometry.jit import cache_folder, compiled_sources
from tests.conftest import INTERPRETED

PACKAGE = Path(projservo_cli.__file__).parent


def test_an_edited_helper_or_a_new_kernel_makes_another_cache(tmp_path, monkeypatch):
    copy = tmp_path / "package"
    shutil.copytree(PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setenv("PROJSERVO_CACHE_DIR", str(tmp_path / "cache"))
    found = [cache_folder(copy)]
    assert found[0].parent == tmp_path / "cache" / "projservo"
    assert found[0].is_dir()
    assert found[0] == cache_folder(copy) == cache_folder(PACKAGE)
    new = "cli/new.py"
    for name, text in (
        ("records.py", "# 1\n"),
        ("geometry/stereo.py", "# 2\n"),
        (new, "@njit\ndef f(x): ...\n"),
    ):
        (copy / new).touch()
        assert cache_folder(copy) == found[-1]
        with (copy / name).open("a", encoding="utf-8") as file:
            file.write(text)
        found.append(cache_folder(copy))
    assert len(set(found)) == 4
    (tmp_path / "occupied").write_text("a file, not a folder", encoding="utf-8")
    monkeypatch.setenv("PROJSERVO_CACHE_DIR", str(tmp_path / "occupied"))
    assert cache_folder(copy) is None


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


def after(x):
    return x + 1.0


@pytest.mark.skipif(INTERPRETED, reason="nothing is compiled: NUMBA_DISABLE_JIT is set")
def test_what_another_process_compiles_is_waited_for(tmp_path, monkeypatch):
    monkeypatch.setattr(jit, "CACHE_FOLDER", tmp_path)
    function, found = jit.inline(after), []
    thread = threading.Thread(target=lambda: found.append(function.compile("float64(float64)")))
    with FileLock(tmp_path / f"{__name__}.after.lock"):
        thread.start()
        thread.join(0.3)
        assert not found
    thread.join(60.0)
    assert found


_CALLER = """
import sys
from projservo_cli.geometry.jit import njit, separate

@separate
@njit
def inverse(x, y):
    if x == 0.0:
        raise ValueError("nothing")
    return y / x

@njit
def caller(x):
    return inverse(x, 3.0) + inverse(y=1.0, x=x)

@njit
def outer(x):
    return caller(x)

if __name__ == "__main__":
    import one
    if "outer" in sys.argv:
        print(one.outer(2.0), sum(one.outer.stats.cache_hits.values()))
        sys.exit()
    print(one.caller(2.0), sum(one.caller.stats.cache_hits.values()), "fdiv" in one.caller.inspect_llvm(
        one.caller.signatures[0]) if "look" in sys.argv else "")
    try:
        one.caller(0.0)
    except ValueError as error:
        print(error)
"""


@pytest.mark.skipif(INTERPRETED, reason="nothing is compiled: NUMBA_DISABLE_JIT is set")
def test_a_separate_function_is_called_where_it_is_and_found_again_by_another_process(tmp_path):
    (tmp_path / "one.py").write_text(_CALLER, encoding="utf-8")
    environment = {**os.environ, "PROJSERVO_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(PACKAGE.parent)}

    def told(*arguments):
        command = [sys.executable, "one.py", *arguments]
        run = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
        assert run.returncode == 0, run.stderr
        return run.stdout.split()

    # The caller holds no division of its own, and the error of the function comes through it.
    assert told("look") == ["2.0", "0", "False", "nothing"]
    assert told() == ["2.0", "1", "nothing"]
    # So does one that was compiled where its caller was loaded, as after a compilation that was broken off.
    assert told("outer") == ["2.0", "0"]
    assert told("outer") == ["2.0", "1"]
