"""Compiled and interpreted code follow the same trajectories to the bit, in every law."""

import json
import os
import subprocess
import sys

from projservo_cli.laws import LAWS
from tests.conftest import INTERPRETED, ROOT
from tests.loop.bits import FOLLOWING, hashes


def test_both_modes_are_equal_to_the_bit():
    other = {**os.environ, "NUMBA_DISABLE_JIT": "0" if INTERPRETED else "1", "OPENBLAS_NUM_THREADS": "1"}
    there = subprocess.run(
        [sys.executable, "-W", "error", "-m", "tests.loop.bits"],
        cwd=ROOT,
        env=other,
        capture_output=True,
        text=True,
        check=False,
    )
    assert there.returncode == 0, there.stderr
    found = json.loads(there.stdout)
    assert len(found) == len(LAWS) + 2 + 2 + len(FOLLOWING)
    assert found == hashes()
