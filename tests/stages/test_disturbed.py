"""What befalls the simulated robot in the loop: what is read and seen of it, and its truth in the trace."""

import numpy as np
import pytest

from projservo_cli.config import load_config
from tests.configured import calibrate, plan, servo, truth_of
from tests.conftest import ROOT

UNTESTED = "stop.innovation_threshold=0"


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
        assert np.abs(other.latency[-1]).max() < 0.005


@pytest.mark.volume
def test_the_trace_holds_the_truth(driven):
    """Of a slip, of play and of a link that flexes; and the true images where they are shown at once."""
    slip = driven("disturbance.joint_moved={at_step: 10, joint: 2, by_deg: 3, encoder_slip: true}", UNTESTED)
    assert np.degrees(slip.q - slip.q_read)[10:, 1] == pytest.approx(np.full(slip.steps - 9, 3.0))
    assert np.abs(slip.s[-1] - true_images(slip)[-1]).max() < 0.5  # carried, on the way
    loose = driven("disturbance.backlash_deg=0.5", "disturbance.link_deflection_deg=0.2", UNTESTED)
    off = np.degrees(np.abs(loose.q - loose.q_read))
    assert 0.2 < off.max() <= 0.25 + 0.2 + 1e-9
