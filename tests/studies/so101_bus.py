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

from projservo_cli.config import load_config
from projservo_cli.config.inputs import recording_inputs
from projservo_cli.hardware.so101 import COUNT, MIDDLE, SO101
from projservo_cli.records import WorkFailed
from projservo_cli.stages.record import new_recording, record
from tests.configured import truth_of
from tests.emulated.arm import Arm, Clock
from tests.emulated.servos import Bus, Faults

SEEDS = range(20)
BAD = {"altered": 0.01, "dropped": 0.01, "late": 0.01, "silent": 0.001}
START = (0.0, 10.0, -25.0, 15.0, 0.0)
CONFIGURATION = """
plant: {{use: "tests.studies.so101_bus:Projected", max_steady_state_error_deg: 4, settle_s: 0.3}}
robot: {{limits: {{joints: [[-100, 100], [-120, 100], [-100, 100], [-120, 100], [-120, 120]], unit: deg}}}}
markers: {{numbers: [0, 1, 2, 3, 4, 5, 6, 7], face: [0, 1, 2, 3]}}
data: {{table: {table}, joints: RRRRR}}
calibration: {{reference: {{joints: {reference}, unit: deg}}, amplitude_deg: 15, frames_per_joint: 1, random_poses: 2}}
control: {{joint_speed_limit_deg_s: 60}}
"""


class Projected(SO101):
    """The driver before points of the true links, which watches readings and commands."""

    bus: Bus

    def __init__(self, limits=None):
        super().__init__(self.bus.port, limits=limits)
        self.truth, self.wrong, self.sent_counts = truth_of(load_config("configs/hobby.yaml")), 0, set()
        self.__class__.last = self

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
    with (
        tempfile.TemporaryDirectory() as folder,
        Bus(Arm(Clock(), START), Faults(**faults, seed=seed)) as bus,
    ):
        Projected.bus, begun, error = bus, time.monotonic(), ""
        text = CONFIGURATION.format(table=Path(folder, "t.csv"), reference=reference(bus))
        inputs = recording_inputs(load_config("bus.yaml", text=text))
        recording = new_recording(inputs, Path(folder, "t.csv"))
        try:
            record(inputs, recording)
        except WorkFailed as failure:
            error = str(failure)
        robot = Projected.last
        goals = {(i, goal) for i in range(1, 6) for _, goal in bus.servos[i].moments}
        unsent = goals - robot.sent_counts
        return len(recording.done), robot.wrong, len(unsent), time.monotonic() - begun, error


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
        print(
            f"{seed:3} {poses} poses, {wrong} wrong readings, {unsent} wrong commands, {seconds:.0f} s {error}"
        )
    complete = sum(row[0] == 8 for row in rows)
    print(
        f"{complete} of {len(rows)} complete, {sum(r[1] for r in rows)} wrong readings, "
        f"{sum(r[2] for r in rows)} wrong commands"
    )


if __name__ == "__main__":
    main()
