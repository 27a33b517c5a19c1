"""Arms before two cameras, simulated with nothing of the package, and thirty faults of arm and rig.

No arm and no rig is a shipped one. A fault changes the joints behind their readings, the tool, the base, the
cameras or their lenses by one amplitude (rad, m, px, or a ratio), some by the place of a pose in the order of
the recording, from 0 to 1.
"""

import itertools
from functools import partial
from typing import Any, NamedTuple

import numpy as np

IMAGE = (1280, 960)  # px
ASPECT, SKEW, MIDDLE = 1.002, 0.001, np.array([[655.0, 470.0], [628.0, 487.0]])  # of cameras; px
REACH_M = 0.3  # m of a prismatic joint for a rad
TILTS = np.radians([-35.0, 0.0, 35.0])  # of three tags side by side
SQUARE = 0.5 * np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])


class Arm(NamedTuple):
    """An arm, stretched out along x where all joints are zero, its rig, and where it is recorded."""

    types: str
    axes: np.ndarray  # (n, 3) directions
    at: np.ndarray  # (n, 3) points on them, m
    tip: np.ndarray  # (3,) m
    home: np.ndarray  # (n,) rad or m
    reach: np.ndarray  # (n,) of trials to both sides, rad or m
    joints: tuple[int, int, int]  # shoulder, elbow, wrist: those that have faults
    design: str  # trials, singles or random
    focal: float  # px
    cameras: Any = None  # (2, 3, 4) to normalised coordinates
    markers: Any = None  # (12, 3) at zero, m
    k: np.ndarray = np.zeros((2, 2))  # radial lenses


def turned(v):
    """Rotations (..., 3, 3) by rotation vectors (..., 3), rad."""
    v = np.asarray(v, dtype=float)
    angle, W = np.linalg.norm(v, axis=-1)[..., None, None], np.zeros((*v.shape, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        W[..., i, j], W[..., j, i] = -v[..., k], v[..., k]
    return np.eye(3) + np.sinc(angle / np.pi) * W + 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2 * W @ W


def moved(X, motion, about=0.0):
    """Points X (..., k, 3) after motions (..., 6): a rotation vector about a point, and a shift."""
    return (X - about) @ np.swapaxes(turned(motion[..., :3]), -1, -2) + about + motion[..., None, 3:]


def chain(arm, q):
    """Rotation (K, 3, 3) and shift (K, 3) that carry each joint, and at last the tool."""
    R, t = np.broadcast_to(np.eye(3), (len(q), 3, 3)), np.zeros((len(q), 3))
    found = [(R, t)]
    for kind, axis, at, amount in zip(arm.types, arm.axes, arm.at, q.T, strict=True):
        turn = turned(amount[:, None] * (kind == "R") * axis / np.linalg.norm(axis))
        shift = amount[:, None] * axis if kind == "P" else at - turn @ at
        R, t = R @ turn, t + (R @ shift[..., None])[..., 0]
        found.append((R, t))
    return found


def arm_of(types, letters, at, tip, home, reach, joints, design, focal, tag_m, views):
    """An arm, deg or m, whose tags look at its cameras at home; views (2, 4): place and roll."""
    axes, slides = np.array([np.eye(3)["xyz".index(a)] for a in letters]), np.array(list(types)) == "P"
    home, reach = (np.where(slides, one, np.radians(one)) for one in (home, reach))
    arm = Arm(types, axes, np.array(at, float), np.array(tip), home, reach, joints, design, focal)
    R, t = (part[0] for part in chain(arm, home[None])[-1])
    there, rows = R @ arm.tip + t, []
    for x, y, z, roll in views:
        Q = turned([0.0, 0.0, roll]) @ looking(-np.array([x, y, z]))
        rows.append(np.hstack([Q, -Q @ np.add(there, [x, y, z])[:, None]]))
    face = looking(np.mean(views, axis=0)[:3]).T @ np.diag([-1.0, -1.0, 1.0])
    place = [[1.2 * np.sin(a), 0.0, np.cos(a) - 1.0] for a in TILTS]
    tags = [p + SQUARE @ turned([0.0, a, 0.0]).T for p, a in zip(place, TILTS, strict=True)]
    markers = (tag_m * np.concatenate(tags) @ face.T + there - t) @ R
    return arm._replace(cameras=np.array(rows), markers=markers)


def looking(ahead):
    """Axes (3, 3), rows x, y, z, of a camera that looks ahead (3,) with its y axis down."""
    z = ahead / np.linalg.norm(ahead)
    x = np.cross(z, [0.0, 0.0, 1.0]) / np.linalg.norm(np.cross(z, [0.0, 0.0, 1.0]))
    return np.stack([x, np.cross(z, x), z])


_SIX_AT = [[0, 0, 0], [0.06, 0, 0.36], [0.42, 0, 0.36], [0.42, 0, 0.36], [0.8, 0, 0.36], [0.8, 0, 0.36]]
_HOBBY_AT = [[0, 0, 0], [0.02, 0, 0.08], [0.14, 0, 0.08], [0.27, 0, 0.08], [0.31, 0, 0.08]]
_SLIDE_AT = [[0, 0, 0], [0, 0.1, 0.4], [0, 0, 0], [0.5, 0.1, 0.4], [0.62, 0.1, 0.46], [0.7, 0.14, 0.46]]
_SIX_VIEWS = [[1.15, -0.35, 0.2, 0.06], [1.1, 0.4, 0.3, -0.04]]
_HOBBY_VIEWS = [[0.47, -0.15, 0.06, 0.08], [0.45, 0.17, 0.11, -0.05]]
_SLIDE_VIEWS = [[1.0, -0.3, 0.27, -0.05], [1.05, 0.36, 0.2, 0.07]]
_SIX = [8, -52, 75, 12, -38, 15], [28, 22, 24, 28, 28, 30], (2, 3, 5), "trials", 1050.0, 0.06, _SIX_VIEWS
_HOBBY = [-5, -55, 70, -20, 10], [30, 22, 25, 30, 30], (2, 3, 4), "random", 930.0, 0.026, _HOBBY_VIEWS
_SLIDE = [-6, -15, 0.05, 10, 20, -12], [25, 22, 0.12, 30, 28, 28], (1, 2, 5), "trials", 1000.0, 0.055
ARMS = {
    # Six axes of which the last three meet, 0.9 m; five of which three are parallel, 0.4 m; a slide behind
    # two joints, and a wrist whose axes do not meet, 0.9 m.
    "six": arm_of("RRRRRR", "zyyxyx", _SIX_AT, [0.92, 0.0, 0.36], *_SIX),
    "hobby": arm_of("RRRRR", "zyyyx", _HOBBY_AT, [0.38, 0.0, 0.08], *_HOBBY),
    "slide": arm_of("RRPRRR", "zyxxyz", _SLIDE_AT, [0.78, 0.14, 0.46], *_SLIDE, _SLIDE_VIEWS),
}


class World:
    """An arm and its rig at poses, with what is not as the model says."""

    def __init__(self, arm, q, order, held):
        self.arm, self.q, self.t, self.held = arm, q, order, held  # order from 0 to 1
        self.unit = np.where(np.array(list(arm.types)) == "P", REACH_M, 1.0)
        self.theta, self.base, self.slip = q.copy(), np.zeros((len(q), 6)), np.zeros((len(q), 6))
        self.views, self.slipping = np.zeros((len(q), 2, 6)), np.ones(len(arm.markers), dtype=bool)
        self.k, self.tangential, self.focus = arm.k.copy(), np.zeros((2, 2)), np.zeros(2)
        # A lens without a fault is about the middle of the image, px from the principal point.
        self.center = (np.array(IMAGE) - 1.0) / 2.0 - MIDDLE

    def turn(self, joint, by):
        """Turn a joint, from 1, by (K,) rad more than it reads, or slide it."""
        self.theta[:, joint - 1] += by * self.unit[joint - 1]

    def read(self, joint):
        """Reading (K,) of a joint, rad."""
        return self.q[:, joint - 1] / self.unit[joint - 1]

    def near(self, view):
        """Distance of the tool from a camera where all joints are zero, m."""
        return np.linalg.norm(self.arm.cameras[view] @ [*self.arm.markers.mean(axis=0), 1.0])

    def load(self, joint):
        """Torque (K,) of weights at the outer joints and at the tip about a joint, over that of the arm."""
        frames, ends = chain(self.arm, self.q), [*self.arm.at, self.arm.tip]
        place = [R @ at + t for (R, t), at in zip(frames[joint - 1 :], ends[joint - 1 :], strict=True)]
        axis, lever = frames[joint - 1][0] @ self.arm.axes[joint - 1], np.mean(place[1:], axis=0) - place[0]
        return np.cross(axis, lever)[:, 2] / np.linalg.norm(self.arm.tip - self.arm.at[1])

    def images(self):
        """Pixels (K, 2, m, 2)."""
        arm, ((R, t), result) = self.arm, (chain(self.arm, self.theta)[-1], [])
        X = np.broadcast_to(arm.markers, (len(self.q), *arm.markers.shape))
        X = np.where(self.slipping[:, None], moved(X, self.slip, arm.markers.mean(axis=0)), X)
        X = moved(X @ R.swapaxes(1, 2) + t[:, None], self.base)
        for v, P in enumerate(arm.cameras):
            Y = moved(X @ P[:, :3].T + P[:, 3], self.views[:, v])
            x = Y[..., :2] / Y[..., 2:] * (1.0 + self.focus[v] * (Y[..., 2:] / self.near(v) - 1.0))
            x = x @ [[1.0, 0.0], [SKEW, ASPECT]] - self.center[v] / arm.focal
            r2, p = (x**2).sum(axis=-1, keepdims=True), self.tangential[v]
            bent = x * (1.0 + self.k[v, 0] * r2 + self.k[v, 1] * r2**2)
            x = bent + 2.0 * (x @ p)[..., None] * x + r2 * p + self.center[v] / arm.focal
            result.append(arm.focal * x + MIDDLE[v])
        return np.stack(result, axis=1)


def ramp(t):
    return t


def saturates(t):
    return -np.expm1(-5.0 * t)


def steps(t, at=0.5):
    return (t >= at) * 1.0


def settles(t):
    return np.exp(-t / 0.05)


# What puts a fault of an amplitude (rad, m, px, or a ratio) into a world.
def curve(w, a, rng, joints, power=1):
    for joint in joints:
        w.turn(joint, a * w.read(joint) ** power)


def harmonic(w, a, rng, joint, times=1.0, phase=None):
    phase = rng.uniform(0.0, 2.0 * np.pi) if phase is None else phase
    w.turn(joint, a * np.sin(times * w.read(joint) + phase))


def coupling(w, a, rng, joint, to):
    w.turn(to, a * w.read(joint))


def sag(w, a, rng, joints):
    for joint in joints:
        w.turn(joint, a * w.load(joint))


def zero(w, a, rng, joint, when):
    w.turn(joint, a * when(w.t))


def nudge(w, a, rng, part, index, when=None):
    getattr(w, part)[index] += a if when is None else a * when(w.t)


def askew(w, a, rng, part):
    for v, angle in enumerate(rng.uniform(0.0, 2.0 * np.pi, 2)):
        getattr(w, part)[v] += a * np.array([np.cos(angle), np.sin(angle)])


def move(w, a, rng, part, when, views=(0, 1), tags=(0, 1, 2)):
    """Move cameras, base or tool by random motions: images by a px or so, else points by a m or so."""
    for v in views if part == "views" else (0,):
        size = {"views": w.arm.focal, "base": np.linalg.norm(w.arm.tip)}.get(part, np.ptp(w.arm.markers))
        turn, shift = rng.standard_normal((2, 3))
        by = a * np.concatenate([turn / np.linalg.norm(turn) / size, 0.7 * shift / np.linalg.norm(shift)])
        by[3:] *= w.near(v) / size if part == "views" else 1.0
        getattr(w, part)[(slice(None), v) if part == "views" else slice(None)] += when(w.t)[:, None] * by
    w.slipping[:] = np.isin(np.arange(len(w.slipping)) // 4, tags)


def backlash(w, a, rng, joint):
    way, signs = 1.0, np.sign(np.diff(w.read(joint), prepend=0.0))
    w.turn(joint, (not w.held) * -0.5 * a * np.array([way := sign or way for sign in signs]))


def joint_noise(w, a, rng):
    for joint in range(1, len(w.arm.types) + 1):
        w.turn(joint, (not w.held) * a * rng.standard_normal(len(w.q)))


def faults_of(arm):
    """Faults by name: what puts one into a world, and its causes: kind, joints, view; None for any."""
    s, e, j = arm.joints
    every, late = tuple(i + 1 for i, kind in enumerate(arm.types) if kind == "R"), partial(steps, at=0.8)
    moves, left = partial(partial, move), {(kind, None, "left") for kind in ("camera_drift", "camera_step")}
    subsets = [some for count in range(1, 7) for some in itertools.combinations(every, count)]
    waves = ("second_harmonic", "harmonic", "quadratic", "cubic")  # a short stretch of two waves is a cubic
    curved = {(kind, (e,), None) for kind in waves}
    return {
        "gear": (partial(curve, joints=(e,)), {("scale", (e,), None)}),
        "gear all": (partial(curve, joints=every), {("scale", some, None) for some in subsets}),
        "gear wrist": (partial(curve, joints=(j,)), {("scale", (j,), None)}),
        "second order": (partial(curve, joints=(s,), power=2), {("quadratic", (s,), None)}),
        "third order": (partial(curve, joints=(e,), power=3), {("cubic", (e,), None)}),
        "eccentric": (partial(harmonic, joint=s), {("harmonic", (s,), None)}),
        "two waves": (partial(harmonic, joint=e, times=2.0), curved),
        "coupled wrist": (partial(coupling, joint=j - 1, to=j), {("coupling", (j - 1, j), None)}),
        "coupled arm": (partial(coupling, joint=s, to=s + 1), {("coupling", (s, s + 1), None)}),
        "sag": (partial(sag, joints=every), {("sag", None, None)}),
        "sag of one": (partial(sag, joints=(2,)), {("sag", (), None), ("sag", (2,), None)}),
        "joint drifts": (partial(zero, joint=e, when=ramp), {("joint_drift", (e,), None)}),
        "joint warms up": (partial(zero, joint=s, when=saturates), {("joint_drift", (s,), None)}),
        "joint steps": (partial(zero, joint=e, when=steps), {("joint_step", (e,), None)}),
        "joint steps late": (partial(zero, joint=s, when=late), {("joint_step", (s,), None)}),
        "left drifts": (moves(part="views", when=ramp, views=(0,)), {("camera_drift", None, "left")}),
        "both drift": (moves(part="views", when=ramp), {("camera_drift", None, None)}),
        "right steps": (moves(part="views", when=steps, views=(1,)), {("camera_step", None, "right")}),
        "left settles": (moves(part="views", when=settles, views=(0,)), left),
        # Cameras that step alike are a base that steps.
        "base steps": (moves(part="base", when=steps), {("base", None, None), ("camera_step", None, "")}),
        "tool slips": (moves(part="slip", when=steps), {("tool", None, None)}),
        "tool creeps": (moves(part="slip", when=ramp), {("tool", None, None)}),
        "tag slips": (moves(part="slip", when=steps, tags=(1,)), {("tool", None, None)}),
        "lens": (partial(nudge, part="k", index=(slice(None), 0)), {("lens", None, None)}),
        "right lens": (partial(nudge, part="k", index=(1, 0)), {("lens", None, "right")}),
        "lens centre": (partial(askew, part="center"), {("lens_center", None, None)}),
        "focus": (partial(nudge, part="focus", index=slice(None)), {("focus", None, None)}),
        "decentred": (partial(askew, part="tangential"), {(k, None, None) for k in ("lens", "lens_center")}),
        # No kind is of backlash: all that is said of the joint is right. Joint noise has no cause.
        "backlash": (partial(backlash, joint=e), {(None, (e,), None)}),
        "joint noise": (joint_noise, set()),
    }


FAULTS, WITH_LENS = tuple(faults_of(ARMS["six"])), ("lens centre",)  # those calibrated with a lens


def alternatives(arm, kind, joints, view):
    """Alternatives of a named cause, each of directions that act together."""
    joints = joints or range(1, len(arm.types) + 1)
    views = [("left", "right").index(view)] if view in ("left", "right") else [0, 1]
    breaks = [partial(steps, at=at) for at in np.arange(0.1, 0.95, 0.05)]
    pairs = [joints] if len(joints) == 2 else itertools.permutations(joints, 2)
    moments = {"drift": [ramp], "step": breaks}.get(kind.partition("_")[2], [ramp, *breaks])
    powers = {"scale": 1, "quadratic": 2, "cubic": 3}
    if kind in powers:
        return [[partial(curve, joints=(j,), power=powers[kind]) for j in joints]]
    if kind in ("joint_drift", "joint_step"):
        return [[partial(zero, joint=j, when=when) for j in joints] for when in moments]
    if kind in ("camera_drift", "camera_step", "base", "tool"):
        part = {"base": "base", "tool": "slip"}.get(kind, "views")
        columns = [(slice(None), *((v,) if part == "views" else ()), i) for v in views for i in range(6)]
        return [[partial(nudge, part=part, index=c, when=when) for c in columns] for when in moments]
    both = [(v, i) for v in views for i in (0, 1)]
    static = {
        "harmonic": [partial(harmonic, joint=j, phase=p) for j in joints for p in (0.0, 0.5 * np.pi)],
        "coupling": [partial(coupling, joint=i, to=j) for i, j in pairs],
        "sag": [partial(sag, joints=(j,)) for j in joints],
        "lens": [partial(nudge, part="k", index=index) for index in both],
        "lens_center": [partial(nudge, part="center", index=index) for index in both],
        "focus": [partial(nudge, part="focus", index=v) for v in views],
    }
    return [static[kind]] if kind in static else []
