"""Pick, lift and place a part with an emulated SO-101, by taught goals; and kill the command in each step.

    python -m tests.studies.pick_and_place [RUNS] [--fps 30] [--rate 0.25] [--killed]

Bench, recording and mechanics are those of ``so101_goals``. In each run somebody puts the arm to where the
part is to be gripped, and to where it is to be placed, and teaches both: the middle of the face and the
direction of its upright edge; the turn about that follows, as five joints have it. One call of ``servo``
then opens the gripper, approaches along the normal, grips, lifts, goes over the place and down to it, opens
and retreats. The part is gripped where the gripper closes within 5 mm of it, moves with the tool, and is
dropped where the gripper opens or loses torque. The truth is that of the emulator. With ``--killed`` run k
is interrupted half a second after step k mod 9 began.
"""

import argparse
import os
import signal
import tempfile
import threading
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from projservo_cli.config.inputs import truth_of
from projservo_cli.robots.session import Session
from projservo_cli.stages import servo
from tests.studies.common import quantiles
from tests.studies.so101_goals import goals, prepared, said
from tests.studies.so101_tutorial import benched, by_hand

RUNS = 20
OPENED, CLOSED, PART = 2600, 1200, 1500  # counts of the gripper, and that at which the part stops it
REACH_M, IN_PLACE_MM, IN_PLACE_DEG = 0.005, 2.0, 2.0
FEATURES = {
    "plate": "{on: tool, plane: [0, 1, 2]}",
    "middle": "{on: tool, point: [0, 1, 2, 3]}",
    "spot": "{on: scene, point: middle}",
    "down": "{on: tool, line: [1, 0]}",
    "upright": "{on: scene, line: down}",
}
INCIDENCES = "incidences: [[down, upright, parallel], [middle, spot]]"
STEPS = """\
  steps:
    - {act: {gripper: 1.0}}
    - {approach: {along: plate, by_m: -0.03, to: grip}}
    - {to: grip}
    - {act: {gripper: 0.0}}
    - {retreat: {along: down, by_m: 0.03}}
    - {approach: {along: down, by_m: 0.03, to: place}}
    - {to: place}
    - {act: {gripper: 1.0}}
    - {retreat: {along: plate, by_m: -0.03}}
"""


class Part:
    """A part on the bench, which the gripper takes along; ``dropped`` where it was let go of elsewhere.

    pose : (4, 4) of the tool that grips it right, m.
    """

    def __init__(self, bench, truth, pose):
        self.bench, self.truth, self.pose, self.held, self.dropped = bench, truth, pose, None, False
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._stopping.set()
        self._thread.join()

    def tool(self):
        """Pose (4, 4) of the tool, m."""
        return self.truth.robot.pose(self.bench.arm.link)

    def _watch(self):
        while not self._stopping.is_set():
            self.look()
            self.bench.arm.clock.sleep(0.02)

    def look(self):
        """Grip, carry or let go of the part, as the gripper stands now."""
        gripper, tool = self.bench.bus.servos[6], self.tool()
        near = np.linalg.norm(tool[:3, 3] - self.pose[:3, 3]) < REACH_M
        gripper.between = PART if near or self.held is not None else None
        grips = gripper.on and gripper.present <= PART + 20
        if self.held is not None:
            self.pose = tool @ self.held
            if not (grips and self.bench.arm.torque_on.all()):
                self.dropped, self.held = not gripper.on or self.dropped, None
        elif grips and near:
            self.held = np.linalg.inv(tool) @ self.pose


def off(pose, wanted):
    """Distance, mm, and angle, deg, of two poses (4, 4)."""
    turn = Rotation.from_matrix(pose[:3, :3].T @ wanted[:3, :3]).magnitude()
    return 1e3 * np.linalg.norm(pose[:3, 3] - wanted[:3, 3]), float(np.degrees(turn))


def written(bench):
    """Add features, steps and the gripper's readings to arm.yaml."""
    file = bench.folder / "arm.yaml"
    text = file.read_text()
    gripper = f"gripper: 6, gripper_counts: [{CLOSED}, {OPENED}]"
    named = "".join(f"  {name}: {feature}\n" for name, feature in FEATURES.items())
    taught = "".join(f"    {name}: {{taught: {name}.yaml, {INCIDENCES}}}\n" for name in ("grip", "place"))
    text = text.replace("gripper: 6", gripper).replace("task:\n", f"features:\n{named}\ntask:\n")
    file.write_text(
        text.replace("  goal: goal.yaml    # projservo teach writes it\n", f"  goals:\n{taught}{STEPS}")
    )


def interrupted(patch, step):
    """Send this process SIGINT half a second after a step, counted from 0, began."""
    begun = []

    def counted(call):
        def wrapped(*given, **more):
            begun.append(None)
            if len(begun) == step + 1:
                threading.Timer(0.5, os.kill, (os.getpid(), signal.SIGINT)).start()
            return call(*given, **more)

        return wrapped

    patch.setattr(servo, "run", counted(servo.run))
    patch.setattr(Session, "act", counted(Session.act))


def main():
    """Print what became of the part in each run, and a summary."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="?", type=int, default=RUNS)
    parser.add_argument("--fps", type=float, default=30.0, help="frames a second of both cameras")
    parser.add_argument("--rate", type=float, default=0.25, help="of the emulated clock; slower is safer")
    parser.add_argument("--killed", action="store_true", help="interrupt each run in another step")
    given = parser.parse_args()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in the background of a shell
    with (
        tempfile.TemporaryDirectory() as folder,
        pytest.MonkeyPatch.context() as patch,
        benched(Path(folder), patch, given.rate, given.fps) as bench,
    ):
        if prepared(bench, "-o", "run"):
            written(bench)
            _driven(bench, given.runs, given.killed)


def _driven(bench, runs, killed):
    arm, truth, errors = bench.arm, truth_of(bench.arm.config), []
    places, kept = goals(truth, 2 * runs), 0
    for k in range(runs):
        there = []
        for name, q in zip(("grip", "place"), places[2 * k : 2 * k + 2], strict=True):
            bench.script[:] = [None, by_hand(arm, q), lambda at=there: at.append(truth.robot.pose(arm.link))]
            code, line = said(["teach", "-c", "arm.yaml", "-o", f"{name}.yaml", "--force"])
            if code != 0:
                print(f"{k:3} {name} not taught, exit {code}: {line[-200:]}", flush=True)
        if len(there) < 2:
            continue
        with Part(bench, truth, there[0]) as part, pytest.MonkeyPatch.context() as patch:
            if killed:
                interrupted(patch, k % 9)
            code, line = said(["servo", "-c", "arm.yaml", "-o", "run"])
            arm.clock.sleep(1.0)
            part.look()
        mm, deg = off(part.pose, there[1])
        gripper = bench.bus.servos[6]
        holds = not part.dropped and gripper.on and arm.torque_on.all()
        kept += bool(holds)
        if code == 0:
            errors.append((mm, deg))
        how = f"part {mm:.2f} mm, {deg:.2f}° off, {'' if holds else 'NOT '}kept"
        print(f"{k:3} exit {code}: {how}  {line[-230:]}", flush=True)
    found = np.array(errors).reshape(-1, 2)
    placed = int(((found[:, 0] <= IN_PLACE_MM) & (found[:, 1] <= IN_PLACE_DEG)).sum())
    within = f"within {IN_PLACE_MM:g} mm and {IN_PLACE_DEG:g}°"
    print(f"{placed} of {runs} parts {within}; torque and grip kept in {kept}")
    if len(found):
        print(f"mm {quantiles(found[:, 0])}; deg {quantiles(found[:, 1])}")


if __name__ == "__main__":
    main()
