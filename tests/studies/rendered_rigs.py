"""How well a UR5e with its meshes arrives before other rendered rigs than two fixed cameras.

    python -m tests.studies.rendered_rigs --draw    (the tasks, into rendered_rigs_tasks.csv beside this file)
    python -m tests.studies.rendered_rigs [--rigs ...] [--tasks 30] [-o runs.csv]

One recording for each rig and thirty tasks by seed on it, driven by ``exact_track`` with the profile auto. A
task fails unless the run converged within 1 mm and 0.3 degrees of the truth, by one camera within 2 mm along
its ray. Beside it go OpenCV's hand–eye calibration with true intrinsics and inverse kinematics of the true
model, as in ``rendered``, and, where there is one camera, the monocular law on the first ten tasks.
"""

import math
import sys
from pathlib import Path

import numpy as np

from projservo_cli.records import WorkFailed
from projservo_cli.settings.markers import Markers
from projservo_cli.simulation.arm import camera_center
from projservo_cli.simulation.faults import obstruction_of
from projservo_cli.simulation.random_tasks import STRATA, random_tasks
from tests.configured import calibrate, observed_in_frames, record, robot_by_itself, truth_of
from tests.known import configured, with_task
from tests.studies.common import in_two_processes, parser_of, row_of, tasks_in, write_rows
from tests.studies.rendered import by_hand_eye, known_by_hand_eye, run_of, tell
from tests.studies.rendered_conditions import ARM, FRAMES, FRONT, LEAST_PX, SEEDS, SHOWN_FRAMES

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
    x, y, z = CELL_M
    T = np.array([[0.0, 0.0, -1.0, x + SCENE_M], [-1.0, 0.0, 0.0, y], [0.0, 1.0, 0.0, z], [0.0, 0.0, 0.0, 1.0]])
    tags = Markers(tags="roof", tag_size_m=0.06).all_tags
    return [
        {"number": t.number, "size_m": t.size_m, "pose": (T @ np.array(t.pose)).tolist()} for t in tags
    ]


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
        f"markers={ {'tags': scene()} if moving else markers}",
        *(f"calibration.reference={front}", f"task={{start: {front}, goal: {{joints: {front}}}}}"),
        *(f"calibration.amplitude_deg={15 if moving else 25}", "calibration.random_poses=15"),
        *(f"noise.averaged_frames={SHOWN_FRAMES}", "trajectory.profile=auto", "plant.joint_limits=stop"),
        *(f"trajectory.visible_views={2 if len(cameras) == 4 else 'all'}", "control.laws=[exact]"),
        *("control.mode=track", f"plant.averaged_frames={FRAMES}", "plant.settle_s=0.3"),
    )
