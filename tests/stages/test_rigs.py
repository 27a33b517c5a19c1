"""Rigs of one to four cameras with any names, on the wall and on the tool, from trials to the goal."""

import json
from functools import cache

import numpy as np
import pytest

from projservo_cli.calibration import predict
from projservo_cli.config.inputs import report_inputs
from projservo_cli.experiment import plan_scene_of
from projservo_cli.records import InputError, WorkFailed
from projservo_cli.report import figures
from projservo_cli.simulation.arm import camera_center
from projservo_cli.stages.report import comparison_of, metric_plan
from tests.configured import calibrate, plan, scenario_of, servo, truth_of
from tests.known import configured

ARM = configured("ur5")
LEFT, RIGHT = (
    json.loads(ARM.rig.cameras[name].model_dump_json(exclude_none=True)) for name in ("left", "right")
)
START = list(ARM.calibration.reference.joints)
BASE_TOOL = truth_of(ARM).robot.base_tool
# Where the scene is that cameras on the tool look at: half a metre before it, facing it.
SCENE = BASE_TOOL @ np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0.5], [0, 0, 0, 1]])


def looking(position, target, up=(0.0, 0.0, 1.0)):
    """A camera of 1000 px at a place that looks at another, m."""
    place = {"position_m": list(position), "target_m": list(target), "up": list(up)}
    return {"focal_px": [1000, 1000], "principal_point_px": [639.5, 511.5]} | place


def eye(x):
    """A camera beside the tool that looks where it points."""
    return looking([x, 0.08, 0.0], [0.0, 0.0, 0.5], [0.0, 1.0, 0.0])


LEFT_EYE, RIGHT_EYE = (np.array(camera_center(P)) for P in truth_of(ARM).P)
ABOVE = looking(0.5 * (LEFT_EYE + RIGHT_EYE) + [0.0, 0.0, 0.5], [0.5, 0.12, 0.45])
BEHIND = looking([-1.0, 0.5, 0.9], [0.5, 0.12, 0.45])
RIGS = {
    "one": {"webcam": LEFT},
    "three": {"left": LEFT, "right": RIGHT, "top": ABOVE},
    "four": {"left": LEFT, "right": RIGHT, "top": ABOVE, "back": BEHIND},
    "hand": {"mount": "tool", "left": eye(-0.06), "right": eye(0.06)},
    "eye": {"mount": "tool", "cam_1": eye(0.03)},
}


def rigged(name, *keys):
    """The UR5 before a rig, with a task of about 120 degrees."""
    rig = {"image_size_px": [1280, 1024]} | RIGS[name]
    task = {"start": {"joints": START, "unit": "rad"}, "goal": {"roll_deg": 120}}
    mine = [f"rig={json.dumps(rig)}", "control.joint_speed_limit_deg_s=125", "trajectory.profile=auto"]
    if "mount" in rig:
        points = (np.c_[ARM.markers.points, np.ones(len(ARM.markers.points))] @ SCENE.T)[:, :3]
        mine += [f"markers.positions_m={points.tolist()}", "calibration.amplitude_deg=20"]
        task["start_offset"] = {"joints": [0.05, -0.04, 0.06, 0.05, -0.05, 0.1], "unit": "rad"}
    else:
        task = json.loads(ARM.task.model_dump_json(exclude_none=True))
    if name == "four":
        mine += ["trajectory.visible_views=2"]
    return configured("ur5", *mine, f"task={json.dumps(task)}", "calibration.random_poses=12", *keys)


@cache
def chain(name):
    """Configuration, calibration and plan of a rig, made once."""
    config = rigged(name)
    calibration = calibrate.run(config)[1]
    return config, calibration, plan.run(config, calibration)


@pytest.mark.parametrize("rig", ["one", "four", "hand", "eye"])
def test_the_arm_arrives_by_any_rig(rig):
    config, calibration, made = chain(rig)
    truth = truth_of(config)
    assert calibration.usable
    assert made.view == calibration.view == truth.view
    assert made.feasible, made.reason
    assert made.margin.shape[1] == len(truth.view)
    assert len(figures.of_plan(made, plan_scene_of(config, calibration)).axes) == len(truth.view) + 3
    for law in ("exact_track", "direct_two"):
        trace = servo.run(config, calibration, made, law)
        assert (trace.verdict, trace.view) == ("converged", truth.view), trace.reason
        assert trace.s.shape[1] == len(truth.view)
        # Images end a hundredth of a pixel from the goal, about 15 µm at a metre and a half.
        assert trace.position_error_mm < 0.1
        assert trace.rotation_error_deg < 0.02


def test_one_camera_on_the_hand_starts_from_small_trials_of_single_joints():
    """They hardly show the depth of the scene."""
    config = rigged(
        "eye", "calibration={amplitude_deg: 12, random_poses: 0, seed: 1}", "noise.calibration_px=0.5"
    )
    assert calibrate.run(config)[1].usable


@pytest.mark.parametrize("rig", ["four", "hand"])
def test_a_plan_through_joint_space_keeps_what_it_asks_of_the_views(rig):
    config, calibration, _ = chain(rig)
    made = plan.run(rigged(rig, "trajectory.profile=joint_space"), calibration)
    assert made.feasible, made.reason
    truth, least = truth_of(config), scenario_of(config, calibration).world.min_views
    for q in made.q:
        s = truth.images(q, truth.M_face)
        size = truth.image_size[:, None]
        shown = ((s > -0.5) & (s < size - 0.5)).all(axis=(1, 2))
        assert shown.sum() >= least


def test_the_textbook_law_of_one_camera_goes_small_ways():
    """Its Jacobian is that of the body's pose; at half a turn it fails, where the direct laws arrive."""
    config, calibration, made = chain("one")
    goal = np.array(config.task.goal.joints.joints)
    near = rigged("one", f"task.start={json.dumps({'joints': (goal + 0.04).tolist(), 'unit': 'rad'})}")
    short = servo.run(near, calibration, plan.run(near, calibration), "stacked")
    assert short.verdict == "converged", short.reason
    assert servo.run(config, calibration, made, "stacked").verdict != "converged"


@pytest.mark.parametrize("rig", ["one", "eye"])
def test_extra_runs_of_a_report_measure_the_body_where_points_need_two_views(rig):
    config, calibration, made = chain(rig)
    bench = comparison_of(report_inputs(config).extra, calibration, made)
    for operators in bench.models:
        trace = bench.run("direct_two", operators, bench.scenario.gains, limited=True)
        assert (trace.verdict, trace.features) == ("converged", "body"), trace.reason
    assert metric_plan(bench).theta_r == pytest.approx(made.theta_r, abs=0.01)


def test_the_order_of_views_changes_nothing_but_their_order():
    """Directions, margins and runs of the true model, to round-off."""
    three = {"left": LEFT, "right": RIGHT, "top": ABOVE}
    found = []
    for names in (("left", "right", "top"), ("top", "left", "right")):
        rig = {"image_size_px": [1280, 1024]} | {f"cam_{name}": three[name] for name in names}
        config = rigged(
            "three", f"rig={json.dumps(rig)}", "noise.calibration_px=0", "trajectory.profile=linear"
        )
        calibration = calibrate.run(config)[1]
        made = plan.run(config, calibration)
        trace = servo.run(config, calibration, made, "exact")
        order = [trace.view.index(f"cam_{name}") for name in sorted(three)]
        q = trace.q[:40]
        found.append((predict(calibration, q)[:, order], made.margin[:, order], trace.s[:40, order], q))
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-5 * np.abs(one).max())


def test_cameras_around_ask_for_as_many_views_as_they_have():
    """One looks from behind the arm: all four never see the face, two do."""
    config, calibration, made = chain("four")
    assert made.feasible
    strict = rigged("four", "trajectory.visible_views=all")
    with pytest.raises(WorkFailed, match=r"the back camera sees one side|not in front"):
        plan.run(strict, calibration)
    with pytest.raises(InputError, match=r"trajectory.visible_views: 5, of 4 views: set 4 or all"):
        plan.run(rigged("four", "trajectory.visible_views=5"), calibration)
    assert servo.run(config, calibration, made, "exact").success


def test_what_a_rig_cannot_do_is_told():
    calibration = chain("one")[1]
    with pytest.raises(InputError, match=r"control\.features: points are measured from two views"):
        plan.run(rigged("one", "control.features=points"), calibration)
    drawn = "trajectory.keep_out=[{left: [[0, 0], [9, 0], [9, 9]]}]"
    with pytest.raises(InputError, match=r"left is no view; the views are webcam"):
        plan.run(rigged("one", drawn, "control.mode=track"), calibration)
    with pytest.raises(InputError, match=r"trajectory\.keep_out: are regions of fixed images"):
        rigged("hand", drawn, "control.mode=track")
    with pytest.raises(InputError, match=r"the calibration is of webcam .mount world., and the rig"):
        plan.run(rigged("eye"), calibration)
    with pytest.raises(InputError, match="rig: has no camera"):
        rigged("one", "rig={image_size_px: [640, 480]}")
    with pytest.raises(InputError, match="is no name of a camera"):
        rigged("one", f"rig={json.dumps({'image_size_px': [640, 480], 'Left Eye': LEFT})}")
