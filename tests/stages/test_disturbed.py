"""What befalls the simulated robot in the loop: what is read and seen of it, and its truth in the trace."""

import numpy as np
import pytest

from projservo_cli.config import load_config
from projservo_cli.records import InputError
from projservo_cli.stages import calibrate, plan, servo
from projservo_cli.stages.simulation import events_of, faults_of
from projservo_cli.stages.world import truth_of
from tests.conftest import ROOT

UNTESTED = "stop.innovation_factor=0"


def config(*overrides, name="hobby"):
    return load_config(ROOT / "configs" / f"{name}.yaml", list(overrides))


@pytest.fixture(scope="module")
def driven():
    """Function that drives the hobby arm, without noise unless told, on one calibration of noisy trials."""
    calibration = calibrate.run(config())[1]
    undisturbed = config("noise.servo_px=0")
    whole = plan.run(undisturbed, calibration)

    def run(*overrides, law="exact_track"):
        return servo.run(config("noise.servo_px=0", *overrides), calibration, whole, law)

    return run


def true_images(trace):
    truth = truth_of(config())
    return np.array([truth.images(q, truth.M_face) for q in trace.q])


@pytest.mark.volume
def test_a_robot_that_is_struck_by_nothing_goes_as_the_ideal_one_does(driven):
    """An event beyond the end of the run takes the loop of robots of the contract, which looks for delays."""
    late = "disturbance.camera_moved={at_step: 100000, view: left, by_px: 1}"
    for law in ("exact_track", "direct_three"):
        ideal, other = driven(law=law), driven(late, law=law)
        assert (other.verdict, other.success, other.overruns) == (ideal.verdict, ideal.success, 0)
        assert other.steps == pytest.approx(ideal.steps, abs=5)
        assert other.position_error_mm == pytest.approx(ideal.position_error_mm, abs=0.1)
        assert other.center_deviation_mm == pytest.approx(ideal.center_deviation_mm, abs=1.0)
        assert np.abs(other.delay[-1]).max() < 0.005


@pytest.mark.volume
def test_the_trace_holds_the_truth(driven):
    """Of a slip, of play and of a link that flexes; and the true images where they are shown at once."""
    slip = driven("disturbance.bump={at_step: 10, joint: 2, by_deg: 3, read: false}", UNTESTED)
    assert np.degrees(slip.q - slip.q_read)[10:, 1] == pytest.approx(np.full(slip.steps - 9, 3.0))
    assert np.abs(slip.s[-1] - true_images(slip)[-1]).max() < 0.5  # carried, on the way
    loose = driven("disturbance.play_deg=0.5", "disturbance.flex_deg=0.2", UNTESTED)
    off = np.degrees(np.abs(loose.q - loose.q_read))
    assert 0.2 < off.max() <= 0.25 + 0.2 + 1e-9


def test_what_the_configuration_says_befalls_the_robot():
    given = config(
        "disturbance.bump={at_step: 3, joint: 2, by_deg: 3, read: false}",
        "disturbance.frozen_joint={joint: 3, from_step: 10, steps: 20}",
        "disturbance.camera_moved={at_step: 7, view: right, by_px: [1.5, -1]}",
        "disturbance.marker_moved={at_step: 9, marker: 5, by_m: [0, 0.003, 0]}",
        "disturbance.lost_markers={from_step: 4}",
        "disturbance.delay_s={left: 0.1, right: 0.2}",
        "disturbance.frame_rate_hz=25",
        "disturbance.encoder_ticks=4096",
        "disturbance.sag_deg=0.5",
    )
    events, faults = events_of(given, truth_of(given)), faults_of(given)
    assert (events.bump_at, events.slips, events.marker, events.marker_at) == (3, True, 5, 9)
    assert np.degrees(events.bump) == pytest.approx([0, 3, 0, 0, 0])
    assert (events.frozen, events.frozen_at, events.frozen_until) == (2, 10, 30)
    assert events.camera.tolist() == [[0, 0], [1.5, -1]]
    assert events.lost == tuple(range(8))
    assert events.lost_until > 10**9
    assert (faults.delay, faults.interval, faults.ticks) == ((0.1, 0.2), 0.04, 4096)
    assert np.degrees(faults.sag) == pytest.approx(0.5)


def test_a_robot_of_somebody_else_is_not_disturbed():
    with pytest.raises(InputError, match="disturbs the simulated robot"):
        config("disturbance.delay_s=0.1", "plant=my_robot:Robot")
