"""Servos of a rendered robot: what they are sent, what gravity takes, what a file's own actuators do."""

import math

import numpy as np
import pytest

from projservo_cli.config import load_config
from projservo_cli.simulation.mujoco_servos import Physics
from tests.configured import truth_of
from tests.simulation.conftest import eyes_of

# A pendulum of 2 kg at 0.5 m behind a joint about the vertical axis, and a finger of its own.
ARM = """<mujoco><compiler angle="radian"/><worldbody>
  <body name="stand"><geom size="0.05"/>
    <body name="turret" pos="0 0 0.4"><joint name="pan" axis="0 0 1"/><geom size="0.05"/>
      <body name="boom"><joint name="tilt" axis="0 1 0" armature="0.05"/>
        <geom size="0.02" pos="0.5 0 0" mass="2"/>
        <body name="hand" pos="0.5 0 0">
          <body name="finger"><joint name="grip" type="slide"/><geom size="0.01" contype="0"/></body>
        </body>
      </body>
    </body>
  </body></worldbody>
  <actuator><position name="gripper" joint="grip" kp="10" kv="1"/>{actuators}</actuator>
  <keyframe><key qpos="0.3 0.2 0.01" ctrl="0.01 {inputs}"/></keyframe>
</mujoco>"""
SERVOS = {
    "position": '<position name="t" joint="tilt" kp="500" kv="20" gear="3"/>'
    '<position joint="pan" kp="90" kv="9"/>',
    "scaled": '<general name="t" joint="tilt" gainprm="100" biastype="affine" biasprm="7 -4000 -200"/>'
    '<position joint="pan" kp="90" kv="9"/>',
    "velocity": '<velocity name="t" joint="tilt" kv="60" gear="2"/><velocity joint="pan" kv="9"/>',
    "motor": '<motor name="t" joint="tilt" gear="-20"/><motor joint="pan" gear="5"/>',
    "integrated": '<intvelocity name="t" joint="tilt" kp="3000" kv="90" actrange="-3 3"/>'
    '<position joint="pan" kp="90" kv="9"/>',
    "none": "",
}
# What a radian off takes, N m: gear² times what the actuator does.
STIFFNESS = {"position": 4500.0, "scaled": 4000.0, "velocity": 4.0 * 60.0 / 0.1, "integrated": 3000.0}
WEIGHT = 0.5 * 9.81 * 2.0  # N m at the joint, stretched out; the finger weighs 4 g more
Q = np.array([0.4, -0.3])


def described(tmp_path, servos, *overrides):
    """Configuration of the pendulum."""
    inputs = " ".join("0" * SERVOS[servos].count("joint="))
    text = ARM.replace("{actuators}", SERVOS[servos]).replace("{inputs}", inputs)
    (tmp_path / "arm.xml").write_text(text, encoding="utf-8")
    path = tmp_path / "its.yaml"
    lens = "focal_px: [300, 300], principal_point_px: [160, 120]"
    left, right = (f"{{{lens}, position_m: [2, {y}, 1], target_m: [0.5, 0, 0.5]}}" for y in (0.2, -0.2))
    path.write_text(
        "plant: mujoco\nrobot: {mjcf: arm.xml, tip: hand}\n"
        f"rig: {{image_size_px: [320, 240], left: {left}, right: {right}}}\n"
        "task: {start: {joints: [0, 0], unit: rad}, goal: {joints: {joints: [1, 0.4], unit: rad}}}\n",
        encoding="utf-8",
    )
    return load_config(path, overrides)


def driven(config, q, lag_s=0.0, sag=0.0):
    """The servos of a configuration, at rest at joints."""
    truth_of(config)
    return Physics(eyes_of(config).rendered, np.array(q), lag_s, sag)


def load(physics):
    """Torque that gravity asks of the tilting joint, N m, of an arm that stands."""
    return physics._gravity()[1]


@pytest.mark.usefixtures("needs_mujoco")
@pytest.mark.parametrize("servos", SERVOS)
def test_actuators_of_a_file_hold_and_move_the_arm(tmp_path, servos):
    physics = driven(described(tmp_path, servos), Q)
    torque = load(physics)
    assert abs(torque) == pytest.approx(WEIGHT * math.cos(Q[1]), rel=0.2)
    sag = torque / STIFFNESS.get(servos, math.inf)
    assert physics.setpoint - Q == pytest.approx([0.0, sag], abs=1e-12)
    physics.follow(physics.setpoint, 1.0)
    assert physics.motor == pytest.approx(Q, abs=1e-5)
    target = np.array([-0.5, 0.5])
    physics.follow(target, 1.0)
    physics.follow(target, 1.5)
    expected = target - [0.0, load(physics) / STIFFNESS.get(servos, math.inf)]
    assert physics.motor == pytest.approx(expected, abs=2e-4)
    assert physics._data.qpos[2] == pytest.approx(0.01, abs=0.02)


@pytest.mark.usefixtures("needs_mujoco")
def test_the_force_on_an_arm_is_what_its_servo_presses_with(tmp_path, monkeypatch):
    """A ball of 2 cm at 0.5 m before a wall, sent 0.1 rad into it."""
    wall = '<geom type="box" size="0.3 0.05 0.3" pos="0.5 0.1 0.4"/></worldbody>'
    monkeypatch.setattr(f"{__name__}.ARM", ARM.replace("</worldbody>", wall))
    config = described(tmp_path, "position")
    physics = driven(config, [0.0, 0.0])
    assert physics.force == 0.0
    physics.follow(np.array([0.1, 0.0]), 0.5)
    physics.follow(np.array([0.1, 0.0]), 2.0)
    physics.follow(np.array([0.1, 0.0]), 0.1)
    torque = 90.0 * (0.1 - physics.motor[0])
    assert physics.force == pytest.approx(torque / 0.5, rel=0.02)
    assert physics.force > 5.0
    assert [one.code for one in physics.obstruction] == ["arm_touches"]


@pytest.mark.usefixtures("needs_mujoco")
@pytest.mark.parametrize("servo", ["position", "velocity"])
def test_servos_of_ours_follow_lag_and_sag_as_they_are_told(tmp_path, servo):
    config = described(tmp_path, "position", f"plant.options.servo={servo}")
    pace, period = np.array([0.8, -0.6]), 0.02
    for lag in (0.0, 0.1):
        physics = driven(config, Q, lag)
        for k in range(1, 51):
            physics.follow(Q + pace * period * k, period)
        assert physics.motor == pytest.approx(Q + pace * (1.0 - lag), abs=0.004)
        physics.follow(Q + pace, 1.5)
        assert physics.motor == pytest.approx(Q + pace, abs=1e-6)
    physics = driven(config, Q, 0.0, math.radians(0.5))
    physics.follow(physics.setpoint, 1.0)
    assert physics.motor == pytest.approx(Q, abs=1e-6)
    physics.follow(np.zeros(2), 1.0)
    physics.follow(np.zeros(2), 1.0)
    assert np.degrees(physics.motor) == pytest.approx([0.0, 0.5], abs=0.01)
    physics.strike(np.array([0.1, 0.0]))
    assert physics.motor[0] == pytest.approx(0.1, abs=1e-6)
    physics.follow(physics.setpoint, 1.0)
    assert physics.motor[0] == pytest.approx(0.1, abs=1e-4)


@pytest.mark.usefixtures("needs_mujoco")
def test_a_real_arm_with_its_meshes(shared_data, small, drawn):
    """Its own servos hold it with an error of their stiffness; drawn, it does not hide its tags."""
    file = shared_data / "robots" / "ur5e" / "ur5e.xml"
    if not file.is_file():
        pytest.skip(f"{file} is not there: the model of the arm is not shipped")
    q = np.array([-1.5708, -1.2, 1.5, -1.9, -1.5708, 0.4])
    camera = "focal_px: [300, 300], principal_point_px: [160, 120], target_m: [0.49, 0.2, 0.6]"
    config = small(
        f"robot={{mjcf: {file}, tip: attachment_site}}",
        f"rig.left={{{camera}, position_m: [0.4, 0.4, -0.4]}}",
        f"rig.right={{{camera}, position_m: [0.6, 0.4, -0.4]}}",
        f"task={{start: {{joints: {q.tolist()}, unit: rad}}, goal: {{roll_deg: 10}}}}",
    )
    truth, eyes = drawn(config)
    looks = [eyes.capture(view, q[None], None, np.random.default_rng(0)) for view in range(2)]
    seen, sigma = zip(*looks, strict=True)
    off, sigma = np.array(seen) - truth.images(q, truth.M), np.array(sigma)[..., None]
    assert np.isfinite(sigma).sum(axis=(1, 2)).min() >= 8
    assert (np.abs(off) < 5.0 * sigma)[np.isfinite(off)].all()
    assert eyes.rendered.model.dof_armature == pytest.approx(0.1)
    physics = Physics(eyes.rendered, q, 0.0, 0.0)
    for _ in range(2):
        physics.follow(q, 1.0)
    stiffness = np.array([2000.0, 2000.0, 2000.0, 500.0, 500.0, 500.0])
    assert q - physics.motor == pytest.approx(physics._gravity() / stiffness, abs=1e-5)
