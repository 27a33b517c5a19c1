"""A rig that flies freely before a face: six constant twists instead of joints.

It checks control laws without any robot: the operators do not depend on the joints, and the pose is
integrated by one exponential of the commanded twist.
"""

import numpy as np

from projservo_cli.geometry.stereo import optical_centers
from projservo_cli.plants.plant import Plant
from projservo_cli.plants.robot import METRIC_A_INF, twist
from projservo_cli.records import FREE, FloatArray, Model
from projservo_cli.task.face import center_of, cyclic_order, face_plane


def rig_twists() -> FloatArray:
    """Operators (6, 4, 4) of the face in the rig's frame for the rig's velocities v (m/s), ω (rad/s)."""
    unit = np.eye(3).tolist()
    moving = [twist((0, 0, 0), v) for v in unit] + [twist(w, (0, 0, 0)) for w in unit]
    return -np.array(moving)


def free_flying_plant(P: FloatArray, M: FloatArray, center: int) -> Plant:
    """Plant of a free-flying rig.

    Parameters
    ----------
    P : (2, 3, 4) cameras in the rig's frame, any image unit.
    M : (m, 4) points of the face in the rig's frame at the start, m.
    center : index of the centre marker, or ``MIDPOINT``.

    Returns
    -------
    Plant whose images have no border and whose twists have no limits.
    """
    model = Model(P, rig_twists(), np.full(6, FREE, dtype=np.int64), np.zeros(6), METRIC_A_INF.copy())
    order = cyclic_order(M)
    O = optical_centers(P, METRIC_A_INF)
    side = O @ np.array(face_plane(M, order, center_of(M, center)))
    endless = np.full(6, np.inf)
    return Plant(model, M, order, center, O, np.sign(side), np.full(2, np.inf), -endless, endless, False)
