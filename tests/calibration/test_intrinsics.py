"""Cameras that are known by a file of OpenCV or ROS."""

import numpy as np
import pytest
import yaml

from projservo_cli.calibration.known_intrinsics import KnownCameras
from projservo_cli.calibration.pipeline import calibrate
from projservo_cli.geometry.flange import FLANGE_TYPES, FlangeChart
from projservo_cli.geometry.invariant_forms import UPPER
from projservo_cli.records import WORLD, InputError, Observation
from projservo_cli.results import ImageModel
from projservo_cli.store.camera_files import read_intrinsics
from projservo_cli.store.flange_poses import pose_columns
from projservo_cli.store.observation_tables import to_csv
from tests.calibration import board_arms, flange
from tests.calibration.simulated_robot import around, random_robot

cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed: pip install '.[detect]'")

BENT = np.array([-0.2, 0.05, 0.0005, -0.0003, 0.0])


def by_opencv(path, K=flange.K, coefficients=BENT):
    """Write a file as cv2.FileStorage does."""
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in (("image_width", flange.SIZE[0]), ("image_height", flange.SIZE[1])):
        file.write(name, value)
    file.write("camera_matrix", K)
    file.write("distortion_coefficients", coefficients[None])
    file.release()
    return path


def by_ros(path, model, coefficients):
    """Write a file as ROS's camera_calibration does."""
    of = {"camera_matrix": flange.K, "distortion_coefficients": coefficients[None]}
    rows = {name: {"rows": len(M), "cols": M.shape[1], "data": M.ravel().tolist()} for name, M in of.items()}
    size = dict(zip(("image_width", "image_height"), flange.SIZE, strict=True))
    path.write_text(yaml.safe_dump({**size, "distortion_model": model, **rows}))
    return path


@pytest.mark.parametrize("seed", range(5))
def test_a_lens_is_that_of_opencv_where_its_terms_are_radial(tmp_path, seed):
    """Of k1, k2 over the image to the difference of both centres of focal lengths, 0.1 px."""
    rng = np.random.default_rng(seed)
    coefficients = np.array([rng.uniform(-0.3, 0.1), rng.uniform(-0.02, 0.1), 0.0, 0.0, 0.0])
    found = read_intrinsics(by_opencv(tmp_path / "camera.yaml", coefficients=coefficients))
    x = rng.uniform(-0.45, 0.45, (200, 2)) * [1.0, 0.75]
    ideal = x * np.diag(flange.K)[:2] + flange.K[:2, 2]
    seen = cv2.projectPoints(np.c_[x, np.ones(200)], np.zeros(3), np.zeros(3), flange.K, coefficients)[0][
        :, 0
    ]
    rho = np.linalg.norm(ideal - found.lens[:2], axis=1, keepdims=True) / found.lens[2]
    mine = found.lens[:2] + (1.0 + found.lens[3] * rho**2 + found.lens[4] * rho**4) * (ideal - found.lens[:2])
    assert np.abs(mine - seen).max() < 0.15
    assert found.off_px < 0.1
    assert found.size == flange.SIZE


def recording(folder, rng, name, count):
    """A list of detections by a bent lens, and poses."""
    T = flange.poses(rng, count)
    straight = flange.images(T, WORLD, rng, 0.0)[:, 0]
    x = (straight - flange.K[:2, 2]) / np.diag(flange.K)[:2]
    points = np.concatenate([x, np.ones_like(x[..., :1])], axis=-1).reshape(-1, 3)
    seen = cv2.projectPoints(points, np.zeros(3), np.zeros(3), flange.K, BENT)[0].reshape(straight.shape)
    seen += 0.3 * rng.standard_normal(seen.shape)
    pose, marker = np.divmod(np.arange(count * 48), 48)
    u, v = seen.reshape(-1, 2).T
    table = {"pose": pose, "camera": np.full(len(u), "eye"), "marker": marker, "u": u, "v": v}
    (folder / f"{name}.csv").write_text(to_csv(table))
    (folder / f"{name}_poses.csv").write_text(to_csv({"pose": np.arange(count), **pose_columns(T)}))
    return "--data", f"{name}.csv", "--readings", f"{name}_poses.csv"


def test_a_known_lens_is_taken_and_another_camera_is_named(projservo, monkeypatch, tmp_path):
    """New images are predicted within the noise; a focal length that is 3 % off is told by the images."""
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(1)
    train, test = recording(tmp_path, rng, "train", 14), recording(tmp_path, rng, "test", 10)
    by_opencv("mine.yaml")
    by_opencv("other.yaml", flange.K * [[0.97], [0.97], [1.0]])
    found = projservo("calibrate", *train, "--intrinsics", "mine.yaml", "-o", "run", "--json")
    assert found.code == 0, found.err
    assert not [one for one in found.json["findings"] if one["code"] == "other_intrinsics"]
    told = projservo("validate", "run", *test, "--json").json
    assert told["rms_px"] < 1.1 * np.sqrt(2) * 0.3
    found = projservo("calibrate", *train, "--intrinsics", "eye=other.yaml", "-o", "other", "--json")
    said = [one for one in found.json["findings"] if one["code"] == "other_intrinsics"]
    assert [(one["subject"]["views"], one["subject"]["name"]) for one in said] == [(["eye"], "focal length")]


# Deviations of the entries of K: 0.5 % of the focal length, and of the skew, 1 % of the image for the centre.
DEVIATION = np.array([0.005 * 905.0, 0.005 * 905.0, 12.8, 0.005 * 903.0, 9.6])
IDEAL = np.array([640.0, 480.0, 640.0, 0.0, 0.0])


def by_flange(views=1, known=None, count=8):
    """A calibration by few poses of the flange, and of known cameras, K (V, 3, 3)."""
    rng = np.random.default_rng(3)
    T = flange.poses(rng, count)
    chart, seen = FlangeChart.of(T), flange.images(T, WORLD, rng, 0.3, views=views)
    where = {"view": ("one", "two")[:views], "flange_chart": chart.record}
    seen = Observation(np.arange(count), np.arange(48), chart.coordinates(T), seen, **where)
    return calibrate(seen, FLANGE_TYPES, joint_noise=0.0, source="recorded", cameras=cameras(known))


def by_joints(known=None):
    """A calibration by six revolute joints, whose invariant form is the metric of two cameras."""
    robot = random_robot("RRRRRR", np.random.default_rng(2), markers=4)
    rng = np.random.default_rng(5)
    seen = robot.observe(around(robot, 14, rng), 0.5, rng)
    return calibrate(seen, "RRRRRR", sigma_px=0.5, cameras=cameras(known))


def by_parallel_axes(known=None):
    """A calibration by parallel axes and a board of known shape."""
    types, seen = board_arms.recording("scara", np.random.default_rng(4), count=16)
    return calibrate(seen, types, boards=(board_arms.BOARD,), source="recorded", cameras=cameras(known))


def cameras(K):
    """Known cameras without distortion."""
    return (
        None if K is None else KnownCameras(K, np.tile(IDEAL, (len(K), 1)), np.tile(DEVIATION, (len(K), 1)))
    )


def metric_of(found, fit):
    """Entries (V, 5) of K, and their covariance (5 V, 5 V)."""
    length = {} if fit is not by_joints else {"length_m": 1.0, "between": found.marker[[0, 1]].tolist()}
    metric = ImageModel.of(found).metric(**length)
    changes = metric.deviations("K").reshape(-1, 5 * len(metric.K))
    return metric.K[:, *UPPER], changes.T @ changes


@pytest.mark.parametrize("fit", [by_flange, by_joints, by_parallel_axes])
def test_few_poses_and_stated_intrinsics_give_what_both_know_together(fit):
    """K and its covariance are those of the normal densities of both, to the second order of the camera.

    The prior lies one deviation of both off, so that it moves K; what is left is a tenth of a deviation.
    """
    free = fit()
    K, C = metric_of(free, fit)
    S = np.diag(np.tile(DEVIATION**2, len(K)))
    both = np.linalg.inv(np.linalg.inv(C) + np.linalg.inv(S))
    shift = np.linalg.cholesky(C + S) @ np.tile([0.6, -0.6, 0.6, 0.3, -0.6], len(K))
    stated = np.tile(np.eye(3), (len(K), 1, 1))
    stated[:, *UPPER] = K + shift.reshape(K.shape)
    held = fit(known=stated)
    assert "other_intrinsics" not in {one.code for one in held.findings}
    found, of_both = metric_of(held, fit)
    size = np.sqrt(np.diag(both))
    assert size.reshape(K.shape)[:, 0].max() < 0.9 * np.sqrt(np.diag(C)).reshape(K.shape)[:, 0].max()
    np.testing.assert_allclose(np.sqrt(np.diag(of_both)), size, rtol=0.15)
    wanted = K.ravel() + C @ np.linalg.solve(C + S, shift)
    assert np.abs((found.ravel() - wanted) / size).max() < 0.3


def test_a_camera_of_another_focal_length_is_named_and_leaves_the_other_as_a_prior():
    """Of 5 %, as another mode of the sensor; without any prior left the fit is the one without files."""
    free, right = by_flange(2), np.tile(flange.K, (2, 1, 1))
    wrong = right.copy()
    wrong[1, (0, 1), (0, 1)] *= 1.05
    held = by_flange(2, wrong)
    said = [one for one in held.findings if one.code == "other_intrinsics"]
    assert [(one.subject.views, one.subject.name) for one in said] == [(("two",), "focal length")]
    assert said[0].amount == pytest.approx(said[0].limit / 1.05, abs=4.0 * said[0].deviation)
    K, C = (metric_of(free, by_flange), metric_of(held, by_flange))
    assert np.sqrt(C[1][0, 0]) < 0.9 * np.sqrt(K[1][0, 0])
    alone = by_flange(1, wrong[1:])
    np.testing.assert_array_equal(alone.P, by_flange(1).P)


@pytest.mark.parametrize(
    ("model", "coefficients", "message"),
    [
        ("thin_prism", np.zeros(5), "distortion_model thin_prism"),
        ("rational_polynomial", np.r_[BENT, 0.0, 0.0, 0.0, 0.01, 0.0, 0.0, 0.0], "of a thin prism"),
        ("rational_polynomial", np.array([0.8, 0.2, 0.0, 0.0, 0.01, 1.4, 0.3, 0.02]), "miss its lens"),
        ("plumb_bob", np.array([-0.2, 0.05, 0.01, 0.01, 0.0]), "miss its lens"),
        ("plumb_bob", np.array([-0.35, 0.15, 0.0, 0.0, -0.03]), "miss its lens"),  # at the borders alone
        ("fisheye", np.array([-0.01, 0.003, -0.002, 0.0004]), "miss its lens"),
    ],
)
def test_lenses_beyond_the_model_are_refused(tmp_path, model, coefficients, message):
    with pytest.raises(InputError, match=message):
        read_intrinsics(by_ros(tmp_path / "camera.yaml", model, coefficients))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: [", "not YAML"),
        ("a: 1", "has no camera_matrix"),
        ("camera_matrix: [1, 2]", "no matrix"),
        ("3", "no camera"),
    ],
)
def test_files_of_no_camera_are_refused(tmp_path, text, message):
    path = tmp_path / "camera.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        read_intrinsics(path)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--intrinsics", "low=mine.yaml"), "name the file of each"),
        (("--intrinsics", "mine.yaml", "--lens"), "leave one out"),
        (("--intrinsics", "mine.yaml", "--image-size", "640x480"), "is of images of 1280x960 px"),
        (("--intrinsics", "none.yaml"), "a YAML file of a camera"),
    ],
)
def test_files_that_do_not_fit_are_refused(projservo, monkeypatch, tmp_path, options, message):
    monkeypatch.chdir(tmp_path)
    train = recording(tmp_path, np.random.default_rng(1), "train", 8)
    by_opencv("mine.yaml")
    answer = projservo("calibrate", *train, *options, "-o", "run")
    assert (answer.code, message in answer.err) == (2, True), answer.err
    assert "making" not in answer.err  # before any work
