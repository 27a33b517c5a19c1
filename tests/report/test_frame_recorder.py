"""The animation of both camera images, as it is written."""

import numpy as np
import pytest
from PIL import Image, ImageSequence

from projservo_cli.records import Trace
from projservo_cli.report import animation
from tests.fake_records import fake
from tests.report.cases import case

PALE_ORANGE = "#F0C566"  # of what is hidden, on paper, as all frames show it


def run(end=4, hidden=(2,), verdict="converged"):
    """Four corners that go right by 10 px in each second, hidden from the left camera at some instants."""
    corners = np.array([[100.0, 100.0], [140.0, 100.0], [140.0, 140.0], [100.0, 140.0]])
    s = np.stack([np.stack([corners + np.array([10.0 * k, 0.0])] * 2) for k in range(end + 1)])
    behind = np.zeros((end + 1, 2), dtype=bool)
    behind[list(hidden), 0] = True
    return fake(Trace, steps=end, period=1.0, verdict=verdict, s=s, s_star=s[-1], self_occluded=behind)


@pytest.fixture
def frames(tmp_path, monkeypatch):
    """Pixels of so many frames of an animation of named runs, at equal steps of its time."""

    def written(count, **runs):
        monkeypatch.setattr(animation, "FRAMES", count)
        animation.write_animation(tmp_path / "film.gif", runs, np.arange(4), (1280, 1024), lambda *_: None)
        with Image.open(tmp_path / "film.gif") as film:
            return [np.array(frame.convert("RGB")) for frame in ImageSequence.Iterator(film)]

    return written


def count(pixels, color):
    wanted = [int(color[i : i + 2], 16) for i in (1, 3, 5)]
    return np.count_nonzero((np.abs(pixels.astype(int) - wanted) < 40).all(axis=2))


def test_the_direct_law_stands_beside_the_classical_ones(frames):
    traces = case()[2].traces
    beside = ("direct_three", "stacked", "blockwise", "euclidean_points")
    shown = [frames(1, **{name: traces[name] for name in names})[0] for names in (traces, beside)]
    np.testing.assert_array_equal(*shown)
    for names, width in ((("direct_two", "exact"), 510), (("stacked",), 400)):
        (pixels,) = frames(1, **{name: traces[name] for name in names})
        assert abs(pixels.shape[1] - width) <= 1


def test_the_face_moves_and_hidden_instants_are_marked(frames):
    first, hidden, last = frames(3, one=run())
    assert abs(first.shape[1] - 400) <= 1  # room for the legend
    assert (first != last).any(axis=2).sum() > 500
    # The legend has some of the colour; the filled face and the word beside it are more.
    orange = [count(pixels, PALE_ORANGE) for pixels in (first, hidden, last)]
    assert orange[1] > orange[0] + 500
    green = [count(pixels, animation.SEEN) for pixels in (first, hidden, last)]
    assert min(green[0], green[2]) > 1.5 * green[1]
    legend = first[-60:]  # is whole
    assert (legend[:, [0, 1, 2, -3, -2, -1]] > 250).all()
    assert (legend < 128).any()
