"""Goals on objects that move: led, judged where they are, given up in words, and handed over to the tool."""

import json
import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from projservo_cli.chain.outdated import steps_for
from projservo_cli.config.inputs import objects_of, servo_inputs
from projservo_cli.loop.goal_reach import GoalReach
from projservo_cli.loop.verdicts import JOINT_LIMIT, OUT_OF_REACH, OUT_OF_VIEW
from projservo_cli.messages import text
from projservo_cli.records import InputError
from projservo_cli.robots.session import Session
from projservo_cli.stages import plan as planning
from projservo_cli.stages.runs.run_trace import trace_of
from projservo_cli.stages.scenario import run_scenario
from projservo_cli.stages.servo import drive
from projservo_cli.store.run_file import Run
from projservo_cli.task.objects.moving_goal import Followed
from projservo_cli.task.objects.object_tracker import ObjectTracker
from tests.configured import calibrate, plan
from tests.conftest import ROOT
from tests.known import configured

NEAR = {"translation_m": [-0.02, -0.08, 0.0], "rotation_deg": [4.0, 5.0, 6.0]}
BELT = {"translation_mm_s": [0.0, 50.0, 0.0]}


def moving(velocity, *more, px=0.02, **part):
    """The part of the shipped configuration in motion, seen with little noise."""
    part = {"follow": True, "velocity": velocity, "displacement": NEAR} | part
    settings = (f"objects.part.{name}={json.dumps(value)}" for name, value in part.items())
    noise = (f"noise.calibration_px={px}", f"noise.servo_px={px}")
    return configured("object", "control.mode=[regulate]", *noise, *settings, *more)


@cache
def calibrated(*more):
    return calibrate.run(moving(BELT, *more))[1]


def driven(config, law="exact", calibration=None, session=None):
    """The run of a law."""
    calibration = calibration or calibrated()
    planned = plan.run(config, calibration)
    return drive(run_scenario(servo_inputs(config), calibration), planned, law, session=session)


def distances_mm(run):
    """Distances (k,) of the true centre of the face from the goal where it truly was, mm."""
    history = trace_of(run).of_goal
    center = trace_of(run).center
    return 1e3 * np.linalg.norm(history.goal_center - center, axis=1)


@pytest.mark.parametrize("law", ["exact", "direct_three", "incidences"])
@pytest.mark.parametrize("velocity", [BELT, {"rotation_deg_s": [0.0, 0.0, 10.0]}], ids=["belt", "turntable"])
def test_a_law_moves_along_with_its_goal(law, velocity):
    """Without a lead it would stay 20 mm behind a belt of 50 mm/s, and 14 mm at 80 mm from an axis, 10°/s."""
    run = driven(moving(velocity), law)
    trace = trace_of(run)
    assert (trace.verdict, trace.success) == ("followed", True), trace.reason
    # The error of the goal that was planned, 0.1 mm, and of a velocity known to 1 mm/s over 0.4 s.
    assert np.sqrt(np.mean(distances_mm(run)[-25:] ** 2)) < 0.7
    assert trace.position_error_mm < 1.0
    assert trace.followed_seconds == pytest.approx(2.0, abs=0.05)
    assert trace.followed_rms_mm <= trace.followed_max_mm < 1.5
    assert trace.followed_rms_deg < 0.3
    if velocity is BELT:
        assert trace.followed_speed_mm_s == pytest.approx(50.0, abs=1.0)
        assert trace.of_goal.goal_true_speed[1:] == pytest.approx(50.0, abs=1e-6)


BEHIND = NEAR | {"translation_m": [-0.02, -0.15, 0.0]}
TRACK = ("control.mode=[track]", "stop.max_steps=500", "control.joint_speed_limit_deg_s=60")


@pytest.mark.parametrize("profile", ["linear", "joint_space"])
def test_a_plan_leads_to_where_its_goal_will_be(profile):
    """The part is 100 mm from where it was planned first when the arm arrives, which stays with it."""
    run = driven(moving(BELT, *TRACK, f"trajectory.profile={profile}", displacement=BEHIND), "exact_track")
    trace, off = trace_of(run), distances_mm(run)
    assert (trace.verdict, trace.replan_attempts) == ("followed", 0), trace.reason
    arrived = np.flatnonzero(off < 20.0)[0]
    assert run.goal.periods[arrived].t < 1.8
    assert off[arrived:].max() < 20.0
    assert np.sqrt(np.mean(off[-25:] ** 2)) < 0.7


def test_a_plan_is_made_again_where_its_goal_will_be_elsewhere():
    """The part stops while the arm is under way, and moves on for 70 mm by the first estimate."""
    rows = [[0.0] * 7, [0.9, 0, 70, 0, 0, 0, 0], [1.0, 0, 74, 0, 0, 0, 0]]
    slow = (*TRACK[:2], "control.joint_speed_limit_deg_s=30")
    run = driven(moving(None, *slow, displacement=BEHIND, path=rows), "exact_track")
    trace = trace_of(run)
    assert trace.verdict == "followed", trace.reason
    assert trace.replan_attempts >= 1
    assert "the goal will be elsewhere than the plan had it" in trace.reason
    assert np.sqrt(np.mean(distances_mm(run)[-25:] ** 2)) < 0.7
    arrived = np.flatnonzero(distances_mm(run) < 4.0)[0]
    assert run.goal.since - arrived < 50  # the motion of the plan ends with it


def test_a_goal_that_no_plan_reaches_is_out_of_reach_before_the_arm_moves():
    away = {"translation_mm_s": [0.0, 300.0, 0.0]}
    run = driven(moving(away, *TRACK, max_acceleration=20000.0, displacement=BEHIND), "exact_track")
    assert run.verdict == "out of reach"
    assert "no plan leads to where the goal will be" in trace_of(run).reason
    np.testing.assert_array_equal(run.log.q_dot[: run.steps], 0.0)


def test_latency_is_compensated():
    """At two periods, 50 mm/s would put the goal 4 mm behind."""
    late = "disturbance.camera_latency_s=0.08"
    config = moving(BELT, late)
    run = driven(config, calibration=calibrated(late))
    assert run.verdict == "followed"
    assert np.sqrt(np.mean(distances_mm(run)[-25:] ** 2)) < 1.0


def test_the_lag_of_servos_is_led_too():
    """Servos that lag by 60 ms would stay 6 mm behind at 100 mm/s."""
    slow = "disturbance.servo_time_constant_s=0.06"
    back = NEAR | {"translation_m": [-0.02, -0.2, 0.0]}
    config = moving({"translation_mm_s": [0.0, 100.0, 0.0]}, slow, displacement=back, px=0.1)
    run = driven(config, calibration=calibrate.run(config)[1])
    assert run.verdict == "followed"
    assert np.sqrt(np.mean(distances_mm(run)[-25:] ** 2)) < 1.0


def test_sag_that_changes_on_the_way_leaves_no_error():
    """An arm that follows is never still: by the sag of its start it would stay 0.5 mm off."""
    sags = ("disturbance.gravity_sag_deg=1.0", "disturbance.servo_time_constant_s=0.05")
    run = driven(moving(BELT, *sags), calibration=calibrated(*sags))
    assert run.verdict == "followed"
    assert np.sqrt(np.mean(distances_mm(run)[-25:] ** 2)) < 0.3


def test_the_arm_slows_down_where_its_object_is_too_fast():
    run = driven(moving(BELT, max_speed_mm_s=30.0))
    assert run.verdict == "too fast"
    assert "its object moves at" in trace_of(run).reason
    speed = np.abs(run.log.q_dot[: run.steps]).max(axis=1)
    bound = run.driven.robot.bounds.limits.acceleration.max() * run.scenario.gains.period
    assert (np.diff(np.append(speed, 0.0)) > -1.001 * bound).all()


def test_a_goal_that_leaves_the_image_is_out_of_reach_before():
    run = driven(moving({"translation_mm_s": [0.0, 250.0, 0.0]}, "stop.max_steps=400"))
    trace = trace_of(run)
    assert (trace.verdict, trace.first_outside_image) == ("out of reach", -1), trace.reason
    assert "the goal leaves the image" in trace.reason or "farther than the joints reach" in trace.reason


def test_a_goal_that_leaves_the_reach_is_given_up_before():
    """The arm is stretched 1 s later: it stays with its goal up to then."""
    run = driven(moving({"translation_mm_s": [-100.0, 0.0, 0.0]}, "stop.follow_s=8"))
    trace = trace_of(run)
    assert (trace.verdict, trace.first_beyond_limit) == ("out of reach", -1)
    assert trace.reason == "in 1 s the goal is farther than the joints reach"
    assert trace.followed_max_mm < 2.0


def test_a_goal_of_incidences_may_be_reached_otherwise_than_as_it_was_taught():
    """Joints that show its pose are asked of a whole pose alone."""
    goal = SimpleNamespace(whole=False)  # has no joints
    now = Followed(0.0, np.eye(4), np.zeros((2, 4, 2)), (9.0, math.nan, math.nan), 0.1, 0.0, 0.0)
    assert GoalReach(goal, None, 0.4).found(0, np.zeros(6), now, 1.0) is None


def test_a_goal_that_goes_away_faster_than_the_arm_is_given_up():
    slow = ("control.joint_speed_limit_deg_s=4", "stop.max_steps=400")
    run = driven(moving(BELT, *slow))
    trace = trace_of(run)
    assert trace.verdict == "out of reach"
    assert "the goal goes away faster than the arm follows: its image error grew from" in trace.reason
    assert run.steps < 150


def test_a_joint_at_its_limit_and_a_face_that_left_an_image_are_named():
    run = driven(moving(BELT))
    run.log.events[2], still = 3, np.zeros(6)
    for verdict, words in ((JOINT_LIMIT, "joint 4 stands at its limit"), (OUT_OF_VIEW, "left an image")):
        assert run.goal.ruled(run.log, 9, verdict, still) == OUT_OF_REACH
        assert words in text([run.goal.reason], run.setup)


def test_a_goal_that_is_hidden_is_predicted_and_then_lost(monkeypatch):
    """Hidden for 0.4 s it is predicted; for longer than lost_s it is given up."""
    look = ObjectTracker.observe

    def hand_before_one_camera(self, t, s, *further, **named):
        look(self, t, np.where(t.max() > 2.0, s * [[[np.nan]], [[1.0]]], s), *further, **named)

    for seconds, verdict in ((0.4, "followed"), (9.0, "lost goal")):

        def covered(self, t, s, *further, hidden=seconds, **named):
            look(self, t, np.where(2.0 < t.max() < 2.0 + hidden, np.nan, s), *further, **named)

        monkeypatch.setattr(ObjectTracker, "observe", covered)
        run = driven(moving(BELT))
        assert run.verdict == verdict
        unseen = np.array([one.unseen_s for one in run.goal.periods])
        assert unseen.max() == pytest.approx(min(seconds, 0.5), abs=0.1)
        if verdict == "followed":
            assert distances_mm(run)[(unseen > 0.1)].max() < 3.0
    monkeypatch.setattr(ObjectTracker, "observe", hand_before_one_camera)
    run = driven(moving(BELT))
    assert (run.verdict, run.goal.covered) == ("followed", None)
    monkeypatch.setattr(ObjectTracker, "observe", covered)
    near = driven(moving(BELT, approach_mm=30.0))
    assert near.verdict == "lost goal"
    lost = next(one for one in near.goal.periods if one.unseen_s > 0.2)
    assert lost.error[1] < 30.0
    # Back as it came to its part, but for a tenth, from where the arm came to rest.
    trace, came = trace_of(near), [one.error[1] < 30.0 for one in near.goal.periods].index(True)
    relative = trace.center - trace.of_goal.goal_center
    at_rest = np.flatnonzero(np.abs(near.log.q_dot[:-1]).max(axis=1) == 0.0)[0]
    there = trace.center[at_rest] + relative[came - 1] - relative[at_rest]
    assert 1e3 * np.linalg.norm(trace.center[near.steps] - there) < 5.0
    assert near.steps < at_rest + 40


def test_a_view_that_shows_something_else_is_left_out_and_said(monkeypatch):
    """A like tag held before the left camera for 0.5 s, 10 px beside."""
    look = ObjectTracker.observe

    def held_before_it(self, t, s, *further, **named):
        off = 10.0 * (1.5 < t.max() < 2.0)
        look(self, t, s + np.array([off, 0.0])[:, None, None] * [[[1.0, 0.0]]], *further, **named)

    monkeypatch.setattr(ObjectTracker, "observe", held_before_it)
    run = driven(moving(BELT))
    assert run.verdict == "followed"
    assert "part, markers 40 to 47, is covered in the left image" in trace_of(run).reason
    assert np.sqrt(np.mean(distances_mm(run)[-25:] ** 2)) < 0.7


def test_an_arm_goes_on_while_it_acts_and_then_holds_the_part():
    with Session() as session:
        run = driven(moving(BELT), session=session)
        assert run.verdict == "followed"
        steps, before = len(run.goal.periods), run.goal.periods[-1].t
        session.hold(1.0)
        assert run.goal.periods[-1].t - before == pytest.approx(1.0, abs=0.05)
        after = [one.error[1] for one in run.goal.periods[steps:]]
        assert max(after) < 1.0  # mm, and the part went 50 mm on
        session.act("gripper", 1.0)
        assert (session.held, session.followed) == ({"gripper": "part"}, None)
        count = len(run.goal.periods)
        session.hold(0.2)
        assert len(run.goal.periods) == count  # it belongs to the tool


def test_an_arm_leaves_a_part_while_that_moves_on():
    """60 mm along the normal of the face, and along with the part."""
    joints = {"joints": [3.6575, -1.6783, -1.8493, 0.2776, 1.1568, 3.5344], "unit": "rad"}
    steps = [{"to": "there"}, {"retreat": {"along": "front", "by_m": 0.06}}]
    start = {"joints": [3.3575, -1.4783, -2.0493, 0.5776, 0.9568, 3.9344], "unit": "rad"}
    task = {"start": start, "goals": {"there": {"joints": joints, "on": "part"}}, "steps": steps}
    front = "features.front={on: tool, plane: [0, 1, 2]}"
    config, calibration = moving(BELT, front, f"task={json.dumps(task)}"), calibrated()
    with Session() as session:
        at_part = driven(config.at_step("there"), session=session)
        inputs = servo_inputs(config.at_step("retreat"))
        inputs = replace(inputs, plan=replace(inputs.plan, q_current=session.robot.read().q))
        planned = planning.run(inputs.plan, calibration)
        run = drive(run_scenario(inputs, calibration), planned, "exact", session=session)
        assert (at_part.verdict, run.verdict) == ("followed", "followed")
        assert session.followed.name == "part"
    trace, before = trace_of(run), trace_of(at_part)
    apart = trace.center[run.steps] - before.center[at_part.steps]
    along = 0.05 * (trace.of_goal.goal_time[run.steps] - before.of_goal.goal_time[at_part.steps])
    assert 1e3 * np.linalg.norm(apart - [0.0, along, 0.0]) == pytest.approx(60.0, abs=1.5)
    assert distances_mm(run)[run.steps] < 1.0
    assert trace.followed_motion == "belt"
    assert trace.followed_deviation_mm is None
    assert before.followed_deviation_mm > trace.followed_rms_mm


def test_a_pushed_part_ends_the_run():
    rows = [[0.0] * 7, [1.2, 0, 60, 0, 0, 0, 0], [1.24, 0, 90, 0, 0, 0, 0], [9.0, 0, 500, 0, 0, 0, 0]]
    run = driven(moving(None, path=rows))
    trace = trace_of(run)
    assert run.verdict == "object moved"
    assert "from where its motion would have taken it" in trace.reason
    # Of where it is then, nothing is known.
    unknown = trace.followed_deviation_mm, trace.followed_motion, trace.estimated_position_error_mm
    assert unknown == (None, None, None)


def test_each_law_is_driven_although_its_part_is_pushed(projservo, tmp_path):
    rows = [[0.0] * 7, [1.0] + 6 * [0.0], [1.04, 0, 100, 0, 0, 0, 0]]
    pushed = ("--set", "objects.part.velocity=null", "--set", f"objects.part.path={json.dumps(rows)}")
    answer = projservo("servo", "-c", ROOT / "configs/belt.yaml", "-o", tmp_path / "run", "--json", *pushed)
    assert answer.code == 1
    assert [law["verdict"] for law in answer.json["laws"]] == ["object moved"] * 2
    assert answer.err.count("must converge, but ended in object moved: the object part") == 2


def test_laws_and_tasks_that_cannot_follow_are_refused():
    with pytest.raises(InputError, match=r"stacked cannot follow objects\.part"):
        driven(moving(BELT), "stacked")
    with pytest.raises(
        InputError, match=r"control\.laws: stacked cannot follow objects\.part, .* name some of"
    ):
        steps_for(moving(BELT), Run(Path("run.h5")), ["servo"], laws=["exact", "stacked"])
    with pytest.raises(InputError, match=r"stop\.follow_s: is longer than a run"):
        moving(BELT, "stop.follow_s=100", "stop.max_steps=500")
    with pytest.raises(InputError, match="a goal is followed by regulate and track"):
        moving(BELT, "control.mode=[regulate, image_track]")
    with pytest.raises(InputError, match=r"led by 1/gain.*gain_s 1"):
        moving(BELT, "control.gain_s=1.0")
    with pytest.raises(InputError, match="gives its motion as velocity does"):
        moving(BELT, path=[[0.0] * 7, [1.0] * 7])
    with pytest.raises(InputError, match="its times must grow"):
        moving(None, path=[[0.0] * 7, [0.0] * 7])


def test_five_joints_follow_what_a_goal_leaves_open_by_the_law_of_incidences_alone():
    """Its other poses an arm of five joints cannot take along, so that it went a wrong way."""
    X = np.array([0.2, 0.0, 0.2]) + 0.03 * np.random.default_rng(1).standard_normal((6, 3))
    part = {"markers": [*range(40, 46)], "positions_m": X.tolist(), "follow": True, "velocity": BELT}
    features = {"tip": {"on": "tool", "point": [0]}, "spot": {"on": "part", "point": "tip"}}
    config = configured(
        "hobby",
        *(f"objects.part={json.dumps(part)}", f"features={json.dumps(features)}"),
        *("task.goal.incidences=[[tip, spot]]", "control.mode=[regulate]"),
    )
    with pytest.raises(InputError, match="5 joints are too few: incidences leaves open"):
        driven(config, calibration=calibrate.run(config)[1])


def test_an_object_moves_as_it_is_told():
    """Along its velocity, about its middle, and along rows, before and after which it rests."""
    (one,) = objects_of(moving({"translation_mm_s": [10.0, 0.0, 0.0], "rotation_deg_s": [0.0, 0.0, 30.0]}))
    middle, at_first = (one.X @ one.T.T).mean(axis=0), one.at(0.0)
    np.testing.assert_allclose(at_first, one.T, atol=1e-12)
    later = one.at(3.0) @ np.linalg.inv(one.T)
    np.testing.assert_allclose(later @ middle - middle, [0.03, 0.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(later[:3, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-9)
    (one,) = objects_of(moving(None, path=[[1.0, 0, 0, 0, 0, 0, 0], [2.0, 0, 100, 0, 0, 0, 0]]))
    shifts = [(one.at(t) @ np.linalg.inv(one.T))[1, 3] for t in (0.0, 1.5, 2.0, 9.0)]
    np.testing.assert_allclose(shifts, [0.0, 0.05, 0.1, 0.1], atol=1e-12)
