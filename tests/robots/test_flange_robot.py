"""Controllers that take poses of the flange instead of joints."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import projservo_cli as ps
from projservo_cli.config import load_config
from projservo_cli.geometry.displacements import rigid
from projservo_cli.geometry.flange import FlangeChart
from projservo_cli.robots.flange_robot import FlangeRobot
from projservo_cli.store.observation_tables import read_table
from projservo_cli.store.run_file import load
from tests.robots.robots import CALLS, ByPoses, Sent

pytestmark = pytest.mark.volume  # a calibration and many steps

CARTESIAN = Path(__file__).parents[2] / "configs" / "cartesian.yaml"
QUICK = ("--set", "calibration.frames_per_joint=4", "--set", "noise.servo_px=0.3")


def by_poses(name="ByPoses", config=CARTESIAN, **options):
    """The plant of a class here."""
    words = "".join(f", {key}: {value}" for key, value in options.items())
    return "--set", f"plant={{use: 'tests.robots.robots:{name}', options: {{config: {config}{words}}}}}"


@pytest.fixture
def run(projservo, monkeypatch, tmp_path):
    """Stages of the configuration, driven by a class of poses."""
    monkeypatch.chdir(tmp_path)
    CALLS.clear()

    def call(*stages, **options):
        law = ["--law", "exact"] if "servo" in stages else []
        return projservo(*stages, "-c", CARTESIAN, *QUICK, *by_poses(**options), *law, "-o", "run", "--json")

    return call


def test_a_robot_of_poses_is_recorded_calibrated_and_driven_to_the_goal(run):
    """Its table holds poses; commands are poses within the limits of speed, with their twists."""
    answer = run("record", "calibrate", "servo")
    assert answer.code == 0, answer.err
    assert answer.json["calibrate"]["readings"] == "flange"
    assert answer.json["servo"]["laws"][0]["verdict"] == "converged"
    table = read_table("run/trials.csv")
    assert table.flange_chart is not None
    trace = load(Path("run")).traces["exact"]
    goal = np.array([-0.03, 0.06, -0.05, *np.radians([-5.0, 6.0, -70.0])])
    off = np.abs(trace.q[-1] - goal)
    assert off[:3].max() < 1e-3
    assert off[3:].max() < np.radians(0.3)
    sent = [call for call in CALLS if isinstance(call, Sent) and call.period > 0.0]
    turns = Rotation.from_matrix([call.step[:3, :3] for call in sent]).magnitude()
    shifts = np.abs([call.target[:3, 3] - before.target[:3, 3] for before, call in pairwise(sent)])
    seconds = np.array([call.period for call in sent])
    assert (turns <= 1.001 * np.sqrt(3.0) * np.radians(30.0) * seconds).all()
    assert (shifts <= 1.001 * 0.1 * seconds[1:, None]).all()


def test_the_twist_of_a_command_is_the_rate_of_its_pose(rng):
    """To central differences of 1e-6."""
    chart = FlangeChart.of(np.array([rigid(R, [0.4, 0.0, 0.3]) for R in Rotation.random(3, rng=rng)]))
    given = []
    robot = FlangeRobot(type("Arm", (), {"command": lambda _, *told: given.append(told)})(), chart)
    for q in rng.uniform(-0.6, 0.6, (5, 6)):
        speed = rng.normal(size=6)
        robot.command(q, speed, 1.0)
        T, twist, _ = given[-1]
        ends = chart.poses(np.array([q - 1e-6 * speed, q + 1e-6 * speed]))
        turn = Rotation.from_matrix(ends[1, :3, :3] @ ends[0, :3, :3].T).as_rotvec() / 2e-6
        np.testing.assert_allclose(T, chart.poses(q[None])[0])
        np.testing.assert_allclose(
            twist, np.concatenate([(ends[1] - ends[0])[:3, 3] / 2e-6, turn]), atol=1e-6
        )


def test_a_pose_that_the_controller_refuses_is_said_in_its_words(run):
    answer = run("record", "calibrate", lowest=0.34)
    assert answer.code == 1
    assert "the controller refused the pose at (" in answer.err
    assert "joint 3 would pass its limit" in answer.err


def test_a_coordinate_that_a_controller_does_not_reach_has_its_name(run):
    """And not the number of a joint that the controller does not have."""
    answer = run("record", "calibrate", blocked_at=0.34)
    assert answer.code == 1
    assert "z of the flange was sent to" in answer.err
    assert "joint 3" not in answer.err


def test_joints_and_poses_are_not_mistaken_for_each_other(projservo, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    ur5 = CARTESIAN.with_name("ur5.yaml")
    for name, config, words in (
        ("Sound", CARTESIAN, "takes joints, and robot.flange"),
        ("ByPoses", ur5, "set robot.flange"),
    ):
        answer = projservo("record", "-c", config, *by_poses(name, CARTESIAN), "--output", "t.csv")
        assert (answer.code, words in answer.err) == (2, True), answer.err


def test_a_calibration_by_another_home_drives_nothing():
    short = ("calibration.frames_per_joint=4", "control.laws=[exact]")
    home = "robot.flange.home=[[1,0,0,0.46],[0,-1,0,0],[0,0,-1,0.35],[0,0,0,1]]"
    config, other = load_config(CARTESIAN, short), load_config(CARTESIAN, [*short, home])
    calibration = ps.calibrate(ps.simulate(config, progress=False), progress=False)
    motion = ps.plan(config, calibration)
    with pytest.raises(ps.InputError, match="its home"):
        ps.servo(other, calibration, motion, robot=ByPoses(CARTESIAN))
