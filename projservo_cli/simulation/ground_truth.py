"""Ground truth (workspace) of a simulated experiment: the true robot, rig and markers."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from projservo_cli.geometry.displacements import rigid
from projservo_cli.geometry.kinematics import project
from projservo_cli.geometry.stereo import optical_centers
from projservo_cli.image_size import within_images
from projservo_cli.records import (
    TOOL,
    VIEWS,
    WORLD,
    BoolArray,
    CalibratedArm,
    CalibratedBody,
    CalibratedRig,
    Calibration,
    CalibrationVerdict,
    FitQuality,
    FloatArray,
    JointEvidence,
    Model,
    ParameterErrors,
    Rejections,
    StatedErrors,
    WorkFailed,
)
from projservo_cli.settings.objects import Displacement
from projservo_cli.settings.task import Goal
from projservo_cli.simulation.analytic_plant import Ends, Plant
from projservo_cli.simulation.arm import (
    METRIC_A_INF,
    SerialArm,
    camera_center,
    inverse_kinematics,
    roll_axis,
)
from projservo_cli.simulation.random_streams import NORMAL, NoiseShape
from projservo_cli.task.face import center_of, cyclic_order, face_plane

_EDGE_OF_FACE = 1e-9  # limit of a·O below which a face is seen edge-on
_EDGE_ON = math.cos(math.radians(70.0))  # cosine of the angle to a camera from which tags are not found


@dataclass(frozen=True, eq=False)
class Truth:
    """Robot, rig and markers as they are."""

    robot: SerialArm  # true kinematics
    P: FloatArray  # (V, 3, 4) true cameras at the robot's reference, from the base frame, px
    M: FloatArray  # (m, 4) all markers at the robot's reference, m
    number: tuple[int, ...]  # (m,) their numbers
    face: tuple[int, ...]  # indices of the face markers; none if the configuration has no face
    center: int  # position of the centre marker within the face, or ``MIDPOINT``
    image_size: FloatArray  # (V, 2) width and height of each image, px
    lens: FloatArray  # (V, 5) true lenses
    # (m, 3) directions that markers look in at the robot's reference; zero if they are seen from anywhere
    normals: FloatArray = field(default_factory=lambda: np.zeros(3))
    view: tuple[str, ...] = VIEWS  # names of the views
    on_tool: bool = False  # whether the cameras are on the tool, and markers belong to the scene
    noise: NoiseShape = NORMAL  # distribution of the noise of pixels

    @cached_property
    def model(self) -> Model:
        """Metric model, for the plant and for the law that is given one."""
        return self.robot.model(self.P, self.lens, on_tool=self.on_tool)

    @cached_property
    def calibration(self) -> Calibration:
        """Calibration from the truth: without an error, and without a covariance."""
        n, unknown = len(self.model.prismatic), np.full((0, 0), np.nan)
        none, still, never = np.zeros((0, 3), dtype=np.int64), np.full(n, np.nan), np.zeros(n, dtype=np.bool_)
        return Calibration(
            method="bundle_adjustment",
            source="simulated",
            view=self.view,
            seconds=0.0,
            verdict=CalibrationVerdict(usable=True, reason="known", advice=()),
            rig=CalibratedRig(mount=TOOL if self.on_tool else WORLD, P=self.model.P, lens=self.lens),
            arm=CalibratedArm(
                joint_types="".join("P" if slides else "R" for slides in self.model.prismatic),
                H_hat_0=self.robot.H_hat_0,
                q_reference=self.model.q_reference,
                a_inf=self.model.a_inf,
            ),
            body=CalibratedBody(marker=np.array(self.number, dtype=np.int64), M=self.M),
            parameter_errors=ParameterErrors(
                sqrt_cov_shared=np.full((1, 1), np.nan), sqrt_cov_marker=unknown, sqrt_cov_own=unknown
            ),
            fit=FitQuality(
                rms_px=0.0,
                sigma_px=0.0,
                sigma_fitted_px=0.0,
                chi2_per_dof=math.nan,
                dof=0,
                poses_used=0,
                markers_used=len(self.M),
            ),
            joints=JointEvidence(
                excitation=still,
                joint_min=still,
                poorly_observable=never,
                operator_defect=still,
                trace_defect=still,
                plane_defect=still,
                prediction_noise=unknown,
            ),
            rejections=Rejections(outlier=none, suspect=none, id_switches=none),
            stated=StatedErrors(),
        )

    @cached_property
    def M_face(self) -> FloatArray:
        """Face markers (k, 4) at the robot's reference, m."""
        return np.ascontiguousarray(self.M[list(self.face)])

    @cached_property
    def pins(self) -> tuple[int, ...]:
        """Indices of the markers that are not on the face."""
        return tuple(i for i in range(len(self.M)) if i not in self.face)

    def of(self, numbers: Sequence[int]) -> FloatArray:
        """Markers (k, 4) of some numbers at the robot's reference, m."""
        return np.ascontiguousarray(self.M[[self.number.index(number) for number in numbers]])

    def ends(self, q_goal: FloatArray) -> Ends:
        """Return the poses of the tool at the reference and at the goal joints (n,)."""
        base_tool, pose = self.robot.base_tool, self.robot.pose(q_goal)
        middle = np.array(center_of(self.M_face, self.center))
        if self.on_tool:
            return Ends(base_tool, pose, self.displacement(q_goal) @ middle)
        return Ends(base_tool, pose, pose @ np.linalg.solve(base_tool, middle))

    def images(self, q: FloatArray, M: FloatArray) -> FloatArray:
        """True pixels (V, k, 2) of markers M (k, 4), given at the reference, at the joints q (n,)."""
        return project(self.P, M @ self.displacement(q).T, self.lens)

    def faces(self, q: FloatArray) -> BoolArray:
        """Whether markers look towards each camera (V, m) at the joints q (n,), and are not seen edge-on."""
        H = self.displacement(q)
        return self.towards(self.M @ H.T, self.normals @ H[:3, :3].T)

    def towards(self, X: FloatArray, normals: FloatArray) -> BoolArray:
        """Whether markers X (m, 4) that look along normals (m, 3) look towards each camera (V, m), likewise.

        Those whose normal is zero are seen from anywhere.
        """
        away = np.array([camera_center(camera) for camera in self.P])[:, None] - X[:, :3]
        towards = (away * normals).sum(axis=2) / np.linalg.norm(away, axis=2)
        return np.asarray((towards > _EDGE_ON) | ~normals.any(axis=-1))

    def within(self, pixels: FloatArray, view: int | slice = slice(None)) -> FloatArray:
        """Pixels (..., V, m, 2), or (m, 2) of a view, NaN outside an image: centres reach to size − ½."""
        inside = within_images(pixels, self.image_size[view, ..., None, :])
        return np.where(inside[..., None], pixels, np.nan)

    def displacement(self, q: FloatArray) -> FloatArray:
        """True displacement (4, 4) of the face before the cameras from the reference, at joints q (n,)."""
        moved = self.robot.pose(q) @ self._from_tool
        return np.asarray(np.linalg.inv(moved)) if self.on_tool else moved

    def cameras_at(self, q: FloatArray) -> FloatArray:
        """Cameras (V, 3, 4) from the base frame at the joints q (n,), px."""
        return self.P @ self.displacement(q) if self.on_tool else self.P

    @cached_property
    def _from_tool(self) -> FloatArray:
        return np.asarray(np.linalg.inv(self.robot.base_tool), dtype=np.float64)


class SceneObject(NamedTuple):
    """An object of the simulated scene."""

    name: str
    number: tuple[int, ...]  # (k,) numbers of its markers
    X: FloatArray  # (k, 4) these when the goal was taught, in the base frame, m
    normals: FloatArray  # (k, 3) directions that they looked in; zero if they are seen from anywhere
    T: FloatArray  # (4, 4) displacement since
    # rows (k, 7) of t, s, x, y, z, m, and a rotation vector, rad, from then on; None if it rests
    motion: FloatArray | None = None

    def at(self, time: float) -> FloatArray:
        """Return its displacement (4, 4) since the goal was taught, at a time of the robot's clock, s."""
        if self.motion is None:
            return self.T
        x = [np.interp(time, self.motion[:, 0], column) for column in self.motion.T[1:]]
        middle, R = (self.X @ self.T.T)[:, :3].mean(axis=0), Rotation.from_rotvec(x[3:])
        return rigid(R, middle - R.apply(middle) + x[:3]) @ self.T

    def displaced(self, by: Displacement) -> "SceneObject":
        """Return the object after another displacement about where its middle is."""
        return self._replace(T=by.about((self.X @ self.T.T)[:, :3].mean(axis=0)) @ self.T)

    def images(self, truth: Truth, T: FloatArray) -> FloatArray:
        """True pixels (V, k, 2) of its markers after a displacement T (4, 4), NaN where unseen."""
        X = self.X @ T.T
        seen = truth.towards(X, self.normals @ T[:3, :3].T) & (truth.P[:, 2] @ X.T > 0.0)
        return truth.within(np.where(seen[..., None], project(truth.P, X, truth.lens), np.nan))


def _about_axis(point: FloatArray, direction: FloatArray, theta: float) -> FloatArray:
    """4×4 rotation by θ, rad, about the axis through a point (3,), m, along a direction (3,)."""
    R = Rotation.from_rotvec(theta * direction / np.linalg.norm(direction))
    return rigid(R, point - R.as_matrix() @ point)


def turned(goal: Goal, arm: SerialArm, P: FloatArray, q_start: FloatArray) -> FloatArray:
    """Joints (n,) of a goal that is a turn of the tool about the roll axis of the rig from joints (n,).

    arm, P : the arm and the cameras (V, 3, 4) at its place, m. The pose is perhaps displaced a little
    along the axes of the tool. Raises WorkFailed if no joints reach it.
    """
    assert goal.roll_deg is not None
    point, direction = roll_axis(P)
    pose = _about_axis(point, direction, math.radians(goal.roll_deg)) @ arm.pose(q_start)
    if goal.perturbation is not None:
        t, v = np.array(goal.perturbation.translation_m), np.array(goal.perturbation.rotation_rad)
        angle = float(np.linalg.norm(v))
        turn = _about_axis(np.zeros(3), v, angle) if angle > 0.0 else np.eye(4)
        pose = pose @ rigid(Rotation.identity(), t) @ turn
    return inverse_kinematics(arm, pose, q_start)


def plant_of(truth: Truth, q_start: FloatArray, *, opaque: bool, min_views: int = 0) -> Plant:
    """The truth as the loop sees it from the joints q_start (n,), undisturbed.

    opaque : whether the face hides its markers from a camera behind it.
    min_views : number of views that are to see the face, 0 for all.
    Raises WorkFailed if a camera sees the face edge-on there.
    """
    return _plant_at(truth, q_start.tobytes(), opaque, min_views or len(truth.P))


def _front(truth: Truth, H: FloatArray, a: FloatArray, sides: FloatArray, min_views: int) -> float:
    """Sign of the plane a (4,) of the face before it, after the displacement H (4, 4).

    By the directions that its markers look in where enough cameras see them; otherwise of most cameras,
    whose sides of it are a·O (V,).
    """
    normals = truth.normals[list(truth.face)] if truth.normals.ndim > 1 else truth.normals[None]
    towards = np.sign(a[:3] @ H[:3, :3] @ normals.mean(axis=0))
    if np.sum(towards * sides > _EDGE_OF_FACE) >= min_views:
        return float(towards)
    total = np.sign(sides).sum()
    return float(np.sign(total if total else sides[0]) or 1.0)


@lru_cache(maxsize=2048)
def _plant_at(truth: Truth, start_bytes: bytes, opaque: bool, min_views: int) -> Plant:
    q_start = np.frombuffer(start_bytes)
    M = truth.M_face
    H = truth.displacement(q_start)
    start = M @ H.T
    order = cyclic_order(start)
    O = optical_centers(truth.P, METRIC_A_INF)
    a = np.array(face_plane(start, order, center_of(start, truth.center)))
    sides = O @ a
    front = _front(truth, H, a, sides, min_views)
    if np.sum(front * sides > _EDGE_OF_FACE) < min_views:
        raise WorkFailed(
            "task.start: the cameras see different sides of the face, or one sees it edge-on: "
            f"turn the face towards {'both' if len(O) == 2 else 'them' if min_views == len(O) else 'more'}"
        )
    return Plant(
        model=truth.model,
        M=M,
        order=order,
        center=truth.center,
        O=O,
        visible=np.full(len(O), front),
        image_size=truth.image_size,
        limits=truth.robot.limits,
        opaque=opaque,
        min_views=min_views,
    )
