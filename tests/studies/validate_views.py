"""One camera of two to five that turned since the calibration: how often `validate` ends in 1 and names it.

    python -m tests.studies.validate_views [--draws 200] [-o validate_views.csv]

Each rig, an arm of six joints with 12 markers before two to five cameras at 0.3 px, is calibrated once from
single-joint trials and twelve combined poses. Each draw is a table of 8 to 40 random poses within ±30°, at
0.3 px, of one rig. One camera sees all rows while the others miss a part of theirs (more), or misses two
thirds of its own (fewer). Its images are shifted in a random direction by 3, 10 and 100 times the median
error that the covariance states there, and by none. A table without a shift in which any view passes its
limit is a false alarm; of the others the one view that passes must be that of the camera.
"""

import dataclasses

import numpy as np

from projservo_cli.calibration import calibrate, residual_statistics
from tests.calibration.simulated_robot import around, random_robot, trials
from tests.studies.common import parser_of, written

SEED, NOISE_PX, MARKERS, COMBINED = 2711, 0.3, 12, 12
VIEWS, TIMES, ROWS = (2, 3, 4, 5), (0, 3, 10, 100), ("more", "fewer")
POSES, MISSED = (8, 40), 2.0 / 3.0
SURE = 0.99  # share that is to be found from 10 times the stated error on
COLUMNS = ("draw", "views", "rows", "times", "poses", "stated_px", "named", "beyond")


def rig_of(views):
    """A robot before some cameras, and its calibration."""
    rng = np.random.default_rng([SEED, views])
    robot = random_robot("RRRRRR", rng, MARKERS, views)
    q = np.concatenate([trials(robot), around(robot, COMBINED, rng)])
    return robot, calibrate(robot.observe(q, NOISE_PX, rng), robot.joint_types, image_size=(1280, 1024))


def rows_of(draw, rig):
    """Rows of the table of one draw: one for each number of times the stated error."""
    robot, calibration = rig
    rng, views = np.random.default_rng([SEED, 100, draw]), len(robot.cameras)
    camera, rows = int(rng.integers(views)), ROWS[draw // len(VIEWS) % 2]
    seen = robot.observe(around(robot, int(rng.integers(*POSES)), rng), NOISE_PX, rng)
    images = seen.images.copy()
    for v in range(views):
        if (v == camera) == (rows == "fewer"):
            images[rng.random(len(images)) < MISSED, v] = np.nan
    if not np.isfinite(images[:, camera]).any():
        images[:, camera] = seen.images[:, camera]
    stated = residual_statistics(calibration, dataclasses.replace(seen, images=images))["stated_px"]
    angle = rng.uniform(0.0, 2.0 * np.pi)
    for times in TIMES:
        shifted = images.copy()
        shifted[:, camera] += times * stated * np.array([np.cos(angle), np.sin(angle)])
        value = residual_statistics(calibration, dataclasses.replace(seen, images=shifted))
        beyond = [
            one["view"] for one in value["views"] if one["count"] and one["median_px"] > one["limit_px"]
        ]
        named = beyond == [calibration.view[camera]]
        found = (draw, views, rows, times, len(images), stated, int(named), len(beyond))
        yield dict(zip(COLUMNS, found, strict=True))


def main():
    """Judge all draws, print a line for each number of times, and write the table."""
    asked = parser_of("validate_views", __doc__, [("draws", 200, "tables of each kind")]).parse_args()
    rigs = [rig_of(views) for views in VIEWS]
    made = (list(rows_of(draw, rigs[draw % len(rigs)])) for draw in range(asked.draws))
    rows = written(asked.output, COLUMNS, made)
    for times in TIMES:
        some = [row for row in rows if row["times"] == times]
        alarms, named = sum(row["beyond"] > 0 for row in some), sum(row["named"] for row in some)
        wanted = "0" if not times else f"≥ {SURE:.0%}" if times >= 10 else "measured"
        print(f"{times:3d} times: {alarms} of {len(some)} end in 1, {named} name the camera ({wanted})")


if __name__ == "__main__":
    main()
