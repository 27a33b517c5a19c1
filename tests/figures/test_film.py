"""The animation of both camera images."""

import numpy as np
import pytest

from projservo_cli.records import Trace
from projservo_cli.report import animation as film
from projservo_cli.report import style
from tests.fake_records import fake
from tests.figures.cases import case

SIZE = np.array([1280.0, 1024.0])


ORDER = np.arange(4)


def run(end=4, hidden=(2,), verdict="converged"):
    """Four corners that go right by 10 px in each second, hidden from the left camera at some instants."""
    corners = np.array([[100.0, 100.0], [140.0, 100.0], [140.0, 140.0], [100.0, 140.0]])
    s = np.stack([np.stack([corners + np.array([10.0 * k, 0.0])] * 2) for k in range(end + 1)])
    behind = np.zeros((end + 1, 2), dtype=bool)
    behind[list(hidden), 0] = True
    return fake(Trace, steps=end, period=1.0, verdict=verdict, s=s, s_star=s[-1], self_occluded=behind)


def frames(runs, at):
    with style.styled():
        named = {f"law {k}": one for k, one in enumerate(runs)}
        return list(film.frames(named, ORDER, SIZE, np.asarray(at, dtype=float)))


def count(pixels, color):
    wanted = [int(color[i : i + 2], 16) for i in (1, 3, 5)]
    return np.count_nonzero((np.abs(pixels.astype(int) - wanted) < 40).all(axis=2))


def test_the_direct_law_stands_beside_the_classical_ones():
    traces = case()[2].traces
    assert film.shown(traces) == ["direct_three", "stacked", "blockwise", "euclidean_points"]
    direct = {name: traces[name] for name in ("direct_two", "exact")}
    assert film.shown(direct) == ["direct_two", "exact"]
    assert film.shown({"stacked": traces["stacked"]}) == ["stacked"]


def test_the_film_lasts_as_long_as_the_longest_run_that_converged():
    assert film.times([run(4), run(80, verdict="max steps"), run(9)])[[0, -1]].tolist() == [0.0, 9.0]
    assert film.times([run(4, verdict="diverged"), run(80, verdict="plateau")])[-1] == 80.0
    assert len(film.times([run()])) == film.FRAMES


def test_the_face_moves_and_hidden_instants_are_marked():
    first, hidden, last = frames([run()], [0.0, 2.0, 4.0])
    assert first.shape == hidden.shape == last.shape
    assert (first != last).any(axis=2).sum() > 500
    # The legend has some of the colour; the filled face and the word beside it are more.
    orange = [count(pixels, film.HIDDEN) for pixels in (first, hidden, last)]
    assert orange[1] > orange[0] + 500
    green = [count(pixels, film.SEEN) for pixels in (first, hidden, last)]
    assert min(green[0], green[2]) > 1.5 * green[1]


@pytest.mark.parametrize("columns", [1, 4])
def test_as_many_columns_as_runs(columns):
    (pixels,) = frames([run() for _ in range(columns)], [1.0])
    assert abs(pixels.shape[1] - {1: 400, 4: 970}[columns]) <= 1


def test_markers_that_were_not_seen_are_told_and_leave_the_rest():
    lost, whole = run(hidden=()), run(hidden=())
    lost.s[3, 1] = np.nan
    first, last = zip(*(frames([one], [3.0, 4.0]) for one in (lost, whole)), strict=True)
    upper, lower = np.array_split(np.abs(first[0].astype(int) - first[1]).max(axis=2) > 60, 2)
    assert lower.sum() > 200  # the word, and the face that is gone, in the image of the right camera alone
    assert not upper.any()
    assert count(last[0], film.SEEN) > 0.9 * count(last[1], film.SEEN)


def test_the_legend_is_whole_where_there_is_one_column():
    (pixels,) = frames([run()], [0.0])
    legend = pixels[-60:]
    assert (legend[:, :3] == 255).all()
    assert (legend[:, -3:] == 255).all()
    assert (legend < 128).any()
