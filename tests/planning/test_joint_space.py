"""Plans of the profiles joint_space and auto, and runs that follow them to the goal."""

from functools import lru_cache

import numpy as np
import pytest

from projservo_cli.calibration import predict
from projservo_cli.geometry.kinematics import forward_kinematics
from projservo_cli.records import flat_fields
from projservo_cli.simulation.random_tasks import random_tasks
from projservo_cli.task.target import followed
from projservo_cli.task.trajectory import planned
from tests.configured import calibrate, scenario_of, servo, truth_of
from tests.configured import plan as planning
from tests.known import configured, with_task

pytestmark = pytest.mark.volume
COUNT = 6


@lru_cache(maxsize=4)
def calibrated(name):
    """A configuration with joint limits that end a run, a calibration at 0.5 px, and random tasks."""
    config = configured(
        name, "plant.joint_limits=stop", "trajectory.profile=joint_space", "noise.servo_px=0.5"
    )
    truth, front = truth_of(config), np.array(config.task.start.values(config.joint_types))
    return config, calibrate.run(config)[1], random_tasks(truth, front, COUNT, np.random.default_rng(7))


@lru_cache(maxsize=16)
def guided(name, k, profile="joint_space"):
    """Configuration, calibration and plan of a random task."""
    config, calibration, tasks = calibrated(name)
    motion = config.trajectory.model_copy(update={"profile": profile})
    config = with_task(config, [q[k] for q in tasks], trajectory=motion)
    return config, calibration, planning.run(config, calibration)


@pytest.mark.parametrize("k", range(3))
@pytest.mark.parametrize("name", ["paper", "ur5"])
def test_a_random_task_is_planned_and_followed_to_its_goal(name, k):
    config, calibration, plan = guided(name, k)
    assert plan.feasible
    assert plan.profile == "joint_space"
    assert "joint space leads to " in plan.reason
    assert plan.n_goal_configurations >= 1
    assert np.isnan(plan.mu).all()
    assert (plan.margin > 0.0).all()
    assert (plan.border_distance > 0.0).all()
    assert (plan.joint_margin > 0.0).all()
    assert plan.s[-1] == pytest.approx(plan.s_star, abs=10.0)  # what the calibration is off there
    assert np.diff(plan.time) == pytest.approx(plan.duration / (len(plan.time) - 1))
    # The face is where it was measured at the start, carried by the calibrated joints.
    face = [calibration.marker.tolist().index(number) for number in config.markers.face]
    assert predict(calibration, plan.q)[:, :, face] == pytest.approx(plan.s, abs=8.0)
    for law in ("exact_track", "stacked_image_track"):
        trace = servo.run(config, calibration, plan, law)
        assert trace.verdict == "converged"
        assert trace.planned_s == plan.duration
        assert not trace.self_occluded.any()
        assert trace.first_beyond_limit == trace.first_outside_image == -1


def test_the_displacement_planned_at_a_time_is_that_of_the_joints():
    config, calibration, plan = guided("paper", 1)
    model, period = calibration.model(), config.control.period_s
    task = followed(model, scenario_of(config, calibration).ends.task(model), plan, period, 1.0)
    assert task.reference.A[-1] @ (
        forward_kinematics(model, plan.q[-1]) @ np.linalg.inv(forward_kinematics(model, plan.q[0]))
    ).T == pytest.approx(task.A_star, abs=1e-9)
    rows = task.reference.q
    for clock in (0.0, 3.25, 1e6):
        i = min(int(clock), len(rows) - 2)
        q = rows[i] + min(clock - i, 1.0) * (rows[i + 1] - rows[i])
        wanted = forward_kinematics(model, q) @ np.linalg.inv(forward_kinematics(model, rows[0]))
        found = np.array(planned(model, task.reference, clock)).reshape(4, 4)
        assert found == pytest.approx(wanted, abs=1e-9)


def test_auto_is_linear_to_the_bit_where_that_keeps_every_constraint():
    plans = []
    for profile in ("linear", "auto"):
        config = configured("paper", f"trajectory.profile={profile}")
        plans.append(planning.run(config, calibrated("paper")[1]))
    for field in flat_fields(type(plans[0])):
        np.testing.assert_array_equal(*(getattr(plan, field.name) for plan in plans), err_msg=field.name)


def test_auto_says_which_way_it_took_and_why_not_the_ones_before():
    """On these tasks each of the three ways, and every plan keeps what it promises."""
    taken = set()
    for name in ("paper", "ur5"):
        for k in range(COUNT):
            _, _, plan = guided(name, k, "auto")
            taken.add(plan.profile)
            assert plan.feasible
            before = {"linear": [], "constrained": ["linear"], "joint_space": ["linear", "constrained"]}
            assert [text.split(": ")[0] for text in plan.rejected_profiles] == before[plan.profile]
            assert (plan.n_goal_configurations is None) == (plan.profile != "joint_space")
    assert {"linear", "joint_space"} <= taken


def test_a_face_that_is_lost_for_long_is_found_on_the_way_back():
    """Waited for in 25 periods, then sought back along the path, and another way is taken from there."""
    config, calibration, plan = guided("ur5", 0)
    lost = {"lost_markers": {"from_step": 12, "steps": 30}}
    disturbed = config.model_copy(update={"disturbance": type(config.disturbance).model_validate(lost)})
    trace = servo.run(disturbed, calibration, plan, "exact_track")
    assert trace.verdict == "converged"
    assert trace.success
    assert trace.replan_attempts == 1
    assert "seen again on the path backwards" in trace.reason
    assert not trace.q_dot[12 : 12 + 25].any()
    there = np.linalg.norm(trace.q[37:43] - trace.q[0], axis=1)
    assert (np.diff(there) < 0.0).all()
