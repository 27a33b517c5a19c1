"""Words for findings: each code, before any cameras, for joints that turn and that slide."""

import itertools
import json
import re

import numpy as np
import pytest

from projservo_cli import messages
from projservo_cli.deviations import DEVIATIONS
from projservo_cli.findings import LIMITS, REFUSES, Finding, Subject, sparse
from projservo_cli.messages import rows_by_code
from projservo_cli.records import TOOL, WORLD

VIEWS = ("left", "right", "top", "far side")
COUNTED = Finding(
    "id_switches", subject=Subject((), ("left",), (5,), 1, (), "tray"), amount=3.0, limit=9.0, unit="1"
)


def finding(code, joint_unit):
    """A finding with all that its words may name."""
    unit = {"scale": "1", "coupling": "1"}.get(code, joint_unit if "joint" in code else "px")
    joints = (3, 2) if "coupling" in code or code == "level_hand" else (2,)
    name = "singular" if code.startswith("replanned") else "arm.json"
    subject = Subject(joints, ("left", "right"), (5, 6), 3, (7, 9), name)
    return Finding(code, LIMITS, subject, 0.02, 0.001, 0.5, unit, 1.5, 0.2, (COUNTED, COUNTED, COUNTED))


@pytest.mark.parametrize("code", messages.ROWS)
def test_each_finding_has_words_whatever_the_arm_and_the_cameras(code):
    for mount, count, unit in itertools.product((WORLD, TOOL), (1, 2, 3, 4), ("rad", "m")):
        one = finding(code, unit)
        setup = rows_by_code.Setup(mount, VIEWS[:count], 1 if count == 1 else 6)
        if code in DEVIATIONS:
            one = Finding(**vars(one) | {"others": (finding("joint_step", unit), finding("base", unit))})
        row = messages.table_row(one, setup)
        for text in (messages.sentence_and_remedy(one, setup), messages.limit(one, setup), *row.values()):
            assert not re.search(r"\{\w*\}|\bnan\b|  |None", text), text
        line = messages.sentence_and_remedy(one, setup)
        told = line.split(" (or ")[0]
        if "joint" in code and "{size}" in messages.ROWS[code].sentence:
            assert {"rad": "1.1°", "m": "20 mm"}[unit] in told
        if code == "tool":
            assert ("on the tool" if mount == WORLD else "in the scene") in told
        if "{joints}" in messages.ROWS[code].sentence:
            assert "joint" in line


def test_deviations_name_what_else_explains_the_images():
    one = finding("scale", "rad")
    one = Finding(**vars(one) | {"others": (finding("joint_step", "rad"), finding("base", "rad"))})
    line = messages.sentence_and_remedy(one, rows_by_code.Setup())
    assert "(or step of joint 2, or motion of the base or the cameras: the images do not tell); fit" in line
    assert line.startswith("joint 2 moves 2 % ± 0.1 % more than it reads")


def test_joints_that_are_alike_share_a_line():
    few = [
        Finding("little_motion", LIMITS, Subject(joints=(i,)), 0.05, limit=0.2 * i, unit="rad")
        for i in (1, 2)
    ]
    one = Finding("little_motion", LIMITS, Subject(joints=(4,)), 0.01, limit=0.05, unit="m")
    together = messages.lines([*few, one], rows_by_code.Setup())
    assert together == (
        "joints 1, 2 and 4 moved only 2.86°, 2.86° and 10 mm: move each at least 11.5°, 22.9° and 50 mm",
    )


def test_a_refusal_names_its_cause_first_and_a_hint_last():
    cause = Finding("joint_type", REFUSES, Subject(joints=(2,), name="RPR"), unit="m")
    misfit = Finding("misfit", REFUSES, Subject(name="views"), 3.0, limit=0.5, unit="px")
    hint = finding("sag", "rad")
    text = messages.refused([cause, misfit], rows_by_code.Setup())
    assert text.startswith("by the images joint 2 is prismatic, not revolute: check the types of joints, ")
    assert "(RPR would fit); as given, the fit does not describe the data: residuals of 3 px a" in text
    assert text.endswith(
        "are 6 times the 0.5 px that the epipolar geometry shows; check the joint readings, "
        "their units and types, and the marker numbers"
    )
    assert "; the residuals look as if joint 2 sags" in messages.refused([misfit, hint], rows_by_code.Setup())


def test_cameras_without_a_marker_are_named_by_their_number():
    for view, dark, told in [
        (("top",), ("top",), "the top camera shows no marker"),
        (VIEWS[:2], ("left",), "the left camera shows no marker"),
        (VIEWS[:2], VIEWS[:2], "neither camera shows a marker"),
        (VIEWS[:3], ("left", "top"), "none of the cameras left, top shows a marker"),
        (VIEWS[:3], VIEWS[:3], "no camera shows a marker"),
    ]:
        one = Finding("unseen_markers", subject=Subject(views=dark))
        assert messages.sentence(one, rows_by_code.Setup(view=view)) == f"{told} of the calibration"


def test_no_two_tables_have_words_for_one_code():
    assert sum(map(len, rows_by_code.TABLES)) == len(rows_by_code.ROWS)


def test_numbers_of_numpy_in_findings_are_stored_as_plain_ones():
    one = Finding("misfit", subject=Subject(joints=(np.int64(2),)), amount=np.int64(3), limit=np.float32(0.5))
    stored = json.loads(json.dumps(one, default=sparse))
    assert stored == {"code": "misfit", "subject": {"joints": [2]}, "amount": 3, "limit": 0.5}
