"""A part on a turntable beside an emulated SO-101: how near the arm stays to where it has its goal.

    python -m tests.studies.turntable [TASKS] [--first 0] [--fps 15] [--rate 0.25] [--slower 0.32]
                                      [--pictures FOLDER]

Bench, recording, mechanics, and the part with two tags of 30 mm are those of ``pick_and_place``: the middle
of the face and the direction of its upright edge go along with the part, and the turn about that follows, as
five joints have it. Somebody teaches once how the part is gripped. In each task it lies anywhere on a
turntable, which turns at 5 degrees a second about a vertical axis beside it, in either sense; ``servo``
follows from the start by the law of incidences, until it has followed for 2 s. A task is good within 2 mm
and 2 degrees rms from the first arrival on, by the arm and the part of the emulator.
"""

import argparse
import math
import threading
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from projservo_cli.geometry.displacements import rigid
from projservo_cli.store.run_file import load
from tests.studies.carried_goals import seen
from tests.studies.common import quantiles
from tests.studies.following import draw_following
from tests.studies.pick_and_place import (
    APART_PX,
    AWAY,
    FARTHEST_M,
    GRIP,
    MOST_DEG,
    TEACH,
    off,
    part_of,
    put_at_start,
    taught,
    with_part,
    written,
)
from tests.studies.so101_goals import SPREAD_DEG, prepared, said
from tests.studies.so101_tutorial import START

SEED, TASKS, TRIES = 9_320_000, 20, 10_000
SPEED = math.radians(5.0)  # rad/s
RADIUS_M = (0.03, 0.08)  # of the part from the axis
TURNED = math.radians(35.0)  # from where a run begins to where it lies as drawn, and then as far again
KEPT, FOUND = math.radians(3.0), 1e-4  # rad, of the joints from their limits; m and rad, of a place reached
NEAR_MM, NEAR_DEG = 2.0, 2.0
SAMPLE_S = 0.02


class Turntable:
    """A part that turns, and how far the tool is from the goal on it, ``rows`` of s, mm, deg."""

    def __init__(self, bench, truth, grip, motion):
        self.arm, self.truth, self.grip, self.motion, self.rows = bench.arm, truth, grip, motion, []
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self):
        begun = self.arm.clock.now()
        self.arm.displacement = self.displacement = lambda time: self.motion(max(0.0, time - begun))
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._stopping.set()
        self._thread.join()
        self.arm.displacement = self.displacement(self.arm.clock.now())

    def _watch(self):
        while not self._stopping.is_set():
            now = self.arm.clock.now() - SAMPLE_S  # the arm is known until now
            tool = self.truth.robot.pose(self.arm.at(now))
            self.rows.append((now, *off(self.truth, self.displacement(now) @ self.grip, tool)))
            self.arm.clock.sleep(SAMPLE_S)


def turning(T, axis, sense):
    """Displacement (4, 4) at a time, s, since a run began: T, turned about a vertical axis (3,)."""

    def at(time):
        R = Rotation.from_rotvec([0.0, 0.0, sense * (SPEED * time - TURNED)])
        return rigid(R, axis - R.apply(axis)) @ T

    return at


def motions(truth, grip, count):
    """Motions of the part that cameras see and the arm can follow from their begin to their end."""
    rng, found = np.random.default_rng(SEED), []
    for _ in range(TRIES):
        q = np.array(START) + np.array(SPREAD_DEG) * rng.uniform(-1.0, 1.0, 5)
        turn = rigid(Rotation.from_euler("x", rng.uniform(-15.0, 15.0), degrees=True), np.zeros(3))
        T = truth.robot.pose(np.radians(q)) @ turn @ np.linalg.inv(grip)
        angle, radius, sense = rng.uniform(-math.pi, math.pi), rng.uniform(*RADIUS_M), rng.choice([-1.0, 1.0])
        middle = (part_of(grip).points @ T.T)[:, :3].mean(axis=0)
        axis = middle + radius * np.array([math.cos(angle), math.sin(angle), 0.0])
        motion = turning(T, axis, sense)
        if allowed(truth, grip, motion, np.radians(q)):
            found.append(motion)
        if len(found) == count:
            return found
    raise ValueError(f"{len(found)} of {count} motions of the part are seen and in reach")


def allowed(truth, grip, motion, q):
    """Whether the part is seen and in reach all along, near where it was taught, and not hidden at the start.

    q : (n,) joints that grip it in the middle of its motion.
    """
    part = part_of(grip)
    for way in (np.linspace(TURNED, 0.0, 4), np.linspace(TURNED, 2.0 * TURNED, 4)):
        there = q
        for time in way / SPEED:
            T = motion(time)
            X, R = part.points @ T.T, Rotation.from_matrix(T[:3, :3])
            far = np.linalg.norm((X - part.points)[:, :3].mean(axis=0)) > FARTHEST_M
            if far or np.degrees(R.magnitude()) > MOST_DEG:
                return False
            if not seen(truth, X, R.apply(part.normals[::4])):
                return False
            there = joints_at(truth, T @ grip, there)
            if there is None or not seen(truth, truth.M_face @ truth.displacement(there).T):
                return False
    X, at_start = part.points @ motion(0.0).T, truth.images(np.radians(START), truth.M)
    s = np.array([(X @ P.T)[:, :2] / (X @ P.T)[:, 2:] for P in truth.P])
    beside = (s.min(axis=1) > at_start.max(axis=1) + APART_PX) | (
        s.max(axis=1) < at_start.min(axis=1) - APART_PX
    )
    return bool(beside.any(axis=1).all())


def joints_at(truth, wanted, q):
    """Joints (n,) near some (n,) that grip as a tool (4, 4) does; None without any within their limits."""
    middle = truth.M_face.mean(axis=0) @ np.linalg.inv(truth.robot.base_tool).T

    def left(q):
        tool = truth.robot.pose(q)
        return np.concatenate([((tool - wanted) @ middle)[:3], 0.1 * (tool - wanted)[:3, 0]])

    fit = least_squares(left, q, max_nfev=20)
    low, high = truth.robot.limits.lower + KEPT, truth.robot.limits.upper - KEPT
    inside = (fit.x > low).all() and (fit.x < high).all()
    return fit.x if inside and np.abs(fit.fun).max() < FOUND else None


GOAL = "{taught: grip.yaml, incidences: [[down, upright, parallel], [middle, spot]]}"
FOLLOW = (
    *("--law", "incidences", "--set", "objects.part.follow=true", "--set", "control.mode=regulate"),
    *("--set", "objects.part.acceleration=10"),  # mm/s², of a turntable that is steady
    *("--set", f"task.goals={{grip: {GOAL}}}", "--set", "task.steps=[{to: grip}]"),
)


def main():
    """Print how each task was followed, and a summary."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("tasks", nargs="?", type=int, default=TASKS)
    parser.add_argument("--first", type=int, default=0, help="number of the first task")
    parser.add_argument("--fps", type=float, default=15.0, help="frames a second of both cameras")
    parser.add_argument("--rate", type=float, default=0.25, help="of the emulated clock while it records")
    parser.add_argument("--slower", type=float, default=0.32, help="factor of the rate while it follows")
    parser.add_argument("--pictures", type=Path, help="folder of Fig. 23 of each run")
    given = parser.parse_args()
    pictures = given.pictures and given.pictures.resolve()
    with with_part(given.rate, given.fps) as (bench, truth, _):
        if prepared(bench, "-o", "run"):
            written(bench)
            bench.arm.clock.slow_down(given.slower)  # no period must be late, or the arm is slower
            _driven(bench, truth, given, pictures)


def _driven(bench, truth, given, pictures):
    arm, errors = bench.arm, []
    arm.displacement = np.eye(4)
    if (q := taught(bench, [*TEACH, "grip.yaml"], GRIP)) is None:
        return
    grip = truth.robot.pose(q)
    for k, motion in enumerate(motions(truth, grip, given.first + given.tasks)[given.first :], given.first):
        arm.displacement = AWAY
        put_at_start(bench, motion(0.0))
        with Turntable(bench, truth, grip, motion) as table:
            code, line = said(["servo", "-c", "arm.yaml", "-o", "run", *FOLLOW])
        how = "not followed"
        if code == 0:
            trace = load(Path("run")).traces["grip/incidences"]
            end = trace.of_goal.goal_time[trace.steps]
            rows = np.array([row for row in table.rows if end - trace.followed_seconds <= row[0] <= end])
            errors.append(np.sqrt(np.mean(rows[:, 1:] ** 2, axis=0)))
            how = f"{errors[-1][0]:.2f} mm, {errors[-1][1]:.2f}° rms over {len(rows)} samples"
        print(f"{k:3} exit {code}: {how}  {line[-300:]}", flush=True)
        if pictures and code == 0:
            draw_following(pictures / f"{k}.png", load(Path("run")), "grip", "incidences")
    found = np.array(errors).reshape(-1, 2)
    near = int(((found[:, 0] <= NEAR_MM) & (found[:, 1] <= NEAR_DEG)).sum())
    print(f"{near} of {given.tasks} within {NEAR_MM:g} mm and {NEAR_DEG:g}° rms; {len(found)} followed")
    if len(found):
        print(f"mm {quantiles(found[:, 0])}; deg {quantiles(found[:, 1])}")


if __name__ == "__main__":
    main()
