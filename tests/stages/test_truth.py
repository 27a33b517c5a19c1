"""The simulated truth: other software's robots, start and goal, and what is refused."""

import math

import numpy as np
import pytest

from projservo_cli.records import InputError, WorkFailed
from tests.configured import plant_of, scenario_of, simulate, truth_of
from tests.known import configured as loaded
from tests.known import known_scenario
from tests.stages.cases import case


@pytest.mark.parametrize("name", ["ur5", "stanford"])
def test_configuration_is_the_reference_robot_unchanged(name, reference_truth):
    truth, reference = case(name).truth, reference_truth(name)
    assert truth.P[0].tolist() == reference["camera_left"]
    assert truth.P[1].tolist() == reference["camera_right"]
    assert truth.robot.base_tool.tolist() == reference["T_base_tool_at_reference"]
    assert truth.robot.q_reference.tolist() == reference["q_reference"]
    assert [truth.robot.limits.lower.tolist(), truth.robot.limits.upper.tolist()] == reference["q_limits"]
    for H_hat, screw in zip(truth.robot.H_hat_0, reference["screws"], strict=True):
        assert [H_hat[2, 1], H_hat[0, 2], H_hat[1, 0]] == screw["w"]
        assert H_hat[:3, 3].tolist() == screw["v"]
    body = np.linalg.solve(truth.robot.base_tool, truth.M.T).T[:, :3]
    assert body == pytest.approx(np.array(reference["markers_tool"]), abs=1e-14)
    assert truth.face == tuple(reference["face_markers"])


def test_the_reference_task(reference_truth):
    """First task of the reference robot: 180° of which 158.87° are onto the plane."""
    task = reference_truth("ur5")["tasks"][0]
    example = case("ur5")
    assert example.ends.q_start.tolist() == task["q_start"]
    assert example.plan.theta_r == pytest.approx(math.radians(task["theta_r_deg"]), abs=1e-9)
    assert example.plan.theta_s == pytest.approx(math.pi, abs=1e-9)
    goal = example.truth.robot.pose(np.array(task["q_goal"]))
    assert example.scenario.true_ends.goal_pose == pytest.approx(goal, abs=0)


@pytest.mark.parametrize("roll_deg", [180, 165])
def test_turn_about_the_roll_axis_of_the_rig(roll_deg):
    """Start and goal differ by that rotation about the axis midway between the cameras."""
    config = loaded("paper", f"task.goal.roll_deg={roll_deg}")
    truth = truth_of(config)
    shown, ends = scenario_of(config).exact, scenario_of(config).true_ends
    T = ends.goal_pose @ np.linalg.inv(truth.robot.pose(shown.q_start))
    axis = np.array([-1.0, 0, 0])  # the cameras look along −x of the base, symmetric about y = 0
    eigenvalues = np.linalg.eigvals(T[:3, :3])
    assert np.abs(np.angle(eigenvalues)).max() == pytest.approx(abs(math.radians(roll_deg)), abs=1e-9)
    assert T[:3, :3] @ axis == pytest.approx(axis, abs=1e-9)
    on_axis = np.array([0.0, 0, 0.63, 1])
    assert T @ on_axis == pytest.approx(on_axis, abs=1e-9)
    sine = axis @ [T[2, 1] - T[1, 2], T[0, 2] - T[2, 0], T[1, 0] - T[0, 1]] / 2
    assert sine == pytest.approx(math.sin(math.radians(roll_deg)), abs=1e-9)


def test_the_benchmark_is_within_its_promised_dimensions():
    """Baseline 0.2–0.5 m, 1.2–1.6 m to the face, view ≤ 60°, face ≤ 0.12 m, 5–10 markers; 180°."""
    example = case("paper")
    truth = example.truth
    centers = np.array([-np.linalg.solve(P[:, :3], P[:, 3]) for P in truth.P])
    assert 0.2 <= np.linalg.norm(centers[1] - centers[0]) <= 0.5
    face = truth.M_face @ (truth.robot.pose(example.ends.q_start) @ np.linalg.inv(truth.robot.base_tool)).T
    for center in centers:
        assert 1.2 <= np.linalg.norm(face[:, :3].mean(axis=0) - center) <= 1.6
    spread = np.linalg.norm(face[:, None, :3] - face[None, :, :3], axis=2).max()
    assert spread <= 0.12 * math.sqrt(2)
    assert 5 <= len(truth.M) <= 10
    for P, (width, _) in zip(truth.P, truth.image_size, strict=True):
        K = np.linalg.inv(np.linalg.qr(np.linalg.inv(P[:, :3]))[1])
        focal = abs(K[0, 0] / K[2, 2])
        assert 2 * math.degrees(math.atan(width / 2 / focal)) <= 60.0
    # Transversal to the image planes: the normal lies far from the viewing direction.
    M = face[:, :3]
    normal = np.cross(M[1] - M[0], M[2] - M[0])
    cosine = abs(normal[0]) / np.linalg.norm(normal)
    assert math.degrees(math.acos(cosine)) > 45.0


@pytest.mark.parametrize("scale", [-1.0, 250.0, -1e-3])
def test_a_camera_is_given_up_to_scale(scale):
    """Any multiple, of either sign, is the camera whose depths are positive metres."""
    P = case("ur5").truth.P[0]
    there = truth_of(loaded("ur5", f"rig.left={{matrix: {(scale * P).tolist()}}}")).P[0]
    assert there == pytest.approx(P, rel=1e-8)


FAR = "{translation_m: [0, 0, 5], rotation_rad: [0, 0, 0]}"
REFUSED = {
    "a goal beyond a limit": ("ur5", "task.goal.joints.joints=[0, 0, 3.5, 0, 0, 0]", r"goal: joint 3"),
    "a goal out of reach": ("paper", f"task.goal.perturbation={FAR}", "goal: the robot cannot put its tool"),
    "a start beyond a limit": (
        "paper",
        "task.start_offset={joints: [300, 0, 0, 0, 0, 0], unit: deg}",
        r"start_offset: joint 1 .* limits",
    ),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_the_robot_cannot_reach_is_refused(what):
    name, override, message = REFUSED[what]
    with pytest.raises(WorkFailed, match=rf"task\.{message}"):
        scenario_of(loaded(name, override))


@pytest.mark.parametrize("section", ["robot", "rig", "markers", "task"])
def test_missing_parts_are_named(section):
    bare = case("ur5").config.model_copy(update={section: None})
    with pytest.raises(InputError, match=f"set {section}"):
        scenario_of(bare)


def test_perturbation_displaces_the_goal_by_what_it_says():
    exact, other = (case(name).scenario.true_ends for name in ("paper", "paper_perturbed"))
    gap = np.linalg.inv(exact.goal_pose) @ other.goal_pose
    assert 5e-4 < np.linalg.norm(gap[:3, 3]) < 2e-3
    assert 5e-4 < np.linalg.norm(gap[:3, :3] - np.eye(3)) / math.sqrt(2) < 2e-3


def test_a_face_that_shows_the_cameras_different_sides_is_refused():
    """Turned all around by one joint, the face passes through poses that no task can start from."""
    example = case("ur5")
    refused, seen, truth = 0, set(), example.truth
    for turn in np.linspace(0, 2 * math.pi, 60):
        q = example.ends.q_start + turn * np.eye(6)[4]
        M = truth.M_face @ (truth.robot.pose(q) @ np.linalg.inv(truth.robot.base_tool)).T
        normal = np.cross(M[1, :3] - M[0, :3], M[2, :3] - M[0, :3])
        sides = np.sign((example.plan.optical_center[:, :3] - M[0, :3]) @ normal)
        if sides[0] != sides[1]:
            refused += 1
            with pytest.raises(WorkFailed, match="different sides"):
                plant_of(example.config, truth, q)
        else:
            seen.add(float(plant_of(example.config, truth, q).visible[0]))
    assert refused > 0
    assert seen == {-1.0, 1.0}


def test_an_offset_moves_the_start_and_leaves_the_goal():
    offset = "task.start_offset={joints: [1, -2, 3, 0, 0, 0], unit: deg}"
    plain, moved = (scenario_of(loaded("paper", *sets)) for sets in ((), (offset,)))
    step = np.degrees(moved.exact.q_start - plain.exact.q_start)
    assert np.allclose(step, [1, -2, 3, 0, 0, 0], atol=1e-12)
    assert np.array_equal(plain.true_ends.goal_pose, moved.true_ends.goal_pose)


def test_noise_is_on_start_and_goal_images_and_that_of_trials_has_a_seed_of_its_own():
    """The noise of the trials follows calibration.seed, that of the loop follows seed."""
    clean, noisy = case("ur5").ends, known_scenario(loaded("ur5", "noise.servo_px=0.5")).ends
    for a, b in ((clean.s_start, noisy.s_start), (clean.s_star, noisy.s_star)):
        assert 0.2 < np.std(b - a) < 0.9
    own, other, both = (loaded("ur5", *sets) for sets in ((), ("calibration.seed=7",), ("seed=7",)))
    noise = [simulate(config, truth_of(config)).images[0].tolist() for config in (own, other, both)]
    assert noise[1] == noise[2] != noise[0]
    assert other.seed == own.seed
