"""Robot, rig, markers and scene of a simulation, as a configuration describes them.

The same sections give the same object, so that derived results are kept.
"""

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from projservo_cli.detection.finders import DICTIONARY
from projservo_cli.geometry.displacements import twists
from projservo_cli.image_size import image_sizes
from projservo_cli.records import TOOL, FloatArray, no_lenses, position_limits, prismatic_of
from projservo_cli.result_hashes import File
from projservo_cli.settings.markers import Markers, Tag
from projservo_cli.settings.objects import ObjectSettings
from projservo_cli.settings.plant import RenderedOptions
from projservo_cli.settings.robot_and_rig import Camera, Rig, RobotSettings, Screws
from projservo_cli.simulation.arm import Link, SerialArm, dh_twists
from projservo_cli.simulation.ground_truth import SceneObject, Truth
from projservo_cli.simulation.random_streams import NoiseShape
from projservo_cli.simulation.rendering import RenderedScene, lens_of
from projservo_cli.task.face import MIDPOINT


@lru_cache(maxsize=32)
def arm_of(robot: RobotSettings) -> SerialArm:
    """Arm of screws, or of a Denavit–Hartenberg table, whose reference is all joints zero."""
    kinds = robot.joint_types
    prismatic = prismatic_of(kinds)
    limits = position_limits(*np.array(robot.ranges, dtype=np.float64).T.copy())
    if isinstance(screws := robot.kinematics, Screws):
        H_hat = twists(np.array([[*joint.w, *joint.v] for joint in screws.joints], dtype=np.float64))
        q_reference = screws.reference.values(kinds)
        return SerialArm(H_hat, prismatic, q_reference, np.array(screws.base_tool), limits)
    if robot.dh is None:
        raise ValueError("joints of a robot of limits alone are not described")
    table = robot.dh
    links = [
        Link(row.type, math.radians(row.theta_deg), row.d_m, row.a_m, math.radians(row.alpha_deg))
        for row in table.joints
    ]
    H_hat, base_tool = dh_twists(links, np.array(table.tool), modified=table.convention == "modified")
    return SerialArm(H_hat, prismatic, np.zeros(len(kinds)), base_tool, limits)


@lru_cache(maxsize=32)
def cameras_of(rig: Rig) -> FloatArray:
    """Cameras (V, 3, 4) of a rig, to px, from the base frame or, of those on the tool, from its frame."""
    return np.array([_camera(camera) for camera in rig.cameras.values()])


def _camera(camera: Camera) -> FloatArray:
    focal, middle, position, target = (
        camera.focal_px,
        camera.principal_point_px,
        camera.position_m,
        camera.target_m,
    )
    if focal is None or middle is None or position is None or target is None:
        return _metric_camera(np.array(camera.matrix))
    (f_u, f_v), (u, v) = focal, middle
    K = np.array([[f_u, 0.0, u], [0.0, f_v, v], [0.0, 0.0, 1.0]])
    return _camera_towards(K, position, target, camera.up)


def _metric_camera(P: FloatArray) -> FloatArray:
    """Camera (3, 4) in the scale that makes depths positive metres, which a given one is only up to."""
    scale = float(np.sign(np.linalg.det(P[:, :3])) * np.linalg.norm(P[2, :3]))
    return P / scale if abs(scale - 1.0) > 1e-12 else P


def _camera_towards(
    K: FloatArray, position: Sequence[float], target: Sequence[float], up: Sequence[float]
) -> FloatArray:
    """Camera (3, 4) to px with intrinsics K (3, 3) at a position that looks at a target, m."""
    z = np.subtract(target, position)
    x = np.cross(z, up)
    z = z / np.linalg.norm(z)
    x = x / np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    return np.asarray(K @ np.c_[R, -R @ np.asarray(position)])


def center_in_face(markers: Markers) -> int:
    """Position of the centre marker within the face, or ``MIDPOINT``."""
    midpoint = markers.center == "midpoint" or not markers.front
    return MIDPOINT if midpoint else (markers.front or ()).index(int(markers.center))


@lru_cache(maxsize=32)
def described_truth(
    robot: RobotSettings, rig: Rig, markers: Markers, noise: NoiseShape, face: bool, k1: float = 0.0
) -> Truth:
    """Robot, rig and markers as they are, and how pixels err.

    face : whether the truth has the face, of which a calibration knows nothing.
    k1 : radial distortion of all rendered lenses, in units of the focal length, instead of the rig's.
    """
    coefficients = np.array([(k1, 0.0) if k1 else camera.lens for camera in rig.cameras.values()])
    arm, P, numbers = arm_of(robot), cameras_of(rig), markers.known
    points, on_tool = np.c_[markers.points, np.ones(len(numbers))], rig.mount == TOOL
    # Parts on the tool are given in its frame, fixed ones in the frame of the base.
    base_tool = np.eye(4) if on_tool else arm.base_tool
    return Truth(
        robot=arm,
        P=P @ np.linalg.inv(arm.base_tool) if on_tool else P,
        M=points @ base_tool.T,
        number=numbers,
        face=tuple(numbers.index(number) for number in markers.front or ()) if face else (),
        center=center_in_face(markers),
        image_size=image_sizes(rig.image_size_px, tuple(rig.cameras)),
        lens=lens_of(P, *coefficients.T) if coefficients.any() else no_lenses(len(P)),
        normals=np.zeros(3) if markers.normals is None else markers.normals @ base_tool[:3, :3].T,
        view=tuple(rig.cameras),
        on_tool=on_tool,
        noise=noise,
    )


@lru_cache(maxsize=8)
def described_scene(
    robot: RobotSettings,
    rig: Rig,
    markers: Markers,
    options: RenderedOptions,
    mjcf: File | None,
    objects: tuple[Tag, ...] = (),
    moving: tuple[tuple[str, ObjectSettings], ...] = (),
) -> RenderedScene:
    """Return the scene before rendered cameras.

    mjcf : the model of the arm, None for capsules; objects : tags of objects at their places; moving :
        the objects that move.
    """
    further = [number for tag in objects for number in tag.numbers]
    return RenderedScene(
        arm=arm_of(robot),
        P=cameras_of(rig),
        size=rig.image_size_px,
        tags=markers.all_tags,
        numbers=(*markers.known, *further),
        dictionary=markers.dictionary or DICTIONARY,
        mjcf=mjcf,
        tip=robot.tip or "",
        options=options,
        view=tuple(rig.cameras),
        on_tool=rig.mount == TOOL,
        objects=objects,
        moving=tuple(scene_object(*one) for one in moving),
    )


def scene_object(name: str, one: ObjectSettings) -> SceneObject:
    """Return an object whose places in the scene are given."""
    assert one.points is not None
    return SceneObject(name, one.numbers, one.points, one.normals, one.moved, one.motion)
