"""Symmetric forms that motions keep: the metric of a frame in which rotations and translations are rigid.

A metric form Q gives lengths √(d·Q d) of directions d. Rotations about axes that are not parallel leave one;
a board of known shape decides among those that other joints leave.
"""

import numpy as np

from projservo_cli.records import FloatArray

_I, _J = np.triu_indices(3)
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
