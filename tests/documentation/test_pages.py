"""Every command of the documentation is run, in a folder of its own for each page."""

import json
import os
import re
import shutil
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import projservo_cli
from docs.generate.regions import GROUPS
from projservo_cli import cli
from projservo_cli.config import load_config
from projservo_cli.geometry.displacements import rigid_inverse
from projservo_cli.messages.rows_by_code import ROWS
from projservo_cli.records import TOOL
from projservo_cli.report import animation as film
from projservo_cli.report.figures import FIGURES
from projservo_cli.simulation.mjcf import mujoco
from tests.calibration import flange
from tests.calibration.flange import write_recording
from tests.configured import draw_only, truth_of
from tests.detection.lerobot import make_episodes, write_dataset
from tests.detection.rendering import render, square
from tests.documentation.blocks import PAGES, ROOT, blocks_of, run_page

# Those that run laws or plan: only with the compiler.
DRIVING = {
    "align-and-insert",
    "benchmark-a-law",
    "choose-your-rig",
    "commands",
    "first-law",
    "follow-a-belt",
    "first-run",
    "planning",
    "python",
    "read-a-report",
    "recorded-table",
    "reproduce-the-paper",
    "robot-class",
    "run-file",
}
LANGUAGES = {"sh", "python", "text", "xml", "yaml"}
# What cannot be run by a test, and how often it stands there.
NOT_RUN = {
    "episodes": 1,
    "install": 1,
    "pick-a-part": 3,
    "refit-a-camera": 1,
    "rendered-cameras": 1,
    "so101": 5,
    "use-a-cluster": 1,
}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with the shipped configurations and what a reader is said to have."""
    (tmp_path / "configs").symlink_to(ROOT / "configs")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path, str(tmp_path)])
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    return tmp_path


def put_tags(folder):
    """Two pairs of images with a tag, and their joint readings."""
    cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed: pip install '.[detect]'")
    tags = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    for side in ("left", "right"):
        (folder / "images" / side).mkdir(parents=True)
        for k in range(2):
            image = render(cv2, tags, (160, 120), [(k, square((80 + 5 * k, 60), 50, 0.2 * k))])
            (folder / "images" / side / f"{k}.png").write_bytes(cv2.imencode(".png", image)[1].tobytes())
    (folder / "readings.csv").write_text("q1,q2\n0.1,0.2\n0.1,0.3\n")


def put_sheet(folder, arm="stanford", name="sheet.json"):
    """The simulated robot of a configuration as a data sheet."""
    truth = truth_of(load_config(folder / "configs" / f"{arm}.yaml"))
    twists = truth.robot.H_hat_0
    sheet = {
        "screws": [{"w": [T[2, 1], T[0, 2], T[1, 0]], "v": T[:3, 3].tolist()} for T in twists],
        "q_reference": truth.robot.q_reference.tolist(),
        "camera_left": truth.P[0].tolist(),
        "camera_right": truth.P[1].tolist(),
        "markers_tool": truth.M[:, :3].tolist(),
        "marker_numbers": list(truth.number),
        "T_base_tool_at_reference": np.eye(4).tolist(),
        "image_size": truth.image_size[0].tolist(),
    }
    (folder / name).write_text(json.dumps(sheet))


def put_truth(folder):
    """The data sheet of the arm that the class of the page simulates."""
    put_sheet(folder, "ur5", "truth.json")


def put_hand(folder):
    """A recording by a camera on the hand of a UR5, and a model of the arm."""
    cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed: pip install '.[detect]'")
    if not hasattr(cv2, "calibrateHandEye"):
        pytest.skip("OpenCV 5 has no hand-eye calibration")
    from tests.studies.hand_eye_coverage import write_recording

    write_recording("one", folder)


def put_poses(folder):
    """Two recordings by a camera on a flange, with its poses, and poses of a target that it sees."""
    rng = np.random.default_rng(2)
    write_recording(folder, TOOL, rng)
    write_recording(folder, TOOL, rng, ("new", "new_poses"), 8)
    T = rigid_inverse(flange.poses(np.random.default_rng(2)) @ flange.HAND) @ flange.BOARD_ON_TABLE
    T[:, :3, 3] += 3e-4 * rng.standard_normal((len(T), 3))
    T[:, :3, :3] = Rotation.from_rotvec(1e-3 * rng.standard_normal((len(T), 3))).as_matrix() @ T[:, :3, :3]
    m = T[:, :3, 3] @ flange.K.T
    pose = np.flatnonzero((np.abs(m[:, :2] / m[:, 2:] - [640.0, 480.0]) < [540.0, 380.0]).all(axis=1))
    rows = {"pose": pose, "target": 0 * pose, **flange.pose_columns(T[pose])}
    (folder / "targets.csv").write_text(flange.to_csv(rows))


def put_bag(folder):
    """A bag of a robot that carries a board from stop to stop, with stamps 50 ms late."""
    from tests.detection.ros_bags import Bag, Show, put_readings

    show, bag = Show(18, delay=0.05), Bag(folder / "recording", "mcap")
    put_readings(bag, show, "tf")
    for side, frames in zip(("left", "right"), show.frames(2), strict=True):
        for t, image in frames:
            bag.image(f"/{side}/image_raw", t, image)
    bag.close()


def put_episodes(folder):
    """Four episodes of an arm of three joints, between which a camera moves."""
    for package in ("cv2", "av", "pyarrow"):
        pytest.importorskip(package, reason=f"{package} is not installed: pip install '.[lerobot]'")
    episodes, _ = make_episodes(np.random.default_rng(5), 4, moved=2)
    names = ["shoulder_pan.pos", "shoulder_lift.pos", "wrist_roll.pos", "gripper.pos"]
    write_dataset(folder / "pick", "v3.0", episodes, names)


def require_gl():
    """Skip where nothing can be drawn."""
    try:
        mujoco().Renderer(mujoco().MjModel.from_xml_string("<mujoco/>"), 8, 8).close()
    except Exception as error:
        pytest.skip(f"nothing can be drawn: {error}")


def check_rendered(folder, names, read):
    """Frames show the markers, and what was taught is where the true cameras project them."""
    table = np.genfromtxt("few.csv", delimiter=",", names=True)
    assert np.isfinite(table["u_left"]).mean() > 0.8
    for name, file, q in (
        ("configs/rendered", "goal", [3.6, -1.6, -1.9, 0.3, 1.2, 3.4]),
        ("arm", "there", [0.1, 0.1, 0.2]),
    ):
        config = load_config(f"{name}.yaml", [f"task.goal={folder / file}.yaml"])
        truth, images = truth_of(config), config.task.goal.images
        expected = truth.images(np.array(q), truth.of(images.markers))
        for told, s in zip((images.left, images.right), expected, strict=True):
            seen = [k for k, pixel in enumerate(told) if pixel is not None]
            assert len(seen) >= 8
            off = np.array([told[k] for k in seen]) - s[seen]
            assert np.abs(off).max() < (0.3 if name == "configs/rendered" else 3.0)  # sag and play


def check_installation(folder, names, read):
    assert load_config(folder / "mine.yaml").name == "mine"
    assert json.loads((folder / "projservo.schema.json").read_text())["title"]


def check_tutorial(folder, names, read):
    run = projservo_cli.load("results/task")
    assert {run.traces[name].verdict for name in ("direct_two", "exact")} == {"converged"}
    assert run.calibration.source == "recorded"
    drift = {name: run.traces[name].center_deviation_mm for name in ("exact", "direct_two")}
    assert drift["exact"] < drift["direct_two"]


def check_diagnostics(folder, names, read):
    calibration = projservo_cli.load("results/spoiled").calibration
    np.testing.assert_array_equal(calibration.poorly_observable, [False] * 4 + [True, False])
    assert len(calibration.outlier) == 8


def check_commands(folder, names, read):
    """The objects have the keys that the page tells."""
    rows = [line.split("|")[1:3] for line in PAGES["commands"].read_text(encoding="utf-8").splitlines()]
    told = {row[0].strip(" `"): set(re.findall(r"`(\w+)`", row[1])) for row in rows if len(row) == 2}
    assert cli.run(["calibrate", "plan", "-o", "results/ur5", "--json"]) == 0
    found = json.loads(read())
    later = {"cross_validation", "suggestions", "joint_model"}  # only where they are asked for
    assert told["calibrate"] - {"name", "type", "excitation", "poorly_observable"} - later <= set(
        found["calibrate"]
    )
    assert {"name", "type", "excitation", "poorly_observable"} <= set(found["calibrate"]["joints"][0])
    of_object = {"objects", "markers", "shift_mm", "angle_deg", "shift_px", "reason"}
    of_object |= {f"goal_deviation_{unit}" for unit in ("mm", "deg", "px")}
    assert told["plan"] - {"min", "mu"} - of_object <= set(found["plan"])
    assert {"min", "mu"} == set(found["plan"]["margins"]["joints"])
    assert cli.run(["record", "-c", "configs/ur5.yaml", "--output", "trials.csv", "--json"]) == 0
    assert told["record"] == set(json.loads(read()))
    assert cli.run(["validate", "results/ur5", "--data", "trials.csv", "--json"]) == 0
    assert told["validate"] | {"run"} == set(json.loads(read()))


def check_law(folder, names, read):
    assert projservo_cli.load("results/law").traces["my_laws:Damped"].verdict == "converged"


def check_guidance(folder, names, read):
    """The points keep the limits, and lead from the start to the goal as the true cameras see it."""
    config = load_config(folder / "configs" / "paper.yaml")
    truth, points = truth_of(config), names["points"]
    q, rate = (np.array([point[name] for point in points]) for name in ("positions", "velocities"))
    assert ((q >= truth.robot.limits.lower) & (q <= truth.robot.limits.upper)).all()
    assert np.abs(rate).max() <= np.radians(config.control.joint_speed_limit_deg_s)
    assert [points[0]["time_from_start"], points[-1]["time_from_start"]] == [0.0, names["plan"].duration]
    np.testing.assert_array_equal(q[0], names["q_start"])
    np.testing.assert_allclose(truth.images(q[-1], truth.M_face), [names["left"], names["right"]], atol=1.5)


def check_run_file(folder, names, read):
    """What the page says of groups is what is there, and in which."""
    with h5py.File("results/paper/run.h5") as file:
        found = {}
        file.visititems(lambda name, item: found.update({name: item.attrs.get("record")}))
    held = {name: record for name, record in found.items() if record is not None}
    said = {name.replace("<law>", "direct_two"): record.__name__ for name, record in GROUPS.items()}
    assert held == {name: said[name] for name in held}
    assert {"calibrate/observation", "calibrate/calibration", "plan", "servo/direct_two"} <= set(held)


def check_report(folder, names, read):
    for name in ("view.html", "animation.gif"):
        assert f'<a href="{name}">' in Path("results/turn/report.html").read_text(encoding="utf-8")
        assert Path("results/turn", name).stat().st_size > 10_000
    assert Path("both.html").is_file()


def check_robot(folder, names, read):
    """Both laws converge within their limits, and an arm without commands comes to rest."""
    assert names["robot"].q == pytest.approx(names["gone"], abs=1e-6)
    run = projservo_cli.load("results/mine")
    assert {law: trace.verdict for law, trace in run.traces.items()} == dict.fromkeys(
        ("direct_three", "exact"), "converged"
    )
    task = load_config("mine.yaml").task
    for trace in run.traces.values():
        np.testing.assert_allclose(trace.q[0], task.start.joints, atol=1e-3)
        # The goal is predicted from 0.5 px of noise, far from the reference: about a pixel, half a degree.
        # Without joint limits a joint may arrive a whole turn away.
        turns = (trace.q[-1] - task.goal.joints.joints) / (2 * np.pi)
        np.testing.assert_allclose(2 * np.pi * (turns - np.round(turns)), 0.0, atol=np.radians(1.0))
    limit = np.radians(125.0) * 0.5
    assert np.abs(run.traces["direct_three"].q_dot).max() <= limit * (1 + 1e-12)


def check_teach(folder, names, read):
    config = load_config("configs/ur5.yaml", [f"task.goal={folder / 'there.yaml'}"])
    assert len(config.task.goal.images.markers) == 10


def check_paper(folder, names, read):
    """The table of claims is that of the reports: each claim, and on which benchmark it holds.

    Its figures are those of the paper.
    """
    text = PAGES["reproduce-the-paper"].read_text(encoding="utf-8")
    rows = [[cell.strip(" *") for cell in line.split("|")] for line in text.splitlines()]
    rows = [row for row in rows if len(row) == 7]
    for column, name in enumerate(row for row in rows[0][3:6]):
        told = {row[1]: re.match("yes|no|–", row[3 + column]) for row in rows[2:]}
        path = Path("results", name.strip("`"), "claims.json")
        claims = json.loads(path.read_text(encoding="utf-8"))["claims"]
        holds = {claim["claim"]: {True: "yes", False: "no", None: "–"}[claim["holds"]] for claim in claims}
        assert {claim: cell and cell[0] for claim, cell in told.items()} == holds
    figures = set(re.findall(r"`(fig\d\d_\w+)`", text))
    assert figures == {spec.name for spec in FIGURES if spec.paper.startswith("Fig.")}
    assert figures <= {path.stem for path in Path("results/paper/figures").glob("*.svg")}


HAS = {
    "bags": (put_bag,),
    "camera-on-the-hand": (put_hand,),
    "episodes": (put_episodes,),
    "flange-poses": (put_poses,),
    "print-and-mount-tags": (put_tags,),
    "observation-tables": (put_sheet,),
    "robot-class": (put_truth,),
}
CHECK = {
    "commands": check_commands,
    "first-law": check_law,
    "install": check_installation,
    "mend-a-calibration": check_diagnostics,
    "planning": check_guidance,
    "read-a-report": check_report,
    "recorded-table": check_tutorial,
    "rendered-cameras": check_rendered,
    "reproduce-the-paper": check_paper,
    "robot-class": check_robot,
    "run-file": check_run_file,
    "teach-a-goal": check_teach,
}
# Figures that pages name; README draws all.
NAMED = {"python": ("fig21_runs",), "read-a-report": ("fig01_partition",)}
NEEDS = {"run-file": ("xarray", "h5netcdf"), "benchmark-a-law": ("xarray",), "read-a-report": ("plotly",)}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.volume] if name in DRIVING else []) for name in PAGES]
)
def test_page(request, folder, name, capsys, monkeypatch):
    for module in NEEDS.get(name, ()):
        pytest.importorskip(module)
    if name == "rendered-cameras":
        require_gl()
    if name == "reproduce-the-paper":  # its command is that of README, and finds all up to date
        shutil.copytree(request.getfixturevalue("first_chain"), folder / "results" / "paper")
    monkeypatch.setattr(os, "cpu_count", lambda: 1)  # other processes would import all anew
    monkeypatch.setattr(film, "_FRAMES", 6)
    draw_only(monkeypatch, *NAMED.get(name, ("fig13_calibration", "fig18_metric")))
    for put in HAS.get(name, ()):
        put(folder)

    def read():
        return capsys.readouterr().out

    names = run_page(PAGES[name], read)
    CHECK.get(name, lambda *_: None)(folder, names, read)


def test_pages_that_have_rules_of_their_own_are_there():
    assert {*DRIVING, *NOT_RUN, *HAS, *CHECK, *NEEDS} <= set(PAGES)


@pytest.mark.parametrize("name", PAGES)
def test_every_block_is_run_or_excused(name):
    blocks = [block for block in blocks_of(PAGES[name]) if not block.language.startswith("{")]
    assert {block.language for block in blocks} <= LANGUAGES
    assert sum(1 for block in blocks if block.excuse) == NOT_RUN.get(name, 0)
    assert all(block.excuse or block.file for block in blocks if block.language == "yaml")


def test_tasks_in_python_are_short():
    blocks = [block for block in blocks_of(PAGES["python"]) if block.language == "python"]
    assert max(len(block.text.splitlines()) for block in blocks) <= 15


def test_messages_of_the_troubleshooting_page_stand_in_the_sources():
    """The middle column quotes messages, in pieces between the numbers and names."""
    sources = " ".join(
        path.read_text(encoding="utf-8") for path in sorted((ROOT / "projservo_cli").rglob("*.py"))
    )
    joined = re.sub(r'["\']\s*(?:\+ )?f?["\']', "", sources)
    rows = " ".join(f"{row.sentence}{by} {row.remedy}" for row in ROWS.values() for by in ":;")
    joined += rows + re.sub(r"\{\w+\}", "… px", rows)
    rows = [line.split("|") for line in PAGES["troubleshoot"].read_text(encoding="utf-8").splitlines()]
    said = [piece for row in rows if len(row) == 5 for piece in re.findall(r"`([^`]*)`", row[2])]
    pieces = [part.strip() for piece in said for part in piece.split("…") if part.strip()]
    assert len(pieces) > 20
    assert [piece for piece in pieces if piece not in joined and piece != "overruns"] == []
