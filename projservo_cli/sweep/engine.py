"""Where the parts of a sweep are made: here, in processes of this machine, or on a cluster."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, Future, wait
from concurrent.futures.process import ProcessPoolExecutor
from concurrent.futures.thread import ThreadPoolExecutor
from itertools import islice
from typing import Any, Protocol, TypeVar

from threadpoolctl import threadpool_limits

from projservo_cli.records import InputError, WorkFailed

Job = TypeVar("Job")
Result = TypeVar("Result")

MOST_LOSSES = 5  # of workers in a row, without a job done in between


class Engine(Protocol):
    """What makes jobs, ``workers`` at a time; ``losses`` are raised by futures whose worker was lost."""

    workers: int
    losses: tuple[type[Exception], ...]

    def suit(self, workers: int, *, threads: bool) -> None:
        """Make ready for jobs worth so many workers, and whose threads seldom wait for each other."""

    def pool(self, *, anew: bool = False) -> Executor:
        """The pool to submit jobs to; another one after workers of the first were lost."""

    def check(self) -> None:
        """Raise WorkFailed where nothing can come back any more."""

    def close(self) -> None:
        """Give back what was taken; jobs that run are dropped."""


class Here(Executor):
    """The pool of one: a job is made when it is submitted."""

    def submit(self, function: Callable[..., Any], /, *arguments: Any, **named: Any) -> "Future[Any]":
        """A future that is done."""
        future: Future[Any] = Future()
        try:
            future.set_result(function(*arguments, **named))
        except Exception as error:
            future.set_exception(error)
        return future


class LocalEngine:
    """Processes or threads of this machine; a single one is this process.

    Parameters
    ----------
    workers : how many.
    """

    losses: tuple[type[Exception], ...] = ()

    def __init__(self, workers: int) -> None:
        self.workers = self.most = workers
        self._threads = False
        self._pool: Executor | None = None

    def suit(self, workers: int, *, threads: bool) -> None:
        """Threads take the memory of one process, and share what it has compiled and worked out."""
        wanted = min(self.most, workers), threads
        if wanted != (self.workers, self._threads):
            self.close()
            self.workers, self._threads = wanted

    def pool(self, *, anew: bool = False) -> Executor:
        """The workers, started when they are first asked for."""
        if anew:
            self.close()
        if self._pool is None and self.workers == 1:
            self._pool = Here()
        elif self._pool is None and self._threads:
            self._limits = threadpool_limits(1)  # for all threads together, or one would end that of another
            self._pool = ThreadPoolExecutor(self.workers)
        elif self._pool is None:
            context = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(self.workers, context, _follow_the_parent)
        return self._pool

    def check(self) -> None:
        """A pool tells by itself."""

    def close(self) -> None:
        """End processes at once, threads with their jobs."""
        if isinstance(self._pool, ThreadPoolExecutor):
            self._pool.shutdown(cancel_futures=True)
            self._limits.restore_original_limits()
        if isinstance(self._pool, ProcessPoolExecutor):
            processes = list((self._pool._processes or {}).values())
            self._pool.shutdown(wait=False, cancel_futures=True)
            for process in processes:
                process.terminate()
        self._pool = None


def _follow_the_parent() -> None:
    """Leave interrupts to the parent, and end when it is gone, however it ended."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(multiprocessing.parent_process(),), daemon=True).start()


def _end_with(process: Any) -> None:
    if process is not None:
        process.join()
    os._exit(1)


def completed(engine: Engine, function: Callable[[Job], Result], jobs: Iterable[Job]) -> Iterator[Result]:
    """Results of jobs as they are done, in any order; what a lost worker had is made again.

    No more jobs wait than keep all workers busy, and a result is let go when the next is asked for.

    Raises
    ------
    WorkFailed
        If workers are lost again and again, or the engine is.
    InputError
        What a job raises.
    """
    waiting = iter(jobs)
    pool = engine.pool()
    futures: dict[Future[Result], Job] = {}
    again: list[Job] = []
    losses = 0
    lost: tuple[type[BaseException], ...] = (BrokenExecutor, CancelledError, OSError, *engine.losses)
    try:
        while True:
            room = max(0, 2 * engine.workers - len(futures) - len(again)) if engine.workers > 1 else 1
            for job in [*again, *islice(waiting, room)]:
                futures[_submitted(pool, function, job)] = job
            again = []
            if not futures:
                return
            done, _ = wait(futures, timeout=1.0, return_when=FIRST_COMPLETED)
            if not done:
                engine.check()
            for future in done:
                job = futures.pop(future)
                try:
                    result = future.result()
                except lost as error:
                    engine.check()
                    again.append(job)
                    reason = error
                    continue
                losses = 0
                yield result
                del result
            if again:
                losses += 1
                if losses > MOST_LOSSES:
                    raise WorkFailed(
                        f"workers were lost {losses} times in a row ({' '.join(str(reason).split())}): see "
                        "whether the machine has memory left; run the sweep again to continue"
                    )
                again += futures.values()
                futures.clear()
                pool = engine.pool(anew=True)
    finally:
        for future in futures:
            future.cancel()


def _submitted(pool: Executor, function: Callable[[Job], Result], job: Job) -> "Future[Result]":
    """The future of a job; where the pool is broken already, one that failed."""
    try:
        return pool.submit(function, job)
    except (RuntimeError, OSError) as error:
        failed: Future[Result] = Future()
        failed.set_exception(error if isinstance(error, OSError) else BrokenExecutor(str(error)))
        return failed


def engine_for(workers: int, scheduler: str | None) -> Engine:
    """The engine that the command line asks for.

    Raises
    ------
    InputError
        If the package of the cluster is not installed, or its versions differ.
    WorkFailed
        If the scheduler does not answer.
    """
    if scheduler is None:
        return LocalEngine(workers)
    try:
        from projservo_cli.sweep.cluster import ClusterEngine
    except ImportError as error:
        raise InputError(
            f"--scheduler {scheduler}: the package distributed is missing: pip install 'projservo[cluster]'"
        ) from error
    return ClusterEngine(scheduler)
