"""Frames of a robot: which are kept of a run, and that they are what was seen, with what was found in it."""

import io

import numpy as np
import pytest
from PIL import Image

from projservo_cli.records import Trace
from projservo_cli.report.figures.images import frames_of_run
from projservo_cli.robots.frame_recorder import MOST_FRAMES, FrameRecorder
from projservo_cli.store.run_file import load
from tests.fake_records import fake
from tests.robots.robots import Sound
from tests.robots.test_servo import OPTIONS, QUICK


@pytest.mark.parametrize("looks", [1, 2, 59, 60, 61, 118, 1000])
def test_frames_are_thinned_evenly_and_the_first_and_last_are_kept(looks):
    film, s = FrameRecorder(), np.arange(12.0).reshape(2, 3, 2)
    for k in range(looks):
        film.show(k, s + k, np.full((2, 8, 16), [[[k % 251]], [[255 - k % 251]]], dtype=np.uint8))
    told = film.recorded()
    instant = told.frame_index
    assert (instant[0], instant[-1]) == (0, looks - 1)
    assert min(looks, MOST_FRAMES // 2) <= len(instant) <= MOST_FRAMES
    ways = np.diff(instant)
    assert len(set(ways[:-1])) <= 1
    assert len(ways) < 2 or ways[-1] <= ways[0]
    np.testing.assert_array_equal(told.frame_s, [s + k for k in instant])
    shown = frames_of_run(fake(Trace, **vars(told)))
    assert [film.shape for film in shown] == [(len(instant), 8, 16)] * 2
    assert shown[0].mean(axis=(1, 2)) == pytest.approx(instant % 251, abs=1.0)
    assert shown[1].mean(axis=(1, 2)) == pytest.approx(255 - instant % 251, abs=1.0)


class Seeing(Sound):
    """Has frames, in which a marker is a bright square."""

    frames = None

    def read(self):
        q, s = super().read()
        width, height = self.world.image_size[0].astype(int)
        self.frames = np.full((2, height, width), 30, dtype=np.uint8)
        for view, marker in np.ndindex(s.shape[:2]):
            u, v = s[view, marker].round().astype(int)
            self.frames[view, v - 5 : v + 6, u - 5 : u + 6] = 220
        return q, s


def test_the_frames_of_a_run_show_what_was_found_in_them(servo):
    seeing = f"plant={{use: '{__name__}:Seeing', {OPTIONS}}}}}"
    assert servo("--set", seeing, *QUICK, "-q").code == 0
    trace = load("run").traces["direct_three"]
    assert trace.frame_index[0] == 0
    assert trace.frame_index[-1] == trace.steps
    assert trace.frame_jpeg.nbytes < 3e6
    frames = np.stack(frames_of_run(trace), axis=1)
    assert frames.shape[1:] == (2, 1024, 1280)
    k, view = np.indices(trace.frame_s.shape[:3])[:2]
    u, v = np.moveaxis(trace.frame_s, -1, 0).round().astype(int)
    assert frames[k, view, v, u].min() > 180
    assert np.median(frames) == pytest.approx(30, abs=1)
    half = frames_of_run(trace, np.array([3]), width=640)
    assert [film.shape for film in half] == [(1, 512, 640)] * 2
    assert Image.open(io.BytesIO(trace.frame_jpeg[: trace.frame_size[0, 0]].tobytes())).mode == "L"
