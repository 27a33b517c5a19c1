"""JIT warm-up: compile for the first run in another process while one calibrates and plans, 20 s of 60.

Both share the work: what one compiles the other waits for and loads.
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from subprocess import DEVNULL, Popen
from typing import Any

import numpy as np
from numba import typeof

from projservo_cli.control import command
from projservo_cli.control.law import ERRORS, Gains, Law, new_state
from projservo_cli.geometry.jit import CACHE_FOLDER
from projservo_cli.loop.run_metrics import Ended, path_deviation, summarize
from projservo_cli.loop.verdicts import new_log
from projservo_cli.planning.margins import Reaching, carried_into, carrier_of, limits_alone, room_along
from projservo_cli.records import JointLimits, Model
from projservo_cli.simulation.analytic_plant import Ends, Plant
from projservo_cli.task.face import Task


@contextmanager
def compiling_in_background() -> Iterator[None]:
    """Let another process compile meanwhile, where no kernel of the loop is in the cache."""
    if CACHE_FOLDER is None or any(CACHE_FOLDER.rglob("compiled.run_compiled-*.nbi")):
        yield
        return
    command = [sys.executable, "-c", f"from {__name__} import _compile_now; _compile_now()"]
    with Popen(command, stdin=DEVNULL, stdout=DEVNULL, stderr=DEVNULL) as other:
        try:
            yield
        finally:
            other.kill()


def _compile_now() -> None:
    """Compile all calls."""
    for kernel, arguments in calls():
        kernel.compile(tuple(map(typeof, arguments)))


def calls() -> Iterator[tuple[Any, tuple[Any, ...]]]:
    """Kernels and arguments of the types that all runs have; their values mean nothing."""
    q, O, matrices, order = np.zeros(4), np.zeros((2, 4)), np.zeros((4, 4, 4)), np.zeros(4, np.int64)
    limits = JointLimits(q, q, q, q)
    slides = np.zeros(4, np.bool_)
    model = Model(np.zeros((2, 3, 4)), matrices, slides, q_reference=q, a_inf=q, lens=np.zeros((2, 5)))
    task = Task(
        s_star=np.zeros((2, 4, 2)),
        A_star=matrices[0],
        order=order,
        center=0,
        pair=order,
        F=np.zeros((3, 3)),
        O=O,
        visible=q,
        least_views=2,
    )
    plant = Plant(
        model=model,
        M=matrices[0],
        order=order,
        center=0,
        O=O,
        visible=q,
        image_size=np.zeros((2, 2)),
        limits=limits,
        opaque=True,
        least_views=2,
    )
    state, log = new_state(4, 4), new_log(4, 4, 1, len(ERRORS))
    gains = Gains(*(1.0,) * 8, limits=limits)
    reaching = Reaching(
        model=model,
        demands=limits_alone(limits),
        H_hat=matrices,
        amplitudes=q,
        A=matrices[0],
        a=q,
        O=O,
        visible=q,
        q_start=q,
    )
    along = room_along(reaching, 1)
    yield command, (Law(0, model, task, gains), task.s_star, q, state)
    yield summarize, (plant, log, Ended(0, 1, 0.0), 0.04, Ends(np.eye(4), np.eye(4), q))
    yield path_deviation, (plant, log, 1, 0.04, q, q)
    yield carried_into, (carrier_of(reaching), O, along)
