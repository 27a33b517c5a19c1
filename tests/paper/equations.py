"""Equations (1) to (25) of [RH00] with their errata, after the paper alone: NumPy and SciPy, nothing of ours.

Points and planes are (..., 4), operators and displacements (4, 4), each as the paper names it.
"""

import numpy as np
from scipy.linalg import expm, null_space
from scipy.optimize import brentq


def dual(*vectors):
    """What is incident with all vectors, as rows: (3)."""
    return null_space(np.array(vectors)).T


def images(P, M):
    """Pixels (V, ..., 2) of points (..., 4): (1)."""
    m = np.einsum("vij,...j->v...i", P, M)
    return m[..., :2] / m[..., 2:]


def reconstructed(P, s):
    """Point of two pixels (2, 2), up to scale: the null vector of (1) without ζ and ζ′."""
    return dual(*(s[:, :, None] * P[:, None, 2] - P[:, :2]).reshape(4, 4))[0]


def displacement(H):
    """H scaled to det H = 1, (2); its sign is left open."""
    return H / np.linalg.det(H) ** 0.25


def exponential(H_hat, prismatic, q):
    """From algebra to group: (4), (5)."""
    if prismatic:
        return np.eye(4) + q * H_hat
    return np.eye(4) + np.sin(q) * H_hat + (1 - np.cos(q)) * H_hat @ H_hat


def logarithm(H, prismatic, q):
    """From group to algebra: (4), (5)."""
    return (H - np.linalg.inv(H)) / (2 * (q if prismatic else np.sin(q)))


def truncated(H_hat, prismatic, q):
    """Truncated products H̄_1 … H̄_n: (6)."""
    products = [np.eye(4)]
    for one, kind, amount in zip(H_hat, prismatic, q, strict=True):
        products.append(products[-1] @ exponential(one, kind, amount))
    return np.array(products[1:])


def moved_operators(H_hat, prismatic, q):
    """Operators at q: (19) with H̄_i."""
    return np.array([H @ one @ np.linalg.inv(H) for H, one in
                     zip(truncated(H_hat, prismatic, q), H_hat, strict=True)])  # fmt: skip


def image_jacobian(P, M, H_hat):
    """Velocity (V, 2, n) of the pixels of one point by the joints: (7) with its second row mended."""
    rows = []
    for camera in P:
        m = camera @ M
        J_G = np.array([[1 / m[2], 0, -m[0] / m[2] ** 2], [0, 1 / m[2], -m[1] / m[2] ** 2]])
        rows.append(J_G @ camera @ (H_hat @ M).T)
    return np.array(rows)


def mechanism(H_hat, planes=(), points=(), turns=True):
    """Joint motion that keeps planes and points, and its operator: (8), (9), (10); of a turn in rad."""
    columns = [np.concatenate([*(-H.T @ a for a in planes), *(H @ A for A in points)]) for H in H_hat]
    q_hat = np.linalg.svd(np.array(columns).T)[2][-1]
    H = np.tensordot(q_hat, H_hat, 1)
    nu = np.abs(np.linalg.eigvals(H).imag).max() if turns else 1.0
    return q_hat / nu, H / nu


def coefficients(a, H_hat, A):
    """p_0, p_s, p_c of aᵀ H(θ) A = p_0 + p_s sin θ + p_c cos θ: (13), (14)."""
    square = a @ H_hat @ H_hat @ A
    return a @ A + square, a @ H_hat @ A, -square


def solutions(p_0, p_s, p_c):
    """Both θ by half-angle substitution, t = tan(θ/2), and the quadratic equation: (15)."""
    root = np.sqrt(p_s**2 - (p_0 - p_c) * (p_0 + p_c))
    larger = -(p_s + np.copysign(root, p_s))
    halves = np.arctan([larger / (p_0 - p_c), (p_0 + p_c) / larger])
    return tuple(2 * halves)


def plane_through(*points):
    """Plane of three points, whose sign any displacement carries along."""
    return np.array([np.linalg.det([e, *points]) for e in np.eye(4)])


def partition(H_hat, A, A_star):
    """Parts of a task: joint motions and operators (q̂, Ĥ) times amplitudes t, r, p, A_t and A_r: (8) to (16).

    Angles are in (−π, π]; the centre is the mean of the markers.
    """
    A_c, A_cs = A.mean(axis=0), A_star.mean(axis=0)
    a, a_star = plane_through(*A[:3]), plane_through(*A_star[:3])
    q_t, H_t = mechanism(H_hat, planes=dual(A_c, A_cs), turns=False)
    a_cs = A_c * (A_cs @ A_cs) - A_cs * (A_c @ A_cs)  # through A_c*, not through A_c
    tau = -(a_cs @ A_c) / (a_cs @ H_t @ A_c)
    A_t, a_t = A_star @ (np.eye(4) - tau * H_t).T, (np.eye(4) + tau * H_t).T @ a_star
    q_r, H_r = mechanism(H_hat, points=dual(a, a_t))
    A_d = max(A, key=lambda point: np.linalg.norm(H_r @ point))
    theta_r = max(
        solutions(*coefficients(a_t, H_r, A_d)),
        key=lambda theta: np.linalg.inv(exponential(H_r, False, theta)).T @ a @ a_t,
    )
    A_r = A_t @ exponential(H_r, False, -theta_r).T
    q_p, H_p = mechanism(H_hat, planes=[a], points=[A_c])
    e = np.argmax([np.linalg.norm(H_p @ point) for point in A])
    a_i = plane_through(A_r[e], *np.linalg.svd(H_p)[2][2:])  # and two points on the axis
    theta_p = min(
        solutions(*coefficients(a_i, H_p, A[e])),
        key=lambda theta: np.linalg.norm(exponential(H_p, False, theta) @ A[e] - A_r[e]),
    )
    amplitudes = np.array([tau, theta_r, theta_p])
    q_hat, operators = np.array([q_t, q_r, q_p]), np.array([H_t, H_r, H_p])
    return amplitudes, q_hat, operators, A_t, A_r


def planned(H_hat, amplitudes):
    """Displacement along the trajectory: (17)."""
    return expm(amplitudes[0] * H_hat[0]) @ expm(amplitudes[1] * H_hat[1]) @ expm(amplitudes[2] * H_hat[2])


def exponential_profile(sigma, t_star=0.2):
    """Profile 1 − exp(−σ/t_*) of section 4.3, scaled to reach 1 at σ = 1."""
    return (1 - np.exp(-sigma / t_star)) / (1 - np.exp(-1 / t_star))


def one_rotation(H_r, H_p, theta_r, theta_p):
    """θ_s and Ĥ_s of both rotations, and a, b, c: (24), (25) with c without the factor 2."""
    a = np.sin(theta_r / 2) * np.cos(theta_p / 2)
    b = np.cos(theta_r / 2) * np.sin(theta_p / 2)
    c = np.sin(theta_p / 2) * np.sin(theta_r / 2)
    sine = np.sqrt(a**2 + b**2 + c**2)
    theta_s = 2 * np.arctan2(sine, np.cos(theta_r / 2) * np.cos(theta_p / 2))
    return theta_s, (a * H_r + b * H_p + c * (H_r @ H_p - H_p @ H_r)) / sine, (a, b, c)


def margin(a, H, O):
    """Side of the optical centre of a plane that H displaces, section 4.2."""
    return np.linalg.inv(H).T @ a @ O


def change_of_translation(a, H_t, O, upper):
    """τ_0 in (0, upper) at which a translated plane changes visibility, by bisection; None for none."""
    return _zero(lambda tau: margin(a, np.eye(4) + tau * H_t, O), upper)


def change_of_rotation(a, H_r, O, upper):
    """θ_0 between 0 and upper, |upper| < π, at which a plane turned about its own line changes visibility."""
    return _zero(lambda theta: margin(a, exponential(H_r, False, theta), O), upper)


def _zero(f, upper):
    return brentq(f, 0.0, upper, xtol=1e-15) if f(0.0) * f(upper) < 0 else None
