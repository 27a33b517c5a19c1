"""One camera and a board: whether all corners are kept, and how near predictions come to the bound.

    python -m tests.studies.boards [--draws 20] [-o boards.csv]

Draw k has a random arm of six revolute joints and 12 to 130 corners of 25 mm, flat for even k and bent
for the others, before a fixed camera, or before one on the tool where k mod 4 is 2 or 3. It is recorded
at 35 random poses at 0.2 px; corners outside the image are not seen. The bound is that of Cramér and Rao
of the corners seen. The first line is of the table in the reference data, against its noiseless images.
"""

import csv

import numpy as np

from projservo_cli.calibration import calibrate, predict
from projservo_cli.records import Observation, WorkFailed
from tests.calibration.bound import derivative, spread
from tests.calibration.simulated_robot import IMAGE_SIZE, NAMES, around, random_robot
from tests.calibration.test_cameras_on_the_tool import Hand
from tests.conftest import SHARED
from tests.studies.common import in_two_processes, parser_of, write_rows

SEED, NOISE_PX, POSES, HELD_OUT = 66, 0.2, 35, 40
PITCH, BEND = 0.025, 0.04  # m: of the corners, and the height of a bent board
NEAREST, EDGE = 0.3, 5.0  # m before the camera, and px within its image, of a corner that is seen
FEWEST, ENOUGH = 6, 30  # corners of an image, and poses of a recording


def board(rng, bent):
    """Corners (m, 4) of 12 to 130 on a board about the origin, in a random attitude, m."""
    columns, rows = rng.integers(4, 14), rng.integers(3, 11)
    x, y = np.meshgrid(np.arange(columns) - (columns - 1) / 2, np.arange(rows) - (rows - 1) / 2)
    flat = PITCH * np.stack([x.ravel(), y.ravel()], axis=1)
    height = BEND * (rng.uniform(-1.0, 1.0, len(flat)) if bent else np.zeros(len(flat)))
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    return np.c_[np.c_[flat, height] @ turn.T, np.ones(len(flat))]


def drawn(draw):
    """Arm, recording, poses to predict and its mount; drawn again until enough images show the board."""
    rng = np.random.default_rng([SEED, draw])
    for _ in range(1000):
        arm = random_robot("RRRRRR", rng, views=1)
        kind = Hand if draw % 4 > 1 else type(arm)
        arm = kind(arm.joint_types, arm.twists, arm.cameras, board(rng, draw % 2 == 1), arm.q_reference)
        q, ahead = around(arm, POSES, rng), around(arm, HELD_OUT, rng)
        seen, known = visible(arm, q), visible(arm, ahead)
        if (seen.sum(axis=1) >= FEWEST).sum() >= ENOUGH and known.sum(axis=1).min() > 0:
            break
    images = arm.images(q) + NOISE_PX * rng.standard_normal((*seen.shape[:1], 1, seen.shape[1], 2))
    images[~seen[:, None]] = np.nan
    observation = Observation(np.arange(POSES), np.arange(seen.shape[1]), q, images, view=NAMES[:1])
    return arm, observation, seen, ahead, known


def visible(arm, q):
    """Mask (K, m) of corners before the camera and in its image."""
    m = arm.projected(q)[:, 0]
    pixels = m[:, :2] / m[:, 2:]
    inside = (pixels > EDGE) & (pixels < np.array(IMAGE_SIZE)[:, None] - EDGE)
    return inside.all(axis=1) & (m[:, 2] > NEAREST)


def bound_px(arm, q, seen, ahead, known):
    """Bound of the rms error of a coordinate at poses to predict, px."""
    if isinstance(arm, Hand):
        arm, q, ahead = arm.seen_from_the_hand, -q[:, ::-1], -ahead[:, ::-1]
    # A corner that no image shows has no prediction.
    shown = seen.sum(axis=0) > 1
    factor = spread(
        derivative(arm, q)[np.repeat((seen & shown).ravel(), 2)],
        derivative(arm, ahead)[np.repeat((known & shown).ravel(), 2)],
    )
    return NOISE_PX * float(np.sqrt((factor**2).sum(axis=1).mean()))


def judged(draw):
    """A row of the table."""
    arm, observation, seen, ahead, known = drawn(draw)
    mount, corners = ("tool" if isinstance(arm, Hand) else "world"), seen.shape[1]
    row = {"draw": draw, "mount": mount, "corners": corners, "flat": draw % 2 == 0, "seen": int(seen.sum())}
    row |= {"usable": False, "kept": 0, "error_px": np.nan, "bound_px": np.nan, "reason": ""}
    try:
        found = calibrate(observation, "RRRRRR", source="recorded", image_size=IMAGE_SIZE, mount=mount)
    except WorkFailed as error:
        return row | {"reason": str(error)}
    shown = known & np.isin(observation.marker, found.marker)
    error = np.full((*known.shape, 2), np.nan)
    error[:, np.isin(observation.marker, found.marker)] = predict(found, ahead)[:, 0]
    error -= arm.images(ahead)[:, 0]
    return row | {
        "usable": found.usable,
        "kept": len(found.marker),
        "rejected": len(found.outlier),
        "error_px": float(np.sqrt(np.mean(error[shown] ** 2))),
        "bound_px": bound_px(arm, observation.q, seen, ahead, known),
        "reason": found.reason,
    }


def reference():
    """Rms error of a coordinate by the table of the reference data, px, and the number of corners kept."""
    folder = SHARED / "board"

    def table(name):
        with open(folder / f"{name}_joints.csv", encoding="utf-8") as file:
            q = {int(row["pose"]): [float(row[f"q{i}"]) for i in range(1, 7)] for row in csv.DictReader(file)}
        images = np.full((len(q), 1, 63, 2), np.nan)
        order = {pose: k for k, pose in enumerate(q)}
        with open(folder / f"{name}.csv", encoding="utf-8") as file:
            for row in csv.DictReader(file):
                at = order[int(row["pose"])], 0, int(row["marker"])
                images[at] = float(row["u"]), float(row["v"])
        return Observation(
            np.array(list(q)), np.arange(63), np.array(list(q.values())), images, view=("cam",)
        )

    test = table("test")
    found = calibrate(table("train"), "RRRRRR", source="recorded", image_size=(1280, 960))
    return float(np.sqrt(np.nanmean((predict(found, test.q) - test.images) ** 2))), len(found.marker)


def main():
    """Judge all draws, print a line each, and write the table."""
    asked = parser_of("boards", __doc__, [("draws", 20, "of boards")]).parse_args()
    if (SHARED / "board").is_dir():
        print("reference table: {:.4f} px rms a coordinate, {} of 63 corners kept".format(*reference()))
    rows = []
    for row in in_two_processes(judged, range(asked.draws), "boards"):
        rows.append(row)
        print(
            "draw {draw}: {mount}, {corners} corners, flat {flat}, usable {usable}, {kept} kept, error "
            "{error_px:.4f} px, bound {bound_px:.4f} px {reason}".format_map(row),
            flush=True,
        )
    write_rows(asked.output, rows)
    ratio = np.array([row["error_px"] / row["bound_px"] for row in rows if row["usable"]])
    whole = sum(row["usable"] and row["kept"] == row["corners"] for row in rows)
    print(
        f"usable with all corners: {whole} of {len(rows)}; rms over the draws of error over bound: "
        f"{np.sqrt(np.mean(ratio**2)):.3f}"
    )


if __name__ == "__main__":
    main()
