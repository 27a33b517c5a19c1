"""Tasks that no motion can do: the plan names the constraint, the camera and the place."""

import numpy as np
import pytest

from projservo_cli.config import load_config
from projservo_cli.stages.plan import plan_task
from projservo_cli.task.target import TaskImages
from tests.configured import truth_of
from tests.conftest import ROOT
from tests.known import asked, known_scenario

pytestmark = pytest.mark.volume

# A rig of wide angle that stands within the reach of the arm of ur5.yaml.
NEAR = (
    "rig={{image_size_px: [1280, 1024], "
    "left: {{focal_px: [300, 300], principal_point_px: [639.5, 511.5], position_m: [0.85, {}, 0.45], "
    "target_m: [0.3, 0.12, 0.45]}}, "
    "right: {{focal_px: [300, 300], principal_point_px: [639.5, 511.5], position_m: [0.85, {}, 0.45], "
    "target_m: [0.3, 0.12, 0.45]}}}}"
)
# Start and goal in degrees: one that passes a camera so closely that turning cannot keep up, and one that
# begins 2.7 px from the border of an image, where 5 px are asked for.
PASSING = (
    [168.057, -266.215, -20.278, 41.361, -128.377, -93.061],
    [276.133, 294.127, -50.457, 4.022, -83.974, -294.656],
)
BORDER = (
    [0.977, -159.178, 190.12, -34.988, 18.725, -56.874],
    [-12.633, -149.758, 180.678, -4.066, 48.153, 174.349],
)
# One in which joint 5 would have to pass 180°, where joints 4 and 6 are one axis.
JUMP = (
    [219.601, 156.604, 152.68, -319.261, -41.8, -140.096],
    [68.604, -184.647, 63.518, -239.498, 112.226, 100.466],
)


def planned(name, task, overrides, **demands):
    """Plan of a task of a shipped configuration with another rig, with the true operators."""
    config = load_config(ROOT / "configs" / f"{name}.yaml", overrides)
    truth = truth_of(config)
    q_start, q_goal = np.radians(task)
    s_start, s_star = (truth.images(q, truth.M_face) for q in (q_start, q_goal))
    wanted = known_scenario(config).demands._replace(**demands)
    shown = TaskImages(q_start, s_start, s_star, truth.center)
    return plan_task(truth.model, shown, asked("constrained"), wanted)


def test_a_camera_that_is_passed_too_closely():
    plan = planned("ur5", PASSING, [NEAR.format(0.06, 0.18)])
    assert not plan.feasible
    assert plan.constraint == "visibility"
    assert "visibility fails first: visibility from the left camera" in plan.reason
    assert "at mu_t 0." in plan.reason
    assert plan.min_margin[0] <= 0.0


def test_an_end_too_near_to_the_border_of_an_image():
    overrides = ["rig.left.position_m=[0.9, 0.9, 0.63]", "rig.right.position_m=[0.9, -0.9, 0.63]"]
    plan = planned("coupled", BORDER, overrides)
    assert not plan.feasible
    assert plan.constraint == "image"
    assert "px from the border of the right image (5 px asked for)" in plan.reason
    assert 0.0 < plan.min_margin[1] < 5.0
    assert "image fails first" not in planned("coupled", BORDER, overrides, border_px=0.0).reason


def test_no_path_jumps_over_a_singular_configuration():
    """To flip the wrist where it is all but singular is no path; without a flip joint 4 passes its limit."""
    plan = planned("ur5", JUMP, ["trajectory.border_px=0.0"])
    assert not plan.feasible
    assert plan.constraint in ("conditioning", "joints")
    followed = plan.q[np.isfinite(plan.q).all(axis=1)]
    assert np.abs(np.diff(followed, axis=0)).max() < 0.6
