"""Many closed loops at once: compiled runs hold no lock, so threads share the processors."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

from projservo_cli.control.law import Gains, State
from projservo_cli.loop.compiled import Log, run
from projservo_cli.loop.step import Limits
from projservo_cli.plants.plant import Plant
from projservo_cli.records import FloatArray, Model
from projservo_cli.task.face import Task


class Job(NamedTuple):
    """The arguments of one run; ``state`` and ``log`` are its own, the rest may be shared."""

    code: int
    model: Model
    task: Task
    gains: Gains
    limits: Limits
    plant: Plant
    noise: FloatArray
    q_start: FloatArray
    state: State
    log: Log


def run_all(jobs: Sequence[Job], threads: int) -> list[tuple[int, int]]:
    """Verdict and steps of every run, in the order given; bits do not depend on the number of threads.

    Parameters
    ----------
    jobs : runs; their logs are filled.
    threads : how many at a time.
    """
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(lambda job: run(*job), jobs))
