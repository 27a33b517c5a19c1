"""Compiling in a second process: the same types as a real task, and nothing left running."""

import subprocess
import sys

import pytest

from projservo_cli.stages import compilation

SAME_TYPES = """
from pathlib import Path

from projservo_cli.config import load_config
from projservo_cli.stages import calibrate, compilation, plan, servo
from projservo_cli.task.path import follow

for compile_part in compilation.PARTS.values():
    compile_part()
compiled = [follow, *(value for value in vars(compilation).values() if hasattr(value, "overloads"))]
config = load_config(Path("configs/paper.yaml"))
calibration = calibrate.run(config)[1]
planned = plan.run(config, calibration)
servo.run(config, calibration, planned, "exact")
print(len(compiled), *(len(function.overloads) for function in compiled))
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
    functions, *overloads = map(int, answer.stdout.split())
    assert functions > 8
    assert overloads == [1] * functions


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
