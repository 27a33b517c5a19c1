"""The watch over an object: its motion is found whichever way it goes, and nothing else counts as one."""

import numpy as np
import pytest
from scipy.linalg import expm

from projservo_cli.geometry.kinematics import project
from projservo_cli.robots.contract import Reading
from projservo_cli.robots.object_watch import LOOKS, ObjectWatch
from tests.samples import hat

K = np.array([[1200.0, 0.0, 640.0], [0.0, 1200.0, 512.0], [0.0, 0.0, 1.0]])
P = np.array([K @ np.c_[np.eye(3), [x, 0.0, 1.5]] for x in (0.15, -0.15)])
# Two tags of 60 mm, one of them inclined.
TAG = 0.03 * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
X = np.c_[np.r_[TAG - [0.05, 0.0, 0.0], TAG @ expm(hat([0.0, 0.6, 0.0], np.zeros(3)))[:3, :3]], np.ones(8)]
SIGMA = 0.5


def images(T):
    return project(P, X @ T.T)


def by_motion():
    """Derivatives (2, 8, 2, 6) by three translations and three turns."""
    twists = np.r_[np.zeros((3, 3)), np.eye(3)], np.r_[np.eye(3), np.zeros((3, 3))]
    steps = [1e-6 * hat(*each) for each in zip(*twists, strict=True)]
    return np.stack([(images(expm(E)) - images(expm(-E))) / 2e-6 for E in steps], axis=-1)


def watched(seed, off, looks=2 * LOOKS):
    """The finding after so many readings, in which images are off by some pixels, and when it was found."""
    rng, still = np.random.default_rng(seed), images(np.eye(4))
    planned = still + SIGMA / np.sqrt(10.0) * rng.standard_normal(still.shape)
    sigma = np.full(still.shape[:2], SIGMA / np.sqrt(10.0))
    watch = ObjectWatch("part", range(8), np.arange(8), planned, sigma, by_motion())
    for k in range(looks):
        s = still + off + SIGMA * rng.standard_normal(still.shape)
        names = ("left", "right")
        watch.observe(Reading(np.zeros(1), s[:, :0], 0.0, np.full(2, np.nan), None, s_objects=s, view=names))
        if watch.moved:
            return watch.moved, k
    return None, looks


@pytest.mark.parametrize("axis", range(3))
def test_an_object_that_moves_by_ten_millimetres_is_found_whichever_way(axis):
    """Towards the cameras its images move by less than a pixel, apart in both."""
    for seed in range(5):
        for sign in (-1.0, 1.0):
            T = np.eye(4)
            T[axis, 3] = 0.01 * sign
            found, k = watched(seed, images(T) - images(np.eye(4)))
            assert found.code == "moved_object"
            assert k < LOOKS
            assert len(found.subject.views) == 2 or axis < 2


def test_an_object_that_stands_still_is_not_found_moving():
    """1e-6 is the chance of a look; 40 runs of 300 looks."""
    assert not any(watched(seed, 0.0, 300)[0] for seed in range(40))


def test_one_camera_that_moved_is_no_object_that_did_before_it_is_named():
    off = np.zeros((2, 1, 2))
    off[0] = (3.0, -2.0)
    for seed in range(5):
        assert watched(seed, off)[1] >= LOOKS


def test_edges_that_another_light_moves_are_no_motion():
    """All corners a third of a pixel outwards, as of a tag that shines."""
    s = images(np.eye(4))
    outwards = s - np.repeat(s.reshape(2, 2, 4, 2).mean(axis=2), 4, axis=1)
    outwards /= np.linalg.norm(outwards, axis=2, keepdims=True)
    assert not any(watched(seed, 0.33 * outwards)[0] for seed in range(5))
