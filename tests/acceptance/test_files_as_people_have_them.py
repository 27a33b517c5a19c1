"""Files and sources as people have them, each read or refused by its cause: a kind of fault a test."""

import json
import os

import numpy as np
import pytest

from projservo_cli import cli
from projservo_cli.config import load_config
from projservo_cli.records import InputError
from projservo_cli.store.observation_tables import read_table
from tests.conftest import ROOT


@pytest.fixture
def told(capsys):
    """Exit code of a call, and all that it printed, in one line."""

    def call(*arguments):
        capsys.readouterr()
        code = cli.run([str(argument) for argument in arguments])
        captured = capsys.readouterr()
        return code, " ".join(captured.out.split()), " ".join(captured.err.split())

    return call


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A table of the UR5, as projservo records it."""
    path = tmp_path_factory.mktemp("recorded") / "t.csv"
    assert cli.run(["record", "-c", str(ROOT / "configs" / "ur5.yaml"), "--output", str(path), "-q"]) == 0
    return path


LINKS = "".join(f'<link name="{name}"/>' for name in ("base", "upper", "fore", "hand"))
LIMIT = '<limit lower="-1" upper="2" effort="1" velocity="1"/>'


def joint(name, parent, child, limit=LIMIT, kind="revolute", more=""):
    """A joint about z, half a metre above its parent."""
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="0.1 0 0.5"/><axis xyz="0 0 1"/>{limit}{more}</joint>'
    )


def urdf(*joints, links=LINKS, head="<robot name='arm'>", more=""):
    """A URDF of joints, in text."""
    return f"{head}{links}{''.join(joints)}{more}</robot>"


CHAIN = (joint("pan", "base", "upper"), joint("lift", "upper", "fore"), joint("roll", "fore", "hand"))
XACRO = 'xmlns:xacro="http://www.ros.org/wiki/xacro"'


def config_of(folder, content):
    """The configuration of an arm in a URDF of this content, in bytes."""
    (folder / "arm.urdf").write_bytes(content)
    (folder / "arm.yaml").write_text("robot: {urdf: arm.urdf, tip: hand}\ndata: {table: t.csv}\n")
    return load_config(folder / "arm.yaml")


@pytest.mark.parametrize(
    ("name", "code", "words"),
    [
        ("03_urdf_two_parents", 2, "link fore has two parent joints, j3 and rod_joint"),
        ("07_xacro_comment", 0, "calibrate: would be made (none yet)"),
    ],
)
def test_case_03_and_07_of_urdfs(entered, told, name, code, words):
    entered(name)
    found, out, err = told("calibrate", "-c", "arm.yaml", "-n")
    assert (found, words in out + err) == (code, True)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (urdf(*CHAIN, joint("lift", "hand", "tool"), links=LINKS + '<link name="tool"/>'), "2 times"),
        (urdf(*CHAIN, links=LINKS + '<link name="fore"/>'), "link fore occurs 2 times"),
        (urdf(*CHAIN[1:], joint("pan", "hand", "upper")), "closes a loop"),
        (urdf(CHAIN[0], CHAIN[1].replace('"upper"', '"uper"', 1), CHAIN[2]), "lift: there is no link uper"),
        (urdf(*CHAIN[:2], joint("roll", "fore", "hand", LIMIT, more=LIMIT)), "roll has 2 elements limit"),
        (urdf(*CHAIN[:2], joint("roll", "fore", "hand", "")), "roll of type revolute has no lower and no"),
        (urdf(*CHAIN[:2], joint("roll", "fore", "hand", '<limit effort="1"/>', "prismatic")), "joint roll"),
        (urdf(*CHAIN[:2], joint("roll", "fore", "hand", '<limit lower="-1"/>')), "has no upper limit"),
        (urdf(*CHAIN[:2], joint("roll", "fore", "hand", '<limit lower="0" upper="0"/>')), "is not below its"),
        (urdf(*CHAIN, head=f"<robot name='a' {XACRO}>", more='<xacro:property name="l"/>'), "expand it"),
        (urdf(*CHAIN[:2], joint("roll", "${parent}", "hand")), "expand it first"),
        (urdf(*CHAIN, head="<robot name='Müller'>"), "encoding that its first line declares"),
        (urdf(*CHAIN, head="<?xml version='1.0' encoding='klingon'?><robot name='a'>"), "klingon|unknown"),
    ],
)  # fmt: skip
def test_a_urdf_that_is_no_tree_or_leaves_something_open_is_refused_by_its_cause(tmp_path, text, message):
    with pytest.raises(InputError, match=message) as refused:
        config_of(tmp_path, text.encode("latin-1"))
    assert "arm.urdf: " in str(refused.value)
    assert "\n" not in str(refused.value)


def test_case_08_unequal_image_sizes(entered, told):
    entered("08_unequal_image_sizes")
    code, out, _ = told("plan", "-c", "unequal.yaml", "-o", "out", "--json")
    assert code == 0
    assert json.loads(out)["profile"] == "joint_space"  # the linear one leaves both images
    with open("unequal.yaml", encoding="utf-8") as file:
        text = file.read()
    with open("unknown.yaml", "w", encoding="utf-8") as file:
        file.write(text.replace(", size_px: [960, 1023]", ""))
    code, out, _ = told("plan", "-c", "unknown.yaml", "-o", "out2", "--json")
    assert (code, json.loads(out)["profile"]) == (0, "joint_space")
    assert (
        "the size of the images is not known: they are taken to reach to the last pixels seen, 918x862 left"
        in out
    )


def test_case_10_password_in_page(entered, told, tmp_path):
    entered("10_password_in_page")
    for command in (["doctor"], ["doctor", "--json"], ["record", "--output", "t.csv"], ["record", "-v"]):
        code, out, err = told(*command, "-c", "arm.yaml")
        assert code == 1
        assert "rtsp://user:***@127.0.0.1:8554/stream1" in out + err
        assert "secret123" not in out + err
    assert all(b"secret123" not in path.read_bytes() for path in tmp_path.rglob("*.html"))


@pytest.mark.parametrize(
    ("separator", "comma", "head", "encoding"),
    [
        ("\t", False, "", "utf-8"), ("\t", True, "", "utf-8-sig"), (";", True, "", "utf-8"),
        (";", True, "sep=;", "utf-8-sig"), (",", False, "sep=,", "utf-8"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("unseen", ["", "nan", "NaN", "NA", "#N/A"])
def test_a_table_of_a_spreadsheet_is_read(recorded, tmp_path, separator, comma, head, encoding, unseen):
    header, *rows = (line.split(",") for line in recorded.read_text().splitlines()[:41])
    at = header.index("u_left")
    for row in rows:
        row[at : at + 2] = ["", ""] if row[1] == "2" else row[at : at + 2]

    def written(name, separator, comma, head, unseen, encoding):
        lines = [[cell or unseen for cell in row] for row in (header, *rows)]
        cells = [[cell.replace(".", ",") if comma else cell for cell in row] for row in lines]
        text = "\n".join([*head.splitlines(), *(separator.join(row) for row in cells)])
        (tmp_path / name).write_text(text + "\n", encoding=encoding)
        return tmp_path / name

    one = read_table(written("plain.csv", ",", False, "", "", "utf-8"))
    other = read_table(written("sheet.csv", separator, comma, head, unseen, encoding))
    np.testing.assert_array_equal(one.images, other.images)
    np.testing.assert_array_equal(one.q, other.q)
    rows[-1][2] = "x"
    with pytest.raises(InputError, match=f"broken.csv:{len(rows) + 1 + bool(head)}: q1 is 'x'"):
        read_table(written("broken.csv", separator, comma, head, unseen, encoding))


@pytest.mark.parametrize(
    ("change", "unit"),
    [
        ("markers.positions_m=[[0, 0, 0], [40, 0, 0], [0, 40, 0], [40, 40, 0]]", "millimetres"),
        ("rig.left={focal_px: [900, 900], principal_point_px: [640, 512], position_m: [1500, 0, 600], "
         "target_m: [0, 0, 300]}", "millimetres"),
        ("control.period_s=40", "milliseconds"),
        ("plant.time_offset_s=80", "milliseconds"),
        ("plant.time_offset_s={left: 0.08, right: 80}", "milliseconds"),
        ("disturbance.camera_latency_s=60", "milliseconds"),
        ("plant.settle_s=500", "milliseconds"),
    ],
)  # fmt: skip
def test_a_value_of_another_unit_than_its_key_says_is_refused(change, unit):
    key = change.partition("=")[0]
    with pytest.raises(InputError, match=rf"{key}[\w.]*: [0-9.]+ is more than [0-9.]+: it looks like {unit}"):
        load_config(ROOT / "configs" / "paper.yaml", [change])


def in_motion(recorded, path, unit=1.0, clocks=("t_q", "t_left", "t_right")):
    """A recorded table with a motion, its stamps by these clocks in another unit."""
    header, *rows = recorded.read_text().splitlines()
    more = ["0,,,"] * len(rows)
    for line in rows[:300]:
        pose, rest = line.split(",", 1)
        t = 5.0 + 0.04 * int(pose)
        stamps = [t * unit if name in clocks else t for name in ("t_q", "t_left", "t_right")]
        rows.append(f"{1000 + int(pose)},{rest}")
        more.append(",".join(["1", *map(repr, stamps)]))
    text = "\n".join(f"{row},{cells}" for row, cells in zip(rows, more, strict=True))
    path.write_text(f"{header},moving,t_q,t_left,t_right\n{text}\n")
    return path


@pytest.mark.parametrize(
    ("unit", "clocks"), [(1e3, ("t_q",)), (1e6, ("t_right",)), (1e9, ("t_q", "t_left", "t_right"))]
)
def test_stamps_of_a_table_in_another_unit_are_refused(recorded, tmp_path, unit, clocks):
    read_table(in_motion(recorded, tmp_path / "t.csv"))
    with pytest.raises(
        InputError, match=rf"t.csv: {clocks[0]} goes on by .* by {unit:g}".replace("+", r"\+")
    ):
        read_table(in_motion(recorded, tmp_path / "t.csv", unit, clocks))


@pytest.mark.parametrize("mode", ["r", "r+"])
def test_a_run_file_open_elsewhere_is_read_or_its_holder_named(told, recorded, tmp_path, mode):
    h5py = pytest.importorskip("h5py")
    out = tmp_path / "out"
    assert told("calibrate", "--data", recorded, "-o", out)[0] == 0
    with h5py.File(out / "run.h5", mode):
        answers = [told("calibrate", "--data", recorded, "-o", out), told("show", out)]
    for code, _, err in answers:
        assert code == (0 if mode == "r" else 2)
        assert (
            mode == "r" or "is open for writing in this process, such as by h5py or xarray: close it" in err
        )
        assert "delete" not in err


def test_a_path_that_is_not_utf8_works_or_is_refused_in_a_line(told, recorded, tmp_path):
    folder = tmp_path / os.fsdecode(b"dos\xe9")
    try:
        folder.mkdir()
    except (OSError, UnicodeError):
        pytest.skip("the file system takes no such name")
    (folder / "t.csv").write_bytes(recorded.read_bytes())
    code, _, err = told("calibrate", "--data", folder / "t.csv", "-o", tmp_path / "out")
    assert (code, "data.table: must be UTF-8 (rename the file or its folder)" in err) == (2, True)
    code, out, _ = told("calibrate", "--data", recorded, "-o", folder / "out", "--json")
    assert (code, json.loads(out)["run"]) == (0, str(folder / "out" / "run.h5"))
    assert told("report", "-o", folder / "out")[0] == 0
    assert (folder / "out" / "report.html").is_file()


def test_images_of_one_camera_that_come_a_pose_late_are_named(told, recorded, tmp_path):
    header, *rows = (line.split(",") for line in recorded.read_text().splitlines())
    at = header.index("u_right")
    seen = {(int(row[0]), row[1]): row[at : at + 2] for row in rows}
    for row in rows:
        row[at : at + 2] = seen.get((max(int(row[0]) - 1, 0), row[1]), ["", ""])
    (tmp_path / "t.csv").write_text("\n".join(map(",".join, [header, *rows])) + "\n")
    code, _, err = told("calibrate", "--data", tmp_path / "t.csv", "-o", tmp_path / "out")
    assert (code, "each right image shows the pose before that of" in err) == (1, True)
    assert "plant.settle_s" in err
