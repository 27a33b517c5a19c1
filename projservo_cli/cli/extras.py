"""``projservo report --view --animation``: what a report can have beside its page."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from projservo_cli.cli.output import Console
from projservo_cli.config import Config
from projservo_cli.store import SERVO, Run

EXTRAS = ("view", "animation")


def wanted_of(options: Mapping[str, Any]) -> list[str]:
    """What the options ask for."""
    return [name for name in EXTRAS if options[name]]


def require(config: Config, options: Mapping[str, Any]) -> None:
    """Refuse before any work what cannot be made.

    Raises
    ------
    InputError
        If plotly is not installed, the robot is not known in metres, or there is no task.
    """
    if wanted_of(options):
        from projservo_cli.stages import report as extras

        extras.require(config, wanted_of(options))


def made_extras(
    config: Config, run: Run, laws: Sequence[str], wanted: Sequence[str], console: Console
) -> dict[str, Path]:
    """Write what is wanted, and the page anew, which links to it; the paths by name."""
    from projservo_cli.report.page import write_page
    from projservo_cli.stages import report as extras
    from projservo_cli.stages.chain import reported

    chosen = {name: result for name, result in run.results.items() if not laws or _is_of(name, laws)}
    shown = replace(run, results=chosen)
    makers: dict[str, Any] = {"view": extras.view, "animation": extras.animation}
    made = {}
    for name in wanted:
        console.say(f"report: making the {name}")
        made[name] = makers[name](shown, console.progress).resolve()
    told = reported(config, run, laws)
    write_page(replace(told, results={**told.results, "report": run.results["report"]}))
    return made


def _is_of(name: str, laws: Sequence[str]) -> bool:
    return not name.startswith(SERVO) or name.removeprefix(SERVO) in laws
