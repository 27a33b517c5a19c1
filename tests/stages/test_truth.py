"""The simulated truth: other software's robots, start and goal, and what is refused."""

from pathlib import Path

import numpy as np
import pytest

from projservo_cli.config import load_config
from projservo_cli.records import WorkFailed
from tests.configured import joints_of, scenario_of, simulate, truth_of
from tests.configured import record as trials
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


def test_noise_is_on_start_and_goal_images_and_that_of_trials_has_a_seed_of_its_own():
    """The noise of the trials follows calibration.seed, that of the loop follows seed."""
    clean, noisy = case("ur5").ends, known_scenario(loaded("ur5", "noise.servo_px=0.5")).ends
    for a, b in ((clean.s_start, noisy.s_start), (clean.s_star, noisy.s_star)):
        assert 0.2 < np.std(b - a) < 0.9
    own, other, both = (loaded("ur5", *sets) for sets in ((), ("calibration.seed=7",), ("seed=7",)))
    noise = [simulate(config, truth_of(config)).images[0].tolist() for config in (own, other, both)]
    assert noise[1] == noise[2] != noise[0]
    assert other.seed == own.seed


UR5 = Path(__file__).parents[2] / "configs" / "ur5.yaml"


def test_poses_of_all_joints_follow_and_no_reading_comes_twice():
    config = load_config(UR5, ["disturbance.jitter_s=0.001"])
    q, truth, joints = trials.trial_motions(config), truth_of(config), joints_of(config)
    assert q.shape == (1 + 6 * 8 + 12, 6)
    np.testing.assert_array_equal(q, trials.trial_motions(config))
    assert all(len(np.unique(column)) == len(q) for column in q.T)
    tick = 2.0 * np.pi / 4096
    moved = np.abs(q - q[0]) > 2.0 * tick
    assert (moved[1:49].sum(axis=1) <= 1).all()
    assert (moved[49:].sum(axis=1) >= 5).all()
    assert np.abs(q - q[0]).max() <= np.radians(30.0) + 2.0 * tick
    assert ((q >= joints.limits.lower) & (q <= joints.limits.upper)).all()
    seen = np.isfinite(trials.simulate(config, truth).images).all(axis=(1, 3))
    assert seen.mean(axis=1).min() >= 0.5


def test_an_ideal_robot_gets_those_that_are_asked_for():
    config = load_config(UR5)
    asked = load_config(UR5, ["calibration.random_poses=5"])
    plain, more = trials.trial_motions(config), trials.trial_motions(asked)
    assert len(plain) == 49
    np.testing.assert_array_equal(more[:49], plain)
    assert (more[49:] != plain[0]).all()
    assert len(more) == 54
