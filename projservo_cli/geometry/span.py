"""Displacements counted in six coordinates, for arms of more or fewer than six joints.

The kernels of [RH00] eqs. (8)–(10) are unique for six joints in general position. With more, a motion of
the face leaves the joint motion open; with fewer, not every motion of the face can be made. For such arms
the mechanisms are found among six operators that span all displacements, three translations and three
rotations of the calibrated frame, and the joints follow: with more by the motion of least norm, with
fewer by least squares.
"""

import numpy as np

from projservo_cli.geometry.jit import merged, njit
from projservo_cli.geometry.kernels import RANK_TOLERANCE, back_substitute, least_squares, orthogonalize
from projservo_cli.geometry.kinematics import joint_operators
from projservo_cli.geometry.mechanisms import COORDINATES, OWN, Span, Work
from projservo_cli.records import FloatArray, Model, WorkFailed

# Forms that the joints keep up to this share of the largest change are kept.
INVARIANT = 1e-6
# Once more with what rounding left of a solution by normal equations.
PASSES = 2


def span_of(model: Model, A: FloatArray) -> Span:
    """Six operators that span the displacements of the calibrated frame; ``OWN`` for six joints.

    Rotations are about the middle of the points, per rad; a unit of translation moves them about as far
    as a rad of rotation does.

    Parameters
    ----------
    model : calibrated model.
    A : (m, 4) points, a_inf·A = 1.

    Raises
    ------
    WorkFailed
        If the joints keep no shape of the frame, as those of a wrong calibration do not.
    """
    if len(model.q_reference) == COORDINATES:
        return OWN
    D = np.linalg.svd(model.a_inf[None])[2][1:]
    middle = A.mean(axis=0)
    turns = (
        D.T @ invariant_rotations(D @ model.H_hat_0 @ D.T) @ D @ (np.eye(4) - np.outer(middle, model.a_inf))
    )
    size = float(np.sqrt(np.mean(np.sum((turns @ A.T) ** 2, axis=1))))
    shifts = size * D[:, :, None] * model.a_inf
    H_hat = np.concatenate([shifts, turns])
    dual = np.linalg.pinv(H_hat.reshape(COORDINATES, 16).T)
    return Span(np.ascontiguousarray(H_hat), np.ascontiguousarray(dual))


def invariant_rotations(actions: FloatArray) -> FloatArray:
    """Three rotations (3, 3, 3) of the plane at infinity in the metric that all joints keep, per rad.

    The metric is the symmetric Q with LᵀQ + QL = 0 for every action L; where few joints leave it open, the
    one nearest to the identity, which does as well for what these joints can do.

    Parameters
    ----------
    actions : (n, 3, 3) of the joint operators on the plane at infinity.

    Raises
    ------
    WorkFailed
        If no metric is kept.
    """
    basis = np.array([_symmetric(i, j) for i in range(3) for j in range(i, 3)])
    changes = np.einsum("nba,sbc->nsac", actions, basis) + np.einsum("sab,nbc->nsac", basis, actions)
    _, sizes, rows = np.linalg.svd(np.swapaxes(changes, 0, 1).reshape(6, -1).T, full_matrices=True)
    sizes = np.r_[sizes, np.zeros(6 - len(sizes))]
    kept = rows[sizes <= INVARIANT * max(sizes[0], 1.0)]
    Q = np.einsum("s,sab->ab", kept.T @ (kept @ np.einsum("saa->s", basis)), basis)
    if len(kept) == 0 or np.linalg.eigvalsh(Q)[0] <= 1e-6 * np.abs(Q).max():
        raise WorkFailed(
            "the joints keep no metric of the calibrated frame: calibrate anew, or measure point by point "
            "with control.observation: points"
        )
    C = np.linalg.cholesky(Q).T
    return np.array([np.linalg.solve(C, np.cross(np.eye(3), e) @ C) for e in np.eye(3)])


def _symmetric(i: int, j: int) -> FloatArray:
    """Symmetric 3×3 matrix of unit norm with entries at i, j and j, i."""
    S = np.zeros((3, 3))
    S[i, j] = S[j, i] = 1.0
    return S / np.linalg.norm(S)


def in_span(span: Span, model: Model, q: FloatArray, q_hat: FloatArray) -> FloatArray:
    """Coordinates (k, 6) in the span of joint motions q̂ (k, n) at the joints q (n,); q̂ for six joints."""
    if len(span.H_hat) == 0:
        return q_hat
    H_hat = np.einsum("kn,nab->kab", q_hat, joint_operators(model, q))
    return np.asarray(H_hat.reshape(len(q_hat), 16) @ span.dual.T)


@njit
def joint_motion(work: Work, xi: FloatArray, q_hat: FloatArray) -> bool:
    """Joint motion of a displacement with coordinates ξ (6,), from the operators in ``work.H_hat``.

    Of least norm with more than six joints, of least squares with fewer. False at a singularity.
    """
    n = q_hat.shape[0]
    for i in range(n):
        for a in range(COORDINATES):
            total = 0.0
            for j in range(16):
                total += work.span.dual[a, j] * work.H_hat[i, j // 4, j % 4]
            work.J[a, i] = total
    if n < COORDINATES:
        for a in range(COORDINATES):
            work.rhs[a] = xi[a]
            for i in range(n):
                work.B[i, a] = work.J[a, i]
        return least_squares(work.B, COORDINATES, n, q_hat, work.pivot, work.z, work.rhs)
    for i in range(n):
        q_hat[i] = 0.0
        for a in range(COORDINATES):
            work.B[a, i] = work.J[a, i]
    first, _, last = orthogonalize(work.B, n, COORDINATES, work.norms, work.z, work.pivot, work.rhs, False)
    if not last > RANK_TOLERANCE * first:
        return False
    for _ in range(PASSES):
        add_least_norm(work, xi, q_hat)
    return True


@merged
def add_least_norm(work: Work, xi: FloatArray, q_hat: FloatArray) -> None:
    """Add Jᵀ(J Jᵀ)⁻¹ of what q̂ lacks of ξ, with Jᵀ factorised in ``work.B``."""
    n = q_hat.shape[0]
    z = work.z
    for k in range(COORDINATES):
        a = work.pivot[k]
        total = xi[a]
        for i in range(n):
            total -= work.J[a, i] * q_hat[i]
        for i in range(k):
            total -= work.B[i, k] * z[i]
        z[k] = total * work.B[k, k]
    back_substitute(work.B, COORDINATES, z)
    for k in range(COORDINATES):
        a = work.pivot[k]
        for i in range(n):
            q_hat[i] += work.J[a, i] * z[k]
