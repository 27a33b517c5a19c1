"""What a comparison of all numbers tells: moved, reworded and lost ones apart."""

import numpy as np

from tests.golden import numbers


def test_what_moves_is_compared_and_not_lost(monkeypatch):
    monkeypatch.setattr(numbers, "RENAMED", ((r"/calibration/(P|M)\b", r"/calibration/rig/\1"),))
    old = {
        "r/calibration/P": np.ones(2),
        "r/calibration/P@units": np.array("px"),
        "r/calibration/M": np.ones(1),
    }
    new = {"r/calibration/rig/P": np.ones(2), "r/calibration/rig/P@units": np.array("px"), "r/x": np.ones(1)}
    old["r/reason"], new["r/reason"] = np.array("the arm was lost"), np.array("the arm is lost now")
    old["r/y"], new["r/y"] = np.ones(1), np.full(1, 1.0 + 1e-8)
    told = numbers.differences(old, new)
    assert told["equal"] == ["r/calibration/rig/P", "r/calibration/rig/P@units"]
    assert (told["lost"], told["new"]) == (["r/calibration/rig/M"], ["r/x"])
    assert [len(told[kind]) for kind in ("reworded", "apart", "near")] == [1, 1, 0]
