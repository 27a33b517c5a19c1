"""Whether a goal taught once on a part is reached wherever the part lies, beside hand–eye calibration.

    python -m tests.studies.displaced_parts [--tasks 30] [--faults 100] [-o displaced_parts.csv]

The UR5e of rendered_conditions with one recording. In each task a part with two tags of 30 mm is beside the
tool where the goal is taught; it is then displaced by up to 150 mm and 60 degrees, and seen once more with
the arm at the start. A task fails unless ``exact_track`` brings the tip of the tool, 80 mm from the part,
within 1 mm and 0.5 degrees of the truth. What users know goes beside it on the same images: OpenCV's hand–eye
calibration with true intrinsics, tool and part in metres, and inverse kinematics, once straight and then
corrected by three looks.

Then objects that are hidden, exchanged, lack tags or move, before and during a run of the analytic UR5: the
arm is to arrive where the part truly is, or the run to end with a reason.
"""

import math
from collections import Counter
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.spatial.transform import Rotation

from projservo_cli import cli
from projservo_cli.config import load_config
from projservo_cli.config.inputs import scene_of
from projservo_cli.records import WorkFailed
from projservo_cli.simulation.arm import camera_center, inverse_kinematics
from projservo_cli.simulation.robot_with_faults import observed_in_frames, obstruction_of
from projservo_cli.store.run_file import load
from tests.configured import plan, robot_by_itself, servo, truth_of
from tests.conftest import ROOT
from tests.known import with_task
from tests.robots.robots import Seeing, Sound
from tests.studies import hand_eye
from tests.studies.carried_goals import direction, seen, tags
from tests.studies.common import in_two_processes, parser_of, quantiles, written
from tests.studies.hand_eye_coverage import pose
from tests.studies.rendered import calibrated, corrected, known_by_hand_eye
from tests.studies.rendered_conditions import FRONT, SEEDS, base_of, tasks_of

SEED, SIDE_M, NUMBERS = 730_000, 0.03, (10, 11)
FARTHEST_M, MOST_DEG, TILT_DEG = 0.15, 60.0, 35.0
BESIDE_M, TIP_M = 0.2, 0.08  # of the part from the middle of the face, and of the tip from the part
NEAR_MM, NEAR_DEG = 1.0, 0.5
COLUMNS = ("seed", "by", "verdict", "mm", "deg", "middle_mm", "stated_mm", "stated_deg", "arrived", "reason")


def looked(config, q, drawn, *, now):
    """Pixels (V, m, 2) of tool and part in frames at joints (n,): now, or where the goal was taught."""
    named = config.objects.named
    scene = scene_of(config, None, named if now else dict.fromkeys(named))
    return observed_in_frames(scene, config.noise.averaged_frames, q, drawn)[0]


@cache
def task_of(seed):
    """Configuration of a task, joints (n,) of its goal as taught, and the place (4,) of its tip."""
    base, rng = base_of("ideal"), np.random.default_rng(SEED + seed)
    truth, q_goal, start = truth_of(base), tasks_of()[seed][1], np.array(FRONT)
    G = truth.robot.pose(q_goal)
    face = (truth.M_face @ truth.displacement(q_goal).T).mean(axis=0)
    while True:
        angle = rng.uniform(-math.pi, math.pi)
        at = face[:3] + BESIDE_M * G[:3, :3] @ [math.cos(angle), math.sin(angle), -0.2]
        towards = np.mean([camera_center(P) for P in truth.P], axis=0) - at
        turn, _ = Rotation.align_vectors(towards[None], [[0.0, 0.0, 1.0]])
        turn = Rotation.from_rotvec(math.radians(rng.uniform(0.0, TILT_DEG)) * direction(rng)) * turn
        turn = turn * Rotation.from_rotvec([0.0, 0.0, rng.uniform(-math.pi, math.pi)])
        R = Rotation.from_rotvec(math.radians(rng.uniform(0.0, MOST_DEG)) * direction(rng))
        by = rng.uniform(0.0, FARTHEST_M) * direction(rng)
        T = pose(R.as_rotvec(), at - R.apply(at) + by)
        X, normals = tags(SIDE_M)
        X, normals = X @ pose(turn.as_rotvec(), at).T, turn.apply(normals)
        if not (
            seen(truth, X, normals) and seen(truth, X @ T.T, R.apply(normals)) and seen_tool(truth, T @ G)
        ):
            continue
        part = {
            "tags": [
                {"number": n, "size_m": SIDE_M, "pose": tag_at(X[4 * k : 4 * k + 4]).tolist()}
                for k, n in enumerate(NUMBERS)
            ],
            "displacement": {
                "translation_m": by.tolist(),
                "rotation_deg": np.degrees(R.as_rotvec()).tolist(),
            },
        }
        config = with_task(base.replace({"objects": {"part": part}}), (start, q_goal), seed=seed)
        goal = config.task.goal.model_copy(update={"on": "part"})
        config = config.model_copy(update={"task": config.task.model_copy(update={"goal": goal})})
        if shown(config, q_goal, now=False) and shown(config, start, now=True):
            tip = at + TIP_M * (face[:3] - at) / np.linalg.norm(face[:3] - at)
            return config, q_goal, np.linalg.solve(G, np.append(tip, 1.0))


def tag_at(X):
    """Pose (4, 4) of a tag with corners X (4, 4), in turn about its normal."""
    right, up = X[1] - X[0], X[3] - X[0]
    T = np.eye(4)
    T[:3, 0], T[:3, 1] = right[:3] / np.linalg.norm(right), up[:3] / np.linalg.norm(up)
    T[:3, 2], T[:3, 3] = np.cross(T[:3, 0], T[:3, 1]), X[:, :3].mean(axis=0)
    return T


def seen_tool(truth, goal):
    """Whether joints near the front bring the tool to a pose (4, 4) where both cameras see its face."""
    try:
        q = inverse_kinematics(truth.robot, goal, np.array(FRONT))
    except WorkFailed:
        return False
    face = list(truth.face)
    whole = np.isfinite(truth.within(truth.images(q, truth.M_face))).all()
    return bool(whole and truth.faces(q)[:, face].all())


def shown(config, q, *, now):
    """Whether the arm touches nothing at joints (n,), and both images show the face and all of the part."""
    truth = truth_of(config)
    obstructions = obstruction_of(robot_by_itself(config, truth, q, 0.0, 0, 0))
    if any(one.code == "arm_touches" for one in obstructions):
        return False
    once = config.model_copy(update={"noise": type(config.noise)()})
    s = looked(once, q, (0, 0), now=now)
    return bool(np.isfinite(s[:, [*truth.face, *range(len(truth.number), s.shape[1])]]).all())


def judged(config, q_goal, tip, reached):
    """True errors of a tool at a pose (4, 4)."""
    goal = config.objects.named["part"].moved @ truth_of(config).robot.pose(q_goal)
    turn = Rotation.from_matrix(reached[:3, :3].T @ goal[:3, :3]).magnitude()
    mm = 1e3 * np.linalg.norm((reached - goal) @ tip)
    return {
        "mm": mm,
        "deg": np.degrees(turn),
        "middle_mm": 1e3 * np.linalg.norm((reached - goal)[:3, 3]),
        "arrived": bool(mm <= NEAR_MM and np.degrees(turn) <= NEAR_DEG),
    }


def driven(job):
    """Rows of all that drives a task."""
    seed, calibration, known = job
    config, q_goal, tip = task_of(seed)
    row = {"seed": seed, "by": "projservo", "arrived": False}
    try:
        planned = plan.run(config, calibration)
        trace = servo.run(config, calibration, planned, "exact_track")
        row |= {"stated_mm": planned.goal_deviation_mm, "stated_deg": planned.goal_deviation_deg}
        row |= judged(config, q_goal, tip, trace.pose[-1]) | {
            "verdict": trace.verdict,
            "reason": trace.reason,
        }
        row["arrived"] &= trace.verdict == "converged"
    except WorkFailed as error:
        row |= {"verdict": "not started", "reason": str(error)}
    return [row, *({"seed": seed} | one for one in by_hand_eye(config, known, q_goal, tip, seed))]


def by_hand_eye(config, known, q_goal, tip, seed):
    """Rows of hand–eye calibration with inverse kinematics: straight, and after so many looks."""
    (views, points, _), m = known, len(truth_of(config).number)
    part = config.objects.named["part"].points[:, :3]
    taught, now = (
        looked(config, q_goal, (seed, 7), now=False),
        looked(config, np.array(FRONT), (seed, 8), now=True),
    )
    places = [hand_eye.tool_in_base(views, part, s[:, m:]) for s in (taught, now)]
    wanted = hand_eye.tool_in_base(views, points, taught[:, :m])
    if wanted is None or places[0] is None or places[1] is None:
        return [{"by": "hand-eye", "verdict": "unseen", "arrived": False}]
    wanted = places[1] @ np.linalg.inv(places[0]) @ wanted

    def judge(pose):
        return {"verdict": "converged", **judged(config, q_goal, tip, pose)}

    rows = corrected(config, known, wanted, np.array(FRONT), (seed, 6), judge)
    return [{"by": by, **row} for by, row in rows]


KINDS = ("hidden", "tags missing", "exchanged", "moved before", "moved during")
CONFIG = ROOT / "configs" / "object.yaml"
OPTIONS = f"options: {{config: {CONFIG}}}, averaged_frames: 10"
PLANT = f"plant={{use: 'tests.robots.robots:Seeing', {OPTIONS}}}"
AS_TAUGHT = {
    "shift": np.eye(4),
    "later": (10**9, None),
    "hidden": (),
    "unseen_from": 10**9,
    "exchanged": 0.0,
    "looks": 0,
}


def disturbed(folder, k):
    """Whether the arm arrived at the part, or its part was named, in a run of a kind; and what was said."""
    rng, kind, part = (
        np.random.default_rng(SEED + k),
        KINDS[k % len(KINDS)],
        load_config(CONFIG).objects.named["part"],
    )
    R = Rotation.from_rotvec(math.radians(rng.uniform(0.0, 40.0)) * direction(rng))
    middle, by = part.points[:, :3].mean(axis=0), rng.uniform(0.0, 0.1) * direction(rng)
    T, numbers = pose(R.as_rotvec(), middle - R.apply(middle) + by), np.array(part.numbers)
    nudge = T.copy()
    nudge[:3, 3] += rng.uniform(0.005, 0.05) * direction(rng)
    where = AS_TAUGHT | {"shift": T}
    where |= {
        "hidden": {"unseen_from": int(rng.integers(12, 120))},
        "tags missing": {"hidden": tuple(rng.choice(numbers, rng.integers(2, 8), replace=False).tolist())},
        "exchanged": {"exchanged": rng.uniform(0.003, 0.02)},
        "moved before": {"later": (12, nudge)},
        "moved during": {"later": (int(rng.integers(60, 110)), nudge)},
    }[kind]
    for name, value in where.items():
        setattr(Seeing, name, value)
    goal = f"task.goal={{taught: {folder / 'goal.yaml'}, on: part}}"
    given = ["-c", str(CONFIG), "-o", str(folder / "run"), "--law", "exact", "-q", "--set", goal]
    code = cli.run(["servo", *given, "--set", PLANT, "--set", "control.mode=regulate"])
    trace = load(folder / "run").traces.get("exact")
    arm = Seeing.last.world.robot
    off = 1e3 * np.linalg.norm((arm.pose(Seeing.last.q) - T @ arm.pose(Sound(CONFIG).q))[:3, 3])
    stopped = trace is not None and trace.verdict == "object moved"
    named = "arrived" if code == 0 else "object moved" if stopped else "refused"
    return {"kind": kind, "code": code, "mm": off, "verdict": named, "good": off < 3.0 if code == 0 else True}


def taught(folder):
    """Calibrate, and teach the goal on the part where it lies."""
    calls = [["calibrate", "-c", str(CONFIG), "-o", str(folder / "run"), "-q"]]
    goal = ["--set", "task.goal={taught: goal.yaml, on: part}", "-o", str(folder / "goal.yaml"), "-q"]
    calls.append(["teach", str(folder / "run"), "-c", str(CONFIG), "--set", PLANT, *goal])
    for name, value in AS_TAUGHT.items():
        setattr(Seeing, name, value)
    for call in calls:
        assert cli.run(call) == 0


def faults(count):
    """Rows of disturbed runs."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        taught(folder)
        for k in range(count):
            yield disturbed(folder, k)


def main():
    counted = [("tasks", len(SEEDS), "rendered"), ("faults", 100, "runs with an object hidden or moved")]
    given = parser_of("displaced_parts", __doc__, counted).parse_args()
    rows = list(faults(given.faults)) if given.faults else []
    for kind in dict.fromkeys(row["kind"] for row in rows):
        own = [row for row in rows if row["kind"] == kind]
        ended = Counter((row["code"], row["verdict"]) for row in own)
        print(f"{kind}: {sum(row['good'] for row in own)} of {len(own)} good, {dict(ended)}", flush=True)
    if not given.tasks:
        return
    config = base_of("ideal")
    observed, calibration, _ = calibrated(config)
    known = known_by_hand_eye(config, observed)
    print(f"usable {calibration.usable}: {calibration.reason}", flush=True)
    jobs = [(seed, calibration, known) for seed in list(SEEDS)[: given.tasks]]
    rows = written(given.output, COLUMNS, in_two_processes(driven, jobs, "tasks"))
    for by in dict.fromkeys(row["by"] for row in rows):
        own = [row for row in rows if row["by"] == by]
        ended = Counter(row["verdict"] for row in own if not row["arrived"])
        told = [f"{key} {quantiles([row.get(key, math.nan) for row in own])}" for key in COLUMNS[3:8]]
        arrived = sum(row["arrived"] for row in own)
        print(f"{by}: arrived {arrived} of {len(own)}; {', '.join(told)}; else {dict(ended)}", flush=True)


if __name__ == "__main__":
    main()
