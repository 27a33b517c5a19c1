"""The run file that the first release wrote, as later ones must be able to read it.

``python -m tests.store.first_release`` wrote it; from the first release on, it is not written again.
"""

import gzip
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path

from tests.conftest import ROOT

FILE = Path(__file__).parent / "data" / "first_release.h5.gz"
SETTINGS = (
    "name=first-release",
    "calibration.method=closed_form",
    "calibration.frames_per_joint=4",
    "noise.calibration_px=0.01",
    "control.laws=[direct_three, stacked]",
    "control.observation=points",
    "control.must_converge=[]",
    "stop.max_steps=12",
    "trajectory.samples=6",
    "report.formats=[svg]",
)


@cache
def first_release() -> bytes:
    """Its content."""
    return gzip.decompress(FILE.read_bytes())


def write() -> None:
    """Make a small run with this version and keep its file."""
    settings = [part for value in SETTINGS for part in ("--set", value)]
    stages = ["calibrate", "plan", "servo", "report"]
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-c", "from projservo_cli.cli import main; main()", *stages]
        config = ROOT / "configs" / "paper.yaml"
        subprocess.run([*command, "-c", str(config), "-o", folder, *settings], check=False)
        FILE.write_bytes(gzip.compress(Path(folder, "run.h5").read_bytes(), mtime=0))


if __name__ == "__main__":
    write()
