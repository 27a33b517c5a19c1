"""A number that moves, is lost or changes its unit is found; what tells of time and place is not."""

import h5py
import numpy as np
import pytest

from tests.golden.numbers import differences, of_file, of_json


@pytest.fixture
def stored(tmp_path):
    """Write a file with an array and a scalar; what is read of it."""

    def write(value, unit="px", **scalars):
        path = tmp_path / "run.h5"
        with h5py.File(path, "w") as file:
            file["images"] = np.array([1.0, np.nan, value])
            file["images"].attrs["units"] = unit
            file.attrs.update(scalars)
        return dict(of_file(path, "run"))

    return write


@pytest.mark.parametrize(
    ("value", "kind"), [(2.0, "equal"), (2.0 + 1e-12, "near"), (2.0 + 1e-6, "apart"), (np.nan, "apart")]
)
def test_an_array_that_moves_is_found(stored, value, kind):
    told = differences(stored(2.0), stored(value))
    assert [line.split(":")[0] for line in told[kind] if "@" not in line] == ["run/images"]


def test_units_and_scalars_are_compared_and_times_are_not(stored):
    old = stored(2.0, rms_px=1.0, verdict="converged", seconds=1.0, key="a")
    new = stored(2.0, "m", rms_px=1.0, verdict="no progress", seconds=2.0, key="b")
    told = differences(old, new)
    assert [line.split(":")[0] for line in told["apart"]] == ["run/@verdict", "run/images@units"]
    assert len(told["equal"]) == 3


def test_a_leaf_of_json_that_is_lost_is_found():
    old = dict(of_json({"laws": [{"steps": 3, "reason": None}], "run": "/a"}, "0"))
    told = differences(old, dict(of_json({"laws": [{"steps": 3}], "run": "/b"}, "0")))
    assert told["lost"] == ["0/laws/0/reason"]
    assert not told["apart"]
