"""What mistakes in a table cost: each kind alone and a mixture, a few seeds each.

python -m tests.studies.calibration_mistakes [points] [share] [kinds …] prints a row a table: seconds of the
processor, whether it is usable, the median error of held-out images over that of a fit to what is right
alone and over that of the best estimator with the same noise, the share of wrong sightings off by more than
4 σ that is left out, and of right ones, on tracks of at least four sightings, more than half of them right.
"""

import sys
import time
import warnings

import numpy as np

from projservo_cli.calibration import calibrate, predict
from projservo_cli.records import WorkFailed
from tests.calibration.bound import errors_of_the_best
from tests.calibration.mistakes import MISTAKES, SIGMA, table

SEEDS = (1, 2, 3)
_COLUMNS = [
    "mistake",
    "seed",
    "joints",
    "points",
    "seconds",
    "usable",
    "over_right",
    "over_bound",
    "wrong_out",
    "right_out",
]


def left_out(mistaken, calibration):
    """Sightings (K, m) of which a view was left out, or whose pose or marker was."""
    out = np.zeros(mistaken.kind.shape, dtype=bool)
    out[calibration.outlier[:, 0], calibration.outlier[:, 1]] = True
    for pose, *numbers in calibration.id_switches:
        out[pose, numbers[0]] = True
        # An exchange of two shows in both and is told once.
        out[pose, numbers[1]] |= mistaken.kind[pose, numbers[1]] == 1
    out[calibration.suspect[:, 0]] = True
    out[calibration.rejected_poses] = True
    gone = np.setdiff1d(mistaken.observation.marker, calibration.marker)
    out[:, gone] = True
    return out & (mistaken.kind >= 0)


def shares_left_out(mistaken, calibration):
    """Shares of the wrong sightings off by more than 4 σ and of the right ones, as counted."""
    out = left_out(mistaken, calibration)[:, mistaken.counted]
    kind, off = mistaken.kind[:, mistaken.counted], mistaken.off[:, mistaken.counted]
    wrong, right = (kind > 0) & (off > 4.0 * SIGMA), kind == 0
    return out[wrong].mean() if wrong.any() else np.nan, out[right].mean()


def median_error(mistaken, calibration, markers):
    """Median error of held-out images of markers, px."""
    truth = mistaken.robot.images(mistaken.ahead)[:, :, markers]
    images = predict(calibration, mistaken.ahead)[:, :, np.searchsorted(calibration.marker, markers)]
    return float(np.nanmedian(np.linalg.norm(images - truth, axis=3)))


def one(mistaken):
    """Measurements of a table, or why it was refused."""
    letters = mistaken.robot.joint_types
    begin = time.process_time()
    try:
        found = calibrate(mistaken.observation, letters, source="recorded", image_size=(1280, 1024))
    except WorkFailed as refused:
        return [time.process_time() - begin, False, np.nan, np.nan, np.nan, np.nan], str(refused)
    seconds = time.process_time() - begin
    best = calibrate(mistaken.right, letters, source="recorded", image_size=(1280, 1024))
    own = mistaken.counted
    markers = np.intersect1d(np.intersect1d(found.marker, best.marker), np.flatnonzero(own))
    mine, ideal = (median_error(mistaken, one, markers) for one in (found, best))
    bound = np.median(errors_of_the_best(mistaken)[:, :, markers])
    return [
        seconds,
        found.usable,
        mine / ideal,
        mine / bound,
        *shares_left_out(mistaken, found),
    ], found.reason


def main(points=1500, share=0.2, kinds=("right", *MISTAKES)):
    """Print a row a table."""
    warnings.simplefilter("ignore")
    print(*_COLUMNS)
    for kind in kinds:
        for seed in SEEDS:
            for joints, poses in (("RRRRRR", 24), ("turntable", 36)):
                values, why = one(table(kind, seed, points, poses, joint_types=joints, share=share))
                row = (f"{v:.3f}" if isinstance(v, float) else str(v) for v in values)
                print(kind.replace(" ", "_"), seed, joints, points, *row, "#", why, flush=True)


if __name__ == "__main__":
    given = sys.argv[1:]
    main(
        *(of(text) for of, text in zip((int, float), given, strict=False)),
        *(
            [[name.replace("_", " ") for name in given[2:]]]
            if [name.replace("_", " ") for name in given[2:]]
            else []
        ),
    )
