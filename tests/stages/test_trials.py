"""Trial motions of robots whose joints or images may have faults."""

from pathlib import Path

import numpy as np
import pytest

from projservo_cli.config import Config, load_config
from projservo_cli.stages import record as trials
from projservo_cli.stages.world import joints_of, truth_of

UR5 = Path(__file__).parents[2] / "configs" / "ur5.yaml"


@pytest.fixture
def faulty(monkeypatch):
    monkeypatch.setattr(Config, "is_ideal", False)


def test_poses_of_all_joints_follow_and_no_reading_comes_twice(faulty):
    config = load_config(UR5)
    q, truth, joints = trials.trial_motions(config), truth_of(config), joints_of(config)
    assert q.shape == (1 + 6 * 8 + 12, 6)
    np.testing.assert_array_equal(q, trials.trial_motions(config))
    assert all(len(np.unique(column)) == len(q) for column in q.T)
    tick = 2.0 * np.pi / 4096
    moved = np.abs(q - q[0]) > 2.0 * tick
    assert (moved[1:49].sum(axis=1) <= 1).all()
    assert (moved[49:].sum(axis=1) >= 5).all()
    assert np.abs(q - q[0]).max() <= np.radians(30.0) + 2.0 * tick
    assert ((q >= joints.limits.lower) & (q <= joints.limits.upper)).all()
    seen = np.isfinite(trials.simulate(config, truth).images).all(axis=(1, 3))
    assert seen.mean(axis=1).min() >= 0.5


def test_an_ideal_robot_gets_those_that_are_asked_for():
    config = load_config(UR5)
    asked = load_config(UR5, ["calibration.random_poses=5"])
    plain, more = trials.trial_motions(config), trials.trial_motions(asked)
    assert len(plain) == 49
    np.testing.assert_array_equal(more[:49], plain)
    assert (more[49:] != plain[0]).all()
    assert len(more) == 54
