"""Forward kinematics, operators and Jacobian against matrix exponentials and finite differences."""

import numpy as np
import pytest

from projservo_cli.geometry.kinematics import forward_kinematics, image_jacobian, joint_operators, project
from projservo_cli.records import Model, no_lenses, prismatic_of
from tests.samples import arm, face, frame, hat, in_frame, operators, pixels, poe

TYPES = ["RRPRRR", "PRR", "RRRRRRR", "R", "RRRPP"]


def joints(model, seed=0):
    return np.random.default_rng(seed).uniform(-1.5, 1.5, len(model.q_reference))


@pytest.fixture(params=TYPES)
def model(request):
    """An arm in a projective frame."""
    return in_frame(arm(request.param), frame(1))


def test_forward_kinematics_is_the_product_of_exponentials(model):
    q = joints(model)
    assert forward_kinematics(model, q) == pytest.approx(poe(model, q), abs=1e-12)
    assert forward_kinematics(model, model.q_reference) == pytest.approx(np.eye(4), abs=0)


def test_operators_are_conjugated_by_the_joints_before(model):
    """Equation (19) with the truncated product; the printed Ĥ⁰ in its place would fail here."""
    q = joints(model, 3)
    assert joint_operators(model, q) == pytest.approx(operators(model, q), abs=1e-12)
    assert joint_operators(model, model.q_reference) == pytest.approx(model.H_hat_0, abs=0)


def test_operators_are_the_derivatives_of_the_forward_kinematics(model):
    """Central differences of step 1e-5: error of 1e-10, ∂H/∂q_i = Ĥ_i H."""
    q = joints(model, 4)
    H_hat = joint_operators(model, q)
    for i in range(len(q)):
        step = 1e-5 * np.eye(len(q))[i]
        difference = (forward_kinematics(model, q + step) - forward_kinematics(model, q - step)) / 2e-5
        assert difference == pytest.approx(H_hat[i] @ forward_kinematics(model, q), abs=2e-9)


def test_image_jacobian_is_the_derivative_of_the_pixels():
    """Central differences of step 1e-5 on pixels of 1e3: error of 1e-6 px per rad."""
    G = frame(5)
    model = in_frame(arm("RRPRRR"), G)
    M_0 = face() @ G.T
    q = model.q_reference + 0.1 * joints(model, 6)

    def images(q):
        return pixels(model.P, M_0 @ poe(model, q).T)

    M = M_0 @ poe(model, q).T
    J = image_jacobian(model.P, M, joint_operators(model, q))
    assert J.shape == (2, 4, 2, 6)
    for i in range(6):
        step = 1e-5 * np.eye(6)[i]
        difference = (images(q + step) - images(q - step)) / 2e-5
        assert J[..., i] == pytest.approx(difference, abs=1e-5)
    assert np.abs(J).max() > 100.0  # px per rad or m: the comparison is not one of zeros


def test_pixels_of_points():
    P, M = arm().P, face()
    assert project(P, M) == pytest.approx(pixels(P, M), abs=1e-12)
    assert project(P, 7.0 * M) == pytest.approx(pixels(P, M), abs=1e-9)
    assert project(P, np.stack([M, M])).shape == (2, 2, 4, 2)


@pytest.mark.parametrize("name", ["ur5", "stanford"])
def test_true_kinematics_reproduce_the_reference_pixels(reference_truth, shared_data, name):
    """200 poses of another software's robot and cameras, to the 1e-6 px its table is written with."""
    truth = reference_truth(name)
    model = Model(
        np.array([truth["camera_left"], truth["camera_right"]]),
        np.array([hat(screw["w"], screw["v"]) for screw in truth["screws"]]),
        prismatic_of(truth["joint_types"]),
        np.array(truth["q_reference"]),
        np.array([0, 0, 0, 1.0]),
        no_lenses(2),
    )
    body = np.c_[truth["markers_tool"], np.ones(len(truth["markers_tool"]))]
    M_0 = body @ np.array(truth["T_base_tool_at_reference"]).T
    table = np.genfromtxt(shared_data / name / "validation.csv", delimiter=",", names=True)
    q = np.stack([table[f"q{i + 1}"] for i in range(len(truth["joint_types"]))], axis=1)
    seen = np.stack([table[f"{axis}_{view}"] for view in ("left", "right") for axis in "uv"], axis=1)
    poses, first, which = np.unique(table["pose"], return_index=True, return_inverse=True)
    assert len(poses) == 200
    s = np.array([project(model.P, M_0 @ forward_kinematics(model, q[k]).T) for k in first])
    off = s[which, :, table["marker"].astype(int)] - seen.reshape(-1, 2, 2)
    assert np.abs(off).max() < 2e-6
