"""Late images: what is estimated from frames on the way, against the truth of a small simulation."""

import dataclasses

import numpy as np
import pytest

from projservo_cli.calibration import calibrate
from projservo_cli.calibration.time_offset import with_time_offset
from projservo_cli.records import Observation
from tests.calibration.simulated_robot import around, random_robot, trials

SIGMA, PERIOD, MOTIONS, SECONDS = 0.3, 0.04, 10, 0.8


@pytest.fixture(scope="module")
def known():
    """A robot and its calibration."""
    rng = np.random.default_rng(16)
    robot = random_robot("RRPR", rng, 6)
    seen = robot.observe(np.concatenate([trials(robot, frames=5), around(robot, 8, rng)]), SIGMA, rng)
    return robot, calibrate(seen, "RRPR", source="recorded")


class Cameras:
    """Two cameras that take a frame at each look, or run freely with an interval, s, 16 ms apart."""

    def __init__(self, delay, interval, jitter, rng):
        self.delay, self.interval, self.jitter = delay, interval, jitter * rng.standard_normal((2, 2000))
        self.phase = rng.uniform(0.0, 0.03)

    def newest(self, view, now):
        """Number and middle of the exposure of the newest frame that is there."""
        first, looks = self.phase + 0.016 * view, round(now / PERIOD)
        if self.interval is None:
            return looks, now - self.delay + self.jitter[view, looks]
        k = int((now - self.delay - first) / self.interval) + 2
        middle = [first + i * self.interval + self.jitter[view, i] for i in range(k)]
        k = max(i for i in range(k) if middle[i] + self.delay <= now)
        return k, middle[k]


def on_the_way(robot, cameras, rng, *, stamped=False):
    """Poses in motion, smooth from rest to rest, and the mean delay (2,) of their frames, each once."""
    pose = np.concatenate([robot.q_reference[None], around(robot, MOTIONS, rng)])
    rows, late, frames = [], [[], []], {}

    def joints(t):
        k, share = divmod(max(t, 0.0) - 1.0, SECONDS + 1.0)
        x = np.clip(share / SECONDS, 0.0, 1.0)
        k = min(int(k), MOTIONS - 1)
        return (
            pose[0]
            if t < 1.0
            else pose[k] + (pose[k + 1] - pose[k]) * (x - np.sin(2 * np.pi * x) / (2 * np.pi))
        )

    for look in range(25, int((1.0 + SECONDS) / PERIOD) * MOTIONS):
        now = look * PERIOD
        k, share = divmod(now - 1.0, SECONDS + 1.0)
        if share > SECONDS + 0.4:
            continue
        shown, stamps = np.empty((2, len(robot.markers), 2)), np.empty(2)
        for view in (0, 1):
            number, middle = cameras.newest(view, now)
            if (view, number) not in frames:
                pixels = robot.images(joints(middle)[None])[0, view]
                frames[view, number] = pixels + SIGMA * rng.standard_normal(pixels.shape)
                late[view].append(now - middle)
            shown[view], stamps[view] = frames[view, number], middle + 77.0 + view
        rows.append((int(k) + 1, now, joints(now), shown, stamps))
    moving, t_q, q, images, stamps = (np.array(column) for column in zip(*rows, strict=True))
    seen = Observation(-1 - np.arange(len(rows)), 5 + 3 * np.arange(6), q, images, moving, t_q)
    return dataclasses.replace(seen, t_view=stamps if stamped else None), np.array([np.mean(d) for d in late])


@pytest.mark.parametrize(
    ("late", "free", "stamped"),
    [(0.0, False, False), (0.3, True, False), (0.3, False, True), (0.0, True, True)],
)
def test_delay_of_each_view_is_within_5_ms_and_its_interval(known, late, free, stamped):
    robot, calibration = known
    rng = np.random.default_rng([int(1e3 * late), free, stamped])
    cameras = Cameras(late, *((1.0 / 30.0, 0.008) if free else (None, 0.0)), rng)
    seen, truth = on_the_way(robot, cameras, rng, stamped=stamped)
    found = with_time_offset(calibration, seen)
    assert found.time_offset_s == pytest.approx(truth, abs=5e-3)
    assert (
        (found.time_offset_interval_s[:, 0] <= truth) & (truth <= found.time_offset_interval_s[:, 1])
    ).all()
    assert np.ptp(found.time_offset_interval_s, axis=1).max() < 0.008
    # Frames of cameras that run freely are up to an interval late; stamps tell by how much each is.
    deviation = np.hypot(0.008, 1.0 / 30.0 / np.sqrt(12.0)) if free and not stamped else 0.0
    assert found.time_offset_jitter_s == pytest.approx(deviation, abs=2.5e-3)


def test_without_frames_that_tell_it_there_is_no_delay(known):
    robot, calibration = known
    rng = np.random.default_rng(4)
    seen, _ = on_the_way(robot, Cameras(0.1, None, 0.0, rng), rng)
    assert with_time_offset(calibration, dataclasses.replace(seen, moving=None)) is calibration
    assert with_time_offset(calibration, seen.rows(seen.moving == 99)) is calibration
    still = np.linalg.norm(seen.q - robot.q_reference, axis=1) < 1e-6
    assert with_time_offset(calibration, seen.rows(still)) is calibration
