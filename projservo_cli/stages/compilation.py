"""Compiling beside the work: other processes fill the cache with what is needed later.

The compiler works in one thread. On the first run on a machine, the kernels of the planned path and the parts
of the loop are made in processes of their own while this one calibrates and makes what is needed first.
"""

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import numpy as np

from projservo_cli.control.direct_two import single_rotation
from projservo_cli.control.exact import continued, first_order
from projservo_cli.control.image_based import pseudo_inverse, put_view
from projservo_cli.control.law import measure
from projservo_cli.geometry.jit import compile_for
from projservo_cli.geometry.mechanisms import NO_OPERATOR
from projservo_cli.loop.compiled import advance
from projservo_cli.loop.summary import Ends, path_deviation, summary
from projservo_cli.loop.trial import new_stage
from projservo_cli.records import NO_LENS, Model
from projservo_cli.robots.simulated import observe
from projservo_cli.task.along import along
from projservo_cli.task.face import MIDPOINT, Task
from projservo_cli.task.margins import CONSTRAINTS, Reaching, within
from projservo_cli.task.partition import no_parts

JOINTS = 6
POINTS = 4


@contextmanager
def compiling_beside(*parts: str) -> Iterator[None]:
    """Compile some of ``PARTS``, the first of them first, in other processes while the block lasts.

    There is a process for each part where a processor is left for it, else one for all. What they do not
    get done, this process compiles when it needs it.
    """
    alone = (os.cpu_count() or 1) > len(parts)
    with ExitStack() as stack:
        for some in [[part] for part in parts] if alone else [parts]:
            process = subprocess.Popen(
                [sys.executable, "-P", "-m", __name__, *some],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
            stack.callback(process.wait)
            stack.callback(process.terminate)
        yield


def any_model() -> Model:
    """A model of no meaning, with arrays of the types that every model has."""
    P = np.tile(np.eye(3, 4), (2, 1, 1))
    types = np.zeros(JOINTS, dtype=np.int64)
    a_inf = np.array([0.0, 0.0, 0.0, 1.0])
    return Model(P, np.zeros((JOINTS, 4, 4)), types, np.zeros(JOINTS), a_inf, NO_LENS)


def compile_path() -> None:
    """Follow a path of no meaning, with arrays of the types that every task has."""
    model = any_model()
    demands = within(np.full(JOINTS, -1.0), np.full(JOINTS, 1.0))
    A = np.array([[0.0, 0.0, 1.0, 1.0], [1.0, 0.0, 1.0, 1.0], [1.0, 1.0, 1.0, 1.0], [0.0, 1.0, 2.0, 1.0]])
    O = np.tile(model.a_inf, (2, 1))
    motions, still = model.H_hat_0[:3], np.zeros(JOINTS)
    reaching = Reaching(
        model, demands, motions, np.zeros(3), A, model.a_inf, O, still, np.ones(len(CONSTRAINTS))
    )
    along(reaching, np.zeros((2, 3)))


def compile_loop() -> None:
    """Compile the parts of the closed loop, and what tells of a run, those first that it needs last.

    The loop itself is left to the process that runs it: it would wait for the last of its parts.
    """
    model, q = any_model(), np.zeros(JOINTS)
    _, plant, noise, state, log = new_stage(model, POINTS, q, q)
    parts, H, s, points, goal = no_parts(), NO_OPERATOR, noise[0], plant.M, np.zeros(4)
    task = Task(s, points, plant.order, MIDPOINT, np.zeros((3, 3)), plant.O, plant.visible)
    compile_for(observe, plant, H, points, s, log.hidden[0])
    compile_for(advance, plant, log, 0, q)
    compile_for(first_order, parts, 0.0, 0.0, 0.0, 0.0, state)
    compile_for(continued, model, task, q, parts, H, 0.0, 0.0, 0.0, 0, state)
    compile_for(measure, model, task, s, q, state)
    compile_for(pseudo_inverse, state, 0, q)
    compile_for(put_view, model, task, s, state, 0, 0)
    compile_for(single_rotation, model, parts, 1.0, state)
    compile_for(summary, plant, log, 0, 0.0, 0.0, Ends(model.H_hat_0[0], model.H_hat_0[0], goal))
    compile_for(path_deviation, plant, log, 0, 0.0, goal, goal, 0)


PARTS = {"path": compile_path, "loop": compile_loop}

if __name__ == "__main__":
    for name in sys.argv[1:]:
        PARTS[name]()
