"""A small rendered robot; without GL, tests that draw are skipped."""

import numpy as np
import pytest

from projservo_cli.config import load_config
from projservo_cli.records import InputError
from projservo_cli.simulation.mjcf import mujoco
from tests.configured import eyes_of, truth_of

# A two-joint arm before two cameras, of which the left one has skew, the right one unequal focal lengths.
SMALL = """
plant: {use: mujoco, options: {grey_noise: 0, blur_px: 0}}
robot:
  screws:
    reference: {joints: [0.1, -0.2], unit: rad}
    base_tool: [[0, 0, 1, 0.5], [1, 0, 0, 0], [0, 1, 0, 0.2], [0, 0, 0, 1]]
    joints:
      - {type: R, w: [0, 1, 0], v: [-0.2, 0, 0], limits_deg: [-90, 90]}
      - {type: R, w: [1, 0, 0], v: [0, 0.2, 0], limits_deg: [-90, 90]}
rig:
  image_size_px: [320, 240]
  left: {matrix: MATRIX}
  right:
    focal_px: [560, 600]
    principal_point_px: [150, 125]
    position_m: [1.5, -0.2, 0.3]
    target_m: [0.5, 0, 0.2]
markers: {tags: roof, tag_size_m: 0.08}
task: {start: {joints: [0.1, -0.2], unit: rad}, goal: {joints: {joints: [0.2, 0.5], unit: rad}}}
"""


def _skewed():
    """A camera (3, 4) like the right one, with skew."""
    z = np.array([-1.0, -0.2, -0.1]) / np.linalg.norm([-1.0, -0.2, -0.1])
    x = np.cross(z, [0.0, 0.0, 1.0]) / np.linalg.norm(np.cross(z, [0.0, 0.0, 1.0]))
    R = np.stack([x, np.cross(z, x), z])
    K = np.array([[580.0, 9.0, 164.0], [0.0, 575.0, 118.0], [0.0, 0.0, 1.0]])
    return K @ np.c_[R, -R @ [1.5, 0.2, 0.3]]


@pytest.fixture(scope="session")
def small():
    """The configuration of a small rendered robot, with overrides."""
    text = SMALL.replace("MATRIX", str(_skewed().tolist()))
    return lambda *overrides: load_config("small.yaml", overrides, text=text)


@pytest.fixture
def needs_mujoco():
    """Skip a test where MuJoCo is missing."""
    try:
        mujoco()
    except InputError as error:
        pytest.skip(str(error))


@pytest.fixture
def drawn(needs_mujoco):
    """Truth and cameras of a configuration, the cameras open; a test that cannot draw is skipped."""
    opened = []

    def draw(config):
        opened.append(eyes_of(config))
        try:
            opened[-1].open()
        except InputError as error:
            pytest.skip(str(error))
        return truth_of(config), opened[-1]

    yield draw
    for eyes in opened:
        eyes.close()
