"""JIT warm-up: compile for the first run in other processes while one calibrates and plans.

All share the work: each compiles a part, and the others wait and load it.
"""

import sys
from collections.abc import Collection, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from subprocess import DEVNULL, Popen
from typing import Any

import numpy as np
from numba import typeof

from projservo_cli.control import FUNCTIONS, address_of
from projservo_cli.control.law import ERRORS, Law, example
from projservo_cli.geometry.jit import CACHE_FOLDER, is_cached
from projservo_cli.loop.compiled_loop import Course, run_compiled
from projservo_cli.loop.run_metrics import Ended, path_deviation, summarize
from projservo_cli.loop.verdicts import Limits, new_log
from projservo_cli.planning.motion_margins import Reaching, carried_into, carrier_of, limits_alone, room_along
from projservo_cli.simulation.analytic_plant import Ends, Plant


@contextmanager
def compiling_in_background(codes: Collection[int]) -> Iterator[None]:
    """Let two other processes compile meanwhile, if the loop or a law is not in the cache.

    codes : of the laws that will run.
    """
    if CACHE_FOLDER is None or (is_cached(run_compiled) and are_cached(codes)):
        yield
        return
    with ExitStack() as others:
        # One begins at the loop and the other at the laws; each loads the results of the other.
        for first, order in (("loop", -1), ("laws", 1)):
            call = f"warmup._compile({first!r}, {sorted(codes)[::order]})"
            command = [sys.executable, "-c", f"import {__name__} as warmup; {call}"]
            other = others.enter_context(Popen(command, stdin=DEVNULL, stdout=DEVNULL, stderr=DEVNULL))
            others.callback(other.kill)
        yield


def are_cached(codes: Collection[int]) -> bool:
    """Whether the laws of codes need no compiler."""
    return all(is_cached(FUNCTIONS[code]) for code in codes)


def _compile(first: str, codes: Collection[int]) -> None:
    """Compile the ``loop`` or the ``laws`` of codes first, then the other, then the summary of a run."""
    kernels = [partial(kernel.compile, tuple(map(typeof, values))) for kernel, values in calls()]
    laws = [partial(address_of, code) for code in codes]
    loop, last = kernels[:2], kernels[2:]
    for compiled in (*loop, *laws, *last) if first == "loop" else (*laws, *loop, *last):
        compiled()


def calls() -> Iterator[tuple[Any, tuple[Any, ...]]]:
    """Kernels and arguments of the types that all runs have; their values mean nothing."""
    _, model, task, gains, _, q, state = example()
    H_hat, O, order, limits = model.H_hat_0, task.O, task.order, gains.limits
    plant = Plant(
        model=model,
        M=task.A_star,
        order=order,
        center=0,
        O=O,
        visible=q,
        image_size=np.zeros((2, 2)),
        limits=limits,
        opaque=True,
        min_views=2,
    )
    log = new_log(4, 4, 1, len(ERRORS))
    reaching = Reaching(
        model=model,
        demands=limits_alone(limits),
        H_hat=H_hat,
        amplitudes=q,
        A=task.A_star,
        a=q,
        O=O,
        visible=q,
        q_start=q,
    )
    along = room_along(reaching, 1)
    course = Course(
        plant,
        Limits(
            speed=q,
            image_error_px=1.0,
            diverged_factor=1.0,
            stall_periods=1,
            max_steps=1,
            stop_at_joint_limit=True,
            stop_at_border=True,
        ),
        q,
    )
    yield carried_into, (carrier_of(reaching), O, along)
    yield run_compiled, (Law(0, 0, model, task, gains), course, log.s, state, log)
    yield summarize, (plant, log, Ended(0, 1, 0.0), 0.04, Ends(np.eye(4), np.eye(4), q))
    yield path_deviation, (plant, log, 1, 0.04, q, q)
