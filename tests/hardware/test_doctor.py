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
from projservo_cli.files import working_in
from projservo_cli.hardware.checks_at_rest import FAULT, FINE, Finding
from projservo_cli.report.live_page import LivePage
from projservo_cli.stages import calibrate
from projservo_cli.stages.doctor import Checked, calibration_finding, with_refit
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
    """Function that checks an arm before two drawn images; the answer, and findings by level."""
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
        return answer, {
            level: [
                f"{one['where']}: {one['text']}: {one['remedy']}" for one in told if one["level"] == level
            ]
            for level in ("fault", "warning", "fine")
        }

    yield check
    for stream in streams:
        stream.close()


def test_a_sound_set_up_is_ready_and_shown_on_a_page(doctor, tmp_path):
    answer, found = doctor(LEFT, picture(at=(50.0, 90.0), numbers=(0, 1, 2), side=50.0, step=70.0))
    warned = [
        one for one in found["warning"] if "directions" not in one
    ]  # both pictures are drawn from ahead
    assert warned == []
    assert "left image: tags 0 (50 px), 1 (50 px), 2 (50 px); corners to 0.0" in "\n".join(found["fine"])
    assert any("supply, V 12.1" in one for one in found["fine"])
    assert any("frames a second, stamped when they arrive" in one for one in found["fine"])
    page = (tmp_path / "preflight.html").read_text(encoding="utf-8")
    assert page.count("data:image/jpeg;base64,") == 2
    assert html.escape("share 12 of 12 markers") in page
    assert "directions" in found["fault"][0]
    assert answer.code == 1


_OTHER = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)


@pytest.mark.parametrize(
    ("left", "right", "level", "words"),
    [
        (
            picture(at=(30.0, 80.0), numbers=(0, 1, 0), side=50.0),
            picture(numbers=(0, 1), at=(60.0, 80.0), tags=_OTHER),
            "fault",
            (
                "left image: tag 0 is there twice: a number must be unique: print another one",
                "right image: 2 tags are of 5X5_50, none of 4X4_50: set markers.dictionary: 5X5_50",
            ),
        ),
        (
            LEFT[:, ::-1],
            LEFT,
            "fault",
            ("the left camera's image is mirrored: it shows no tag, its mirror image tags 0, 1, 2; switch",),
        ),
        (
            picture(at=(60.0, 80.0), numbers=(7, 8)),
            np.full((240, 320), 2, np.uint8),
            "fault",
            (
                "left image: tags 7, 8 are there, and markers has none of them: name the corners",
                "right camera: its image is black: take the cap off",
            ),
        ),
        (
            picture(at=(60.0, 80.0), numbers=(0, 1, 2), side=19.0),
            picture(numbers=(0, 1), at=(60.0, 80.0), blur=3.5),
            "warning",
            (
                " px a cell (4 at least): print larger tags, move the camera nearer",
                "right camera: its image is blurred by",
            ),
        ),
    ],
)
def test_a_mistake_with_tags_or_light_is_named_with_its_remedy(doctor, left, right, level, words):
    _, found = doctor(left, right)
    for text in words:
        assert [one for one in found[level] if text in one], found


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="device nodes of Linux")
@pytest.mark.parametrize(
    ("left", "right", "words"),
    [
        ("0", "/dev/video0", "cameras.right.source: is /dev/video0, that of the left camera as well"),
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
    known = {"marker": calibrated.marker.tolist(), "face": (0, 1, 2, 3), "views": ()}
    seen = SimpleNamespace(q=q, s=s, **known)
    side, diagonal = 0.04, 0.04 * np.sqrt(2.0)
    lengths = np.array([[0.0, side, diagonal, side], [side, 0.0, side, diagonal]])
    lengths = np.concatenate([lengths, np.roll(lengths, 2, axis=1)])
    finding = calibration_finding(calibrated, seen, (640, 480), lengths)
    assert words in f"{finding.text}: {finding.remedy}"
    assert (finding.level == "fine") == (words.startswith("agrees with the images"))
    unknown = calibration_finding(calibrated, seen, (640, 480), np.full((4, 4), np.nan))
    assert unknown.level == finding.level
    assert "mm" not in unknown.text


@pytest.mark.parametrize(("views", "slipped"), [(2, False), (2, True), (3, False)])
def test_a_camera_that_moved_is_named_with_the_poses_that_mend_it(calibrated, views, slipped):
    if views == 3:
        calibrated = of_hobby(f"rig.top={json.dumps(TOP)}", "calibration.frames_per_joint=4")
    q, off = calibrated.q_reference, np.zeros(len(calibrated.q_reference))
    off[1] = np.radians(3.0 * slipped)
    s = predict(calibrated, (q + off)[None])[0]
    s[1] += 0.0 if slipped else 12.0
    seen = SimpleNamespace(q=q, s=s, marker=calibrated.marker.tolist(), face=(0, 1, 2, 3), views=())
    fault = calibration_finding(calibrated, seen, (640, 480), np.full((4, 4), np.nan))
    finding, mend = with_refit(fault, calibrated, seen, (640, 480))
    assert finding.text.startswith(f"{fault.text}; the left images are ")
    assert (mend is None) == slipped
    if mend is not None:
        view, poses = mend
        assert view == "right"
        assert "the right images are 17 px off (0." in finding.text
        assert f"put the right camera back, or fit it again from {len(poses.q)} poses" in finding.remedy
        assert poses.before_px < poses.error_px <= 1.5 * poses.before_px


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
    assert [one.level for one in found] == ["fine"] * len(found)
    late = {one.where: float(one.text.split()[1]) for one in found if one.text.startswith("latency")}
    assert late == {"left camera": pytest.approx(120, abs=5), "right camera": pytest.approx(60, abs=5)}
    for one in found[:5]:
        hysteresis = float(one.text.split("hysteresis ")[1].split("°")[0])
        assert hysteresis == pytest.approx(0.6, abs=0.12)
        assert "backlash 0.3" in one.text or "backlash 0.4" in one.text
    assert max(np.degrees(np.ptp(one.q)) for one in moved) < 8.0


@pytest.mark.parametrize(
    ("faults", "moving", "where", "words"),
    [
        (
            Faults(link=3),
            range(5),
            "joints 4, 5",
            "no tag moved: the tags sit on the link before joint 4: mount them behind",
        ),
        (Faults(loose=3, loose_px=3.0), (0, 2), "tags", "tag 3 moved by"),
        (Faults(held=1), (1,), "joint 2", "went 0 deg of 3 deg: it is held or too weak: free it"),
    ],
)
def test_motions_name_what_a_recording_would_fail_at(faults, moving, where, words):
    found, _ = findings(faults, moving)
    (fault,) = (one for one in found if one.level == "fault")
    assert fault.where == where
    assert words in f"{fault.text}: {fault.remedy}"


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
    assert [one["where"] for one in found if (one["level"], one["text"]) == ("fault", "has no limits")] == [
        "joint 1",
        "joint 2",
    ]
    assert found[-1]["text"] == "were not moved: something above is a fault"


@pytest.mark.parametrize(
    ("frozen", "where", "words"),
    [
        ("[0, 1]", "joints 1, 2", "turned, and no tag moved: look whether the tags are on this arm"),
        ("[1]", "right camera", "its tags moved by 0.0 px with the joints (1 at least): look whether"),
    ],
)
def test_a_camera_that_repeats_one_frame_is_named(rail, tmp_path, frozen, where, words):
    answer, found, _ = rail(options=f", options: {{frozen: {frozen}}}")
    (fault,) = (one for one in found if one["level"] == "fault")
    assert (answer.code, fault["where"]) == (1, where)
    assert words in f"{fault['text']}: {fault['remedy']}"
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
    moved = Finding(FAULT, "calibration", "the left camera was moved", "put it back")

    def answer_to(finding):
        checked = Checked((finding,), None, ())
        monkeypatch.setattr("projservo_cli.stages.doctor.check", lambda *_, **__: checked)
        return projservo("doctor", "out", "-c", "arm.yaml")

    assert answer_to(moved).code == 1
    assert load("out").refuted == "the left camera was moved"
    with working_in(tmp_path / "out"):
        answer = answer_to(Finding(FINE, "calibration", "agrees with the images"))
    assert answer.code == 2
    assert "is at work there" in answer.err
    assert load("out").refuted == "the left camera was moved"
    assert answer_to(Finding(FINE, "calibration", "agrees with the images")).code == 0
    assert load("out").refuted == ""
