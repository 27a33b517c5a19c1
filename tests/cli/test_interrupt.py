"""Ctrl-C ends a command whatever Python is at when it comes."""

import subprocess
import sys

import pytest

from tests.conftest import ROOT

COMMAND = """\
import os, signal, time
from projservo_cli import cli

class Ended:
    def __del__(self):
        {at_the_end}
        time.sleep(1)  # what was raised is raised here, where it can only be ignored

def work(arguments):
    Ended()
    {then}

cli.main.invoke = work
cli.main(["doctor"])
"""
INTERRUPT = ("os.kill(os.getpid(), signal.SIGINT)", "time.sleep(60)", 130, "projservo: interrupted\n")
# As a compilation ends that was broken off where C called Python.
BROKEN_OFF = (INTERRUPT[0], "raise RuntimeError('no compiled object')", *INTERRUPT[2:])
ELSE = ("raise ValueError('odd')", "pass", 0, "ValueError: odd")


@pytest.mark.parametrize(("at_the_end", "then", "code", "told"), [INTERRUPT, BROKEN_OFF, ELSE])
def test_what_comes_at_the_end_of_an_object_is_not_lost(at_the_end, then, code, told):
    command = COMMAND.format(at_the_end=at_the_end, then=then)
    done = subprocess.run(
        [sys.executable, "-c", command], cwd=ROOT, capture_output=True, text=True, timeout=50, check=False
    )
    assert done.returncode == code
    assert told in done.stderr
    assert (done.stderr == told) == (code == 130)
