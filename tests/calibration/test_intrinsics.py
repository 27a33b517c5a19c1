"""Cameras that are known by a file of OpenCV or ROS."""

import numpy as np
import pytest
import yaml

from projservo_cli.records import WORLD, InputError
from projservo_cli.store.camera_files import read_intrinsics
from projservo_cli.store.flange_poses import pose_columns
from projservo_cli.store.observation_tables import to_csv
from tests.calibration import flange

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


def recording(folder, rng, name, count=25):
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
    train, test = recording(tmp_path, rng, "train"), recording(tmp_path, rng, "test", 10)
    by_opencv("mine.yaml")
    by_opencv("other.yaml", flange.K * [[0.97], [0.97], [1.0]])
    found = projservo("calibrate", *train, "--intrinsics", "mine.yaml", "-o", "run", "--json")
    assert found.code == 0, found.err
    assert not [one for one in found.json["findings"] if one["code"] == "other_intrinsics"]
    told = projservo("validate", "run", *test, "--json").json
    assert told["rms_px"] < 1.1 * np.sqrt(2) * 0.3
    found = projservo("calibrate", *train, "--intrinsics", "eye=other.yaml", "-o", "other", "--json")
    said = [one for one in found.json["findings"] if one["code"] == "other_intrinsics"]
    assert [one["subject"]["views"] for one in said] == [["eye"]]


@pytest.mark.parametrize(
    ("model", "coefficients", "message"),
    [
        ("thin_prism", np.zeros(5), "distortion_model thin_prism"),
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
