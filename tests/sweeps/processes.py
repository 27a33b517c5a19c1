"""Sweeps as processes of their own, which tests end in every way."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from projservo_cli.store.sweep_table import SweepTable
from tests.conftest import ROOT

# Runs of a law and of a part: seconds of work, on a busy machine long after the first parts are seen.
RUNS, CHUNK = 64, 8
SWEEP = """\
base: {base}
runs: {runs}
chunk: {chunk}
calibrations: 2
set:
  stop.max_steps: 60
  noise.servo_px: 0.3
  calibration.frames_per_joint: 6
grid: {{law: [direct_two, stacked]}}
random: {{control.gain_t: {{uniform: [1, 3]}}}}
traces: [1, {runs}]
between_samples: true
"""
COMMAND = "from projservo_cli.cli import main; main()"
ENVIRONMENT = os.environ | {"PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}


def written(folder):
    """A small sweep as a configuration file."""
    path = folder / "small.yaml"
    path.write_text(
        SWEEP.format(base=ROOT / "configs" / "ur5.yaml", runs=RUNS, chunk=CHUNK), encoding="utf-8"
    )
    return path


def start(config, output, *options):
    """The command as the leader of a group of processes."""
    command = [sys.executable, "-c", COMMAND, "sweep", "-c", str(config), "-o", str(output), *options]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen(command, env=ENVIRONMENT, text=True, start_new_session=True, **pipes)


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
