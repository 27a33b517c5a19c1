"""Cameras on the tool in metres: exact models, and images of OpenCV from the table to files of others."""

import dataclasses
import json
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from projservo_cli.cli import run
from projservo_cli.metric.frame import MetricParameters
from projservo_cli.metric.nominal_comparison import in_model_frames
from projservo_cli.metric.opencv import opencv_cameras
from projservo_cli.records import InputError, changed
from projservo_cli.results import ImageModel
from projservo_cli.store import run_file
from tests.calibration.simulated_robot import NAMES, around, random_robot
from tests.calibration.test_cameras_on_the_tool import Hand
from tests.metric.test_frame import calibrated, frame  # noqa: F401

cv2 = pytest.importorskip("cv2")
if not hasattr(cv2, "calibrateHandEye"):
    pytest.skip("OpenCV 5 has no hand-eye calibration", allow_module_level=True)

from tests.studies import hand_eye_coverage as hand  # noqa: E402

TAG = ["--metric", str(hand.TAG), "--metric-std", "0.00001", "--between", "tags"]


@pytest.mark.parametrize(("types", "views"), [("RRRRRR", 2), ("RRPRR", 1), ("PRRRRP", 3)])
def test_exact_cameras_see_the_scene_from_a_flange_of_any_arm(types, views, frame, rng):  # noqa: F811
    """Whatever the projective frame: pixels, distances, and the true hand-eye transformation by a model."""
    arm = Hand(**vars(random_robot(types, rng, markers=6, views=views)))
    length = float(np.linalg.norm(arm.markers[0] - arm.markers[1]))
    exact = changed(calibrated(arm, frame), mount="tool", view=NAMES[:views])
    m = exact.metric(length, (0, 10))
    q = around(arm, 5, rng)
    points = np.c_[m.markers, np.ones(len(m.markers))]
    s = np.array([m.cameras(row) @ points.T for row in q])
    np.testing.assert_allclose((s[:, :, :2] / s[:, :, 2:]).swapaxes(2, 3), arm.images(q), atol=1e-6)
    seen = arm.images(q)
    expected = (np.linalg.inv(m.pose(q)) @ points.T).swapaxes(1, 2)[..., :3]
    np.testing.assert_allclose(m.project(expected), seen, atol=1e-6)
    behind = 2.0 * np.linalg.inv(m.poses[0])[2, :3] if views == 1 else None
    assert behind is None or np.isnan(m.project(-100.0 * behind[None])).all()
    seen[0, 0, 2] = np.nan
    if views == 1:
        with pytest.raises(InputError, match="one camera determines no point"):
            m.triangulate(seen)
    else:
        expected[0, 2] = np.nan if views == 2 else expected[0, 2]
        np.testing.assert_allclose(m.triangulate(seen), expected, atol=1e-6)
        noisy = seen + 0.5 * rng.standard_normal((40, *seen.shape))
        error = m.triangulate(noisy) - m.triangulate(seen)
        C = m.triangulation_covariance(seen)
        square = np.einsum("...i,...ij,...j->...", error, np.linalg.inv(C), error)
        assert np.nanmean(square) / 3.0 == pytest.approx(1.0, abs=0.15)
    # A model with a flange of its own: the truth, and not only up to a frame.
    at_zero = [np.eye(4)]
    for twist, reading in zip(arm.twists, -arm.q_reference, strict=True):
        at_zero.append(at_zero[-1] @ expm(twist * reading))
    axes = np.array([T @ H @ np.linalg.inv(T) for T, H in zip(at_zero, arm.twists, strict=False)])
    axes = np.c_[axes[:, 2, 1], axes[:, 0, 2], axes[:, 1, 0], axes[:, :3, 3]]
    flange = hand.pose((0.3, -0.2, 0.5), (0.1, 0.2, 0.3))
    model = in_model_frames(m, axes, at_zero[-1] @ flange)
    np.testing.assert_allclose(model.markers, arm.markers[:, :3], atol=1e-6)
    true = [np.linalg.inv(flange) @ np.linalg.inv(camera_frame(P)) for P in arm.cameras]
    np.testing.assert_allclose(model.poses, true, atol=1e-6)


def camera_frame(P):
    """Pose (4, 4) of the frame that a camera (3, 4) is given in, in that of the camera."""
    T = np.eye(4)
    T[:3] = np.linalg.solve(hand.hand_eye.intrinsics(P), P)
    return T


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A pair of cameras, the run of its recording from the command line, and a URDF of the true arm."""
    folder = tmp_path_factory.mktemp("hand")
    hand.write_recording("pair", folder)
    told = ["--mount", "tool", "--image-size", "1280x1024", "--joints", "RRRRRR"]
    assert run(["calibrate", "--data", str(folder / "hand.csv"), *told, "-o", str(folder / "run")]) == 0
    return hand.RIGS["pair"], folder


def export(folder, kind, *more):
    out = folder / f"{kind}{len(more)}"
    assert run(["export", str(folder / "run"), "--to", kind, "-o", str(out), *TAG, *more]) == 0
    (file,) = (path for path in out.iterdir() if "_info" not in path.name)
    return file


def test_files_of_others_have_the_true_hand_eye_transformation(recorded):
    """By a model of the arm: within its covariance, and alike in each kind of file."""
    eyes, folder = recorded
    model = ["--nominal", str(folder / "ur5.urdf"), "--frames", "model", "--tip", "tool0"]
    found = json.loads(export(folder, "json", *model).read_text())
    poses = np.array(found["poses"])
    wrong = hand.off(poses, np.array([one.X for one in eyes]))
    for error, C in zip(wrong, np.array(found["poses_covariance"]), strict=True):
        assert error @ np.linalg.solve(C, error) < chi2.ppf(0.999, 6)
        assert np.sqrt(np.trace(C[3:, 3:])) < 1e-3  # m
    off_scene = np.linalg.norm(np.array(found["markers"]) - hand.points(), axis=1)
    assert off_scene.max() < 3e-3  # in the base of the model, m
    file = cv2.FileStorage(str(export(folder, "opencv", *model)), cv2.FILE_STORAGE_READ)
    ros = ElementTree.parse(export(folder, "ros", *model)).getroot()
    names = [node.get("args").split() for node in ros]
    for v, view in enumerate(("left", "right")):
        R, t = (file.getNode(f"{view}_{part}_cam2gripper").mat() for part in "Rt")
        # Without skew it is another estimate, by what the noise allows.
        np.testing.assert_allclose(t.ravel(), poses[v, :3, 3], atol=1e-3)
        np.testing.assert_allclose(R, poses[v, :3, :3], atol=2e-3)
        args = dict(zip(names[v][::2], names[v][1::2], strict=True))
        assert (args["--frame-id"], args["--child-frame-id"]) == ("tool0", f"camera_{view}")
        turn = Rotation.from_quat([float(args[f"--q{axis}"]) for axis in "xyzw"]).as_matrix()
        np.testing.assert_allclose(turn, R, atol=1e-9)
        np.testing.assert_allclose([float(args[f"--{axis}"]) for axis in "xyz"], t.ravel(), atol=1e-9)


def test_positions_of_the_flange_are_those_of_the_arm(recorded, capsys):
    """Of a point of it, as a laser tracker would measure them."""
    _, folder = recorded
    q = hand.readings()
    xyz = [(hand.flange(row) @ [0.02, 0.05, 0.1, 1.0])[:3] for row in q]
    names = ",".join(["pose", *(f"q{i}" for i in range(1, 7)), *"xyz"])
    table = folder / "positions.csv"
    np.savetxt(table, np.c_[np.arange(len(q)), q, xyz], ["%d"] + ["%.9f"] * 9, ",", header=names, comments="")
    capsys.readouterr()
    assert run(["validate", str(folder / "run"), "--metric", str(table), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["rms_mm"] < 1.0
    assert 0.1 < found["mahalanobis"] < 5.0


def test_mujoco_moves_the_cameras_with_the_flange(recorded):
    mujoco = pytest.importorskip("mujoco")
    _, folder = recorded
    calibration = run_file.load(folder / "run").calibration
    metric = ImageModel.of(calibration).metric(hand.TAG, "tags")
    model = mujoco.MjModel.from_xml_path(str(export(folder, "urdf")))
    data, q = mujoco.MjData(model), calibration.q_reference + 0.2
    data.qpos[:] = q
    mujoco.mj_kinematics(model, data)
    # Files hold the fit without skew.
    metric = dataclasses.replace(
        metric, bodies=MetricParameters(*(part[None] for part in opencv_cameras(metric, calibration).body))
    )
    camera, expected = data.body("camera_left"), metric.pose(q) @ metric.poses[0]
    np.testing.assert_allclose(camera.xpos, expected[:3, 3], atol=1e-9)
    np.testing.assert_allclose(camera.xmat.reshape(3, 3), expected[:3, :3], atol=1e-9)
