"""Runs without traces: each a function of its seed, whatever was made before it in the same arrays."""

import numpy as np
import pytest

from projservo_cli.loop.trial import NUMBERS, VERDICT
from projservo_cli.records import WorkFailed
from projservo_cli.stages import calibrate
from projservo_cli.stages.scenario import scenario_of
from projservo_cli.sweep import runs
from projservo_cli.sweep.design import changed, name_of_run
from projservo_cli.sweep.runs import is_compiled, numbers_of
from tests.sweep.cases import design

pytestmark = pytest.mark.volume


def prepared(**settings):
    """What runs of a small sweep share, with a value or two of its configuration changed."""
    config = changed(design().calibrated(0, 0), settings, "test")
    _, calibration, _ = calibrate.run(config)
    return scenario_of(config, calibration), name_of_run(config)


def test_noise_for_fewer_instants_changes_nothing(monkeypatch):
    """A run that outlasts its noise is made anew with more of it."""
    found = prepared()
    whole = numbers_of(*found, [1, 2])
    assert whole[:, NUMBERS.index("steps")].min() > 8
    monkeypatch.setattr(runs, "INSTANTS", 2)
    assert numbers_of(*found, [1, 2]).tobytes() == whole.tobytes()


def test_a_task_that_cannot_be_begun_has_a_verdict_and_no_numbers():
    """Images so noisy that markers have no place leave nothing to count; a goal out of reach is an error."""
    numbers = numbers_of(*prepared(**{"noise.servo_px": 3000.0}), [1, 2, 3])
    assert (numbers[:, VERDICT] < 0).any()
    lost = numbers[numbers[:, VERDICT] < 0]
    assert np.isnan(np.delete(lost, VERDICT, axis=1)).all()
    with pytest.raises(WorkFailed, match="limits"):
        prepared(**{"task.start_offset": {"joints": [0, 0, 400, 0, 0, 0], "unit": "deg"}})


@pytest.mark.parametrize(
    ("key", "value"),
    [("plant.speed_scale", 0.5), ("trajectory.profile", "constrained"), ("control.mode", "track")],
)
def test_runs_that_need_more_than_their_images_are_made_elsewhere(key, value):
    found = design(grid={"law": ["exact"]})
    assert is_compiled(found, found.cell(0))
    assert not is_compiled(found, changed(found.cell(0), {key: value}, "test"))
