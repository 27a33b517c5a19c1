"""Robots that files describe, against MuJoCo's own kinematics."""

import math

import numpy as np
import pytest

from projservo_cli.config import load_config
from projservo_cli.records import InputError
from projservo_cli.simulation import mjcf
from projservo_cli.simulation.from_settings import arm_of
from tests.samples import displacement

try:
    mujoco = mjcf.mujoco()
except InputError as error:
    pytest.skip(str(error), allow_module_level=True)

URDF = """<robot name="arm">
  <link name="world"/>
  <joint name="mount" type="fixed">
    <parent link="world"/><child link="base"/><origin xyz="0.1 -0.2 0.3" rpy="0.1 0.2 -0.3"/>
  </joint>
  <link name="base">{inertia}</link>
  <joint name="turn" type="revolute">
    <parent link="base"/><child link="one"/><origin xyz="0 0.05 0.3" rpy="0.3 -0.4 0.5"/>
    <axis xyz="0 1 1"/><limit lower="-2" upper="1.5" effort="1" velocity="1"/>
  </joint>
  <link name="one">{inertia}</link>
  <joint name="lift" type="prismatic">
    <parent link="one"/><child link="two"/><origin rpy="-1.2 0.1 0"/>
    <axis xyz="0.6 0 -0.8"/><limit lower="-0.1" upper="0.4" effort="1" velocity="1"/>
  </joint>
  <link name="two">{inertia}</link>
  <joint name="spin" type="continuous">
    <parent link="two"/><child link="three"/><origin xyz="0.2 0 0.1"/>
  </joint>
  <link name="three">{inertia}</link>
  <joint name="flange" type="fixed">
    <parent link="three"/><child link="tool"/><origin xyz="0 0 0.07" rpy="0 1.5707963 0.4"/>
  </joint>
  <link name="tool">{inertia}</link>
</robot>
""".format(
    inertia='<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
)

# Joints in another order than their names and actuators, two on one body, a reading that is not zero at the
# reference, and a body that is not of the arm.
MJCF = """<mujoco><compiler angle="radian"/><worldbody>
  <body name="box" pos="1 1 1"><freejoint/><geom size="0.1"/></body>
  <body name="base" pos="0.1 0 0.2" euler="0.3 0 0.4">
    <geom size="0.05"/>
    <body name="upper" pos="0 0 0.2" euler="0 0.5 0">
      <joint name="b" axis="0 1 0" pos="0.01 0 0" range="-1 2" ref="0.2"/>
      <joint name="a" axis="1 0 0.5" pos="0 0.02 0"/><geom size="0.05"/>
      <body name="finger"><joint name="grip" type="slide"/><geom size="0.02"/></body>
      <body name="fore" pos="0.3 0 0">
        <joint type="slide" axis="0 0 1" range="-0.1 0.2"/><geom size="0.05"/>
        <body name="hand" pos="0.1 0 0.05" quat="0.5 0.5 -0.5 0.5"><site name="flange" pos="0 0.1 0"/></body>
      </body>
    </body>
  </body>
</worldbody></mujoco>
"""


def configured(tmp_path, kind, text, tip):
    """The configuration of a robot in a file beside it."""
    (tmp_path / "robot.xml").write_text(text, encoding="utf-8")
    path = tmp_path / "its.yaml"
    path.write_text(f"robot: {{{kind}: robot.xml, tip: {tip}}}\ndata: {{table: t.csv}}\n", encoding="utf-8")
    return load_config(path)


def poses(model, tip, names, readings):
    """Poses (k, 4, 4) of a body as MuJoCo has them at joint readings (k, n)."""
    data, found = mujoco.MjData(model), []
    for q in readings:
        data.qpos[[model.joint(name).qposadr[0] for name in names]] = q
        mujoco.mj_kinematics(model, data)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = data.body(tip).xmat.reshape(3, 3), data.body(tip).xpos
        found.append(pose)
    return np.array(found)


def test_a_urdf_moves_as_mujoco_has_it(tmp_path, rng):
    config = configured(tmp_path, "urdf", URDF, "tool")
    arm, readings = arm_of(config.arm), rng.uniform(-1.0, 1.0, (20, 3))
    extra = '<mujoco><compiler fusestatic="false" discardvisual="false"/></mujoco></robot>'
    model = mujoco.MjModel.from_xml_string(URDF.replace("</robot>", extra))
    expected = poses(model, "tool", ["turn", "lift", "spin"], readings)
    assert np.array([arm.pose(q) for q in readings]) == pytest.approx(expected, abs=1e-12)
    assert config.joint_types == "RPR"
    assert arm.limits.lower.tolist() == [-2.0, -0.1, -math.inf]
    assert arm.limits.upper.tolist() == [1.5, 0.4, math.inf]


def test_an_mjcf_moves_as_mujoco_has_it(tmp_path, rng):
    config = configured(tmp_path, "mjcf", MJCF, "hand")
    arm, readings = arm_of(config.arm), rng.uniform(-1.0, 1.0, (20, 3))
    model = mujoco.MjModel.from_xml_string(MJCF)
    expected = poses(model, "hand", ["b", "a", model.nu + 4], readings)
    assert np.array([arm.pose(q) for q in readings]) == pytest.approx(expected, abs=1e-12)
    at_site = arm_of(configured(tmp_path, "mjcf", MJCF, "flange").arm)
    assert at_site.base_tool == pytest.approx(arm.base_tool @ displacement([0, 0, 0], [0, 0.1, 0]), abs=1e-12)
    assert config.joint_types == "RRP"
    assert arm.q_reference.tolist() == [0.2, 0.0, 0.0]
    assert arm.limits.lower.tolist() == [-1.0, -math.inf, -0.1]


@pytest.mark.parametrize(
    ("kind", "text", "tip", "message"),
    [
        ("urdf", "<robot", "tool", "robot.xml: not XML"),
        ("urdf", "<arm/>", "tool", "outermost element is arm, not robot"),
        ("urdf", URDF, "hand", "there is no link hand; links: world, base, one"),
        ("urdf", URDF, "base", "no joint moves link base"),
        ("urdf", URDF.replace("<robot", '<robot xmlns:xacro="x" a="${b}"'), "tool", "expand it first"),
        ("urdf", URDF.replace('<axis xyz="0 1 1"/>', '<mimic joint="spin"/>'), "tool", "joint turn mimics"),
        ("urdf", URDF.replace("continuous", "floating"), "tool", "joint spin is of type floating"),
        ("urdf", URDF.replace("0 1 1", "0 0 0"), "tool", "joint turn: its axis is zero"),
        ("urdf", URDF.replace("0 1 1", "0 one 1"), "tool", "'0 one 1': expected 3 numbers"),
        ("mjcf", "<mujoco", "hand", "MuJoCo cannot read it"),
        ("mjcf", MJCF, "head", "there is no body head; bodies: box, base, upper"),
        ("mjcf", MJCF, "base", "no joint moves body base"),
        ("mjcf", MJCF, "box", "has more than one axis"),
    ],
)
def test_what_cannot_be_taken_is_said_in_a_line(tmp_path, kind, text, tip, message):
    with pytest.raises(InputError, match=message) as told:
        configured(tmp_path, kind, text, tip)
    assert str(told.value).startswith(f"{tmp_path}/its.yaml:1:")
    assert "\n" not in str(told.value)
