"""One camera from scratch: how often a calibration is found, and how near its predictions come to the bound.

    python -m tests.studies.one_camera [--draws 20] [--rigs NAME ...] [-o one_camera.csv]

Arms are the UR5 and the RRPRRR arm of the reference data, before their left camera, and a tool of eight
markers in a plane on the UR5. Trials are of single joints, six frames to ±30° or ±0.15 m, or have twelve
combined poses besides. Noise is 0.5 px. Held-out poses are random, within ±50° or ±0.2 m. The bound is that
of Cramér and Rao of the design, and that of the pair beside it is of both cameras.
"""

import json
from typing import NamedTuple

import numpy as np

from projservo_cli.calibration import calibrate, predict
from projservo_cli.records import WorkFailed
from tests.calibration.bound import Bound
from tests.calibration.simulated_robot import Robot, around, trials
from tests.conftest import SHARED
from tests.studies.common import in_two_processes, parser_of, quantiles, rate, write_rows

SEED, NOISE_PX, HELD_OUT = 50, 0.5, 100
FRAMES, COMBINED = 6, 12
NEAR = 3.0  # errors over the bound up to which the arm was found
FLAT = np.array([[x, y, 0.0] for x in (-0.05, 0.05) for y in (-0.05, -0.02, 0.02, 0.05)])  # m


class Rig(NamedTuple):
    """An arm and the poses of its recording."""

    data: str
    combined: bool
    flat: bool = False


RIGS = {
    "ur5": Rig("ur5", combined=False),
    "ur5 combined": Rig("ur5", combined=True),
    "stanford": Rig("stanford", combined=False),
    "stanford combined": Rig("stanford", combined=True),
    "flat": Rig("ur5", combined=False, flat=True),
    "flat combined": Rig("ur5", combined=True, flat=True),
}


def robot_of(rig, cameras):
    """The true arm before some of its cameras."""
    with open(SHARED / rig.data / "truth.json", encoding="utf-8") as file:
        truth = json.load(file)
    twists = np.zeros((len(truth["screws"]), 4, 4))
    for twist, screw in zip(twists, truth["screws"], strict=True):
        twist[:3, :3] = np.cross(np.eye(3), screw["w"])
        twist[:3, 3] = screw["v"]
    markers = np.array(truth["markers_tool"])
    if rig.flat:
        markers = FLAT + markers[truth["face_markers"]].mean(axis=0)
    tool = np.array(truth["T_base_tool_at_reference"])
    places = np.c_[markers, np.ones(len(markers))] @ tool.T
    P = np.array([truth["camera_left"], truth["camera_right"]])[:cameras]
    return Robot(truth["joint_types"], twists, P, places, np.array(truth["q_reference"]))


def poses_of(rig):
    """Readings of the recording, and those that are held out."""
    robot, rng = robot_of(rig, 1), np.random.default_rng([SEED, 0])
    q = trials(robot, frames=FRAMES)
    if rig.combined:
        q = np.concatenate([q, around(robot, COMBINED, rng)])
    return q, around(robot, HELD_OUT, rng, np.radians(50.0), 0.2)


def judged(job):
    """A row of the table: one draw of the noise of a rig."""
    name, draw, bound = job
    rig = RIGS[name]
    robot, (q, ahead) = robot_of(rig, 1), poses_of(rig)
    seen = robot.observe(q, NOISE_PX, np.random.default_rng([SEED, 1, draw]))
    row = {"rig": name, "draw": draw, "error_px": np.nan, "stated_px": np.nan, "reason": ""}
    try:
        found = calibrate(seen, robot.joint_types, source="recorded", image_size=(1280, 1024))
    except WorkFailed as error:
        return row | {"reason": str(error), "found": False}
    error = float(np.sqrt(np.nanmean((predict(found, ahead) - robot.images(ahead)) ** 2)))
    return row | {"error_px": error, "reason": found.reason, "found": error <= NEAR * bound}


def bound_px(rig, cameras):
    """Bound of the rms error of a coordinate of the left image, px."""
    robot, (q, ahead) = robot_of(rig, cameras), poses_of(rig)
    bound = Bound(robot, q, ahead)
    rows = np.reshape(bound.factor, (len(ahead), cameras, -1, bound.factor.shape[1]))[:, 0]
    return NOISE_PX * float(np.sqrt((rows**2).sum(axis=-1).mean()))


def main():
    """Judge all draws, print a line a rig, and write the table."""
    parser = parser_of("one_camera", __doc__, [("draws", 20, "of the noise, of each rig")], rigs=RIGS)
    asked = parser.parse_args()
    bounds = {name: (bound_px(RIGS[name], 1), bound_px(RIGS[name], 2)) for name in asked.rigs}
    jobs = [(name, draw, bounds[name][0]) for name in asked.rigs for draw in range(asked.draws)]
    rows = list(in_two_processes(judged, jobs, "one camera"))
    write_rows(asked.output, rows)
    print("rig: found (95 %), rms over the bound (1.1), bound over the pair's (1.45), errors px")
    for name, (alone, pair) in bounds.items():
        some = [row for row in rows if row["rig"] == name]
        errors = np.array([row["error_px"] for row in some if row["found"]])
        rms = float(np.sqrt(np.mean(errors**2))) if errors.size else np.nan
        print(
            f"{name}: {rate(sum(row['found'] for row in some), len(some))} %, {rms / alone:.3f}, "
            f"{alone / pair:.3f}, {quantiles(errors)}"
        )
        for row in some:
            if not row["found"]:
                print(f"    draw {row['draw']}: {row['error_px']:.3g} px, {row['reason'][:120]}")


if __name__ == "__main__":
    main()
