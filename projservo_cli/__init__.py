"""Uncalibrated stereo visual servoing in projective space.

The method follows A. Ruf and R. Horaud, "Vision-based Guidance and Control of Robots in
Projective Space", ECCV 2000, cited below as [RH00].
"""

from typing import TYPE_CHECKING, Any

from projservo_cli.provenance import __version__

if TYPE_CHECKING:
    from projservo_cli.api import calibrate, load, plan, record, servo, simulate, sweep
    from projservo_cli.config import Config
    from projservo_cli.experiment import Experiment
    from projservo_cli.observations import Observations
    from projservo_cli.records import InputError, WorkFailed
    from projservo_cli.robots.flange_robot import PoseRefused

_PLACES = {
    "Config": "config",
    "Experiment": "experiment",
    "InputError": "records",
    "Observations": "observations",
    "PoseRefused": "robots.flange_robot",
    "WorkFailed": "records",
    **dict.fromkeys(("calibrate", "load", "plan", "record", "servo", "simulate", "sweep"), "api"),
}

__all__ = [
    "Config",
    "Experiment",
    "InputError",
    "Observations",
    "PoseRefused",
    "WorkFailed",
    "__version__",
    "calibrate",
    "load",
    "plan",
    "record",
    "servo",
    "simulate",
    "sweep",
]


def __getattr__(name: str) -> Any:
    """Import a name on its first use, so that importing the package stays light."""
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"projservo_cli.{_PLACES[name]}"), name)


def __dir__() -> list[str]:
    return [*__all__]
