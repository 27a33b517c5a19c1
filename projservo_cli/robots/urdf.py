"""Arms that files of other programs describe: URDF by its XML alone, MJCF by MuJoCo.

Each is read as what ``robot.screws`` takes: the joint screws at a reference and the pose of a tip there.
"""

import math
import os
import sys
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from projservo_cli.records import FloatArray, InputError

_MOVING = {"revolute": "R", "continuous": "R", "prismatic": "P"}


def mujoco() -> Any:
    """The module of MuJoCo, which draws without a display where there is none.

    Raises InputError, with what to install, where it is missing or too old.
    """
    if "mujoco" not in sys.modules and sys.platform == "linux":
        if not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
            os.environ.setdefault("MUJOCO_GL", "egl")
    try:
        import mujoco as module
    except ImportError as error:
        what = "too old or broken" if "mujoco" not in str(error.name) else "missing"
        raise InputError(f"MuJoCo is {what}: pip install '.[mujoco]' ({error})") from error
    except AttributeError as error:  # MuJoCo up to 3 looks for the library of GL where it is imported
        raise InputError(no_gl(error)) from error
    if tuple(map(int, module.__version__.split(".")[:2])) < (3, 7):
        raise InputError(f"MuJoCo {module.__version__} is older than 3.7: pip install -U '.[mujoco]'")
    return module


def no_gl(error: BaseException) -> str:
    """What to install where nothing can be drawn."""
    told = " ".join(str(error).split())
    return (
        "MuJoCo finds no OpenGL to draw with: apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri, "
        f"MUJOCO_GL=egl ({type(error).__name__}: {told:.120})"
    )


def spec_of(path: str) -> Any:
    """The specification in an MJCF file; an InputError in one line where there is none."""
    try:
        return mujoco().MjSpec.from_file(path)
    except ValueError as error:
        raise InputError(f"{path}: MuJoCo cannot read it: {_line(error)}") from error


def compiled(spec: Any, path: str) -> Any:
    """The model of a specification; an InputError in one line where it is none."""
    try:
        return spec.compile()
    except ValueError as error:
        raise InputError(f"{path}: MuJoCo cannot compile it: {_line(error)}") from error


def _line(error: BaseException) -> str:
    return " ".join(str(error).split())[:300]


def tip_of(model: Any, tip: str, where: str) -> tuple[int, FloatArray]:
    """Body of a compiled MJCF that holds a tip, by its number, and the pose (4, 4) of the tip in it, m.

    tip : a body, or a site on one. Raises InputError if there is none of this name.
    """
    mj, pose = mujoco(), np.eye(4)
    body = int(mj.mj_name2id(model, mj.mjtObj.mjOBJ_BODY, tip))
    if body > 0:
        return body, pose
    site = int(mj.mj_name2id(model, mj.mjtObj.mjOBJ_SITE, tip))
    if site < 0:
        bodies = _listed([model.body(i).name for i in range(1, model.nbody)])
        sites = _listed([model.site(i).name for i in range(model.nsite)])
        raise InputError(f"{where}: there is no body {tip}; bodies: {bodies}; sites: {sites or 'none'}")
    pose[:3, :3] = Rotation.from_quat(model.site_quat[site], scalar_first=True).as_matrix()
    pose[:3, 3] = model.site_pos[site]
    return int(model.site_bodyid[site]), pose


def chain_of(model: Any, body: int, where: str) -> list[int]:
    """Joints of a compiled MJCF from its base to a body, by their numbers.

    Raises InputError if no joint moves it, or one neither turns nor slides.
    """
    mj, told = mujoco(), model.body(body).name
    chain: list[int] = []
    while body:
        first = int(model.body_jntadr[body])
        chain[:0] = range(first, first + int(model.body_jntnum[body]))
        body = int(model.body_parentid[body])
    for joint in chain:
        if mj.mjtJoint(int(model.jnt_type[joint])) not in (mj.mjtJoint.mjJNT_HINGE, mj.mjtJoint.mjJNT_SLIDE):
            name = model.joint(joint).name or joint
            raise InputError(f"{where}: joint {name}, on the way to {told}, has more than one axis")
    if not chain:
        raise InputError(f"{where}: no joint moves body {told}")
    return chain


def read_mjcf(path: str, tip: str) -> dict[str, Any]:
    """Screws of the joints of an MJCF file from its base to a body or site, as ``robot.screws`` takes them.

    Raises InputError as of ``tip_of`` and ``chain_of``, or if there is no such file.
    """
    mj = mujoco()
    model = compiled(spec_of(path), path)
    body, held = tip_of(model, tip, path)
    chain, data = chain_of(model, body, path), mj.MjData(model)
    mj.mj_kinematics(model, data)
    joints = []
    for i in chain:
        slides = mj.mjtJoint(int(model.jnt_type[i])) == mj.mjtJoint.mjJNT_SLIDE
        limits = model.jnt_range[i] if model.jnt_limited[i] else None
        kind = "P" if slides else "R"
        joints.append(_joint(kind, model.joint(i).name, data.xaxis[i], data.xanchor[i], limits))
    tool = np.eye(4)
    tool[:3, :3], tool[:3, 3] = data.xmat[body].reshape(3, 3), data.xpos[body]
    return _screws(joints, model.qpos0[model.jnt_qposadr[chain]], tool @ held)


def read_urdf(path: str, tip: str, text: str) -> dict[str, Any]:
    """Screws of the joints of a URDF from its root to a link, as ``robot.screws`` takes them.

    text : of the file. Raises InputError if it is no URDF, there is no such link, or a joint on the way to
    it is none of those that turn or slide by themselves.
    """
    try:
        root = ET.fromstring(text)
    except ET.ParseError as error:
        raise InputError(f"{path}: not XML: {error}") from error
    if "xacro" in text and ("${" in text or "xacro:" in text):
        raise InputError(f"{path}: is a xacro file: expand it first, xacro {Path(path).name} > robot.urdf")
    if root.tag != "robot":
        raise InputError(f"{path}: not a URDF: its outermost element is {root.tag}, not robot")
    links = [link.get("name", "") for link in root.findall("link")]
    above = {_of(joint, "child", "link", "", path): joint for joint in root.findall("joint")}
    if tip not in links and tip not in above:
        raise InputError(f"{path}: there is no link {tip}; links: {_listed(links)}")
    chain: list[ET.Element] = []
    link = tip
    while link in above:
        chain.insert(0, above.pop(link))
        link = _of(chain[0], "parent", "link", "", path)
    T, joints = np.eye(4), []
    for joint in chain:
        T = T @ _origin(joint, path)
        name, kind = joint.get("name", ""), joint.get("type", "")
        if joint.find("mimic") is not None:
            raise InputError(
                f"{path}: joint {name} mimics another, and only joints that move alone are taken"
            )
        if kind == "fixed":
            continue
        if kind not in _MOVING:
            raise InputError(f"{path}: joint {name} is of type {kind}; taken are {', '.join(_MOVING)}, fixed")
        axis = _numbers(joint, "axis", "xyz", "1 0 0", path)
        if not np.linalg.norm(axis) > 0.0:
            raise InputError(f"{path}: joint {name}: its axis is zero")
        limits = None
        if kind != "continuous" and joint.find("limit") is not None:
            limits = [float(_numbers(joint, "limit", key, "0", path)[0]) for key in ("lower", "upper")]
        joints.append(_joint(_MOVING[kind], name, T[:3, :3] @ axis / np.linalg.norm(axis), T[:3, 3], limits))
    if not joints:
        raise InputError(f"{path}: no joint moves link {tip}")
    return _screws(joints, np.zeros(len(joints)), T)


def _joint(
    kind: str, name: str, axis: FloatArray, point: FloatArray, limits: Sequence[float] | None
) -> dict[str, Any]:
    """A joint along or about an axis (3,) through a point (3,), m."""
    axis = np.asarray(axis) / np.linalg.norm(axis)
    w, v = (np.zeros(3), axis) if kind == "P" else (axis, np.cross(point, axis))
    given = (
        {} if limits is None else {"limits_m" if kind == "P" else "limits_rad": [float(x) for x in limits]}
    )
    return {"type": kind, "name": name or None, "w": w.tolist(), "v": v.tolist(), **given}


def _screws(joints: list[dict[str, Any]], q: FloatArray, tool: FloatArray) -> dict[str, Any]:
    reference = {"joints": q.tolist(), "unit": "rad"}
    return {"reference": reference, "base_tool": tool.tolist(), "joints": joints}


def _origin(joint: ET.Element, path: str) -> FloatArray:
    """Pose (4, 4) of a joint in the link above it, m."""
    T = np.eye(4)
    rpy = _numbers(joint, "origin", "rpy", "0 0 0", path)
    T[:3, :3] = Rotation.from_euler("xyz", rpy).as_matrix()
    T[:3, 3] = _numbers(joint, "origin", "xyz", "0 0 0", path)
    return T


def _of(joint: ET.Element, tag: str, key: str, default: str, path: str) -> str:
    """An attribute of an element of a joint."""
    found = joint.find(tag)
    value = default if found is None else found.get(key, default)
    if not value:
        raise InputError(f"{path}: joint {joint.get('name', '')}: its {tag} has no {key}")
    return value


def _numbers(joint: ET.Element, tag: str, key: str, default: str, path: str) -> FloatArray:
    """The numbers in an attribute of an element of a joint."""
    told = _of(joint, tag, key, default, path)
    try:
        values = np.array([float(part) for part in told.split()])
    except ValueError:
        values = np.array([math.nan])
    many = len(default.split())
    if len(values) != many or not np.isfinite(values).all():
        name = joint.get("name", "")
        raise InputError(f"{path}: joint {name}: {key} of its {tag} is {told!r}: expected {many} numbers")
    return values


def _listed(names: Sequence[str]) -> str:
    shown = ", ".join(name for name in names[:30] if name)
    return shown + (" …" if len(names) > 30 else "")
