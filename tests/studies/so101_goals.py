"""Taught goals of an emulated SO-101: how near the arm comes to where it was when each was taught.

    python -m tests.studies.so101_goals [GOALS] [--fps 30] [--rate 0.25]

One recording and calibration by the commands of the tutorial, of an arm with 1° of hysteresis that is read,
0.2° of backlash that is not, 2° of sag and images 80 ms late. Then for each goal the arm is put there by
hand, the goal is taught, and ``servo --goal`` drives to it from the start. The truth is that of the emulator.
"""

import argparse
import contextlib
import io
import tempfile
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from projservo_cli.cli import run
from projservo_cli.config.settings_and_rules import truth_of
from tests.studies.common import quantiles
from tests.studies.so101_tutorial import SHORTER, START, benched, by_hand, configure, through_all

SEED, GOALS = 3232, 20
SPREAD_DEG, INSIDE_PX = (16.0, 14.0, 18.0, 18.0, 40.0), 60.0
WITHIN_MM, WITHIN_DEG = 1.0, 1.0
LONGER = SHORTER | {"frames_per_joint: 6": "frames_per_joint: 4\n  random_poses: 6"}


def goals(truth, count):
    """Joints (5,), deg, that show the face to both cameras."""
    rng, found = np.random.default_rng(SEED), []
    while len(found) < count:
        q = np.array(START) + np.array(SPREAD_DEG) * rng.uniform(-1.0, 1.0, 5)
        s = truth.images(np.radians(q), truth.M_face)
        if (np.minimum(s, truth.image_size[:, None] - s).min() > INSIDE_PX) and (s > INSIDE_PX).all():
            found.append(q)
    return found


def said(words):
    """Exit code of a command, and the end of what it printed."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out):
        code = run(words)
    lines = out.getvalue().strip().splitlines()
    return code, " ".join(" ".join(lines[-4:]).split())


def main():
    """Print the error of each goal, and a summary."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("goals", nargs="?", type=int, default=GOALS)
    parser.add_argument("--fps", type=float, default=30.0, help="frames a second of both cameras")
    parser.add_argument("--rate", type=float, default=0.25, help="of the emulated clock; slower is safer")
    given = parser.parse_args()
    with (
        tempfile.TemporaryDirectory() as folder,
        pytest.MonkeyPatch.context() as patch,
        benched(Path(folder), patch, given.rate, given.fps) as bench,
    ):
        _driven(bench, given.goals)


def prepared(bench, *where):
    """Record and calibrate, into a run if its folder is named so, ``-o FOLDER``; whether that went well."""
    arm = bench.arm
    prepare = {
        "init --arm so101 arm.yaml": [],
        "limits -c arm.yaml": [None, by_hand(arm, *through_all())],
        "teach --start -c arm.yaml": [None, by_hand(arm, START), None],
        "teach -c arm.yaml": [None, by_hand(arm, np.array(START) + 5.0), None],
        " ".join(("record calibrate -c arm.yaml", *where)): [],
    }
    for command, acts in prepare.items():
        bench.script[:] = acts
        code, line = said(command.split())
        print(f"{command}: {code} {line[-200:]}", flush=True)
        if command.startswith("init"):
            configure(bench, LONGER)
        if code != 0:
            return False
    return True


def _driven(bench, count):
    if not prepared(bench):
        return
    arm, truth, errors = bench.arm, truth_of(bench.arm.config), []
    for k, q in enumerate(goals(truth, count)):
        taught = []
        bench.script[:] = [None, by_hand(arm, q), lambda taught=taught: taught.append(arm.link.copy())]
        code, line = said(["teach", "-c", "arm.yaml", "-o", f"goal{k}.yaml"])
        if code == 0 and taught:
            code, line = said(["servo", "-c", "arm.yaml", "--goal", f"goal{k}"])
            there, here = (truth.robot.pose(joints) for joints in (taught[0], arm.link))
            off_mm = 1e3 * np.linalg.norm(here[:3, 3] - there[:3, 3])
            off_deg = np.degrees(Rotation.from_matrix(here[:3, :3].T @ there[:3, :3]).magnitude())
            if code == 0:
                errors.append((off_mm, off_deg))
            print(f"{k:3} exit {code}: off by {off_mm:.2f} mm, {off_deg:.2f}°  {line[-160:]}", flush=True)
        else:
            print(f"{k:3} not taught, exit {code}: {line[-200:]}", flush=True)
    off = np.array(errors).reshape(-1, 2)
    near = int(((off[:, 0] <= WITHIN_MM) & (off[:, 1] <= WITHIN_DEG)).sum())
    summary = f"{len(off)} of {count} converged; {near} within {WITHIN_MM} mm and {WITHIN_DEG}°"
    print(f"{summary}; mm {quantiles(off[:, 0])}")


if __name__ == "__main__":
    main()
