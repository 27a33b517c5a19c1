"""Ground truth of a simulated experiment: robot, rig and markers as a configuration describes them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from projservo_cli.calibration.detections import per_rad
from projservo_cli.config import Config
from projservo_cli.config.markers import Markers
from projservo_cli.config.robot import Camera, JointVector, Rig, RobotSettings
from projservo_cli.config.task import Goal
from projservo_cli.geometry.kinematics import forward_kinematics, joint_operators, project
from projservo_cli.records import (
    NO_LENS,
    PRISMATIC,
    REVOLUTE,
    BoolArray,
    Calibration,
    FloatArray,
    InputError,
    JointLimits,
    Model,
    WorkFailed,
    in_unit,
    position_limits,
)
from projservo_cli.rendered.model import lens_of
from projservo_cli.robots.simulated import Arm, Ends, camera_center, roll_axis
from projservo_cli.task.face import MIDPOINT, center_of

# Accelerations that the profile joint takes where no limit is given, deg/s² and m/s².
_ACCELERATION_DEG_S2, _ACCELERATION_M_S2 = 500.0, 2.0


class Joints(NamedTuple):
    """What a configuration says of the joints."""

    types: str  # one letter a joint, R or P
    limits: JointLimits  # infinite where none is set; accelerations of the profile joint alone
    units: tuple[str, ...]  # in which messages give readings: deg, rad or m

    def length_of(self, degrees: float) -> FloatArray:
        """An angle as (n,) rad, for prismatic joints the length, m, that makes as much of a difference."""
        return math.radians(degrees) * per_rad(np.array([*self.types]) == "P")

    def limit_passed(self, q: FloatArray) -> str:
        """Return which of the readings (n,), rad or m, lies beyond its limits, in words; empty for none."""
        return limit_passed(q, self.limits, self.units)


def limit_passed(q: FloatArray, limits: JointLimits, units: Sequence[str]) -> str:
    """Return which of the readings (n,), rad or m, lies beyond its limits, in its unit; empty for none."""
    for i in np.flatnonzero((q < limits.lower) | (q > limits.upper)).tolist():
        at, low, high = (in_unit(values[i], units[i]) for values in (q, limits.lower, limits.upper))
        return f"joint {i + 1} would be at {at}, beyond its limits {low} to {high}"
    return ""


def joints_of(config: Config, default_types: str = "", calibration: Calibration | None = None) -> Joints:
    """Joints of the robot; of ``default_types`` where the configuration does not tell.

    calibration : whose data tell limits, where ``robot.limits`` takes them from there; without, none are.
    """
    vector = config.reference
    types = config.joint_types or default_types or "R" * (len(vector.joints) if vector is not None else 0)
    lower, upper = _limits_of(config.robot, types, calibration)
    c = config.control
    revolute = math.inf if c.joint_speed_limit_deg_s is None else math.radians(c.joint_speed_limit_deg_s)
    prismatic = math.inf if c.prismatic_speed_limit_m_s is None else c.prismatic_speed_limit_m_s
    speed = np.array([prismatic if kind == "P" else revolute for kind in types])
    turning = math.radians(c.joint_acceleration_limit_deg_s2 or _ACCELERATION_DEG_S2)
    sliding = c.prismatic_acceleration_limit_m_s2 or _ACCELERATION_M_S2
    acceleration = np.array([sliding if kind == "P" else turning for kind in types])
    return Joints(types, JointLimits(lower, upper, speed, acceleration), units_of(vector, types))


def units_of(vector: JointVector | None, types: str) -> tuple[str, ...]:
    """Units in which somebody gave readings of joints (n,) by their types; rad where nobody did."""
    return tuple("m" if kind == "P" else "rad" if vector is None else vector.unit for kind in types)


def _limits_of(
    robot: RobotSettings | None, types: str, calibration: Calibration | None
) -> tuple[FloatArray, FloatArray]:
    """Lower and upper limits (n,) of joints, rad or m; infinite where nothing tells them."""
    share = robot.limits.from_data if robot is not None and robot.limits is not None else None
    if share is not None and calibration is not None:
        span = calibration.excitation
        return calibration.lowest - share * span, calibration.lowest + (1.0 + share) * span
    pairs: Sequence[tuple[float, float]] = ((-math.inf, math.inf),) * len(types)
    if robot is not None and share is None:
        try:
            pairs = robot.ranges if robot.limits is None else robot.limits.values(types)
        except ValueError as error:
            raise InputError(f"robot.limits.joints: give a pair for each of {len(types)} joints") from error
    lower, upper = np.array(pairs, dtype=np.float64).reshape(-1, 2).T.copy()
    return lower, upper


_EDGE_ON = math.cos(math.radians(70.0))  # of the angle to a camera from which tags are not found


@dataclass(frozen=True, eq=False)
class Truth:
    """Robot, rig and markers as they are."""

    robot: Arm  # true kinematics
    P: FloatArray  # (2, 3, 4) true cameras, px
    M: FloatArray  # (m, 4) all markers at the robot's reference, m
    number: tuple[int, ...]  # (m,) their numbers
    face: tuple[int, ...]  # indices of the face markers; none where the configuration has no face
    center: int  # position of the centre marker within the face, or ``MIDPOINT``
    image_size: FloatArray  # (2,) px
    lens: FloatArray = field(default_factory=NO_LENS.copy)  # (2, 5) true lenses
    # (m, 3) directions that markers look in at the robot's reference; zero where they are seen from anywhere
    normals: FloatArray = field(default_factory=lambda: np.zeros(3))

    @cached_property
    def model(self) -> Model:
        """Metric model, for the plant and for the law that is given one."""
        return self.robot.model(self.P)._replace(lens=self.lens)

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
        """Where the robot holds the tool at its reference and at the goal joints (n,)."""
        base_tool, pose = self.robot.base_tool, self.robot.pose(q_goal)
        middle = np.array(center_of(self.M_face, self.center))
        return Ends(base_tool, pose, pose @ np.linalg.solve(base_tool, middle))

    def images(self, q: FloatArray, M: FloatArray) -> FloatArray:
        """True pixels (2, k, 2) of markers M (k, 4), given at the reference, at the joints q (n,)."""
        return project(self.P, M @ self.displacement(q).T, self.lens)

    def faces(self, q: FloatArray) -> BoolArray:
        """Whether markers look towards each camera (2, m) at the joints q (n,), and are not seen edge-on."""
        H = self.displacement(q)
        away = np.array([camera_center(camera) for camera in self.P])[:, None] - (self.M @ H.T)[:, :3]
        towards = (away * (self.normals @ H[:3, :3].T)).sum(axis=2) / np.linalg.norm(away, axis=2)
        return np.asarray((towards > _EDGE_ON) | ~self.normals.any(axis=-1))

    def within(self, pixels: FloatArray) -> FloatArray:
        """Pixels (..., 2), NaN where they lie outside an image: their centres reach from −½ to size − ½."""
        inside = (pixels >= -0.5) & (pixels <= self.image_size - 0.5)
        return np.where(inside.all(axis=-1, keepdims=True), pixels, np.nan)

    def displacement(self, q: FloatArray) -> FloatArray:
        """True displacement (4, 4) of the face from the reference at the joints q (n,)."""
        return self.robot.pose(q) @ self._from_tool

    def turned(self, q_start: FloatArray, goal: Goal) -> FloatArray:
        """Joints (n,) after a turn about the roll axis of the rig and a small displacement of the tool."""
        assert goal.turn_deg is not None
        point, direction = roll_axis(self.P)
        pose = _about_axis(point, direction, math.radians(goal.turn_deg)) @ self.robot.pose(q_start)
        if goal.perturbation is not None:
            v = np.array(goal.perturbation.rotation_rad)
            t = np.array(goal.perturbation.translation_m)
            angle = float(np.linalg.norm(v))
            turn = _about_axis(np.zeros(3), v, angle) if angle > 0.0 else np.eye(4)
            pose = pose @ _rigid(Rotation.identity(), t) @ turn
        return _inverse_kinematics(self.robot, pose, q_start)

    @cached_property
    def _from_tool(self) -> FloatArray:
        return np.asarray(np.linalg.inv(self.robot.base_tool), dtype=np.float64)


def center_index(markers: Markers) -> int:
    """Position of the centre marker within the face, or ``MIDPOINT``."""
    return (
        MIDPOINT if markers.center == "midpoint" or not markers.front else markers.front.index(markers.center)
    )


def truth_of(config: Config) -> Truth:
    """Build the truth, or find it again where it was built; an InputError where a part of it is missing."""
    if config.arm is None:
        raise InputError("this stage drives a simulated robot: set robot.dh or robot.screws")
    if config.rig is None:
        raise InputError("this stage needs a simulated rig: set rig.left, rig.right and rig.image_size_px")
    if config.markers is None or config.markers.points is None:
        raise InputError("this stage needs the markers of the simulated robot: set markers.positions_m")
    rendered = config.plant.rendered
    return _built(config.arm, config.rig, config.markers, 0.0 if rendered is None else rendered.k1)


@lru_cache(maxsize=16)
def _built(described: RobotSettings, rig: Rig, markers: Markers, k1: float) -> Truth:
    robot, P = _robot_of(described), np.array([_camera_of(rig.left), _camera_of(rig.right)])
    numbers = markers.known
    assert numbers is not None
    points = np.c_[markers.points, np.ones(len(numbers))]
    face = markers.front or ()
    return Truth(
        robot,
        P,
        points @ robot.base_tool.T,
        numbers,
        tuple(numbers.index(number) for number in face),
        center_index(markers),
        np.array(rig.image_size_px, dtype=np.float64),
        lens_of(P, k1) if k1 else NO_LENS,
        np.zeros(3) if markers.normals is None else markers.normals @ robot.base_tool[:3, :3].T,
    )


def arm_of(config: Config) -> Arm | None:
    """The arm of a configuration; None where its kinematics are not given."""
    return None if config.arm is None else _robot_of(config.arm)


def _twist(w: Sequence[float], v: Sequence[float]) -> FloatArray:
    """4×4 twist of an angular velocity w (rad) and a velocity v of the origin (m)."""
    return np.array([[0.0, -w[2], w[1], v[0]], [w[2], 0.0, -w[0], v[1]], [-w[1], w[0], 0.0, v[2]], [0.0] * 4])


def _rigid(R: Rotation, t: Sequence[float] | FloatArray) -> FloatArray:
    """4×4 displacement of a rotation and a translation (3,), m."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R.as_matrix(), t
    return T


def _about_axis(point: FloatArray, direction: FloatArray, theta: float) -> FloatArray:
    """4×4 rotation by θ, rad, about the axis through a point (3,), m, along a direction (3,)."""
    R = Rotation.from_rotvec(theta * direction / np.linalg.norm(direction))
    return _rigid(R, point - R.as_matrix() @ point)


def _robot_of(described: RobotSettings) -> Arm:
    """Arm of screws, or of a Denavit–Hartenberg table, whose reference is all joints zero.

    In Craig's modified convention a and α come before θ and d; the joint variable is added to θ or d.
    Source: P. Corke, Robotics, Vision and Control, 2nd ed., section 7.1.
    """
    kinds = described.joint_types
    types = np.array([PRISMATIC if kind == "P" else REVOLUTE for kind in kinds], dtype=np.int64)
    limits = position_limits(*np.array(described.ranges, dtype=np.float64).T.copy())
    if described.screws is not None:
        screws = described.screws
        twists = np.array([_twist(joint.w, joint.v) for joint in screws.joints])
        q_reference = np.array(screws.reference.values(kinds))
        return Arm(twists, types, q_reference, np.array(screws.base_tool), limits)
    assert described.dh is not None
    table, T, moved = described.dh, np.eye(4), []
    for joint in table.joints:
        turn = _rigid(Rotation.from_rotvec([0.0, 0.0, math.radians(joint.theta_deg)]), [0.0, 0.0, joint.d_m])
        tilt = _rigid(Rotation.from_rotvec([math.radians(joint.alpha_deg), 0.0, 0.0]), [joint.a_m, 0.0, 0.0])
        if table.convention == "modified":
            T, tilt = T @ tilt, np.eye(4)
        axis = _twist([0, 0, 0], [0, 0, 1]) if joint.type == "P" else _twist([0, 0, 1], [0, 0, 0])
        moved.append(T @ axis @ np.linalg.inv(T))
        T = T @ turn @ tilt
    return Arm(np.array(moved), types, np.zeros(len(kinds)), T @ np.array(table.tool), limits)


def _camera_of(camera: Camera) -> FloatArray:
    """Camera (3, 4) to px of its matrix or its look-at description."""
    if camera.matrix is not None:
        P = np.array(camera.matrix)
        # A camera is given up to scale; the loop needs the scale that makes depths positive metres.
        scale = float(np.sign(np.linalg.det(P[:, :3])) * np.linalg.norm(P[2, :3]))
        return P / scale if abs(scale - 1.0) > 1e-12 else P
    assert camera.focal_px is not None
    assert camera.principal_point_px is not None
    assert camera.position_m is not None
    assert camera.target_m is not None
    z = np.subtract(camera.target_m, camera.position_m)
    x = np.cross(z, camera.up)
    z = z / np.linalg.norm(z)
    x = x / np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    (f_u, f_v), (u, v) = camera.focal_px, camera.principal_point_px
    K = np.array([[f_u, 0.0, u], [0.0, f_v, v], [0.0, 0.0, 1.0]])
    return np.asarray(K @ np.c_[R, -R @ np.asarray(camera.position_m)])


def _inverse_kinematics(robot: Arm, goal: FloatArray, q_start: FloatArray) -> FloatArray:
    """Joints within the limits that put the tool at a pose, as near to the start as found.

    Damped Newton steps on the pose from the start and from 30 seeded places within the limits; the
    solution with the least joint motion wins. goal : (4, 4) pose of the tool, m; q_start : (n,) rad or m.
    """
    rng = np.random.default_rng(0)
    span_lower = np.maximum(robot.limits.lower, q_start - 2 * math.pi)
    span_upper = np.minimum(robot.limits.upper, q_start + 2 * math.pi)
    found = []
    for trial in range(31):
        q = _newton(robot, goal, q_start if trial == 0 else rng.uniform(span_lower, span_upper))
        if q is not None:
            q = _unwind(robot, q, q_start)
            if np.all(q >= robot.limits.lower) and np.all(q <= robot.limits.upper):
                found.append(q)
    if not found:
        x, y, z = goal[:3, 3]
        raise WorkFailed(
            f"task.goal: the robot cannot put its tool at ({x:.3f}, {y:.3f}, {z:.3f}) m with this rotation "
            "within its joint limits: choose a nearer goal, another start or wider limits"
        )
    return min(found, key=lambda q: float(np.linalg.norm(q - q_start)))


def _newton(robot: Arm, goal: FloatArray, q: FloatArray) -> FloatArray | None:
    """Damped Newton steps to a pose; None where they do not arrive."""
    model = robot.model(np.zeros((2, 3, 4)))
    for _ in range(40):
        pose = forward_kinematics(model, q) @ robot.base_tool
        gap = goal @ np.linalg.inv(pose)
        error = np.r_[Rotation.from_matrix(gap[:3, :3]).as_rotvec(), goal[:3, 3] - pose[:3, 3]]
        if np.abs(error).max() < 1e-13:
            return q
        H_hat = joint_operators(model, q)
        tip = H_hat @ pose[:, 3]
        J = np.stack([H_hat[:, 2, 1], H_hat[:, 0, 2], H_hat[:, 1, 0], *tip.T[:3]])
        damping = 1e-9 * float(error @ error)
        if len(q) > len(error):  # of least norm
            step = J.T @ np.linalg.solve(J @ J.T + damping * np.eye(len(error)), error)
        else:
            step = np.linalg.solve(J.T @ J + damping * np.eye(len(q)), J.T @ error)
        q = q + step / max(1.0, float(np.abs(step).max()) / 0.5)
    return q if np.abs(error).max() < 1e-10 else None


def _unwind(robot: Arm, q: FloatArray, near: FloatArray) -> FloatArray:
    """Shift revolute joints by whole turns to within half a turn of ``near`` where limits allow."""
    turned = q.copy()
    for i, kind in enumerate(robot.joint_types):
        if kind == PRISMATIC:
            continue
        candidates = q[i] + 2 * math.pi * np.arange(-4, 5)
        inside = candidates[(candidates >= robot.limits.lower[i]) & (candidates <= robot.limits.upper[i])]
        if len(inside):
            turned[i] = inside[np.argmin(np.abs(inside - near[i]))]
    return turned
