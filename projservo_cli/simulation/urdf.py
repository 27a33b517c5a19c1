"""URDF import: the joint screws of an arm that a URDF describes, read by its XML alone.

An arm is given as in ``robot.screws``: the joint screws at a reference and the pose of a tip there.
"""

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from projservo_cli.records import FloatArray, InputError

_MOVING = {"revolute": "R", "continuous": "R", "prismatic": "P"}
_MACRO = ("${", "$(")  # marks of xacro expressions in attributes


def read_urdf(path: str, tip: str, content: bytes) -> dict[str, Any]:
    """Screws of the joints of a URDF from its root to a link, as ``robot.screws`` takes them.

    content : of the file, as bytes in the encoding that it declares.
    Raises InputError if it is no URDF or no tree, there is no such link, or a joint on the chain to it is
    none of those that turn or slide by themselves, or has limits without bounds.
    """
    return _arm(path, *_chain(path, tip, content), bounded=True)


class UrdfChain(NamedTuple):
    """Joints of a URDF from its root to a link, at readings of zero."""

    root: str  # name of the first link
    axes: FloatArray  # (n, 6) screws, rad and m
    tip: FloatArray  # (4, 4) pose of the link, m


def urdf_chain(path: str, tip: str | None, content: bytes) -> UrdfChain:
    """Joints of a URDF from its root to a link, by default the last one; limits do not count.

    Raises InputError as ``read_urdf``, or if several links are last.
    """
    links, chain = _chain(path, tip, content)
    arm = _arm(path, links, chain, bounded=False)
    axes = np.array([[*joint["w"], *joint["v"]] for joint in arm["joints"]])
    return UrdfChain(links[0], axes, np.array(arm["base_tool"]))


def _arm(path: str, links: list[str], chain: list[ET.Element], *, bounded: bool) -> dict[str, Any]:
    """Screws of the joints of a chain of links, root to tip.

    bounded : whether joints that turn or slide within limits must state both.
    """
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
        limits = _limits(joint, path) if bounded and kind != "continuous" else None
        joints.append(
            joint_screw(_MOVING[kind], name, T[:3, :3] @ axis / np.linalg.norm(axis), T[:3, 3], limits)
        )
    if not joints:
        raise InputError(f"{path}: no joint moves link {links[-1]}")
    return arm_screws(joints, np.zeros(len(joints)), T)


def _chain(path: str, tip: str | None, content: bytes) -> tuple[list[str], list[ET.Element]]:
    """Names of the links from the root of a URDF to one, by default the only last one, and joints between.

    Raises InputError if several links are last, there is no such link, or links and joints are no tree.
    """
    links, above = _tree(path, content)
    if tip is None:
        parents = {_link(joint, "parent", path) for joint in above.values()}
        ends = [name for name in links if name not in parents]
        if len(ends) != 1:
            raise InputError(f"{path}: has {len(ends)} last links ({listed(ends)}): name one as the tip")
        tip = ends[0]
    if tip not in links and tip not in above:
        raise InputError(f"{path}: there is no link {tip}; links: {listed(links)}")
    names, chain = [tip], list[ET.Element]()
    while names[0] in above:
        chain.insert(0, above.pop(names[0]))
        names.insert(0, _link(chain[0], "parent", path))
        if names[0] == tip:
            raise InputError(f"{path}: joint {chain[0].get('name')} closes a loop of links: a URDF is a tree")
    return names, chain


def _tree(path: str, content: bytes) -> tuple[list[str], dict[str, ET.Element]]:
    """Names of the links of a URDF, and the joint above each but the root, by the name of the link."""
    root = _parsed(path, content)
    links, joints = (
        [element.get("name", "") for element in root.findall(kind)] for kind in ("link", "joint")
    )
    for kind, names in (("link", links), ("joint", joints)):
        if twice := [name for name in dict.fromkeys(names) if names.count(name) > 1]:
            count = names.count(twice[0])
            raise InputError(f"{path}: {kind} {twice[0]} occurs {count} times: keep one")
    above: dict[str, ET.Element] = {}
    for joint in root.findall("joint"):
        link = _link(joint, "child", path)
        if link in above:
            raise InputError(
                f"{path}: link {link} has two parent joints, {above[link].get('name')} and "
                f"{joint.get('name')}: a URDF is a tree; remove the one that closes the loop"
            )
        above[link] = joint
    for joint in above.values():
        if links and (link := _link(joint, "parent", path)) not in (*links, *above):
            raise InputError(
                f"{path}: joint {joint.get('name')}: there is no link {link}, its parent; links: "
                f"{listed(links)}"
            )
    return links, above


def _parsed(path: str, content: bytes) -> ET.Element:
    """The outermost element of a URDF, in the encoding that the file declares."""
    try:
        try:
            root = ET.fromstring(content)
        except ValueError:  # encodings of several bytes, which the parser leaves to its caller
            declared = re.search(rb"""encoding\s*=\s*["']([\w.:-]+)""", content[:200])
            root = ET.fromstring(content.decode(declared[1].decode() if declared else "utf-8"))
    except (ET.ParseError, LookupError, ValueError) as error:
        raise InputError(
            f"{path}: not XML: {error}; its text must be in the encoding that its first line declares, by "
            "default UTF-8"
        ) from error
    if root.tag != "robot":
        raise InputError(f"{path}: not a URDF: its outermost element is {root.tag}, not robot")
    spaces = {str(name).partition("}")[0] for e in root.iter() for name in (e.tag, *e.keys()) if "}" in name}
    used = [part for name in ("joint", "link") for element in root.findall(name) for part in element.iter()]
    values = [value for e in (root, *used) for value in e.attrib.values()]
    if any(space.endswith("xacro") for space in spaces) or any(mark in v for v in values for mark in _MACRO):
        raise InputError(f"{path}: is a xacro file: expand it first, xacro {Path(path).name} > robot.urdf")
    return root


def joint_screw(
    kind: str, name: str, axis: FloatArray, point: FloatArray, limits: Sequence[float] | None
) -> dict[str, Any]:
    """A joint along or about an axis (3,) through a point (3,), m."""
    axis = np.asarray(axis) / np.linalg.norm(axis)
    w, v = (np.zeros(3), axis) if kind == "P" else (axis, np.cross(point, axis))
    bounds = (
        {} if limits is None else {"limits_m" if kind == "P" else "limits_rad": [float(x) for x in limits]}
    )
    return {"type": kind, "name": name or None, "w": w.tolist(), "v": v.tolist(), **bounds}


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


def _limits(joint: ET.Element, path: str) -> list[float]:
    """Lower and upper limit of a joint, rad or m."""
    name, element = joint.get("name", ""), joint.find("limit")
    if missing := [key for key in ("lower", "upper") if element is None or element.get(key) is None]:
        raise InputError(
            f"{path}: joint {name} of type {joint.get('type')} has no {' and no '.join(missing)} limit: give "
            "lower and upper in its element limit, rad or m; a joint that turns without end is continuous"
        )
    lower, upper = (float(_numbers(joint, "limit", key, "0", path)[0]) for key in ("lower", "upper"))
    if not lower < upper:
        raise InputError(
            f"{path}: joint {name}: its lower limit, {lower:g}, is not below its upper, {upper:g}"
        )
    return [lower, upper]


def _link(joint: ET.Element, end: str, path: str) -> str:
    """Name of the link at an end of a joint, parent or child."""
    return _attribute(joint, end, "link", "", path)


def _attribute(joint: ET.Element, tag: str, key: str, default: str, path: str) -> str:
    """An attribute of an element of a joint."""
    elements = joint.findall(tag)
    if len(elements) > 1:
        raise InputError(
            f"{path}: joint {joint.get('name', '')} has {len(elements)} elements {tag}: keep one"
        )
    value = elements[0].get(key, default) if elements else default
    if not value:
        raise InputError(f"{path}: joint {joint.get('name', '')}: its {tag} has no {key}")
    return value


def _numbers(joint: ET.Element, tag: str, key: str, default: str, path: str) -> FloatArray:
    """The numbers in an attribute of an element of a joint."""
    text = _attribute(joint, tag, key, default, path)
    try:
        values = np.array([float(part) for part in text.split()])
    except ValueError:
        values = np.array([math.nan])
    many = len(default.split())
    if len(values) != many or not np.isfinite(values).all():
        name = joint.get("name", "")
        raise InputError(f"{path}: joint {name}: {key} of its {tag} is {text!r}: expected {many} numbers")
    return values


def listed(names: Sequence[str]) -> str:
    """Up to thirty names, for a message."""
    displayed = ", ".join(name for name in names[:30] if name)
    return displayed + (" …" if len(names) > 30 else "")
