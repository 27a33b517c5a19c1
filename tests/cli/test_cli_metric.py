"""Files in metres, read by other people's code, and positions against a table: from the command line."""

import dataclasses
import json
import runpy
import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from projservo_cli.cli import run
from projservo_cli.metric.frame import MetricParameters
from projservo_cli.metric.opencv import opencv_cameras
from projservo_cli.records import InputError
from projservo_cli.results import ImageModel
from projservo_cli.simulation.urdf import urdf_chain
from projservo_cli.store import run_file

ONES = np.ones(6)
KNOWN = ["--metric", "0.2492990172463582", "--between", "2,8"]


@pytest.fixture(scope="module")
def ur5(shared_data, tmp_path_factory):
    """A run of another simulator's UR5, with lenses."""
    folder = tmp_path_factory.mktemp("metric") / "ur5"
    table = shared_data / "ur5" / "trials_0.5px.csv"
    assert (
        run(["calibrate", "--data", str(table), "--lens", "-o", str(folder), "--image-size", "1280x1024"])
        == 0
    )
    return folder


@pytest.fixture(scope="module")
def metric(ur5):
    return ImageModel.of(run_file.load(ur5).calibration).metric(float(KNOWN[1]), (2, 8))


Q = np.array([[0.3, -1.2, 1.1, -0.4, 0.8, 0.2], [0.1, -1.0, 1.4, -0.8, 1.1, -0.6]])


def export(ur5, tmp_path, kind, *more):
    assert run(["export", str(ur5), "--to", kind, "-o", str(tmp_path / kind), *KNOWN, *more]) == 0
    (file,) = (path for path in (tmp_path / kind).iterdir() if "_info" not in path.name)
    return file


def test_opencv_reads_the_cameras_and_projects_as_the_model_that_was_fitted(ur5, metric, tmp_path):
    cv2 = pytest.importorskip("cv2")
    file = cv2.FileStorage(str(export(ur5, tmp_path, "opencv")), cv2.FILE_STORAGE_READ)
    found = opencv_cameras(metric, run_file.load(ur5).calibration)
    body = found.body
    # The true cameras have no skew, so that this costs what chance does: 14 in one of 1,000 draws.
    assert 0.0 < found.skew_chi2 < 13.9
    assert 0.0 < found.lens_chi2 < 1.0  # a hundredth of the noise where markers are seen
    assert file.getNode("delta_chi2").real() == pytest.approx(found.delta_chi2)
    T = body.tool_poses(metric.prismatic, Q)
    points = (body.markers @ T[:, :3, :3].swapaxes(1, 2) + T[:, None, :3, 3]).reshape(-1, 3)
    for v, view in enumerate(("left", "right")):
        names = ("R", "T", "camera_matrix", "distortion_coefficients")
        R, t, K, dist = (file.getNode(f"{view}_{name}").mat() for name in names)
        pixels = cv2.projectPoints(points, cv2.Rodrigues(R)[0], t, K, dist)[0][:, 0]
        np.testing.assert_allclose(pixels, found.pixels(points)[:, v], atol=1e-6)
    left, right = (
        np.vstack([np.hstack([file.getNode(f"{v}_{part}").mat() for part in "RT"]), [0, 0, 0, 1]])
        for v in ("left", "right")
    )
    stereo = np.hstack([file.getNode("R").mat(), file.getNode("T").mat()])
    np.testing.assert_allclose(stereo, (right @ np.linalg.inv(left))[:3], atol=1e-12)


def test_urdf_and_opencv_are_one_fit(ur5, metric, tmp_path):
    """Arm and cameras of the URDF, with the matrices for OpenCV, project the markers as OpenCV's rig does."""
    found = opencv_cameras(metric, run_file.load(ur5).calibration)
    file = export(ur5, tmp_path, "urdf")
    arm, root = urdf_chain(str(file), "tool", file.read_bytes()), ElementTree.parse(file)
    poses = [
        body.tool_poses(metric.prismatic, Q)
        for body in (found.body, found.body._replace(axes=arm.axes, tool=arm.tip))
    ]
    one, other = (found.body.markers @ T[:, :3, :3].swapaxes(1, 2) + T[:, None, :3, 3] for T in poses)
    for v, view in enumerate(metric.view):
        origin = root.find(f"joint[@name='camera_{view}_fixed']/origin")
        place, turns = (np.array(origin.get(name).split(), dtype=float) for name in ("xyz", "rpy"))
        rays = (other.reshape(-1, 3) - place) @ Rotation.from_euler("xyz", turns).as_matrix()
        m = rays @ found.body.intrinsics()[v].T
        expected = found.body.pixels(one.reshape(-1, 3))[:, v]  # without distortion
        np.testing.assert_allclose(m[:, :2] / m[:, 2:], expected, atol=1e-6)


def pixels_at(metric, tool):
    return metric.body.pixels(metric.markers @ tool[:3, :3].T + tool[:3, 3])


def test_mujoco_reads_the_arm_and_predicts_the_same_pixels(ur5, metric, tmp_path):
    mujoco = pytest.importorskip("mujoco")
    body = opencv_cameras(metric, run_file.load(ur5).calibration).body
    metric = dataclasses.replace(metric, bodies=MetricParameters(*(part[None] for part in body)))
    model = mujoco.MjModel.from_xml_path(str(export(ur5, tmp_path, "urdf")))
    data = mujoco.MjData(model)
    for q in Q:
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        tool = np.eye(4)
        tool[:3, :3], tool[:3, 3] = data.body("tool").xmat.reshape(3, 3), data.body("tool").xpos
        np.testing.assert_allclose(pixels_at(metric, tool), pixels_at(metric, metric.pose(q)), atol=1e-6)
    camera = data.body("camera_left")
    np.testing.assert_allclose(camera.xpos, metric.poses[0, :3, 3], atol=1e-12)
    np.testing.assert_allclose(camera.xmat.reshape(3, 3), metric.poses[0, :3, :3], atol=1e-12)


def matrix(screw):
    H = np.zeros((4, 4))
    H[:3, :3], H[:3, 3] = np.cross(np.eye(3), screw[:3]), screw[3:]
    return H


@pytest.fixture
def model_of(reference_truth, tmp_path):
    """Write a URDF of the true arm whose zeros are off, rad, links too long or senses other; its path."""
    truth = reference_truth("ur5")
    true = np.array([[*screw["w"], *screw["v"]] for screw in truth["screws"]])

    def write(zero, link_m=0.0, sense=ONES):
        text = wrong_model(sense[:, None] * true, sense * np.array(truth["q_reference"]), zero, link_m)
        (tmp_path / "model.urdf").write_text(text)
        return str(tmp_path / "model.urdf")

    return write


def wrong_model(true, q, zero, link_m):
    """A URDF of screws (n, 6) at readings q, whose zeros are off and whose third link is too long."""
    T, last, lines = np.eye(4), np.zeros(3), ['<robot name="wrong"><link name="l0"/>']
    for i, screw in enumerate(true):
        H = T @ matrix(screw) @ np.linalg.inv(T)
        w, v = np.array([H[2, 1], H[0, 2], H[1, 0]]), H[:3, 3]
        place = np.cross(w, v) + w * (w @ last)
        if i == 3:
            place += link_m * (place - last) / np.linalg.norm(place - last)
        lines.append(
            f'<link name="l{i + 1}"/><joint name="j{i}" type="continuous"><parent link="l{i}"/>'
            f'<child link="l{i + 1}"/><origin xyz="{" ".join(map(str, place - last))}"/>'
            f'<axis xyz="{" ".join(map(str, w))}"/></joint>'
        )
        last = place
        T = T @ expm(matrix(screw) * (-q[i] - zero[i]))
    return "".join([*lines, "</robot>"])


def test_zeros_and_links_of_a_wrong_model_are_found(ur5, model_of, tmp_path, capsys):
    """A model off by 2° in the zeros of joints 3 and 5 and 3 mm in a link, beside the truth."""
    zero = np.radians([0.0, 0.0, -2.0, 0.0, -2.0, 0.0])
    file = model_of(zero, 0.003)
    capsys.readouterr()
    export(ur5, tmp_path, "ros", "--nominal", str(file), "--json")
    answer = json.loads(capsys.readouterr().out)
    errors = {e["joint"]: e for e in answer["nominal"]}
    assert abs(answer["length_error"]) < 4.0 * answer["length_error_std"]
    for joint in (2, 3, 4, 5):
        found, std = np.degrees([errors[joint]["zero"], errors[joint]["zero_std"]])
        assert abs(found - np.degrees(zero[joint - 1])) < 3.5 * std
    assert errors[1]["zero"] is None
    assert errors[6]["zero"] is None


OTHERS = {
    "joint 1": ([1], 0.0, "joint 1 turns the other way in the model (or", "--frames", "model"),
    "two joints": ([2, 5], 0.0, "joint 2 turns the other way in the model and joint 5 turns the other way"),
    "a zero": ([], 180.0, "the zero of joint 3 is off by", "--frames", "model"),
}


@pytest.mark.parametrize("kind", OTHERS)
def test_a_model_with_other_senses_or_zeros_is_refused(ur5, model_of, tmp_path, capsys, kind):
    reversed_joints, zero, words, *more = OTHERS[kind]
    sense = np.where(np.isin(np.arange(1, 7), reversed_joints), -1.0, 1.0)
    file, out = model_of(np.radians(zero) * np.eye(6)[2], sense=sense), tmp_path / "out"
    capsys.readouterr()
    words_of_model = ["--nominal", str(file), *more]
    assert run(["export", str(ur5), "--to", "ros", "-o", str(out), *KNOWN, *words_of_model]) == 1
    assert words in " ".join(capsys.readouterr().err.split())
    assert not out.exists()


def test_case_of_a_model_in_which_a_joint_turns_the_other_way(shared_data, tmp_path, monkeypatch, capsys):
    """Case 02: a model by its own zeros, as it is and with a joint reversed."""
    case = shared_data.parent / "cases" / "02_nominal_sign"
    if not case.exists():
        pytest.skip(f"{case} is absent")
    monkeypatch.chdir(tmp_path)
    assert run(["calibrate", "--data", str(case / "trials.csv"), "-o", "out", "-q"]) == 0
    model = ["--nominal", "m.urdf", "--tip", "tool", "--frames", "model"]
    known = ["--metric", "0.19105", "--between", "0,2"]
    for joint in (2, 0):
        monkeypatch.setattr(sys, "argv", ["model_other_zeros.py", str(joint)])
        capsys.readouterr()
        runpy.run_path(str(case / "model_other_zeros.py"), run_name="__main__")
        Path("m.urdf").write_text(capsys.readouterr().out)
        code = run(["export", "out", *known, "--to", "ros", "-o", "e", *model])
        told = " ".join(capsys.readouterr().err.split())
        assert (code, Path("e").exists()) == ((1, False) if joint else (0, True))
        assert (f"joint {joint} turns the other way in the model" in told) == bool(joint)


def face_pixels(metric):
    return np.array([pixels_at(metric, T) for T in metric.pose(Q)])


def test_cameras_come_in_the_base_of_a_model(ur5, reference_truth, model_of, tmp_path, capsys):
    """Of one whose zeros are wrong: cameras where they are, and the same pixels as before."""
    truth, file = reference_truth("ur5"), model_of(np.radians([0.0, 0.0, -2.0, 0.0, 1.0, 0.0]))
    model = ["--nominal", file, "--frames", "model"]
    found = json.loads(export(ur5, tmp_path, "json", *model).read_text())
    for v, view in enumerate(("left", "right")):
        P = np.array(truth[f"camera_{view}"])
        center = -np.linalg.solve(P[:, :3], P[:, 3])
        off = np.array(found["poses"])[v, :3, 3] - center
        C = np.array(found["poses_covariance"])[v, 3:, 3:]
        assert off @ np.linalg.solve(C, off) < 16.3  # once in a thousand
        assert np.sqrt(np.trace(C)) < 8e-3
    m = ImageModel.of(run_file.load(ur5).calibration).metric(float(KNOWN[1]), (2, 8))
    there = m.in_frames_of(file)
    np.testing.assert_allclose(face_pixels(there), face_pixels(m), atol=1e-9)
    capsys.readouterr()
    assert run(["export", str(ur5), "--to", "ros", *KNOWN, "--frames", "model"]) == 2
    assert "--nominal URDF" in capsys.readouterr().err
    with pytest.raises(InputError, match="degrees"):
        m.pose(np.degrees(Q))
    assert "left camera" in repr(m)
    assert len(repr(m).splitlines()) < 12


@pytest.mark.parametrize(("factor", "word"), [(0.98, "short"), (1.0, ""), (1.02, "long")])
def test_links_of_a_model_contradict_a_length_that_is_wrong(ur5, model_of, tmp_path, capsys, factor, word):
    """By 2 % of 249 mm, 5 mm, told within four of its deviations; a length that is right is none."""
    length = ["--metric", str(factor * float(KNOWN[1])), "--between", "2,8", "--nominal"]
    capsys.readouterr()
    out = tmp_path / "out"
    code = run(["export", str(ur5), "--to", "json", "-o", str(out), *length, model_of(np.zeros(6))])
    err = " ".join(capsys.readouterr().err.split())
    assert (code, out.exists()) == ((1, False) if word else (0, True))
    assert (f"too {word} for the links of the model" in err) == bool(word)
    if not word:
        value = json.loads((out / "metric.json").read_text())
        assert abs(value["length_error"]) < 4.0 * value["length_error_std"]
