"""Checks before a recording: mistakes that beginners make with tags and cameras, each with its remedy."""

import html
import json
import re
import sys
import urllib.request
from types import SimpleNamespace

import click
import cv2
import numpy as np
import pytest

from projservo_cli.calibration import predict
from projservo_cli.config import load_config
from projservo_cli.config.inputs import calibration_inputs
from projservo_cli.findings import NOTE, REFUSES, Finding, Subject, first
from projservo_cli.hardware.checks_at_rest import RobotAtRest
from projservo_cli.messages import sentence_and_remedy
from projservo_cli.records import JointLimits, Observation
from projservo_cli.report.image_pages import LivePage
from projservo_cli.stages import calibrate
from projservo_cli.stages.doctor import Checked, calibration_finding, mended_by_refit
from projservo_cli.store.files_and_locks import working_in
from projservo_cli.store.run_file import load
from tests.conftest import ROOT
from tests.hardware.arms_in_motion import Faults, Rail, findings
from tests.hardware.streams import Stream, picture

# A camera above those of the hobby arm.
TOP = {
    "focal_px": [600, 600],
    "principal_point_px": [319.5, 239.5],
    "position_m": [0.68, 0.0, 0.5],
    "target_m": [0.2, 0.0, 0.22],
}
LEFT = picture(at=(60.0, 80.0), numbers=(0, 1, 2), side=50.0, step=75.0)
CONFIGURATION = """\
name: arm
plant: {{use: "tests.hardware.still:Still"{options}}}
data: {{table: arm.csv, joints: RRRRR}}
cameras:
  left: {{source: "{left}", rate_hz: {rate}}}
  right: {{source: "{right}", rate_hz: {rate}}}
  max_age_s: 5.0  # other programs share the machine
  reconnect_s: 20.0
markers: {{numbers: [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11], face: [0, 1, 2, 3]}}
robot: {{limits: {{joints: [[-110, 110], [-100, 100], [-97, 97], [-95, 95], [-160, 160]], unit: deg}}}}
control: {{joint_speed_limit_deg_s: 60}}
"""


@pytest.fixture
def doctor(projservo, tmp_path, monkeypatch):
    """Function that checks an arm before two drawn images; the answer, and findings by level and code."""
    monkeypatch.chdir(tmp_path)
    streams = []

    def check(left, right, rate_hz=30.0, asked_hz=20, options="", sets=()):
        streams.extend(Stream(lambda image=image: image, rate_hz) for image in (left, right))
        text = CONFIGURATION.format(
            left=streams[-2].url, right=streams[-1].url, rate=asked_hz, options=options
        )
        (tmp_path / "arm.yaml").write_text(text, encoding="utf-8")
        answer = projservo("doctor", "-c", "arm.yaml", "--json", *sets)
        told = json.loads(answer.out)["findings"]
        assert not re.search(r"\bnan\b", answer.out)
        levels = "fault", "warning", "fine"
        return answer, {
            level: {one["code"]: one for one in told if one["level"] == level} for level in levels
        }

    yield check
    for stream in streams:
        stream.close()


def test_a_sound_set_up_is_ready_and_shown_on_a_page(doctor, tmp_path):
    answer, found = doctor(LEFT, picture(at=(50.0, 90.0), numbers=(0, 1, 2), side=50.0, step=70.0))
    assert found["warning"].keys() <= {"alike_views"}  # both pictures are drawn from ahead
    fine = {code: f"{one['where']}: {one['text']}" for code, one in found["fine"].items()}
    assert fine["tags_seen"].startswith("right image: tags 0 (50 px), 1 (50 px), 2 (50 px); corners to 0.0")
    assert fine["health"] == "arm: supply, V 12.1"
    assert fine["camera_rate"].endswith("frames a second, stamped when they arrive")
    page = (tmp_path / "preflight.html").read_text(encoding="utf-8")
    assert page.count("data:image/jpeg;base64,") == 2
    assert html.escape("share 12 of 12 markers") in page
    assert found["fault"].keys() == {"alike_views"}
    assert answer.code == 1


_OTHER = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)


@pytest.mark.parametrize(
    ("left", "right", "level", "told"),
    [
        (
            picture(at=(30.0, 80.0), numbers=(0, 1, 0), side=50.0),
            picture(numbers=(0, 1), at=(60.0, 80.0), tags=_OTHER),
            "fault",
            {
                "repeated_tag": {"views": ["left"], "tag": 0},
                "other_dictionary": {"views": ["right"], "name": "5X5_50"},
            },
        ),
        (
            LEFT[:, ::-1],
            LEFT,
            "fault",
            {"mirrored_image": {"views": ["left"], "markers": [0, 4, 8]}},
        ),
        (
            picture(at=(60.0, 80.0), numbers=(7, 8)),
            np.full((240, 320), 2, np.uint8),
            "fault",
            {
                "unknown_tags": {"views": ["left"], "markers": [28, 32]},
                "black_image": {"views": ["right"]},
            },
        ),
        (
            picture(at=(60.0, 80.0), numbers=(0, 1, 2), side=19.0),
            picture(numbers=(0, 1), at=(60.0, 80.0), blur=3.5),
            "warning",
            {"small_tag": {"views": ["left"], "tag": 2}, "blurred_image": {"views": ["right"]}},
        ),
    ],
)
def test_a_mistake_with_tags_or_light_is_named_with_its_remedy(doctor, left, right, level, told):
    _, found = doctor(left, right)
    for code, subject in told.items():
        assert found[level][code]["subject"] == subject
        assert found[level][code]["remedy"]


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="device nodes of Linux")
@pytest.mark.parametrize(
    ("left", "right", "words"),
    [
        ("0", "/dev/video0", "cameras.right.source: is /dev/video0, also the device of the left camera"),
        ('"0"', "1", "cameras.left.source: is text: an index has no quotes: source: 0"),
        (
            "/dev/null",
            "1",
            "the left camera (cameras.left.source: /dev/null): is no camera: name one of the devices: ",
        ),
    ],
    ids=["twice", "quoted", "no camera"],
)
def test_a_source_that_is_taken_or_no_camera_is_refused(projservo, tmp_path, monkeypatch, left, right, words):
    monkeypatch.chdir(tmp_path)
    text = CONFIGURATION.format(left="L", right="R", rate=30, options="")
    text = text.replace('"L"', left).replace('"R"', right)
    (tmp_path / "arm.yaml").write_text(text, encoding="utf-8")
    answer = projservo("doctor", "-c", "arm.yaml")
    assert (answer.code, answer.err.count("\n"), words in answer.err) == (2, 1, True), answer.err


def of_hobby(*changes):
    """A calibration of the hobby arm, which carries a roof of tags."""
    settings = (
        "markers={tags: roof, tag_size_m: 0.04}",
        "noise.calibration_px=0.05",
        "calibration.random_poses=8",
    )
    return calibrate.run(calibration_inputs(load_config("configs/hobby.yaml", (*settings, *changes))))[1]


@pytest.fixture(scope="module")
def calibrated():
    return of_hobby()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda s: s, "agrees with the images, which show the tool within 0."),
        (lambda s: _with_noise(s, 0.2), "agrees with the images, which show the tool within 0."),
        (lambda s: s[::-1], "exchanged"),
        (lambda s: s + np.array([[[12.0, 0.0]], [[0.0, 0.0]]]), "the left camera"),
        (lambda s: _tag(s, 1, np.roll(s[:, 4:8], 2, axis=1)), "tag 1 is turned by 180° on the tool: put"),
        (lambda s: _tag(_tag(s, 1, s[:, 12:16]), 3, s[:, 4:8]), "tags 1, 3 are exchanged on the tool"),
        (lambda s: _tag(s, 2, s[:, 8:12] + 15.0), "tag 2 (markers 8, 9, 10, 11) moved on the tool"),
        (
            lambda s: _scaled(s, 0.94),
            "all tags are 6 % smaller than those of the calibration; print them in their size",
        ),
    ],
    ids=["sound", "noisy", "exchanged", "moved", "upside down", "two tags", "loose", "fit to page"],
)
def test_a_calibrated_run_tells_what_changed_since(calibrated, change, words):
    q = calibrated.q_reference
    s = change(predict(calibrated, q[None])[0])
    seen = standing(calibrated, q, s)
    side, diagonal = 0.04, 0.04 * np.sqrt(2.0)
    lengths = np.array([[0.0, side, diagonal, side], [side, 0.0, side, diagonal]])
    lengths = np.concatenate([lengths, np.roll(lengths, 2, axis=1)])
    finding = calibration_finding(calibrated, seen, (640, 480), lengths)
    text = sentence_and_remedy(finding)
    assert words in text
    assert (finding.severity == NOTE) == (words.startswith("agrees with the images"))
    unknown = calibration_finding(calibrated, seen, (640, 480), np.full((4, 4), np.nan))
    assert unknown.severity == finding.severity
    assert "mm" not in sentence_and_remedy(unknown)


@pytest.mark.parametrize(("views", "slipped"), [(2, False), (2, True), (3, False)])
def test_a_camera_that_moved_is_named_with_the_poses_that_mend_it(calibrated, views, slipped):
    if views == 3:
        calibrated = of_hobby(f"rig.top={json.dumps(TOP)}", "calibration.frames_per_joint=4")
    q, off = calibrated.q_reference, np.zeros(len(calibrated.q_reference))
    off[1] = np.radians(3.0 * slipped)
    s = predict(calibrated, (q + off)[None])[0]
    s[1] += 0.0 if slipped else 12.0
    seen = standing(calibrated, q, s)
    fault = calibration_finding(calibrated, seen, (640, 480), np.full((4, 4), np.nan))
    found, mend = mended_by_refit(fault, calibrated, seen, (640, 480))
    fault, *views = fault.others
    assert fault.code == "images_off"
    assert [one.subject.views for one in views] == [(name,) for name in calibrated.view]
    assert (mend is None) == slipped
    if mend is not None:
        view, poses = mend
        assert view == "right"
        off = views[1]
        assert (off.amount, off.limit < 1.0) == (pytest.approx(17.0, abs=0.5), True)
        assert f"put the right camera back, or fit it again from {len(poses.q)} poses" in sentence_and_remedy(
            found[0]
        )
        assert poses.before_px < poses.error_px <= 1.5 * poses.before_px


def standing(calibrated, q, s):
    """An arm at rest at joints before images (V, m, 2)."""
    shown = Observation.of_one(calibrated.marker, q, s, calibrated.view)
    numbers, seen, joints = calibrated.marker.tolist(), np.isfinite(s[..., 0]), JointLimits(q, q, q, q)
    return RobotAtRest(
        numbers, (0, 1, 2, 3), q, s, None, 0.0 * seen, shown, np.ones((1, len(s)), bool), joints, ()
    )


def _with_noise(s, px):
    """Images with normal noise."""
    return s + px * np.random.default_rng(0).standard_normal(s.shape)


def _tag(s, tag, pixels):
    """Images with other pixels (2, 4, 2) of a tag."""
    changed = s.copy()
    changed[:, 4 * tag : 4 * tag + 4] = pixels
    return changed


def _scaled(s, factor):
    """Images of tags printed smaller, each about its own centre."""
    tags = s.reshape(2, -1, 4, 2)
    center = tags.mean(axis=2, keepdims=True)
    return (center + factor * (tags - center)).reshape(s.shape)


def test_motions_of_a_sound_arm_tell_latency_hysteresis_and_backlash():
    found, moved = findings(Faults(latency_s=(0.12, 0.06), hysteresis_deg=0.6, backlash_deg=0.4))
    assert {one.severity for one in found} == {NOTE}
    late = [(one.subject.views, one.amount) for one in found if one.code == "latency"]
    near = [pytest.approx(seconds, abs=0.005) for seconds in (0.12, 0.06)]
    assert late == [(("left",), near[0]), (("right",), near[1])]
    for one in found[:5]:
        hysteresis, _, backlash = (np.degrees(part.amount) for part in one.others)
        assert hysteresis == pytest.approx(0.6, abs=0.12)
        assert 0.25 < backlash < 0.5
    assert max(np.degrees(np.ptp(one.q)) for one in moved) < 8.0


@pytest.mark.parametrize(
    ("faults", "moving", "code", "where"),
    [
        (Faults(link=3), range(5), "early_link", Subject(joints=(4, 5))),
        (Faults(loose=3, loose_px=3.0), (0, 2), "loose_tag", Subject(tag=3)),
        (Faults(held=1), (1,), "held_joint", Subject(joints=(2,))),
    ],
)
def test_motions_name_what_a_recording_would_fail_at(faults, moving, code, where):
    found, _ = findings(faults, moving)
    fault = first(found, REFUSES)
    assert (fault.code, fault.subject) == (code, where)


RAIL = """\
name: rail
plant: {{use: "tests.hardware.arms_in_motion:Rail"{options}}}
data: {{table: rail.csv, joints: RP}}
markers: {{numbers: [0, 1, 2, 3, 4, 5, 6, 7], face: [0, 1, 2, 3]}}
robot: {{limits: {limits}}}
control: {{joint_speed_limit_deg_s: 40, prismatic_speed_limit_m_s: 0.5}}
"""


@pytest.fixture
def rail(projservo, tmp_path, monkeypatch):
    """Function that checks and moves a joint that turns and one that slides; answer, findings, questions."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.stdin", SimpleNamespace(isatty=lambda: True))
    asked = []
    monkeypatch.setattr(click, "confirm", lambda question, **_: asked.append(question) or True)

    def check(limits="{joints: [[-90, 90], [-0.5, 0.5]], unit: deg}", options=""):
        (tmp_path / "rail.yaml").write_text(RAIL.format(limits=limits, options=options), encoding="utf-8")
        answer = projservo("doctor", "-c", "rail.yaml", "--move", "--json")
        assert answer.code < 2, answer.err
        return answer, answer.json["findings"], asked

    return check


def test_a_joint_that_slides_moves_by_millimetres_and_reports_them(rail):
    answer, found, asked = rail()
    assert answer.code == 0
    assert "move each joint by 3°, prismatic ones by 15.7 mm, to either side" in asked[0]
    t, turned, slid = np.array(Rail.last.sent).T
    assert np.degrees([turned.min(), turned.max()]) == pytest.approx([-3.0, 3.0])
    assert [slid.min(), slid.max()] == pytest.approx([-0.0157, 0.0157], abs=1e-4)
    assert np.abs(np.diff(slid) / np.diff(t)).max() == pytest.approx(0.3 * np.radians(20.0), rel=0.01)
    text = {one["where"]: one["text"] for one in found}
    assert text["joint 1"] == "hysteresis 0°, sag 0°, backlash 0°"
    assert text["joint 2"] == "hysteresis 0 mm, sag 0 mm, backlash 0 mm"


def test_a_joint_without_limits_is_a_fault_and_nothing_moves(rail, tmp_path):
    answer, found, asked = rail(limits="{from_data: 0.1}")
    assert (answer.code, asked, Rail.last.sent) == (1, [], [])
    assert (tmp_path / "preflight.html").exists()
    faults = [(one["code"], one["where"]) for one in found if one["level"] == "fault"]
    assert faults == [("joint_without_limits", "joint 1"), ("joint_without_limits", "joint 2")]
    assert found[-1]["code"] == "not_moved"


@pytest.mark.parametrize(
    ("frozen", "where", "code"),
    [
        ("[0, 1]", "joints 1 and 2", "still_tags"),
        ("[1]", "right camera", "still_image"),
    ],
)
def test_a_camera_that_repeats_one_frame_is_named(rail, tmp_path, frozen, where, code):
    answer, found, _ = rail(options=f", options: {{frozen: {frozen}}}")
    (fault,) = (one for one in found if one["level"] == "fault")
    assert (answer.code, fault["where"], fault["code"]) == (1, where, code)
    assert (frozen == "[1]") == any(one["where"] == "tags" for one in found)
    assert (tmp_path / "preflight.html").exists()


def test_a_live_page_serves_both_images_to_this_machine_alone():
    page = LivePage("arm <1>", ("left", "right"))
    assert page.url.startswith("http://127.0.0.1:")
    page.pictures["left"] = b"JPEG-1"
    with urllib.request.urlopen(page.url, timeout=5) as answer:
        text = answer.read().decode()
    assert "Live images of arm &lt;1&gt;" in text
    assert 'src="/right.mjpg"' in text
    with urllib.request.urlopen(f"{page.url}left.mjpg", timeout=5) as answer:
        assert answer.headers["Content-Type"].startswith("multipart/x-mixed-replace")
        head = [answer.readline() for _ in range(4)]
        assert head[:2] == [b"--frame\r\n", b"Content-Type: image/jpeg\r\n"]
        assert answer.read(6) == b"JPEG-1"
    page.close()


def test_a_run_that_images_contradict_is_marked_unless_another_process_is_at_work_in_it(
    projservo, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    assert projservo("calibrate", "-c", ROOT / "configs" / "hobby.yaml", "-o", "out").code == 0
    text = CONFIGURATION.format(left="left.mp4", right="right.mp4", rate=20, options="")
    (tmp_path / "arm.yaml").write_text(text, encoding="utf-8")
    camera = Finding("displaced_camera", REFUSES, Subject(views=("left",)), 3.0, unit="px")
    moved = Finding("refuted", REFUSES, others=(camera,))

    def answer_to(finding):
        checked = Checked((finding,), None, ())
        monkeypatch.setattr("projservo_cli.stages.doctor.check", lambda *_, **__: checked)
        return projservo("doctor", "out", "-c", "arm.yaml")

    assert answer_to(moved).code == 1
    assert load("out").refuted == "the left camera was moved, by 3 px"
    with working_in(tmp_path / "out"):
        answer = answer_to(Finding("agrees", NOTE))
    assert answer.code == 2
    assert "is at work there" in answer.err
    assert load("out").refuted == "the left camera was moved, by 3 px"
    assert answer_to(Finding("agrees", NOTE)).code == 0
    assert load("out").refuted == ""
