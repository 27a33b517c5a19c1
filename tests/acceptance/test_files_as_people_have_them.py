"""Files and sources as people have them, each read or refused by its cause: a kind of fault a test."""

import json
import os

import numpy as np
import pytest

from projservo_cli import cli
from projservo_cli.config import load_config, to_yaml
from projservo_cli.config.inputs import plan_inputs, truth_of
from projservo_cli.detection import TagFinder
from projservo_cli.nominal import read_nominal
from projservo_cli.records import VIEWS, InputError, masked
from projservo_cli.stages.scenario import scenario_of
from projservo_cli.store import load
from projservo_cli.store.tables import read_table
from tests.conftest import ROOT, SHARED


@pytest.fixture
def case(tmp_path, monkeypatch):
    """Function that enters a copy of a case by name, or skips where it is absent."""

    def enter(name):
        folder = SHARED.parent / "cases" / name
        if not folder.is_dir():
            pytest.skip(f"case not found at {folder}")
        for file in folder.iterdir():
            (tmp_path / file.name).write_bytes(file.read_bytes())
        monkeypatch.chdir(tmp_path)
        monkeypatch.syspath_prepend(str(tmp_path))

    return enter


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


def test_case_03_urdf_two_parents(case, told):
    case("03_urdf_two_parents")
    code, _, err = told("calibrate", "-c", "arm.yaml", "-o", "out")
    assert code == 2
    assert "link fore has two parent joints, j3 and rod_joint" in err


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (urdf(*CHAIN, joint("rod", "base", "fore")), "two parent joints, lift and rod"),
        (urdf(*CHAIN, joint("lift", "hand", "tool"), links=LINKS + '<link name="tool"/>'), "2 times"),
        (urdf(*CHAIN, links=LINKS + '<link name="fore"/>'), "link fore stands there 2 times"),
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


def test_case_07_xacro_comment(case, told):
    case("07_xacro_comment")
    code, out, _ = told("calibrate", "-c", "arm.yaml", "-n")
    assert (code, out) == (0, "calibrate: would be made (none yet)")


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "latin-1", "cp1252", "utf-16", "gbk"])
def test_a_urdf_is_read_in_the_encoding_that_it_declares_whatever_its_comments_say(tmp_path, encoding):
    name = "臂" if encoding == "gbk" else "Müller"
    declared = "" if encoding == "utf-8-sig" else f"<?xml version='1.0' encoding='{encoding}'?>"
    gazebo = f"<!-- xacro: ${{x}} {name} --><gazebo><plugin a='${{x}}'>xacro:include</plugin></gazebo>"
    text = urdf(*CHAIN, head=f"{declared}<robot name='{name}' {XACRO}>", more=gazebo)
    screws = config_of(tmp_path, text.encode(encoding)).robot.screws
    assert [one.name for one in screws.joints] == ["pan", "lift", "roll"]


def test_a_key_that_stands_twice_overwrites_nothing(tmp_path, told):
    (tmp_path / "nominal.json").write_text('{"screws": [], "screws": []}')
    with pytest.raises(InputError, match="the key screws stands in one object twice"):
        read_nominal(tmp_path / "nominal.json")
    (tmp_path / "arm.yaml").write_text("plant: so101\nplant: simulated\n")
    code, _, err = told("release", "-c", tmp_path / "arm.yaml")
    assert (code, "plant stands there twice" in err) == (2, True)


def test_case_08_unequal_image_sizes(case, told):
    case("08_unequal_image_sizes")
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


@pytest.mark.parametrize("sizes", [[[640, 480], [320, 240]], [[640, 480], [640, 480]]])
def test_each_camera_has_its_own_border(sizes):
    rig = f"rig.image_size_px={sizes}"
    config = load_config(ROOT / "configs" / "paper.yaml", [rig])
    truth, demands = truth_of(config), scenario_of(plan_inputs(config)).demands
    np.testing.assert_array_equal(demands.image_size, sizes)
    assert load_config("again.yaml", text=to_yaml(config)) == config
    s = np.array([[[400.0, 100.0]], [[400.0, 100.0]]])
    assert np.isfinite(truth.within(s)[:, 0, 0]).tolist() == [True, sizes[1][0] == 640]
    assert (config.image_size_px == (640, 480)) == (sizes[0] == sizes[1])


def test_a_size_of_each_camera_is_an_option_of_every_stage(told, recorded, tmp_path):
    calibrate = ["calibrate", "--data", recorded, "-o", tmp_path / "out", "--image-size"]
    code, _, err = told(*calibrate, "640x480,320x240,1x1")
    assert (code, "1280x1024,1280x960 where the right images" in err) == (2, True)
    code, _, err = told(*calibrate, "1280x1024,320x240")
    assert (code, "image size 320x240 px" in err, "of the right view are outside" in err) == (2, True, True)


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("(rtsp://user:s3cret@10.0.0.2:554/s): lost", "(rtsp://user:***@10.0.0.2:554/s): lost"),
        ("rtsp://admin:p@ss:w/s3cret@cam/1", "rtsp://admin:***@cam/1"),
        ("http://s3cret@host/x.mjpg", "http://***@host/x.mjpg"),
        ("'https://cam/v?user=me&access_token=s3cret&n=1'", "'https://cam/v?user=me&access_token=***&n=1'"),
        ("http://cam/cgi?loginuse=a&loginpas=s3cret: lost", "http://cam/cgi?loginuse=a&loginpas=***: lost"),
        ("rtsp://cam/user=admin_password=s3cret_channel=1.sdp", "rtsp://cam/user=admin_password=***"),
        ("rtspsrc location=rtsp://cam/1 user-pw=s3cret ! x", "rtspsrc location=rtsp://cam/1 user-pw=*** ! x"),
        ("--set KEY=VALUE, http://host:8080/a me@b.org", "--set KEY=VALUE, http://host:8080/a me@b.org"),
    ],
)  # fmt: skip
def test_passwords_and_tokens_of_urls_are_masked(text, wanted):
    assert masked(text) == wanted == masked(wanted) == str(InputError(text))


def test_case_10_password_in_page(case, told, tmp_path):
    case("10_password_in_page")
    for command in (["doctor"], ["doctor", "--json"], ["record", "--output", "t.csv"], ["record", "-v"]):
        code, out, err = told(*command, "-c", "arm.yaml")
        assert code == 1
        assert "rtsp://user:***@127.0.0.1:8554/stream1" in out + err
        assert "secret123" not in out + err
    assert all(b"secret123" not in path.read_bytes() for path in tmp_path.rglob("*.html"))


def test_no_run_file_holds_the_password_of_a_camera(told, recorded, tmp_path):
    arm = tmp_path / "arm.yaml"
    cameras = [f"{side}: {{source: 'rtsp://me:s3cret@cam/{side}', size_px: [1280, 1024]}}" for side in VIEWS]
    arm.write_text(
        f"plant: {{use: 'tests.robots.robots:Sound', options: {{config: 'http://h/?token=s3cret'}}}}\n"
        f"data: {{table: {recorded}}}\nmarkers: {{tags: roof}}\ncameras: {{{', '.join(cameras)}}}\n"
    )
    out = tmp_path / "out"
    assert told("calibrate", "-c", arm, "--set", "seed=1", "-o", out)[0] == 0
    assert b"s3cret" not in (out / "run.h5").read_bytes()
    assert "rtsp://me:***@cam/left" in load(out).configuration
    assert told("calibrate", "-c", arm, "--set", "seed=1", "-o", out)[2].startswith("calibrate: up to date")
    code, _, err = told("doctor", "-c", arm, "--set", "cameras.left.source=rtsp://me:***@cam/left")
    assert (code, "is masked" in err) == (2, True)


def spreadsheet(lines, separator, comma=False, head=""):
    """Lines of a table as a spreadsheet writes them."""
    rows = [line.split(",") for line in lines]
    cells = [[cell.replace(".", ",") if comma else cell for cell in row] for row in rows]
    return "\n".join([*head.splitlines(), *(separator.join(row) for row in cells)]) + "\n"


@pytest.mark.parametrize(
    ("separator", "comma", "head", "encoding"),
    [
        ("\t", False, "", "utf-8"), ("\t", True, "", "utf-8-sig"), (";", True, "", "utf-8"),
        (";", True, "sep=;", "utf-8-sig"), (",", False, "sep=,", "utf-8"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("unseen", ["", "nan", "NaN", "NA", "#N/A"])
def test_a_table_of_a_spreadsheet_is_read(recorded, tmp_path, separator, comma, head, encoding, unseen):
    header, *rows = recorded.read_text().splitlines()
    wanted, given = [], []
    for line in rows[:40]:
        cells = line.split(",")
        for i in range(len(cells)):
            if header.split(",")[i].endswith("_left") and cells[1] == "2":
                cells[i] = ""
        wanted.append(",".join(cells))
        given.append(",".join(unseen if name[:2] in ("u_", "v_") and cell == "" else cell
                              for name, cell in zip(header.split(","), cells, strict=True)))  # fmt: skip
    (tmp_path / "plain.csv").write_text("\n".join([header, *wanted]) + "\n")
    sheet = spreadsheet([header, *given], separator, comma, head)
    (tmp_path / "sheet.csv").write_text(sheet, encoding=encoding)
    one, other = read_table(tmp_path / "plain.csv"), read_table(tmp_path / "sheet.csv")
    np.testing.assert_array_equal(one.images, other.images)
    np.testing.assert_array_equal(one.q, other.q)
    broken = sheet.replace(rows[39].split(",")[2].replace(".", "," if comma else "."), "x")
    (tmp_path / "broken.csv").write_text(broken, encoding=encoding)
    line = broken.splitlines().index(next(row for row in broken.splitlines() if separator + "x" in row)) + 1
    with pytest.raises(InputError, match=f"broken.csv:{line}: q1 is 'x'"):
        read_table(tmp_path / "broken.csv")


@pytest.mark.parametrize("name", ["q0", "q00"])
def test_joint_columns_that_begin_with_zero_are_refused(recorded, tmp_path, name):
    text = recorded.read_text().replace(",q1,", f",{name},q1,", 1).replace("\n", "\n", 1)
    (tmp_path / "t.csv").write_text(text)
    with pytest.raises(InputError, match=f"has {name}: number the joint columns q1, q2"):
        read_table(tmp_path / "t.csv")


MIXED = [("9999", "9999"), ("-1", "-1"), ("-1000000000", "-1000000000"), ("65535", "65535")]


@pytest.mark.parametrize(
    "placeholders",
    [[MIXED[1]], [MIXED[2]], [MIXED[3]], MIXED[:2], [("-1", None)], [(None, "9999")]],
    ids=["-1", "-1e9", "65535", "mixed", "u alone", "v alone"],
)
def test_numbers_for_unseen_markers_are_named_and_taken_as_unseen(told, recorded, tmp_path, placeholders):
    header, *rows = (line.split(",") for line in recorded.read_text().splitlines())
    draw, at, empty = np.random.default_rng(3), header.index("u_left"), []
    for row in rows:
        empty.append(list(row))
        for view in range(2):
            if draw.random() < 0.08 and row[at + 2 * view]:
                given = placeholders[draw.integers(len(placeholders))]
                for axis in range(2):
                    row[at + 2 * view + axis] = given[axis] or row[at + 2 * view + axis]
                    empty[-1][at + 2 * view + axis] = ""
    found = []
    for name, lines in (("given", rows), ("empty", empty)):
        path = tmp_path / f"{name}.csv"
        path.write_text("\n".join(",".join(line) for line in [header, *lines]) + "\n")
        code, out, _ = told("calibrate", "--data", path, "-o", tmp_path / name, "--json")
        assert code == 0
        found.append(json.loads(out))
    one, other = found
    assert one["predicted_rms_px"] == pytest.approx(other["predicted_rms_px"], rel=0.02)
    assert one["rejected"]["placeholders"] > 0.95 * sum(a != b for a, b in zip(rows, empty, strict=True))
    assert "taken as unseen" in one["advice"][-1]


@pytest.fixture
def folders(tmp_path):
    """Folders of images of two tags at two poses, and their joints."""
    cv2, finder = pytest.importorskip("cv2"), TagFinder("4X4_50")
    for side in VIEWS:
        (tmp_path / side).mkdir()
        for k in range(2):
            image = np.full((240, 320), 200, dtype=np.uint8)
            for number in range(2):
                tag = finder.picture(number, 12)
                image[40 + 9 * k :, 20 + 150 * number :][: len(tag), : len(tag)] = tag
            cv2.imwrite(str(tmp_path / side / f"img_{k}.png"), cv2.GaussianBlur(image, (5, 5), 0.8))
    (tmp_path / "q.csv").write_text("pose,q1\n0,0.1\n1,0.2\n")
    sides = [tmp_path / side for side in VIEWS]
    return tmp_path, [
        "detect",
        *sides,
        "--joints-csv",
        tmp_path / "q.csv",
        "-o",
        tmp_path / "t.csv",
        "--json",
    ]


def test_sidecar_files_are_no_images(told, folders):
    folder, detect = folders
    for side in VIEWS:
        (folder / side / "Thumbs.db").write_bytes(b"x")
        for k in range(2):
            (folder / side / f"._img_{k}.png").write_bytes(b"\0\5\x16\7")
    code, out, err = told(*detect)
    assert (code, json.loads(out)["hidden_files"], json.loads(out)["tags"]) == (0, 4, [0, 1])
    assert "4 hidden files" in err


@pytest.mark.parametrize("kind", ["16 bits", "Bayer"])
def test_images_that_show_no_grey_values_are_named(told, folders, kind):
    import cv2

    folder, detect = folders
    path = folder / "right" / "img_1.png"
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if kind == "Bayer":
        gain = np.tile([[0.6, 1.0], [1.0, 0.7]], (120, 160))
        cv2.imwrite(str(path), (image * gain).astype(np.uint8))
    else:
        cv2.imwrite(str(path), image.astype(np.uint16) * 16)
    code, _, err = told(*detect)
    assert (code, "img_1.png" in err, kind in err) == (2, True, True)


def test_an_image_that_two_rows_name_is_refused(told, folders):
    folder, detect = folders
    (folder / "q.csv").write_text("q1,left,right\n0.1,img_0.png,img_0.png\n0.2,img_1.png,img_0.png\n")
    code, _, err = told(*detect)
    assert (code, "names it in 2 rows" in err) == (2, True)


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


def in_motion(recorded, path, unit=1.0, clocks=("t_q", "t_left", "t_right"), whole=False):
    """A recorded table with a motion, its stamps by these clocks in another unit, or in whole seconds."""
    header, *rows = recorded.read_text().splitlines()
    more = ["0,,,"] * len(rows)
    for line in rows[:300]:
        pose, rest = line.split(",", 1)
        t = round(0.04 * int(pose)) if whole else 5.0 + 0.04 * int(pose)
        stamps = [t * unit if name in clocks else t for name in ("t_q", "t_left", "t_right")]
        rows.append(f"{1000 + int(pose)},{rest}")
        more.append(",".join(["1", *map(repr, stamps)]))
    text = "\n".join(f"{row},{cells}" for row, cells in zip(rows, more, strict=True))
    path.write_text(f"{header},moving,t_q,t_left,t_right\n{text}\n")
    return path


@pytest.mark.parametrize("clocks", [("t_q",), ("t_right",), ("t_q", "t_left", "t_right")])
@pytest.mark.parametrize("unit", [1e3, 1e6, 1e9])
def test_stamps_of_a_table_in_another_unit_are_refused(recorded, tmp_path, unit, clocks):
    read_table(in_motion(recorded, tmp_path / "t.csv"))
    with pytest.raises(
        InputError, match=rf"t.csv: {clocks[0]} goes on by .* by {unit:g}".replace("+", r"\+")
    ):
        read_table(in_motion(recorded, tmp_path / "t.csv", unit, clocks))


def test_whole_seconds_in_a_table_are_named_where_the_latency_is_left_out(told, recorded, tmp_path):
    table = in_motion(recorded, tmp_path / "t.csv", whole=True)
    code, out, _ = told("calibrate", "--data", table, "-o", tmp_path / "out", "--json")
    found = json.loads(out)
    assert (code, found["time_offset_s"]) == (0, None)
    assert "t_q of poses in motion are whole seconds" in " ".join(found["advice"])


@pytest.mark.parametrize("images_only", [False, True])
@pytest.mark.parametrize(
    ("unit", "whole", "wanted"),
    [
        (1e3, False, "milliseconds"),
        (1e9, False, "nanoseconds"),
        (1.0, True, "whole number"),
        (1.0, False, ""),
    ],
)
def test_record_names_stamps_in_another_unit(told, tmp_path, unit, whole, wanted, images_only):
    options = f"{{config: {ROOT}/configs/ur5.yaml, unit: {unit}, whole: {whole}, images_only: {images_only}}}"
    robot = f"plant={{use: 'tests.robots.robots:Stamped', options: {options}}}"
    few = ["calibration.random_poses=0", "calibration.frames_per_joint=1"]
    code, _, err = told(
        "record", "-c", ROOT / "configs" / "ur5.yaml", "-o", tmp_path / "t.csv",
        *(word for one in (robot, *few) for word in ("--set", one)),
    )  # fmt: skip
    assert (code, wanted in err, "t_left" in err) == (int(bool(wanted)), True, images_only and bool(wanted))
    assert "vibrates" not in err


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


@pytest.mark.parametrize(("shift", "words"), [(1, "before"), (-1, "after")])
def test_images_of_another_pose_than_their_readings_are_named(told, recorded, tmp_path, shift, words):
    header, *rows = (line.split(",") for line in recorded.read_text().splitlines())
    at, last = header.index("u_left"), max(int(row[0]) for row in rows)
    seen = {(int(row[0]), row[1]): row[at : at + 4] for row in rows}
    for row in rows:
        pose = min(max(int(row[0]) - shift, 0), last)
        row[at : at + 4] = seen[pose, row[1]]
    (tmp_path / "t.csv").write_text("\n".join(map(",".join, [header, *rows])) + "\n")
    code, _, err = told("calibrate", "--data", tmp_path / "t.csv", "-o", tmp_path / "out")
    assert (code, f"each image shows the pose {words} its reading" in err) == (1, True)
    assert ("plant.settle_s" in err) == (shift == 1)


@pytest.mark.parametrize("late", VIEWS)
def test_images_of_one_camera_that_come_a_pose_late_are_named(told, recorded, tmp_path, late):
    header, *rows = (line.split(",") for line in recorded.read_text().splitlines())
    at = header.index(f"u_{late}")
    seen = {(int(row[0]), row[1]): row[at : at + 2] for row in rows}
    for row in rows:
        row[at : at + 2] = seen.get((max(int(row[0]) - 1, 0), row[1]), ["", ""])
    (tmp_path / "t.csv").write_text("\n".join(map(",".join, [header, *rows])) + "\n")
    code, _, err = told("calibrate", "--data", tmp_path / "t.csv", "-o", tmp_path / "out")
    assert (code, f"each {late} image shows the pose before that of" in err) == (1, True)
    assert "plant.settle_s" in err
