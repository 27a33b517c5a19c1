"""Measuring with the body: the fit against finite differences, exact images and its own bound."""

import math

import numpy as np
import pytest
from scipy.linalg import expm

from projservo_cli.geometry.algebra import as_array, mat
from projservo_cli.geometry.null_space import COORDINATES
from projservo_cli.task.body_pose import ALL_VIEWS, SETTLED, fit_body, make_body
from tests.samples import arm, displacement, frame, in_frame, pixels, poe, revolute

FRAMES = [None, 1, 2]
SIGMA = 0.5


def markers(seed=0, m=10):
    """Markers of a body of 0.2 m before the rig, the first four on a face."""
    rng = np.random.default_rng(seed)
    flat = np.array([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]]) * 0.05
    offsets = np.concatenate([flat, rng.uniform(-0.1, 0.1, (m - 4, 3))])
    return np.c_[offsets, np.ones(m)] @ displacement([0.3, -0.2, 0.4], [0.02, -0.03, 1.4]).T


def seen_from(seed):
    """Model, markers and the map from metric points, in the metric frame or a projective one."""
    model, M = arm(), markers()
    if seed is None:
        return model, M, np.eye(4)
    G = frame(seed)
    scaled = M @ G.T
    model = in_frame(model, G)
    return model, scaled / (scaled @ model.a_inf)[:, None], G


def twist_of(body, xi):
    """Element of the algebra with coordinates ξ."""
    return np.outer(xi[:3] @ body.D, body.a_inf) + np.einsum("r,rij->ij", xi[3:], body.H_hat)


def fitted(model, body, s, H, until=ALL_VIEWS):
    return fit_body(model.P, body, np.ascontiguousarray(s), mat(H), until, np.zeros((6, 7)))


@pytest.mark.parametrize("seed", FRAMES)
def test_the_basis_is_one_of_rigid_displacements(seed):
    model, M, G = seen_from(seed)
    body = make_body(model, M)
    forms = -0.5 * np.einsum("iab,jba->ij", body.H_hat, body.H_hat)
    assert forms == pytest.approx(np.eye(3), abs=1e-10)
    for k, operator in enumerate(body.H_hat):
        assert expm(2 * math.pi * operator) == pytest.approx(np.eye(4), abs=1e-9)
        assert body.a_inf @ operator == pytest.approx(np.zeros(4), abs=1e-10)
        assert operator @ body.M.mean(axis=0) == pytest.approx(np.zeros(4), abs=1e-10)
        assert body.turn[:, k] @ body.D == pytest.approx(body.M @ operator.T, abs=1e-10)
        rotation = np.linalg.solve(G, expm(0.7 * operator) @ G)[:3, :3]
        assert rotation @ rotation.T == pytest.approx(np.eye(3), abs=1e-9)
        assert math.acos((np.trace(rotation) - 1) / 2) == pytest.approx(0.7, abs=1e-8)
    assert body.D @ model.a_inf == pytest.approx(np.zeros(3), abs=1e-12)


def test_a_robot_that_turns_about_one_direction_has_a_body_all_the_same():
    """What it cannot do may be counted in any metric; what it can is counted as it is."""
    parallel = np.array([revolute([0.1 * i, 0.2, 0.0], [0.0, 0.0, 1.0]) for i in range(6)])
    body = make_body(arm()._replace(H_hat_0=parallel), markers())
    L = body.H_hat[:, :3, :3].reshape(3, 9)
    wanted = parallel[0, :3, :3].ravel()
    assert np.linalg.lstsq(L.T, wanted, rcond=None)[0] @ L == pytest.approx(wanted, abs=1e-12)
    assert np.linalg.matrix_rank(np.r_[L, [wanted]]) == 3


@pytest.mark.parametrize("seed", FRAMES)
def test_a_step_is_that_of_finite_differences(seed):
    """The weighted least-squares solution of the images' Jacobian, over the views that were seen."""
    model, M, _ = seen_from(seed)
    weight = np.random.default_rng(2).uniform(0.1, 3.0, (2, len(M)))
    body = make_body(model, M)._replace(weight=weight)
    H = poe(model, model.q_reference + 0.1)
    s = pixels(model.P, M @ poe(model, model.q_reference + 0.12).T)
    s[0, 3] = s[1, 7] = math.nan

    def residual(xi):
        e = s - pixels(model.P, M @ (H @ expm(twist_of(body, xi))).T)
        return (weight[..., None] * e)[np.isfinite(s)]

    step = 1e-5
    J = np.stack([(residual(-step * x) - residual(step * x)) / (2 * step) for x in np.eye(6)], axis=1)
    e = residual(np.zeros(6))
    xi, left, _, _ = np.linalg.lstsq(J, e)
    fit = fitted(model, body, s, H, ALL_VIEWS._replace(max_steps=1))
    assert fit.views == 18
    assert fit.before == pytest.approx(e @ e, rel=1e-12)
    assert fit.after == pytest.approx(left[0], rel=1e-6)
    # Central differences of 1e-5 rad: 1e-10 of the third derivative, round-off 1e-13 px over 1e-5.
    assert as_array(fit.H) == pytest.approx(H @ expm(twist_of(body, xi)), abs=1e-8)


@pytest.mark.parametrize("seed", FRAMES)
def test_exact_images_give_the_exact_displacement(seed, rng):
    """From 3° and centimetres off: two steps to a ten-millionth, a few more to round-off."""
    model, M, _ = seen_from(seed)
    body = make_body(model, M)
    q = model.q_reference + rng.uniform(-0.3, 0.3, 6)
    H, away = poe(model, q), poe(model, q + 0.02 * rng.normal(size=6))
    s = pixels(model.P, M @ H.T)
    two, whole = fitted(model, body, s, away), fitted(model, body, s, away, SETTLED)
    assert two.found
    assert two.views == 20
    assert as_array(two.H) == pytest.approx(H, abs=1e-5)
    assert as_array(whole.H) == pytest.approx(H, abs=1e-11)
    assert two.before == pytest.approx(np.sum((s - pixels(model.P, M @ away.T)) ** 2), rel=1e-10)
    assert whole.after < 1e-15 * two.before


SUBSETS = {
    "left only": np.s_[1, :],
    "three in one view": (np.s_[1, :], np.s_[0, 3:]),
    "two and two others": (np.s_[0, 2:], np.s_[1, :2], np.s_[1, 4:]),
    "two and one seen by one camera": (np.s_[:, 3:], np.s_[1, 2]),
}


@pytest.mark.parametrize("hidden", SUBSETS.values(), ids=SUBSETS)
def test_any_sufficient_markers_do(hidden, rng):
    model, M, _ = seen_from(1)
    body = make_body(model, M)
    H = poe(model, model.q_reference + 0.2)
    s = pixels(model.P, M @ H.T)
    for where in hidden if isinstance(hidden[0], tuple) else [hidden]:
        s[where] = math.nan
    away = poe(model, model.q_reference + 0.2 + 0.003 * rng.normal(size=6))
    fit = fitted(model, body, s, away, SETTLED)
    assert fit.found
    assert fit.views == np.isfinite(s[..., 0]).sum()
    assert as_array(fit.H) == pytest.approx(H, abs=1e-8)


def test_too_few_markers_are_told():
    model, M, _ = seen_from(1)
    M = M.copy()
    M[2] = 0.5 * (M[0] + M[1])
    body = make_body(model, M)
    s = pixels(model.P, M)
    for seen in ([], [0], [0, 5], [0, 1, 2]):  # the last on one line
        some = np.full_like(s, math.nan)
        some[:, seen] = s[:, seen]
        fit = fitted(model, body, some, np.eye(4))
        assert not fit.found
        assert fit.views == 2 * len(seen)
        assert as_array(fit.H) == pytest.approx(np.eye(4), abs=0)


def test_the_fit_does_not_depend_on_the_frame(rng):
    noise = SIGMA * rng.normal(size=(2, 10, 2))
    found = []
    for seed in FRAMES:
        model, M, G = seen_from(seed)
        s = pixels(model.P, M @ poe(model, model.q_reference + 0.1).T) + noise
        fit = fitted(model, make_body(model, M), s, poe(model, model.q_reference + 0.1), SETTLED)
        found.append((np.linalg.solve(G, as_array(fit.H) @ G), fit.after))
    for moved, after in found[1:]:
        assert moved == pytest.approx(found[0][0], abs=1e-9)
        assert after == pytest.approx(found[0][1], rel=1e-8)


def draws(count, rng, prediction):
    """Errors (count, 6) of one-shot fits, their Fisher information by finite differences, and the fits."""
    model, M, _ = seen_from(None)
    body = make_body(model, M)
    q = model.q_reference + 0.1
    H = poe(model, q)
    clean = pixels(model.P, M @ H.T)
    step = 1e-5
    images = [
        pixels(model.P, M @ (H @ expm(twist_of(body, sign * step * x))).T).ravel()
        for x in np.eye(6)
        for sign in (1, -1)
    ]
    J = (np.array(images[::2]) - np.array(images[1::2])).T / (2 * step)
    errors, after = np.empty((count, 6)), np.empty(count)
    back = np.linalg.inv(H)
    for i in range(count):
        guess = poe(model, q + prediction * rng.normal(size=6))
        fit = fitted(model, body, clean + SIGMA * rng.normal(size=clean.shape), guess)
        X = back @ as_array(fit.H) - np.eye(4)  # the logarithm but for its square, 1e-6
        errors[i, :3] = body.D[:, :3] @ (X @ body.M.mean(axis=0))[:3]
        errors[i, 3:] = -0.5 * np.einsum("rab,ba->r", body.H_hat[:, :3, :3], X[:3, :3])
        after[i] = fit.after
    return errors, J.T @ J / SIGMA**2, after


@pytest.mark.volume
def test_the_fit_reaches_the_bound_and_its_residual_has_the_right_size():
    """Three thousand draws, predicted 0.6° off; the relative error of an rms is a fiftieth."""
    errors, F, after = draws(3_000, np.random.default_rng(5), 0.01)
    # Rms over the bound: of all six coordinates, the translations, the rotations.
    bound, mean = np.diag(np.linalg.inv(F)), np.mean(errors**2, axis=0)
    assert np.mean(np.einsum("ni,ij,nj->n", errors, F, errors)) / 6 <= 1.06**2
    assert mean[:3].sum() / bound[:3].sum() <= 1.06**2
    assert mean[3:].sum() / bound[3:].sum() <= 1.06**2
    assert np.abs(errors.mean(axis=0) * np.sqrt(np.diag(F))).max() < 0.1  # hardly a bias
    dof = 40 - COORDINATES
    assert np.mean(after) / SIGMA**2 == pytest.approx(dof, rel=4 * math.sqrt(2 / dof / 3_000))
