"""Ctrl-C ends a command whatever Python is at when it comes."""

import subprocess
import sys

from tests.conftest import ROOT

COMMAND = """\
import os, signal, time
from projservo_cli import cli

class Ended:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(1)  # the interrupt is raised here, where it can only be ignored

def work(arguments):
    Ended()
    time.sleep(60)

cli.main.invoke = work
cli.main(["doctor"])
"""


def test_an_interrupt_that_comes_at_the_end_of_an_object_is_not_lost():
    done = subprocess.run(
        [sys.executable, "-c", COMMAND], cwd=ROOT, capture_output=True, text=True, timeout=50, check=False
    )
    assert (done.returncode, done.stderr) == (130, "projservo: interrupted\n")


def test_what_else_cannot_be_raised_is_still_told():
    command = COMMAND.replace("os.kill(os.getpid(), signal.SIGINT)", "raise ValueError('odd')").replace(
        "60", "0"
    )
    done = subprocess.run(
        [sys.executable, "-c", command], cwd=ROOT, capture_output=True, text=True, timeout=50, check=False
    )
    assert "ValueError: odd" in done.stderr
