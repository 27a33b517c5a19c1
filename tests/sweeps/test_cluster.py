"""A sweep on a real Dask scheduler with two workers, processes of their own, which are then killed."""

import json
import subprocess
import sys
import time

import pytest

from tests.sweeps import processes

pytest.importorskip("distributed", reason="distributed is not installed: the extra cluster")
pytestmark = pytest.mark.volume


class Dask:
    """Scheduler and two workers on this machine."""

    def __init__(self, folder):
        folder.mkdir()
        self.folder, self.file = folder, folder / "scheduler.json"
        self.processes = []
        self._start("scheduler", "--host", "127.0.0.1", "--port", "0")
        for _ in range(2):
            self._start("worker", "--nworkers", "1", "--nthreads", "1", "--no-nanny")
        end = time.monotonic() + 60
        while not (self.file.exists() and self.file.stat().st_size):
            assert time.monotonic() < end, "the scheduler did not start"
            time.sleep(0.1)
        self.address = json.loads(self.file.read_text(encoding="utf-8"))["address"]

    def _start(self, kind, *more):
        command = [sys.executable, "-m", f"distributed.cli.dask_{kind}", "--scheduler-file", str(self.file)]
        silent = dict.fromkeys(("stdout", "stderr"), subprocess.DEVNULL)
        options = {"env": processes.ENVIRONMENT, "cwd": self.folder, "start_new_session": True, **silent}
        self.processes.append(subprocess.Popen([*command, "--no-dashboard", *more], **options))

    def kill(self):
        """End the scheduler, then what is left of the workers."""
        for process in self.processes:
            processes.kill_group(process)


@pytest.fixture
def cluster(tmp_path):
    """A cluster, which ends with the test."""
    started = Dask(tmp_path / "cluster")
    yield started
    started.kill()


def test_a_killed_worker_is_made_up_for_and_a_killed_scheduler_gone_on_after(
    cluster, whole, tmp_path, projservo
):
    config, reference = whole
    out = tmp_path / "out"
    process = processes.start(config, out, "--scheduler", cluster.address)
    processes.wait_for_parts(process, out, 2)
    processes.kill_group(cluster.processes[1])
    processes.wait_for_parts(process, out, 8)  # more than were under way
    processes.kill_group(cluster.processes[0])
    code, _, err = processes.finish(process)
    assert code == 1
    assert "2 workers of tcp://127.0.0.1" in err
    assert "the connection to the scheduler is lost; results stored until then are kept" in err
    assert "Traceback" not in err, err
    stored = len(processes.parts(out))
    assert 8 <= stored < 2 * processes.RUNS / processes.CHUNK
    last = projservo("sweep", "-c", config, "-o", out, "-j", "1")
    assert last.code == 0, last.err
    assert f"{processes.CHUNK * stored} of {2 * processes.RUNS} runs are stored already" in last.err
    assert not processes.differences(out, reference)
