"""Chessboards and ChArUco boards in rendered images: corners, numbers, deviations, and a calibration."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from projservo_cli.detection.finders import Board, BoardFinder, finder_of
from projservo_cli.records import InputError
from projservo_cli.settings.markers import BoardSettings, Markers
from projservo_cli.store.observation_tables import read_table
from tests.calibration.simulated_robot import Robot, around, random_robot
from tests.detection.boards import drawn, view_of
from tests.detection.test_detection import joints, write
from tests.hardware.still import Quiet
from tests.hardware.streams import Stream
from tests.samples import revolute
from tests.studies.detection_sigma import KINDS, SPECKLED, errors_of_boards

cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed: pip install '.[detect]'")

SQUARE_M = 0.025


@pytest.mark.parametrize(
    ("kind", "side"), [("chessboard:9x6", 15.0), ("chessboard:9x7", 15.0), ("charuco:7x6", 30.0)]
)
def test_corners_err_as_they_say_and_have_their_numbers(rng, kind, side):
    board = Board.of(kind)
    finder, error, sigma, ends = BoardFinder(board, "4X4_250"), [], [], set()
    for _ in range(8):
        H = view_of(rng, side * rng.uniform(1.0, 2.0))
        image, true = drawn(board, H, rng.uniform(0.5, 1.2), rng.uniform(1.0, 4.0), rng)
        found = finder.find(image.astype(float))[0]
        if not found:
            continue
        corners = found[0]
        ends.add(end := int(np.linalg.norm(corners.pixels - true, axis=1).max() > side))
        true = true[::-1] if end else true
        known = np.isfinite(corners.sigma) & corners.clean
        error.append((corners.pixels - true)[known])
        sigma.append(corners.sigma[known])
    assert len(error) > 4
    assert len(ends) == 1 + (kind == "chessboard:9x7")  # which looks the same turned
    error, sigma = np.concatenate(error), np.concatenate(sigma)
    assert np.sqrt(np.mean(error**2)) < 0.03  # OpenCV alone: 0.1 to 0.25
    assert np.abs(error.mean(axis=0)).max() < 0.003
    assert 0.7 < np.sqrt(np.mean(error**2) / np.mean(sigma**2)) < 1.3
    for part in np.array_split(np.argsort(sigma), 2):
        assert 0.7 < np.sqrt(np.mean(error[part] ** 2) / np.mean(sigma[part] ** 2)) < 1.3


@pytest.mark.parametrize("kind", ["circles:9x7", "acircles:4x11"])
@pytest.mark.parametrize("bright", [False, True])
def test_middles_of_circles_err_as_they_say_and_have_their_numbers(rng, kind, bright):
    """Of tilted circles, whose ellipses have their own middles up to 0.3 px off; dark or bright ones."""
    board = Board.of(kind)
    finder, error, sigma, ends = finder_of(board, None), [], [], set()
    for _ in range(5):
        H = view_of(rng, 24.0 * rng.uniform(1.0, 1.7))
        image, true = drawn(board, H, rng.uniform(0.5, 1.2), rng.uniform(1.0, 4.0), rng)
        found = finder.find((255 - image if bright else image).astype(float))[0]
        if not found:
            continue
        ends.add(end := int(np.linalg.norm(found[0].pixels - true, axis=1).max() > 12.0))
        known = found[0].clean
        error.append((found[0].pixels - (true[::-1] if end else true))[known])
        sigma.append(found[0].sigma[known])
    assert len(error) > 3
    assert len(ends) == 1 + board.symmetric
    error, sigma = np.concatenate(error), np.concatenate(sigma)
    assert np.sqrt(np.mean(error**2)) < 0.05
    assert np.abs(error.mean(axis=0)).max() < 0.005
    assert 0.7 < np.sqrt(np.mean(error**2) / np.mean(sigma**2)) < 1.3


def test_covered_circles_are_rejected_and_even_rows_are_refused(rng):
    board = Board.of("acircles:4x11:20mm")
    assert (str(board), board.staggered, board.symmetric) == ("acircles:4x11:20mm", True, False)
    image, true = drawn(board, view_of(rng, 30.0), 0.8, 2.0, rng)
    u, v = np.rint(true[20]).astype(int)
    for patch, rest in ((200, 1), (224, 44)):  # another thing instead of a circle, or nothing
        image[v - 12 : v + 12, u - 12 : u + 12] = patch
        found = finder_of(board, None).find(image.astype(float))[0]
        assert (np.isnan(found[0].sigma).sum() if found else 44) == rest
    with pytest.raises(InputError, match="odd number of rows"):
        Board.of("acircles:4x10")


def test_a_covered_corner_is_rejected_and_a_small_board_is_less_certain(rng):
    board = Board.of("charuco:7x6")
    image, true = drawn(board, view_of(rng, 45.0), 0.8, 2.0, rng)
    u, v = np.rint(true[7]).astype(int)
    image[v - 3 : v + 12, u - 3 : u + 12] = 128
    corners = BoardFinder(board, "4X4_250").find(image.astype(float))[0][0]
    assert not np.linalg.norm(corners.pixels[7] - true[7]) >= 4 * corners.sigma[7]  # which may be unknown
    assert np.isfinite(corners.sigma).sum() > 20


@pytest.mark.parametrize("covered", [[22], [0, 1, 9, 10, 30], [35, 44], [8, 17, 26, 35, 44, 53]])
def test_a_chessboard_is_numbered_if_two_corners_on_each_side_show(rng, covered):
    board = Board.of("chessboard:9x6")
    image, true = drawn(board, view_of(rng, 36.0), 0.8, 2.0, rng)
    whole = BoardFinder(board, "4X4_50").find(image.astype(float))[0][0]
    for k in covered:
        cv2.circle(image, np.rint(true[k]).astype(int).tolist(), 16, 150, -1)
    found = BoardFinder(board, "4X4_50").find(image.astype(float))[0]
    if len(covered) == 6:  # a side: nobody knows how many columns are behind it
        assert not found
        return
    known = np.isfinite(found[0].sigma)
    assert not known[::-1][covered].any()  # a drawn board ends with the bright square
    assert known.sum() >= 54 - 2 * len(covered)
    off = np.linalg.norm(found[0].pixels - whole.pixels, axis=1)[known]
    assert (off < 5.0 * found[0].sigma[known]).all()


@pytest.mark.parametrize("kind", [*KINDS, SPECKLED])
def test_corners_err_as_they_say_in_images_of_all_kinds(kind):
    found, lost = errors_of_boards("chessboard:9x6", kind, 4)
    assert (lost, np.isfinite(found.sigma).mean() > 0.95) == (0, True)
    assert 0.75 < np.sqrt(np.mean(found.error**2) / np.mean(found.sigma**2)) < 1.3


def test_case_36_a_chessboard_under_speckle_is_found_less_certain(projservo, shared_data, tmp_path):
    case = shared_data.parent / "cases/36_speckle_chessboard"
    if not case.is_dir():
        pytest.skip(f"case not found at {case}")
    answer = projservo(
        *("detect", f"left={case / 'im'}", "--readings", case / "q.csv", "--board", "chessboard:11x8"),
        *("-o", tmp_path / "t.csv", "--json"),
    )
    assert (answer.code, answer.json["unseen"] < 13) == (0, True), answer.err  # of 264
    table = read_table(tmp_path / "t.csv")
    known = np.isfinite(table.sigma)
    assert 0.05 < np.median(table.sigma[known]) < 0.2
    for pixels, seen in zip(table.images[:, 0], known[:, 0], strict=True):
        places = Board.of("chessboard:11x8").grid_points[seen]
        H = cv2.findHomography(places, pixels[seen])[0]
        off = cv2.perspectiveTransform(places[None], H)[0] - pixels[seen]
        assert 0.8 < np.sqrt(np.mean(off**2)) / np.sqrt(np.mean(table.sigma[known] ** 2)) < 1.3


@pytest.mark.parametrize("kind", ["chessboard:7x5", "circles:7x5", "acircles:4x9:25mm"])
def test_images_of_a_board_calibrate_a_robot(projservo, monkeypatch, tmp_path, kind):
    """Its first joint turns the board before the cameras, which number a symmetric one from either end."""
    monkeypatch.chdir(tmp_path)
    rng, board = np.random.default_rng(3), Board.of(kind)
    places = board.grid_points - board.grid_points.mean(axis=0)
    arm = vars(random_robot("RRR", rng))
    body = np.c_[SQUARE_M * places, np.zeros(len(places)), np.ones(len(places))]
    twists = np.array([revolute((0.1, 0.0, 0.0), (0.1, 0.2, 1.0)), *arm["twists"][1:]])
    half = np.diag([0.5, 0.5, 1.0]) @ arm["cameras"]
    arm = Robot(**(arm | {"markers": body, "twists": twists, "cameras": half}))
    q = around(arm, 11, rng, angle=0.4)
    q[:, 0] += np.linspace(-1.2, 1.6, len(q))
    for k, row in enumerate(arm.images(q)):
        for side, pixels in zip(("left", "right"), row, strict=True):
            H = cv2.findHomography(places, pixels)[0]
            image, true = drawn(board, H, 0.8, 2.0, rng)
            np.testing.assert_allclose(true, pixels, atol=1e-6)
            write(f"{side}/{k}.png", image)
    joints("pose,q1,q2,q3", *(",".join(map(repr, [k, *row.tolist()])) for k, row in enumerate(q)))
    command = ["detect", "left", "right", "--readings", "q.csv", "--board", str(board), "-o", "t.csv"]
    answer = projservo(*command, "--json")
    assert answer.code == 0, answer.err
    assert (answer.json["board"], answer.json["tags"], answer.json["markers"]) == (kind, [], len(places))
    shape = () if board.symmetric else ("--board", kind)
    answer = projservo("calibrate", "--data", "t.csv", *shape, "-o", "out", "--json")
    assert answer.code == 0, answer.err
    assert answer.json["sigma_px"] < (0.03 if board.kind == "chessboard" else 0.1)
    assert (len(answer.json["turned_images"]) > 3) == board.symmetric
    assert "unused_shape" not in {one["code"] for one in answer.json["findings"]}


class Carrier(Quiet):
    """An arm that carries a board to where it is sent, and shows it to two cameras."""

    board = Board.of("charuco:5x4")
    places = board.grid_points - board.grid_points.mean(axis=0)
    body = np.c_[0.14 * places, np.zeros(len(places)), np.ones(len(places))]
    arm = random_robot("RR", np.random.default_rng(3))
    arm = replace(arm, markers=body, cameras=np.diag([0.25, 0.25, 1.0]) @ arm.cameras)
    at, kept = arm.q_reference, {}  # where it stands, and images of each place

    def joints(self):
        return Carrier.at, None

    def command(self, target, speed, due):
        Carrier.at = target.copy()

    @classmethod
    def image(cls, view, rng):
        """What a camera sees of the board, with noise of its own."""
        key = view, cls.at.tobytes()
        if key not in cls.kept:
            H = cv2.findHomography(cls.places, cls.arm.images(cls.at[None])[0, view])[0]
            cls.kept[key] = drawn(cls.board, H, 0.8, 0.0, rng, (320, 240))[0]
        return np.clip(cls.kept[key] + rng.normal(0.0, 3.0, (240, 320)), 0, 255).astype(np.uint8)


CARRIED = """\
name: arm
plant: {{use: "tests.detection.test_boards:Carrier", settle_s: 0.05}}
data: {{table: arm.csv, joints: RR, image_size_px: [320, 240]}}
cameras: {{left: {{source: "{left}"}}, right: {{source: "{right}"}}, max_age_s: 5, reconnect_s: 20}}
markers: {{board: {{kind: charuco, rows: 4, columns: 5, size_m: 0.14, dictionary: 4X4_250}}}}
robot: {{limits: {{joints: [[-2, 2], [-2, 2]], unit: rad}}}}
calibration:
  {{reference: {{joints: {q}, unit: rad}}, frames_per_joint: 2, amplitude_deg: 20, random_poses: 2}}
control: {{joint_speed_limit_deg_s: 600}}
"""
TOLD = {
    "record": "7 poses recorded",
    "calibrate": "calibrate: usable",
    "teach --frames 3": "markers that disagree with the calibration: none",
    "doctor": "agrees with the images",
}


def test_a_board_is_recorded_calibrated_taught_and_checked(projservo, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    streams = [Stream(partial(Carrier.image, view, np.random.default_rng(view))) for view in range(2)]
    left, right = (stream.url for stream in streams)
    text = CARRIED.format(left=left, right=right, q=Carrier.arm.q_reference.tolist())
    Path("arm.yaml").write_text(text, encoding="utf-8")
    for command, words in TOLD.items():
        Carrier.at = Carrier.arm.q_reference
        answer = projservo(*command.split(), "-c", "arm.yaml")
        assert (answer.code, words in answer.out) == (0, True), answer.out + answer.err
    for stream in streams:
        stream.close()


def test_a_board_whose_tags_begin_at_another_number(projservo, rng, monkeypatch, tmp_path):
    """It is named by the tags that are seen; mirrored images and covered corners by what they are."""
    monkeypatch.chdir(tmp_path)
    board = Board.of("charuco:7x6:first=20")
    image, corners = drawn(board, view_of(rng, 40.0), 0.7, 1.0, rng)
    write("a/0.png", image)
    write("mirror/0.png", image[:, ::-1].copy())
    joints("q1", "1")
    given = (
        *("detect", "--readings", "q.csv", "-o", "t.csv", "--dictionary", "4X4_250", "--board"),
        str(board),
    )
    assert projservo(*given, "top=a").code == 0
    table = read_table(Path("t.csv"))
    assert np.linalg.norm(table.images[0, 0] - corners[table.marker], axis=1).max() < 0.5
    Path("t.csv").unlink()
    for said, *words in (
        ("but tags 20 to 40 of its dictionary, and the board has 0 to 20", "charuco:7x6", "top=a"),
        ("first tag, --board charuco:7x6:first=20 or markers.board.first: 20", "charuco:7x6", "top=a"),
        ("the top images are mirrored: 1 of 1 show tags in the mirror", str(board), "top=mirror"),
    ):
        answer = projservo(*given[:-1], *words)
        assert (answer.code, answer.err.count("\n")) == (1, 1)
        assert said in answer.err
        assert not Path("t.csv").exists()


def test_case_37_mirrored_tags(projservo, shared_data, tmp_path):
    case = shared_data.parent / "cases/37_mirrored_tags"
    if not case.is_dir():
        pytest.skip(f"case not found at {case}")
    answer = projservo(
        "detect", f"left={case / 'im'}", "--readings", case / "q.csv", "-o", tmp_path / "t.csv"
    )
    assert (answer.code, answer.err.count("\n")) == (1, 1)
    assert "the left images are mirrored: 2 of 2 show tags in the mirror, and none as they are" in answer.err
    assert not (tmp_path / "t.csv").exists()


REFUSED = {
    "--board dots:9x7": "write kind:columnsxrows",
    "--board chessboard:9x2": "of 3 or more",
    "--board charuco:20x20": "has 200 tags, and dictionary 4X4_50 50",
    "--board charuco:7x5 --dictionary 3X3": "--dictionary 3X3: unknown; valid: 4X4_100",
    "--board chessboard:9x7:first=3": "a chessboard has no tags: leave out first=3",
    "--board chessboard:9x7 --points centers": "is of tags; a board has corners",
    "--board chessboard:9x7": "no chessboard:9x7 in any of 2 images",
}


@pytest.mark.parametrize("options", REFUSED)
def test_boards_that_are_not_there(projservo, monkeypatch, tmp_path, options):
    monkeypatch.chdir(tmp_path)
    for side in ("l", "r"):
        write(f"{side}/0.png", np.full((60, 80), 99, dtype=np.uint8))
    joints("q1", "1")
    answer = projservo("detect", "l", "r", "--readings", "q.csv", "-o", "t.csv", "-q", *options.split())
    assert (answer.code, answer.err.count("\n")) == (1 if "any of" in REFUSED[options] else 2, 1), answer.err
    assert REFUSED[options] in answer.err
    assert not Path("t.csv").exists()


def test_a_configured_board_is_found_in_frames_and_gives_a_length(rng):
    markers = Markers(board=BoardSettings(kind="chessboard", rows=5, columns=7, size_m=0.03))
    assert (len(markers.known), markers.front) == (35, (0, 6, 34, 28))
    assert markers.lengths((0, 6, 34))[0] == pytest.approx([0.0, 0.18, 0.03 * np.hypot(4, 6)])
    assert str(BoardSettings(kind="charuco", rows=6, columns=7, first=20).pattern) == "charuco:7x6:first=20"
    board = markers.board.pattern
    finder = finder_of(board, None)
    H = view_of(rng, 35.0)
    first = finder.find(drawn(board, H, 0.8, 2.0, rng)[0].astype(float))[0]
    turned = finder.like({0: type(first[0])(*(part[::-1] for part in first[0]))}, first)  # from the other end
    np.testing.assert_array_equal(turned[0].pixels, first[0].pixels)


CONTRADICTED = {
    "{kind: chessboard, rows: 7, columns: 9, dictionary: 4X4_50}": "one of kind chessboard has none",
    "{kind: chessboard, rows: 7, columns: 9, first: 20}": "markers.board.first: is of the tags on a board",
    "{kind: chessboard, rows: 2, columns: 9}": "markers.board.rows: must be at least 3, not 2",
    "{kind: charuco, rows: 7, columns: 9}, tags: roof": "board is set as well, whose corners are the markers",
    "{kind: chessboard, rows: 7, columns: 9}": "a chessboard:9x7 looks the same turned by 180°",
}


@pytest.mark.parametrize("text", CONTRADICTED)
def test_configured_boards_that_serve_no_goal(projservo, tmp_path, text):
    (tmp_path / "c.yaml").write_text(
        "robot: {limits: {joints: [[-90, 90], [-90, 90]], unit: deg}}\n"
        "plant: {use: 'tests.hardware.test_cameras:Arm'}\ndata: {table: t.csv}\n"
        "control: {joint_speed_limit_deg_s: 20}\n"
        f"cameras: {{left: {{source: 0}}, right: {{source: 1}}}}\nmarkers: {{board: {text}}}\n"
    )
    answer = projservo("teach", "-c", str(tmp_path / "c.yaml"), "-o", str(tmp_path / "goal.yaml"))
    assert (answer.code, answer.err.count("\n")) == (2, 1), answer.err
    assert CONTRADICTED[text] in answer.err
