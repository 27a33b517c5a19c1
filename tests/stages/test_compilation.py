"""Compiling in a second process: the same types as a real task, and nothing left running."""

import subprocess
import sys

import pytest

from projservo_cli.stages import compilation

SAME_TYPES = """
from pathlib import Path

from projservo_cli.config import load_config
from projservo_cli.stages import plan
from projservo_cli.stages.calibrate import run
from projservo_cli.stages.compilation import compile_path
from projservo_cli.task.path import follow

compile_path()
made = len(follow.overloads)
config = load_config(Path("configs/paper.yaml"))
plan.run(config, run(config)[1])
print(made, len(follow.overloads))
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
    assert answer.stdout.split() == ["1", "1"]


def test_the_process_ends_with_the_work(monkeypatch):
    started = []
    real = subprocess.Popen

    def popen(*arguments, **options):
        started.append(real(*arguments, **options))
        return started[-1]

    monkeypatch.setattr(compilation.subprocess, "Popen", popen)
    with compilation.compiling_beside():
        assert started[0].poll() is None
    assert started[0].poll() is not None
