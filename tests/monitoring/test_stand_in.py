"""Faults that are none: what the study of monitoring, with errors of corners as measured, found once."""

import numpy as np
import pytest

from projservo_cli.monitoring.fault_at_rest import fault_at_rest
from projservo_cli.records import Observation
from tests.monitoring.stand_in import IMAGE, StandIn
from tests.studies.monitoring import Rig, calibrated, driven, tasks

_BENT = np.array([[-0.15, 0.2], [-0.4, 0.1], [0.6, -0.5], [0.5, 0.15]])  # px


@pytest.mark.parametrize(
    ("rig", "number", "level"),
    [(Rig("five", "jpeg", 0.0, 0.0), 140240, ("hand", 1)), (Rig("six", "none", 0.0, 0.0), 120259, ("blur",))],
    ids=["hand", "blur"],
)
def test_what_has_passed_is_no_fault(rig, number, level):
    # Windows show it all along; images since then agree, and no cause explains them better than none.
    (row,) = driven((rig, [("sound", number, level)]))
    assert row["verdict"] == "converged", row["reason"]


@pytest.mark.parametrize(
    ("bent", "by", "shift", "named"),
    [
        ((), 0.0, 0.0, None),
        ((1, 4), 1.0, 0.0, None),
        ((1, 4), 1.0, 3.0, "displaced_camera"),
        ((0, 1, 4), 2.0, 0.0, "unexplained_images"),
    ],
)
def test_tags_that_are_bent_in_one_posture_are_no_fault_and_hide_no_camera(bent, by, shift, named):
    # Corners of a slanted tag that are off by up to 0.8 px, as a detector of sharp images has them.
    rig = Rig("five", "finder", 0.0, 0.0)
    goal = next(tasks(rig, np.random.default_rng(1)))[1]
    robot, size = StandIn(**rig.options(at_deg=goal, seed=2)), np.array(IMAGE, dtype=float)
    q, s = robot.read()[:2]
    for tag in bent:
        s[:, 4 * tag : 4 * tag + 4] += by * _BENT
    s[0] += shift
    known = calibrated(rig)
    fault = fault_at_rest(known, Observation.of_one(np.arange(20), q, s, known.view), size)
    assert (fault and (fault.others or (fault,))[0].code) == named


@pytest.mark.parametrize(
    ("rig", "number", "level"),
    [
        (Rig("six", "finder", 0.0, 0.08), 20025, ("exchange",)),  # each view shows other markers
        (Rig("five", "none", 0.3, 0.08), 40003, ("home", 1, 15.0)),  # a tag comes to where another one was
        (Rig("five", "jpeg", 0.3, 0.0), 30036, ("sign", 6)),
    ],
    ids=["exchange", "home", "sign"],
)
def test_what_moves_all_images_is_named_before_what_moves_some(rig, number, level):
    (row,) = driven((rig, [("faults", number, level)]))
    assert row["judged"] in ("right", "pair"), row["reason"]
