"""Goals of a list of incidences: joints at which all hold, of a continuum if they leave freedoms.

Newton's method leads from many joints to the nearest ones at which the incidences hold. Of these, goals in
sight and within limits come first, and among them the near ones with margins.
"""

import numpy as np

from projservo_cli.geometry.kinematics import forward_kinematics, image_jacobian, joint_operators
from projservo_cli.geometry.null_space import COORDINATES
from projservo_cli.planning.joint_constraints import Constraints, time_between
from projservo_cli.planning.rrt_connect import margins_at
from projservo_cli.records import FloatArray, Model
from projservo_cli.task.incidences import Incidences, image_error_at, linearized

# Starts of Newton's method around the start, around the goal that was taught, and between the limits; their
# deviation around these, rad or m.
_AROUND, _ANYWHERE, _SPREAD = 24, 24, 0.5
# Newton steps, the longest of a joint, rad or m, and the image error, px, at which they hold exactly.
_STEPS, _STRIDE, _MET_PX = 40, 0.4, 1e-6
# Error over the minimum, up to which goals that are not exact are met as well.
_AS_WELL = 1.01
# Margin over that asked for, from which more of it counts no more.
_AMPLE = 10.0
# Difference of joints, rad or m, below which goals are one.
_DISTINCT = 0.1


def _share(c: Constraints, q: FloatArray) -> float:
    """Margins at joints (n,) over those asked for, the smallest share; of a pose that images show badly less.

    Three deviations of the joints at one pixel of noise are to be within the margin of a limit.
    """
    asked = np.where(c.full > 0.0, c.full, 1.0)
    share = float((margins_at(c, q)[0][: len(asked)] / asked).min())
    H = forward_kinematics(c.model, q)
    J = image_jacobian(c.model.P, c.M @ H.T, joint_operators(c.model, q)).reshape(-1, len(q))
    singular_values = np.linalg.svd(J * c.keep / 3.0, compute_uv=False)
    return min(share, float(singular_values[min(len(q), COORDINATES) - 1]))


def _joints_meeting(
    model: Model, incidences: Incidences, q: FloatArray, low: FloatArray, high: FloatArray
) -> FloatArray:
    """Joints (n,) within limits (n,) near q at which all incidences hold, or nearly, by Newton's method."""
    q = np.clip(q, low, high)
    for _ in range(_STEPS):
        e, J = linearized(incidences, forward_kinematics(model, q), joint_operators(model, q))
        step = -np.linalg.lstsq(J, e, rcond=1e-6)[0]
        longest = float(np.abs(step).max())
        q = np.clip(q + step * min(1.0, _STRIDE / max(longest, _STRIDE)), low, high)
        if longest < 1e-12:
            break
    return q


def goals_meeting(
    c: Constraints,
    incidences: Incidences,
    q_start: FloatArray,
    taught: FloatArray,
    seed: int,
    max_px: float,
) -> tuple[FloatArray, FloatArray]:
    """Return joints (g, n) at which all incidences hold, the best first, and those that come nearest (n,).

    The best are in sight, then soon reached with margins. Goals that show less come after the others. Where
    none is exact, as with fewer joints than rows, the nearest ones hold that leave no more than ``max_px``.

    taught : (l, n) joints where the goal was taught; seed : of the starts.
    """
    generator, n = np.random.default_rng(seed), len(q_start)
    low, high = c.limits.lower, c.limits.upper
    starts = [q_start, *taught]
    starts += [*(near + _SPREAD * generator.standard_normal((_AROUND, n)) for near in starts)]
    if np.isfinite(low).all() and np.isfinite(high).all():
        starts.append(generator.uniform(low, high, (_ANYWHERE, n)))
    ends = np.array([_joints_meeting(c.model, incidences, start, low, high) for start in np.vstack(starts)])
    left = np.array([image_error_at(incidences, forward_kinematics(c.model, q)) for q in ends])
    nearest = ends[int(np.argmin(left))]
    within = max(_MET_PX, _AS_WELL * float(left.min())) if left.min() <= max_px else _MET_PX
    found: list[FloatArray] = []
    rank: list[tuple[bool, float]] = []
    for q in ends[left <= within]:
        if any(np.abs(q - other).max() < _DISTINCT for other in found):
            continue
        found.append(q)
        share = _share(c, q)
        time = time_between(c.limits.speed, q, q_start)
        rank.append((share <= 0.0, time * (1.0 + 1.0 / min(max(share, 0.1), _AMPLE))))
    order = sorted(range(len(found)), key=rank.__getitem__)
    return np.array([found[i] for i in order]).reshape(-1, n), nearest
