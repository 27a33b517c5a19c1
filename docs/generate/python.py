"""Docstrings of the Python interface as Markdown.

The project's docstrings say after the colon which argument it is, its shape and unit, not its type.
"""

import inspect
import re
from collections.abc import Iterator
from typing import Any

from projservo_cli import api, records
from projservo_cli.config import Config
from projservo_cli.control.law import Gains
from projservo_cli.experiment import Experiment
from projservo_cli.observations import Observations
from projservo_cli.results import ImageModel, MetricModel
from projservo_cli.robots.contract import Robot
from projservo_cli.stages.runs.plugin_law import LawSetup, PluginLaw
from projservo_cli.sweeps.statistics import Study

# What Python users call, in the order of a run, and the members of each class.
INTERFACE: dict[Any, tuple[str, ...]] = {
    Config: ("load", "from_dict", "replace", "pose", "plot"),
    Observations: ("from_arrays", "from_frame", "concat", "select", "to_frame"),
    api.simulate: (),
    api.record: (),
    api.calibrate: (),
    ImageModel: (
        *("predict", "jacobian", "score", "residuals", "suggest", "refitted", "displaced", "covariance"),
        *("metric", "project", "plot"),
    ),
    MetricModel: (
        *("pose", "pose_covariance", "position_std", "triangulate", "triangulation_covariance"),
        *("covariance", "in_frames_of", "errors_of", "to_xarray"),
    ),
    api.plan: (),
    api.servo: (),
    api.sweep: (),
    Study: ("table", "traces", "failures", "success", "paired", "plot", "to_frame", "to_xarray"),
    Experiment: ("make", "servo", "results", "calibration", "plan", "traces", "at_step", "report"),
    api.load: (),
    records.InputError: (),
    records.WorkFailed: (),
}
ROBOT = ("open", "read", "command", "stop", "close")
LAW = (LawSetup, PluginLaw, Gains)


def python_interface() -> Iterator[str]:
    """The functions and classes of the Python interface."""
    for item, members in INTERFACE.items():
        yield from _described(item, members)


def robot_contract() -> Iterator[str]:
    """The contract with a robot."""
    return _described(Robot, ROBOT)


def law_contract() -> Iterator[str]:
    """The contract with a control law."""
    for item in LAW:
        yield from _described(item, ())


def _described(item: Any, members: tuple[str, ...]) -> Iterator[str]:
    call = "" if inspect.isclass(item) else signature(item)
    yield from ("", f"### `{item.__name__}{call}`", "", *markdown(inspect.getdoc(item) or ""))
    for name in members:
        found = inspect.getattr_static(item, name)
        method = not isinstance(found, property) and callable(getattr(item, name))
        call = signature(getattr(item, name)) if method else ""
        about = inspect.getdoc(found) or inspect.getdoc(getattr(item, name)) or ""
        yield from ("", f"#### `{item.__name__}.{name}{call}`", "", *markdown(about))


def signature(function: Any) -> str:
    """Arguments and defaults of a function without their types."""
    found = inspect.signature(function)
    arguments = [
        argument.replace(annotation=inspect.Parameter.empty)
        for name, argument in found.parameters.items()
        if name != "self"
    ]
    return str(found.replace(parameters=arguments, return_annotation=inspect.Signature.empty))


def markdown(docstring: str) -> list[str]:
    """Lines of a docstring, its sections as lists."""
    text = re.sub(r"``(.+?)``", lambda code: f"`{' '.join(code[1].split())}`", docstring, flags=re.DOTALL)
    text = re.sub(r"\n +(?=\S)", " ", text)  # what goes on in the next line
    text = re.sub(r"^(\w[\w ]*)\n-{3,}\n", r"\n**\1**\n\n", text, flags=re.MULTILINE)
    text = re.sub(r"^(\*?\w+(?:, \w+)*) : ", lambda name: f"- `{name[1]}`: ", text, flags=re.MULTILINE)
    text = re.sub(
        r"^(\w+(?:Error|Failed)|ImageModel|Observations) (?=\w)", r"- `\1`: ", text, flags=re.MULTILINE
    )
    return re.sub(r"\n{3,}", "\n\n", text).split("\n")
