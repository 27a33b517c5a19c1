"""Whether a stated error holds where arm or rig are not as the model says, and whether the cause is named.

    python -m tests.studies.model_errors [--faults NAME ...] [--arms ...] [--sizes ...] [--seeds N]
        [--sound N] [--jobs 2] [--output FILE.csv]

Tables are simulated here, with nothing of the package. A fault of size s alone makes the least-squares fit of
the model err by s times the error that a calibration of the same arm without faults states: rms over random
poses within the ranges of the joints, as the arm and the rig are at the end of the recording, without what
changes at random from pose to pose (joint noise, backlash). ``--amplitudes`` remakes these amplitudes,
model_errors.csv. The true error of a run is that of its predictions at such poses. ``--sound`` adds tables
without faults, with corners of the six kinds of ``tests.studies.monitoring``; ``--seeds 0`` leaves faults out.
"""

import argparse
import csv
import os
import sys
import time
import warnings
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from functools import lru_cache, partial
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import numpy as np
from tqdm import tqdm

import projservo_cli as projservo
from projservo_cli.calibration import predict, prediction_variance
from tests.monitoring.corners import CornerMap
from tests.monitoring.stand_in import KINDS
from tests.studies.planning_tables import quantiles, rate

AMPLITUDES = Path(__file__).with_suffix(".csv")
SEED, NOISE_PX = 47, 0.3
IMAGE, ASPECT, SKEW = (1280, 960), 1.002, 0.001  # of both cameras
MIDDLE = np.array([[655.0, 470.0], [628.0, 487.0]])  # principal points, px
BARREL = -0.3  # k1 of rigs that are calibrated with a lens
COMBINED, FRAMES, RANDOM, HELD_OUT = 12, 7, 56, 100  # poses; frames of each joint
REACH_M = 0.3  # m of a prismatic joint for a rad
SIZES, SEEDS, REALISATIONS = (0.3, 1.0, 3.0, 10.0), 10, 5
BEHIND_PX = 1e4  # error of a point that is predicted behind a camera
MOST_TILT = np.radians(66.0)  # at which a tag is found
# Noncentrality and share of a fault's images that a named cause may leave, if images cannot tell them apart.
TELLS, LEAVES = 9.0, 0.5
TAGS = np.radians([-35.0, 0.0, 35.0])  # tilts of three tags side by side
SQUARE = 0.5 * np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])


class Arm(NamedTuple):
    """Axes and a tool where all joints are zero, the arm stretched out along x; a rig; where it is recorded."""

    types: str
    axes: np.ndarray  # (n, 3) directions
    at: np.ndarray  # (n, 3) points on them, m
    tip: np.ndarray  # (3,) m
    home: np.ndarray  # (n,) rad or m
    reach: np.ndarray  # (n,) of trials to both sides, rad or m
    joints: tuple[int, int, int]  # shoulder, elbow, wrist: those that have faults
    design: str  # trials, singles or random
    focal: float  # px
    cameras: np.ndarray  # (2, 3, 4) to normalised coordinates
    markers: np.ndarray  # (12, 3) at zero, m
    k: np.ndarray = np.zeros((2, 2))  # noqa: RUF012  radial lens


def turned(v):
    """Rotations (..., 3, 3) by rotation vectors (..., 3), rad."""
    v = np.asarray(v, dtype=float)
    angle = np.linalg.norm(v, axis=-1)[..., None, None]
    W = np.zeros((*v.shape, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        W[..., i, j], W[..., j, i] = -v[..., k], v[..., k]
    return np.eye(3) + np.sinc(angle / np.pi) * W + 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2 * W @ W


def moved(X, motion, about=0.0):
    """Points X (..., k, 3) after motions (..., 6), a rotation vector about a point, then a shift."""
    return (X - about) @ np.swapaxes(turned(motion[..., :3]), -1, -2) + about + motion[..., None, 3:]


def chain(arm, q):
    """Rotations (K, 3, 3) and shifts (K, 3) of what each joint, and at last the tool, is carried by."""
    R, t = np.broadcast_to(np.eye(3), (len(q), 3, 3)), np.zeros((len(q), 3))
    yield R, t
    for kind, axis, at, angle in zip(arm.types, arm.axes, arm.at, q.T, strict=True):
        if kind == "P":
            t = t + np.einsum("kij,kj->ki", R, angle[:, None] * axis)
        else:
            turn = turned(angle[:, None] * axis / np.linalg.norm(axis))
            t = t + np.einsum("kij,kj->ki", R, at - turn @ at)
            R = R @ turn
        yield R, t


def arm_of(types, letters, at, tip, home_deg, reach_deg, joints, design, focal, tag_m, views):
    """An arm that carries three tags which look at its cameras at home; views (2, 4): place and roll."""
    axes, slides = np.array([np.eye(3)["xyz".index(a)] for a in letters]), np.array(list(types)) == "P"
    q, reach = (np.where(slides, one, np.radians(one)) for one in (home_deg, reach_deg))
    arm = Arm(
        types, axes, np.array(at, dtype=float), np.array(tip), q, reach, joints, design, focal, *[None] * 2
    )
    (*_, (R, t)) = chain(arm, q[None])
    there, rows = R[0] @ arm.tip + t[0], []
    for x, y, z, roll in views:
        ahead = -np.array([x, y, z]) / np.linalg.norm([x, y, z])
        side = np.cross(ahead, [0.0, 0.0, 1.0]) / np.linalg.norm(np.cross(ahead, [0.0, 0.0, 1.0]))
        Q = turned([0.0, 0.0, roll]) @ [side, np.cross(ahead, side), ahead]
        rows.append(np.hstack([Q, -Q @ (there + np.array([[x], [y], [z]])[:, 0])[:, None]]))
    z = np.mean(views, axis=0)[:3] / np.linalg.norm(np.mean(views, axis=0)[:3])
    x = np.cross([0.0, 0.0, 1.0], z) / np.linalg.norm(np.cross([0.0, 0.0, 1.0], z))
    face = np.stack([x, np.cross(z, x), z], axis=1)
    tags = [
        there
        + face @ (tag_m * np.array([1.2 * np.sin(a), 0.0, np.cos(a) - 1.0]))
        + tag_m * SQUARE @ (face @ turned([0.0, a, 0.0])).T
        for a in 1.0 * TAGS
    ]
    return arm._replace(cameras=np.array(rows), markers=(np.concatenate(tags) - t[0]) @ R[0])


ARMS = {
    # Six joints, the last three through one point; 0.9 m.
    "six": arm_of(
        "RRRRRR",
        "zyyxyx",
        [[0, 0, 0], [0.06, 0, 0.36], [0.42, 0, 0.36], [0.42, 0, 0.36], [0.8, 0, 0.36], [0.8, 0, 0.36]],
        [0.92, 0.0, 0.36],
        [8, -52, 75, 12, -38, 15],
        [28, 22, 24, 28, 28, 30],
        (2, 3, 5),
        "trials",
        1050.0,
        0.055,
        [[1.15, -0.35, 0.2, 0.06], [1.1, 0.4, 0.3, -0.04]],
    ),
    # Five joints of a hobbyist's arm, three of them parallel; 0.4 m.
    "hobby": arm_of(
        "RRRRR",
        "zyyyx",
        [[0, 0, 0], [0.02, 0, 0.08], [0.14, 0, 0.08], [0.27, 0, 0.08], [0.31, 0, 0.08]],
        [0.38, 0.0, 0.08],
        [-5, -55, 70, -20, 10],
        [30, 22, 25, 30, 30],
        (2, 3, 4),
        "random",
        930.0,
        0.02,
        [[0.47, -0.15, 0.06, 0.08], [0.45, 0.17, 0.11, -0.05]],
    ),
    # A slide behind two joints, and a wrist whose axes do not meet; 0.9 m.
    "slide": arm_of(
        "RRPRRR",
        "zyxxyz",
        [[0, 0, 0], [0, 0.1, 0.4], [0, 0, 0], [0.5, 0.1, 0.4], [0.62, 0.1, 0.46], [0.7, 0.14, 0.46]],
        [0.78, 0.14, 0.46],
        [-6, -15, 0.05, 10, 20, -12],
        [25, 22, 0.12, 30, 28, 28],
        (1, 2, 5),
        "trials",
        1000.0,
        0.05,
        [[1.0, -0.3, 0.27, -0.05], [1.05, 0.36, 0.2, 0.07]],
    ),
}


class World:
    """An arm and its rig at poses, with what is not as the model says."""

    def __init__(self, arm, q, order, held=False):
        self.arm, self.q, self.t, self.held = arm, q, order, held  # order from 0 to 1
        K, m = len(q), len(arm.markers)
        self.theta, self.base, self.views = q.copy(), np.zeros((K, 6)), np.zeros((K, 2, 6))
        self.slip, self.slipping = np.zeros((K, 6)), np.ones(m, dtype=bool)
        self.k = arm.k.copy()
        self.center, self.focus, self.tangential = np.zeros((2, 2)), np.zeros(2), np.zeros((2, 2))

    def turn(self, joint, by):
        """Turn a joint, from 1, by (K,) rad more than it reads, or slide it."""
        self.theta[:, joint - 1] += by * (REACH_M if self.arm.types[joint - 1] == "P" else 1.0)

    def read(self, joint):
        """Reading (K,) of a joint as an angle, rad."""
        return self.q[:, joint - 1] / (REACH_M if self.arm.types[joint - 1] == "P" else 1.0)

    def revolute(self):
        return [i + 1 for i, kind in enumerate(self.arm.types) if kind == "R"]

    def load(self, joint):
        """Torque (K,) of weights at the outer joints and the tip about a joint, over the farthest possible."""
        frames, axis = list(chain(self.arm, self.q)), self.arm.axes[joint - 1]
        here, outer = (
            frames[joint - 1],
            [*zip(frames[joint:-1], self.arm.at[joint:]), (frames[-1], self.arm.tip)],
        )
        place = [np.einsum("kij,j->ki", R, at) + t for (R, t), at in [(here, self.arm.at[joint - 1]), *outer]]
        lever = np.mean(place[1:], axis=0) - place[0]
        torque = np.cross(np.einsum("kij,j->ki", here[0], axis), lever)[:, 2]
        return torque / np.linalg.norm(self.arm.tip - self.arm.at[1])

    def images(self):
        """Pixels (K, 2, m, 2)."""
        arm = self.arm
        (*_, (R, t)) = chain(arm, self.theta)
        X = np.broadcast_to(arm.markers, (len(self.q), *arm.markers.shape))
        X = np.where(self.slipping[:, None], moved(X, self.slip, arm.markers.mean(axis=0)), X)
        X = moved(X @ R.swapaxes(1, 2) + t[:, None], self.base)
        result = np.empty((len(self.q), 2, len(arm.markers), 2))
        for v, P in enumerate(arm.cameras):
            Y = moved(X @ P[:, :3].T + P[:, 3], self.views[:, v])
            near = float(np.linalg.norm(arm.cameras[v] @ [*np.mean(arm.markers, axis=0), 1.0]))
            x = Y[..., :2] / Y[..., 2:] * (1.0 + self.focus[v] * (Y[..., 2:] / near - 1.0))
            x = x - self.center[v] / arm.focal
            r2, p = (x**2).sum(axis=-1, keepdims=True), self.tangential[v]
            bent = x * (1.0 + self.k[v, 0] * r2 + self.k[v, 1] * r2**2)
            x = bent + 2.0 * (x @ p)[..., None] * x + r2 * p + self.center[v] / arm.focal
            u = arm.focal * (x[..., 0] + SKEW * x[..., 1]) + MIDDLE[v, 0]
            result[:, v] = np.stack([u, ASPECT * arm.focal * x[..., 1] + MIDDLE[v, 1]], axis=-1)
        return result


def motion(rng, turn, shift):
    """A motion (6,) about random axes: rad, m."""
    a, b = rng.standard_normal((2, 3))
    return np.concatenate([turn * a / np.linalg.norm(a), shift * b / np.linalg.norm(b)])


def of_camera(w, rng, px):
    """A motion (6,) of a camera that moves images by about so many px."""
    near = np.linalg.norm(w.arm.cameras[0] @ [*w.arm.markers.mean(axis=0), 1.0])
    return motion(rng, px / w.arm.focal, 0.7 * near * px / w.arm.focal)


def ramp(t):
    return t


def saturates(t):
    return -np.expm1(-5.0 * t)


def steps(t, at=0.5):
    return (t >= at) * 1.0


def late(t):
    return steps(t, 0.8)


def settles(t):
    return np.exp(-t / 0.05)


# Functions of a world, an amplitude and a generator that put a fault into the world.
def scale(w, a, rng, joints):
    for joint in joints:
        w.turn(joint, a * w.read(joint))


def curve(w, a, rng, joint, power):
    w.turn(joint, a * w.read(joint) ** power)


def harmonic(w, a, rng, joint, times):
    w.turn(joint, a * np.sin(times * w.read(joint) + rng.uniform(0.0, 2.0 * np.pi)))


def wave(w, a, rng, joint, phase):
    w.turn(joint, a * np.sin(w.read(joint) + phase))


def coupling(w, a, rng, joint, to):
    w.turn(to, a * w.read(joint))


def sag(w, a, rng, joints):
    for joint in joints:
        w.turn(joint, a * w.load(joint))


def zero(w, a, rng, joint, when):
    w.turn(joint, a * when(w.t))


def camera(w, a, rng, views, when):
    for v in views:
        w.views[:, v] += when(w.t)[:, None] * of_camera(w, rng, a)


def lens(w, a, rng, views):
    w.k[list(views), 0] += a


def lens_center(w, a, rng, views):
    for v in views:
        w.center[v] += a * np.array([np.cos(angle := rng.uniform(0.0, 2.0 * np.pi)), np.sin(angle)])


def focus(w, a, rng, views):
    w.focus[list(views)] += a


def base(w, a, rng, when):
    w.base += when(w.t)[:, None] * motion(rng, a / np.linalg.norm(w.arm.tip), a)


def tool(w, a, rng, when, tags=(0, 1, 2)):
    size = np.linalg.norm(np.ptp(w.arm.markers, axis=0))
    w.slip += when(w.t)[:, None] * motion(rng, a / size, 0.5 * a)
    w.slipping[:] = np.isin(np.arange(len(w.slipping)) // 4, tags)


def backlash(w, a, rng, joint):
    if not w.held:
        way, step = 1.0, np.sign(np.diff(w.read(joint), prepend=0.0))
        w.turn(joint, -0.5 * a * np.array([way := s or way for s in step]))


def joint_noise(w, a, rng):
    for joint in () if w.held else range(1, len(w.arm.types) + 1):
        w.turn(joint, a * rng.standard_normal(len(w.q)))


def decentred(w, a, rng, views):
    for v in views:
        w.tangential[v] += a * np.array([np.cos(angle := rng.uniform(0.0, 2.0 * np.pi)), np.sin(angle)])


def nudge(w, a, rng, part, index, when=None):
    getattr(w, part)[index] += a if when is None else a * when(w.t)


def faults_of(arm):
    """Faults by name: what puts one into a world, and causes that name it: kind, joints and view, None for any."""
    s, e, j = arm.joints
    every = tuple(i + 1 for i, kind in enumerate(arm.types) if kind == "R")
    anything = {("camera_drift", None, None), ("camera_step", None, None)}
    return {
        "gear": (partial(scale, joints=(e,)), {("scale", (e,), None)}),
        "gear all": (
            partial(scale, joints=every),
            {("scale", (i,), None) for i in every} | {("scale", every, None)},
        ),
        "gear wrist": (partial(scale, joints=(j,)), {("scale", (j,), None)}),
        "second order": (partial(curve, joint=s, power=2), {("quadratic", (s,), None)}),
        "third order": (partial(curve, joint=e, power=3), {("cubic", (e,), None)}),
        "eccentric": (partial(harmonic, joint=s, times=1.0), {("harmonic", (s,), None)}),
        # No kind is of two waves a turn: a curve of the joint is right.
        "two waves": (
            partial(harmonic, joint=e, times=2.0),
            {(kind, (e,), None) for kind in ("harmonic", "quadratic", "cubic")},
        ),
        "coupled wrist": (partial(coupling, joint=j - 1, to=j), {("coupling", (j - 1, j), None)}),
        "coupled arm": (partial(coupling, joint=s, to=s + 1), {("coupling", (s, s + 1), None)}),
        "sag": (partial(sag, joints=every), {("sag", None, None)}),
        "sag of one": (partial(sag, joints=(2,)), {("sag", None, None)}),
        "joint drifts": (partial(zero, joint=e, when=ramp), {("joint_drift", (e,), None)}),
        "joint warms up": (partial(zero, joint=s, when=saturates), {("joint_drift", (s,), None)}),
        "joint steps": (partial(zero, joint=e, when=steps), {("joint_step", (e,), None)}),
        "joint steps late": (partial(zero, joint=s, when=late), {("joint_step", (s,), None)}),
        "left drifts": (partial(camera, views=(0,), when=ramp), {("camera_drift", None, "left")}),
        "both drift": (partial(camera, views=(0, 1), when=ramp), {("camera_drift", None, None)}),
        "right steps": (partial(camera, views=(1,), when=steps), {("camera_step", None, "right")}),
        "lens": (partial(lens, views=(0, 1)), {("lens", None, None)}),
        "right lens": (partial(lens, views=(1,)), {("lens", None, "right")}),
        "lens centre": (partial(lens_center, views=(0, 1)), {("lens_center", None, None)}),
        "focus": (partial(focus, views=(0, 1)), {("focus", None, None)}),
        # A base that steps is both cameras that step alike.
        "base steps": (partial(base, when=steps), {("base", None, None), ("camera_step", None, None)}),
        "tool slips": (partial(tool, when=steps), {("tool", None, None)}),
        "tool creeps": (partial(tool, when=ramp), {("tool", None, None)}),
        "tag slips": (partial(tool, when=steps, tags=(1,)), {("tool", None, None)}),
        "left settles": (
            partial(camera, views=(0,), when=settles),
            {(k, None, "left") for k, *_ in anything},
        ),
        # No kind is of backlash: all that is said of the joint is right. Joint noise has no cause.
        "backlash": (partial(backlash, joint=e), {(None, (e,), None)}),
        "decentred lens": (
            partial(decentred, views=(0, 1)),
            {("lens", None, None), ("lens_center", None, None)},
        ),
        "joint noise": (joint_noise, set()),
    }


FAULTS = tuple(faults_of(ARMS["six"]))
WITH_LENS = ("lens centre",)  # calibrated with a lens, of cameras that have one


def alternatives(arm, kind, joints, view):
    """What a named cause may be: alternatives of directions together."""
    joints = joints or range(1, len(arm.types) + 1)
    views = [("left", "right").index(view)] if view in ("left", "right") else [0, 1]
    breaks = [partial(steps, at=at) for at in np.arange(0.1, 0.95, 0.05)]
    six, all_poses = range(6), slice(None)
    parts = {
        "scale": [[partial(scale, joints=(j,)) for j in joints]],
        "quadratic": [[partial(curve, joint=j, power=2) for j in joints]],
        "cubic": [[partial(curve, joint=j, power=3) for j in joints]],
        "harmonic": [[partial(wave, joint=j, phase=p) for j in joints for p in (0.0, np.pi / 2)]],
        "coupling": [[partial(coupling, joint=i, to=j) for i in joints for j in joints if i != j]],
        "sag": [[partial(sag, joints=(j,)) for j in joints]],
        "joint_drift": [[partial(zero, joint=j, when=ramp) for j in joints]],
        "joint_step": [[partial(zero, joint=j, when=when) for j in joints] for when in breaks],
        "lens": [[partial(nudge, part="k", index=(v, i)) for v in views for i in (0, 1)]],
        "lens_center": [[partial(nudge, part="center", index=(v, i)) for v in views for i in (0, 1)]],
        "focus": [[partial(nudge, part="focus", index=(v,)) for v in views]],
    }
    for name, part, whens in (
        ("camera_drift", "views", [ramp]),
        ("camera_step", "views", breaks),
        ("base", "base", [ramp, *breaks]),
        ("tool", "slip", [ramp, *breaks]),
    ):
        columns = [(v, i) for v in views for i in six] if part == "views" else [(i,) for i in six]
        parts[name] = [
            [partial(nudge, part=part, index=(all_poses, *column), when=when) for column in columns]
            for when in whens
        ]
    return parts.get(kind, [])


def seeded(arm, seed, *more):
    return np.random.default_rng([SEED, list(ARMS).index(arm), seed, *more])


def poses_of(arm, design, rng):
    """Readings (K, n) in the order of a recording."""
    eye, free = np.eye(len(arm.home)), lambda count: rng.uniform(-1.0, 1.0, (count, len(arm.home)))
    if design == "random":
        return arm.home + arm.reach * free(RANDOM)
    trials = [np.zeros((1, len(eye)))] + [
        share * eye[i : i + 1] for i in range(len(eye)) for share in np.linspace(-1, 1, FRAMES)
    ]
    return arm.home + arm.reach * np.concatenate([*trials, *([free(COMBINED)] if design == "trials" else [])])


class Setting:
    """An arm where it is recorded, and where it is judged; what its parameters do to the images."""

    def __init__(self, name, seed, *, lens=False, design=None):
        arm = ARMS[name]
        self.arm, self.name, self.seed = (
            arm._replace(k=np.array([[BARREL, 0.0]] * 2)) if lens else arm,
            name,
            seed,
        )
        self.lens = lens
        self.q = poses_of(self.arm, design or arm.design, seeded(name, seed))
        self.ahead = seeded(name, seed, 3).uniform(
            self.q.min(axis=0), self.q.max(axis=0), (HELD_OUT, len(arm.home))
        )
        self.sound = self.images()
        self.sound_ahead = self.images(held=True)

    def images(self, put=None, amplitude=0.0, fault=0, held=False, arm=None):
        """Pixels (K, 2, m, 2) with a fault, where it is recorded or at the end of the recording."""
        q = self.ahead if held else self.q
        w = World(arm or self.arm, q, np.ones(len(q)) if held else np.linspace(0.0, 1.0, len(q)), held)
        if put is not None:
            put(w, amplitude, seeded(self.name, self.seed, 4, fault))
        return w.images()

    @lru_cache(maxsize=None)  # noqa: B019  a setting is short-lived
    def derivative(self, held=False):
        """Derivative of all pixels in the images by the parameters of the model, ravelled."""
        columns, step = [], 1e-5
        for field in ("cameras", "axes", "at", "markers", *(("k",) if self.lens else ())):
            values = getattr(self.arm, field)
            for index in np.ndindex(values.shape):
                change = np.zeros(values.shape)
                change[index] = step
                ends = [
                    self.images(held=held, arm=self.arm._replace(**{field: values + s * change}))
                    for s in (1, -1)
                ]
                columns.append(
                    ((ends[0] - ends[1]) / (2.0 * step))[
                        inside(self.sound_ahead if held else self.sound)
                    ].ravel()
                )
        return np.stack(columns, axis=1)

    @lru_cache(maxsize=None)  # noqa: B019
    def range(self):
        """Orthonormal directions of the images that parameters reach, and their parameters."""
        U, s, Vt = np.linalg.svd(self.derivative(), full_matrices=False)
        kept = s > 1e-7 * s[0]
        return U[:, kept], Vt[kept].T / s[kept]

    def change(self, put, amplitude, fault=0, held=False):
        """How a fault changes all pixels in the images, ravelled."""
        sound = self.sound_ahead if held else self.sound
        return (self.images(put, amplitude, fault, held) - sound)[inside(sound)].ravel()

    def effect_px(self, put, amplitude, fault):
        """Error of the predictions of a least-squares fit to images with a fault, rms of marker and view, px."""
        U, to_params = self.range()
        shift = to_params @ (U.T @ self.change(put, amplitude, fault))
        error = self.derivative(held=True) @ shift - self.change(put, amplitude, fault, held=True)
        return float(np.sqrt(2.0 * np.mean(error**2)))

    def left_by(self, change, directions=()):
        """Noncentrality of a change of images that parameters and directions leave."""
        U = self.range()[0]
        rest = change - U @ (U.T @ change)
        if directions:
            N = np.stack([self.change(put, 1e-4) for put in directions], axis=1)
            N -= U @ (U.T @ N)
            N /= np.maximum(np.linalg.norm(N, axis=0), 1e-12)
            rest = rest - N @ np.linalg.lstsq(N, rest, rcond=1e-6)[0]
        return float(rest @ rest) / NOISE_PX**2

    def same_images(self, put, amplitude, fault, cause):
        """Whether images do not tell a fault from a named cause."""
        change = self.change(put, amplitude, fault)
        whole = self.left_by(change)
        left = min((self.left_by(change, some) for some in alternatives(self.arm, *cause)), default=np.inf)
        return left <= min(TELLS, LEAVES * whole)


def inside(pixels):
    """Whether points are in the images (K, 2, m)."""
    return ((pixels >= 0.0) & (pixels <= np.array(IMAGE) - 1.0)).all(axis=-1)


@lru_cache
def corner_map(finder):
    return CornerMap(finder)


def with_corners(setting, pixels, kind):
    """Pixels and stated deviations of a recording: of a white noise, or as a finder of tags errs."""
    rng = seeded(setting.name, setting.seed, 1)
    if kind == "white":
        pixels, sigma = pixels + NOISE_PX * rng.standard_normal(pixels.shape), None
    else:
        finder, stated = KINDS[kind]
        arm, pixels, sigma = setting.arm, pixels.copy(), np.full(pixels.shape[:3], np.nan)
        corners = arm.markers.reshape(3, 4, 3)
        x, y = corners[:, 1] - corners[:, 0], corners[:, 0] - corners[:, 3]
        tag = np.stack([x, y, np.cross(x, y)], axis=2)
        tag /= np.linalg.norm(tag, axis=1, keepdims=True)
        (*_, (R, t)) = chain(arm, setting.q)
        for k, v in np.ndindex(len(R), 2):
            P = arm.cameras[v]
            there = (corners.mean(axis=1) @ R[k].T + t[k]) @ P[:, :3].T + P[:, 3]
            turn, distance = P[:, :3] @ R[k] @ tag, np.linalg.norm(there, axis=1)
            side = arm.focal * np.linalg.norm(x, axis=1) / distance
            errors, deviation, fresh, share = corner_map(finder).at(
                turn, there, side, pixels[k, v].reshape(3, 4, 2), v
            )
            errors += fresh[..., None] * rng.standard_normal(errors.shape)
            tilt = np.arccos(-(turn[..., 2] * there).sum(axis=1) / distance)
            found = (tilt < MOST_TILT) & (share >= 0.5)
            pixels[k, v] += np.where(found[:, None, None], errors, np.nan).reshape(-1, 2)
            sigma[k, v] = ((stated or 1.0) * deviation).ravel()
        sigma = sigma if stated else None
    with np.errstate(invalid="ignore"):
        pixels[~inside(pixels)] = np.nan
    return pixels, sigma


class Job(NamedTuple):
    """A table."""

    fault: str
    arm: str
    design: str
    corners: str
    size: float
    seed: int
    amplitude: float


def judged(job):
    """A row: what came of the calibration of a table, against the truth."""
    warnings.simplefilter("ignore")
    setting = Setting(job.arm, job.seed, lens=job.fault in WITH_LENS, design=job.design)
    number = FAULTS.index(job.fault) if job.fault in FAULTS else -1
    put, right = faults_of(setting.arm).get(job.fault, (None, set()))
    put_in = put, job.amplitude, number + 1
    row = job._asdict() | {"effect_px": setting.effect_px(*put_in) if put else 0.0}
    pixels, sigma = with_corners(setting, setting.images(*put_in), job.corners)
    begun = time.process_time()
    try:
        seen = projservo.Observations.from_arrays(
            setting.q, pixels, joint_types=setting.arm.types, joint_unit="rad", image_size=IMAGE, sigma=sigma
        )
        found = projservo.calibrate(seen, lens=setting.lens, progress=False)
    except (projservo.InputError, projservo.WorkFailed) as refused:
        code = 2 if isinstance(refused, projservo.InputError) else 1
        return row | {"exit": code, "seconds": time.process_time() - begun, "reason": str(refused)}
    row |= {"exit": int(not found.usable), "seconds": time.process_time() - begun, "reason": found.reason}
    truth = setting.images(*put_in, held=True)[:, :, found.marker]
    visible = inside(truth)
    error = (predict(found, setting.ahead) - truth)[visible]
    z = np.abs(error) / np.sqrt(prediction_variance(found, setting.ahead)[visible])
    rms = float(np.sqrt(np.mean(np.nan_to_num((error**2).sum(axis=1), nan=BEHIND_PX**2))))
    stated, worst = found.predicted_rms_px or np.nan, getattr(found, "predicted_worst_px", None)
    row |= {
        "predicted_rms_px": stated,
        "predicted_p99_px": found.predicted_p99_px,
        "predicted_worst_px": worst,
    }
    row |= {"true_rms_px": rms, "ratio": rms / stated, "ratio_worst": rms / max(stated, worst or 0.0)}
    row |= {"within_68": np.mean(z < 1.0), "within_95": np.mean(z < 1.96)}
    causes = sorted(getattr(found, "model_errors", ()), key=lambda cause: -abs(cause.effect_px))
    row["named"] = "; ".join(
        f"{c.kind} {','.join(map(str, c.joints))} {c.view} {c.estimate:.3g}±{c.deviation:.2g} {c.effect_px:.3g} px"
        for c in causes
    )
    if not causes:
        return row | {"judged": ""}
    verdicts = []
    for cause in causes:
        what = cause.kind, tuple(cause.joints), cause.view
        if any(all(a is None or a == b for a, b in zip(one, what, strict=True)) for one in right):
            verdicts.append("right")
        else:
            same = put is not None and setting.same_images(*put_in, what)
            verdicts.append("equivalent" if same else "wrong")
    return row | {"judged": verdicts[0], "others_wrong": verdicts[1:].count("wrong")}


def amplitudes(arms=tuple(ARMS), names=FAULTS):
    """Rows of amplitudes (rad, m or px) of faults by size, and of the errors that sound tables state."""
    for name in arms:
        for lens in (False, True):
            settings = [Setting(name, seed, lens=lens) for seed in range(REALISATIONS)]
            stated = []
            for one in settings:
                pixels, _ = with_corners(one, one.sound.copy(), "white")
                seen = projservo.Observations.from_arrays(
                    one.q, pixels, joint_types=one.arm.types, joint_unit="rad", image_size=IMAGE
                )
                stated.append(projservo.calibrate(seen, lens=lens, progress=False).predicted_rms_px)
            wanted = float(np.sqrt(np.mean(np.square(stated))))
            for fault, (put, _) in faults_of(settings[0].arm).items():
                if (fault in WITH_LENS) != lens or fault not in names:
                    continue
                amplitude = 1e-3
                for size in SIZES:
                    for _ in range(3):
                        number = FAULTS.index(fault) + 1
                        effects = [one.effect_px(put, amplitude, number) for one in settings]
                        amplitude *= size * wanted / float(np.sqrt(np.mean(np.square(effects))))
                    yield {
                        "fault": fault,
                        "arm": name,
                        "size": size,
                        "stated_px": f"{wanted:.4f}",
                        "amplitude": f"{amplitude:.6g}",
                    }


def tables(faults, arms, sizes, seeds, sound, corners):
    """Jobs of a study."""
    with open(AMPLITUDES, encoding="utf-8", newline="") as file:
        known = {
            (r["fault"], r["arm"], float(r["size"])): float(r["amplitude"]) for r in csv.DictReader(file)
        }
    jobs = [
        Job(fault, arm, ARMS[arm].design, "white", size, seed, known[fault, arm, size])
        for seed in range(seeds)
        for fault in faults
        for arm in arms
        for size in sizes
    ]
    kinds = [
        (arm, design, kind) for kind in corners for design in ("trials", "random", "singles") for arm in arms
    ]
    return jobs + [Job("none", *kinds[i % len(kinds)], 0.0, 1000 + i, 0.0) for i in range(sound)]


def tell(rows):
    """Print the three bars of faults, each fault, and sound tables."""
    faulty, sound = ([r for r in rows if (r["fault"] != "none") == is_one] for is_one in (True, False))
    if faulty:
        accepted = [r for r in faulty if r["exit"] == 0]
        held = {key: sum(r["exit"] != 0 or r[key] <= 2.0 for r in faulty) for key in ("ratio", "ratio_worst")}
        print(f"{len(faulty)} runs, {len(accepted)} accepted")
        print(f"true <= 2 x stated, or exit code 1: {rate(held['ratio'], len(faulty))} %, bar 99 %")
        print(f"    with what it may be up to: {rate(held['ratio_worst'], len(faulty))} %")
        print(
            f"stated <= 3 x true: {rate(sum(r['ratio'] >= 1 / 3 for r in accepted), len(accepted))} %, bar 90 %"
        )
        named = [r for r in faulty if r["judged"]]
        count = Counter(r["judged"] for r in named)
        good = count["right"] + count["equivalent"]
        print(f"named right: {rate(good, len(named))} % of {len(named)}, bar 90 %; {dict(count)}; ", end="")
        print(f"with others that are wrong: {sum((r['others_wrong'] or 0) > 0 for r in named)}")
        print(
            f"{'fault':18}{'held %':>8}{'2x at 10':>10}{'exit 1':>8}{'ratio, median by size':>32}  named, right, equivalent, wrong"
        )
        for fault in dict.fromkeys(r["fault"] for r in faulty):
            some = [r for r in faulty if r["fault"] == fault]
            share = 100.0 * np.mean([r["exit"] != 0 or r["ratio"] <= 2.0 for r in some])
            ends = [r for r in some if r["size"] == max(SIZES)]
            at_end = 100.0 * np.mean([r["exit"] != 0 or r["ratio"] <= 2.0 for r in ends]) if ends else np.nan
            medians = [
                np.nanmedian([np.nan, *(r["ratio"] for r in some if r["size"] == size)])
                if any(r["size"] == size and np.isfinite(r["ratio"]) for r in some)
                else np.nan
                for size in SIZES
            ]
            count = Counter(r["judged"] for r in some)
            print(
                f"{fault:18}{share:8.1f}{at_end:10.1f}{sum(r['exit'] != 0 for r in some):8d}"
                f"{' '.join(f'{m:7.2f}' for m in medians):>32}  {len(some) - count['']}, {count['right']}, {count['equivalent']}, {count['wrong']}"
            )
    for kind in dict.fromkeys(r["corners"] for r in sound):
        tell_sound(kind, [r for r in sound if r["corners"] == kind])
    if sound:
        tell_sound("all", sound)
    seconds = [r["seconds"] for r in rows]
    print(f"seconds of the processor for a calibration: {quantiles(seconds)}")


def tell_sound(kind, rows):
    """Print a line on sound tables."""
    usable = [r for r in rows if r["exit"] == 0]
    within = [100.0 * np.mean([r[key] for r in usable]) for key in ("within_68", "within_95")]
    refused = Counter((r["arm"], r["design"], r["reason"][:160]) for r in rows if r["exit"] != 0)
    print(
        f"sound, {kind}: refused {len(rows) - len(usable)} of {len(rows)}; covered {within[0]:.1f} and {within[1]:.1f} % "
        f"(bars 68 +- 3, 95 +- 2); named {sum(bool(r['judged']) for r in rows)}; "
        f"true over stated {quantiles([r['ratio'] for r in usable])}"
    )
    if kind != "all":
        for why, count in refused.items():
            print(f"    {count} refused: {why}")


COLUMNS = (
    *Job._fields,
    *(
        "effect_px",
        "exit",
        "seconds",
        "predicted_rms_px",
        "predicted_p99_px",
        "predicted_worst_px",
        "true_rms_px",
    ),
    *("ratio", "ratio_worst", "within_68", "within_95", "judged", "others_wrong", "named", "reason"),
)


def main():
    """Calibrate the tables of the study and print a summary."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--faults", nargs="+", choices=FAULTS, default=FAULTS)
    parser.add_argument("--arms", nargs="+", choices=ARMS, default=list(ARMS))
    parser.add_argument("--sizes", nargs="+", type=float, choices=SIZES, default=SIZES)
    parser.add_argument("--seeds", type=int, default=SEEDS)
    parser.add_argument("--sound", type=int, default=0, help="number of tables without faults")
    parser.add_argument(
        "--corners", nargs="+", choices=("white", *KINDS), default=list(KINDS), help="of sound tables"
    )
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--amplitudes", action="store_true", help=f"remake {AMPLITUDES.name}")
    parser.add_argument("-o", "--output", type=Path, default=Path("model_errors_study.csv"), help="every run")
    given = parser.parse_args()
    os.environ["OPENBLAS_NUM_THREADS"] = "1"  # of the processes to come
    if given.amplitudes:
        with open(AMPLITUDES, "w", encoding="utf-8", newline="") as file:
            table = csv.DictWriter(
                file, ("fault", "arm", "size", "stated_px", "amplitude"), lineterminator="\n"
            )
            table.writeheader()
            table.writerows(amplitudes())
        return
    jobs, rows = tables(given.faults, given.arms, given.sizes, given.seeds, given.sound, given.corners), []
    with open(given.output, "w", encoding="utf-8", newline="") as file:
        table = csv.DictWriter(file, COLUMNS)
        table.writeheader()
        with ProcessPoolExecutor(given.jobs, get_context("spawn"), os.nice, (10,)) as pool:
            for row in tqdm(pool.map(judged, jobs), "tables", len(jobs), disable=not sys.stderr.isatty()):
                rows.append(dict.fromkeys(COLUMNS, np.nan) | {"judged": "", "others_wrong": 0} | row)
                table.writerow(rows[-1])
                file.flush()
    tell(rows)


if __name__ == "__main__":
    main()
