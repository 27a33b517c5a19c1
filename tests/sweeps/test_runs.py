"""Rows of a sweep against the ordinary stages: every run redone by itself is its row, to the bit."""

import math

import numpy as np
import pytest

from projservo_cli.records import WorkFailed
from projservo_cli.sweeps.design import name_of_run
from projservo_cli.sweeps.runs import Part, run_part
from tests.configured import calibrate, plan, servo, truth_of
from tests.stages.test_rigs import BEHIND
from tests.sweeps.cases import design

# Of each case every run is redone.
CASES = {
    "laws": {"grid": {"law": ["direct_three", "exact", "exact_track", "euclidean_points"]}, "runs": 1},
    "points": {
        "set": {"control.features": "points"},
        "runs": 2,
        "random": {"control.gain_s": {"uniform": [1, 3]}},
    },
    "late images": {
        "set": {
            "disturbance.camera_latency_s": 0.08,
            "stop.max_steps": 20,
            "calibration.frames_per_joint": 3,
            "calibration.random_poses": 6,
        },
        "grid": {"law": ["direct_two"]},
        "runs": 1,
    },
    "constrained": {"set": {"trajectory.profile": "constrained"}, "runs": 1, "between_samples": True},
    "python loop": {"set": {"plant.speed_scale": 0.5, "stop.max_steps": 10}, "runs": 1},
    "half turn": {"base": "paper", "runs": 2, "set": {"noise.calibration_px": 0.5}},
    "tasks": {
        "tasks": {"random": 4, "rotation_deg": [60, 90]},
        "set": {
            "noise.servo_px": 0.3,
            "noise.tail_dof": 3,
            "noise.outlier_share": 0.02,
            "rig.left.lens": [-0.1, 0.01],
        },
        "grid": {"law": ["direct_two"]},
        "runs": 4,
    },
    "listed tasks": {
        "tasks": {"listed": [{"goal": {"roll_deg": 30}}, {"goal": {"roll_deg": 60}}]},
        "grid": {"law": ["direct_two"]},
        "runs": 2,
    },
    "a camera that sees little": {
        "set": {"rig.back": BEHIND, "trajectory.visible_views": 2},
        "tasks": {"random": 2},
        "grid": {"law": ["direct_two"]},
        "runs": 2,
    },
}
# Columns of the name of a field of the trace.
SAME = {
    *("position_error_mm", "rotation_error_deg", "path_length_mm", "effort", "steps", "success"),
    *("self_occluded_steps_left", "self_occluded_steps_right", "self_occluded_steps_back"),
    *("first_outside_image", "first_beyond_limit", "speed_limited_steps", "visibility_limited_steps"),
    *("center_deviation_at_samples_mm", "center_deviation_mm"),
}


def part_of(found):
    """A part with all it needs."""
    calibrations = {}
    for key, config in found.calibrations():
        try:
            calibrations[key] = calibrate.run(config)[1]
        except WorkFailed:
            calibrations[key] = None
    return Part(found, 0, found.total, calibrations)


@pytest.mark.volume
@pytest.mark.parametrize("name", CASES)
def test_every_run_redone_by_the_stages_is_its_row(name):
    found = design(**CASES[name])
    part = part_of(found)
    made = run_part(part)
    for i in range(found.total):
        config = found.config(i)
        cell, _, number, _ = found.numbers(i)
        calibration = part.calibrations[found.calibration_key(cell, number)]
        trace = servo.run(config, calibration, plan.run(config, calibration), name_of_run(config))
        row = {column: values[i] for column, values in made.columns.items()}
        assert row["verdict"].decode() == trace.verdict
        assert row["seed"] == config.seed
        assert row["image_error_px"] == trace.image_error[-1]
        for column in row.keys() & SAME:
            assert row[column] == getattr(trace, column), column
        truth = truth_of(config)
        seen = np.array([truth.images(q, truth.M_face) for q in trace.q])
        kept = (trace.q >= truth.robot.limits.lower) & (trace.q <= truth.robot.limits.upper)
        inside = ((seen >= -0.5) & (seen <= truth.image_size[:, None] - 0.5)).all(axis=(2, 3))
        shown = (inside & ~trace.self_occluded).sum(axis=1)
        good = kept.all() and (shown >= 2).all()
        assert row["success"] == (trace.verdict == "converged" and good)
        R = trace.pose[0, :3, :3].T @ trace.goal_pose[:3, :3]
        angle = math.degrees(math.acos(np.clip((np.trace(R) - 1) / 2, -1, 1)))
        assert row["rotation_deg"] == pytest.approx(angle, abs=1e-4)
        assert name != "tasks" or 60 <= row["rotation_deg"] <= 90
        assert name != "listed tasks" or angle == pytest.approx(30 * (i + 1), abs=1e-6)
        centre = trace.center[-1] - trace.center[0]
        assert abs(np.linalg.norm(centre) * 1e3 - row["distance_mm"]) <= row["position_error_mm"] + 1e-6
        assert row["path_length_mm"] >= np.linalg.norm(centre) * 1e3 - 1e-9


@pytest.mark.volume
def test_parts_do_not_depend_on_how_runs_are_divided():
    found = design(runs=3, traces=[1, 4], random={"control.gain_t": {"normal": [2.5, 0.2]}})
    part = part_of(found)
    whole = run_part(part)
    pieces = [
        run_part(Part(found, first, first + 1, part.calibrations)) for first in reversed(range(found.total))
    ][::-1]
    for column, values in whole.columns.items():
        assert np.concatenate([piece.columns[column] for piece in pieces]).tobytes() == values.tobytes()
    assert sorted(whole.traces) == [1, 4]
    assert np.array_equal(whole.traces[4].q, pieces[4].traces[4].q)
    assert whole.traces[4].law == "stacked"


def test_runs_that_cannot_begin_have_a_verdict_and_no_numbers():
    """Without trials there is no calibration; an offset beyond a joint limit is no start."""
    made = run_part(part_of(design(runs=1, set={"calibration.frames_per_joint": 0})))
    assert made.columns["verdict"].tolist() == [b"not calibrated"] * 2
    assert made.columns["usable"].tolist() == [0, 0]
    limits = {"task.start_offset": {"joints": [0, 0, 300, 0, 0, 0], "unit": "deg"}}
    made = run_part(part_of(design(runs=2, set=limits, traces=[1])))
    assert {law: (count, run) for law, (count, run, _) in made.failures.items()} == {
        "direct_two": (2, 0),
        "stacked": (2, 2),
    }
    assert all("joint 3 would be at" in reason for _, _, reason in made.failures.values())
    assert made.columns["verdict"].tolist() == [b"not started"] * 4
    assert np.isnan(made.columns["position_error_mm"]).all()
    assert made.columns["steps"].tolist() == [-1] * 4
    assert made.columns["success"].tolist() == [0] * 4
