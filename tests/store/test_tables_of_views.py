"""Tables of one, three or four views, and lists of detections beside joints."""

import dataclasses

import numpy as np
import pytest

from projservo_cli.calibration.checks.validation import of_views
from projservo_cli.image_size import image_sizes, views_in_order
from projservo_cli.records import VIEWS, InputError
from projservo_cli.store.observation_tables import read_detections, read_table, write_table
from tests.calibration.simulated_robot import random_robot, trials


@pytest.fixture(scope="module")
def seen():
    """Observation by four views, some markers unseen, with deviations."""
    rng = np.random.default_rng(3)
    robot = random_robot("RRR", rng, markers=5, views=4)
    q = trials(robot, frames=2)
    seen = robot.observe(q, 0.5, rng)
    seen.images[rng.random(seen.images.shape[:3]) < 0.2] = np.nan
    sigma = np.where(np.isfinite(seen.images[..., 0]), 0.5, np.nan)
    return dataclasses.replace(seen, sigma=sigma)


def test_left_and_right_are_in_this_order_whatever_that_of_the_columns(tmp_path):
    (tmp_path / "t.csv").write_text(
        "pose,marker,q1,u_right,v_right,u_left,v_left,u_other\n0,0,0.1,3,4,1,2,9\n"
    )
    found = read_table(tmp_path / "t.csv")
    assert found.view == VIEWS
    np.testing.assert_array_equal(found.images, [[[[1.0, 2.0]], [[3.0, 4.0]]]])


def listed(seen):
    """Rows of a list of detections, and of its joints."""
    k, v, j = np.nonzero(np.isfinite(seen.images[..., 0]))
    rows = [
        ",".join(map(str, (seen.pose[a], seen.view[b], seen.marker[c], *seen.images[a, b, c].tolist(), 0.5)))
        for a, b, c in zip(k, v, j, strict=True)
    ]
    joints = [f"{pose},{','.join(map(repr, q.tolist()))}" for pose, q in zip(seen.pose, seen.q, strict=True)]
    return ["pose,camera,marker,u,v,sigma", *rows], ["pose,q1,q2,q3", *joints]


def test_a_list_of_detections_beside_joints_is_the_same_recording(seen, tmp_path):
    for name, rows in zip(("d.csv", "q.csv"), listed(seen), strict=True):
        (tmp_path / name).write_text("\n".join(rows) + "\n")
    found = read_detections(tmp_path / "d.csv", tmp_path / "q.csv", "RRR")
    expected = of_views(seen, found.view)
    for name in ("pose", "marker", "q", "images", "sigma"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)


@pytest.mark.parametrize("seed", range(3))
def test_views_of_a_list_are_by_name_whatever_the_order_of_its_rows(seen, tmp_path, seed):
    names = ("right", "c10", "Kamera ü 2", "left")
    head, *rows = listed(dataclasses.replace(seen, view=names))[0]
    np.random.default_rng(seed).shuffle(rows)
    (tmp_path / "d.csv").write_text("\n".join([head, *rows]) + "\n", encoding="utf-8")
    (tmp_path / "q.csv").write_text("\n".join(listed(seen)[1]) + "\n")
    found = read_detections(tmp_path / "d.csv", tmp_path / "q.csv", "RRR")
    assert found.view == ("left", "right", "c10", "kamera ü 2")
    np.testing.assert_array_equal(found.images, seen.images[:, [3, 0, 1, 2]])
    write_table(found, tmp_path / "t.csv")
    again = read_table(tmp_path / "t.csv", "RRR")
    assert again.view == found.view
    np.testing.assert_array_equal(again.images, found.images)


def test_names_are_sorted_by_their_words_and_numbers():
    names = ["c10", "right", "c2", "top", "C1", "left", "c02b"]
    assert views_in_order(names) == ["left", "right", "C1", "c2", "c02b", "c10", "top"]


def test_sizes_by_name_reach_the_views_of_these_names():
    view, sizes = ("left", "c2", "c10"), {"c10": (3, 4), "left": (1, 2), "c2": (5, 6)}
    np.testing.assert_array_equal(image_sizes(sizes, view), [[1, 2], [5, 6], [3, 4]])
    for wrong in (sizes | {"top": (1, 1)}, {"left": (1, 2)}, [(1, 2), (3, 4)]):
        with pytest.raises(InputError, match=r"the views (are )?left, c2, c10: give one"):
            image_sizes(wrong, view)


ERRORS = {
    "unknown pose": ("7,1,0,1,2", "d.csv:2: pose 7 has no joint readings in"),
    "twice": ("0,1,0,1,2\n0,1,0,1,2", "d.csv:3: marker 0 of camera cam1 at pose 0 is already in line 2"),
    "no name": ("0,,0,1,2", "d.csv:2: camera is ''; expected a number or a name"),
    "a blank in it": ("0,a  b,0,1,2", "d.csv:2: camera is 'a  b'"),
    "no pixel": ("0,1,0,,2", "d.csv:2: u is ''; expected a finite number"),
    "no rows": ("", "d.csv: the table has a header but no rows; add a detection a row"),
}


@pytest.mark.parametrize("name", ERRORS)
def test_an_error_of_a_list_names_its_line(name, tmp_path):
    rows, message = ERRORS[name]
    (tmp_path / "d.csv").write_text(f"pose,camera,marker,u,v\n{rows}\n")
    (tmp_path / "q.csv").write_text("pose,q1\n0,0.5\n")
    with pytest.raises(InputError) as error:
        read_detections(tmp_path / "d.csv", tmp_path / "q.csv")
    assert message in str(error.value)


def test_a_view_that_is_missing_is_named(seen):
    some = of_views(seen, ("left", "top"))
    with pytest.raises(InputError, match="the calibration has left, right: add right"):
        of_views(some, ("left", "right"))
