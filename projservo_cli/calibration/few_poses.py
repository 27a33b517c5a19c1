"""Refusal of recordings whose poses are too few: several arms then fit them, each with a small covariance."""

from itertools import combinations

import numpy as np

from projservo_cli.calibration.detections import Detections
from projservo_cli.records import WorkFailed

# Difference of readings, rad or m, below which two poses are one: a robot holds a joint with jitter.
_SAME = 1e-3
# Numbers of a rigid motion from one pose to another, of a revolute joint and of a prismatic one.
_OF_MOTION, _OF_REVOLUTE, _OF_PRISMATIC = 6, 4, 2
# Numbers to spare for each joint, as trials of single joints have them, up to those of a motion.
_SPARE = 2


def require_poses(detections: Detections) -> None:
    """Refuse poses that show hardly more of the arm, or of joints in a row, than these have.

    With as many numbers as unknowns an arm is one of finitely many, and no residual tells which: of 34 sets
    of five poses of a UR5 six predicted images 18 to 40 times worse than stated. With one motion to spare 1
    of 120 was beyond 3 times. Raises WorkFailed with both numbers and the number of poses to record.
    """
    q, n = np.round(detections.q[np.unique(detections.pose_of)] / _SAME), detections.prismatic.size
    for i, j in sorted(combinations(range(n + 1), 2), key=lambda ends: ends[0] - ends[1]):
        poses, own = len(np.unique(q[:, i:j], axis=0)), _OF_REVOLUTE * (j - i)
        own -= (_OF_REVOLUTE - _OF_PRISMATIC) * int(detections.prismatic[i:j].sum())
        needed, shown = own + min(_SPARE * (j - i), _OF_MOTION), _OF_MOTION * (poses - 1)
        if shown >= needed or j - i == 1:  # of a single joint range and noise decide
            continue
        what, enough = f"postures of joints {i + 1} to {j}", -(-needed // _OF_MOTION) + 1
        raise WorkFailed(
            f"{poses} {'poses' if j - i == n else what} show {shown} numbers of the arm, {_OF_MOTION} a "
            f"motion between two, less than the {needed} required ({own} unknown and {needed - own} to "
            f"spare): several arms fit them, and no residual tells which; record {enough} or more, "
            f"better {2 * enough}, in which every joint moves"
        )
