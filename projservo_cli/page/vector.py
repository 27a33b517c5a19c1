"""A figure's SVG as part of a page: no names that clash, nothing that runs or is fetched."""

import re
import xml.etree.ElementTree as ET
from typing import Any

from markupsafe import Markup

_SVG = "{http://www.w3.org/2000/svg}"
_HREF = "{http://www.w3.org/1999/xlink}href"
_SHAPES = ("path", "use", "rect", "circle", "ellipse", "line", "polyline", "polygon", "image")
_ELEMENTS = frozenset((*_SHAPES, "svg", "g", "defs", "clipPath", "pattern"))
_PLACES = ("x", "y", "width", "height", "cx", "cy", "r", "rx", "ry", "x1", "x2", "y1", "y2", "points", "d")
_PAINTS = ("style", "fill", "stroke", "opacity", "clip-path", "transform", "patternUnits")
_ATTRIBUTES = frozenset((*_PLACES, *_PAINTS, "id", "href", "preserveAspectRatio"))
_PICTURE = "data:image/png;base64,"
_REFERENCE = re.compile(r"url\(#([\w.:-]+)\)")


def inline(svg: bytes, prefix: str, alt: str) -> Markup | None:
    """An SVG image to stand within HTML; None where the file is not one.

    Only shapes and what paints them are kept, so that the file of a stranger can neither run a
    script nor fetch anything; references lead to names that start with ``prefix``.

    Parameters
    ----------
    svg : content of the file.
    prefix : unlike those of all other images of the page.
    alt : what the image shows, for those who do not see it.
    """
    try:
        root = ET.fromstring(svg)
    except ET.ParseError:
        return None
    if root.tag != f"{_SVG}svg" or "viewBox" not in root.attrib:
        return None
    view = " ".join(root.attrib["viewBox"].split())
    used = _references(root)
    _clean(root, prefix, used)
    root.attrib.clear()
    root.attrib.update({"viewBox": view, "role": "img", "aria-label": alt})
    return Markup(ET.tostring(root, encoding="unicode"))


def _references(root: ET.Element) -> set[str]:
    """Names that something in the image refers to."""
    found: set[str] = set()
    for element in root.iter():
        for name, value in element.attrib.items():
            if name in (_HREF, "href") and value.startswith("#"):
                found.add(value[1:])
            elif "url(" in value:
                found.update(_REFERENCE.findall(value))
    return found


def _clean(element: ET.Element, prefix: str, used: set[str]) -> None:
    element.tag = element.tag.removeprefix(_SVG)
    element.text = element.tail = None
    kept = {}
    for name, value in element.attrib.items():
        name = "href" if name == _HREF else name
        text = _attribute(name, value, prefix, used)
        if text is not None:
            kept[name] = text
    element.attrib.clear()
    element.attrib.update(kept)
    for child in list(element):
        tag: Any = child.tag  # of a comment it is a function
        if isinstance(tag, str) and tag.startswith(_SVG) and tag.removeprefix(_SVG) in _ELEMENTS:
            _clean(child, prefix, used)
        else:
            element.remove(child)


def _attribute(name: str, value: str, prefix: str, used: set[str]) -> str | None:
    """The value of an attribute as the page has it; None where it is to go."""
    if name not in _ATTRIBUTES:
        return None
    value = " ".join(value.split())
    if name == "id":
        return prefix + value if value in used else None
    if name == "href":
        return f"#{prefix}{value[1:]}" if value.startswith("#") else _picture(value)
    changed = _REFERENCE.sub(rf"url(#{prefix}\1)", value)
    foreign = _REFERENCE.sub("", value).lower()
    return None if any(sign in foreign for sign in ("url", "@", "\\", "expression")) else changed


def _picture(value: str) -> str | None:
    return value.replace(" ", "") if value.startswith(_PICTURE) else None
