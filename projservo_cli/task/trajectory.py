"""Trajectories that drive the three parts of the task together: [RH00] section 4.3."""

from typing import NamedTuple

import numpy as np

from projservo_cli.geometry.algebra import Mat4, apply, mat, mul, put_vec, rotation, translation, vec
from projservo_cli.geometry.jit import internal, merged, njit
from projservo_cli.geometry.kinematics import backward, forward_between
from projservo_cli.records import FloatArray, Model

# Share of the path that a part driven first, or last, has to itself.
_PLATEAU = 0.5
PROFILES = ("linear", "exponential", "rotation_first", "translation_first", "planar_first")


class KeptOut(NamedTuple):
    """What an obstacle covers in the images: polygons of corners u and v, px; None for none in an image."""

    left: tuple[tuple[float, float], ...] | None
    right: tuple[tuple[float, float], ...] | None
    hides: bool  # whether the obstacle may hide markers: those of the face stay outside in both images


class Trajectory(NamedTuple):
    """The planned motion that is asked for, and what it keeps to."""

    profile: str  # one of ``PROFILES``, ``constrained``, ``joint`` or ``auto``
    delta: float  # share of the translation at which visibility changes that is kept to
    samples: int  # points of the path that are stored
    duration_s: float | None  # time the motion is given; None for as little as it takes
    ramp_s: float  # time in which a motion comes up to its pace, and to rest again
    border_px: float  # least distance of a marker from an image border
    least_condition: float  # least reciprocal condition of the face's image Jacobian
    least_face_px: float  # least width of the face in an image
    joint_margin: float  # least distance from a limit, revolute joints, rad
    joint_margin_m: float  # and prismatic ones
    goals: int  # joints that show the goal which a search tries
    search_samples: int  # joint vectors that two trees grow towards, at most
    search_seed: int
    keep_out: tuple[KeptOut, ...]

    @property
    def rehearses(self) -> bool:
        """Whether half turns are rehearsed; where shares are searched for both senses are compared."""
        return self.profile not in ("constrained", "auto")

    @property
    def needs_covariance(self) -> bool:
        """Whether a plan takes the covariance of the calibration: searches through joint space, regions."""
        return self.profile in ("joint", "auto") or bool(self.keep_out)


def profile_shares(profile: str, sigma: FloatArray, pure_translation: float = 1.0) -> FloatArray:
    """Shares μ_t, μ_r, μ_p of the parts along the path, [RH00] eq. (18) and section 4.3.

    The exponential profile (1 − exp(−kσ)) / (1 − exp(−k)), k = 5, is the paper's 1 − exp(−σ/t_*)
    stretched to reach 1. In the profiles with a part first, that part is done in the first half of
    the path and the others stay flat until then; a translation first goes no farther than visibility
    lets the unturned face go, and does the rest while the face turns.

    profile : one of ``PROFILES``.
    sigma : (k,) path parameter in [0, 1].
    pure_translation : most share of the translation before any rotation, δ τ_0 / τ.
    Returns (k, 3) shares, each monotone from 0 to 1. Raises ValueError if the profile is unknown.
    """
    if profile not in PROFILES:
        raise ValueError(f"unknown profile {profile!r}: choose one of {', '.join(PROFILES)}")
    if profile == "exponential":
        share = np.expm1(-5.0 * sigma) / np.expm1(-5.0)
        return np.stack([share, share, share], axis=1)
    early = np.minimum(sigma / _PLATEAU, 1.0)
    late = np.maximum((sigma - _PLATEAU) / (1.0 - _PLATEAU), 0.0)
    share = min(1.0, pure_translation)
    t, r, p = {
        "linear": (sigma, sigma, sigma),
        "rotation_first": (late, early, sigma),
        "translation_first": (share * early + (1.0 - share) * late, late, sigma),
        "planar_first": (late, late, early),
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
    found = [displaced(H_hat, sizes, *shares) for shares in mu.reshape(-1, 3).tolist()]
    return np.array(found).reshape(*mu.shape[:-1], 4, 4)


class Reference(NamedTuple):
    """A planned motion at k instants, one control period apart but for the last, where it arrives."""

    H_hat: FloatArray  # (3, 4, 4) operators t, r, p of the plan
    amplitudes: FloatArray  # (3,) τ in the unit of Ĥ_t, θ_r and θ_p in rad
    mu: FloatArray  # (k, 3) shares that are done; none of a way through joint space
    q: FloatArray  # (k, n) joints, rad or m; k is 0 where nothing is followed, else at least 2
    # (k, m, 4) points of the face, a_inf·A = 1, before the displacement that is planned until then
    A: FloatArray
    s: FloatArray  # (k, 2, m, 2) its pixels as projective cameras see them
    # (k, 2, m, 2) their motion in the next period to first order, velocity times time, px
    s_ahead: FloatArray
    # periods of the plan that a period of the loop is worth: less than 1 where commands are scaled
    rate: float
    # (n,) how far images may take the joints from a way through joint space, rad or m; none for shares
    room: FloatArray


# Every step plans anew.
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
def through_joints(reference: Reference) -> bool:
    """Whether what is followed is a way through joint space."""
    return bool(reference.room.shape[0] > 0)


@merged
def _place(reference: Reference, clock: float) -> tuple[int, float]:
    """Row before a time in periods, and how far on towards the next; the plan stays where it arrived."""
    last = reference.q.shape[0] - 1
    i = min(int(clock), last - 1)
    return i, min(clock, float(last)) - i


@merged
def _between(column: FloatArray, i: int, x: float) -> float:
    """Value between two rows; the rows themselves to the bit."""
    return (1.0 - x) * float(column[i]) + x * float(column[i + 1])


@internal
def planned(model: Model, reference: Reference, clock: float) -> Mat4:
    """Displacement from the start that is planned until a time in periods, [RH00] eqs. (17), (18).

    Of a way through joint space it is that of the joints, eq. (6).
    """
    i, x = _place(reference, clock)
    if through_joints(reference):
        return mul(forward_between(model, reference.q, i, x), backward(model, reference.q[0]))
    mu_t = _between(reference.mu[:, 0], i, x)
    mu_r = _between(reference.mu[:, 1], i, x)
    mu_p = _between(reference.mu[:, 2], i, x)
    return displaced(reference.H_hat, reference.amplitudes, mu_t, mu_r, mu_p)


@merged
def under_way(reference: Reference, clock: float) -> bool:
    """Whether a way through joint space has not arrived yet."""
    return through_joints(reference) and clock < reference.q.shape[0] - 1


@merged
def near_way(reference: Reference, clock: float, l: int, wanted: float) -> float:
    """Where joint l may be at a time in periods: as wanted, but near the way."""
    i, x = _place(reference, clock)
    there, room = _between(reference.q[:, l], i, x), float(reference.room[l])
    return min(max(wanted, there - room), there + room)


@merged
def put_aim(
    model: Model,
    reference: Reference,
    clock: float,
    lead: float,
    A: FloatArray,
    s: FloatArray,
    q_ahead: FloatArray,
) -> None:
    """Write where the face should be now, where its images should go, and how the joints lead there.

    For the image-based law, whose command is −λ J⁺ (s − s_aim), the planned velocity ṡ is fed forward by
    aiming ahead: s_aim = s + ṡ/λ.

    clock : time in periods.
    lead : 1/λ in periods.
    A : (m, 4) on return the face; s : (2, m, 2) straight pixels to aim at; q_ahead : (n,) joint motion in
        the next period, rad or m.
    """
    i, x = _place(reference, clock)
    j, y = _place(reference, clock + 1.0)
    H = planned(model, reference, clock)
    for k in range(A.shape[0]):
        for c in range(4):
            A[k, c] = _between(reference.A[:, k, c], i, x)
        put_vec(A[k], apply(H, vec(A[k])))
        for view in range(2):
            for c in range(2):
                here = _between(reference.s[:, view, k, c], i, x)
                s[view, k, c] = here + lead * _between(reference.s_ahead[:, view, k, c], i, x)
    for l in range(q_ahead.shape[0]):
        q_ahead[l] = _between(reference.q[:, l], j, y) - _between(reference.q[:, l], i, x)


@merged
def planned_step(model: Model, reference: Reference, clock: float, share: float) -> Mat4:
    """Displacement that a plan of shares makes from a time on in a share of a period."""
    mu = reference.mu
    i, x = _place(reference, clock)
    H_r, H_p = mat(reference.H_hat[1]), mat(reference.H_hat[2])
    theta_r = _between(mu[:, 1], i, x) * float(reference.amplitudes[1])
    theta_p = _between(mu[:, 2], i, x) * float(reference.amplitudes[2])
    tau = _between(mu[:, 0], i, x) * float(reference.amplitudes[0])
    turned_back = mul(rotation(H_p, -theta_p), rotation(H_r, -theta_r))
    return mul(
        planned(model, reference, clock + share), mul(turned_back, translation(mat(reference.H_hat[0]), -tau))
    )
