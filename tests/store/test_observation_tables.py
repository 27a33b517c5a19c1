"""Observation tables: what is read, what is refused and where, and round trips."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from projservo_cli.records import VIEWS, InputError, Observation
from projservo_cli.store.observation_tables import read_joint_list, read_table, write_table

HEADER = "pose,marker,q1,q2,u_left,v_left,u_right,v_right"
SIGMAS = f"{HEADER},sigma_left,sigma_right"
ROWS = ["0,1,0.5,-1,10,20,30,40", "0,0,0.5,-1,11,21,31,41", "7,1,0.25,2e-1,12.5,22,,"]


def written(tmp_path, *lines, end="\n", prefix=b""):
    path = tmp_path / "table.csv"
    path.write_bytes(prefix + end.join(lines).encode())
    return path


BAD = {
    "empty file": ([""], "the table is empty"),
    "header only": ([HEADER], "no rows"),
    "no marker column": ([HEADER.replace("marker,", ""), "0,1,2,3,4,5,6"], ":1: .*lacks.*marker"),
    "no joints": (["pose,marker,u_left,v_left,u_right,v_right", "0,0,1,2,3,4"], ":1: .*lacks.*q1"),
    "gap in joints": ([HEADER.replace("q2", "q3"), ROWS[0]], ":1: joint column q2 is missing"),
    "column twice": ([HEADER.replace("q2", "q1"), ROWS[0]], ":1: .*q1 more than once"),
    "joints from zero": ([HEADER.replace("q2", "q0"), ROWS[0]], ":1: the header has q0"),
    "row cut short": ([HEADER, ROWS[0], "0,0,0.5,-1,11,2"], ":3: 6 cells, but the header has 8"),
    "text for a number": ([HEADER, ROWS[0].replace("10", "ten")], ":2: u_left is 'ten'"),
    "nan": ([HEADER, ROWS[0].replace("10", "nan")], ":2: one of u_left, v_left is empty"),
    "infinite": ([HEADER, ROWS[0].replace("10", "1e999")], ":2: u_left is '1e999'"),
    "empty joint": ([HEADER, "0,1,,-1,10,20,30,40"], ":2: q1 is ''"),
    "half a pixel": ([HEADER, "0,1,1,-1,10,,30,40"], ":2: one of u_left, v_left is empty"),
    "fractional pose": ([HEADER, "0.5,1,1,-1,10,20,30,40"], ":2: pose is '0.5'; expected an integer"),
    "same marker twice": ([HEADER, ROWS[0], ROWS[0]], ":3: marker 1 at pose 0 is already in line 2"),
    "two readings": ([HEADER, ROWS[0], "0,0,0.5,-2,1,2,3,4"], ":3: q2 of pose 0 is -2.0, but -1.0 in line 2"),
    "backwards": ([f"{HEADER},moving,t_q", f"{ROWS[0]},-1,0.5"], ":2: moving is -1; number motions from 1"),
    "no moment": ([f"{HEADER},moving,t_q", f"{ROWS[0]},1,"], ":2: a pose in motion needs t_q"),
    "two moments": (
        [f"{HEADER},t_q", f"{ROWS[0]},0.5", f"{ROWS[1]},"], ":3: t_q of pose 0 is None, but 0.5 in line 2"
    ),
    "deviation of one view": ([f"{HEADER},sigma_left", f"{ROWS[0]},1"], ":1: give the columns sigma_l"),
    "negative deviation": ([SIGMAS, f"{ROWS[0]},-0.1,1"], ":2: sigma_left is '-0.1'; expected a positive"),
    "no deviation": ([SIGMAS, f"{ROWS[0]},,1"], ":2: sigma_left is ''; expected a finite number"),
    "open quote": ([HEADER, ROWS[0], '"0,1'], ":3: "),
    "one column of a view": (["pose,marker,q1,u_left,v_left,u_right", "1,1,1,1,1,1"], "lacks .* v_right"),
    "no view": (["pose,marker,q1", "1,1,1"], "lacks .* u_left"),
    "a list without its joints": (["pose,camera,marker,u,v", "0,1,0,1,2"], "table: give --readings"),
    "nul byte": ([HEADER, "0,\0,1"], ":2: not a text file"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_tables_are_refused_with_the_line(tmp_path, case):
    lines, message = BAD[case]
    path = written(tmp_path, *lines)
    with pytest.raises(InputError, match=message) as caught:
        read_table(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


TURNS = ["0,1,0.5,370,1,2,3,4", "3,1,0.5,-90,1,2,3,4"]


@pytest.mark.parametrize("types", [None, "RR", "PR"])
def test_readings_that_look_like_degrees_are_refused_with_the_remedy(tmp_path, types):
    message = r"q2 of pose 0 is 370, .*\(2 such readings\).*--joint-unit deg"
    with pytest.raises(InputError, match=message) as caught:
        read_table(written(tmp_path, HEADER, *TURNS), types)
    assert "\n" not in str(caught.value)


LIST = ["pose,q1,q2,left,right", "7,1,90,a.png,b.png", "3,2,-90,c.png,d.png"]


def test_a_list_of_joints_has_numbers_and_images_or_not(tmp_path):
    joints = read_joint_list(written(tmp_path, *LIST), joint_unit="rad")
    assert (joints.pose.tolist(), joints.q.tolist()) == ([7, 3], [[1, 90], [2, -90]])
    assert joints.images == {"left": ("a.png", "c.png"), "right": ("b.png", "d.png")}
    plain = read_joint_list(written(tmp_path, "q2,q1", "90,1", "", "-90,2"), "PR", "deg")
    assert (plain.pose.tolist(), plain.numbered, plain.images) == ([0, 1], False, None)
    np.testing.assert_allclose(plain.q, [[1, np.pi / 2], [2, -np.pi / 2]], rtol=1e-15)


finite = st.floats(allow_nan=False, allow_infinity=False)


@given(st.data())
def test_writing_and_reading_is_exact(tmp_path_factory, data):
    """Of one to four views, with or without deviations, times and poses in motion."""
    views = data.draw(
        st.sampled_from([("hand",), VIEWS, ("cam1", "cam2"), ("d", "left", "top"), (*VIEWS, "a", "b")])
    )
    poses = data.draw(st.lists(st.integers(-(10**9), 10**9), min_size=1, max_size=4, unique=True))
    markers = sorted(data.draw(st.sets(st.integers(0, 10**6), min_size=1, max_size=3)))
    shape = len(poses), len(views), len(markers)
    n = data.draw(st.integers(1, 3))
    q = np.array([[data.draw(finite) for _ in range(n)] for _ in poses])
    images = np.array([data.draw(finite) for _ in range(2 * np.prod(shape))]).reshape(*shape, 2)
    images[np.array([data.draw(st.booleans()) for _ in range(np.prod(shape))]).reshape(shape)] = np.nan
    rng, more = np.random.default_rng(data.draw(st.integers(0, 99))), {}
    if data.draw(st.booleans()):
        more["sigma"] = np.where(
            np.isnan(images[..., 0]), np.nan, data.draw(st.floats(1e-3, 1e3)) + rng.random(shape)
        )
    if data.draw(st.booleans()):
        t_q = 0.03 * np.arange(len(poses)) + 0.01 * rng.random(len(poses))
        t_view = t_q[:, None] + 0.01 * rng.random(shape[:2])
        t_view[rng.random(shape[:2]) < 0.2] = np.nan
        more = more | {"moving": rng.integers(0, 3, len(poses)), "t_q": t_q, "t_view": t_view}
        more["moving"][-1], more["t_view"][0, 0] = 1, 0.5  # what is nowhere is no column
    table = Observation(np.array(poses), np.array(markers), q, images, view=views, **more)
    path = tmp_path_factory.mktemp("tables") / "table.csv"
    write_table(table, path)
    back = read_table(path, joint_unit="rad")
    assert back.view == views
    for name in ("pose", "marker", "q", "images", *more):
        np.testing.assert_array_equal(getattr(back, name), getattr(table, name), err_msg=name)
    if "moving" in more:
        still = more["moving"] == 0
        assert back.at_rest.pose.tolist() == table.pose[still].tolist()
        if still.any():
            write_table(back.at_rest, path)
            assert read_table(path, joint_unit="rad").moving is None
