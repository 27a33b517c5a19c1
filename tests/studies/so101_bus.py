"""Study of recordings over a bad bus: packets altered, dropped, late, and a bus that is silent now and then.

    python -m tests.studies.so101_bus [RECORDINGS]

Each recording has eight poses of an emulated SO-101, with points that are projected from its true links. A
wrong reading is one that no servo gave since it was asked for; a wrong command is a set-point that a servo
took and that nobody sent.
"""

import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from projservo_cli.config import load_config, shipped
from projservo_cli.config.inputs import recording_inputs
from projservo_cli.hardware.so101 import COUNT, MIDDLE, SO101
from projservo_cli.records import WorkFailed
from projservo_cli.stages.external_robot import plugin_robot
from projservo_cli.stages.record import new_recording, record_poses
from tests.configured import truth_of
from tests.emulated.arm import Arm, Clock
from tests.emulated.servos import Bus, Faults

SEEDS, POSES = range(20), 8
BAD = {"altered": 0.01, "dropped": 0.01, "late": 0.01, "silent": 0.001}
START = (0.0, 10.0, -25.0, 15.0, 0.0)
CONFIGURATION = """
plant: {{use: "given:Here", max_steady_state_error_deg: 4, settle_s: 0.3}}
robot: {{limits: {{joints: [[-100, 100], [-120, 100], [-100, 100], [-120, 100], [-120, 120]], unit: deg}}}}
markers: {{numbers: [0, 1, 2, 3, 4, 5, 6, 7], face: [0, 1, 2, 3]}}
data: {{table: {table}, joints: RRRRR}}
calibration:
  reference: {{joints: {reference}, unit: deg}}
  amplitude_deg: 15
  frames_per_joint: 1
  random_poses: 2
control: {{joint_speed_limit_deg_s: 60}}
"""


class Projected(SO101):
    """The driver before points of the true links, which watches readings and commands."""

    def __init__(self, bus, limits):
        super().__init__(bus.port, limits=limits)
        self.bus, self.truth = bus, truth_of(load_config(shipped("hobby")))
        self.wrong, self.sent_counts = 0, set()

    def read(self):
        asked = self.now()
        q, t_q = self.joints()
        for i, angle in zip(range(1, 6), q, strict=True):
            given = [at for t, at in list(self.bus.servos[i].reads) if t >= asked]
            self.wrong += round(MIDDLE + angle / COUNT) not in given
        s = self.truth.images(self.bus.arm.at(asked), self.truth.M)
        return q, s, t_q, t_q, t_q

    def command(self, target, speed, due):
        self.sent_counts |= {(i, round(MIDDLE + q / COUNT)) for i, q in zip(range(1, 6), target, strict=True)}
        super().command(target, speed, due)

    def hold(self):
        super().hold()
        self.sent_counts |= {*self._sent.items()}


def recorded(seed, faults=BAD):
    """Record once; poses, wrong readings, wrong commands, seconds, and what ended it."""
    arm, begun, error = Arm(Clock(), START), time.monotonic(), ""
    with tempfile.TemporaryDirectory() as folder, Bus(arm, Faults(**faults, seed=seed)) as bus:
        text = CONFIGURATION.format(table=Path(folder, "t.csv"), reference=reference(bus))
        inputs = recording_inputs(load_config("bus.yaml", text=text))
        recording, joints = new_recording(inputs, Path(folder, "t.csv")), inputs.trials.joints.joints()
        bounds = inputs.trials.driven.following.bounds(joints)
        robot = Projected(bus, bounds.limits)
        foreign = plugin_robot(inputs.own, bounds, joints.types, inputs.numbers, robot)
        try:
            record_poses(inputs, recording, foreign)
        except WorkFailed as failure:
            error = str(failure)
        goals = {(i, goal) for i in range(1, 6) for _, goal in bus.servos[i].moments}
        unsent, seconds = len(goals - robot.sent_counts), time.monotonic() - begun
        return len(recording.done), robot.wrong, unsent, seconds, error


def reference(bus):
    """Readings of the joints where the arm stands, deg."""
    return [float(round(np.degrees((bus.servos[i].present - MIDDLE) * COUNT), 3)) for i in range(1, 6)]


def main():
    """Print a line a recording and the sums."""
    seeds = SEEDS[: int(sys.argv[1])] if len(sys.argv) > 1 else SEEDS
    rows = []
    for seed in seeds:
        rows.append(recorded(seed))
        poses, wrong, unsent, seconds, error = rows[-1]
        print(f"{seed:3} {poses} poses, wrong: {wrong} readings, {unsent} commands, {seconds:.0f} s {error}")
    wrong, unsent = (sum(values) for values in list(zip(*rows, strict=True))[1:3])
    complete = sum(row[0] == POSES for row in rows)
    print(f"{complete} of {len(rows)} complete; wrong: {wrong} readings, {unsent} commands")


if __name__ == "__main__":
    main()
