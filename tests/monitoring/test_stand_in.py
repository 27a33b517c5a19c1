"""Faults that are none: what the study of monitoring, with errors of corners as measured, found once."""

import pytest

from tests.studies.monitoring import Rig, driven


@pytest.mark.parametrize(
    ("rig", "number", "level"),
    [(Rig("five", "jpeg", 0.0, 0.0), 140240, ("hand", 1)), (Rig("six", "none", 0.0, 0.0), 120259, ("blur",))],
    ids=["hand", "blur"],
)
def test_what_has_passed_is_no_fault(rig, number, level):
    # Windows show it all along; images since then agree, and no cause explains them better than none.
    (row,) = driven((rig, [("sound", number, level)]))
    assert row["verdict"] == "converged", row["reason"]
