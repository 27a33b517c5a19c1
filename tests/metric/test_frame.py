"""The metric of a calibration: closed forms, invariants, true arms, and arms that have no metric."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.stats import chi2

import projservo_cli as projservo
from projservo_cli.config.settings_and_rules import truth_of
from projservo_cli.metric.frame import Metric
from projservo_cli.records import Calibration, InputError, WorkFailed, changed, composed, flat_fields
from projservo_cli.results import ImageModel
from tests.calibration.simulated_robot import Robot, rig
from tests.known import configured
from tests.samples import prismatic, revolute

POINTS = np.array([[0.1, 0, 0, 1], [0, 0.12, 0, 1], [0, 0, 0.08, 1], [-0.05, 0.02, 0.03, 1]])
X, Y, Z = np.eye(3)


def robot(twists, types, q=0.0, cameras=None):
    return Robot(
        types, np.array(twists), rig() if cameras is None else cameras, POINTS, np.full(len(types), q)
    )


def calibrated(arm, frame):
    """A calibration without errors in a projective frame."""
    back, n = np.linalg.inv(frame), len(arm.joint_types)
    a_inf = np.array([0.0, 0.0, 0.0, 1.0]) @ back
    M = arm.markers @ frame.T
    fields = {field.name: None for field in flat_fields(Calibration)}
    fields |= {
        "method": "bundle_adjustment",
        "joint_types": arm.joint_types,
        "P": arm.cameras @ back,
        "H_hat_0": frame @ arm.twists @ back,
        "q_reference": arm.q_reference,
        "a_inf": a_inf,
        "marker": 10 * np.arange(len(M)),
        "M": M / (M @ a_inf)[:, None],
        "sqrt_cov_shared": np.zeros((arm.cameras.size + 16 * n, 1)),
        "sqrt_cov_marker": np.zeros((len(M), 4, 1)),
        "sqrt_cov_own": np.zeros((len(M), 4, 3)),
        "sigma_px": 0.5,
        "joint_min": np.full(n, -1.0),
        "excitation": np.full(n, 2.0),
    }
    return ImageModel.of(composed(Calibration, fields))


ELBOW = (revolute(0.1 * X, Z), revolute(0.2 * Z, Y), revolute(0.4 * Z, Y), revolute(0.5 * Z, X))


@pytest.fixture
def frame(rng):
    return np.eye(4) + 0.3 * rng.standard_normal((4, 4))


def test_closed_form_of_an_arm(frame):
    """Axes, link lengths, cameras and poses are those of the drawing, whatever the projective frame."""
    arm = robot(ELBOW, "RRRR", 0.3)
    m = calibrated(arm, frame).metric(np.linalg.norm(POINTS[0] - POINTS[1]), np.array([0, 10]))
    focal = np.array([[1200.0, 0.0, 640.0], [0.0, 1200.0, 512.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(m.K, [focal, focal], rtol=1e-8, atol=1e-7)
    np.testing.assert_allclose(np.linalg.norm(np.diff(m.poses[:, :3, 3], axis=0)), 0.3, rtol=1e-9)
    w, v = m.axes[:, :3], m.axes[:, 3:]
    np.testing.assert_allclose(w[0], Z, atol=1e-9)
    np.testing.assert_allclose(v[0], 0.0, atol=1e-9)
    np.testing.assert_allclose(w[1], w[2], atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(np.cross(w[1], v[2] - v[1])), 0.2, atol=1e-9)
    assert abs((v @ w[1])[1]) < 1e-12
    # x is the common normal of the first two axes, on which the origin lies, by the reading of zero
    np.testing.assert_allclose(w[1] @ X, 0.0, atol=1e-12)
    q = np.array([0.5, -0.2, 0.7, 0.1])
    between = m.pose(q) @ np.linalg.inv(m.pose(arm.q_reference))
    turned = [expm(H * a) for H, a in zip(arm.twists, q - 0.3, strict=True)]
    np.testing.assert_allclose(np.trace(between), np.trace(np.linalg.multi_dot(turned)), atol=1e-9)


def test_the_frame_is_right_handed(frame):
    """A reflection of the projective frame changes nothing."""
    arm = robot(ELBOW, "RRRR")
    here, there = (calibrated(arm, G).metric(0.3, "cameras") for G in (frame, frame @ np.diag([-1, 1, 1, 1])))
    np.testing.assert_allclose(here.poses, there.poses, atol=1e-9)
    assert np.linalg.det(here.poses[0, :3, :3]) == pytest.approx(1.0)


MIRROR = np.diag([-1.0, 1.0, 1.0])


@pytest.mark.parametrize(
    ("arm", "known", "said"),
    [
        (robot(ELBOW[:1], "R"), (0.3, "cameras"), "one revolute joint leaves the stretch"),
        (robot(ELBOW[1:3], "RR"), (0.3, "cameras"), "all revolute axes are parallel"),
        (robot([prismatic(e) for e in np.eye(3)], "PPP"), (), "without a revolute joint"),
        (robot(ELBOW, "RRRR", cameras=np.array([rig()[0], MIRROR @ rig()[1]])), (0.3, "cameras"), "mirrored"),
        (robot(ELBOW, "RRRR"), (0.0, "cameras"), "a length of 0.0 m with"),
        (robot(ELBOW, "RRRR"), (None, (0, 10)), r"the length between \[0, 10\] is not given: give it in m"),
        (robot(ELBOW, "RRRR"), (0.1, (0, 7)), "marker 7 is not in the calibration"),
        (robot(ELBOW, "RRRR"), (0.1, (10, 10)), "give two markers"),
        (robot(ELBOW, "RRRR"), (), "no joint is prismatic"),
        (robot(ELBOW, "RRRR"), (0.06, "tags"), "no tag has all its corners"),
        (robot((prismatic(Z), *ELBOW[1:]), "PRRR"), (0.3,), "a length of 0.3 m without its ends"),
    ],
)
def test_what_has_no_metric_says_so(arm, known, said, frame):
    # Mirrored images are no fault of the arguments.
    with pytest.raises(WorkFailed if said == "mirrored" else InputError, match=said) as error:
        calibrated(arm, frame).metric(*known)
    assert "\n" not in str(error.value)


@pytest.fixture(scope="module")
def draws():
    """Calibrations of a UR5 at 0.5 px, and its truth."""
    config = configured("ur5")
    noisy = [projservo.calibrate(projservo.simulate(config, seed=900 + k, noise_px=0.5)) for k in range(5)]
    return truth_of(config), noisy


def test_errors_are_as_large_as_their_covariance_says(draws):
    """Intrinsics of both cameras, and lengths that any frame leaves alone, against the true ones."""
    truth, noisy = draws
    u, v = np.triu_indices(3)
    A = truth.P[..., :3]
    true_K = np.array([np.linalg.inv(np.linalg.qr(np.linalg.inv(a))[1]) for a in A])
    true_K = np.abs(true_K / true_K[:, 2:, 2:]) * (np.abs(true_K) > 1e-9)
    squares = []
    for c in noisy:
        m = c.metric(1.0, "cameras")
        error = (m.K - true_K)[:, u[:5], v[:5]]
        squares.append(np.einsum("vi,vij,vj->v", error, np.linalg.inv(m.covariance("K")), error))
    total = np.sum(squares)
    low, high = chi2.ppf([5e-4, 1.0 - 5e-4], 5 * 2 * len(noisy))
    # both cameras of a draw share its errors, so the sum scatters up to twice as far
    assert 0.5 * low < total < 2.0 * high


def test_position_std_is_that_of_many_draws_of_the_errors(draws):
    """Linear propagation against whole calibrations off by random errors of their covariance."""
    c = draws[1][0]
    rng, m = np.random.default_rng(3), c.metric(0.38, "cameras")
    C = c.covariance()
    values, vectors = np.linalg.eigh(C)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    n, places = len(c.H_hat_0), []
    for _ in range(200):
        d = np.split(0.1 * root @ rng.standard_normal(len(C)), np.cumsum([24, 16 * n]))
        moved = changed(
            c,
            P=c.P + d[0].reshape(2, 3, 4),
            H_hat_0=c.H_hat_0 + d[1].reshape(n, 4, 4),
            M=c.M + d[2].reshape(-1, 4),
        )
        exact = Metric.of(moved, np.zeros((len(C), 1)), length_m=0.38, between="cameras")
        places.append(exact.pose(c.q_reference)[:3, 3])
    np.testing.assert_allclose(1e4 * np.std(places, axis=0), m.position_std(c.q_reference), rtol=0.2)
