"""A run file of the first release still opens and can be reported; other schemas say what to do."""

import h5py
import numpy as np
import pytest

from projservo_cli import store
from projservo_cli.config import load_config
from projservo_cli.records import InputError
from projservo_cli.report.page import write_page


def test_it_holds_what_it_held(run):
    found = store.load(run)
    assert list(found.results) == ["calibrate", "plan", "servo/direct_three", "servo/stacked", "report"]
    assert found.calibration.joint_types == "RRRRRR"
    assert found.calibration.method == "closed_form"
    assert found.observation.images.shape == (25, 2, 10, 2)
    assert found.plan.H_d.shape == (6, 4, 4)
    np.testing.assert_allclose(found.plan.mu[-1], 1.0, rtol=1e-12)  # the whole task is done at the end
    assert {name: trace.steps for name, trace in found.traces.items()} == {"direct_three": 12, "stacked": 12}
    assert load_config(run, text=found.configuration).name == "first-release"


def test_it_can_be_shown_on_a_page(run):
    page = write_page(store.load(run))
    assert "first-release" in page.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("version", "remedy"),
    [
        (store.SCHEMA_VERSION + 1, "pip install --upgrade projservo"),
        (0, "make it again: projservo calibrate"),
    ],
)
def test_another_schema_says_what_to_do(run, version, remedy):
    with h5py.File(run, "a") as file:
        file.attrs["schema_version"] = version
    with pytest.raises(InputError, match=remedy):
        store.load(run)
