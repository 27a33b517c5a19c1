"""Displaced goals: the same in any projective frame, and as far as asked for in metres or pixels."""

import numpy as np
import pytest

from projservo_cli.geometry.kinematics import project
from projservo_cli.monitoring.arrival_accuracy import metres_a_unit
from projservo_cli.records import InputError, WorkFailed
from projservo_cli.task.body_pose import make_body
from projservo_cli.task.stand_off import StandOff, displacement_back
from tests.samples import frame, in_frame, poe
from tests.task.test_incidences import deviating, random_arm

ALONG = {"line": ((4,), (5,)), "plane": ((4,), (5,), (6,))}


def displaced(model, M, q, asked, G, metre=1.0):
    """Displacement in the frame G, brought back from it."""
    model, M = in_frame(model, G), M @ G.T
    body, shows = make_body(model, M), np.ones((2, len(M)), dtype=bool)
    shows[0, 3] = False
    return np.linalg.inv(G) @ displacement_back(model, body, poe(model, q), asked, shows, metre) @ G


@pytest.mark.parametrize("kind", ALONG)
@pytest.mark.parametrize("amount", [{"by_m": 0.05}, {"by_m": -0.02}, {"by_px": 30.0}, {"by_px": -7.0}])
def test_a_displaced_goal_is_as_far_as_asked_for_in_any_frame(kind, amount):
    for seed in range(5):
        generator = np.random.default_rng(seed)
        model, M = random_arm(generator)
        q = model.q_reference + deviating(generator)
        asked = StandOff("pin", ALONG[kind], **({"by_m": None, "by_px": None} | amount))
        frames = [np.eye(4), frame(seed)]
        apart = np.zeros((len(M), len(M)))
        apart[0, 2] = np.linalg.norm(M[0] - M[2])  # a length that is known
        units = [metres_a_unit(in_frame(model, G), M @ G.T, apart) for G in frames]
        each = [displaced(model, M, q, asked, G, u) for G, u in zip(frames, units, strict=True)]
        each = [back / back[3, 3] for back in each]
        assert np.abs(np.array(each) - each[0]).max() < 1e-8, seed
        np.testing.assert_allclose(each[0][:3, :3], np.eye(3), atol=1e-9)
        moved, points = each[0][:3, 3], (M[list(map(max, ALONG[kind]))] @ poe(model, q).T)[:, :3]
        length = np.linalg.norm(moved)
        sense = np.sign(next(iter(amount.values())))
        if kind == "line":
            axis = points[0] - points[1]
            assert sense * moved @ axis == pytest.approx(length * np.linalg.norm(axis), rel=1e-9)
        else:
            assert np.abs((points[1:] - points[0]) @ moved).max() < 1e-9 * length
        if "by_m" in amount:
            assert length == pytest.approx(abs(amount["by_m"]), rel=1e-7)
            continue
        there, H = M @ poe(model, q).T, each[0]
        apart = np.linalg.norm(project(model.P, there @ H.T) - project(model.P, there), axis=2)
        apart[0, 3] = np.nan
        assert np.nanmean(apart, axis=1).max() == pytest.approx(abs(amount["by_px"]), rel=1e-9)


def test_what_cannot_be_displaced_is_refused_in_one_line():
    model, M = random_arm(np.random.default_rng(0))
    q, line = model.q_reference, ALONG["line"]
    for asked, metre, error, words in (
        (StandOff("pin", line, 0.05, None), np.nan, InputError, "by_m needs a known length .* by_px"),
        (StandOff("pin", ((4,), (4,)), 0.05, None), 1.0, WorkFailed, "points of pin span no line"),
        (StandOff("pin", line, None, 1e9), 1.0, WorkFailed, "no distance along pin moves the images by"),
    ):
        with pytest.raises(error, match=words) as refused:
            displaced(model, M, q, asked, np.eye(4), metre)
        assert "\n" not in str(refused.value)
