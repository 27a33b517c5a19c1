"""A sweep on a real Dask scheduler with two workers, processes of their own, which are then killed."""

import json
import os
import subprocess
import sys
import time

import pytest

from tests.conftest import ROOT
from tests.sweep.processes import differences, finish, kill_group, parts, start, wait_for_parts, written

pytest.importorskip("distributed", reason="distributed is not installed: the extra cluster")
pytestmark = pytest.mark.volume

RUNS = 60  # a law, made two at a time, so that most are left when a process is killed


class Cluster:
    """Scheduler and workers on this machine."""

    def __init__(self, folder, workers=2):
        self.folder, self.file = folder, folder / "scheduler.json"
        self.environment = os.environ | {"PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
        self.file.unlink(missing_ok=True)
        self.scheduler = self._start("scheduler", "--host", "127.0.0.1", "--port", "0")
        end = time.monotonic() + 60
        while not (self.file.exists() and self.file.stat().st_size):
            assert time.monotonic() < end, "the scheduler did not start"
            time.sleep(0.1)
        self.address = json.loads(self.file.read_text(encoding="utf-8"))["address"]
        one = ("--nworkers", "1", "--nthreads", "1", "--no-nanny", "--local-directory", str(folder))
        self.workers = [self._start("worker", *one) for _ in range(workers)]

    def _start(self, kind, *options):
        command = [sys.executable, "-m", f"distributed.cli.dask_{kind}", "--scheduler-file", str(self.file)]
        return subprocess.Popen(
            [*command, "--no-dashboard", *options],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=self.environment,
            cwd=self.folder,
            start_new_session=True,
        )

    def close(self):
        for process in (*self.workers, self.scheduler):
            kill_group(process)


@pytest.fixture
def cluster(tmp_path):
    """A scheduler and two workers, ended with the test."""
    folder = tmp_path / "cluster"
    folder.mkdir()
    found = Cluster(folder)
    yield found
    found.close()


@pytest.fixture(scope="module")
def local(tmp_path_factory):
    """Configuration and folder of a sweep made by this machine alone."""
    folder = tmp_path_factory.mktemp("local")
    config = written(folder, RUNS)
    code, _, err = finish(start(config, folder / "out"))
    assert code == 0, err
    return config, folder / "out"


def test_a_worker_killed_in_the_middle_changes_nothing(cluster, local, tmp_path):
    """Without a loss it is equal all the more: half of the parts are made before the kill."""
    config, reference = local
    out = tmp_path / "out"
    process = start(config, out, "--scheduler", cluster.address)
    wait_for_parts(process, out, 3)
    kill_group(cluster.workers[0])
    code, _, err = finish(process)
    assert code == 0, err
    assert "2 workers of tcp://127.0.0.1" in err
    assert not differences(out, reference)


def test_a_killed_scheduler_is_told_and_what_was_stored_is_gone_on_with(cluster, local, tmp_path):
    config, reference = local
    out = tmp_path / "out"
    process = start(config, out, "--scheduler", cluster.address)
    wait_for_parts(process, out, 3)
    kill_group(cluster.scheduler)
    code, _, err = finish(process)
    assert code == 1
    assert "the connection to the scheduler is lost; what was stored until then is kept" in err
    assert "Traceback" not in err, err
    stored = {path.name: path.read_bytes() for path in parts(out)}
    assert 3 <= len(stored) < RUNS
    another = Cluster(cluster.folder)
    try:
        code, _, err = finish(start(config, out, "--scheduler", another.address))
    finally:
        another.close()
    assert code == 0, err
    assert f"{2 * len(stored)} of {2 * RUNS} runs are stored already" in err
    assert not differences(out, reference)


def test_no_scheduler_at_the_address(local, tmp_path):
    config, _ = local
    process = start(config, tmp_path, "--scheduler", "tcp://127.0.0.1:9", "--set", "seed=9")
    code, _, err = finish(process)
    assert code == 1
    assert "no answer within" in err
    assert len(err.strip().splitlines()) == 1
