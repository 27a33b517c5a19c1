"""Tasks of incidences through plan, run and trace, and laws that state an error of their own."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from projservo_cli.findings import REFUSES, Finding
from projservo_cli.records import InputError, WorkFailed, changed
from projservo_cli.report.animation import motion_of
from projservo_cli.report.figure_inputs import REGISTER, Driven
from projservo_cli.report.figures.scene import features_in_space
from projservo_cli.simulation.ground_truth import plant_of
from projservo_cli.stages.runs.plugin_law import PluginLaw
from projservo_cli.stages.runs.run_trace import trace_of
from projservo_cli.stages.scenario import run_scenario
from projservo_cli.stages.servo import drive
from tests.configured import calibrate, plan, servo, servo_inputs, truth_of
from tests.known import configured


@cache
def made():
    """Configuration of the insertion, its calibration and plan."""
    config = configured("insertion")
    calibration = calibrate.run(config)[1]
    return config, calibration, plan.run(config, calibration)


def axis_and_tip(truth, H):
    """Both ends (2, 3) of the pin, in truth, at a displacement."""
    return (truth.of((10, 11)) @ H.T)[:, :3]


def seen_mm(trace):
    """What the images show of the errors, mm."""
    return np.sqrt(trace.incidence_mm**2 - trace.incidence_deviation_mm**2)


@pytest.mark.parametrize("law", ["exact_track", "incidences"])
def test_a_pin_goes_into_its_hole_and_the_rest_stays_free(law):
    """By trials at 0.5 px and images without noise: the pin within half a millimetre, in any turn."""
    config, calibration, planned = made()
    trace, truth = servo.run(config, calibration, planned, law), truth_of(config)
    assert (trace.verdict, trace.success, trace.free_dof) == ("converged", True, 1)
    assert trace.incidences == ("pin on hole", "tip on bottom")
    H = trace.pose[-1] @ np.linalg.inv(truth.robot.base_tool)
    q_goal = config.task.goal.joints.values(config.joint_types)
    ends, there = axis_and_tip(truth, H), axis_and_tip(truth, truth.displacement(q_goal))
    along = (there[1] - there[0]) / np.linalg.norm(there[1] - there[0])
    off = np.linalg.norm(np.cross(ends - there[0], along), axis=1).max()
    tip = np.linalg.norm(ends[1] - there[1])
    assert max(off, tip) < 0.5e-3
    # The nearest goal is as near as the pin is.
    assert trace.position_error_mm < 2e3 * max(off, tip)
    pin = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    deg = np.degrees(np.arccos(min(1.0, pin @ along)))
    assert deg < 0.2
    # As stated, within twice, and the images themselves show less.
    assert (np.array([off, tip]) < 2e-3 * trace.incidence_mm).all()
    assert deg < 2.0 * trace.incidence_deg[0] < 1.0
    assert trace.incidence_px[0].min() > 50.0 > 0.05 > trace.incidence_px[-1].max()
    assert seen_mm(trace).max() < 0.1 < trace.incidence_mm.max() < 0.5


def test_no_error_is_stated_by_images_that_contradict_the_calibration():
    """But of a tool that presses on something the images are as good as ever."""
    config, calibration, planned = made()
    run = drive(run_scenario(servo_inputs(config), calibration), planned, "exact_track")
    run.verdict, run.why = "fault detected", Finding("moved_camera", REFUSES)
    assert np.isnan(trace_of(run).incidence_mm).all()
    run.why = Finding("pressed", REFUSES, amount=31.0, limit=30.0, unit="N")
    assert np.isfinite(trace_of(run).incidence_mm).all()


@pytest.mark.parametrize("law", ["stacked", "euclidean_points"])
def test_laws_that_measure_points_go_to_a_pose_where_the_incidences_hold(law):
    """To that of the plan; they end above stop.image_error_px, which the errors of the calibration exceed."""
    config, calibration, planned = made()
    trace = servo.run(config, calibration, planned, law)
    assert trace.verdict == "no progress"
    assert trace.incidences == ("pin on hole", "tip on bottom")
    assert seen_mm(trace).max() < 0.2


def test_features_of_tool_and_scene_are_drawn_where_they_are():
    """In space within two millimetres; in the images, the film and the 3D view."""
    config, calibration, planned = made()
    trace, truth = servo.run(config, calibration, planned, "exact_track"), truth_of(config)
    q_start, q_goal = (
        ends.values(config.joint_types) for ends in (config.task.start, config.task.goal.joints)
    )
    plant = plant_of(truth, np.array(q_start), opaque=True)
    spanned = features_in_space(plant, {"": trace})
    assert spanned is not None
    for (pin, tip), q in zip(spanned, (q_start, q_goal), strict=True):
        there = axis_and_tip(truth, truth.displacement(np.array(q)))
        np.testing.assert_allclose(pin[:2], there, atol=2e-3)
        np.testing.assert_allclose(tip[0], there[1], atol=2e-3)
        assert np.isnan(tip[1:]).all()
    figure = REGISTER["fig19_incidences"]
    material = Driven(calibration, None, planned, {"exact_track": trace})
    assert not figure.lacking(material)
    drawn = figure.drawn(figure.data(material))
    assert "1 joint motion free" in drawn.axes[0].get_title()
    for axes in drawn.axes[: len(trace.view)]:
        assert sum(line.get_label().startswith("features of the ") for line in axes.lines) == 3
    assert drawn.axes[2].get_title().startswith("pin on hole\nwithin 0.")
    # A motion of a sequence has incidences of its own, and panels for them.
    approach = changed(trace, incidences=("pin on hole (back)", "tip on bottom (back)"))
    drawn = figure.drawn(figure.data(replace(material, traces={"exact_track": trace, "before": approach})))
    titles = [axes.get_title().split("\n")[0] for axes in drawn.axes[2:]]
    assert titles == [*trace.incidences, *approach.incidences]
    assert [len(axes.lines) for axes in drawn.axes[2:]] == [1, 1, 1, 1]
    # The free motion turns the face about the pin, in truth too, and as its images say.
    (free,), (velocity,) = trace.free_motion, trace.free_s
    ends = [trace.q[-1] + by * free for by in (-0.01, 0.01)]
    before, after = (axis_and_tip(truth, truth.displacement(q)) for q in ends)
    assert np.linalg.norm(after - before, axis=1).max() < 0.2e-3
    before, after = (truth.images(q, truth.M_face) for q in ends)
    assert np.linalg.norm((after - before) / 0.02 - velocity, axis=-1).max() < 0.05 * np.abs(velocity).max()
    motion = motion_of(truth.robot, plant, truth.M, planned, {"exact_track": trace})
    last = motion.runs["exact_track"].features[-1]
    assert np.nanmax(np.abs(last - motion.features)) < 2e-3


def test_incidences_that_contradict_each_other_are_refused_by_their_names():
    config, calibration, _ = made()
    goal = config.task.goal.model_copy(update={"incidences": (("pin", "hole"), ("pin", "hole", 40.0))})
    config = config.model_copy(update={"task": config.task.model_copy(update={"goal": goal})})
    with pytest.raises(
        WorkFailed, match="pin on hole and pin at 40° to hole contradict each other: wherever"
    ):
        plan.run(config, calibration)


def test_without_a_body_to_measure_with_incidences_are_refused():
    config, calibration, _ = made()
    with pytest.raises(WorkFailed, match="incidences are measured with the body"):
        plan.run(config, changed(calibration, usable=False))


class Own:
    """Law that stands still and states how far a joint is from a value."""

    tolerance = 0.5

    def __call__(self, s, q):
        return np.zeros_like(q)

    def error(self, s, q):
        return 0.25 + abs(s).sum() * 0.0


def test_a_law_that_states_an_error_is_judged_by_it():
    law = PluginLaw(Own(), "law own", 2, image_error_px=0.2)
    law(np.zeros((2, 4, 2)), np.zeros(6))
    assert law.face_px[0] == pytest.approx(0.2 * 0.25 / 0.5)
    wrong = Own()
    wrong.tolerance = -1
    with pytest.raises(InputError, match=r"law own: has error\(s, q\) and tolerance -1: make it a positive"):
        PluginLaw(wrong, "law own", 2)
