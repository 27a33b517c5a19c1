"""ViSP as a law: a process of ViSP computes the joint velocities of a robot that projservo simulates.

``eye_to_hand.cpp`` beside this file is the process. It is given what projservo does without: intrinsics, the
cameras in the base frame, the kinematics of the arm, and the face in metres. Robot, noise, limits, stops and
verdicts are those of every other law.
"""

import shutil
import subprocess
from functools import partial
from itertools import product
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from projservo_cli.geometry.kinematics import joint_operators
from projservo_cli.simulation.arm import SerialArm
from tests.conftest import ROOT
from tests.studies import hand_eye

SOURCE = Path(__file__).with_name("eye_to_hand.cpp")
PROGRAM = ROOT / "build" / "eye_to_hand"
LIBRARIES = ("-lvisp_core", "-lvisp_vision", "-lvisp_visual_features", "-lvisp_vs")
KINDS = ("ibvs", "pbvs")
VIEWS = {(0, 1): "two cameras", (0,): "one camera"}
# Start of the calibration of intrinsics: a focal length of so many image widths.
FOCAL_WIDTHS = 1.5
# Points of a frame that it takes: a pose of known intrinsics needs three, one of unknown ones six.
LEAST_POINTS = 6
FIXED = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_ZERO_TANGENT_DIST
FIXED |= cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3


class Cell(NamedTuple):
    """Arm, cameras and face as ViSP is given them."""

    arm: SerialArm
    K: np.ndarray  # (V, 3, 3) intrinsics, px
    base: np.ndarray  # (V, 4, 4) base frame in the frames of the cameras
    face: np.ndarray  # (k, 3) points of the face in a frame of its own amid them, m


def true_cell(truth):
    """Return the cell as it is."""
    K = np.array([hand_eye.intrinsics(P) for P in truth.P])
    base = np.tile(np.eye(4), (len(K), 1, 1))
    for T, own, P in zip(base, K, truth.P, strict=True):
        T[:3] = np.linalg.solve(own, P)
        T[:3] /= np.cbrt(np.linalg.det(T[:3, :3]))
    return Cell(truth.robot, K, base, face_of(truth))


def calibrated_cell(truth, seen):
    """Return the cell by OpenCV's calibration, of intrinsics and hand–eye transformation, from images."""
    points = np.linalg.solve(truth.robot.base_tool, truth.M.T).T[:, :3]
    still = np.ones(len(seen.q), dtype=bool) if seen.moving is None else seen.moving == 0
    hands, images = np.array([truth.robot.pose(q) for q in seen.q[still]]), seen.images[still]
    views = []
    for v, size in enumerate(truth.image_size):
        K = intrinsics(points, images[:, v], size)
        views.append(hand_eye.calibrated(K @ np.eye(3, 4), points, hands, images[:, v]))
    K, base = (np.array([getattr(view, name) for view in views]) for name in ("K", "base"))
    return Cell(truth.robot, K, base, face_of(truth))


def intrinsics(points, images, size):
    """Intrinsics (3, 3) of a camera from pixels (f, m, 2) of the points (m, 3) of the tool, m."""
    shown = [np.isfinite(s).all(axis=1) for s in images]
    frames = [(points[on], s[on]) for on, s in zip(shown, images, strict=True) if on.sum() >= LEAST_POINTS]
    known, pixels = ([np.float32(frame[i]) for frame in frames] for i in range(2))
    width, height = (int(x) for x in size)
    focal = FOCAL_WIDTHS * width
    guess = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return cv2.calibrateCamera(known, pixels, (width, height), guess, np.zeros(5), flags=FIXED)[1]


def face_of(truth):
    """Points (k, 3) of the face in a frame amid them whose z axis is normal to it, m."""
    X = truth.M_face[:, :3] - truth.M_face[:, :3].mean(axis=0)
    x, z = X[1] - X[0], np.cross(X[1] - X[0], X[2] - X[0])
    axes = np.array([x, np.cross(z, x), z])
    return X @ (axes / np.linalg.norm(axes, axis=1)[:, None]).T


def missing():
    """Return what is missing to run ViSP; empty where nothing is."""
    for tool in ("g++", "pkg-config"):
        if shutil.which(tool) is None:
            return f"no {tool}"
    found = subprocess.run(["pkg-config", "--exists", "visp"], check=False).returncode == 0
    return "" if found else "no libvisp-dev"


def require():
    """End the program where ViSP cannot be run, with what mends it."""
    if what := missing():
        raise SystemExit(f"ViSP cannot be run, {what}: apt install g++ pkg-config libvisp-dev")


class Program:
    """The process of ViSP, compiled where its source is newer; a context manager."""

    def __init__(self):
        if not PROGRAM.exists() or PROGRAM.stat().st_mtime < SOURCE.stat().st_mtime:
            PROGRAM.parent.mkdir(exist_ok=True)
            flags = subprocess.check_output(["pkg-config", "--cflags", "visp"], text=True).split()
            subprocess.check_call(["g++", "-O2", *flags, str(SOURCE), "-o", str(PROGRAM), *LIBRARIES])
        pipe = subprocess.PIPE
        self.process = subprocess.Popen([PROGRAM], stdin=pipe, stdout=pipe, text=True)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def close(self):
        """End the process."""
        self.process.communicate()  # closes both ends and waits

    def ask(self, *values):
        """Return the words of the answer to words and arrays of numbers."""
        words = [x if isinstance(x, str) else " ".join(map(repr, np.ravel(x).tolist())) for x in values]
        self.process.stdin.write(" ".join(words) + "\n")
        self.process.stdin.flush()
        answer = self.process.stdout.readline().split()
        if not answer:
            raise RuntimeError("eye_to_hand ended")
        return answer

    def law(self, kind, cell, views, tolerance_px):
        """Return the factory of a law of ViSP.

        kind : ibvs or pbvs; views : indices of its cameras; tolerance_px : of the image error.
        """
        return partial(Visp, self, kind, cell, views, tolerance_px)

    def laws(self, cells, tolerance_px):
        """Yield name and factory of each law of ViSP, by both cameras and by the left one.

        cells : by what is told of them; tolerance_px : of the image error.
        """
        for (views, told), (known, cell), kind in product(VIEWS.items(), cells.items(), KINDS):
            yield f"ViSP {kind.upper()}, {known}, {told}", self.law(kind, cell, views, tolerance_px)


class Visp:
    """A law of ViSP; it has converged where the image error in its own cameras is within the tolerance."""

    def __init__(self, program, kind, cell, views, tolerance_px, setup):
        self.program, self.arm, self.views, self.tolerance = program, cell.arm, list(views), tolerance_px
        self.model, self.s_star = cell.arm.model(np.zeros((1, 3, 4))), setup.s_star[self.views]
        cameras = [
            np.concatenate([K[[0, 1, 0, 1], [0, 1, 2, 2]], base.ravel(), goal.ravel()])
            for K, base, goal in zip(cell.K[self.views], cell.base[self.views], self.s_star, strict=True)
        ]
        sizes = [setup.gains.gain, len(cell.arm.q_reference), len(cell.face), len(self.views)]
        program.ask("set", kind, sizes, cell.face, cameras)

    def __call__(self, s, q):
        pose = self.arm.pose(q)
        body = np.linalg.inv(pose) @ joint_operators(self.model, q) @ pose  # (n, 4, 4) twists in the hand
        J = np.stack([*body[:, :3, 3].T, body[:, 2, 1], body[:, 0, 2], body[:, 1, 0]])
        answer = self.program.ask("move", pose, J, s[self.views])
        return None if answer == ["lost"] else np.array(answer, dtype=float)

    def error(self, s, q):
        """Image error in its cameras, px rms per marker and view."""
        return float(np.sqrt(np.square(s[self.views] - self.s_star).sum(axis=2).mean()))
