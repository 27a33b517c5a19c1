"""Trajectories that drive the three parts of the task together: [RH00] section 4.3."""

import numpy as np

from projservo_cli.geometry.algebra import Mat4, mat, mul
from projservo_cli.geometry.displacement import as_array, rotation, translation
from projservo_cli.geometry.jit import merged, njit
from projservo_cli.records import FloatArray

# Share of the path that a part driven first, or last, has to itself.
PLATEAU = 0.5
PROFILES = ("linear", "exponential", "rotation_first", "translation_first", "planar_first")


def profile_shares(profile: str, sigma: FloatArray, pure_translation: float = 1.0) -> FloatArray:
    """Shares μ_t, μ_r, μ_p of the parts along the path, [RH00] eq. (18) and section 4.3.

    The exponential profile (1 − exp(−kσ)) / (1 − exp(−k)), k = 5, is the paper's 1 − exp(−σ/t_*)
    stretched to reach 1. In the profiles with a part first, that part is done in the first half of
    the path and the others stay flat until then; a translation first goes no farther than visibility
    lets the unturned face go, and does the rest while the face turns.

    Parameters
    ----------
    profile : one of ``PROFILES``.
    sigma : (k,) path parameter in [0, 1].
    pure_translation : most share of the translation before any rotation, δ τ_0 / τ.

    Returns
    -------
    (k, 3) shares, each monotone from 0 to 1.

    Raises
    ------
    ValueError
        If the profile is unknown.
    """
    if profile not in PROFILES:
        raise ValueError(f"unknown profile {profile!r}: choose one of {', '.join(PROFILES)}")
    if profile == "exponential":
        share = np.expm1(-5.0 * sigma) / np.expm1(-5.0)
        return np.stack([share, share, share], axis=1)
    early = np.minimum(sigma / PLATEAU, 1.0)
    late = np.maximum((sigma - PLATEAU) / (1.0 - PLATEAU), 0.0)
    share = min(1.0, pure_translation)
    t, r, p = {
        "linear": (sigma, sigma, sigma),
        "rotation_first": (late, early, sigma),
        "translation_first": (share * early + (1.0 - share) * late, late, sigma),
        "planar_first": (late, late, early),
    }[profile]
    return np.stack([t, r, p], axis=1)


@njit
def turned(H_r: Mat4, H_p: Mat4, theta_r: float, theta_p: float) -> Mat4:
    """Rotations of the planned displacement, exp(θ_r Ĥ_r) exp(θ_p Ĥ_p) of [RH00] eq. (17)."""
    return mul(rotation(H_r, mul(H_r, H_r), theta_r), rotation(H_p, mul(H_p, H_p), theta_p))


@merged
def rotated(H_hat: FloatArray, amplitudes: FloatArray, mu_r: float, mu_p: float) -> Mat4:
    """Rotations of the planned displacement at shares μ_r, μ_p of the angles, [RH00] eqs. (17), (18)."""
    return turned(mat(H_hat[1]), mat(H_hat[2]), mu_r * float(amplitudes[1]), mu_p * float(amplitudes[2]))


@njit
def displaced(H_hat: FloatArray, amplitudes: FloatArray, mu_t: float, mu_r: float, mu_p: float) -> Mat4:
    """Planned displacement at shares of the parts, [RH00] eqs. (17), (18)."""
    shift = translation(mat(H_hat[0]), mu_t * float(amplitudes[0]))
    return mul(shift, rotated(H_hat, amplitudes, mu_r, mu_p))


def trajectory_displacement(
    H_hat: FloatArray, amplitudes: tuple[float, float, float], mu: FloatArray
) -> FloatArray:
    """Planned displacement of the face, [RH00] eqs. (17), (18).

    Parameters
    ----------
    H_hat : (3, 4, 4) operators t, r, p.
    amplitudes : τ in the unit of Ĥ_t, θ_r and θ_p in rad.
    mu : (3,) shares.

    Returns
    -------
    (4, 4) displacement exp(μ_t τ Ĥ_t) exp(μ_r θ_r Ĥ_r) exp(μ_p θ_p Ĥ_p).
    """
    H_hat = np.ascontiguousarray(H_hat, dtype=np.float64)
    return as_array(displaced(H_hat, np.array(amplitudes, dtype=np.float64), *(float(share) for share in mu)))
