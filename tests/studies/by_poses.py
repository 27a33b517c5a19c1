"""A rendered UR5e whose controller takes poses of the flange: thirty tasks, and poses that it refuses.

    python -m tests.studies.by_poses [--tasks 30] [-o by_poses.csv]

MuJoCo moves and renders the arm of rendered_conditions. A controller of its own finds the joints of each pose
by the true model, holds them against gravity, and refuses poses beyond their limits. Trials, calibration and
plans know poses alone. A task arrives if its run converged within 1 mm and 0.3° of the goal by the true arm.
Then the same tasks with joints that may turn less, so that the controller refuses poses on the way: each of
these must end with its words.
"""

import math
from functools import cache
from tempfile import TemporaryDirectory

import numpy as np
from scipy.spatial.transform import Rotation

import projservo_cli as ps
from projservo_cli.config import load_config
from projservo_cli.geometry.flange import FlangeChart
from projservo_cli.records import WorkFailed
from projservo_cli.simulation.robot_with_faults import obstruction_of
from tests.configured import robot_by_itself, truth_of
from tests.conftest import ROOT
from tests.studies.common import in_two_processes, parser_of, quantiles, write_rows
from tests.studies.rendered_conditions import FRONT, base_of

SEED = 740_000
AT_HOME = "{joints: [0, 0, 0, 0, 0, 0], unit: deg}"
NEAR_MM, NEAR_DEG = 1.0, 0.3
# Of goals and starts from home: shift, m, tilt and spin, degrees.
SHIFT_M, TILT_DEG, SPIN_DEG = 0.1, 18.0, 80.0
STEPS, FOUND_M, FOUND_RAD = 40, 1e-7, 1e-7  # of inverse kinematics, and when it has found a pose
GAIN = 0.1  # of the integral action that holds joints where they are to be, a command
LIMITED_DEG = 12.0  # that each joint may turn from FRONT where poses are refused


@cache
def rendered():
    """Configuration and truth of the arm that the controller moves."""
    config = base_of("ideal")
    return config, truth_of(config)


class Controller:
    """A controller that takes poses (4, 4) of the flange."""

    readings = "flange"

    def __init__(self, q, seed, range_deg=math.inf):
        self.config, self.truth_known = rendered()
        self.robot = robot_by_itself(self.config, self.truth_known, np.array(q), 0.0, SEED, seed)
        limits, most = self.truth_known.robot.limits, np.radians(range_deg)
        self.lower = np.maximum(limits.lower, np.array(FRONT) - most)
        self.upper = np.minimum(limits.upper, np.array(FRONT) + most)
        self.sent, self.lift = np.array(q, dtype=float), np.zeros(len(q))

    def __getattr__(self, name):
        return getattr(self.robot, name)

    def read(self):
        q, *rest = self.robot.read()
        return self.truth_known.robot.pose(np.asarray(q)), *rest

    def command(self, target, speed, due):
        q = joints_at(target, self.sent)
        if q is None or (q < self.lower).any() or (q > self.upper).any():
            raise ps.PoseRefused(
                "no joints within their limits" if q is None else "a joint would pass its limit"
            )
        now = self.robot.now()
        period = max(due - now, 1e-3)
        self.lift += GAIN * (self.sent - self.robot._joints.at(now))  # joints follow behind, and sag
        self.robot.command(q + self.lift, (q - self.sent) / period, due)
        self.sent = q


def joints_at(T, q):
    """Joints (n,) of a pose (4, 4) near joints (n,), by the true arm; None if there are none."""
    arm, q = rendered()[1].robot, np.array(q, dtype=float)
    for _ in range(STEPS):
        here = arm.pose(q)
        gap = np.concatenate(
            [T[:3, 3] - here[:3, 3], Rotation.from_matrix(T[:3, :3] @ here[:3, :3].T).as_rotvec()]
        )
        if np.linalg.norm(gap[:3]) < FOUND_M and np.linalg.norm(gap[3:]) < FOUND_RAD:
            return q
        J = np.empty((6, len(q)))
        for i in range(len(q)):
            step = np.zeros(len(q))
            step[i] = 1e-6
            ahead = arm.pose(q + step)
            J[:3, i] = (ahead[:3, 3] - here[:3, 3]) / 1e-6
            J[3:, i] = Rotation.from_matrix(ahead[:3, :3] @ here[:3, :3].T).as_rotvec() / 1e-6
        q = q + J.T @ np.linalg.solve(J @ J.T + 1e-8 * np.eye(6), gap)
    return None


@cache
def by_poses():
    """The configuration of the controller, which knows no arm."""
    home = rendered()[1].robot.pose(np.array(FRONT))
    box = (1e3 * (home[:3, 3, None] + np.array([-0.25, 0.25]))).tolist()
    words = (
        f"robot={{name: UR5e by poses, flange: {{home: {home.tolist()}, box_mm: {box}, max_tilt_deg: 60, "
        "max_speed_mm_s: 250, max_turn_deg_s: 60}}",
        "plant={use: 'tests.studies.by_poses:Controller', settle_s: 0.3, averaged_frames: 2, timeout_s: 60}",
        "calibration={frames_per_joint: 4, random_poses: 10, amplitude_deg: 25, amplitude_m: 0.12, "
        f"reference: {AT_HOME}}}",
        f"task={{start: {AT_HOME}, goal: {{joints: {AT_HOME}}}}}",
        "control.laws=[exact]",
        "control.mode=track",
        "noise={}",
        "trajectory={profile: auto}",
    )
    return load_config(ROOT / "configs" / "rendered.yaml", words)


@cache
def tasks():
    """Coordinates of start and goal of each seed, which both cameras see and the arm can reach."""
    config, truth = rendered()
    chart = by_poses().robot.flange.chart
    rng, found = np.random.default_rng(SEED), []
    while len(found) < 60:
        ends = []
        for _ in range(2):
            q = np.concatenate(
                [
                    rng.uniform(-SHIFT_M, SHIFT_M, 3),
                    np.radians([*rng.uniform(-TILT_DEG, TILT_DEG, 2), rng.uniform(-SPIN_DEG, SPIN_DEG)]),
                ]
            )
            joints = joints_at(chart.poses(q[None])[0], FRONT)
            if joints is None:
                break
            seen = truth.within(truth.images(joints, truth.M_face))
            robot = robot_by_itself(config, truth, joints, 0.0, 0, 0)
            if not np.isfinite(seen).all() or any(one.code == "arm_touches" for one in obstruction_of(robot)):
                break
            ends.append(q)
        if len(ends) == 2:
            found.append(tuple(ends))
    return found


def calibrated():
    """The calibration by poses of the flange, or why there is none."""
    with TemporaryDirectory() as folder:
        seen = ps.record(by_poses(), Controller(FRONT, 0), path=f"{folder}/trials.csv", progress=False)
        return ps.calibrate(seen, progress=False)


def driven(job):
    """How a task ends, with its true errors."""
    number, calibration, range_deg = job
    start, goal = tasks()[number]
    robot = Controller(FRONT, 1 + number, range_deg)
    told = {"task": number, "range_deg": range_deg}
    try:
        motion = ps.plan(by_poses(), calibration, q_start=start, goal=goal)
        trace = ps.servo(by_poses(), calibration, motion, "exact", robot=robot)
    except WorkFailed as error:
        return told | {"verdict": "stopped", "reason": str(error), "arrived": False}
    T, aim = rendered()[1].robot.pose(robot.robot._joints.links[-1]), chart().poses(goal[None])[0]
    mm = 1e3 * float(np.linalg.norm(T[:3, 3] - aim[:3, 3]))
    deg = math.degrees(Rotation.from_matrix(T[:3, :3] @ aim[:3, :3].T).magnitude())
    arrived = trace.verdict == "converged" and mm <= NEAR_MM and deg <= NEAR_DEG
    return told | {"verdict": trace.verdict, "reason": trace.reason, "mm": mm, "deg": deg, "arrived": arrived}


def chart() -> FlangeChart:
    """Chart of the poses."""
    return by_poses().robot.flange.chart


def main():
    """Calibrate, drive all tasks with whole and with limited joints, and print what came of it."""
    asked = parser_of("by_poses", __doc__, [("tasks", 30, "of each kind")]).parse_args()
    calibration = calibrated()
    print(f"calibration: usable {calibration.usable}, {calibration.reason}", flush=True)
    rows = []
    for range_deg in (math.inf, LIMITED_DEG):
        mine = list(
            in_two_processes(driven, [(k, calibration, range_deg) for k in range(asked.tasks)], "tasks")
        )
        rows += mine
        write_rows(asked.output, rows)
        refused = sum("the controller refused the pose" in row["reason"] for row in mine)
        others = [f"{row['task']}: {row['verdict']}, {row['reason']}" for row in mine if not row["arrived"]]
        mm, deg = ([row.get(name, math.nan) for row in mine] for name in ("mm", "deg"))
        print(
            f"joints within {range_deg}°: arrived {sum(row['arrived'] for row in mine)} of {len(mine)}, "
            f"refused {refused}; mm (median / 95 % / most) {quantiles(mm)}; degrees {quantiles(deg)}",
            flush=True,
        )
        for line in others[:5]:
            print(f"  {line[:200]}", flush=True)


if __name__ == "__main__":
    main()
