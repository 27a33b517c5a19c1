"""No wrong fit is returned as usable: random tables, up to 60 % of their sightings wrong in every way.

python -m tests.studies.calibration_wrong [first] [last] prints a row a table that is returned as usable
although the true rms of held-out predictions over the range of the trials exceeds 2 × ``predicted_rms_px``
+ 0.1 px, and then how many were usable, refused and wrong. Predictions are of points in the images, of
markers most of whose sightings are right: where no majority speaks for a marker, nobody can know it.
"""

import multiprocessing
import sys
import warnings

import numpy as np

from projservo_cli.calibration import calibrate, predict
from projservo_cli.records import InputError, WorkFailed
from tests.calibration.mistakes import MISTAKES, table
from tests.calibration.simulated_robot import IMAGE_SIZE

TABLES = 1000


def drawn(number):
    """A random table: of 1 to 7 joints, 8 to 40 poses, 8 to 60 points."""
    rng = np.random.default_rng([18, number])
    joints = int(rng.integers(1, 8))
    letters = "".join(rng.choice(["R", "P"], joints, p=[0.8, 0.2]))
    if joints == 1 and rng.random() < 0.5:
        letters = "turntable"
    points, poses, length = rng.integers(8, 61), rng.integers(8, 41), rng.integers(3, 21)
    mistake = str(rng.choice(MISTAKES))
    return table(
        mistake,
        number,
        int(points),
        int(poses),
        joint_types=letters,
        share=rng.uniform(0.0, 0.6),
        length=length,
    )


def judged(number):
    """Number, what came of it (usable, refused or wrong), true and predicted rms, px, and the reason."""
    warnings.simplefilter("ignore")
    mistaken = drawn(number)
    try:
        found = calibrate(
            mistaken.observation, mistaken.robot.joint_types, source="recorded", image_size=IMAGE_SIZE
        )
    except (InputError, WorkFailed) as refused:
        return number, "refused", np.nan, np.nan, str(refused)
    if not found.usable:
        return number, "refused", np.nan, np.nan, found.reason
    truth = mistaken.robot.images(mistaken.ahead)[:, :, found.marker]
    inside = ((truth >= 0.0) & (truth <= np.array(IMAGE_SIZE) - 1.0)).all(axis=3)
    right, seen = (np.count_nonzero(which, axis=0) for which in (mistaken.kind == 0, mistaken.kind >= 0))
    inside &= (2 * right > seen)[found.marker]
    error = np.linalg.norm(predict(found, mistaken.ahead) - truth, axis=3)
    # A point that is predicted behind a camera is as wrong as can be.
    rms = float(np.sqrt(np.mean(np.nan_to_num(error[inside], nan=1e4) ** 2))) if inside.any() else 0.0
    predicted = found.predicted_rms_px
    wrong = predicted is None or rms > 2.0 * predicted + 0.1
    return number, "wrong" if wrong else "usable", rms, predicted, found.reason


def main(first=0, last=TABLES):
    """Judge tables in two processes."""
    count = {"usable": 0, "refused": 0, "wrong": 0}
    with multiprocessing.Pool(2) as pool:
        for row in pool.imap_unordered(judged, range(first, last)):
            count[row[1]] += 1
            if row[1] == "wrong":
                print(*row, flush=True)
    print(count)


if __name__ == "__main__":
    main(*(int(text) for text in sys.argv[1:]))
