"""Direct control: each error at its own rate, one rotation for two, and the limit of the translation."""

import inspect
import math

import numpy as np
import pytest
from scipy.linalg import expm

from projservo_cli.control import FUNCTIONS
from projservo_cli.control.law import TAU_AFFINE, THETA_P, THETA_R, THETA_S
from projservo_cli.laws import CODES, LAWS
from tests.samples import pixels, poe, revolute
from tests.scene import GAINS, STEP, Run, limits, scene

# Fine steps: a hundredth of the error at most, so that the sampled law follows the continuous one.
FINE = GAINS._replace(period=0.004)


def rates(run, column):
    """Decay rate of one error in 1/s over the run, from the first and the last instant."""
    errors = run.log.errors[:, column]
    return -math.log(abs(errors[-1] / errors[0])) / (run.steps * FINE.period)


@pytest.mark.parametrize("types", ["RRRRRR", "RRPRRR"])
def test_each_error_decays_at_its_own_rate(types):
    """Gains 2.5, 1 and 0.5 per second: the factor of a step is 1 − gain·period, to second order."""
    gains = FINE._replace(gain_t=2.5, gain_r=1.0, gain_p=0.5)
    run = Run(scene(types=types), "direct_three", gains, limits(max_steps=100))
    for column, gain in ((TAU_AFFINE, 2.5), (THETA_R, 1.0), (THETA_P, 0.5)):
        assert rates(run, column) == pytest.approx(gain, rel=0.02)


def test_one_rotation_decays_at_the_rate_of_its_gain():
    run = Run(scene(), "direct_two", FINE._replace(gain_t=1.3, gain_s=0.8), limits(max_steps=100))
    assert rates(run, TAU_AFFINE) == pytest.approx(1.3, rel=0.02)
    assert rates(run, THETA_S) == pytest.approx(0.8, rel=0.02)


def test_error_of_both_rotations_is_the_true_angle():
    """θ_s, and τ in metres with the metric model, against the true poses of the face at every instant."""
    sc = scene()
    run = Run(sc, "direct_three", GAINS, limits(max_steps=40))
    goal = poe(sc.model, sc.q_goal)
    center = sc.plant.M.mean(axis=0)
    for H, errors in zip(run.log.H, run.log.errors, strict=True):
        R = goal[:3, :3] @ H[:3, :3].T
        sine = np.linalg.norm([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / 2
        assert errors[THETA_S] == pytest.approx(math.atan2(sine, (np.trace(R) - 1) / 2), abs=1e-9)
        assert errors[TAU_AFFINE] == pytest.approx(np.linalg.norm((goal - H) @ center), abs=1e-10)


@pytest.mark.parametrize(("ratio", "types"), [(1.0, "RRRRRR"), (2.0, "RRPRRR"), (0.5, "RRRRRR")])
def test_any_ratio_converges(ratio, types):
    run = Run(scene(types=types), "direct_two", GAINS._replace(ratio_rp=ratio))
    assert run.verdict == "converged"


@pytest.mark.parametrize("ratio", [2.0, 0.5])
def test_ratio_is_that_of_the_two_decays(ratio):
    """Over small rotations the errors θ_r, θ_p decay at rates of the ratio λ_r/λ_p."""
    run = Run(scene(0.1 * STEP), "direct_two", FINE._replace(ratio_rp=ratio), limits(max_steps=100))
    assert rates(run, THETA_R) / rates(run, THETA_P) == pytest.approx(ratio, rel=0.02)
    # The faster of both decays at the gain of the rotation.
    assert max(rates(run, THETA_R), rates(run, THETA_P)) == pytest.approx(GAINS.gain_s, rel=0.03)


def test_both_laws_agree_where_one_rotation_is_nothing():
    """A task whose rotation lies in the plane of the face: there is nothing to compose."""
    sc = scene()
    three, two = (Run(sc, law, FINE, limits(max_steps=1)).log for law in ("direct_three", "direct_two"))
    assert np.abs(three.q_dot[0] - two.q_dot[0]).max() > 1e-3
    flat = sc.plant.M @ poe(sc.model, sc.q_start).T
    center = flat[:, :3].mean(axis=0)
    normal = np.cross(flat[1, :3] - flat[0, :3], flat[2, :3] - flat[0, :3])
    goal = flat @ expm(0.6 * revolute(center, normal)).T
    turned = sc._replace(s_star=pixels(sc.model.P, goal))
    three, two = (Run(turned, law, FINE, limits(max_steps=1)).log for law in ("direct_three", "direct_two"))
    assert three.q_dot[0] == pytest.approx(two.q_dot[0], abs=1e-8)


@pytest.mark.parametrize("center", [0, 3])
def test_a_marker_as_center(center):
    """The marker chosen heads straight for its goal; the midpoint does not."""
    sc = scene(center=center)
    run = Run(sc, "direct_three", FINE._replace(gain_r=7.0, gain_p=7.0), limits(max_steps=300))
    start, goal = run.center[0], (poe(sc.model, sc.q_goal) @ sc.plant.M[center])[:3]
    way = (goal - start) / np.linalg.norm(goal - start)

    def deviation(points):
        off = points - points[0]
        return np.linalg.norm(off - np.outer(off @ way, way), axis=1).max()

    assert deviation(run.center) < 2e-3
    assert deviation((run.log.H @ sc.plant.M.mean(axis=0))[:, :3]) > 5e-3


def test_laws_are_given_images_joints_and_a_model_and_nothing_else():
    for function in FUNCTIONS:
        parameters = inspect.signature(getattr(function, "py_func", function)).parameters
        assert [name.strip("_") for name in parameters] == [
            "code",
            "model",
            "task",
            "gains",
            "s",
            "q",
            "state",
        ]
    assert len(FUNCTIONS) == len(LAWS)
    assert [*CODES.items()] == [(law, code) for code, law in enumerate(LAWS)]
