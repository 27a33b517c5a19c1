"""Parts of a sweep made by the workers of a Dask scheduler."""

import logging
import time
from concurrent.futures import Executor
from typing import Any

import distributed
from distributed.scheduler import KilledWorker

from projservo_cli import provenance
from projservo_cli.records import InputError, WorkFailed

PATIENCE_S = 10.0  # for the scheduler to answer and for a first worker
RETRIES = 5  # of a job whose worker died
COMPARED = ("projservo", "python", "numpy", "scipy", "numba", "jit")  # what decides the bits of a result


class ClusterEngine:
    """Workers of a Dask scheduler.

    Parameters
    ----------
    address : of the scheduler, such as tcp://host:8786.

    Raises
    ------
    WorkFailed
        If the scheduler does not answer or has no workers.
    InputError
        If the scheduler or a worker lacks this package, or has other versions.
    """

    losses: tuple[type[Exception], ...] = (KilledWorker,)

    def __init__(self, address: str) -> None:
        self.address = address
        for name in list(logging.root.manager.loggerDict):  # what matters is said in our words
            if name.split(".")[0] in ("distributed", "tornado", "asyncio"):
                logging.getLogger(name).setLevel(logging.CRITICAL)
        try:
            make: Any = distributed.Client
            self._client = make(address, timeout=PATIENCE_S, set_as_default=False)
            self._client.wait_for_workers(1, timeout=PATIENCE_S)
        except (OSError, TimeoutError, ValueError) as error:
            what = " ".join(str(error).split())
            raise WorkFailed(
                f"--scheduler {address}: no answer within {PATIENCE_S:g} s, or no worker ({what}): start "
                "dask scheduler and dask worker, and see whether the address is right"
            ) from error
        self._check_versions()
        self._pool: Executor = self._client.get_executor(retries=RETRIES, pure=False)
        self.workers = sum(self._client.nthreads().values())

    def suit(self, workers: int, *, threads: bool) -> None:
        """Nothing: the workers wait for jobs anyway."""

    def pool(self, *, anew: bool = False) -> Executor:
        """The scheduler as a pool, the same as long as there is the scheduler."""
        if anew:
            self.check()
        return self._pool

    def check(self) -> None:
        """Raise WorkFailed where the scheduler is gone."""
        for _ in range(20):  # a lost connection is noticed a moment after what was lost with it
            if self._client.status != "running":
                raise WorkFailed(
                    f"--scheduler {self.address}: the connection to the scheduler is lost; what was stored "
                    "until then is kept: start it anew and run the sweep again to continue"
                )
            time.sleep(0.05)

    def close(self) -> None:
        """Leave the scheduler; it drops what is not done."""
        self._client.close(timeout=2.0)

    def _check_versions(self) -> None:
        here = _versions()
        for where, ask in (
            ("the scheduler", self._client.run_on_scheduler),
            ("a worker", self._client.run),
        ):
            try:
                found = ask(_versions)
            except Exception as error:  # whatever unpickling raises there
                what = " ".join(str(error).split())
                raise InputError(
                    f"--scheduler {self.address}: {where} cannot import projservo ({what}): install the same "
                    "version there, pip install 'projservo[cluster]'"
                ) from error
            for there in [found] if "projservo" in found else found.values():
                other = [
                    f"{name} {there[name]} instead of {here[name]}"
                    for name in COMPARED
                    if there[name] != here[name]
                ]
                if other:
                    raise InputError(
                        f"--scheduler {self.address}: {where} has {', '.join(other)}: results would differ "
                        "in their last digits; install the same versions"
                    )


def _versions() -> dict[str, Any]:
    found = provenance.collect(seed=0, argv=[])
    return {name: found[name] for name in COMPARED}
