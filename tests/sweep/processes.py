"""Sweeps as processes of their own, which tests and studies end in every way.

``python -m tests.sweep.processes 10`` kills a sweep at so many random moments, one after the other, and
compares what it leaves in the end with the uninterrupted one; ``python -m tests.sweep.processes 10 2``
with two processes.
"""

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from projservo_cli.store import SweepTable
from tests.conftest import ROOT

SWEEP = """\
base: {base}
runs: {runs}
chunk: 2
calibrations: 2
set: {{stop.max_steps: 60, noise.servo_px: 0.3, calibration.frames_per_joint: 6}}
grid: {{law: [direct_two, stacked]}}
random: {{control.gain_t: {{uniform: [1, 3]}}}}
traces: [1, {runs}]
"""
COMMAND = "from projservo_cli.cli import main; main()"


def written(folder, runs=10):
    """A small sweep as a configuration file."""
    path = folder / "small.yaml"
    path.write_text(SWEEP.format(base=ROOT / "configs" / "ur5.yaml", runs=runs), encoding="utf-8")
    return path


def start(config, output, *options):
    """The command as the leader of a group of processes."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-c", COMMAND, "sweep", "-c", str(config), "-o", str(output), *options]
    return subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=environment,
        text=True,
        start_new_session=True,
    )


def finish(process, timeout=300):
    """Exit code and what was said."""
    out, err = process.communicate(timeout=timeout)
    return process.returncode, out, err


def parts(output):
    """Parts that are stored."""
    return sorted((Path(output) / "parts").glob("*.h5"))


def wait_for_parts(process, output, count, timeout=240):
    """Wait until so many parts are stored or the process has ended."""
    end = time.monotonic() + timeout
    while process.poll() is None and len(parts(output)) < count:
        assert time.monotonic() < end, "no part was stored in time"
        time.sleep(0.005)


def kill_group(process):
    """End a command and all processes of its group at once, as kill -9 does."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.communicate()


def differences(output, reference):
    """Columns and traces in which two sweeps differ."""
    here, there = (SweepTable(Path(folder) / "sweep.h5") for folder in (output, reference))
    if (here.names, here.rows) != (there.names, there.rows):
        return ["names or rows"]
    found = [name for name in here.names if here.column(name).tobytes() != there.column(name).tobytes()]
    for run in (1, here.rows // 2):
        found += [f"trace {run}"] * (here.trace(run).q.tobytes() != there.trace(run).q.tobytes())
    return found


def main():
    """Kill at random moments until the sweep is done."""
    kills, workers = int(sys.argv[1]), sys.argv[2] if len(sys.argv) > 2 else "1"
    rng = np.random.default_rng(20260101)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        config = written(folder, runs=60 * kills)
        assert finish(start(config, folder / "whole"))[0] == 0
        process = start(config, folder / "killed", "-j", workers)
        wait_for_parts(process, folder / "killed", 1)
        for kill in range(kills):
            time.sleep(rng.uniform(0.0, 1.0))
            ended = process.poll()
            kill_group(process)
            print(
                f"kill {kill + 1}: {len(parts(folder / 'killed'))} parts stored",
                "(had ended)" if ended is not None else "",
                flush=True,
            )
            process = start(config, folder / "killed", "-j", workers)
            wait_for_parts(process, folder / "killed", len(parts(folder / "killed")) + 1)
        code, _, err = finish(process)
        print(f"resumed to the end with exit code {code} {err.strip()}")
        print(f"differences: {differences(folder / 'killed', folder / 'whole') or 'none'}")


if __name__ == "__main__":
    main()
