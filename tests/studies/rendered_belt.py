"""A part on a belt before rendered cameras, followed and gripped; and control by positions beside it.

    python -m tests.studies.rendered_belt [--first 0] [--tasks 30] [--pictures FOLDER] [-o rendered_belt.csv]

The UR5e of rendered_conditions, its images 40 ms late, and a part with two tags of 30 mm on a belt at
30 mm/s. One recording and calibration by the commands, of a robot class that knows no model. Each task
teaches anew how a tool anywhere before the cameras grips the part; then the part comes along the belt, which
runs in any horizontal direction, shifted across it and turned about the vertical. The command ``servo``
follows, closes the gripper and retreats by 50 mm. Gripped is within 1 mm and 1 degree of how it was taught,
at the fingertips and in truth, when they close; the task is done if the part then comes along.

What users know goes beside it before the same scenes: OpenCV's hand–eye calibration of the same recording,
with true intrinsics, lengths, latency and kinematics, poses of part and tool by ``solvePnP``, a Kalman filter
of constant velocity, and a law that leads joints by its prediction. It has as long to follow.
"""

import json
import math
import os
from collections import deque
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from projservo_cli.config import inputs
from projservo_cli.geometry.displacements import rigid
from projservo_cli.records import WorkFailed
from projservo_cli.settings.markers import Tag
from projservo_cli.simulation.arm import inverse_kinematics
from projservo_cli.simulation.robot_with_faults import obstruction_of, robot_by_itself
from projservo_cli.store.run_file import load
from tests.configured import truth_of
from tests.studies import hand_eye
from tests.studies.carried_goals import seen, tags
from tests.studies.common import parser_of, quantiles, written
from tests.studies.displaced_parts import tag_at
from tests.studies.following import draw_following
from tests.studies.rendered import known_by_hand_eye
from tests.studies.rendered_conditions import FRAMES, FRONT, base_of
from tests.studies.so101_goals import said

SEED, TASKS, TRIES = 9_310_000, 30, 300
SPEED, AT_TAUGHT, LAST = 0.03, 4.0, 9.0  # m/s, and times of the belt, s, at the place taught and at the end
SHIFT_M, TILT_DEG, SPIN_DEG, FARTHEST = 0.08, 15.0, 40.0, 1.5  # of grips from home, and of joints, rad
ACROSS_M, YAW_DEG = 0.03, 20.0  # of the part from the place taught
SIDE_M, NUMBERS = 0.03, (10, 11)
FINGERS_M, PART_M = 0.15, 0.2  # from the middle of the face
CLOSES_S, ACTS_S = 0.3, 0.4  # when the fingers meet the part, and when the gripper is done
REACH_MM, REACH_DEG, NEAR_MM, NEAR_DEG = 10.0, 10.0, 1.0, 1.0  # that it takes the part, and takes it well
RETREAT_M, COMES_M = 0.05, 0.04
LATENCY_S = 0.04
AWAY = rigid(Rotation.identity(), [-5.0, 0.0, 0.0])
# Control by positions: gain, 1/s; noise of a pose, m and rad; accelerations, m/s² and rad/s², as white noise.
GAIN, NOISE, ACCELERATION = 2.5, (0.001, 0.01), (0.01, 0.04)
LEARNT, WINDOW, LATEST = 10, 50, 150  # periods: before it moves, that it is near, after which it grips anyway
COLUMNS = ("task", "by", "gripped", "done", "mm", "deg", "moved_mm", "seconds", "code", "reason")


class Part:
    """The part as the scene has it; ``path`` gives its pose (4, 4) at a time, s."""

    name, T = "part", np.eye(4)
    number = tuple(4 * tag + k for tag in NUMBERS for k in range(4))

    def __init__(self):
        self.path = lambda time: AWAY

    def at(self, time):
        """Displacement (4, 4) from the origin, at a time."""
        return self.path(time)


PART = Part()


@cache
def world():
    """Simulated robot and truth, and the corners (8, 4) of the part in its frame."""
    config, (X, _) = base_of("40 ms late"), tags(SIDE_M)
    truth = truth_of(config)
    placed = [
        Tag(number=number, size_m=SIDE_M, pose=tag_at(X[4 * k : 4 * k + 4]).tolist())
        for k, number in enumerate(NUMBERS)
    ]
    scene = inputs.scene_of(config)
    scene = replace(scene, objects=tuple(placed), moving=(PART,), numbers=(*scene.numbers, *PART.number))
    robot = inputs._drive(config, truth).robot
    corners = np.concatenate([tag.corners for tag in placed])
    return robot._replace(scene=scene), truth, np.c_[corners, np.ones(len(corners))]


class Task(NamedTuple):
    """How the part is gripped, and how it comes."""

    q: np.ndarray  # (n,) joints where that is taught, rad
    place: np.ndarray  # (4, 4) pose of the part there
    tip: np.ndarray  # (4,) fingertips in the frame of the tool
    turn: np.ndarray  # (3,) rotation vector of the part on the belt from there
    across: np.ndarray  # (3,) its shift, m
    along: np.ndarray  # (3,) direction of the belt

    def moved(self, time):
        """Displacement (4, 4) of the part on the belt from where it was when the grip was taught."""
        R, at = Rotation.from_rotvec(self.turn), self.place[:3, 3]
        return rigid(R, at - R.apply(at) + self.across + SPEED * (time - AT_TAUGHT) * self.along)

    def part_at(self, time):
        """Pose (4, 4) of the part on the belt at a time, s."""
        return self.moved(time) @ self.place

    def error(self, tool, moved):
        """Distance of the fingertips, mm, and angle, deg, of a tool (4, 4) from the grip on a moved part."""
        goal = moved @ world()[1].robot.pose(self.q)
        turn = Rotation.from_matrix(goal[:3, :3].T @ tool[:3, :3]).magnitude()
        return 1e3 * float(np.linalg.norm((goal - tool) @ self.tip)), math.degrees(turn)


def vertical(angle):
    """Rotation vector about the vertical."""
    return np.array([0.0, 0.0, angle])


def drawn(k):
    """A task that cameras see and the arm reaches from the beginning of the belt to its end."""
    rng = np.random.default_rng((SEED, k))
    for _ in range(TRIES):
        task = once(rng)
        if task is not None:
            return task
    raise ValueError(f"none of {TRIES} draws of task {k} is seen and in reach")


def once(rng):
    """A task; None where it is not seen or not reached."""
    truth = world()[1]
    turn = np.radians([*rng.uniform(-TILT_DEG, TILT_DEG, 2), rng.uniform(-SPIN_DEG, SPIN_DEG)])
    shift, angle, heading = rng.uniform(-SHIFT_M, SHIFT_M, 3), *rng.uniform(-math.pi, math.pi, 2)
    tilt, yaw = Rotation.from_rotvec(rng.uniform(-0.4, 0.4, 3)), math.radians(rng.uniform(-YAW_DEG, YAW_DEG))
    along = np.array([math.cos(heading), math.sin(heading), 0.0])
    across = rng.uniform(-ACROSS_M, ACROSS_M) * np.cross([0.0, 0.0, 1.0], along)
    home = truth.robot.pose(np.array(FRONT))
    grip = home @ rigid(Rotation.from_rotvec(turn), np.zeros(3))
    grip[:3, 3] += shift
    face = np.linalg.solve(truth.robot.base_tool, truth.M_face.T).mean(axis=1)
    beside = np.array([math.cos(angle), math.sin(angle), -0.2, 0.0])
    place = np.eye(4)
    place[:3, :3], place[:3, 3] = (
        (tilt * Rotation.from_matrix(home[:3, :3])).as_matrix(),
        (grip @ (face + PART_M * beside))[:3],
    )
    tip = face + FINGERS_M * beside
    task = Task(np.array(FRONT), place, tip, vertical(yaw), across, along)
    moments = [(grip, place)]
    moments += [(task.moved(t) @ grip, task.part_at(t)) for t in (0.0, AT_TAUGHT, LAST)]
    if not all(in_sight(tool, part) for tool, part in moments):
        return None
    try:
        joints = [inverse_kinematics(truth.robot, tool, np.array(FRONT)) for tool, _ in moments]
    except WorkFailed:
        return None
    if max(np.abs(q - FRONT).max() for q in joints) > FARTHEST:
        return None
    places = [*zip(joints, [part for _, part in moments], strict=True), (np.array(FRONT), task.part_at(0.0))]
    return task._replace(q=joints[0]) if all(shown(q, part) for q, part in places) else None


def in_sight(tool, part):
    """Whether both images hold the face of a tool (4, 4) and a part (4, 4), whose tags look at them."""
    _, truth, X = world()
    face = truth.M_face @ (tool @ np.linalg.inv(truth.robot.base_tool)).T
    normals = tags(SIDE_M)[1] @ part[:3, :3].T
    return seen(truth, face) and seen(truth, X @ part.T, normals)


def shown(q, part):
    """Whether the arm touches nothing at joints (n,), and frames show its face and all of a part (4, 4)."""
    robot, truth, _ = world()
    PART.path = lambda time: part
    faulty = robot_by_itself(robot, q, 0.0, (SEED, 0))
    if any(one.code == "arm_touches" for one in obstruction_of(faulty)):
        return False
    faulty.open()
    try:
        s = faulty.read()[1]
    finally:
        faulty.close()
    return bool(np.isfinite(s[:, [*truth.face, *range(len(truth.number), s.shape[1])]]).all())


class Belt:
    """The arm beside the belt, with a gripper that takes a part that is near.

    ``task``: whose part comes; None for none. ``still``: whether it lies where the grip is taught, and the
    arm is there. ``stream``: of its random numbers. ``last``: the robot made last. ``grip``: when the fingers
    met the part, s, and pose (4, 4) of the part in the tool; None before. ``error``: mm and deg of it.
    """

    task, still, stream, last = None, False, 0, None

    def __init__(self):
        robot, self.known, _ = world()
        q = self.task.q if self.still else np.array(FRONT)
        self.robot = robot_by_itself(robot, q, 0.0, (SEED, self.stream))
        self.closes, self.grip, self.error = math.inf, None, (math.nan, math.nan)
        PART.path, Belt.last = self.part_at, self
        for name in ("open", "read", "now", "stop", "close"):
            setattr(self, name, getattr(self.robot, name))

    @property
    def frames(self):
        return self.robot.frames

    def command(self, target, speed, due):
        self.robot.command(target, speed, due)
        if self.now() >= self.closes:
            self.closes, now = math.inf, self.now()
            tool, moved = self.tool_at(now), self.task.moved(now)
            self.error = self.task.error(tool, moved)
            if self.error[0] < REACH_MM and self.error[1] < REACH_DEG:
                self.grip = now, np.linalg.inv(tool) @ moved @ self.task.place

    def act(self, name, value):
        self.closes = self.now() + CLOSES_S
        return ACTS_S

    def holding(self, name):
        return None if math.isnan(self.error[0]) else self.grip is not None

    def tool_at(self, time):
        """Pose (4, 4) of the tool at a time, s."""
        return self.known.robot.pose(self.robot._joints.at(time))

    def part_at(self, time):
        """Pose (4, 4) of the part at a time, s."""
        if self.grip is not None and time >= self.grip[0]:
            return self.tool_at(time) @ self.grip[1]
        if self.task is None:
            return AWAY
        return self.task.place if self.still else self.task.part_at(time)


HOME = {"joints": list(FRONT), "unit": "rad"}
FILE = {
    "name": "belt",
    "plant": {"use": f"{__name__}:Belt", "averaged_frames": FRAMES, "settle_s": 0.3, "timeout_s": 60},
    "data": {"table": "trials.csv", "joints": "RRRRRR", "image_size_px": [640, 480]},
    "markers": {"tags": "roof", "tag_size_m": 0.085},
    "calibration": {
        "reference": HOME,
        "frames_per_joint": 3,
        "random_poses": 8,
        "amplitude_deg": 25,
    },
    "objects": {"part": {"tags": list(NUMBERS), "follow": True}},
    "features": {"up": {"on": "tool", "line": [3, 0]}},
    "task": {"start": HOME, "goal": {"joints": HOME}},
    "control": {"laws": ["exact"], "mode": "regulate", "joint_speed_limit_deg_s": 125},
    "stop": {"image_error_px": 0.1},
}
PICK = {
    "start": HOME,
    "goals": {"grip": {"taught": "grip.yaml", "on": "part"}},
    "steps": [{"to": "grip"}, {"act": {"gripper": 0.0}}, {"retreat": {"along": "up", "by_m": RETREAT_M}}],
}


def by_commands(k, task, pictures):
    """Row of a task that is taught and driven by the commands."""
    row = {"task": k, "by": "projservo", "gripped": False, "done": False}
    Belt.task, Belt.still, Belt.stream = task, True, 4 * k + 1
    code, line = said(["teach", "run", "-c", "pick.yaml", "--force", "-o", "grip.yaml"])
    if code:
        return row | {"code": code, "reason": line}
    Belt.still, Belt.stream = False, 4 * k + 2
    code, line = said(["servo", "-c", "pick.yaml", "-o", "run"])
    row |= {"code": code, "reason": line} | gripped(Belt.last)
    row["done"] = row["gripped"] and code == 0 and row["moved_mm"] >= 1e3 * COMES_M
    if pictures and not code:
        draw_following(pictures / f"{k}.png", load(Path("run")), "grip", "exact")
    return row


def gripped(robot):
    """How a part was gripped, and how far it came along."""
    (mm, deg), when, moved_mm = robot.error, math.nan, 0.0
    if robot.grip is not None:
        when = robot.grip[0]
        moved = robot.part_at(robot.now())[:3, 3] - robot.part_at(when)[:3, 3]
        moved_mm = 1e3 * float(np.linalg.norm(moved))
    well = bool(mm <= NEAR_MM and deg <= NEAR_DEG)
    return {"gripped": well, "mm": mm, "deg": deg, "seconds": when, "moved_mm": moved_mm}


class Filter:
    """Kalman filter of poses (4, 4) that go on at a constant velocity: shift and rotation since the first."""

    def __init__(self, time, first):
        self.first, self.t, self.x = first, time, np.zeros(12)
        self.R = np.diag(np.square(np.repeat(NOISE, 3)))
        self.P = np.block([[self.R, np.zeros((6, 6))], [np.zeros((6, 6)), np.eye(6)]])

    def predicted(self, time):
        """State (12,) and its covariance at a time, s."""
        dt, Q = time - self.t, np.diag(np.square(np.repeat(ACCELERATION, 3)))
        F = np.block([[np.eye(6), dt * np.eye(6)], [np.zeros((6, 6)), np.eye(6)]])
        noise = np.block([[dt**3 / 3 * Q, dt**2 / 2 * Q], [dt**2 / 2 * Q, dt * Q]])
        return F @ self.x, F @ self.P @ F.T + noise

    def update(self, time, pose):
        """Take a pose at a time, s."""
        x, P = self.predicted(time)
        R = Rotation.from_matrix(pose[:3, :3] @ self.first[:3, :3].T)
        z = np.concatenate([pose[:3, 3] - self.first[:3, 3], R.as_rotvec()])
        gain = P[:, :6] @ np.linalg.inv(P[:6, :6] + self.R)
        self.t, self.x, self.P = time, x + gain @ (z - x[:6]), P - gain @ P[:6]

    def at(self, time):
        """Pose (4, 4) at a time, s."""
        x, T = self.predicted(time)[0], self.first.copy()
        T[:3, :3], T[:3, 3] = Rotation.from_rotvec(x[3:6]).as_matrix() @ T[:3, :3], T[:3, 3] + x[:3]
        return T


def by_positions(k, task, known):
    """Row of a task that is driven by positions: what hand–eye calibration and a filter lead to."""
    row = {"task": k, "by": "hand-eye", "gripped": False, "done": False}
    (views, points, _), (_, truth, X) = known, world()
    m, part_points = len(truth.number), X[:, :3]
    Belt.task, Belt.still, Belt.stream = task, True, 4 * k + 1
    robot = Belt()
    robot.open()
    s = np.mean([robot.read()[1] for _ in range(FRAMES)], axis=0)
    robot.close()
    tool, part = (
        hand_eye.tool_in_base(views, points, s[:, :m]),
        hand_eye.tool_in_base(views, part_points, s[:, m:]),
    )
    relation = np.linalg.inv(part) @ tool
    Belt.still, Belt.stream = False, 4 * k + 3
    robot = Belt()
    robot.open()
    try:
        gone_on(robot, known, relation, task.tip)
    except WorkFailed as error:
        return row | {"reason": str(error)}
    finally:
        robot.close()
    return row | gripped(robot)


def gone_on(robot, known, relation, tip):
    """Follow the part and grip it: near by its own measure for long enough, or at last.

    relation : (4, 4) wanted pose of the tool in the part.
    """
    (views, points, mount), (_, truth, X) = known, world()
    arm, m, period = truth.robot, len(truth.number), world()[0].period
    sent, seen_at, part = robot.read()[0], deque([mount], 25), None
    past, errors, closing = [], deque(maxlen=WINDOW), None
    for step in range(LATEST + round(ACTS_S / period) + 1):
        (q, s, *_), now = robot.read(), robot.now()
        past.append((now, q))
        then, moments = now - LATENCY_S, np.array([one for one, _ in past])
        hand = arm.pose(
            np.array([np.interp(then, moments, each) for each in np.array([q for _, q in past]).T])
        )
        near = None if part is None else part.at(then)
        found = hand_eye.tool_in_base(views, X[:, :3], s[:, m:], near)
        if found is not None and part is None:
            part = Filter(then, found)
        elif found is not None:
            part.update(then, found)
        if (tool := hand_eye.tool_in_base(views, points, s[:, :m], hand @ mount)) is not None:
            seen_at.append(np.linalg.inv(hand) @ tool)
        on_hand = hand_eye.mean(seen_at)
        q_dot = np.zeros(len(q))
        if part is not None and step >= LEARNT:
            wanted = part.at(now + 1.0 / GAIN) @ relation @ np.linalg.inv(on_hand)
            joints = hand_eye.joints_for(arm, wanted, q)
            if joints is None:
                raise WorkFailed("no joints")
            q_dot = GAIN * (joints - q)
            goal, here = part.at(now) @ relation, arm.pose(q) @ on_hand
            turn = Rotation.from_matrix(goal[:3, :3].T @ here[:3, :3]).magnitude()
            errors.append((1e3 * np.linalg.norm((goal - here) @ tip), math.degrees(turn)))
        if closing is None and (step == LATEST or (len(errors) == WINDOW and is_near(errors))):
            robot.act("gripper", 0.0)
            closing = step
        if closing is not None and step - closing >= ACTS_S / period:
            return
        most = math.radians(FILE["control"]["joint_speed_limit_deg_s"])
        sent = sent + period * q_dot * min(1.0, most / max(np.abs(q_dot).max(), 1e-9))
        robot.command(sent, q_dot, now + period)


def is_near(errors):
    """Whether errors (k, 2), mm and deg, are rms within what counts as gripped."""
    mm, deg = np.sqrt(np.mean(np.square(errors), axis=0))
    return mm <= NEAR_MM and deg <= NEAR_DEG


def rows_of(tasks, known, pictures):
    """Rows of each task, by both."""
    for k in tasks:
        task = drawn(k)
        rows = [by_commands(k, task, pictures), by_positions(k, task, known)]
        for row in rows:
            print({name: x for name, x in row.items() if name != "reason"}, flush=True)
            if not row["done"]:
                print(f"   {row.get('reason', '')[-500:]}", flush=True)
        yield rows


def main():
    """Record, drive all tasks, and print what came of it."""
    counted = [("first", 0, "number of the first task"), ("tasks", TASKS, "number")]
    parser = parser_of("rendered_belt", __doc__, counted)
    parser.add_argument("--pictures", type=Path, help="folder of Fig. 23 of each run")
    given = parser.parse_args()
    output, pictures = given.output.resolve(), given.pictures and given.pictures.resolve()
    with TemporaryDirectory() as folder:
        os.chdir(folder)
        for name, content in (("arm", FILE), ("pick", FILE | {"task": PICK})):
            Path(f"{name}.yaml").write_text(json.dumps(content), encoding="utf-8")  # which YAML takes in
        print(said(["record", "calibrate", "-c", "arm.yaml", "-o", "run"]), flush=True)
        known = known_by_hand_eye(base_of("40 ms late"), load(Path("run")).observation)
        tasks = range(given.first, given.first + given.tasks)
        rows = written(output, COLUMNS, rows_of(tasks, known, pictures))
        os.chdir(output.parent)
    for by in ("projservo", "hand-eye"):
        mine = [row for row in rows if row["by"] == by]
        mm, deg, seconds = (
            quantiles([row.get(name, math.nan) for row in mine]) for name in ("mm", "deg", "seconds")
        )
        print(
            f"{by}: gripped within {NEAR_MM:g} mm and {NEAR_DEG:g}° {sum(row['gripped'] for row in mine)} of "
            f"{len(mine)}, done {sum(row['done'] for row in mine)}; mm (median / 95 % / most) "
            f"{mm}; deg {deg}; s {seconds}"
        )


if __name__ == "__main__":
    main()
