"""Compiling beside the work: a second process fills the cache with what is needed later.

The compiler works in one thread. On the first run on a machine, the kernels of the planned path are
made in a process of their own while this one calibrates and makes the kernels of the loop.
"""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from projservo_cli.records import NO_LENS, Model
from projservo_cli.task.along import along
from projservo_cli.task.margins import CONSTRAINTS, Reaching, within

JOINTS = 6


@contextmanager
def compiling_beside() -> Iterator[None]:
    """Run ``compile_path`` in another process, at most as long as the block lasts.

    What that process does not get done, this one compiles when it needs it.
    """
    command = [sys.executable, "-P", "-m", __name__]
    process = subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        yield
    finally:
        process.terminate()
        process.wait()


def compile_path() -> None:
    """Follow a path of no meaning, with arrays of the types that every task has."""
    H_hat = np.zeros((JOINTS, 4, 4))
    types = np.zeros(JOINTS, dtype=np.int64)
    a_inf = np.array([0.0, 0.0, 0.0, 1.0])
    P = np.tile(np.eye(3, 4), (2, 1, 1))
    model = Model(P, H_hat, types, np.zeros(JOINTS), a_inf, NO_LENS)
    demands = within(np.full(JOINTS, -1.0), np.full(JOINTS, 1.0))
    A = np.array([[0.0, 0.0, 1.0, 1.0], [1.0, 0.0, 1.0, 1.0], [1.0, 1.0, 1.0, 1.0], [0.0, 1.0, 2.0, 1.0]])
    O = np.tile(a_inf, (2, 1))
    reaching = Reaching(
        model, demands, H_hat[:3], np.zeros(3), A, a_inf, O, np.zeros(JOINTS), np.ones(len(CONSTRAINTS))
    )
    along(reaching, np.zeros((2, 3)))


if __name__ == "__main__":
    compile_path()
