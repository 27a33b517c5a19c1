"""Following a plan that was made once: exactly where and when it was planned, and back onto it."""

import math

import numpy as np
import pytest

from projservo_cli.control.law import TAU_AFFINE, THETA_S
from projservo_cli.laws import LAW_SPECS, TRACK
from projservo_cli.task.trajectory import (
    NO_REFERENCE,
    following,
    planned_step,
    trajectory_displacement,
)
from projservo_cli.task.trajectory import planned as planned_at
from tests.control.following import SPEED, Followed, planned, tracked
from tests.samples import frame
from tests.scene import GAINS, Run, limits, scene

TRACKING = [law for law, spec in LAW_SPECS.items() if TRACK in spec.modes]


def displacements(plan, periods):
    """Planned displacements (k, 4, 4) at times in periods, by the paper's product."""
    mu = np.stack([np.interp(periods * GAINS.period, plan.time, column) for column in plan.mu.T], axis=1)
    amplitudes = (plan.tau, plan.theta_r, plan.theta_p)
    return np.array([trajectory_displacement(plan.H_hat, amplitudes, row) for row in mu])


@pytest.mark.parametrize(
    ("types", "profile"), [("RRRRRR", "rotation_first"), ("RRRRRR", "exponential"), ("RRPRRR", "linear")]
)
def test_exact_is_where_and_when_it_was_planned(types, profile):
    """With the true operators and without noise, to what Newton's last step leaves."""
    sc = scene(types=types)
    # Between its samples a plan moves joints up to 2 % faster than at them.
    bounds = limits(speed=np.full(6, 1.02 * SPEED))
    run = Followed(sc, "exact", plan=planned(sc, profile=profile), bounds=bounds)
    assert run.verdict == "converged"
    assert run.steps == math.ceil(run.periods)
    there = run.log.H @ np.linalg.inv(run.log.H[0])
    goal = displacements(run.plan, np.arange(run.steps + 1))
    # Where two pieces of the path meet within a period the share of the limit is not reached exactly.
    np.testing.assert_allclose(there, goal, atol=1e-9)


def test_the_motion_of_a_period_is_the_quotient_of_planned_displacements():
    sc = scene()
    plan = planned(sc, frame(1))
    reference = tracked(sc, frame(1), plan).reference
    for clock, share in ((0.0, 1.0), (3.25, 0.5), (7.9, 0.3), (1e6, 1.0)):
        # Between two instants a period apart the reference is straight in the shares.
        mu = [
            [np.interp(time, np.arange(len(reference.mu)), column) for column in reference.mu.T]
            for time in (clock, clock + share)
        ]
        amplitudes = (plan.tau, plan.theta_r, plan.theta_p)
        before, after = (trajectory_displacement(plan.H_hat, amplitudes, np.array(row)) for row in mu)
        found = np.array(planned_step(sc.seen(frame(1)), reference, clock, share)).reshape(4, 4)
        assert found == pytest.approx(after @ np.linalg.inv(before), abs=1e-12)


def test_the_reference_ends_at_the_goal_that_was_shown():
    sc = scene()
    task, plan = tracked(sc, frame(2)), planned(sc, frame(2))
    reference = task.reference
    assert following(reference)
    assert not following(NO_REFERENCE)
    assert reference.A[0] == pytest.approx(plan.A, abs=1e-12)
    goal = np.array(planned_at(sc.seen(frame(2)), reference, 1e9)).reshape(4, 4)
    assert reference.A[-1] @ goal.T == pytest.approx(task.A_star, abs=1e-12)
    assert reference.s[-1] == pytest.approx(sc.s_star, abs=1e-9)
    assert (reference.s_ahead[-1] == 0.0).all()
    # The velocity times a period, against what the images move in one: to the curvature of their paths.
    moved = np.diff(reference.s, axis=0)
    assert reference.s_ahead[:-1] == pytest.approx(moved, abs=0.1 * np.abs(moved).max())


@pytest.mark.parametrize("law", TRACKING)
def test_what_a_start_is_off_decays_at_the_gain(law):
    """The robot starts 3° beside where the plan does: (1 − λT)^k of it is left after k periods."""
    sc = scene()
    plan = planned(sc, duration=8.0, speed=math.inf)
    beside = sc._replace(q_start=sc.q_start + np.radians([2.0, -1.0, 1.5, 2.0, 1.0, -2.0]))
    run = Followed(beside, law, plan=plan, bounds=limits(max_steps=60), task=sc.task())
    errors = run.log.errors[:41, [TAU_AFFINE, THETA_S]]
    assert errors[0, 0] > 0.01
    assert errors[0, 1] > 0.02
    # Direct laws solve the feed-forward and the feedback to first order of a step.
    off = 1e-6 if law == "exact" else 0.2
    left = 0.9 ** np.arange(10, 41)[:, None] * errors[0]
    assert errors[10:] == pytest.approx(left, rel=off, abs=1e-3 * off)


def test_the_speed_limit_slows_the_plan_and_never_bends_the_path():
    """Half the speed the plan was made for: twice the time, on the same path."""
    sc = scene()
    run = Followed(sc, "exact", bounds=limits(speed=np.full(6, 0.5 * SPEED)))
    assert run.verdict == "converged"
    assert run.steps == pytest.approx(2.0 * run.periods, abs=1.5)
    # More where another joint comes to limit, and in the last periods, in which less is left to do.
    assert run.log.factor[: run.steps - 4] == pytest.approx(0.5, abs=0.04)
    reference = tracked(sc, plan=run.plan).reference
    clock = np.r_[0.0, np.cumsum(run.log.factor[: run.steps])]
    goal = np.array([planned_at(sc.model, reference, float(time)) for time in clock]).reshape(-1, 4, 4)
    assert run.log.H @ np.linalg.inv(run.log.H[0]) == pytest.approx(goal, abs=1e-9)


def test_image_track_keeps_to_the_planned_images():
    sc = scene()
    run = Followed(
        sc, "stacked", G=frame(1), bounds=limits(speed=np.full(6, 1.2 * SPEED), image_error_px=0.5)
    )
    assert run.verdict == "converged"
    reference = tracked(sc, frame(1), run.plan).reference
    k = int(run.periods)
    off = np.linalg.norm(run.log.s[: k + 1] - reference.s[: k + 1], axis=-1)
    # A step follows the velocity at its beginning; feedback holds what its curvature leaves over the gain.
    left = np.linalg.norm(np.diff(reference.s, axis=0) - reference.s_ahead[:-1], axis=-1).max()
    assert off.max() < left / 0.1
    plain = Run(sc, "stacked", G=frame(1))
    planned_at = reference.s[np.minimum(np.arange(plain.steps + 1), len(reference.s) - 1)]
    assert np.linalg.norm(plain.log.s - planned_at, axis=-1).max() > 30.0


@pytest.mark.parametrize("share", [0.2, 2.5])
def test_the_pace_of_a_ramp_is_even(share):
    """The pace is a trapezoid; where the ramps meet, a triangle of the same slope."""
    time = planned(scene()).time
    total = time[-1]
    ramp = share * total
    eased = planned(scene(), ramp=ramp).time
    pace = np.diff(time) / np.diff(eased)
    change = np.diff(pace) / np.diff(0.5 * (eased[1:] + eased[:-1]))
    assert eased[0] == 0.0
    assert eased[-1] == pytest.approx(total + ramp if total >= ramp else 2.0 * math.sqrt(total * ramp))
    assert pace.max() <= min(1.0, math.sqrt(total / ramp)) * (1.0 + 1e-9)
    assert np.abs(change).max() <= (1.0 + 1e-6) / ramp
    assert pace[0] < 0.5 * pace.max() > pace[-1]
    assert planned(scene(), duration=6.0, ramp=ramp).duration == pytest.approx(6.0, abs=1e-12)
