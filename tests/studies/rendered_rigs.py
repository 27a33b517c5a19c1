"""How well a UR5e with its meshes arrives before other rendered rigs than two fixed cameras.

    python -m tests.studies.rendered_rigs --draw    (the tasks, into rendered_rigs_tasks.csv beside this file)
    python -m tests.studies.rendered_rigs [--rigs ...] [--first 1] [--tasks 30] [-o runs.csv]

One recording for each rig and thirty tasks by seed on it, driven by ``exact_track`` with the profile auto. A
task fails unless the run converged within 1 mm and 0.3 degrees of the truth, by one camera within 2 mm along
its ray. Beside it go OpenCV's hand–eye calibration with true intrinsics and inverse kinematics of the true
model, as in ``rendered``, and, where there is one camera, the monocular law ``stacked`` on the first ten
tasks.
"""

import math
from pathlib import Path

import numpy as np

from projservo_cli.settings.markers import Markers
from projservo_cli.simulation.arm import camera_center
from tests.configured import truth_of
from tests.known import configured, with_task
from tests.studies.common import in_two_processes, parser_of, quantiles, tasks_in, write_rows, written
from tests.studies.rendered import by_hand_eye, calibrated, known_by_hand_eye, run_of, tell
from tests.studies.rendered_conditions import ARM, FRAMES, FRONT, SEEDS, SHOWN_FRAMES, drawn

TASKS = Path(__file__).with_name("rendered_rigs_tasks.csv")
# What arrived means, mm and degrees; the last along the ray of a camera that is the only one.
NEAR_MM, NEAR_DEG, NEAR_ALONG_MM = 1.0, 0.3, 2.0
MONOCULAR_TASKS = 10
AROUND_M, AROUND_DEG = 1.5, (-80.0, -25.0, 25.0, 80.0)  # distance and azimuths of cameras around the arm
CELL_M = (0.5, 0.1, 0.45)  # where the tool stands at the reference
SCENE_M = 0.5  # from the tool to the tags before cameras on it, at the reference


def fixed(position, target=CELL_M):
    """A camera on the wall."""
    return {
        "focal_px": [950, 950],
        "principal_point_px": [322, 236],
        "position_m": list(position),
        "target_m": list(target),
    }


def on_hand(x, y):
    """A camera beside the flange, which looks ahead."""
    return {
        "focal_px": [600, 604],
        "principal_point_px": [322, 236],
        "position_m": [x, y, 0.0],
        "target_m": [0.0, 0.0, SCENE_M],
        "up": [0.0, 1.0, 0.0],
    }


def around():
    """Four cameras in a half circle about the arm."""
    for k, azimuth in enumerate(np.radians(AROUND_DEG)):
        x, y, z = CELL_M
        yield (
            f"camera{k + 1}",
            fixed((x + AROUND_M * math.cos(azimuth), y + AROUND_M * math.sin(azimuth), z + 0.1 + 0.1 * k)),
        )


def scene():
    """Tags of a roof in the base frame that face the tool at the reference."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = [[0, 0, -1], [-1, 0, 0], [0, 1, 0]], np.add(CELL_M, (SCENE_M, 0.0, 0.0))
    tags = Markers(tags="roof", tag_size_m=0.06).all_tags
    return [{"number": t.number, "size_m": t.size_m, "pose": (T @ np.array(t.pose)).tolist()} for t in tags]


HAND = {"mount": "tool"}
RIGS = {
    "pair on the hand": {"left": on_hand(-0.06, 0.08), "right": on_hand(0.06, 0.08), **HAND},
    "one on the hand": {"eye": on_hand(0.03, 0.08), **HAND},
    "one fixed, flat plate": {"webcam": fixed((1.7, 0.1, 0.7))},
    "four around": dict(around()),
}


def base_of(rig):
    """Configuration of the arm with its meshes before a rig."""
    front = f"{{joints: {list(FRONT)}, unit: rad}}"
    cameras, moving = RIGS[rig], "mount" in RIGS[rig]
    markers = {"tags": "plate" if "plate" in rig else "roof", "tag_size_m": 0.085}
    return configured(
        "rendered",
        f"robot={{mjcf: {ARM}, tip: attachment_site}}",
        f"rig={ {'image_size_px': [640, 480], **cameras} }",
        f"markers={ {'tags': scene()} if moving else markers }",
        *(f"calibration.reference={front}", f"task={{start: {front}, goal: {{joints: {front}}}}}"),
        *(f"calibration.amplitude_deg={15 if moving else 25}", "calibration.random_poses=15"),
        *(f"noise.averaged_frames={SHOWN_FRAMES}", "trajectory.profile=auto", "plant.joint_limits=stop"),
        *(f"trajectory.visible_views={2 if len(cameras) == 4 else 'all'}", "control.laws=[exact]"),
        *("control.mode=track", f"plant.averaged_frames={FRAMES}", "plant.settle_s=0.3"),
    )


def recorded(rig):
    """A calibration by a rig, and what hand–eye calibration makes of the same images."""
    config = base_of(rig)
    seen, calibration, why = calibrated(config)
    return rig, calibration, why, known_by_hand_eye(config, seen)


def driven(job):
    """Rows of all that drives a task."""
    rig, seed, calibration, known = job
    ends = tasks_in(TASKS, rig=rig)[seed]
    config, told = with_task(base_of(rig), ends, seed=seed), {"rig": rig, "seed": seed}
    laws = ["exact_track"]
    if len(truth_of(config).P) == 1 and seed <= MONOCULAR_TASKS:
        laws.append("stacked")
    rows = [told | {"by": law} | run_of(config, calibration, law, ends[1], judge) for law in laws]
    return rows + [told | {"by": by} | row for by, row in by_hand_eye(config, known, ends, seed, judge)]


def judge(truth, pose, q_goal):
    """Errors of a tool at a pose (4, 4) whose goal is joints (n,), in truth, and whether they are small.

    By the middle of the face, or by the frame of a tool that carries the cameras. ``along_mm`` is the part
    along the ray from a camera that is the only one to the face.
    """
    goal, middle = truth.robot.pose(q_goal), truth.M_face.mean(axis=0)
    if truth.on_tool:
        way, face = pose[:3, 3] - goal[:3, 3], middle[:3]
    else:
        back = np.linalg.inv(truth.robot.base_tool)
        way, face = ((pose - goal) @ back @ middle)[:3], (goal @ back @ middle)[:3]
    turn = np.clip(0.5 * (np.trace(pose[:3, :3].T @ goal[:3, :3]) - 1.0), -1.0, 1.0)
    mm, deg = 1e3 * float(np.linalg.norm(way)), math.degrees(math.acos(turn))
    row, across = {"mm": mm, "deg": deg}, mm
    if len(truth.P) == 1:
        ray = face - camera_center(truth.cameras_at(q_goal)[0])
        row["along_mm"] = 1e3 * abs(float(way @ ray)) / float(np.linalg.norm(ray))
        across = math.sqrt(max(0.0, mm**2 - row["along_mm"] ** 2))
    return row, across <= NEAR_MM and row.get("along_mm", 0.0) <= NEAR_ALONG_MM and deg <= NEAR_DEG


def main():
    """Record with every rig, drive all tasks, and print what came of it."""
    parser = parser_of(
        "rendered_rigs_study",
        __doc__,
        [("first", 1, "seed"), ("tasks", len(SEEDS), "of each rig")],
        rigs=RIGS,
    )
    parser.add_argument("--draw", action="store_true", help="draw the tasks anew, and drive nothing")
    given = parser.parse_args()
    if given.draw:
        write_rows(TASKS, [row for mine in in_two_processes(drawn_of, list(RIGS), "rigs") for row in mine])
        return
    made = {}
    for rig, calibration, why, known in in_two_processes(recorded, given.rigs, "recordings"):
        if calibration is None:
            print(f"{rig}: no calibration: {why}", flush=True)
            continue
        made[rig] = calibration, known
        told = f"chi2 {calibration.chi2_per_dof:.2f}, {calibration.reason}"
        print(f"{rig}: usable {calibration.usable}, {told}", flush=True)
    jobs = [
        (rig, seed, *both)
        for seed in list(SEEDS)[given.first - 1 :][: given.tasks]
        for rig, both in made.items()
    ]
    rows = written(given.output, None, in_two_processes(driven, jobs, "tasks"))
    for rig in made:
        mine = [row for row in rows if row["rig"] == rig]
        tell(rig, mine)
        along = [row["along_mm"] for row in mine if row["by"] == "exact_track" and "along_mm" in row]
        if along:
            print(f"{rig}, exact_track: along the ray, mm {quantiles(along)}", flush=True)


def drawn_of(rig):
    """Tasks of a rig."""
    return [{"rig": rig} | row for row in drawn(base_of(rig))]


if __name__ == "__main__":
    main()
