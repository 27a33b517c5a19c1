"""Symmetric forms that motions keep: the metric of a frame in which rotations and translations are rigid.

A metric form Q gives lengths √(d·Q d) of directions d. Rotations about axes that are not parallel leave one;
a board of known shape decides among those that other joints leave.
"""

import numpy as np

from projservo_cli.records import FloatArray

_I, _J = np.triu_indices(3)
# Rows and columns of the entries of intrinsics: focal length, skew, u of the centre, focal length, v.
UPPER = (0, 0, 0, 1, 1), (0, 1, 2, 1, 2)
# Orthonormal symmetric forms.
_BASIS = np.zeros((6, 3, 3))
_BASIS[range(6), _I, _J] = _BASIS[range(6), _J, _I] = np.where(_I == _J, 1.0, np.sqrt(0.5))


def form_of(coefficients: FloatArray) -> FloatArray:
    """Form (…, 3, 3) of coefficients (…, 6), of positive trace."""
    S = np.einsum("...s,sab->...ab", coefficients, _BASIS)
    return np.asarray(S * np.sign(np.trace(S, axis1=-2, axis2=-1))[..., None, None])


def changes_by_rotations(L: FloatArray) -> FloatArray:
    """Changes (…, 9 n, 6) of forms S by actions L (…, n, 3, 3), L S + S Lᵀ; of metric forms by Lᵀ."""
    moved = np.einsum("...nab,sbc->...nacs", L, _BASIS)
    return np.asarray((moved + np.einsum("...nacs->...ncas", moved)).reshape(*L.shape[:-3], -1, 6))


def differences_of_lengths(d: FloatArray) -> FloatArray:
    """Differences (…, k − 1, 6) of squared lengths of directions (…, k, 3) by metric forms, of unit sum."""
    squares = np.einsum("...ka,...kb,sab->...ks", d, d, _BASIS)
    return np.asarray(
        np.diff(squares, axis=-2) / np.maximum((d**2).sum(axis=(-1, -2)), 1e-300)[..., None, None]
    )


def distortions_of_boards(steps: FloatArray) -> FloatArray:
    """Distortions (…, b, 2, 6) of squares with sides (…, b, 2, 3) by metric forms: unequal, and oblique."""
    a, b = steps[..., 0, :], steps[..., 1, :]
    alike = np.einsum("...a,...b,sab->...s", a, a, _BASIS) - np.einsum("...a,...b,sab->...s", b, b, _BASIS)
    across = 2.0 * np.einsum("...a,...b,sab->...s", a, b, _BASIS)
    return np.asarray(np.stack([alike, across], axis=-2) / (a**2).sum(axis=-1)[..., None, None])


def board_steps(positions: FloatArray, points: FloatArray) -> FloatArray:
    """Steps (…, 2, 3) from a corner to the next, of corners at positions (k, 2) and points (…, k, 3)."""
    rows = np.column_stack([positions, np.ones(len(positions))])
    return np.asarray(np.linalg.pinv(rows)[:2] @ points)


def intrinsics_of(P: FloatArray) -> FloatArray:
    """Intrinsic matrices (…, 3, 3), px, of cameras (…, 3, 4) of a metric frame, from K Kᵀ."""
    rows = P[..., ::-1, :3]
    K = np.linalg.cholesky(rows @ rows.swapaxes(-1, -2))[..., ::-1, ::-1]
    return np.asarray(K / K[..., 2:, 2:])


def intrinsics_derivative(P: FloatArray) -> FloatArray:
    """Derivatives (…, 5, 12) of the upper entries of intrinsics (``UPPER``) by cameras (…, 3, 4).

    K⁻¹ dA A⁻¹ K of A = s K R is K⁻¹ dK, which is upper triangular, plus a rotation's rate and ds / s.
    """
    K, by_entry = intrinsics_of(P), np.zeros((12, 3, 4))
    by_entry.reshape(12, 12)[:] = np.eye(12)
    right = np.linalg.solve(P[..., :3], K)
    X = np.linalg.solve(K[..., None, :, :], by_entry[..., :3] @ right[..., None, :, :])
    size = np.diagonal(X, axis1=-2, axis2=-1) - X[..., 2:, 2]
    U = np.triu(X + X.swapaxes(-1, -2), 1) + size[..., None] * np.eye(3)
    return np.asarray((K[..., None, :, :] @ U)[..., *UPPER].swapaxes(-1, -2))
