"""Whether an arm of fewer than six joints can do a task at all."""

import numpy as np
from scipy.optimize import least_squares

from projservo_cli.geometry.kinematics import forward_kinematics, project
from projservo_cli.records import FloatArray, Model, WorkFailed

# What noise and calibration may leave of images that the joints can reach, px rms per marker and view.
LEFT_PX = 3.0
STAGES = 20


def require_in_span(model: Model, A: FloatArray, q_start: FloatArray, images: FloatArray) -> None:
    """Refuse a task whose goal the joints cannot bring the face to.

    The joints that bring the face nearest to its planned images, in px, are carried along the plan.

    Parameters
    ----------
    model : calibrated model.
    A : (m, 4) face at the start.
    q_start : (n,) joints there, rad or m.
    images : (s, 2, m, 2) planned pixels of the face.

    Raises
    ------
    WorkFailed
        If more than ``LEFT_PX`` of image error are left at the goal.
    """
    M = A @ np.linalg.inv(forward_kinematics(model, q_start)).T
    q = q_start

    def miss(q: FloatArray, wanted: FloatArray) -> FloatArray:
        return (project(model.P, M @ forward_kinematics(model, q).T, model.lens) - wanted).ravel()

    for k in np.unique(np.linspace(0, len(images) - 1, STAGES).astype(int)):
        q = least_squares(miss, q, args=(images[k],), method="lm", xtol=1e-12).x
    left = float(np.sqrt(np.mean(np.sum(miss(q, images[-1]).reshape(-1, 2) ** 2, axis=1))))
    if not left <= LEFT_PX:
        raise WorkFailed(
            f"the task does not lie in what {len(q)} joints can do: the nearest they bring the face is "
            f"{left:.3g} px rms from its goal images, more than the {LEFT_PX:g} px that noise may leave; "
            "choose a goal by joint readings, or one that moves the face as these joints do"
        )
