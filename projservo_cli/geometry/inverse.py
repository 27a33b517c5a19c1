"""Projective inverse kinematics: the joints whose product of exponentials is a given displacement.

Newton's method on the projective forward kinematics alone, [RH00] eqs. (6), (19); no metric quantity
enters.
"""

from projservo_cli.geometry.algebra import Mat4, apply, mat, mul, sub, vec
from projservo_cli.geometry.jit import internal
from projservo_cli.geometry.kernels import least_squares
from projservo_cli.geometry.kinematics import operators_at
from projservo_cli.geometry.mechanisms import Work
from projservo_cli.geometry.span import joint_motion
from projservo_cli.records import FloatArray, Model

MOST_NEWTON_STEPS = 6
# A Newton step this short, rad or m, is the last: the next would be its square, below round-off.
SETTLED = 1e-8


@internal
def reach(
    model: Model,
    H_back: Mat4,
    goal: Mat4,
    A: FloatArray,
    q: FloatArray,
    work: Work,
    newton: FloatArray,
    settled: float = SETTLED,
) -> bool:
    """Newton steps on the joints ``q``, in place, until they displace the face A by ``goal``.

    Each is of least norm with more than six joints; with fewer the face comes as near as they bring it.

    Parameters
    ----------
    H_back : inverse forward kinematics at the joints where A was seen.
    goal : displacement from there.
    A : (m, 4) points of the face.
    work, newton : workspaces of n joints and 4m rows; ``newton`` (n,) is left with the last step.
    settled : Newton step that is the last, rad or m.

    Returns
    -------
    False where the steps did not settle or the operators are singular.
    """
    n = q.shape[0]
    m = A.shape[0]
    redundant = work.columns.shape[0] < n
    x = work.xi if redundant else newton
    for _ in range(MOST_NEWTON_STEPS):
        H = mul(operators_at(model, q, work.H_hat), H_back)
        for k in range(m):
            reached = apply(H, vec(A[k]))
            miss = sub(apply(goal, vec(A[k])), reached)
            for j in range(4):
                work.rhs[4 * k + j] = miss[j]
            columns = work.columns
            for i in range(columns.shape[0]):
                velocity = apply(mat(columns[i]), reached)
                for j in range(4):
                    work.B[i, 4 * k + j] = velocity[j]
        if not least_squares(work.B, 4 * m, min(n, x.shape[0]), x, work.pivot, work.z, work.rhs):
            return False
        if redundant and not joint_motion(work, x, newton):
            return False
        most = 0.0
        for i in range(n):
            q[i] += newton[i]
            most = max(most, abs(newton[i]))
        if most <= settled:
            return True
    return False
