"""Curves of joints: one function everywhere, gauge freedoms refused, faults recovered."""

import dataclasses

import h5py
import numpy as np
import pytest

from projservo_cli.calibration import calibrate, joint_model, predict, prediction_variance
from projservo_cli.calibration.bundle_adjustment import LeastSquares
from projservo_cli.calibration.detections import Detections
from projservo_cli.calibration.joint_model import describe_curve, hypotheses_of
from projservo_cli.calibration.prediction import Parameters, error_factor, joint_derivative
from projservo_cli.deviations import BASIS
from projservo_cli.geometry.displacements import twists
from projservo_cli.geometry.joint_curve import backwards, slopes, true_joints
from projservo_cli.geometry.kinematics import backward, forward_between, forward_kinematics, joint_operators
from projservo_cli.metric.frame import Metric
from projservo_cli.records import NO_CURVE, InputError, JointCurve, Model, WorkFailed, no_lenses
from projservo_cli.store.run_file import Result, Run, load, save
from tests.calibration.simulated_robot import around, random_robot, trials
from tests.calibration.test_cameras_on_the_tool import Hand

SIGMA = 0.3
N = 5


def some_arm(rng, types="RRPRR"):
    """Twists (n, 4, 4), which joints slide, and a curve with every function between random joints."""
    prismatic = np.array(list(types)) == "P"
    axes = rng.normal(size=(len(types), 6))
    axes[:, :3] /= np.linalg.norm(axes[:, :3], axis=1, keepdims=True)
    axes[:, 3:] -= axes[:, :3] * (axes[:, :3] * axes[:, 3:]).sum(axis=1, keepdims=True)
    axes[prismatic, :3] = 0.0
    arm = rng.normal(size=(len(types) + 1, 5, 4))
    arm[:-1, :4] = twists(axes)
    # A weight is on the axis of its joint.
    arm[:-1, 4, 3] = 1.0
    arm[:-1, 4, :3] = np.cross(axes[:, :3], axes[:, 3:])
    joints = rng.integers(0, len(types), (3 * len(BASIS), 2))
    terms = np.column_stack([np.tile(np.arange(len(BASIS)), 3), joints, rng.normal(0.0, 0.05, len(joints))])
    return twists(axes), prismatic, JointCurve(terms, arm)


def model_of(H_hat, prismatic, curve, q_reference):
    P, a_inf = np.zeros((2, 3, 4)), np.array([0.0, 0.0, 0.0, 1.0])
    return Model(P, H_hat, prismatic, q_reference, a_inf, no_lenses(2), curve=curve)


@pytest.mark.parametrize("seed", range(2))
def test_kernels_and_vectors_are_one_function(seed):
    """Displacements, their interpolation and operators by readings agree, also by differences."""
    rng = np.random.default_rng(seed)
    H_hat, prismatic, curve = some_arm(rng)
    q_reference, q = rng.uniform(-1.0, 1.0, (2, N))
    bent, ideal = (
        model_of(H_hat, prismatic, curve, q_reference),
        model_of(H_hat, prismatic, NO_CURVE, q_reference),
    )

    def true(q):
        return true_joints(curve, prismatic, (q - q_reference)[None])[0] + q_reference

    np.testing.assert_allclose(true(q_reference), q_reference, atol=1e-15)
    there = forward_kinematics(bent, q)
    np.testing.assert_allclose(there, forward_kinematics(ideal, true(q)), atol=1e-12)
    np.testing.assert_allclose(np.reshape(backward(bent, q), (4, 4)) @ there, np.eye(4), atol=1e-12)
    rows = np.stack([q, q_reference])
    between = np.reshape(forward_between(bent, rows, 0, 0.3), (4, 4))
    np.testing.assert_allclose(between, forward_kinematics(bent, 0.7 * rows[0] + 0.3 * rows[1]), atol=1e-12)
    F = slopes(curve, prismatic, (q - q_reference)[None])[0]
    operators = joint_operators(bent, q)
    np.testing.assert_allclose(
        operators, np.einsum("ij,iab->jab", F, joint_operators(ideal, true(q))), atol=1e-9
    )
    for j, step in enumerate(1e-6 * np.eye(N)):
        change = (forward_kinematics(bent, q + step) - forward_kinematics(bent, q - step)) / 2e-6
        np.testing.assert_allclose(change, operators[j] @ there, atol=1e-7)


@pytest.mark.parametrize("seed", range(2))
def test_backwards_is_the_same_curve_of_the_reversed_chain(seed):
    rng = np.random.default_rng(seed)
    _, prismatic, curve = some_arm(rng)
    curve = curve._replace(terms=curve.terms[curve.terms[:, 0] != BASIS.index("torque")])
    x = rng.uniform(-1.0, 1.0, (4, N))
    there = true_joints(backwards(curve, N), prismatic[::-1], -x[:, ::-1])
    np.testing.assert_allclose(-there[:, ::-1], true_joints(curve, prismatic, x), atol=1e-14)


@pytest.mark.parametrize("seed", range(2))
def test_derivatives_agree_with_central_differences(seed):
    rng = np.random.default_rng(seed)
    robot = random_robot("RRPRR", rng, markers=4)
    curve = some_arm(rng)[2]
    readings = Detections.of(robot.observe(around(robot, 4, rng), 0.0, rng), robot.joint_types)
    problem = LeastSquares.of(readings, robot.q_reference, 0, len(curve.terms))
    scene = Parameters(robot.cameras, robot.twists, readings.prismatic, robot.markers, curve=curve)
    analytic = problem.dense(problem.derivative(scene), readings.seen)
    for k in range(problem.shared - len(curve.terms), problem.shared):
        step = 1e-5 * (np.arange(problem.size) == k)
        ahead, behind = (problem.residual(problem.retract(scene, sign * step)) for sign in (1.0, -1.0))
        np.testing.assert_allclose((ahead - behind).ravel() / 2e-5, analytic[:, k], atol=1e-3)
    by_joint = problem.joint_derivative(scene)
    for i, step in enumerate(1e-5 * np.eye(N)):
        ahead, behind = (
            dataclasses.replace(problem, q=problem.q + sign * step).pixels(scene)[0] for sign in (1.0, -1.0)
        )
        np.testing.assert_allclose((ahead - behind) / 2e-5, by_joint[..., i], atol=2e-3)


def bent(robot, q):
    """True joints (K, n) at readings: a gear of the third, and one that turns the fifth."""
    theta = q.copy()
    theta[:, 2] += -0.03 * (q[:, 2] - robot.q_reference[2])
    theta[:, 4] += 0.05 * (q[:, 3] - robot.q_reference[3])
    return theta


def test_an_error_twice_a_turn_is_named_fitted_and_predicted():
    """Of a joint that turns through more than half a turn; the curve halves what poses ahead err by."""
    rng = np.random.default_rng(5)
    robot = random_robot("RRRR", rng, markers=9)

    def oval(q):
        return q + np.radians(0.25) * np.sin(2.0 * (q - robot.q_reference) + 0.7) * np.eye(4)[2]

    q, ahead = (around(robot, count, rng, np.radians(100.0)) for count in (40, 60))
    seen = dataclasses.replace(robot.observe(oval(q), SIGMA, rng), q=q)
    plain, fitted = (calibrate(seen, "RRRR", source="recorded", joint_model=one) for one in (None, "auto"))
    assert ("second_harmonic", (3,)) in [(one.code, one.subject.joints) for one in plain.findings]
    terms = [BASIS[int(kind)] for kind in fitted.joint_curve[:, 0]]
    assert terms == ["sine of twice", "versine of twice"]
    np.testing.assert_array_less(np.abs(fitted.joint_curve[:, 1] - 3.0), 0.5)
    off = [np.nanmedian(np.abs(predict(one, ahead) - robot.images(oval(ahead)))) for one in (plain, fitted)]
    assert off[1] < 0.5 * off[0]


@pytest.fixture(scope="module", params=["world", "tool"])
def case(request):
    """Arm, poses to predict, its images, and calibrations without a curve, by choice, and as asked for."""
    rng = np.random.default_rng(8)
    robot = random_robot("RRRRR", rng, markers=9)
    robot = robot if request.param == "world" else Hand(**vars(robot))
    q, ahead = np.concatenate([trials(robot, frames=3), around(robot, 16, rng)]), around(robot, 60, rng)
    seen = dataclasses.replace(robot.observe(bent(robot, q), SIGMA, rng), q=q)
    asked = (None, "auto", ("scale:3", "coupling:4-5"))
    found = [
        calibrate(seen, "RRRRR", source="recorded", mount=request.param, joint_model=one) for one in asked
    ]
    return robot, ahead, robot.images(bent(robot, ahead)), found


def test_the_curve_is_found_with_its_deviation_and_predicts(case):
    _, ahead, truth, (plain, auto, asked) = case
    off = [float(np.sqrt(np.mean((predict(one, ahead) - truth) ** 2))) for one in (plain, auto, asked)]
    assert off[1] < 0.25 * off[0]
    assert off[2] < 0.25 * off[0]
    for found in (auto, asked):
        terms = {tuple(row[:3].astype(int).tolist()): row[3:5] for row in found.joint_curve}
        for key, value in (((0, 3, 3), -0.03), ((0, 5, 4), 0.05)):
            coefficient, deviation = terms[key]
            assert abs(coefficient - value) < 4.0 * deviation < 0.02
        assert (found.joint_curve[:, 5] > found.joint_curve[:, 6]).all()
        assert len(describe_curve(found)) == len(found.joint_curve)
    # What is stated is what is true, and derivatives are by readings.
    stated = float(np.sqrt(prediction_variance(asked, ahead).mean()))
    assert 0.5 < off[2] / stated < 1.6
    ends = [predict(asked, ahead[:1] + sign * 1e-6 * np.eye(N)[3]) for sign in (1.0, -1.0)]
    J = joint_derivative(asked, ahead[:1])[..., 3]
    np.testing.assert_allclose((ends[0] - ends[1]) / 2e-6, J, atol=1e-5 * np.abs(J).max())


def test_model_and_metric_follow_the_curve(case):
    """The kernels' model carries markers to the images that are predicted; poses in metres move alike."""
    robot, ahead, _, (_, _, asked) = case
    model = asked.model()
    A = asked.M @ forward_kinematics(model, ahead[0]).T
    images = A @ np.swapaxes(model.P, 1, 2)
    np.testing.assert_allclose(images[..., :2] / images[..., 2:], predict(asked, ahead[:1])[0], atol=1e-8)
    if asked.mount == "world":
        metric = Metric.of(asked, error_factor(asked), length_m=1.0, between=asked.marker[:2].tolist())
        true = dataclasses.replace(metric, curve=None)
        there = bent(robot, ahead[:3])
        # Zeros of the joints are those of the reference of the calibration, which is a pose of the recording.
        there += (asked.q_reference - bent(robot, asked.q_reference[None]))[0]
        np.testing.assert_allclose(metric.pose(ahead[:3]), true.pose(there), atol=2e-3)


def test_files_hold_the_curve_where_one_is_fitted(case, tmp_path):
    _, ahead, _, (plain, auto, _) = case
    for found in (plain, auto):
        result = Result("key", "", {}, {}, {"calibration": found})
        save(Run(tmp_path / "run.h5", "", {"calibrate": result}))
        read = load(tmp_path / "run.h5").calibration
        np.testing.assert_array_equal(predict(read, ahead), predict(found, ahead))
        with h5py.File(tmp_path / "run.h5") as file:
            names = []
            file.visit(names.append)
        assert any("joint_curve" in name for name in names) == (found is auto)


def test_sound_joints_get_no_curve_and_no_field():
    rng = np.random.default_rng(5)
    robot = random_robot("RRRR", rng, markers=8)
    seen = robot.observe(np.concatenate([trials(robot, frames=5), around(robot, 12, rng)]), SIGMA, rng)
    plain, auto = (calibrate(seen, "RRRR", source="recorded", joint_model=one) for one in (None, "auto"))
    assert auto.joint_curve is None
    assert auto.joint_curve_arm is None
    np.testing.assert_array_equal(plain.P, auto.P)


@pytest.mark.parametrize(
    ("word", "says"),
    [
        ("scale:3", "prismatic joint 3"),
        ("harmonic:3", "no turn"),
        ("coupling:2", "coupling:1-2"),
        ("scale:9", "joints are 1 to 5"),
        ("gear", "choose auto"),
    ],
)
def test_gauge_and_mistakes_are_refused_by_name(word, says):
    with pytest.raises(InputError, match=says):
        hypotheses_of([word], "RRPRR", "world")
    with pytest.raises(InputError, match="weight"):
        hypotheses_of("sag", "RRRRR", "tool")


@pytest.mark.parametrize(
    ("word", "types"), [("coupling", "R"), ("scale", "P"), ("harmonic", "PP"), ("sag", "PP")]
)
def test_a_curve_that_no_joint_can_have_is_refused(word, types):
    with pytest.raises(InputError, match=f"joint model '{word}': no joint of {types} can have it"):
        hypotheses_of([word], types, "world")


def test_a_curve_of_all_joints_of_which_no_term_is_left_is_none(monkeypatch):
    """The scale of a single prismatic joint sets that of the frame."""
    scale = hypotheses_of(["scale"], "RP", "world")
    monkeypatch.setattr(joint_model._Search, "_named", lambda search, fit: scale)
    monkeypatch.setattr(joint_model, "_gain", lambda before, after: (1.0, 1e9))
    robot = random_robot("P", np.random.default_rng(1), 7)
    seen = robot.observe(trials(robot, 6), 0.1, np.random.default_rng(2))
    found = calibrate(seen, "P", source="recorded", joint_noise=None, joint_model="auto")
    assert found.usable
    assert found.joint_curve is None


def test_what_the_data_leave_open_is_refused_by_name():
    """A cubic and a harmonic of one joint within two degrees are one curve."""
    rng = np.random.default_rng(5)
    robot = random_robot("RRRR", rng, markers=8)
    q = robot.q_reference + rng.uniform(-0.5, 0.5, (40, 4)) * [1.0, 1.0, 0.03, 1.0]
    with pytest.raises(WorkFailed, match="joint 3 may be off"):
        calibrate(robot.observe(q, SIGMA, rng), "RRRR", joint_model=("cubic:3", "harmonic:3"))
