"""What the claims measure, on runs made up so that the answer is known."""

import dataclasses
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from projservo_cli.control.law import OK
from projservo_cli.loop.verdicts import NO_PROGRESS, Instant, new_log, plateau_stretch, verdict_at
from projservo_cli.records import changed
from projservo_cli.report.claims import claims_of
from tests.report.cases import SPECS, case
from tests.scene import limits

FITTED, FREE = ("direct_two", "calibrated", True), ("direct_three", "calibrated", False)


def measured(words, material=None, own=None):
    """Measure and verdict of the claim with some words; ``own`` replaces some of the extra runs."""
    material = material or case()[2]
    studies = dataclasses.replace(material.studies, own=material.studies.own | (own or {}))
    material = dataclasses.replace(material, studies=studies)
    (claim,) = [claim for claim in claims_of(material, None) if words in claim.claim]
    return claim.measured, claim.holds


def test_decay_is_judged_by_the_steps_after_the_limit_and_above_what_the_calibration_explains():
    material = case()[2]
    trace, gains = material.studies.own[FITTED], material.studies.gains_of_laws
    factors = 1.0 - gains.gain_t * trace.period, 1.0 - gains.gain_s * trace.period
    count = 200
    way, theta = 0.5 * factors[0] ** np.arange(count), 3.0 * factors[1] ** np.arange(count)
    way[:37] = theta[:37] = 5.0  # before twenty steps have passed since the last limited command
    speed = np.ones(count)
    speed[[3, 17]] = 0.5

    def judged(way, theta):
        center = material.goal_center(trace) + way[:, None] * [0.6, 0.0, 0.8]
        run = changed(trace, center=center, theta_s=theta, speed_factor=speed)
        return measured("directTWO: the control errors decay", own={FITTED: run})

    steps = [
        np.count_nonzero(values[37:] > least) - 1
        for values, least in ((way, 1e-4), (theta, np.radians(0.05)))
    ]
    text, holds = judged(way, theta)
    assert f"fitted rates {gains.gain_t:.3f} (centre) and {gains.gain_s:.3f} (θ_s) per s" in text
    assert f"within 0.00% of 1 - gain·period over {steps[0]} and {steps[1]} steps" in text
    assert holds
    text, holds = judged(np.where(np.arange(count) > 50, 1.02 * way, way), theta)
    assert (holds, "within 2.00%" in text) == (False, True)
    assert judged(way[:47], theta[:47]) == ("too few settled steps", None)
    assert judged(way[:48], theta[:48])[1]


@pytest.mark.parametrize(
    ("s", "gap"),
    [
        ([[0.0, 0.0], [10.0, 0.0]], 3.0),  # parallel, however often it is sampled
        ([[0.0, 3.0], [5.0, 7.0], [10.0, 3.0]], 4.0),  # a detour
    ],
)
def test_gap_of_two_paths_is_the_farthest_way_to_the_other(s, gap):
    material = case()[2]
    straight = np.stack([np.linspace(0.0, 10.0, 101), np.full(101, 3.0)], axis=1)
    for first, second in ((straight, np.array(s)), (np.array(s), straight)):
        runs = {
            law: changed(material.traces[law], s=np.broadcast_to(path[:, None, None], (len(path), 2, 4, 2)))
            for law, path in (("direct_three", first), ("direct_two", second))
        }
        told, _ = measured("differ very little", dataclasses.replace(material, traces=runs))
        assert told.startswith(f"largest distance between both paths {gap:.1f} px; the face is 66°")


def test_image_errors_are_held_against_an_exponential_and_the_least_before():
    material = case()[2]
    trace, gains = material.studies.own[FREE], material.studies.gains_of_laws
    decay = (1.0 - gains.gain_t * trace.period) ** np.arange(5)
    e = np.full(trace.s_star.shape, 8.0) * decay[:, None, None, None]
    for risen, exponential, monotone in ((0.0, (0, False), (0, 0, False)), (70.0, (70, True), (1, 69, True))):
        e[3, 1, 2, 0] += risen
        run = changed(trace, s=trace.s_star + e)
        text, holds = measured("does not decay exponentially", own={FREE: run})
        assert (int(re.search(r"(\d+) px", text)[1]), holds) == exponential
        text, holds = measured("does not even decay monotonically", own={FREE: run})
        many, most = re.search(rf"(\d+) of {e[0].size} .* up to (\d+) px", text).groups()
        assert (int(many), int(most), holds) == monotone


def test_a_trial_motion_defines_its_operator_in_any_calibration():
    """By the operators of the run to round-off; not by one that is no tangent of a group."""
    material = case()[2]
    assert measured("A trial motion")[1]
    model = material.calibrated
    bent = model._replace(H_hat_0=model.H_hat_0 + 1e-3 * np.eye(4))
    assert measured("A trial motion", dataclasses.replace(material, calibrated=bent))[1] is False


def on_plateau(error, k, window):
    """Whether a run whose last instant is k ends so."""
    log = new_log(6, 4, len(error), 5)
    log.judged[: len(error)], log.begun[:2] = error, 1.0
    now = Instant(True, False, 1.0, OK, np.zeros(6))
    bounds = limits(image_error_px=0.0, diverged_factor=1e9, stall_periods=window, max_steps=k)
    return verdict_at(log, k, now, bounds) == NO_PROGRESS


@given(st.lists(st.sampled_from([0.5, 0.95, 0.9999, 1.0, 1.01]), max_size=60), st.integers(1, 20))
def test_a_plateau_is_the_longest_stretch_on_which_the_verdict_would_be_one(factors, window):
    error = np.cumprod([100.0, *factors])
    first, last = plateau_stretch(error, window) or (0, window - 1)
    still = "".join("x" if on_plateau(error, k, window) else " " for k in range(len(error)))
    longest = max(still.split(), key=len, default="")
    assert last - first == len(longest) + window - 1
    assert set(still[first + window : last + 1]) <= {"x"}


def test_the_plateau_that_is_drawn_and_claimed_is_that_of_the_verdict():
    """By the configured steps and the error that the run is judged by, which need not be the image error."""
    material = case()[2]
    judged = np.r_[100.0 * 0.9 ** np.arange(10), np.full(20, 30.0), 30.0 * 0.9 ** np.arange(1, 11)]
    trace, count = material.traces["stacked"], len(judged)
    still = changed(
        trace,
        convergence_error=judged,
        image_error=100.0 * 0.9 ** np.arange(count),
        s=np.repeat(trace.s[:1], count, axis=0),
        self_occluded=np.zeros((count, 2), dtype=bool),
    )
    shown = dataclasses.replace(material, traces={"stacked": still}, stall_periods=5)
    assert SPECS["fig04_classical"].data(shown)["plateau_stacked"].tolist() == [[10, 29]]
    (claim,) = [c for c in claims_of(shown, None) if "local minimum" in c.claim]
    assert claim.measured.startswith("19 steps from step 10 at 30 px")
    assert claim.criterion.startswith("image error falls < 1 % in 5 steps")
