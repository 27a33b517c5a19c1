"""Trajectories that drive the three parts of the task together: [RH00] section 4.3."""

from typing import NamedTuple

import numpy as np

from projservo_cli.geometry.algebra import Mat4, apply, mat, mul, vec, vec_into
from projservo_cli.geometry.displacements import rotation, translation
from projservo_cli.geometry.jit import internal, merged, njit
from projservo_cli.geometry.kinematics import backward, forward_between
from projservo_cli.records import FloatArray, Model

# Share of the path for a part driven first, or last.
_PLATEAU = 0.5
# Names of the profiles of [RH00] section 4.3.
PROFILES = ("linear", "exponential", "rotation_first", "translation_first", "planar_first")


def profile_shares(profile: str, sigma: FloatArray, pure: tuple[float, float] = (1.0, 1.0)) -> FloatArray:
    """Shares μ_t, μ_r, μ_p of the parts along the path, [RH00] eq. (18) and section 4.3.

    The exponential profile (1 − exp(−kσ)) / (1 − exp(−k)), k = 5, is the paper's 1 − exp(−σ/t_*)
    scaled to reach 1. A profile with a part first completes it in the first half of the path, before the
    others start. A translation first goes as far as the unturned face stays visible, a rotation first as far
    as the face stays visible at its place, and either completes while the other runs.

    profile : one of ``PROFILES``.
    sigma : (k,) path parameter in [0, 1].
    pure : maximum shares of translation, δ τ_0 / τ, and rotation, δ θ_0 / θ_r, before the other begins.
    Returns (k, 3) shares, each monotone from 0 to 1. Raises ValueError if the profile is unknown.
    """
    if profile not in PROFILES:
        raise ValueError(f"unknown profile {profile!r}: choose one of {', '.join(PROFILES)}")
    if profile == "exponential":
        share = np.expm1(-5.0 * sigma) / np.expm1(-5.0)
        return np.stack([share, share, share], axis=1)
    first = np.minimum(sigma / _PLATEAU, 1.0)
    second = np.maximum((sigma - _PLATEAU) / (1.0 - _PLATEAU), 0.0)
    alone_t, alone_r = (share * first + (1.0 - share) * second for share in np.minimum(1.0, pure))
    t, r, p = {
        "linear": (sigma, sigma, sigma),
        "rotation_first": (second, alone_r, sigma),
        "translation_first": (alone_t, second, sigma),
        "planar_first": (second, second, first),
    }[profile]
    return np.stack([t, r, p], axis=1)


@njit
def both_rotations(H_r: Mat4, H_p: Mat4, theta_r: float, theta_p: float) -> Mat4:
    """Rotations of the planned displacement, exp(θ_r Ĥ_r) exp(θ_p Ĥ_p) of [RH00] eq. (17)."""
    return mul(rotation(H_r, theta_r), rotation(H_p, theta_p))


@njit
def displaced(H_hat: FloatArray, amplitudes: FloatArray, mu_t: float, mu_r: float, mu_p: float) -> Mat4:
    """Planned displacement at shares of the parts, [RH00] eqs. (17), (18)."""
    shift = translation(mat(H_hat[0]), mu_t * float(amplitudes[0]))
    theta_r, theta_p = mu_r * float(amplitudes[1]), mu_p * float(amplitudes[2])
    return mul(shift, both_rotations(mat(H_hat[1]), mat(H_hat[2]), theta_r, theta_p))


def trajectory_displacement(
    H_hat: FloatArray, amplitudes: tuple[float, float, float], mu: FloatArray
) -> FloatArray:
    """Planned displacements (..., 4, 4) of the face at shares (..., 3), [RH00] eqs. (17), (18).

    H_hat : (3, 4, 4) operators t, r, p; amplitudes : τ in the unit of Ĥ_t, θ_r and θ_p in rad.
    """
    H_hat, sizes = np.ascontiguousarray(H_hat), np.array(amplitudes, dtype=np.float64)
    displacements = [displaced(H_hat, sizes, *shares) for shares in mu.reshape(-1, 3).tolist()]
    return np.array(displacements).reshape(*mu.shape[:-1], 4, 4)


class Reference(NamedTuple):
    """A planned motion at k times, one control period apart except the last, the arrival."""

    H_hat: FloatArray  # (3, 4, 4) operators t, r, p of the plan
    amplitudes: FloatArray  # (3,) τ in the unit of Ĥ_t, θ_r and θ_p in rad
    mu: FloatArray  # (k, 3) shares; none for a joint-space path
    q: FloatArray  # (k, n) joints, rad or m; k is 0 without a plan, otherwise 2 or more
    A: FloatArray  # (k, m, 4) points of the face, a_inf·A = 1, before the displacement planned until then
    s: FloatArray  # (k, 2, m, 2) undistorted pixels of the face
    s_ahead: FloatArray  # (k, 2, m, 2) first-order motion of the pixels in the next period, px
    rate: float  # periods of the plan a period of the loop, less than 1 if commands are scaled
    room: FloatArray  # (n,) maximum correction by images off a joint-space path, rad or m; none for shares


# Reference without a plan.
NO_REFERENCE = Reference(
    H_hat=np.zeros((3, 4, 4)),
    amplitudes=np.zeros(3),
    mu=np.zeros((0, 3)),
    q=np.zeros((0, 0)),
    A=np.zeros((0, 0, 4)),
    s=np.zeros((0, 2, 0, 2)),
    s_ahead=np.zeros((0, 2, 0, 2)),
    rate=1.0,
    room=np.zeros(0),
)


@merged
def following(reference: Reference) -> bool:
    """Whether there is a plan to follow."""
    return bool(reference.q.shape[0] > 0)


@merged
def follows_joint_path(reference: Reference) -> bool:
    """Whether the reference is a joint-space path."""
    return bool(reference.room.shape[0] > 0)


@merged
def _row_before(reference: Reference, clock: float) -> tuple[int, float]:
    """Row before a time in periods, and the fraction towards the next; the plan stays at its end."""
    last = reference.q.shape[0] - 1
    i = min(int(clock), last - 1)
    return i, min(clock, float(last)) - i


@merged
def _between(column: FloatArray, i: int, x: float) -> float:
    """Interpolate between two rows, exactly at the rows."""
    return (1.0 - x) * float(column[i]) + x * float(column[i + 1])


@internal
def planned(model: Model, reference: Reference, clock: float) -> Mat4:
    """Displacement planned from the start until a time in periods, [RH00] eqs. (17), (18).

    On a joint-space path it follows from the joints, eq. (6).
    """
    i, x = _row_before(reference, clock)
    if follows_joint_path(reference):
        return mul(forward_between(model, reference.q, i, x), backward(model, reference.q[0]))
    mu_t = _between(reference.mu[:, 0], i, x)
    mu_r = _between(reference.mu[:, 1], i, x)
    mu_p = _between(reference.mu[:, 2], i, x)
    return displaced(reference.H_hat, reference.amplitudes, mu_t, mu_r, mu_p)


@merged
def on_joint_path(reference: Reference, clock: float) -> bool:
    """Whether the reference is a joint-space path that has not arrived yet."""
    return follows_joint_path(reference) and clock < reference.q.shape[0] - 1


@merged
def near_joint_path(reference: Reference, clock: float, l: int, wanted: float) -> float:
    """Clamp the value of joint l to the joint-space path at a time in periods, within ``room``."""
    i, x = _row_before(reference, clock)
    there, room = _between(reference.q[:, l], i, x), float(reference.room[l])
    return min(max(wanted, there - room), there + room)


@merged
def reference_into(
    model: Model,
    reference: Reference,
    clock: float,
    lead: float,
    A: FloatArray,
    s: FloatArray,
    q_ahead: FloatArray,
) -> None:
    """Write the reference at a time: the face, its images and the joint motion of the next period.

    For the image-based law, whose command is −λ J⁺ (s − s_ref), it feeds the planned velocity ṡ forward by
    a target ahead: s_ref = s + ṡ/λ.

    clock : time in periods.
    lead : 1/λ in periods.
    A : (m, 4) on return the face.
    s : (V, m, 2) on return the undistorted target pixels.
    q_ahead : (n,) on return the joint motion, rad or m.
    """
    i, x = _row_before(reference, clock)
    j, y = _row_before(reference, clock + 1.0)
    H = planned(model, reference, clock)
    for k in range(A.shape[0]):
        for c in range(4):
            A[k, c] = _between(reference.A[:, k, c], i, x)
        vec_into(A[k], apply(H, vec(A[k])))
        for view in range(s.shape[0]):
            for c in range(2):
                here = _between(reference.s[:, view, k, c], i, x)
                s[view, k, c] = here + lead * _between(reference.s_ahead[:, view, k, c], i, x)
    for l in range(q_ahead.shape[0]):
        q_ahead[l] = _between(reference.q[:, l], j, y) - _between(reference.q[:, l], i, x)


@merged
def planned_step(model: Model, reference: Reference, clock: float, share: float) -> Mat4:
    """Displacement of a plan of shares from a time on during a share of a period."""
    mu = reference.mu
    i, x = _row_before(reference, clock)
    H_r, H_p = mat(reference.H_hat[1]), mat(reference.H_hat[2])
    theta_r = _between(mu[:, 1], i, x) * float(reference.amplitudes[1])
    theta_p = _between(mu[:, 2], i, x) * float(reference.amplitudes[2])
    tau = _between(mu[:, 0], i, x) * float(reference.amplitudes[0])
    turned_back = mul(rotation(H_p, -theta_p), rotation(H_r, -theta_r))
    return mul(
        planned(model, reference, clock + share), mul(turned_back, translation(mat(reference.H_hat[0]), -tau))
    )
