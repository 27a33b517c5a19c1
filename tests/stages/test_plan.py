"""The plan: its predicted path against the truth, margins, amplitudes of visibility, profiles."""

import numpy as np
import pytest

from projservo_cli.records import WorkFailed
from projservo_cli.task.trajectory import PROFILES
from tests.configured import calibrate, truth_of
from tests.configured import plan as planning
from tests.known import configured
from tests.samples import frame, in_frame, pixels
from tests.stages.cases import case


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("name", ["paper", "ur5"])
def test_planned_images_lead_from_start_to_goal(name, profile):
    """A profile says whether all its margins are positive, and what to change where they are not."""
    example = case(name)
    plan = example.planned(example.truth.model, profile)
    assert plan.s[0] == pytest.approx(plan.s_start, abs=1e-8)
    assert plan.s[-1] == pytest.approx(plan.s_star, abs=1e-8)
    assert plan.margin[0] == pytest.approx([1.0, 1.0], abs=1e-12)
    assert plan.feasible == bool((plan.margin > 0).all())
    assert plan.feasible or (profile in plan.reason and "trajectory.profile" in plan.reason)
    for H, s in zip(plan.H_d, plan.s, strict=True):
        assert s == pytest.approx(pixels(example.truth.P, plan.A @ H.T), abs=1e-8)


@pytest.mark.parametrize("profile", ["translation_first", "rotation_first"])
def test_what_comes_first_waits_for_the_other_where_visibility_would_change(profile):
    example = case("coupled")
    assert example.planned(example.truth.model, profile).feasible


@pytest.mark.parametrize("name", ["paper", "ur5", "stanford"])
def test_margin_is_the_true_distance_of_camera_and_face(name):
    """From the points of the face along the path, in plain metres, relative to the start."""
    plan, distances = case(name).plan, []
    for H in plan.H_d:
        M = (plan.A @ H.T)[:, :3]
        normal = np.cross(M[1] - M[0], M[2] - M[0])
        distances.append((plan.optical_center[:, :3] - M[0]) @ normal / np.linalg.norm(normal))
    wanted = np.array(distances) / distances[0]
    assert plan.margin == pytest.approx(wanted, abs=1e-9)


@pytest.mark.parametrize("name", ["ur5", "stanford"])
def test_plan_does_not_depend_on_the_frame(name):
    example = case(name)
    for seed in (1, 2):
        there = example.planned(in_frame(example.truth.model, frame(seed, mirrored=seed == 2)))
        assert there.s == pytest.approx(example.plan.s, abs=1e-7)
        assert there.margin == pytest.approx(example.plan.margin, abs=1e-9)
        assert there.tau_0 == pytest.approx(example.plan.tau_0, rel=1e-8, nan_ok=True)
        # A mirrored frame turns the plane's sign, which swaps θ_0⁺ and θ_0⁻.
        angles = np.sort(there.theta_0), np.sort(example.plan.theta_0)
        assert angles[0] == pytest.approx(angles[1], abs=1e-8)
        assert there.tau_limit == pytest.approx(example.plan.tau_limit, rel=1e-8)


def test_the_planned_sense_of_a_half_turn_is_the_better():
    """Against the opposite sense: it stays within the joint limits, or arrives no later."""
    example = case("paper")
    planned = example.trace("direct_two")
    sense = example.plan.rotation_sense() * np.array([[1.0], [-1.0]])
    other = example.servo("direct_two", sense=sense)
    assert planned.verdict == "converged"
    assert (planned.first_beyond_limit >= 0, planned.steps) <= (
        other.verdict != "converged" or other.first_beyond_limit >= 0,
        other.steps,
    )
    assert np.abs(planned.q[5] - other.q[5]).max() > 0.1


@pytest.mark.parametrize(
    ("aside_m", "shift_px", "code", "parts"),
    [
        (0.0, 0.0, "", []),
        (0.02, 0.0, "goal_unreached", ["turn", *["joint_reading"] * 5]),
        (0.0, 6.0, "goal_not_rigid", ["shift", "shift"]),
    ],
    ids=["reached", "aside", "one view"],
)
def test_goal_images_that_joints_do_not_reach_are_told_from_those_that_no_tool_shows(
    aside_m, shift_px, code, parts
):
    config = configured(
        "hobby", "noise.servo_px=0.1", "noise.calibration_px=0.1", "calibration.random_poses=8"
    )
    truth, q = truth_of(config), np.radians([20, -5, 5, -10, 80])
    s = pixels(truth.P, truth.M @ truth.displacement(q).T + [0.0, aside_m, 0.0, 0.0])
    s[0] += [shift_px, 0.0]
    images = {"markers": list(truth.number), "left": s[0].tolist(), "right": s[1].tolist()}
    goal = config.task.goal.model_validate({"images": images})
    config = config.model_copy(update={"task": config.task.model_copy(update={"goal": goal})})
    calibration = calibrate.run(config)[1]
    if not code:
        assert planning.run(config, calibration).feasible
        return
    with pytest.raises(WorkFailed) as caught:
        planning.run(config, calibration)
    (one,) = caught.value.findings
    assert (one.code, [part.code for part in one.others]) == (code, parts)
