"""Keys: a stage reads what its key is made of and nothing else, and a key is made of no more than that."""

import contextlib
import json
import shutil
import sys
from collections import namedtuple
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from projservo_cli.config import load_config
from projservo_cli.config.inputs import calibration_inputs, files_of, plan_inputs, report_inputs, servo_inputs
from projservo_cli.records import WorkFailed, flat_fields
from projservo_cli.result_hashes import encoded, key_of
from projservo_cli.simulation.mjcf import files_named
from projservo_cli.stages import calibrate, plan, servo
from tests.configured import record
from tests.conftest import ROOT
from tests.stages.decoding import decoded, files_in

GIVEN = {"calibrate": calibration_inputs, "plan": plan_inputs, "servo": servo_inputs, "report": report_inputs}
# Short, and with all that is random: noise in trials, loop, start and goal.
QUICK = (
    "calibration.frames_per_joint=4",
    "stop.max_steps=12",
    "noise.servo_px=0.3",
    "trajectory.n_samples=11",
)
CASES = {
    "ideal": ("paper", ()),
    "searched": ("ur5", ("trajectory.profile=auto", "control.mode=track")),
    "faults": (
        "hobby",
        (
            "calibration.random_poses=4",
            "disturbance.servo_time_constant_s=0.05",
            "disturbance.joint_moved={at_step: 4, joint: 1, by_deg: 2}",
        ),
    ),
}
LAW = "exact"
STORED = Path(__file__).with_name("keys.json")


def configured(case, *overrides):
    """A case, or another shipped configuration, with other values."""
    name, own = CASES.get(case, (case, ()))
    return load_config(ROOT / "configs" / f"{name}.yaml", [*QUICK, *own, *overrides])


def made(stage, given, before):
    """What a stage makes, by the records that it is given."""
    if stage == "calibrate":
        return calibrate.run(given)
    if stage == "plan":
        return (plan.run(given, before["calibrate"][1]),)
    return (servo.run(given, before["calibrate"][1], before["plan"][0], LAW),)


def same(first, second):
    """Whether records are equal to the bit, but for the time that they took."""
    for one, other in zip(first, second, strict=True):
        if one is None or other is None:
            if one is not other:
                return False
            continue
        for field in flat_fields(type(one)):
            values = (getattr(one, field.name), getattr(other, field.name))
            if field.name != "seconds" and encoded(values[0]) != encoded(values[1]):
                return False
    return True


@cache
def chain(name):
    """What each stage of a case makes, and the configuration."""
    config = configured(name)
    results = {}
    for stage in ("calibrate", "plan", "servo"):
        results[stage] = made(stage, GIVEN[stage](config), results)
    return config, results


OPENED = []
sys.addaudithook(lambda event, arguments: OPENED.append(str(arguments[0])) if event == "open" else None)


@pytest.mark.parametrize("stage", ["calibrate", "plan", "servo"])
@pytest.mark.parametrize("name", CASES)
def test_a_stage_makes_the_same_of_its_bytes_and_opens_no_file(name, stage):
    config, results = chain(name)
    given = GIVEN[stage](config)
    content, files = encoded(given), {file.sha256: file.path for file in files_in(given)}
    again = decoded(content, files)
    assert encoded(again) == content
    OPENED.clear()
    found = made(stage, again, results)
    system = (str(ROOT / "projservo_cli"), sys.prefix, sys.base_prefix, "/proc", "/sys", "/usr", "/dev")
    other = [file for file in OPENED if not file.startswith(system) and "kernels-" not in file]
    assert not [file for file in other if file not in files.values() and not file.isdecimal()]
    assert same(found, results[stage])


# Of a case whether the key of a stage stays where a value changes: a stage makes the same of its bytes, hence
# a key is made of no less than it reads; nor is it made of more.
CHANGES = [
    ("ideal", "plan", True, "control.gain_t=1"),
    ("ideal", "plan", True, "control.period_s=0.05"),
    ("ideal", "plan", True, "stop.max_steps=5"),
    ("ideal", "plan", False, "control.joint_speed_limit_deg_s=20"),
    ("ideal", "plan", False, "stop.innovation_threshold=0"),
    ("ideal", "plan", False, "markers.center=0"),
    ("ideal", "calibrate", True, "plant.timeout_s=3"),
    ("ideal", "calibrate", True, "plant.speed_scale=0.5"),
    ("ideal", "calibrate", True, "control.period_s=0.05"),
    ("ideal", "calibrate", True, "control.joint_speed_limit_deg_s=20"),
    ("ideal", "calibrate", True, "markers.center=0"),
    ("ideal", "servo", True, "control.laws=[stacked]"),
    ("ideal", "servo", True, "control.mode=[regulate, track]"),
    ("ideal", "servo", True, "control.must_converge=[]"),
    ("ideal", "servo", True, "plant.timeout_s=3"),
    ("ideal", "servo", True, "name=other"),
    ("ideal", "servo", False, "plant.speed_scale=0.5"),
    ("ideal", "servo", False, "control.max_replan_attempts=5"),
    ("ideal", "servo", False, "plant.joint_limits=stop"),
    ("ideal", "servo", True, "plant.averaged_frames=3"),
    ("ideal", "plan", True, "plant.joint_limits=stop"),
    ("ideal", "plan", True, "noise.calibration_px=1"),
    ("ideal", "plan", False, "noise.averaged_frames=3"),
    ("ideal", "plan", True, "control.joint_acceleration_limit_deg_s2=500"),  # that of null
    ("ideal", "calibrate", True, "noise.servo_px=1"),
    ("ideal", "report", False, "name=other"),
    ("ideal", "report", False, "control.must_converge=[]"),
    ("faults", "calibrate", True, "plant.timeout_s=3"),
    ("faults", "calibrate", True, "control.gain_t=1"),
    ("faults", "calibrate", False, "control.period_s=0.05"),
    ("faults", "calibrate", False, "plant.settle_s=1"),
    ("faults", "calibrate", False, "plant.max_servo_lag_s=1"),
    ("faults", "calibrate", True, "plant.speed_scale=0.5"),
    ("faults", "calibrate", True, "plant.image_border=stop"),
    ("faults", "servo", False, "plant.timeout_s=3"),
]


@pytest.mark.parametrize(("name", "stage", "stays", "change"), CHANGES)
def test_a_key_is_made_of_what_the_stage_reads(name, stage, stays, change):
    keys = [key_of(GIVEN[stage](configured(name, *more))) for more in ((), (change,))]
    assert (keys[0] == keys[1]) == stays


def keys_of_shipped():
    """The key of each stage of each shipped configuration that this machine can read."""
    found = {}
    for path in sorted((ROOT / "configs").glob("*.yaml")):
        if "\ngrid:" in path.read_text(encoding="utf-8"):
            continue
        with contextlib.suppress(WorkFailed):  # without MuJoCo
            config = load_config(path)
            found |= {f"{path.stem}/{stage}": key_of(given(config)) for stage, given in GIVEN.items()}
    return found


def test_results_of_users_stay_valid():
    """Keys of shipped configurations are as stored: they change with what a stage makes, and not with code.

    Where a layout or a number is meant to change, ``python -m tests.stages.test_keys`` stores them again.
    """
    stored = json.loads(STORED.read_text(encoding="utf-8"))
    found = keys_of_shipped()
    assert found.keys() <= stored.keys()
    assert len(found) >= 4 * len(CASES)
    assert {name: stored[name] for name in found} == found


def test_a_type_that_moves_keeps_its_key():
    first, named = (namedtuple(name, "x") for name in ("Gains", "Other"))
    assert encoded(first(1)) == b'{"projservo_cli.control.law:Gains":{"x":1}}'
    assert encoded(named(1)) == b'{"Other":{"x":1}}'


def test_a_key_that_is_new_counts_where_it_is_set():
    plain, stated = (
        calibration_inputs(configured("ur5", f"markers.boards={text}"))
        for text in ("null", "[{columns: 2, rows: 2}]")
    )
    assert b"boards" not in encoded(plain)
    assert b"StatedBoard" in encoded(stated)


def test_tables_and_goal_files_count_by_their_content(tmp_path):
    config = configured("ur5", "calibration.cross_validate=null")
    table = tmp_path / "trials.csv"
    record.record(config, record.new_recording(config, table))
    told = configured("ur5", f"data.table={table}")
    key, report = key_of(calibration_inputs(told)), key_of(report_inputs(told))
    moved = tmp_path / "elsewhere" / "moved.csv"
    moved.parent.mkdir()
    shutil.move(table, moved)
    elsewhere = configured("ur5", f"data.table={moved}")
    assert key_of(calibration_inputs(elsewhere)) == key
    assert key_of(report_inputs(elsewhere)) == report
    given = calibration_inputs(elsewhere)
    again = decoded(encoded(given), {given.source.file.sha256: str(moved)})
    OPENED.clear()
    assert same(calibrate.run(again), calibrate.run(given))
    assert str(moved) in OPENED
    gone = {str(moved): given.source.file.sha256}
    content = moved.read_text(encoding="utf-8")
    moved.unlink()
    assert key_of(calibration_inputs(elsewhere, files_of(elsewhere, gone))) == key
    moved.write_text(content.replace("0,0,", "0,1,", 1), encoding="utf-8")
    assert key_of(calibration_inputs(elsewhere, files_of(elsewhere, gone))) != key


MESH = "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv 0 0 0.1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
PART = """<mujocoinclude><body name="tool" pos="0 0 0.3"><joint name="b" axis="0 1 0"/>
{}</body></mujocoinclude>"""
ARM = """<mujoco><compiler meshdir="meshes"/><asset><mesh name="link" file="link.obj"/></asset><worldbody>
<body name="base"><joint name="a" axis="0 0 1"/><geom type="mesh" mesh="link"/>
<include file="part.xml"/></body>
</worldbody></mujoco>"""


def test_a_model_of_mujoco_counts_with_the_files_that_it_names(tmp_path):
    pytest.importorskip("mujoco")

    def key(folder, mesh=MESH, size=0.05):
        (folder / "meshes").mkdir(parents=True, exist_ok=True)
        (folder / "meshes" / "link.obj").write_text(mesh, encoding="utf-8")
        geom = f'<geom type="sphere" size="{size}"/>'
        (folder / "part.xml").write_text(PART.format(geom), encoding="utf-8")
        (folder / "arm.xml").write_text(ARM, encoding="utf-8")
        robot = f"robot={{mjcf: {folder / 'arm.xml'}, tip: tool}}"
        start = "task={start: {joints: [0, 0.1], unit: rad}, goal: {joints: {joints: [0.2, 0.3], unit: rad}}}"
        alone = "noise.servo_px=0", "calibration.reference=null"
        config = configured("rendered", robot, start, *alone)
        found = {stage: key_of(GIVEN[stage](config)) for stage in ("calibrate", "plan", "servo", "report")}
        assert len(set(found.values())) == 4
        return found

    first = key(tmp_path / "one")
    assert key(tmp_path / "two") == first
    named = files_named(str(tmp_path / "one" / "arm.xml"))
    assert [name.removeprefix(str(tmp_path)) for name in named] == ["/one/meshes/link.obj", "/one/part.xml"]
    larger = MESH.replace("0.1 0 0", "0.2 0 0")
    for other in (key(tmp_path / "two", mesh=larger), key(tmp_path / "two", size=0.06)):
        assert not {*other.values()} & {*first.values()}


def test_canonical_bytes_tell_values_apart():
    values = [1, 1.0, True, "1", None, (1,), [1], {"a": 1}, np.ones(1), np.ones(1, np.int64), np.ones((1, 1))]
    assert len({encoded(value) for value in values}) == len(values)
    for value in values:
        assert encoded(decoded(encoded(value), {})) == encoded(value)
    with pytest.raises(TypeError, match="object has no canonical bytes"):
        encoded(object())


if __name__ == "__main__":
    STORED.write_text(json.dumps(keys_of_shipped(), indent=1) + "\n", encoding="utf-8")
