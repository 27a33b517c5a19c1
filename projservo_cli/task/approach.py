"""Joints that come as near to a displacement as they can, where the operators are too dependent to reach it.

Near a singular configuration of the calibrated robot a displacement may lie just beyond what its joints
can do, though the robot itself can do it: the calibration is off by more than is left of the way.
"""

import math

from projservo_cli.geometry.algebra import Mat4, apply, mul, vec
from projservo_cli.geometry.jit import internal
from projservo_cli.geometry.kernels import least_squares
from projservo_cli.geometry.kinematics import operators_at, row
from projservo_cli.geometry.mechanisms import Work
from projservo_cli.records import FloatArray
from projservo_cli.task.margins import Reaching, image_jacobian

# Damped steps that are made, and how short one may be to be the last, rad or m.
MOST_STEPS = 12
SHORT = 1e-4
# What is this many times too far off after so many steps is out of reach.
OUT_OF_REACH, SOON = 10.0, 3
# Joint motions that move the images by less than this share of what the best one does are held back.
DAMPING = 1e-3


@internal
def image_miss(reaching: Reaching, H: Mat4, goal: Mat4, rhs: FloatArray) -> tuple[float, float]:
    """What the face displaced by H lacks of where ``goal`` takes it, in the images; differences in ``rhs``.

    Returns
    -------
    The largest distance of a marker, px, and the sum of all squared, px².
    """
    most = total = 0.0
    for k in range(reaching.A.shape[0]):
        here, there = apply(H, vec(reaching.A[k])), apply(goal, vec(reaching.A[k]))
        for view in range(2):
            P = reaching.model.P[view]
            depth, wanted = row(P, 2, here), row(P, 2, there)
            du = row(P, 0, there) / wanted - row(P, 0, here) / depth
            dv = row(P, 1, there) / wanted - row(P, 1, here) / depth
            rhs[4 * k + 2 * view], rhs[4 * k + 2 * view + 1] = du, dv
            most = max(most, du * du + dv * dv)
            total += du * du + dv * dv
    return math.sqrt(most), total


@internal
def approach(
    reaching: Reaching, H_back: Mat4, goal: Mat4, q: FloatArray, work: Work, M: FloatArray, newton: FloatArray
) -> float:
    """Bring the joints ``q``, in place, as near to a displacement as Levenberg–Marquardt steps take them.

    Parameters
    ----------
    H_back : inverse forward kinematics at the start.
    goal : displacement from there, of the face in front of both cameras.
    work : workspace of 4m + n rows, on return with the operators at the joints.
    M, newton : (2, 4) and (n,) workspaces.

    Returns
    -------
    Largest distance of a marker from where it should be that is left, px.
    """
    n, rows = q.shape[0], 4 * reaching.A.shape[0]
    damping = DAMPING
    H = mul(operators_at(reaching.model, q, work.H_hat), H_back)
    left, error = image_miss(reaching, H, goal, work.rhs)
    for step in range(MOST_STEPS):
        if step == SOON and left > OUT_OF_REACH * reaching.demands.miss_px:
            break
        image_jacobian(reaching, H, work, M)
        image_miss(reaching, H, goal, work.rhs)
        damp(work, n, rows, damping)
        if not least_squares(work.B, rows + n, n, newton, work.pivot, work.z, work.rhs):
            break
        most = 0.0
        for i in range(n):
            q[i] += newton[i]
            most = max(most, abs(newton[i]))
        there = mul(operators_at(reaching.model, q, work.H_hat), H_back)
        still, error_there = image_miss(reaching, there, goal, work.rhs)
        if error_there < error:
            H, left, error = there, still, error_there
            damping = max(DAMPING, 0.5 * damping)
        else:
            for i in range(n):
                q[i] -= newton[i]
            operators_at(reaching.model, q, work.H_hat)
            damping *= 4.0
        if most <= SHORT:
            break
    return left


@internal
def damp(work: Work, n: int, rows: int, damping: float) -> None:
    """Append rows that hold back each joint, by a share of the longest column of the image Jacobian."""
    longest = 0.0
    for i in range(n):
        square = 0.0
        for j in range(rows):
            square += work.B[i, j] * work.B[i, j]
        longest = max(longest, square)
    for i in range(n):
        for j in range(n):
            work.B[i, rows + j] = damping * math.sqrt(longest) if i == j else 0.0
        work.rhs[rows + i] = 0.0
