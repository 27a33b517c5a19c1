"""URDF import: the joint screws of an arm that a URDF describes, read by its XML alone.

An arm is what ``robot.screws`` takes: the joint screws at a reference and the pose of a tip there.
"""

import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from projservo_cli.records import FloatArray, InputError

_MOVING = {"revolute": "R", "continuous": "R", "prismatic": "P"}


def read_urdf(path: str, tip: str, text: str) -> dict[str, Any]:
    """Screws of the joints of a URDF from its root to a link, as ``robot.screws`` takes them.

    text : of the file. Raises InputError if it is no URDF, there is no such link, or a joint on the chain to
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
        raise InputError(f"{path}: there is no link {tip}; links: {listed(links)}")
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
        joints.append(
            joint_screw(_MOVING[kind], name, T[:3, :3] @ axis / np.linalg.norm(axis), T[:3, 3], limits)
        )
    if not joints:
        raise InputError(f"{path}: no joint moves link {tip}")
    return arm_screws(joints, np.zeros(len(joints)), T)


class UrdfChain(NamedTuple):
    """Joints of a URDF from its root to a link, at readings of zero."""

    root: str  # name of the first link
    axes: FloatArray  # (n, 6) screws, rad and m
    tip: FloatArray  # (4, 4) pose of the link, m


def urdf_chain(path: str, tip: str | None, text: str) -> UrdfChain:
    """Joints of a URDF from its root to a link, by default the last one.

    Raises InputError as ``read_urdf``, or if several links are last.
    """
    try:
        root = ET.fromstring(text)
    except ET.ParseError as error:
        raise InputError(f"{path}: not XML: {error}") from error
    joints, links = root.findall("joint"), [link.get("name", "") for link in root.findall("link")]
    above = {
        _of(joint, "child", "link", "", path): _of(joint, "parent", "link", "", path) for joint in joints
    }
    if tip is None:
        ends = [name for name in links if name not in above.values()]
        if len(ends) != 1:
            raise InputError(f"{path}: has {len(ends)} last links ({listed(ends)}): name one as the tip")
        tip = ends[0]
    arm, first = read_urdf(path, tip, text), tip
    while first in above:
        first = above.pop(first)
    axes = np.array([[*joint["w"], *joint["v"]] for joint in arm["joints"]])
    return UrdfChain(first, axes, np.array(arm["base_tool"]))


def joint_screw(
    kind: str, name: str, axis: FloatArray, point: FloatArray, limits: Sequence[float] | None
) -> dict[str, Any]:
    """A joint along or about an axis (3,) through a point (3,), m."""
    axis = np.asarray(axis) / np.linalg.norm(axis)
    w, v = (np.zeros(3), axis) if kind == "P" else (axis, np.cross(point, axis))
    given = (
        {} if limits is None else {"limits_m" if kind == "P" else "limits_rad": [float(x) for x in limits]}
    )
    return {"type": kind, "name": name or None, "w": w.tolist(), "v": v.tolist(), **given}


def arm_screws(joints: list[dict[str, Any]], q: FloatArray, tool: FloatArray) -> dict[str, Any]:
    """An arm of joints at a reference (n,), and the pose (4, 4) of its tool there, as ``robot.screws``."""
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
    given = _of(joint, tag, key, default, path)
    try:
        values = np.array([float(part) for part in given.split()])
    except ValueError:
        values = np.array([math.nan])
    many = len(default.split())
    if len(values) != many or not np.isfinite(values).all():
        name = joint.get("name", "")
        raise InputError(f"{path}: joint {name}: {key} of its {tag} is {given!r}: expected {many} numbers")
    return values


def listed(names: Sequence[str]) -> str:
    """Up to thirty names, for a message."""
    displayed = ", ".join(name for name in names[:30] if name)
    return displayed + (" …" if len(names) > 30 else "")
