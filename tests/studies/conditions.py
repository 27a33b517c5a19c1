"""Robots as they are, in studies: arms, tasks by seed, and conditions under which they are driven.

    python -m tests.studies.conditions

draws the tasks anew and writes tasks.csv beside this file, which the studies read.
"""

import csv
import math
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from projservo_cli.settings.sections import JointVector
from projservo_cli.simulation.faults import FaultyRobot
from projservo_cli.simulation.random_tasks import STRATA, random_tasks
from tests.configured import truth_of
from tests.known import configured
from tests.studies.planning_tables import write_rows

TASKS = Path(__file__).with_name("tasks.csv")
SEEDS = range(1, 31)
# Reach of each arm, m.
ARMS = {"ur5": 0.85, "hobby": 0.3}
TICKS = 4096
HALF_TICK = math.pi / TICKS  # rad
# What arrived means: converged, and no farther off in truth than this.
NEAR_MM, NEAR_DEG = 3.0, 1.0

_EXPOSED = "disturbance.exposure_s=0.01"
_PLAY = "disturbance.backlash_deg=0.5"
_READINGS = f"disturbance.encoder_counts_per_turn={TICKS}"
_SHARP = ("noise.calibration_px=0.05", "noise.servo_px=0.05")
LATE = {f"{ms} ms late": (_EXPOSED, f"disturbance.camera_latency_s={ms / 1000}") for ms in (0, 40, 120, 300)}
FREE_RUNNING = (
    "disturbance.frame_rate_hz=30",
    "disturbance.frame_offset_s=0.016",
    "disturbance.jitter_s=0.008",
)
CONDITIONS = {
    "ideal": (),
    **LATE,
    "4,096 ticks": (_READINGS,),
    "lag 50 ms": ("disturbance.servo_time_constant_s=0.05",),
    "sag 0.5 deg": ("disturbance.gravity_sag_deg=0.5",),
    "all at 120 ms": (
        *LATE["120 ms late"],
        *(_READINGS, "disturbance.servo_time_constant_s=0.05", "disturbance.gravity_sag_deg=0.5"),
    ),
    "free-running": FREE_RUNNING,
    "play, taught images": (_PLAY, *_SHARP),
    "play, goal as joints": (_PLAY, *_SHARP),
    "set-points in ticks too": (_READINGS, "disturbance.quantize_setpoints=true"),
}
# Those of the first row of the table, and those whose recordings are judged.
FIRST_ROW = (*LATE, "4,096 ticks", "lag 50 ms", "sag 0.5 deg", "all at 120 ms")
RECORDED = (*FIRST_ROW, "free-running")
TAUGHT = "play, taught images"
# Goals are shown by eight images, as somebody who teaches them would; an arm is held at its limits.
_GUIDED = (
    "noise.averaged_frames=8",
    "trajectory.profile=auto",
    "control.mode=track",
    "plant.joint_limits=stop",
)


def base_of(arm, condition):
    """Configuration of an arm under a condition, at 0.5 px where that says nothing else."""
    noise = ("noise.calibration_px=0.5", "noise.servo_px=0.5")
    return configured(arm, *noise, *_GUIDED, *CONDITIONS[condition])


def tasks_of(arm):
    """Start and goal joints, rad, by seed."""
    with open(TASKS, encoding="utf-8", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["arm"] == arm]
    return {
        int(row["seed"]): tuple(
            np.array([float(row[f"{end}_q{i}"]) for i in range(1, 10) if row.get(f"{end}_q{i}")])
            for end in ("start", "goal")
        )
        for row in rows
    }


def task_config(config, arm, seed, taught_px=None):
    """A configuration with the task of a seed; its goal is taught by images of so much noise, or joints."""
    start, goal = tasks_of(arm)[seed]
    vectors = [JointVector(joints=tuple(q.tolist()), unit="rad") for q in (start, goal)]
    kind = type(config.task.goal)
    if taught_px is None:
        aim = kind(joints=vectors[1])
    else:
        truth, random = truth_of(config), np.random.default_rng([seed, 4])
        s = truth.images(goal, truth.M_face)
        left, right = (s + taught_px * random.standard_normal(s.shape)).tolist()
        aim = kind(images={"left": left, "right": right})
    task = config.task.model_copy(update={"start": vectors[0], "goal": aim})
    return config.model_copy(update={"task": task, "seed": seed})


def recorded_config(arm, condition, number):
    """The configuration by whose trial motions recording ``number`` is made."""
    config = base_of(arm, condition)
    calibration = config.calibration.model_copy(update={"seed": 1000 + number})
    return config.model_copy(update={"calibration": calibration})


@contextmanager
def watched():
    """Joint noise, rad, and delay (2,), s, of simulated robots meanwhile, in truth; filled in at the end."""
    errors, ages, last, taken = [], [], None, np.full(2, np.nan)
    read = FaultyRobot.read

    def noted(self):
        nonlocal last
        answer, truth = read(self), self.truth()
        if last is not None and np.array_equal(last, truth):
            errors.append(answer[0] - truth)
        last = truth
        fresh = self.taken != taken  # a frame that comes twice is no second one
        ages.append(np.where(fresh, self.now() - self.taken, np.nan))
        taken[:] = self.taken
        return answer

    found = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(FaultyRobot, "read", noted)
        yield found
    found["sigma_q"] = float(np.sqrt(np.mean(np.square(errors)))) if errors else 0.0
    found["delay"] = np.nanmean(ages, axis=0) if ages else np.zeros(2)


def drawn(arm):
    """Tasks of all seeds, those of each sixth of half a turn in turn."""
    config = configured(arm)
    truth, front = truth_of(config), np.array(config.task.start.values(config.joint_types))
    for seed in SEEDS:
        starts, goals = random_tasks(truth, front, STRATA, np.random.default_rng(seed))
        ends = {"start": starts[(seed - 1) % STRATA], "goal": goals[(seed - 1) % STRATA]}
        joints = {f"{end}_q{i}": repr(float(x)) for end, q in ends.items() for i, x in enumerate(q, 1)}
        yield {"arm": arm, "seed": seed} | joints


if __name__ == "__main__":
    write_rows(TASKS, [row for arm in ARMS for row in drawn(arm)])
