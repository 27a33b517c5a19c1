"""Cameras on the hand, simulated by OpenCV: the hand-eye transformation beside its bound and its rival.

    python -m tests.studies.hand_eye_coverage [--draws 500] [--rigs NAME ...] [-o hand_eye_coverage.csv]

A UR5 by its Denavit–Hartenberg table carries cameras before six tags of 60 mm on a table and on a box. Images
are by ``cv2.projectPoints``, with 0.5 px of noise. Each draw calibrates from scratch, from the same 40 poses.
The side of the tags gives the scale. Prints how often the 95 % region holds the true transformation, in the
flange frame of the axes and in that of the true model; the rms over the bound of Cramér and Rao; and errors
beside those of OpenCV's hand-eye calibration, which is given true intrinsics, points and arm.
"""

from functools import cache
from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

import projservo_cli as projservo
from projservo_cli.metric.nominal_comparison import in_model_frames
from projservo_cli.observations import Observations
from projservo_cli.records import Observation, WorkFailed
from projservo_cli.store.observation_tables import write_table
from tests.calibration.bound import derivative, spread
from tests.calibration.simulated_robot import NAMES, Robot
from tests.samples import revolute
from tests.studies import hand_eye
from tests.studies.common import in_two_processes, parser_of, rate, write_rows
from tests.studies.metric_coverage import held, off

SEED, NOISE_PX, POSES, SIZE = 503, 0.5, 40, (1280, 1024)
SHOWN = 10_000  # draw of the recording that tests and pages take
# Standard Denavit–Hartenberg parameters of the UR5 by its maker: a, d, m; alpha, rad.
DH = np.array(
    [
        [0.0, 0.089159, np.pi / 2],
        [-0.425, 0.0, 0.0],
        [-0.39225, 0.0, 0.0],
        [0.0, 0.10915, np.pi / 2],
        [0.0, 0.09465, -np.pi / 2],
        [0.0, 0.0823, 0.0],
    ]
)
START = np.radians([0.0, -93.0, 75.0, -72.0, -90.0, 90.0])
TAG = 0.06  # m, the side of a tag
# Centres of the tags in the frame of the scene, m, and how each is turned, rad.
TAGS = (
    ((-0.13, -0.10, 0.0), (0.0, 0.0, 0.1)),
    ((0.14, -0.09, 0.0), (0.0, 0.0, -0.2)),
    ((-0.12, 0.11, 0.0), (0.0, 0.0, 0.4)),
    ((0.13, 0.10, 0.0), (0.0, 0.0, 0.8)),
    ((-0.03, 0.0, 0.07), (0.6, 0.1, 0.0)),
    ((0.05, 0.02, 0.10), (-0.3, 0.5, 0.2)),
)
SCENE = np.array([-0.45, -0.1, 0.05])  # in the base frame, m
# Farthest readings from the start, rad; markers that each camera of the pair sees, and their distance, m.
REACH, LEAST, NEAREST = np.radians([40.0, 40.0, 40.0, 40.0, 40.0, 70.0]), 14, 0.25


class Eye(NamedTuple):
    """A camera in the flange."""

    K: np.ndarray  # (3, 3) px
    X: np.ndarray  # (4, 4) pose in the flange, m


def pose(turn, t):
    """Pose (4, 4) by a rotation vector, rad, and a shift, m."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), t
    return T


def eye(f, center, turn, t):
    """A camera by focal length and principal point, px, and its pose."""
    return Eye(np.array([[f, 0.0, center[0]], [0.0, 1.01 * f, center[1]], [0.0, 0.0, 1.0]]), pose(turn, t))


LEFT = eye(1180.0, (652.0, 498.0), (0.03, 0.08, -0.02), (-0.05, 0.06, 0.04))
RIGHT = eye(1230.0, (630.0, 520.0), (0.01, -0.07, 0.03), (0.05, 0.062, 0.041))
RIGS = {"pair": (LEFT, RIGHT), "one": (LEFT,)}


def link(row, angle):
    """Transformation (4, 4) of one row of the table."""
    a, d, alpha = row
    c, s, ca, sa = np.cos(angle), np.sin(angle), np.cos(alpha), np.sin(alpha)
    return np.array(
        [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0.0, sa, ca, d], [0.0, 0.0, 0.0, 1.0]]
    )


def flange(q):
    """Pose (4, 4) of the flange in the base."""
    T = np.eye(4)
    for row, angle in zip(DH, q, strict=True):
        T = T @ link(row, angle)
    return T


def twists(q):
    """Twists (6, 4, 4) of the joints at readings."""
    T, found = np.eye(4), []
    for row, angle in zip(DH, q, strict=True):
        found.append(revolute(T[:3, 3], T[:3, 2]))
        T = T @ link(row, angle)
    return np.array(found)


def screws(q):
    """Screws (6, 6) of the joints at readings: w, v."""
    T = twists(q)
    return np.c_[T[:, 2, 1], T[:, 0, 2], T[:, 1, 0], T[:, :3, 3]]


def points():
    """Corners (24, 3) of all tags in the base frame, m, in the order of ArUco."""
    square = TAG / 2.0 * np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])
    return np.concatenate([square @ pose(turn, t)[:3, :3].T + np.add(SCENE, t) for t, turn in TAGS])


@cache
def readings():
    """Readings (POSES, 6) about the start at which both cameras of the pair see most of the scene."""
    rng, found = np.random.default_rng([SEED, 0]), []
    while len(found) < POSES:
        q = START + REACH * rng.uniform(-1.0, 1.0, 6)
        if np.isfinite(images(RIGS["pair"], q[None])[..., 0]).sum(axis=2).min() >= LEAST:
            found.append(q)
    return np.array(found)


def images(eyes, q):
    """Pixels (K, V, m, 2) by OpenCV, NaN outside the image and too near."""
    seen, X = np.empty((len(q), len(eyes), 4 * len(TAGS), 2)), points()
    for k, row in enumerate(q):
        for v, one in enumerate(eyes):
            T = np.linalg.inv(flange(row) @ one.X)
            seen[k, v] = cv2.projectPoints(X, cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], one.K, None)[0][:, 0]
            seen[k, v, X @ T[2, :3] + T[2, 3] < NEAREST] = np.nan
    inside = (seen >= 0.0) & (seen <= np.array(SIZE) - 1.0)
    return np.where(inside.all(axis=-1, keepdims=True), seen, np.nan)


def observed(eyes, q, draw):
    """The recording of a draw."""
    exact = images(eyes, q)
    noisy = exact + NOISE_PX * np.random.default_rng([SEED, 1, draw]).standard_normal(exact.shape)
    return Observation(np.arange(len(q)), np.arange(4 * len(TAGS)), q, noisy, view=NAMES[: len(eyes)])


def write_recording(name, folder):
    """Write the table ``hand.csv`` of a rig and a model of the arm, ``ur5.urdf``, with its link tool0."""
    write_table(observed(RIGS[name], readings(), SHOWN), folder / "hand.csv")
    lines, before = ['<robot name="ur5"><link name="link_0"/>'], (0.0, 0.0, 0.0)
    for i, row in enumerate([*DH, None], 1):
        a, d, alpha = before
        child, kind = (f"link_{i}", "continuous") if row is not None else ("tool0", "fixed")
        lines.append(
            f'<link name="{child}"/><joint name="joint_{i}" type="{kind}"><parent link="link_{i - 1}"/>'
            f'<child link="{child}"/><origin xyz="{a} 0 {d}" rpy="{alpha} 0 0"/><axis xyz="0 0 1"/></joint>'
        )
        before = row
    (folder / "ur5.urdf").write_text("".join([*lines, "</robot>"]))


def in_own_flange(cameras, axes, X, reading):
    """Poses (V, 4, 4) of cameras (V, 3, 4) in the flange frame of axes (n, 6), with the tags' side for scale.

    All are in one frame of any scale, with the last joint at a reading, rad.
    """
    (w, v), (u, r) = (np.split(axis / np.linalg.norm(axis[:3]), 2) for axis in (axes[-1], axes[-2]))
    x, p, o = np.cross(w, u), np.cross(w, v), np.cross(u, r)
    # The point of the last axis nearest to the one before.
    at = p + w * (np.cross(o - p, u) @ x) / (x @ x)
    x = x / np.linalg.norm(x)
    T = np.eye(4)
    T[:3] = np.c_[x, np.cross(w, x), w, at]
    T = T @ pose((0.0, 0.0, reading), (0.0, 0.0, 0.0))
    sides = np.linalg.norm(X.reshape(-1, 4, 3) - np.roll(X.reshape(-1, 4, 3), -1, axis=1), axis=-1)
    found = []
    for P in cameras:
        C = np.eye(4)
        C[:3, :3] = (np.linalg.inv(hand_eye.intrinsics(P)) @ P)[:, :3]
        C[:3, :3] = (C[:3, :3] / np.cbrt(np.linalg.det(C[:3, :3]))).T
        C[:3, 3] = -np.linalg.solve(P[:, :3], P[:, 3])
        found.append(np.linalg.inv(T) @ C)
        found[-1][:3, 3] *= TAG / sides.mean()
    return np.array(found)


class Design(NamedTuple):
    """A rig with its poses, its truth, and the bound of the best estimator."""

    q: np.ndarray
    own: np.ndarray  # (V, 4, 4) true poses in the flange frame of the axes
    bound: np.ndarray  # (V, 6, 6) covariance of their errors, at the noise

    @classmethod
    def of(cls, name):
        """The design of a rig."""
        eyes, q = RIGS[name], readings()
        there = flange(q[0])
        P = np.array([one.K @ np.linalg.inv(there @ one.X)[:3] for one in eyes])
        X, T = points(), twists(q[0])
        # Seen from the hand: the arm in reverse, whose readings are negated.
        robot = Robot("R" * 6, T[::-1], P, np.c_[X, np.ones(len(X))], -q[0, ::-1])
        x = np.concatenate([P.ravel(), screws(q[0])[::-1].ravel(), X.ravel()])

        def own(x):
            cameras, axes, X = np.split(x, [P.size, P.size + 36])
            return in_own_flange(
                cameras.reshape(P.shape), axes.reshape(6, 6)[::-1], X.reshape(-1, 3), q[0, -1]
            )

        true, rows = own(x), []
        for k, size in enumerate(np.maximum(np.abs(x), 1e-2)):
            step = 1e-6 * size * (np.arange(len(x)) == k)
            rows.append((off(own(x + step), own(x - step)) / (2e-6 * size)).ravel())
        seen = np.isfinite(images(eyes, q)).ravel()
        factor = NOISE_PX * spread(derivative(robot, -q[:, ::-1])[seen], np.array(rows).T)
        factor = factor.reshape(len(P), 6, -1)
        return cls(q, true, factor @ factor.swapaxes(1, 2))


def by_opencv(eyes, q, pixels):
    """Errors (V, 6) of the hand-eye transformation of each of OpenCV's methods, by name."""
    hands, X, found = np.array([flange(row) for row in q]), points(), {name: [] for name in hand_eye.HAND}
    for v, one in enumerate(eyes):
        scene = np.array([hand_eye.seen_pose(one.K, X, s) for s in pixels[:, v]])
        for name, method in hand_eye.HAND.items():
            R, t = cv2.calibrateHandEye(
                hands[:, :3, :3], hands[:, :3, 3], scene[:, :3, :3], scene[:, :3, 3], method=method
            )
            found[name].append(pose(Rotation.from_matrix(R).as_rotvec(), np.ravel(t)))
    true = np.array([one.X for one in eyes])
    return {name: off(np.array(poses), true) for name, poses in found.items()}


def errors(name, rows):
    """Columns of errors (V, 6): rms over the cameras, mm and degrees."""
    mm, deg = (
        unit * np.sqrt((part**2).sum(axis=1).mean())
        for unit, part in zip((1e3, np.degrees(1.0)), (rows[:, 3:], rows[:, :3]), strict=True)
    )
    return {f"{name}_mm": mm, f"{name}_deg": deg}


def judged(job):
    """A row of the table: one draw of the noise of a rig."""
    name, draw, design = job
    eyes, row = RIGS[name], {"rig": name, "draw": draw, "reason": ""}
    seen = observed(eyes, design.q, draw)
    for method, wrong in by_opencv(eyes, design.q, seen.images).items():
        row |= errors(method, wrong)
    try:
        recording = Observations.of(seen, joint_types="RRRRRR", mount="tool", image_size=SIZE)
        metric = projservo.calibrate(recording, progress=False).metric(TAG, "tags")
        there = in_model_frames(metric, screws(np.zeros(6)), flange(np.zeros(6)))
    except WorkFailed as error:
        return row | {"reason": str(error)}
    wrong, of_model = off(metric.poses, design.own), off(there.poses, np.array([one.X for one in eyes]))
    # Over the bound, one on average.
    square = np.einsum("vi,vij,vj->v", wrong, np.linalg.inv(design.bound), wrong)
    row |= {"over_bound": square.mean() / 6.0} | errors("own", wrong) | errors("projservo", of_model)
    for v, view in enumerate(metric.view):
        row[f"{view}_own"] = held(wrong, metric.covariance("poses"))[v]
        row[f"{view}_model"] = held(of_model, there.covariance("poses"))[v]
    return row


def main():
    """Judge all draws, print what they show, and write the table."""
    parser = parser_of("hand_eye_coverage", __doc__, [("draws", 500, "of the noise, of each rig")], rigs=RIGS)
    asked = parser.parse_args()
    designs = {name: Design.of(name) for name in asked.rigs}
    jobs = [(name, draw, designs[name]) for name in asked.rigs for draw in range(asked.draws)]
    rows = list(in_two_processes(judged, jobs, "hand-eye"))
    write_rows(asked.output, rows)
    for name in asked.rigs:
        some = [row for row in rows if row["rig"] == name]
        found = [row for row in some if "over_bound" in row]
        print(f"{name}: {len(found)} of {len(some)} draws calibrate")
        for key in (key for key in found[0] if key.endswith(("_own", "_model"))):
            print(f"  95 % region of {key}: held in {rate(sum(row[key] for row in found), len(found))} %")
        over = np.sqrt(np.mean([row["over_bound"] for row in found]))
        print(f"  rms over the bound (1): {over:.3f}")
        for by in ("own", "projservo", *hand_eye.HAND):
            parts = ([row[f"{by}_{unit}"] for row in found] for unit in ("mm", "deg"))
            mm, deg = (np.sqrt(np.mean(np.square(part))) for part in parts)
            print(f"  {by:10}: rms {mm:.3f} mm, {deg:.4f} deg")


if __name__ == "__main__":
    main()
