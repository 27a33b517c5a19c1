"""Rendered cameras: the scene before them, an arm with tags and light, and the frames that they take."""

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.linalg import rq
from scipy.spatial.transform import Rotation

from projservo_cli.detection.finders import TagFinder
from projservo_cli.geometry.lens import undistort
from projservo_cli.records import CORNERS, VIEWS, ByteArray, FloatArray, InputError, IntArray
from projservo_cli.result_hashes import File
from projservo_cli.settings.markers import Tag
from projservo_cli.settings.plant import RenderedOptions
from projservo_cli.simulation.arm import SerialArm, roll_axis
from projservo_cli.simulation.ground_truth import SceneObject
from projservo_cli.simulation.mjcf import chain_of, compiled, mujoco, no_gl, spec_of, tip_of

# Thickness of the first link of an arm and of the last, in lengths of the arm, and of none in any.
_THICK, _THIN, _LEAST_LINK_M = 0.05, 0.03, 1e-3
# Colours of links, and of the holder of the tags.
_LINK, _HOLDER = (0.75, 0.5, 0.25, 1.0), (0.3, 0.3, 0.3, 1.0)
_PLATE_M, _ROD_M = 5e-4, 4e-3  # half the thickness of a tag, and of the rod that holds it
_TOOL_DENSITY = 500.0  # kg/m³
_SCENE_TAGS = "scene with tags"  # name of the body of tags in the scene
_SIDES = ("front", "back")  # sides of a plate: the tag, and its opaque back
# Picture of a tag: where it has more pixels than the frame, edges along its rows are drawn a tenth of
# a pixel off.
_CELL_PX = 4
# Inertia of rotors of joints without, kg m² or kg: at most, and as a share of the heaviest joint's.
_ARMATURE, _ARMATURE_SHARE = 0.1, 0.05
_SENSOR_M = 1e-5  # width of a pixel of a camera's sensor; only ratios to it matter
_NO_SKEW = 1e-9  # skew of a camera's pixels by rounding
_NEAR_M, _FAR_M = 0.01, 50.0  # range of cameras
_WALL, _WALL_M = "far wall", 40.0  # background, and its distance
_FINER = 2
"""Pixels of a drawing along each of a frame: of one alone, edges are drawn up to a tenth of a pixel off."""
AT_OPENING = np.zeros(1)  # instants of a frame, s, unless they are given
_STILL = 1e-5  # rad or m: smaller motions in an exposure cause no blur


@dataclass(frozen=True, eq=False)
class RenderedScene:
    """Scene and settings of rendered cameras."""

    arm: SerialArm
    P: FloatArray  # (V, 3, 4) cameras, px, from the base frame or, of those on the tool, from its frame
    size: tuple[int, int]  # width and height of the images, px
    tags: tuple[Tag, ...]
    numbers: tuple[int, ...]  # numbers of the markers, four corners per tag, objects last
    dictionary: str  # dictionary of the tags
    mjcf: File | None  # the model of the arm, with the files that it names; None for one of capsules
    tip: str  # body or site of the model that is the tool
    options: RenderedOptions
    view: tuple[str, ...] = VIEWS  # names of the views
    on_tool: bool = False  # whether the cameras are on the tool, and the tags are fixed in the base frame
    objects: tuple[Tag, ...] = ()  # further tags, in the base frame
    moving: tuple[SceneObject, ...] = ()  # objects with some of these that move, which are there at time 0


@dataclass(frozen=True, eq=False)
class RenderedModel:
    """A compiled model, and the meaning of its parts."""

    scene: RenderedScene
    finder: TagFinder
    model: Any  # MjModel, which stays unchanged
    key: int  # number of the keyframe that is its beginning, −1 for none
    joints: IntArray  # (n,) its joints of the arm, base to tool
    plates: tuple[tuple[int, ...], ...]  # for each tag the geoms that are its plate
    margin: int  # widening of drawings at each side, px
    tool: FloatArray  # (3, 3) rotation of the frame of the tags in the frame of the body that holds them
    moving: tuple[int, ...] = ()  # bodies of the objects that move

    @property
    def positions(self) -> IntArray:
        """Places (n,) of the joints among all positions."""
        return np.asarray(self.model.jnt_qposadr[self.joints])

    @property
    def rates(self) -> IntArray:
        """Places (n,) of the joints among all velocities."""
        return np.asarray(self.model.jnt_dofadr[self.joints])

    def begin(self, model: Any, q: FloatArray) -> Any:
        """Data of a model like this one at its beginning, the arm at joints (n,), rad or m."""
        mj = mujoco()
        data = mj.MjData(model)
        if self.key >= 0:
            mj.mj_resetDataKeyframe(model, data, self.key)
        data.qpos[self.positions] = q
        mj.mj_forward(model, data)
        return data


def _decomposed(P: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Intrinsic matrix K (3, 3), rotation R (3, 3) and translation t (3,), m, of a metric camera (3, 4)."""
    K, R = rq(P[:, :3])
    signs = np.diag(np.sign(np.diag(K)))
    K, R = K @ signs, signs @ R
    t = np.linalg.solve(K, P[:, 3])
    return np.asarray(K / K[2, 2]), np.asarray(R), np.asarray(t)


def lens_of(P: FloatArray, k1: npt.ArrayLike, k2: npt.ArrayLike = 0.0) -> FloatArray:
    """Lenses (V, 5) of metric cameras (V, 3, 4), with k1 and k2 (V,) in units of the focal length."""
    K = np.array([_decomposed(camera)[0] for camera in P])
    radius = np.sqrt(K[:, 0, 0] * K[:, 1, 1])
    return np.column_stack([K[:, 0, 2], K[:, 1, 2], radius, *(np.full(len(P), k) for k in (k1, k2))])


@lru_cache(maxsize=4)
def rendered_model(scene: RenderedScene) -> RenderedModel:
    """The compiled model of a scene.

    Raises InputError if MuJoCo or OpenCV is missing, or the scene cannot be made.
    """
    mj, finder, P = mujoco(), TagFinder(scene.dictionary), scene.P
    where = scene.mjcf.path if scene.mjcf else "the arm"
    spec = spec_of(where) if scene.mjcf else mj.MjSpec()
    if not scene.mjcf:
        _add_arm(spec, scene.arm)
    bare = compiled(spec, where)
    if scene.mjcf:
        holder, tool = tip_of(bare, scene.tip, where)
    else:
        holder, tool = bare.nbody - 1, scene.arm.base_tool
    joints = np.array(chain_of(bare, holder, where))
    tip = next(body for body in spec.bodies if body.id == holder)
    # Tags and cameras: one on the tool, the other in the base frame.
    body, place = (spec.worldbody, np.eye(4)) if scene.on_tool else (tip, tool)
    _add_tags(body, spec, place, scene.tags, finder, in_scene=scene.on_tool)
    for name, tags in _objects_of(scene):
        _add_tags(spec.worldbody, spec, np.eye(4), tags, finder, in_scene=True, name=name)
    at_reference = np.linalg.inv(scene.arm.base_tool) if scene.on_tool else np.eye(4)
    _put_light(spec, scene.options.light, P @ at_reference)
    K, R, t = (np.array(parts) for parts in zip(*map(_decomposed, P), strict=True))
    width, height = scene.size
    margin = _margin(P, scene.options.k1, width, height)
    K_wide = K + margin * np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    carrier = (tip, tool) if scene.on_tool else (spec.worldbody, np.eye(4))
    _add_cameras(spec, carrier, scene.view, (K_wide, R, t), (width + 2 * margin, height + 2 * margin))
    model = compiled(spec, where)
    rates = model.jnt_dofadr[joints]
    light = rates[model.dof_armature[rates] == 0.0]
    model.dof_armature[light] = min(_ARMATURE, _ARMATURE_SHARE * float(model.dof_M0[rates].max()))
    mj.mj_setConst(model, mj.MjData(model))
    plates = tuple(tuple(model.geom(_name(tag, side)).id for side in _SIDES) for tag in scene.tags)
    return RenderedModel(
        scene=scene,
        finder=finder,
        model=model,
        key=0 if model.nkey else -1,
        joints=joints,
        plates=plates,
        margin=margin,
        tool=place[:3, :3],
        moving=tuple(model.body(_SCENE_TAGS + one.name).id for one in scene.moving),
    )


def _objects_of(scene: RenderedScene) -> list[tuple[str, list[Tag]]]:
    """Tags of the objects that rest, which are one body, and of each that moves, with its name."""
    owner = {number: one.name for one in scene.moving for number in one.number}
    names = [owner.get(tag.numbers[0], "") for tag in scene.objects]
    return [
        (name, [tag for tag, of in zip(scene.objects, names, strict=True) if of == name])
        for name in dict.fromkeys(names)
    ]


def _add_arm(spec: Any, arm: SerialArm) -> None:
    """Add an arm of capsules.

    Every body has the axes of the base at the reference, where joints have their readings; a link reaches
    from the point of one joint's axis that is nearest to the link before to the point of the next.
    """
    mj = mujoco()
    spec.compiler.degree = False
    points, axes = [np.zeros(3)], []
    for twist, slides in zip(arm.H_hat_0, arm.prismatic, strict=True):
        w, v = np.array([twist[2, 1], twist[0, 2], twist[1, 0]]), twist[:3, 3]
        axes.append(v if slides else w)
        foot = points[-1] if slides else np.cross(w, v)
        points.append(foot + axes[-1] * (axes[-1] @ (points[-1] - foot)))
    points.append(arm.base_tool[:3, 3])
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    thickness = np.linspace(_THICK, _THIN, len(lengths)) * max(float(lengths.sum()), _LEAST_LINK_M)
    body = spec.worldbody
    for i, radius in enumerate(thickness):
        if i > 0:
            body = body.add_body(name=f"link {i}")
            slides = arm.prismatic[i - 1]
            body.add_joint(
                name=f"joint {i}",
                type=mj.mjtJoint.mjJNT_SLIDE if slides else mj.mjtJoint.mjJNT_HINGE,
                pos=points[i],
                axis=axes[i - 1],
                ref=arm.q_reference[i - 1],
            )
        sights = {"rgba": _LINK, "contype": 0, "conaffinity": 0}
        if lengths[i] > _LEAST_LINK_M:
            ends = [*points[i], *points[i + 1]]
            body.add_geom(type=mj.mjtGeom.mjGEOM_CAPSULE, size=[radius, 0, 0], fromto=ends, **sights)
        else:
            body.add_geom(type=mj.mjtGeom.mjGEOM_SPHERE, size=[radius, 0, 0], pos=points[i], **sights)


def _camera_name(view: str) -> str:
    """Name of a camera in the model."""
    return f"{view} camera"


def _name(tag: Tag, side: str) -> str:
    return f"tag {tag.number} {side}"


def _add_tags(
    holder: Any,
    spec: Any,
    tool: FloatArray,
    tags: Sequence[Tag],
    finder: TagFinder,
    *,
    in_scene: bool,
    name: str = "",
) -> None:
    """Hang tags on a body of a specification.

    tool : (4, 4) pose of their frame in its own, m; in_scene : whether that is the frame of the base.
    """
    mj = mujoco()
    body = holder.add_body(name=_SCENE_TAGS + name if in_scene else "tool with tags")
    origin = tool[:3, 3]
    if in_scene:  # rods meet behind the tags
        origin = np.mean([np.array(tag.pose)[:3, 3] - tag.size_m * tag.normal for tag in tags], 0)
    if not any(material.name == "tag holder" for material in spec.materials):
        spec.add_material(name="tag holder", rgba=_HOLDER, specular=0.0)

    def add(shape: Any, material: str, **values: Any) -> None:
        """A geom without contacts, for any defaults of the file."""
        body.add_geom(
            type=shape, material=material, group=0, contype=0, conaffinity=0, density=_TOOL_DENSITY, **values
        )

    for tag in tags:
        picture = finder.picture(tag.number, _CELL_PX)
        half = 0.5 * tag.size_m * len(picture) / (len(picture) - 2 * _CELL_PX)
        pose, name = tool @ np.array(tag.pose), _name(tag, "front")
        texture = spec.add_texture(
            name=name, type=mj.mjtTexture.mjTEXTURE_2D, width=len(picture), height=len(picture), nchannel=3
        )
        texture.data = np.repeat(picture[..., None], 3, axis=2).tobytes()
        material = spec.add_material(name=name, specular=0.0)
        material.textures[mj.mjtTextureRole.mjTEXROLE_RGB] = name
        quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True)
        # All faces of a box show its texture.
        for side, depth, sights in zip(_SIDES, (1.0, 3.0), (name, "tag holder"), strict=True):
            place = pose[:3, 3] - depth * _PLATE_M * pose[:3, 2]
            size = [half, half, _PLATE_M]
            add(mj.mjtGeom.mjGEOM_BOX, sights, name=_name(tag, side), size=size, pos=place, quat=quaternion)
        behind = pose[:3, 3] - 4.0 * _PLATE_M * pose[:3, 2]
        if np.linalg.norm(behind - origin) > _LEAST_LINK_M:
            ends = [*origin, *behind]
            add(mj.mjtGeom.mjGEOM_CYLINDER, "tag holder", size=[_ROD_M, 0.0, 0.0], fromto=ends)


def _put_light(spec: Any, light: str, P: FloatArray) -> None:
    """Light from all around and a little from above, or hard light from one side of the rig alone."""
    mj = mujoco()
    for original in list(spec.lights):
        spec.delete(original)
    head, soft = spec.visual.headlight, light == "soft"
    head.active = 1
    head.ambient, head.diffuse, head.specular = (
        [0.45 if soft else 0.15] * 3,
        [0.3 if soft else 0.0] * 3,
        [0.0] * 3,
    )
    up = np.array([0.0, 0.0, 1.0])
    shines = -up
    if not soft:
        _, ahead = roll_axis(P)
        side = np.cross(ahead, up) if abs(ahead @ up) < 0.9 else np.array([0.0, 1.0, 0.0])
        shines = side / np.linalg.norm(side) + 0.5 * ahead - 0.3 * up
    spec.worldbody.add_light(
        type=mj.mjtLightType.mjLIGHT_DIRECTIONAL,
        dir=shines / np.linalg.norm(shines),
        pos=-5.0 * shines,
        diffuse=[0.25 if soft else 0.9] * 3,
        specular=[0.0] * 3,
        castshadow=not soft,
    )


def _drawn_at(P: FloatArray, lens: FloatArray, pixels: FloatArray) -> FloatArray:
    """Return pixels (V, N, 2) of cameras (V, 3, 4) and lenses (V, 5) in drawings without lens and skew."""
    straight = undistort(lens, pixels).copy()
    for view, camera in enumerate(P):
        K, _, _ = _decomposed(camera)
        skew = K[0, 1] if abs(K[0, 1]) > _NO_SKEW * K[0, 0] else 0.0
        straight[view, :, 0] -= skew * (straight[view, :, 1] - K[1, 2]) / K[1, 1]
    return straight


def _margin(P: FloatArray, k1: float, width: int, height: int) -> int:
    """Return the margin of a drawing around the field of a lens, px."""
    u, v = np.linspace(0.0, width - 1.0, 65), np.linspace(0.0, height - 1.0, 65)
    sides = [(x, y) for x in u for y in v[[0, -1]]] + [(x, y) for x in u[[0, -1]] for y in v]
    drawn = _drawn_at(P, lens_of(P, k1), np.array([sides] * len(P)))
    if not np.isfinite(drawn).all():
        raise InputError("plant.options.k1: a lens that bends so much does not show the whole image")
    beyond = max(-float(drawn.min()), float((drawn - [width - 1.0, height - 1.0]).max()))
    return 0 if beyond <= 0.0 else math.ceil(beyond) + 2


def _add_cameras(
    spec: Any,
    carrier: tuple[Any, FloatArray],
    view: Sequence[str],
    cameras: tuple[FloatArray, FloatArray, FloatArray],
    size: tuple[int, int],
) -> None:
    """Add the cameras of a rig, whose images have a size, px.

    carrier : the body that they are on, and the pose (4, 4) of their frame in its own, m.
    cameras : (V, 3, 3) intrinsic matrices, (V, 3, 3) rotations and (V, 3) translations, m.
    """
    mj, (body, pose), (K, R, t) = mujoco(), carrier, cameras
    width, height = size
    spec.add_material(name=_WALL, rgba=[0.25, 0.25, 0.25, 1.0], emission=1.0, specular=0.0)
    for name, K_v, R_v, t_v in zip(view, K, R, t, strict=True):
        axes = pose[:3, :3] @ R_v.T
        camera = body.add_camera(name=_camera_name(name), pos=pose[:3, 3] - axes @ t_v)
        camera.alt.type = mj.mjtOrientation.mjORIENTATION_XYAXES
        camera.alt.xyaxes = [*axes[:, 0], *-axes[:, 1]]
        camera.resolution = size
        camera.sensor_size = [width * _SENSOR_M, height * _SENSOR_M]
        camera.focal_pixel = [K_v[0, 0], K_v[1, 1]]
        camera.principal_pixel = [0.5 * (width - 1) - K_v[0, 2], 0.5 * (height - 1) - K_v[1, 2]]
        # A grey wall far behind: drawn in a quarter of the time of a sky.
        wall = body.add_geom(
            type=mj.mjtGeom.mjGEOM_BOX, material=_WALL, contype=0, conaffinity=0, density=0.0
        )
        wall.pos, wall.size = camera.pos + _WALL_M * axes[:, 2], [_WALL_M, _WALL_M, _PLATE_M]
        wall.alt.type, wall.alt.xyaxes = camera.alt.type, camera.alt.xyaxes
    spec.stat.extent = 1.0
    visual = spec.visual
    visual.map.znear, visual.map.zfar = _NEAR_M, _FAR_M
    visual.global_.offwidth, visual.global_.offheight = _FINER * width, _FINER * height
    visual.quality.offsamples = 0  # the means of finer pixels do as much


class Frames:
    """The cameras of a scene, which a thread opens, looks with and closes.

    ``rendered``: their scene. ``last``: (V, height, width) the last frames of each.
    """

    borders = True

    def __init__(self, rendered: RenderedModel) -> None:
        scene = rendered.scene
        self.rendered, self._finder, self._scene = rendered, rendered.finder, scene
        self._places = {number: i for i, number in enumerate(scene.numbers)}
        width, height = scene.size
        self.last: ByteArray = np.zeros((len(scene.P), height, width), dtype=np.uint8)
        self._maps = self._mapped(scene.P)
        self._renderer: Any = None

    def open(self) -> None:
        """Prepare to draw, in the drawing thread; an InputError names the packages to install."""
        mj, rendered = mujoco(), self.rendered
        height, width = self.last.shape[1] + 2 * rendered.margin, self.last.shape[2] + 2 * rendered.margin
        try:
            self._renderer = mj.Renderer(rendered.model, _FINER * height, _FINER * width)
        except Exception as error:  # another class for each library of GL
            raise InputError(no_gl(error)) from error
        self._renderer.scene.flags[mj.mjtRndFlag.mjRND_SHADOW] = self._scene.options.light == "side"
        # a file's skybox takes longer than the rest
        self._renderer.scene.flags[mj.mjtRndFlag.mjRND_SKYBOX] = 0
        self._model = copy.copy(rendered.model)
        self._data = rendered.begin(self._model, rendered.model.qpos0[rendered.positions])
        self._shown = mj.MjvOption()
        self._shown.sitegroup[:] = 0

    def close(self) -> None:
        """Release the renderer."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def capture(
        self,
        view: int,
        q: FloatArray,
        moved: tuple[int, FloatArray] | None,
        rng: np.random.Generator,
        times: FloatArray = AT_OPENING,
    ) -> tuple[FloatArray, FloatArray]:
        """Pixels (m, 2) that are found in a frame, NaN where unseen, and their deviations (m,), px.

        q : (k, n) joints at instants of its exposure, rad or m; times : these (k,), s.
        moved : number of a marker whose tag was moved, and by how much in the frame of the tool, (3,) m.
        """
        self._move(moved)
        still = np.abs(q - q[len(q) // 2]).max() < _STILL and not self.rendered.moving
        shots_at = list(zip(q, times.tolist(), strict=True))
        shots = [self._drawn(view, *at) for at in (shots_at[len(q) // 2 :][:1] if still else shots_at)]
        image = np.mean(shots, axis=0, dtype=np.float32)
        cv = self._finder.cv
        if self._scene.options.blur_px > 0.0:
            image = cv.GaussianBlur(image, (0, 0), self._scene.options.blur_px)
        image += np.float32(self._scene.options.grey_noise) * rng.standard_normal(
            image.shape, dtype=np.float32
        )
        self.last[view] = np.clip(np.rint(image), 0, 255).astype(np.uint8)
        return self._found(view)

    def _found(self, view: int) -> tuple[FloatArray, FloatArray]:
        """Pixels (m, 2) of the corners in the last frame of a view, NaN where unseen, and deviations (m,)."""
        pixels, sigma = np.full((len(self._places), 2), np.nan), np.full(len(self._places), np.nan)
        tags, _ = self._finder.find(self.last[view].astype(np.float64))
        for number, tag in tags.items():
            for k in range(CORNERS):
                if (place := self._places.get(CORNERS * number + k)) is not None:
                    pixels[place], sigma[place] = tag.pixels[k], tag.sigma[k]
        return pixels, sigma

    def _drawn(self, view: int, q: FloatArray, time: float) -> ByteArray:
        """Return the grey values (height, width) of a camera at joints (n,), without blur and noise."""
        mj = mujoco()
        for body, one in zip(self.rendered.moving, self._scene.moving, strict=True):
            T = one.at(time) @ np.linalg.inv(one.T)
            self._model.body_pos[body] = T[:3, 3]
            self._model.body_quat[body] = Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True)
        self._data.qpos[self.rendered.positions] = q
        mj.mj_kinematics(self._model, self._data)
        mj.mj_camlight(self._model, self._data)
        self._renderer.update_scene(self._data, _camera_name(self._scene.view[view]), self._shown)
        # Tags, their holder and light have no colour: green alone gives grey.
        fine, cv = np.ascontiguousarray(self._renderer.render()[..., 1]), self._finder.cv
        if self._maps is not None:
            fine = cv.remap(fine, *self._maps[view], cv.INTER_LANCZOS4)
        return np.asarray(cv.resize(fine, self._scene.size, interpolation=cv.INTER_AREA))

    def _move(self, moved: tuple[int, FloatArray] | None) -> None:
        """Put every plate where it is, but for one that was moved."""
        self._model.geom_pos[:] = self.rendered.model.geom_pos
        if moved is not None:
            plate = self.rendered.plates[self._places[moved[0]] // CORNERS]
            self._model.geom_pos[list(plate)] += self.rendered.tool @ moved[1]

    def _mapped(self, P: FloatArray) -> list[tuple[FloatArray, FloatArray]] | None:
        """Return the places of finer pixels of a frame in the drawing, u and v of each view."""
        width, height = _FINER * self._scene.size[0], _FINER * self._scene.size[1]
        offset = 0.5 * (_FINER - 1)  # centres of pixels have whole coordinates
        u, v = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
        pixels = (np.stack([u, v], axis=-1).reshape(-1, 2) - offset) / _FINER
        lens = lens_of(P, self._scene.options.k1)
        drawn = _drawn_at(P, lens, np.stack([pixels] * len(P)))
        if all(np.array_equal(one, pixels) for one in drawn):
            return None
        finer = (_FINER * (drawn + self.rendered.margin) + offset).astype(np.float32)
        maps = finer.reshape(-1, height, width, 2)
        return [(np.ascontiguousarray(both[..., 0]), np.ascontiguousarray(both[..., 1])) for both in maps]
