"""Edits of a configuration file that keep its comments and all other keys."""

from collections.abc import Callable, Sequence
from typing import Any

import yaml

from projservo_cli.records import InputError


def with_limits(text: str, limits_deg: Sequence[tuple[float, float]], where: str) -> str:
    """Return the text of a configuration with joint limits (n, 2), deg, under ``robot.limits``.

    where : of the text, for messages. Raises InputError for a text that is no mapping.
    """
    pairs = ", ".join(f"[{low:g}, {high:g}]" for low, high in limits_deg)
    value = f"{{joints: [{pairs}], unit: deg}}"
    root = _parsed(yaml.compose, text, where)
    if not isinstance(root, yaml.MappingNode):
        raise InputError(f"{where}: expected keys and values such as plant: so101")
    robot = _value(root, "robot")
    if robot is None:
        return f"{text.rstrip()}\n\nrobot:\n  limits: {value}\n"
    if not isinstance(robot, yaml.MappingNode):
        return _replaced(text, robot, f"{{limits: {value}}}")
    limits = _value(robot, "limits")
    if limits is not None:
        return _replaced(text, limits, value)
    at = robot.start_mark.index + bool(robot.flow_style)
    divider = ", " if robot.flow_style and robot.value else "\n" + " " * robot.start_mark.column
    return f"{text[:at]}limits: {value}{divider if robot.value else ''}{text[at:]}"


def named_plant(text: str, where: str) -> tuple[str, dict[str, Any]]:
    """Return the plant of a configuration and its options, ignoring the rest of the text.

    An arm can be released, and its limits be found, with a file that has other faults.
    where : of the text, for messages. Raises InputError for a text that is no YAML.
    """
    root = _parsed(yaml.compose, text, where)
    if [key.value for key, _ in getattr(root, "value", ()) if key.value == "plant"][1:]:
        raise InputError(f"{where}: plant occurs twice; keep one")
    values = _parsed(yaml.safe_load, text, where)
    plant = values.get("plant") if isinstance(values, dict) else None
    if isinstance(plant, str):
        return plant, {}
    options = plant.get("options") if isinstance(plant, dict) else None
    name = plant.get("use") if isinstance(plant, dict) else None
    return str(name or "simulated"), dict(options) if isinstance(options, dict) else {}


def _parsed(parse: Callable[[str], Any], text: str, where: str) -> Any:
    """Parse a text. Raises InputError for one that is no YAML."""
    try:
        return parse(text)
    except yaml.YAMLError as error:
        raise InputError(f"{where}: {' '.join(str(error).split())}") from error


def _value(node: yaml.MappingNode, key: str) -> Any:
    """Return the node of a key; None if there is none."""
    return next((value for name, value in node.value if name.value == key), None)


def _replaced(text: str, node: yaml.Node, value: str) -> str:
    """Return a text with another value in the place of a node; comments after it stay."""
    before = text[: node.start_mark.index]
    if isinstance(node, yaml.MappingNode) and not node.flow_style:
        before = before.rstrip() + " "  # a value on the line of its key
    elif node.start_mark.index == node.end_mark.index:  # a key without a value
        value = f" {value}"
    return f"{before}{value}{text[_end(node) :]}"


def _end(node: yaml.Node) -> int:
    """Place after the last character of a node; the end of a block includes comments after it."""
    if isinstance(node, yaml.CollectionNode) and not node.flow_style and node.value:
        last = node.value[-1]
        return _end(last[1] if isinstance(last, tuple) else last)
    return int(node.end_mark.index)
