"""The plan: its predicted path against the truth, margins, amplitudes of visibility, profiles."""

import math

import numpy as np
import pytest

from projservo_cli.planning.margins import limits_alone
from projservo_cli.records import WorkFailed
from projservo_cli.stages.plan import plan_task, rotation_sense
from projservo_cli.task.trajectory import PROFILES
from tests.configured import calibrate, scenario_of, truth_of
from tests.configured import plan as planning
from tests.known import asked, configured
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


@pytest.mark.parametrize("name", ["paper", "ur5", "stanford"])
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


@pytest.mark.parametrize("name", ["paper", "ur5", "stanford"])
def test_amplitudes_at_which_visibility_changes(name):
    """Moved by τ_0 or turned by θ_0 the true face passes through that optical centre."""
    plan = case(name).plan
    for view in range(2):
        O = plan.optical_center[view]
        H = np.eye(4) + plan.tau_0[view] * plan.H_hat[0]
        assert abs(plan.a @ np.linalg.inv(H) @ O) < 1e-9
        for theta in plan.theta_0[view]:
            H_r = plan.H_hat[1]
            H = np.eye(4) + math.sin(theta) * H_r + (1 - math.cos(theta)) * H_r @ H_r
            assert abs(plan.a @ np.linalg.inv(H) @ O) < 1e-9
    ahead = [t for t in plan.tau_0 if t > 0]
    assert plan.tau_limit == pytest.approx(0.9 * min(ahead) if ahead else math.inf)


@pytest.mark.parametrize("name", ["paper", "ur5", "stanford"])
def test_the_better_of_both_senses_is_taken(name):
    """Fewer cameras lose sight of the face in it; on the second robot both senses lose one."""
    plan = case(name).plan
    assert abs(plan.sense[1] - plan.sense[0]) == pytest.approx(2 * math.pi)
    chosen = int(np.argmin(np.abs(plan.sense - plan.theta_r)))
    assert plan.sense[chosen] == pytest.approx(plan.theta_r, abs=1e-12)
    lost = (plan.sense_margin <= 0).sum(axis=1)
    assert lost[chosen] <= lost[1 - chosen]
    assert plan.sense_margin[chosen].min() > plan.sense_margin[1 - chosen].min()


def test_a_start_that_is_the_goal_is_a_plan_without_motion():
    example = case("ur5")
    bounds = limits_alone(example.truth.robot.limits)
    shown = example.ends._replace(s_star=example.ends.s_start)
    plan = plan_task(example.truth.model, shown, asked(samples=5), bounds)
    assert plan.tau == 0.0
    assert abs(plan.theta_s) < 1e-9
    assert plan.feasible
    assert np.abs(plan.H_d - np.eye(4)).max() < 1e-9
    assert plan.tau_limit == math.inf
    assert np.isnan(plan.tau_0).all()


@pytest.mark.parametrize("name", ["paper", "ur5"])
def test_the_planned_sense_of_a_half_turn_is_the_better(name):
    """Against the opposite sense: it stays within the joint limits, or arrives no later."""
    example = case(name)
    planned = example.trace("direct_two")
    sense = example.plan.rotation_sense() * np.array([[1.0], [-1.0]])
    other = example.servo("direct_two", sense=sense)
    assert planned.verdict == "converged"
    assert (planned.first_beyond_limit >= 0, planned.steps) <= (
        other.verdict != "converged" or other.first_beyond_limit >= 0,
        other.steps,
    )
    assert np.abs(planned.q[5] - other.q[5]).max() > 0.1


@pytest.mark.parametrize("name", ["paper", "ur5"])
def test_the_planned_half_turn_does_not_depend_on_frame_or_scale(name):
    """Exactly 180°: the rehearsed sense is one of the robot, whatever the sign of its cameras."""
    example = case(name)
    model = example.truth.model
    wanted = example.plan.rotation_sense()[1]
    negative = model._replace(P=-model.P)
    one_negative = model._replace(P=model.P * np.array([1.0, -1.0])[:, None, None])
    for there in (
        in_frame(model, frame(1)),
        negative,
        one_negative,
        in_frame(negative, frame(2, mirrored=True)),
    ):
        assert example.planned(there).rotation_sense()[1] == pytest.approx(wanted, abs=1e-6)


SENSES = [
    ("paper", ("noise.servo_px=0.5",)),  # half a turn, either sense of which is rehearsed
    ("ur5", ("noise.servo_px=1", "control.features=points")),
    ("coupled", ("trajectory.profile=exponential",)),
]


@pytest.mark.parametrize(("name", "overrides"), SENSES)
def test_the_sense_is_that_of_the_whole_plan(name, overrides):
    config = configured(name, "trajectory.n_samples=11", *overrides)
    _, calibration, _ = calibrate.run(config)
    found = rotation_sense(scenario_of(config, calibration))
    assert np.array_equal(found, planning.run(config, calibration).rotation_sense())


@pytest.mark.parametrize(
    ("aside_m", "shift_px", "words"),
    [
        (0.0, 0.0, ""),
        (
            0.02,
            0.0,
            r"that 5 joints do not reach: the nearest, at joints .* deg, is [\d.]+ deg and [\d.]+ px rms",
        ),
        (0.0, 6.0, "fit no pose of the tool: .* as if the left image were shifted by"),
    ],
    ids=["reached", "aside", "one view"],
)
def test_goal_images_that_joints_do_not_reach_are_told_from_those_that_no_tool_shows(
    aside_m, shift_px, words
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
    if not words:
        assert planning.run(config, calibration).feasible
        return
    with pytest.raises(WorkFailed, match=words):
        planning.run(config, calibration)


@pytest.mark.parametrize(("face", "uneven"), [([0, 1, 2, 3], False), ([0, 1, 2, 7], True)])
def test_a_face_that_is_not_plane_is_said(face, uneven):
    config = configured("hobby", f"markers.face={face}", "noise.calibration_px=0.1")
    assert ("the face is not plane" in planning.run(config, calibrate.run(config)[1]).reason) == uneven
