"""Compiling in a second process: the same types as a real task, and nothing left running."""

import subprocess
import sys

import pytest

from projservo_cli.stages import compilation

SAME_TYPES = """
from pathlib import Path

import numba
from numba.core.types import unliteral

from projservo_cli.config import load_config
from projservo_cli.geometry.jit import _OPTIONS
from projservo_cli.loop import beginning, compiled
from projservo_cli.stages import calibrate, compilation, plan, servo
from projservo_cli.task.path import follow

def anew(function):
    return numba.njit(**{**_OPTIONS, "cache": False})(function.py_func)

for compile_part in compilation.PARTS.values():
    compile_part()
parts = [follow, *(value for value in vars(compilation).values() if hasattr(value, "overloads"))]
# The loop is not taken from the cache, where it would need its parts no more.
compiled.command = anew(compiled.command)
beginning.run = servo.run_loop = anew(compiled.run)
config = load_config(Path("configs/paper.yaml"))
calibration = calibrate.run(config)[1]
servo.run(config, calibration, plan.run(config, calibration), "exact")
print(*(len({tuple(map(unliteral, types)) for types in part.overloads}) for part in parts))
"""


def test_the_path_of_no_meaning_can_be_followed():
    compilation.compile_path()


@pytest.mark.volume
def test_a_real_task_needs_no_other_types(request):
    answer = subprocess.run(
        [sys.executable, "-c", SAME_TYPES],
        cwd=request.config.rootpath,
        capture_output=True,
        text=True,
        check=True,
    )
    made = answer.stdout.split()
    assert len(made) > 8
    assert set(made) == {"1"}


@pytest.mark.parametrize(("processors", "processes"), [(2, 1), (3, 2)])
def test_the_processes_end_with_the_work(monkeypatch, processors, processes):
    started = []
    real = subprocess.Popen

    def popen(*arguments, **options):
        started.append(real(*arguments, **options))
        return started[-1]

    monkeypatch.setattr(compilation.subprocess, "Popen", popen)
    monkeypatch.setattr(compilation.os, "cpu_count", lambda: processors)
    with compilation.compiling_beside("path", "loop"):
        assert [process.poll() for process in started] == [None] * processes
    assert None not in [process.poll() for process in started]
