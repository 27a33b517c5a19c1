"""Workers of the jobs of a sweep: here, in threads or processes of this machine, or on a Dask cluster.

Plain ``concurrent.futures`` and ``distributed``: results of joblib pile up if they are stored more slowly
than made, Ctrl-C prints the work of its processes, and they outlive a sweep that is killed.
"""

import logging
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    wait,
)
from contextlib import contextmanager
from itertools import islice
from typing import Any, TypeVar

from threadpoolctl import threadpool_limits

from projservo_cli import provenance
from projservo_cli.records import InputError, WorkFailed

_Job = TypeVar("_Job")
_Result = TypeVar("_Result")

MOST_LOSSES = 5  # losses of workers in a row, without a finished job
_PATIENCE_S = 10.0  # for the scheduler to answer and for a first worker
_DECISIVE = ("projservo", "python", "numpy", "scipy", "numba", "jit")  # for the last digits of a result


class Engine:
    """Workers of this machine; a single one is this process."""

    here = True
    # errors that mean lost workers
    losses: tuple[type[Exception], ...] = (BrokenExecutor, CancelledError, OSError)

    def __init__(self, workers: int) -> None:
        self.workers = workers

    def completed(
        self,
        function: Callable[[_Job], _Result],
        jobs: Iterable[_Job],
        *,
        max_workers: int | None = None,
        threads: bool = False,
    ) -> Generator[_Result, None, None]:
        """Yield results of jobs as they are done, in any order; jobs of a lost worker are repeated.

        No more jobs wait than keep all workers busy, and a result is released at the next request.

        max_workers : workers that the jobs are worth.
        threads : whether they seldom wait for each other; the memory is then of one process.
        """
        workers = min(self.workers, max_workers or self.workers)
        if self.here and workers == 1:
            yield from map(function, jobs)
            return
        left, losses = iter(jobs), 0
        todo: list[_Job] = []
        while True:
            futures: dict[Future[_Result], _Job] = {}
            with self.pool(workers, threads=threads) as pool:
                try:
                    while True:
                        todo += islice(left, 2 * workers - len(futures) - len(todo))
                        while todo:
                            future = pool.submit(function, todo[0])
                            futures[future] = todo.pop(0)
                        if not futures:
                            return
                        done, _ = wait(futures, timeout=1.0, return_when=FIRST_COMPLETED)
                        if not done:
                            self.check()
                        for future in done:
                            result = future.result()
                            del futures[future]
                            losses = 0
                            yield result
                            del result, future
                except self.losses as error:
                    self.check()
                    reason = error
                finally:
                    for future in futures:
                        future.cancel()
            todo += futures.values()
            losses += 1
            if losses > MOST_LOSSES:
                raise WorkFailed(
                    f"workers were lost {losses} times in a row ({' '.join(str(reason).split())}): see "
                    "whether the machine has memory left; run the sweep again to continue"
                )

    @contextmanager
    def pool(self, workers: int, *, threads: bool) -> Iterator[Executor]:
        """Workers to submit jobs to; in the end processes go at once, threads with the jobs they are at."""
        if threads:
            # One limit for all threads together, or one would end another's.
            with threadpool_limits(1), ThreadPoolExecutor(workers) as of_threads:
                yield of_threads
            return
        pool = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), _follow_the_parent)
        try:
            yield pool
        finally:
            processes, results = list((pool._processes or {}).values()), pool._result_queue
            pool.shutdown(wait=False, cancel_futures=True)
            for process in processes:
                process.terminate()
            # One that ended amid a result leaves a part of it, for the rest of which this process would wait.
            results._writer.close()  # type: ignore[attr-defined]  # no public name closes it

    def check(self) -> None:
        """Raise WorkFailed if no result can arrive; a pool of this machine raises by itself."""

    def close(self) -> None:
        """Leave the cluster."""


def _follow_the_parent() -> None:
    """Leave interrupts to the parent, and end when it is gone, however it ended."""
    parent: Any = multiprocessing.parent_process()

    def end() -> None:
        parent.join()
        os._exit(1)

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=end, daemon=True).start()


class Cluster(Engine):
    """Workers of the Dask scheduler at an address such as tcp://host:8786; it makes up for lost ones."""

    here = False

    def __init__(self, address: str) -> None:
        self._name = f"--scheduler {address}"
        try:
            import distributed
            from distributed.scheduler import KilledWorker
        except ImportError as error:
            raise InputError(
                f"{self._name}: the package distributed is missing: pip install '.[cluster]'"
            ) from error
        self.losses = (*Engine.losses, KilledWorker)
        for name in list(logging.root.manager.loggerDict):  # projservo has its own messages
            if name.split(".")[0] in ("distributed", "tornado", "asyncio"):
                logging.getLogger(name).setLevel(logging.CRITICAL)
        try:
            make: Any = distributed.Client
            self._client = make(address, timeout=_PATIENCE_S, set_as_default=False)
            self._client.wait_for_workers(1, timeout=_PATIENCE_S)
        except (OSError, TimeoutError, ValueError) as error:
            what = " ".join(str(error).split())
            raise WorkFailed(
                f"{self._name}: no answer within {_PATIENCE_S:g} s, or no worker ({what}): start "
                "dask scheduler and dask worker, and see whether the address is right"
            ) from error
        self._compare_versions()
        super().__init__(sum(self._client.nthreads().values()))

    def _compare_versions(self) -> None:
        """Refuse workers whose results would differ in their last digits."""
        try:
            found = self._client.run(versions)
        except Exception as error:  # any error of unpickling there
            what = " ".join(str(error).split())
            raise InputError(
                f"{self._name}: a worker cannot import projservo ({what}): install the same "
                "version there, pip install '.[cluster]'"
            ) from error
        here = versions()
        for name, there in ((name, of_one[name]) for of_one in found.values() for name in here):
            if there != here[name]:
                raise InputError(
                    f"{self._name}: a worker has {name} {there} instead of {here[name]}: results would "
                    "differ in their last digits; install the same version"
                )

    @contextmanager
    def pool(self, workers: int, *, threads: bool) -> Iterator[Executor]:
        """All workers there are, which wait for jobs anyway."""
        yield self._client.get_executor(retries=MOST_LOSSES, pure=False)

    def check(self) -> None:
        """Raise WorkFailed if the scheduler is gone."""
        for _ in range(20):  # a lost connection is noticed a moment after its lost jobs
            if self._client.status != "running":
                raise WorkFailed(
                    f"{self._name}: the connection to the scheduler is lost; results stored "
                    "until then are kept: restart it and run the sweep again to continue"
                )
            time.sleep(0.05)

    def close(self) -> None:
        """Leave the scheduler, which drops pending jobs."""
        self._client.close(timeout=2.0)


def versions() -> dict[str, Any]:
    """Versions that decide the bits of a result."""
    found = provenance.collect(seed=0)
    return {name: found[name] for name in _DECISIVE}
