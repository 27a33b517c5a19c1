"""Servo and record with robots and laws of others, on the command line."""

from dataclasses import replace
from pathlib import Path

import click
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import projservo_cli as ps
from projservo_cli.config import Override, load_config
from projservo_cli.records import changed
from projservo_cli.stages import report
from projservo_cli.store.run_file import load, save
from tests.configured import scenario_of
from tests.robots import robots
from tests.robots.robots import CALLS

pytestmark = pytest.mark.volume  # a calibration and many steps

UR5 = Path(__file__).parents[2] / "configs" / "ur5.yaml"
HERE = "tests.robots.robots"
OPTIONS = f"options: {{config: {UR5}"
NEAR = ["--set", "task.goal.joints.joints=[3.66, -1.68, -1.65, 0.28, 1.26, 3.43]"]
GAINS = (f"control.gain{name}=8" for name in ("", "_t", "_r", "_p", "_s"))
# From where the arm stands to a goal beside it, in some thirty steps.
QUICK = [*NEAR, "--set", "task.start=current", *(word for gain in GAINS for word in ("--set", gain))]
START = ["--set", "task.start={joints: [3.5, -1.68, -1.85, 0.28, 1.2, 3.5], unit: rad}"]
SOUND = ["--set", f"plant={{use: '{HERE}:Sound', {OPTIONS}}}}}"]


def faulty(fault, after=0, **more):
    settings = "".join(f", {name}: {value}" for name, value in more.items())
    return ["--set", f"plant={{use: '{HERE}:Faulty', {OPTIONS}, fault: {fault}, after: {after}}}{settings}}}"]


def commands():
    return [call for call in CALLS if isinstance(call, tuple)]


def test_a_robot_of_others_reaches_the_goal_as_the_simulated_one_does(servo):
    answer = servo(*SOUND, "--json")
    assert answer.code == 0, answer.err
    (told,) = answer.json["laws"]
    assert told["verdict"] == "converged"
    assert [told[name] for name in ("position_error_mm", "rotation_error_deg", "center_deviation_mm")] == [
        None
    ] * 3
    trace = load("run").traces["direct_three"]
    # True goal: that of the configuration, less what the calibration mispredicts there.
    truth = robots.Sound(UR5).world.robot
    goal = truth.pose(np.array([4.143219, -2.507909, -1.233571, 2.549498, 1.251226, 3.700267]))
    reached = truth.pose(trace.q[-1])
    assert 1e3 * np.linalg.norm(reached[:3, 3] - goal[:3, 3]) < 5.0
    assert np.isnan(trace.pose).all()
    assert servo("--set", "noise.servo_px=0.5", "--json", "--force").json["laws"][0][
        "steps"
    ] == pytest.approx(told["steps"], abs=25)


@pytest.mark.parametrize("joints", ["true", "false"])
def test_a_robot_that_tells_its_truth_is_told_how_far_off_it_is(servo, joints):
    told = f"plant={{use: '{HERE}:Telling', {OPTIONS}, joints: {joints}}}}}"
    answer = servo("--set", told, *QUICK, "--json")
    (law,) = answer.json["laws"]
    trace, arm = load("run").traces["direct_three"], robots.Sound(UR5).world.robot
    pose, goal = arm.pose(trace.q[-1]), arm.pose(np.array([3.66, -1.68, -1.65, 0.28, 1.26, 3.43]))
    np.testing.assert_allclose(trace.pose[-1], pose, atol=1e-12)
    np.testing.assert_allclose(trace.goal_pose, goal, atol=1e-12)
    assert 0.0 < law["position_error_mm"] < 5.0
    assert law["position_error_mm"] == pytest.approx(1e3 * np.linalg.norm(pose[:3, 3] - goal[:3, 3]))
    turn = Rotation.from_matrix(pose[:3, :3].T @ goal[:3, :3]).magnitude()
    assert law["rotation_error_deg"] == pytest.approx(np.degrees(turn))
    assert law["success"] is None


def test_every_command_keeps_the_limit_and_the_robot_is_stopped_last(servo):
    assert servo(*SOUND, "-q", "--set", "stop.max_steps=20", law="exact").code == 1
    speeds = np.array([np.abs(sent.step).max() / sent.period for sent in commands()])
    assert speeds.max() == pytest.approx(np.radians(125.0))
    assert [call for call in CALLS if call in ("open", "stop", "close")] == ["open", "stop", "close"]
    assert CALLS[-2:] == ["stop", "close"]
    moved = next(i for i, call in enumerate(CALLS) if isinstance(call, tuple))
    assert CALLS[:moved].count("read") == 4  # nothing moves before the images were seen to fit


def test_speed_scale_scales_every_command(servo):
    given = [*SOUND, *NEAR, *START]
    given += [f"--set=control.gain_{name}=4" for name in "trps"]
    assert servo(*given, "-q").code == 0
    whole, trace = commands(), load("run").traces["direct_three"]
    assert servo(*given, "--speed-scale", "0.25", "-q").code == 0
    quarter, slow = commands(), load("run").traces["direct_three"]
    assert load("run").configuration.count("speed_scale: 0.25") == 1
    np.testing.assert_allclose(quarter[0].step, 0.25 * whole[0].step, rtol=1e-12)  # to the start of the task
    assert slow.steps > 3 * trace.steps
    limit = np.radians(125.0) * 0.04
    assert max(np.abs(sent.step).max() for sent in quarter) <= 0.25 * limit * (1 + 1e-12)
    few = ["-q", "--set", "stop.max_steps=1"]
    assert servo(*few).code == 1  # the simulated robot too
    simulated = load("run").traces["direct_three"]
    assert servo("--speed-scale", "0.5", *few).code == 1
    np.testing.assert_array_equal(load("run").traces["direct_three"].q_dot[0], 0.5 * simulated.q_dot[0])


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("raises", r"read() failed: OSError: camera 2 is unplugged (robots.py:"),
        ("command raises", "command() failed: RuntimeError: protective stop"),
        ("hangs", "read() did not return within 0.5 s"),
        ("zeros", "markers of the left view at the same pixel, (0, 0): NaN stands for unseen"),
    ],
)
def test_a_robot_that_fails_ends_the_run_in_one_line_and_no_other_law_drives_it(servo, fault, message):
    answer = servo(*faulty(fault, 17, timeout_s=0.5), *QUICK, "--law", "exact", "--json")
    assert answer.code == 1
    assert [told["law"] for told in answer.json["laws"]] == ["direct_three"]
    assert answer.json["laws"][0]["verdict"] == "failed"
    assert answer.json["failed"] == "servo/direct_three"
    assert answer.err.splitlines()[-1].startswith(
        "projservo: servo/direct_three: plant tests.robots.robots:Faulty"
    )
    assert message in answer.err
    assert CALLS.count("stop") == 1
    assert "Traceback" not in answer.err
    trace = load("run").traces["direct_three"]  # what was known until then
    assert trace.verdict == "failed"
    assert message in trace.reason
    assert len(trace.q) == trace.steps + 1 == len(trace.q_dot) + 1
    assert trace.steps > 10
    assert np.isfinite(trace.q[:-1]).all()
    assert np.isfinite(trace.s[:-1]).all()
    # What was not measured any more is unknown; a command that fails comes after the images.
    assert np.isfinite(trace.s[-1]).all() == fault.startswith("command")


def test_ctrl_c_stops_the_robot_and_keeps_the_trace(servo):
    answer = servo(*faulty("interrupted", 17), *QUICK, "--law", "exact")
    assert answer.code == 130
    assert CALLS[-2:] == ["stop", "close"]
    assert commands()
    (trace,) = load("run").traces.values()
    assert (trace.law, trace.verdict, trace.reason) == (
        "direct_three",
        "interrupted",
        f"interrupted at step {trace.steps}",
    )
    assert trace.steps > 10
    assert np.isfinite(trace.q[:-1]).all()
    # It is no result: the same command drives the law again.
    again = servo(*faulty("none", 10**6), *QUICK, "--json")
    assert again.json["laws"][0]["verdict"] != "interrupted"


def test_a_plan_that_cannot_be_followed_drops_no_run_of_a_robot(servo, projservo):
    assert servo(*SOUND, *QUICK).code == 0
    before = load("run").traces["direct_three"].q
    shut = ["trajectory.profile=constrained", "trajectory.border_px=400"]
    sets = [word for one in shut for word in ("--set", one)]
    answer = projservo("plan", "-c", UR5, "-o", "run", *SOUND, *QUICK, *sets)
    assert answer.code == 1
    assert "not stored, since a robot was driven for servo/direct_three" in " ".join(answer.err.split())
    np.testing.assert_array_equal(load("run").traces["direct_three"].q, before)
    apart = projservo("plan", "-c", UR5, "-o", "other", *SOUND, *QUICK, *sets)
    assert "not stored" not in apart.err


@pytest.mark.parametrize(
    ("fault", "culprit"),
    [
        ("bumped camera", "the left camera was moved"),
        ("frozen readings", "the reading of all joints stands still"),
    ],
)
def test_a_disturbance_ends_the_run_with_what_moved(servo, fault, culprit):
    answer = servo(*faulty(fault, 15), "--set", "task.start=current", "--json", law="exact")
    assert answer.code == 1
    (told,) = answer.json["laws"]
    assert told["verdict"] == "fault detected"
    assert culprit in told["reason"]
    assert culprit in answer.err
    started = sum(1 for call in CALLS if call == "read") - told["steps"] - 1
    assert told["steps"] <= 15 - started + 8  # the third observation in a row, a few more for what is small
    assert CALLS[-2:] == ["stop", "close"]


def test_a_run_stops_beyond_a_force_that_a_robot_tells(servo):
    pressing = f"plant={{use: '{HERE}:Pressing', {OPTIONS}}}}}"
    answer = servo("--set", pressing, *QUICK, "--set", "stop.max_force_n=8", "--json")
    (told,) = answer.json["laws"]
    assert (answer.code, told["verdict"]) == (1, "fault detected")
    assert "pressed with 8.5 N, beyond the 8 N of stop.max_force_n" in told["reason"]
    force = load("run").traces["direct_three"].force
    assert force is not None
    assert np.nanmax(force[:-1]) <= 8.0 < force[-1]
    assert CALLS[-2:] == ["stop", "close"]
    answer = servo(*SOUND, "--set", "stop.max_force_n=40")
    assert answer.code == 2
    assert "has no force()" in answer.err
    assert not commands()


def test_nothing_moves_where_the_images_do_not_fit_from_the_start(servo):
    answer = servo(*faulty("bumped camera"))
    assert answer.code == 1
    assert "the robot did not move, since at the start images are" in answer.err
    assert commands() == []
    assert CALLS[-2:] == ["stop", "close"]
    untested = ["--set", "stop.innovation_threshold=0", "--set", "stop.max_steps=3"]
    answer = servo(*faulty("bumped camera"), *untested, "--json")
    assert answer.json["laws"][0]["untested"] == "stop.innovation_threshold is 0"
    assert answer.json["laws"][0]["success"] is None  # nobody knows the truth
    assert commands()


@pytest.mark.parametrize(
    ("fault", "dark", "tested"),
    [("lost", "neither camera shows a marker", True), ("blind", "the left camera shows no marker", False)],
)
def test_without_an_image_nothing_moves_unless_that_is_asked_for(servo, fault, dark, tested):
    sets = [*NEAR, "--set", "stop.max_steps=10"]
    sets += [] if tested else ["--set", "stop.innovation_threshold=0"]
    answer = servo(*faulty(fault), *sets, "--json", law="exact")
    assert answer.code == 1
    assert dark in answer.json["reason"]
    assert "--blind" in answer.json["reason"]
    if fault == "lost":  # one camera alone still tells whether the way to the start may be driven
        begun = robots.Sound(UR5).q
        assert all((sent.target == begun).all() for sent in commands())
    told = servo(*faulty(fault), *sets, "--json", "--blind", law="exact").json["laws"][0]
    assert dark in told["untested"]


def test_joint_limits_end_a_run_whatever_is_configured(calibrated):
    use = f"plant={{use: '{HERE}:Sound', joint_limits: report}}"
    config = load_config(UR5, [use, "noise.servo_px=0.1"])
    calibration = load(calibrated).calibration
    scenario = scenario_of(config, calibration)
    gains, limits = scenario.gains, scenario.termination
    assert limits.stop_at_joint_limit
    assert limits.image_error_px == 0.01 + 2.0 * calibration.sigma_fitted_px
    np.testing.assert_array_equal(gains.limits.speed, np.full(6, np.radians(125.0)))


@pytest.mark.parametrize(
    ("law", "code", "message"),
    [
        ("exact --set control.joint_speed_limit_deg_s=null", 2, "set control.joint_speed_limit_deg_s"),
        (
            f"{HERE}:Wrong",
            1,
            "law tests.robots.robots:Wrong: gave (1.0, 2.0): expected 6 finite joint velocities",
        ),
        (f"{HERE}:Raising", 1, "failed: IndexError: list index out of range (robots.py:"),
        (f"{HERE}:Nobody", 2, "tests.robots.robots has no Nobody"),
    ],
)
def test_a_law_that_fails_or_lacks_a_limit(servo, law, code, message):
    law, *more = law.split()
    answer = servo(*SOUND, *QUICK, *more, law=law)
    assert answer.code == code
    assert message in answer.err
    assert "Traceback" not in answer.err
    assert code == 1 or commands() == []


@pytest.mark.parametrize(("answered", "code"), [("y", 0), ("n", 130), ("", 130)])
def test_confirm_asks_before_the_first_motion(servo, monkeypatch, answered, code):
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    asked = []

    def answer_it(prompt):
        asked.append((prompt, len(commands())))
        return answered

    monkeypatch.setattr(click.termui, "visible_prompt_func", answer_it)
    answer = servo(*SOUND, *QUICK, "--confirm", "--speed-scale", "0.5")
    assert answer.code == code
    ((_, moved),) = asked
    assert moved == 0
    assert ("servo will move tests.robots.robots:Sound, speeds times 0.5" in answer.err) or asked[0][0]
    assert bool(commands()) == (code == 0)


def test_a_report_never_moves_a_robot(servo, projservo):
    CALLS.clear()
    answer = projservo("report", "-c", UR5, "-o", "run", *SOUND)
    assert answer.code == 2
    assert "which moves tests.robots.robots:Sound: run projservo servo first" in answer.err
    assert CALLS == []


def test_a_real_robot_moves_whenever_it_is_asked_to_and_a_report_shows_what_is_stored(
    servo, projservo, monkeypatch
):
    monkeypatch.setattr(report, "_draw_all", lambda *_: [])
    asked = servo(*faulty("bumped camera", 15), *QUICK, "--json")
    assert (asked.code, asked.json["laws"][0]["verdict"]) == (1, "fault detected")
    for call in range(2):  # what is wrong is mended, and nothing else is said about it
        CALLS.clear()
        again = servo(*SOUND, *QUICK, *START, "--json")
        assert (again.code, again.json["laws"][0]["verdict"]) == (0, "converged"), call
        assert len(commands()) > 10
    dry = servo(*SOUND, *QUICK, *START, "-n", "--json").json["steps"]
    assert [step["stage"] for step in dry if step["why"]] == ["servo"]
    sent = len(CALLS)
    laws = ["--set", "control.laws=[direct_three]"]
    shown = projservo("report", "-c", UR5, "-o", "run", *SOUND, *QUICK, *START, *laws, "--json")
    assert shown.code == 0, shown.err
    (stored,) = shown.json["replayed"]
    date = load("run").results["servo/direct_three"].provenance["date"]
    assert stored == {"law": "direct_three", "plant": "tests.robots.robots:Sound", "date": date}
    assert f"the stored run of tests.robots.robots:Sound, recorded {date}" in shown.err.replace("\n", " ")
    assert len(CALLS) == sent
    config = load_config(UR5, [Override.parse(text) for text in (SOUND[1], *QUICK[1::2], START[1])])
    ps.Experiment(config, "run", progress=False).make("servo", laws=["direct_three"])
    assert CALLS.count("open") == 1  # of a new object


def test_images_that_stop_agreeing_on_the_path_to_the_start_stop_the_robot_there(servo):
    answer = servo(*faulty("bumped camera", 20), *NEAR)
    assert answer.code == 1
    last = answer.err.splitlines()[-1]
    assert last.startswith(
        "projservo: servo/direct_three: stopped on the path to the start, since images are "
    )
    assert "the left camera was moved" in last
    assert 17 <= len(commands()) <= 25  # no farther than what it takes to be sure
    assert CALLS[-2:] == ["stop", "close"]
    assert "direct_three" not in load("run").traces


def test_a_calibration_that_is_not_usable_drives_no_robot(servo):
    run = load("run")
    made = run.results["calibrate"]
    spoiled = dict(made.records, calibration=changed(run.calibration, usable=False))
    save(replace(run, results={"calibrate": replace(made, records=spoiled)}))
    answer = servo(*SOUND, *NEAR)
    assert answer.code == 1
    assert "the calibration is not usable, and no robot is driven with it: calibrate again" in answer.err
    assert not commands()
