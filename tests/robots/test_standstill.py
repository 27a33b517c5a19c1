"""When a robot stands still, by readings of random joints and images in motion and at rest."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from projservo_cli.robots.contract import Reading
from projservo_cli.robots.standstill import Standstill

PERIOD, SECONDS = 0.05, 0.6


def readings(seed, joints, noise, speed, image_noise, image_speed):
    """Sixty looks at a robot of which one joint, rad/s, and the second image, px/s, move or do not."""
    rng = np.random.default_rng(seed)
    q0, s0 = rng.uniform(-1.0, 1.0, joints), rng.uniform(0.0, 500.0, (2, 4, 2))
    i = int(rng.integers(joints))
    for k in range(60):
        t = PERIOD * k
        q, s = q0 + noise * rng.standard_normal(joints), s0 + image_noise * rng.standard_normal(s0.shape)
        q[i] += speed * t
        s[1] += image_speed * t
        yield i, Reading(q, s, t, np.full(2, np.nan), None)


seeds, joints = st.integers(0, 2**32 - 1), st.integers(1, 7)
noises, image_noises = st.floats(1e-7, 1e-3), st.floats(1e-3, 0.5)


@given(seeds, joints, noises, image_noises)
def test_noise_is_no_motion(seed, n, noise, image_noise):
    """Not before the time is over, and soon after it: a test at three deviations may fail now and then."""
    still, at_rest = Standstill(SECONDS), []
    for _, reading in readings(seed, n, noise, 0.0, image_noise, 0.0):
        at_rest.append(still.all(reading))
    first = at_rest.index(True)
    assert first >= SECONDS / PERIOD
    assert sum(at_rest[first:]) > 0.5 * len(at_rest[first:])


@given(seeds, joints, noises, image_noises, st.booleans())
def test_what_moves_out_of_the_noise_is_named(seed, n, noise, image_noise, joint_moves):
    """By ten deviations in the time, and more than counts as still."""
    speed = (10.0 * noise + 4e-4) / SECONDS * joint_moves
    image_speed = (10.0 * image_noise + 0.4) / SECONDS * (not joint_moves)
    still, named = Standstill(SECONDS), []
    for i, reading in readings(seed, n, noise, speed, image_noise, image_speed):
        assert not still.all(reading)
        named.append(still.moving == (f"joint {i + 1}" if joint_moves else "the right image"))
    late = named[int(2 * SECONDS / PERIOD) :]
    assert sum(late) > 0.5 * len(late)
