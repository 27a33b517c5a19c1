"""The sense of a task's rotations, against the whole plan."""

import numpy as np
import pytest

from projservo_cli.config import load_config
from projservo_cli.stages import calibrate, plan
from projservo_cli.stages.plan import rotation_sense
from projservo_cli.stages.scenario import scenario_of
from tests.conftest import ROOT

CASES = [
    ("paper", ("noise.servo_px=0.5",)),  # half a turn, either sense of which is rehearsed
    ("ur5", ("noise.servo_px=1", "control.observation=points")),
    ("coupled", ("trajectory.profile=exponential",)),
    ("coupled", ("trajectory.profile=constrained", "trajectory.samples=5")),
]


@pytest.mark.parametrize(("name", "overrides"), CASES)
def test_the_sense_is_that_of_the_whole_plan(name, overrides):
    config = load_config(ROOT / "configs" / f"{name}.yaml", ["trajectory.samples=11", *overrides])
    _, calibration, _ = calibrate.run(config)
    found = rotation_sense(scenario_of(config, calibration))
    assert np.array_equal(found.rotation_sense(), plan.run(config, calibration).rotation_sense())
