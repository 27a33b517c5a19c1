"""Following the plan of the paper's task, a half turn: a calibrated robot, with and without noise."""

import numpy as np
import pytest

from projservo_cli.config import load_config
from projservo_cli.stages import calibrate, plan, servo
from tests.conftest import ROOT
from tests.control.tracking import runs

SEEDS = (1, 2, 5, 10)


@pytest.mark.volume
@pytest.mark.parametrize("seed", SEEDS)
def test_the_centre_keeps_to_its_line_and_arrives_in_time(seed):
    """At 0.5 px in the trials and in the loop; ``tests.control.tracking`` runs a hundred seeds."""
    run = runs(seed, ["exact_track"])["exact_track"]
    assert run.verdict == "converged"
    assert run.on_the_line
    assert run.in_time
    assert run.occluded == 0


@pytest.mark.volume
@pytest.mark.parametrize("seed", SEEDS)
def test_shown_often_enough_the_true_goal_is_reached(seed):
    """One image of the goal tells its place to 0.96 mm rms at best; sixteen to a quarter of that."""
    run = runs(seed, ["exact_track"], ["noise.shown_frames=16"])["exact_track"]
    assert run.on_the_line
    assert run.in_time
    assert run.at_true_goal


@pytest.mark.volume
@pytest.mark.parametrize("noise", [0.0, 0.5])
def test_image_track_turns_without_hiding_where_the_plain_law_hides(noise):
    config = load_config(ROOT / "configs" / "paper.yaml", [f"noise.servo_px={noise}"])
    _, calibration, _ = calibrate.run(config)
    planned = plan.run(config, calibration)
    plain, following = (
        servo.run(config, calibration, planned, n) for n in ("stacked", "stacked_image_track")
    )
    assert plain.self_occluded.any()
    assert following.verdict == "converged"
    assert not following.self_occluded.any()
    assert following.center_deviation_mm < 0.1 * plain.center_deviation_mm
    assert following.first_outside_image == following.first_beyond_limit == -1


@pytest.mark.volume
@pytest.mark.parametrize("arm", ["ur5", "stanford", "coupled"])
def test_other_arms_follow_their_plans(arm):
    settings = ["trajectory.profile=constrained", "control.prismatic_speed_limit_m_s=0.5"]
    config = load_config(ROOT / "configs" / f"{arm}.yaml", settings)
    _, calibration, _ = calibrate.run(config)
    planned = plan.run(config, calibration)
    assert planned.time[-1] == planned.duration
    assert (np.diff(planned.time) > 0.0).all()
    trace = servo.run(config, calibration, planned, "exact_track")
    assert trace.verdict == "converged"
    assert trace.mode == "track"
    assert not trace.self_occluded.any()
    assert trace.planned_s == planned.duration
    # An image error of a hundredth of a pixel is reached some time after the plan has.
    assert planned.duration <= trace.steps * trace.period <= planned.duration + 4.0
