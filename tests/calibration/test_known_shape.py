"""Boards of known shape: their fit, what contradicts them, and metres by them."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import yaml

import projservo_cli as projservo
from projservo_cli.calibration.bundle_adjustment import BOARD, LeastSquares
from projservo_cli.calibration.detections import Detections
from projservo_cli.calibration.pipeline import calibrate
from projservo_cli.calibration.prediction import Parameters, predict, prediction_variance
from projservo_cli.geometry.flange import FLANGE_TYPES, FlangeChart
from projservo_cli.messages import lines
from projservo_cli.messages.rows_by_code import Setup
from projservo_cli.records import WORLD, InputError, Observation, StatedBoard
from projservo_cli.results import ImageModel
from projservo_cli.store.observation_tables import write_table
from tests.calibration import board_arms, flange
from tests.calibration.board_arms import PITCH

EIGHT_BY_SIX = StatedBoard(0, 8, 6, flange.PITCH)


def by_flange(rng, shape=lambda X: X, boards=(EIGHT_BY_SIX,), count=16):
    """Calibration by poses of the flange and a board of another shape."""
    T = flange.poses(rng, count)
    seen = flange.images(T, WORLD, rng, 0.3, shape(flange.board()))
    chart = FlangeChart.of(T)
    observation = Observation(
        np.arange(count), np.arange(48), chart.coordinates(T), seen, view=("eye",), flange_chart=chart.record
    )
    return calibrate(observation, FLANGE_TYPES, boards=boards, joint_noise=None, source="recorded")


def said_of(findings):
    """Findings in words."""
    return "; ".join(lines(findings, Setup(WORLD, ("eye",))))


def problem_of(rng, boards):
    """An adjustment of two cameras, three joints and twelve markers about its parameters."""
    types, K = "RPR", 6
    q, M = rng.uniform(-0.5, 0.5, (K, 3)), np.c_[rng.normal(size=(12, 3)), np.ones(12)]
    H = np.zeros((3, 4, 4))
    for i, w in enumerate(rng.normal(size=(3, 3))):
        w /= np.linalg.norm(w)
        H[i, :3, :3] = 0.0 if types[i] == "P" else np.cross(np.eye(3), -w)
        H[i, :3, 3] = w if types[i] == "P" else np.cross(rng.normal(size=3), w)
    P = np.array([np.c_[np.eye(3), [0.1 * v, 0.2, 9.0]] * [[700.0], [700.0], [1.0]] for v in range(2)])
    params = Parameters(P, H, np.array([False, True, False]), M)
    images = params.predict(q) + 0.1 * rng.standard_normal((K, 2, 12, 2))
    detections = Detections.of(Observation(np.arange(K), np.arange(12), q, images), types)
    problem = LeastSquares.of(dataclasses.replace(detections, board=np.array(boards)), np.zeros(3))
    return problem, params


@pytest.mark.parametrize("boards", [[0] * 12, [0] * 5 + [-1] * 3 + [1] * 4])
def test_derivatives_by_a_board_are_those_of_its_motion_and_its_frame_moves_no_image(rng, boards):
    """To the truncation of central differences, 1e-6 of the largest, and to round-off."""
    problem, params = problem_of(rng, boards)
    J = problem.dense(problem.derivative(params), problem.detections.seen)
    step, columns = 1e-6, []
    for k in range(problem.size):
        x = np.zeros(problem.size)
        x[k] = step
        ends = [problem.residual(problem.retract(params, sign * x)).ravel() for sign in (1, -1)]
        columns.append((ends[0] - ends[1]) / (2 * step))
    np.testing.assert_allclose(J, np.transpose(columns), atol=1e-6 * np.abs(J).max())
    gauge = problem.gauge(params)
    assert np.abs(J @ gauge).max() < 1e-9 * np.abs(J).max()
    assert np.linalg.matrix_rank(J) == problem.free - gauge.shape[1]
    moved = problem.retract(params, rng.normal(size=problem.size) * 0.1)
    for board in problem.detections.boards:
        X, Y = (one.M[np.array(boards) == board, :3] for one in (params, moved))
        ratio = np.linalg.norm(Y[1:] - Y[0], axis=1) / np.linalg.norm(X[1:] - X[0], axis=1)
        np.testing.assert_allclose(ratio, ratio[0], rtol=1e-12)
    assert problem.shared - problem.curved.stop == BOARD * len(problem.detections.boards)


def test_a_known_shape_predicts_at_its_own_bound():
    """Errors at 40 new poses are as stated, to 40 %, and less than two thirds of those of free points."""
    rng = np.random.default_rng(1)
    free, held = (by_flange(np.random.default_rng(2), boards=one) for one in ((), (EIGHT_BY_SIX,)))
    assert free.boards is None
    assert held.boards.tolist() == [[0.0, 8.0, 6.0, flange.PITCH, 0.0]]
    T, rms = flange.poses(rng, 40), []
    for found in (free, held):
        q = FlangeChart.from_record(found.flange_chart).coordinates(T)
        error = predict(found, q) - flange.images(T, WORLD, rng, 0.0)
        rms.append(np.sqrt((error**2).sum(axis=-1).mean()))
        stated = np.sqrt(prediction_variance(found, q).sum(axis=-1).mean())
        assert stated / 1.4 < rms[-1] < 1.4 * stated
    assert rms[1] < rms[0] / 1.5


STAGGERED = StatedBoard(0, 4, 12, 0.02, staggered=True)


def lattice(X):
    """Circles (48, 3) of a grid whose odd rows are one pitch on, as OpenCV has its points, m."""
    u, v = np.meshgrid(np.arange(4), np.arange(12))
    return np.c_[0.02 * (2 * u + v % 2 - 3.5).ravel(), 0.02 * (v.ravel() - 5.5), np.zeros(48)]


def test_the_shape_of_an_asymmetric_grid_is_its_own_and_no_other():
    """It is taken as it is, and refuted as rows without a shift, by the same images."""
    found = by_flange(np.random.default_rng(0), shape=lattice, boards=(STAGGERED,))
    assert [StatedBoard.of(one) for one in found.boards.tolist()] == [STAGGERED]
    assert not {one.code for one in found.findings} & {"unused_shape", "other_pitch"}
    other = by_flange(np.random.default_rng(0), shape=lattice, boards=(STAGGERED._replace(staggered=False),))
    assert other.boards is None
    assert "unused_shape" in {one.code for one in other.findings}
    assert StatedBoard.of([0, 4, 12]) == STAGGERED._replace(pitch_m=None, staggered=False)


OTHERWISE = {
    "longer": lambda X: X * [1.005, 1.0, 1.0],
    "bent": lambda X: X + np.c_[np.zeros((48, 2)), 1e-3 * (1.0 - (X[:, 0] / 0.0875) ** 2)],
}


@pytest.mark.parametrize("name", OTHERWISE)
def test_a_board_that_is_not_as_printed_is_said_and_its_shape_not_used(name):
    found = by_flange(np.random.default_rng(0), shape=OTHERWISE[name], count=25)
    assert found.boards is None
    said = [one for one in found.findings if one.code == "unused_shape"]
    assert len(said) == 1
    assert (abs(said[0].others[0].amount) > 3e-3) == (name == "longer")
    assert "the board 8x6 is not as stated" in said_of(said)


def test_a_board_of_other_columns_is_said():
    found = by_flange(np.random.default_rng(0), boards=(StatedBoard(0, 6, 8),))
    assert [one.code for one in found.findings if one.code.endswith("shape")] == ["unused_shape"]


def test_of_several_boards_the_wrong_one_is_said_and_the_others_are_used():
    """Half of the corners are a board as stated, the others are not; a third is nowhere."""
    halves = StatedBoard(0, 8, 3), StatedBoard(24, 8, 3), StatedBoard(90, 8, 3)
    bent = lambda X: X * np.where(np.arange(48) < 24, 1.0, 1.01)[:, None] ** [1, 0, 0]  # noqa: E731
    found = by_flange(np.random.default_rng(0), shape=bent, boards=halves, count=25)
    assert found.boards.tolist() == [[0.0, 8.0, 3.0, pytest.approx(np.nan, nan_ok=True), 0.0]]
    said = [one for one in found.findings if one.code in ("unused_shape", "unplaced_board")]
    assert sorted((one.code, *one.subject.markers) for one in said) == [
        ("unplaced_board", 90),
        ("unused_shape", 24),
    ]
    assert "0 corners of the board 8x3 from marker 90 are known; its shape takes 6" in said_of(said)


def test_positions_that_are_short_against_a_board_are_said_with_their_factor():
    found = by_flange(np.random.default_rng(0), boards=(StatedBoard(0, 8, 6, 1.0045 * flange.PITCH),))
    said = [one for one in found.findings if one.code == "other_pitch"]
    assert len(said) == 1
    assert said[0].amount / said[0].limit == pytest.approx(1 / 1.0045, abs=4 * said[0].deviation / PITCH)
    assert "% short, or the board is printed small" in said_of(said)


@pytest.mark.parametrize(("name", "views"), [("scara", 2), ("gantry", 1), ("palletiser", 1)])
def test_arms_of_parallel_axes_get_metres_by_a_board(name, views):
    """Intrinsics within four standard deviations, lengths to 0.3 %."""
    rng = np.random.default_rng(4)
    types, observation = board_arms.recording(name, rng, views=views)
    known = {"image_size": board_arms.SIZE, "joint_noise": 0.0, "source": "recorded"}
    found = calibrate(observation, types, boards=(board_arms.BOARD,), **known)
    assert found.usable
    metric = ImageModel.of(found).metric()
    for K, covariance in zip(metric.K, metric.covariance("K"), strict=True):
        off = (K - board_arms.K)[np.triu_indices(3)][:5]
        assert off @ np.linalg.pinv(covariance) @ off < 4.0**2 + 5.0
    X = metric.markers - metric.markers.mean(axis=0)
    assert np.linalg.norm(X[0] - X[-1]) == pytest.approx(PITCH * np.hypot(7, 5), rel=3e-3)
    np.testing.assert_allclose(np.linalg.svd(X)[1][2], 0.0, atol=1e-9)


def test_a_run_with_a_board_validates_refits_and_exports_metres(projservo, tmp_path, monkeypatch):
    """From the command line: a camera that moved is fitted again from six poses; no length is given."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(6)
    types, observation = board_arms.recording("scara", rng, views=2)
    write_table(observation, "trials.csv")
    asked = "--joints", types, "--board", "chessboard:8x6:20mm", "--image-size", "1280x960", "-o", "run"
    answer = projservo("calibrate", "--data", "trials.csv", *asked, "--json")
    assert answer.code == 0
    assert answer.json["boards"] == [{"board": "8x6", "first": 0, "used": True}]
    for name, angle in (("same", 0.0), ("moved", 0.02)):
        write_table(board_arms.recording("scara", rng, 8, views=2, turned=angle)[1], f"{name}.csv")
        assert projservo("validate", "run", "--data", f"{name}.csv").code == int(name == "moved")
    found = projservo("calibrate", "run", "--refit", "top", "--data", "moved.csv", "-o", "new")
    assert found.code == 0, found.err
    assert projservo("validate", "new", "--data", "moved.csv").code == 0
    for kind in ("json", "ros"):
        assert projservo("export", "new", "--to", kind).code == 0
    info = yaml.safe_load(Path("new/ros/low_info.yaml").read_text())
    assert (info["image_width"], info["distortion_model"]) == (1280, "plumb_bob")
    K = np.reshape(info["camera_matrix"]["data"], (3, 3))
    np.testing.assert_allclose(K, board_arms.K, atol=8.0)  # to 1 % of the focal length
    metric = json.loads(Path("new/json/metric.json").read_text())
    X = np.array(metric["markers"])[[0, 47]]
    assert np.linalg.norm(X[0] - X[1]) == pytest.approx(PITCH * np.hypot(7, 5), rel=1e-3)


@pytest.mark.parametrize(
    ("boards", "message"),
    [
        ([(0, 8)], "give the number"),
        ([(0, 8, 1)], "2 or more"),
        ([(-1, 8, 6)], "number"),
        ([(0, 8, 6, 0)], "m"),
    ],
)
def test_boards_that_are_none_are_refused(boards, message):
    types, observation = board_arms.recording("scara", np.random.default_rng(0))
    seen = projservo.Observations.of(observation, joint_types=types)
    with pytest.raises(InputError, match=message):
        projservo.calibrate(seen, boards=boards, progress=False)
