"""How well a UR5e with its meshes arrives before rendered cameras, beside hand–eye calibration.

    python -m tests.studies.rendered [--conditions ...] [--tasks 30] [-o runs.csv]

First the chain of rendered.yaml. Then one recording for each condition and thirty tasks by seed on it, driven
by ``exact_track`` with the profile auto. All measure with all tags of the tool. A task fails unless the run
converged within 3 mm and 1 degree of the truth. The deviations that corners state are held against the truth
of every look. What users know goes beside it: OpenCV's hand–eye calibration, of all its methods the one that
leaves the least of the same images, with true intrinsics, the goal from the same frames, inverse kinematics
of the true model, once straight and then corrected by three looks.
"""

import math
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

from projservo_cli.laws import REGULATE, law_and_mode
from projservo_cli.records import WorkFailed
from projservo_cli.simulation.robot_with_faults import FaultyRobot
from tests.configured import calibrate, observed_in_frames, plan, record, robot_by_itself, servo, truth_of
from tests.conftest import ROOT
from tests.studies import hand_eye
from tests.studies.common import in_two_processes, parser_of, quantiles, written
from tests.studies.conditions import NEAR_DEG, NEAR_MM, errors
from tests.studies.rendered_conditions import (
    CONDITIONS,
    LATEST,
    SEEDS,
    TAUGHT,
    base_of,
    task_config,
    tasks_of,
)

DECADES = np.array([0.0, 0.01, 0.1, 1.0, np.inf])  # of stated deviations, px
LOOKS = 3  # after which hand–eye calibration corrects the tool
VAGUE_PX = 0.2  # of a corner that hand–eye calibration is not shown
STREAM = 6  # of random numbers of the robot that hand–eye calibration drives


class Watched(FaultyRobot):
    """It keeps by how much corners are off where they truly are, in stated deviations, by decade of these."""

    counts, squares = np.zeros(len(DECADES) - 1), np.zeros(len(DECADES) - 1)
    lens = False

    def read(self):
        answer = super().read()
        if self.lens or len(answer) < 6 or answer[5] is None:  # the truth knows no lens
            return answer
        truth = self.world.truth
        for view, t in enumerate(self.taken):
            off = answer[1][view] - truth.images(self._joints.at(t), truth.M)[view]
            sigma = answer[5][view]
            seen = np.isfinite(off[:, 0])
            place = np.digitize(sigma[seen], DECADES) - 1
            np.add.at(self.counts, place, 2.0)
            np.add.at(self.squares, place, np.square(off[seen] / sigma[seen][:, None]).sum(axis=1))
        return answer


def calibrated(config):
    """A recording, the calibration made of it and, where that is None, why it failed."""
    with pytest.MonkeyPatch.context() as patch:
        seen, sigma_px = record.observed(config)
        patch.setattr("projservo_cli.stages.calibrate.observed", lambda *args, **kwargs: (seen, sigma_px))
        try:
            return seen, calibrate.run(config)[1], ""
        except WorkFailed as error:
            return seen, None, str(error)


def recorded(condition):
    """A calibration, what it is made from and how corners compare with the truth."""
    config = base_of(condition)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("projservo_cli.simulation.robot_with_faults.FaultyRobot", Watched)
        Watched.counts[:], Watched.squares[:], Watched.lens = 0.0, 0.0, condition == "lens"
        seen, calibration, why = calibrated(config)
    known = known_by_hand_eye(config, seen)
    return condition, calibration, why, known, Watched.counts.copy(), Watched.squares.copy()


def driven(job):
    """Rows of all that drives a task."""
    condition, seed, calibration, known = job
    config = task_config(base_of(condition), seed, taught=condition == TAUGHT)
    told = {"condition": condition, "seed": seed}
    ends = tasks_of()[seed]
    rows = [told | {"by": "exact_track"} | run_of(config, calibration, "exact_track", ends[1], near)]
    for by, row in by_hand_eye(config, known, ends, seed, near):
        rows.append(told | {"by": by} | row)
    return rows


def run_of(config, calibration, law, goal, judge, **brought):
    """One run to joints (n,), with its true errors at the end as somebody judges them.

    brought : a ``factory`` of the law.
    """
    mode = law_and_mode(law)[1]
    if mode == REGULATE:
        control = config.control.model_copy(update={"mode": (mode,)})
        stop = config.stop.model_copy(update={"max_steps": LATEST})
        config = config.model_copy(update={"control": control, "stop": stop})
    try:
        trace = servo.run(config, calibration, plan.run(config, calibration), law, **brought)
    except WorkFailed as error:
        return {"verdict": "not started", "reason": str(error), "arrived": False}
    return judged(judge(truth_of(config), trace.pose[-1], goal), trace.verdict) | {
        "steps": trace.steps,
        "reason": trace.reason,
    }


def judged(errors, verdict):
    """True errors of a tool and whether it arrived, from the errors and whether they are small."""
    row, small = errors
    return {"verdict": verdict, **row, "arrived": verdict == "converged" and small}


def near(truth, pose, goal):
    """Errors of a tool at a pose (4, 4) whose goal is joints (n,), in truth, and whether they are small."""
    mm, deg = errors(pose, truth.robot.pose(goal), truth)
    return {"mm": mm, "deg": deg}, mm <= NEAR_MM and deg <= NEAR_DEG


def hand_of(truth, q):
    """Pose (4, 4) of the hand at joints (n,), or of the base in its frame, where the cameras are on it."""
    pose = truth.robot.pose(q)
    return np.linalg.inv(pose) if truth.on_tool else pose


def known_by_hand_eye(config, seen):
    """The cameras, points of the tool, m, and how it sits on the hand, by the poses at rest.

    For cameras on the hand, scene and base stand for tool and hand: who moves is all the same.
    """
    truth = truth_of(config)
    still = np.ones(len(seen.q), dtype=bool) if seen.moving is None else seen.moving == 0
    points = truth.M[:, :3]
    if not truth.on_tool:
        points = np.linalg.solve(truth.robot.base_tool, truth.M.T).T[:, :3]
    hands, images = np.array([hand_of(truth, q) for q in seen.q[still]]), seen.images[still]
    views = [hand_eye.calibrated(P, points, hands, images[:, v]) for v, P in enumerate(truth.P)]
    return views, points, hand_eye.mount_of(views, points, hands, images)


def by_hand_eye(config, known, ends, seed, judge):
    """Rows of hand–eye calibration with inverse kinematics: straight, and after so many looks."""
    (views, points, _), truth, (start, goal) = known, truth_of(config), ends
    shown, sigma = observed_in_frames(config, truth, goal, (seed, 7))
    shown = np.where((sigma <= VAGUE_PX)[..., None], shown, np.nan)
    wanted = hand_eye.tool_in_base(views, points, shown)
    if wanted is None:
        return [("hand-eye", {"verdict": "goal unseen", "arrived": False})]

    def judge_now(pose):
        return judged(judge(truth, pose, goal), "converged")

    return corrected(config, known, wanted, start, (seed, STREAM), judge_now)


def corrected(config, known, wanted, start, drawn, judge):
    """Rows of inverse kinematics to a pose (4, 4) of the tool before a camera: straight, and after looks.

    start : joints (n,) of the robot, whose noise is of ``drawn``; judge : of a pose (4, 4) of the hand.
    """
    (views, points, mount), truth = known, truth_of(config)
    hand, rows = wanted @ np.linalg.inv(mount), []
    robot = robot_by_itself(config, truth, start, 0.0, *drawn)
    robot.open()
    try:
        for look in range(LOOKS + 1):
            there = np.linalg.inv(hand) if truth.on_tool else hand
            sent = hand_eye.joints_for(truth.robot, there, robot.read()[0])
            if sent is None:
                return [("hand-eye", {"verdict": "no joints", "arrived": False})]
            s = driven_to(robot, config, sent)[:, : len(truth.number)]
            row = judge(truth.robot.pose(robot.truth()))
            rows.append((f"hand-eye, {look} looks", row | {"reason": views[0].method}))
            now = hand_eye.tool_in_base(views, points, s)
            if now is None:
                break
            hand = wanted @ np.linalg.inv(now) @ hand
    finally:
        robot.close()
    return [rows[0], rows[-1]]


def driven_to(robot, config, q):
    """Send a robot to joints (n,) as fast as it may go; what frames then show on average, (2, m, 2) px."""
    period, sent = config.control.period_s, robot.read()[0]
    most = math.radians(config.control.joint_speed_limit_deg_s) * period
    for k in range(1, 1 + math.ceil(np.abs(q - sent).max() / most)):
        step = min(1.0, k * most / np.abs(q - sent).max())
        robot.command(sent + step * (q - sent), np.zeros(len(q)), robot.now() + period)
    robot.command(q, np.zeros(len(q)), robot.now() + 2.0)
    shown = []
    for _ in range(config.noise.averaged_frames):
        shown.append(robot.read()[1])
        robot.command(q, np.zeros(len(q)), robot.now() + period)
    count = np.isfinite(shown).sum(axis=0)
    return np.where(count > 0, np.nansum(shown, axis=0) / np.maximum(count, 1), np.nan)


def tell(condition, rows):
    """Lines on a condition."""
    for by in dict.fromkeys(row["by"] for row in rows):
        mine = [row for row in rows if row["by"] == by]
        ended = Counter(row["verdict"] for row in mine if not row["arrived"])
        mm, deg = ([row.get(name, math.nan) for row in mine] for name in ("mm", "deg"))
        print(
            f"{condition}, {by}: arrived {sum(row['arrived'] for row in mine)} of {len(mine)}; mm (median / "
            f"95 % / most) {quantiles(mm)}; deg {quantiles(deg)}; else {dict(ended)}",
            flush=True,
        )


def run_chain():
    """The whole chain of rendered.yaml, as a user calls it, and how long it takes."""
    with TemporaryDirectory() as folder:
        start = time.monotonic()
        command = ["projservo", "record", "calibrate", "plan", "servo", "report"]
        run = [*command, "-q", "-c", str(ROOT / "configs" / "rendered.yaml"), "-o", folder]
        done = subprocess.run([Path(sys.executable).parent / run[0], *run[1:]], check=False)
        print(
            f"chain of rendered.yaml: exit code {done.returncode}, {time.monotonic() - start:.0f} s",
            flush=True,
        )


def main():
    """Record under every condition, drive all tasks, and print what came of it."""
    counted = [("tasks", len(SEEDS), "of each condition")]
    given = parser_of("rendered_study", __doc__, counted, conditions=CONDITIONS).parse_args()
    run_chain()
    made = {}
    counts, squares = np.zeros(len(DECADES) - 1), np.zeros(len(DECADES) - 1)
    for condition, calibration, why, known, n, square in in_two_processes(
        recorded, given.conditions, "recordings"
    ):
        if calibration is None:
            print(f"{condition}: no calibration: {why}", flush=True)
            continue
        made[condition] = calibration, known
        counts, squares = counts + n, squares + square
        print(
            f"{condition}: usable {calibration.usable}, chi2 {calibration.chi2_per_dof:.2f}, "
            f"{calibration.reason}",
            flush=True,
        )
    for low, high, n, square in zip(DECADES[:-1], DECADES[1:], counts, squares, strict=True):
        if n:
            print(f"corners of {low} to {high} px: {n:.0f}, off over stated {math.sqrt(square / n):.2f}")
    jobs = [(name, seed, *both) for name, both in made.items() for seed in list(SEEDS)[: given.tasks]]
    rows = written(given.output, None, in_two_processes(driven, jobs, "tasks"))
    for condition in made:
        tell(condition, [row for row in rows if row["condition"] == condition])


if __name__ == "__main__":
    main()
