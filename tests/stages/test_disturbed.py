"""What befalls the simulated robot: lost markers, bumps, slips, frozen readings, late images."""

import numpy as np
import pytest

from projservo_cli.config import load_config
from projservo_cli.control import CODES
from projservo_cli.loop.python import BuiltInLaw, run_in_python
from projservo_cli.loop.step import VERDICTS
from projservo_cli.records import InputError
from projservo_cli.robots.simulated import AnalyticPlant
from tests.conftest import ROOT
from tests.known import known_scenario
from tests.loop.test_python_loop import same_logs
from tests.scene import GAINS, Run, limits, scene, with_pins

BUMP = "disturbance.bump={at_step: 7, joint: 3, by_deg: 3}"
SLIP = "disturbance.bump={at_step: 7, joint: 3, by_deg: -3, read: false}"
FROZEN = "disturbance.frozen_joint={joint: 2, from_step: 4, steps: 6}"
LATE = "disturbance.delay_periods=2"
LOST = "disturbance.lost_markers={from_step: 3, steps: 2, markers: [1]}"


def config(*overrides):
    return load_config(ROOT / "configs" / "paper.yaml", list(overrides))


def disturbed(*overrides, pins=False):
    sc = with_pins(scene()) if pins else scene()
    disturbance = known_scenario(config(*overrides)).plant_of("exact").disturbance
    return sc._replace(plant=sc.plant._replace(disturbance=disturbance))


def noise_of(steps, *overrides):
    """Zero but for lost markers."""
    return known_scenario(config(*overrides)).noise_of("exact", 1, steps + 1)


@pytest.mark.parametrize("pins", [False, True], ids=["points", "body"])
@pytest.mark.parametrize(
    "overrides", [(BUMP,), (SLIP,), (FROZEN,), (LATE,), (SLIP, FROZEN, LATE, LOST)], ids=len
)
def test_both_loops_suffer_alike(overrides, pins):
    sc = disturbed(*overrides, pins=pins)
    bounds = limits(max_steps=60, lost_steps=5)
    noise = noise_of(60, *overrides)
    if pins:
        noise = np.concatenate([noise, np.zeros((61, 2, len(sc.plant.pins), 2))], axis=2)
    task = sc.body_task() if pins else sc.task()
    compiled = Run(sc, "exact", bounds=bounds, noise=noise, task=task)
    plant = AnalyticPlant(sc.plant, sc.q_start, noise)
    law = BuiltInLaw(CODES["exact"], sc.model, task, GAINS._replace(speed=bounds.speed))
    code, steps, log = run_in_python(law, plant, sc.s_star, GAINS.period, bounds)
    assert (VERDICTS[code], steps) == (compiled.verdict, compiled.steps)
    same_logs(log, compiled.full, steps)


def test_a_bump_moves_the_joint_once_and_the_reading_with_it():
    run = Run(disturbed(BUMP), "exact")
    step = np.diff(run.log.q, axis=0) - GAINS.period * run.log.q_dot[:-1]
    knocked = np.zeros_like(step)
    knocked[6, 2] = np.radians(3.0)
    assert step == pytest.approx(knocked, abs=1e-14)
    np.testing.assert_array_equal(run.log.read, run.log.q)
    assert run.verdict == "converged"


def test_a_slip_stays_between_joint_and_reading():
    run = Run(disturbed(SLIP), "exact")
    off = run.log.read - run.log.q
    assert not off[:7].any()
    assert off[7:, 2] == pytest.approx(np.full(run.steps - 6, np.radians(3.0)), abs=1e-15)
    assert not np.delete(off, 2, axis=1).any()
    # The images tell where the face is; readings a little off only bend the way there.
    assert run.verdict == "converged"


def test_a_frozen_reading_stays_for_its_time():
    run = Run(disturbed(FROZEN), "exact")
    read, q = run.log.read[:, 1], run.log.q[:, 1]
    assert (read[4:10] == q[4]).all()
    assert (np.delete(read, range(5, 10)) == np.delete(q, range(5, 10))).all()
    assert (np.diff(q[4:10]) != 0).all()


@pytest.mark.parametrize("delay", [1, 3])
def test_late_images_show_what_was(delay):
    run = Run(disturbed(f"disturbance.delay_periods={delay}"), "exact")
    for k in range(run.steps + 1):
        assert run.log.s[k] == pytest.approx(scene().images(run.log.q[max(0, k - delay)]), abs=1e-9)


def test_markers_named_are_lost_and_no_others():
    noise = noise_of(9, LOST)
    gone = np.isnan(noise)
    assert gone[3:5, :, 1].all()
    assert gone.sum() == 2 * 2 * 2
    for_ever = noise_of(9, "disturbance.lost_markers={from_step: 4}")
    assert (np.isnan(for_ever).all(axis=(1, 2, 3)) == (np.arange(10) >= 4)).all()


def test_a_robot_of_somebody_else_is_not_disturbed():
    with pytest.raises(InputError, match="disturbs the simulated robot"):
        config("disturbance.delay_periods=1", "plant=my_robot:Robot")
