"""Configurations: what loads, every error at once with its place, overrides, hashing."""

import math

import pytest

from projservo_cli.config import load_config, shipped, to_yaml
from projservo_cli.config.inputs import servo_inputs
from projservo_cli.laws import LAW_SPECS, LAWS
from projservo_cli.records import InputError
from projservo_cli.result_hashes import encoded
from projservo_cli.settings.task import Goal
from tests.conftest import SHIPPED

GOOD = """\
seed: 1
robot:
  dh:
    joints:
      - {type: R, d_m: 0.089, alpha_deg: 90, limits_deg: [-360, 360]}
      - {type: P, limits_m: [0.2, 0.9]}
rig:
  image_size_px: [1280, 1024]
  left: {focal_px: [1200, 1200], principal_point_px: [640, 512], position_m: [1, 0, 0], target_m: [0, 0, 0]}
  right: {matrix: [[1200, 0, 640, 0], [0, 1200, 512, 0], [0, 0, 1, 1]]}
markers:
  positions_m: [[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]]
  face: [0, 1, 2]
noise: {calibration_px: 1e-1}
task:
  start: {joints: [10, 0.5], unit: deg}
  goal: {roll_deg: 180}
control: {joint_speed_limit_deg_s: null}
"""


@pytest.fixture
def good(tmp_path):
    path = tmp_path / "good.yaml"
    path.write_text(GOOD, encoding="utf-8")
    return path


def errors(path, *overrides, text=None):
    with pytest.raises(InputError) as caught:
        load_config(path, overrides, text=text)
    return str(caught.value).splitlines()


def test_a_configuration_loads_with_defaults_and_units(good):
    config = load_config(good)
    assert config.name == "good"
    assert config.joint_types == "RP"
    assert tuple(config.task.start.values("RP")) == (math.radians(10), 0.5)
    assert config.robot.ranges == ((-2 * math.pi, 2 * math.pi), (0.2, 0.9))
    assert config.noise.calibration_px == 0.1
    assert config.control.joint_speed_limit_deg_s is None
    assert config.control.laws == tuple(law for law, spec in LAW_SPECS.items() if spec.paper)
    assert load_config(good, [f"control.laws=[{', '.join(LAWS)}]"]).control.laws == LAWS
    assert config.markers.known == (0, 1, 2, 3)
    with pytest.raises(ValueError, match="frozen"):
        config.seed = 3


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_resolved_yaml_loads_to_an_equal_configuration(path):
    config = load_config(path)
    again = load_config("stored.yaml", text=to_yaml(config))
    assert again == config
    assert config.name == path.stem
    assert encoded(servo_inputs(again)) == encoded(servo_inputs(config))


def test_all_errors_come_at_once_each_with_line_and_column(tmp_path):
    path = tmp_path / "bad.yaml"
    path.write_text(
        """\
seeed: 3
robot:
  dh:
    convention: craig
    joints:
      - {type: R, d: 0.089, alpha_deg: true, limits_deg: [360, -360]}
rig:
  image_size_px: [1280.5, 1024]
  left: {focal_px: [.inf, 1200]}
noise: {calibration_px: "0.5"}
control:
  gain_t: 30
  laws: [direct_thre]
  period_s: -0.04
stop: {max_steps: 0}
plant:
""",
        encoding="utf-8",
    )
    expected = {
        "1:1: ": "markers.positions_m: is missing; a simulated run needs it (a recorded one sets data.table)",
        "1:1:  ": "task: is missing; a simulated run needs it, or calibration.reference",
        "1:1:": "seeed: unknown key; did you mean seed?",
        "4:5:": "robot.dh.convention: 'craig' is not one of them; valid: standard, modified",
        "6:19:": "robot.dh.joints.0.d: unknown key; did you mean d_m?",
        "6:29:": "robot.dh.joints.0.alpha_deg: must be a number, not true",
        "6:46:": "robot.dh.joints.0.limits_deg: the lower limit 360 must be below the upper limit -360",
        "8:19:": "rig.image_size_px.0: must be a whole number, not 1280.5",
        "9:21:": "rig.left.focal_px.0: must be a finite number, not inf",
        "10:9:": "noise.calibration_px: must be a number, not '0.5'",
        "13:10:": "control.laws.0: 'direct_thre' is not one of them; did you mean direct_three?",
        "14:3:": "control.period_s: must be greater than 0, not -0.04",
        "15:8:": "stop.max_steps: must be at least 1, not 0",
        "16:1:": "plant: must be a mapping of keys to values, not null",
    }
    assert errors(path) == [f"{path}:{place.strip()} {what}" for place, what in expected.items()]


SCREWS = "joints: [{type: R, w: [0, 0, 1], v: [0, 0, 0]}, {type: P, w: [0, 0, 0], v: [1, 0, 0]}]"
POSE = "[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]"
# what is set, the path named, part of the message
AT = "positions_m: [[1, 0, 0], [1, 1, 0], [1, 0, 1]]"  # of three markers
INCONSISTENT = [
    ("control.gain_t=25", "control.gain_t", "gain · period_s is 1;"),
    ("task.goal.joints={joints: [1, 0.3], unit: deg}", "task.goal", "exactly one of"),
    ("task.goal={joints: {joints: [1, 0], unit: deg}, perturbation: {}}", "task.goal.perturbation",
     "belongs to a goal given by roll_deg"),
    ("task.goal={images: {left: [[1, 2]], right: [[1, 2], [3, 4], [5, 6]]}}", "task.goal.images.left",
     "1 entries for 3 markers"),
    ("markers.face=[0, 1, 9]", "markers.face.2", "there is no marker 9"),
    ("features={pin: {on: tool, line: [0, 9]}}", "features.pin.line.1", "there is no marker 9"),
    ("features={pin: {on: tool, line: [0, 0]}}", "features.pin.line", "a marker occurs here twice"),
    ("features={pin: {on: tool, line: [0, 1], point: [2]}}", "features.pin", "exactly one of point, line"),
    ("features={pin: {on: tool, point: []}}", "features.pin.point", "numbers of 1 to 100 markers"),
    ("features={Pin: {on: tool, point: [0]}}", "features.Pin", "a name of small letters"),
    ("task.goal.incidences=[[pin]]", "task.goal.incidences.0", "perhaps with how both lie"),
    ("task.goal.incidences=[[pin, hole, meets]]", "task.goal.incidences.0", "'meets' does not say how"),
    ("features={hole: {on: scene, line: pin}}", "features.hole.line", "there is no line pin of the tool"),
    ("features={hole: {on: scene, line: [0, 1]}}", "features.hole.line", "the name of a feature of the tool"),
    ("task.goal.incidences=[[pin, hole]]", "task.goal.incidences.0", "there is no feature pin"),
    ("features={pin: {on: tool, line: [0, 1]}, hole: {on: block, line: pin}}", "features.hole.on",
     "there is no object block; objects: none"),
    ("task.goals={grip: {roll_deg: 1.0, on: block}}", "task.goals.grip.on", "there is no object block"),
    ("objects.block={tags: [10]}", "objects.block", "is nowhere: give size_m and pose of its tags"),
    ("objects.block={tags: [10, {number: 11}]}", "objects.block.tags", "numbers of tags, or {number, size_m"),
    ("objects.block={tags: [-1]}", "objects.block.tags.0", "must be at least 0"),
    ("disturbance.camera_moved={at_step: 1, view: left, by_px: a}", "disturbance.camera_moved.by_px",
     "must be a number or a list, not 'a'"),
    (f"objects.block={{markers: [0, 40, 41], {AT}}}", "objects.block", "marker 0 is on the tool"),
    (f"objects.tool={{markers: [40, 41, 42], {AT}}}", "objects.tool", "is no name of an object"),
    (f"objects={{a: {{markers: [4, 5, 6], {AT}}}, b: {{markers: [7, 8, 4], {AT}}}}}", "objects.b",
     "marker 4 is of a as well"),
    (f"objects.a={{markers: [4, 5], {AT}}}", "objects.a.markers", "2 markers do not show how it is turned"),
    ("markers.face=[0, 1, 1]", "markers.face", "twice"),
    ("markers.center=3", "markers.center", "not on the face"),
    ("markers.center=middle", "markers.center", "must be midpoint or the number of a marker"),
    ("markers.numbers=[0, 1, 2]", "markers.numbers", "3 numbers for 4"),
    ("task.start.joints=[1, 0.3, 2]", "task.start.joints", "3 values for 2 joints"),
    ("task.start.joints=[361, 0.3]", "task.start.joints.0",
     "361 deg is outside the limits of joint 1, -360 deg to 360 deg"),
    ("task.start={joints: [6.3, 0.3], unit: rad}", "task.start.joints.0",
     "6.3 rad is outside the limits of joint 1, -6.28319 rad to 6.28319 rad"),
    ("robot.dh.joints.1.limits_m=[2, 1]", "robot.dh.joints.1.limits_m", "below"),
    ("robot.dh.joints.1={type: P, limits_deg: [0, 1]}", "robot.dh.joints.1.limits_deg", "takes limits_m"),
    ("robot.dh.joints.0.limits_rad=[0, 1]", "robot.dh.joints.0.limits_rad", "keep one"),
    ("robot.dh.joints.0={type: R, limits_rad: [-110, 110]}", "robot.dh.joints.0.limits_rad",
     "-110 to 110 rad is more than two turns to a side: degrees?"),
    (f"robot.screws={{reference: {{joints: [0, 0], unit: rad}}, {SCREWS}, base_tool: {POSE}}}", "robot",
     "exactly one of dh, screws"),
    ("robot=null", "robot", "a simulated run needs it"),
    (f"robot.dh.tool={POSE.replace('1, 0, 0]', '2, 0, 0]')}", "robot.dh.tool", "must be a rotation"),
    (f"robot.dh.tool={POSE.replace('1, 0]', '-1, 0]')}", "robot.dh.tool", "must be a rotation"),  # a mirror
    (f"robot.dh.tool={POSE.replace('1]]', '2]]')}", "robot.dh.tool", "last row"),
    ("rig.left.matrix=[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]", "rig.left.focal_px", "matrix is set"),
    ("rig.left.target_m=null", "rig.left", "missing: target_m"),
    ("rig.left.target_m=[1, 0, 0]", "rig.left.target_m", "must look somewhere"),
    ("rig.right.matrix=[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]]", "rig.right.matrix", "singular"),
    ("data={table: t.csv, joints: RR}", "data.joints", "not the joints of the robot, RP"),
    ("disturbance.joint_moved={at_step: 1, joint: 1}", "disturbance.joint_moved",
     "exactly one of by_deg and by_m"),
    ("disturbance.joint_moved={at_step: 1, joint: 2, by_deg: 1}", "disturbance.joint_moved",
     "of type P: give by_m"),
    ("disturbance.stuck_encoder={joint: 3, from_step: 1}", "disturbance.stuck_encoder.joint", "has 2 joints"),
    ("control.mode=track", "control.mode", "nothing gives it one"),
]  # fmt: skip


@pytest.mark.parametrize(("override", "path", "message"), INCONSISTENT)
def test_inconsistencies_are_refused_with_path_and_flag(good, override, path, message):
    (found,) = errors(good, override)
    assert found.startswith((f"--set {override}: {path}: ", f"{good}:")), found
    assert f" {path}: " in found
    assert message in found


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("control.gain_t", "expected KEY=VALUE"),
        ("control.gain_t=[1", "the value is not valid YAML"),
        ("controls.gain=3", "controls: unknown key; did you mean control?"),
        ("robot.dh.joints.5.d_m=1", "robot.dh.joints.5: expected a list position from 0 to 1"),
        ("seed.x=1", "seed.x: there is a plain value"),
        ("name=a/b", "name: must be usable as the name of a folder"),
    ],
)
def test_errors_in_overrides_name_the_flag(good, override, message):
    (found,) = errors(good, override)
    assert found.startswith(f"--set {override}: {message}")


def test_overrides_reach_lists_and_make_sections(good):
    reference = ["calibration.reference.unit=deg", "calibration.reference.joints=[1, 0.2]"]
    gains = ["control.gain=1", "control.gain=2"]
    config = load_config(good, ["robot.dh.joints.1.limits_m=[0.1, 0.6]", *reference, *gains])
    assert config.robot.ranges[1] == (0.1, 0.6)
    assert tuple(config.calibration.reference.values("RP")) == (math.radians(1), 0.2)
    assert config.control.gain == 2


def test_a_blank_recorded_configuration_needs_only_a_table(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    config = load_config(None, ["data.table=a/trial.csv", "data.joints=rrp"])
    assert (config.name, config.recorded, config.joint_types) == ("trial", True, "RRP")
    assert config.data.table == str(tmp_path / "a/trial.csv")
    assert config.data.joint_unit is None
    (line,) = errors(None, "data.table=t.csv", "data.joint_unit=degree")
    assert line.endswith("data.joint_unit: 'degree' is not one of them; did you mean deg?")


UNREADABLE = {
    "nothing": "",
    "no yaml": "name: [1",
    "two documents": "name: a\n---\nname: b",
    "a tag": "name: !!python/object/apply:os.getcwd []",
    "deep nesting": "[" * 3000,
    "an endless alias": "name: &x [*x]",
    "an alias bomb": "a: &a [1,1,1,1,1,1,1,1,1,1]\n"
    + "".join(
        f"{new}: &{new} [{','.join([f'*{old}'] * 10)}]\n" for old, new in zip("abcdef", "bcdefg", strict=True)
    ),
    "too large": "name: " + "x" * 1_000_001,
}


@pytest.mark.parametrize("case", UNREADABLE)
def test_unreadable_text_is_refused(case):
    assert all(line.startswith("c.yaml") for line in errors("c.yaml", text=UNREADABLE[case]))


def test_duplicate_keys_are_refused_with_both_places(good):
    (line,) = errors(good, text=GOOD.replace("  face:", "  face: [0, 1, 3]\n  face:"))
    assert line == f"{good}:14:3: markers.face: the key stands here a second time (first at 13:3); keep one"


def test_a_taught_goal_keeps_the_incidences_beside_it(tmp_path):
    """Read from the file, written out whole, and read again."""
    pixels = "[[1, 2], [3, 4], [5, 7]]"
    (tmp_path / "goal.yaml").write_text(f"images: {{left: {pixels}, right: {pixels}}}")
    features = "features: {pin: {on: tool, line: [0, 1]}, hole: {on: scene, line: pin}}\n"
    goal = "{taught: goal.yaml, incidences: [[pin, hole], [pin, hole, 90]]}"
    path = tmp_path / "good.yaml"
    path.write_text(features + GOOD.replace("{roll_deg: 180}", goal), encoding="utf-8")
    config = load_config(path)
    assert config.task.goal.images.left[2] == (5.0, 7.0)
    assert config.task.goal.incidences == (("pin", "hole"), ("pin", "hole", 90.0))
    assert load_config("again.yaml", text=to_yaml(config)) == config


def test_objects_before_cameras_on_the_tool_are_refused_in_one_line(good):
    wanted = [f"objects.block={{markers: [40, 41, 42], {AT}}}", "rig.mount=tool"]
    (found,) = errors(good, *wanted)
    assert "objects: cameras on the tool see the scene that the goal is on: its images carry" in found


def test_wrong_options_of_a_plant_hide_nothing_else():
    pushed = "disturbance.object_moved={at_step: 3, name: part}"
    found = errors(shipped("object"), "plant={use: mujoco, options: {blurr_px: 1}}", pushed)
    assert len(found) == 4  # two of markers and noise
    assert any("plant.options.blurr_px: unknown key; did you mean blur_px?" in line for line in found)
    assert any("disturbance.object_moved: moves no object before rendered" in line for line in found)


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("trajectory.visible_views=0", "trajectory.visible_views: must be all or at least 1, not 0"),
        ("calibration.joint_model=gear", "calibration.joint_model: must be auto or a list, not 'gear'"),
        ("calibration.joint_model=[1]", "calibration.joint_model.0: must be text; put it in quotes, not 1"),
    ],
)
def test_a_value_that_may_be_of_several_kinds_is_refused_in_one_line(override, says):
    with pytest.raises(InputError) as refused:
        load_config(shipped("paper"), [override])
    assert str(refused.value) == f"--set {override}: {says}"


def test_a_key_with_dots_replaces_a_whole_section_and_mappings_merge():
    config = load_config(shipped("insertion"))
    assert config.task.goal.incidences
    assert config.replace({"task.goal": {"roll_deg": 30.0}}).task.goal == Goal(roll_deg=30.0)
    merged = config.replace({"noise": {"servo_px": 0.5}})
    assert merged.noise == config.noise.model_copy(update={"servo_px": 0.5})
