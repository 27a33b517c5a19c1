"""Robots and laws of others on the command line: code runs where a user names it, motion where one asks."""

import sys
from collections.abc import Sequence
from typing import Any

import click

from projservo_cli.cli.output import Console
from projservo_cli.records import InputError, law_and_mode
from projservo_cli.robots import plugins


def law_names(names: Sequence[str]) -> tuple[str, ...]:
    """The laws of ``--law``, each once, registered names as the classes they stand for."""
    from projservo_cli.control import LAWS

    found = {name: name if name in LAWS else plugins.target_of("law", name) for name in names}
    for name, target in found.items():
        if target is None:
            valid = ", ".join((*LAWS, *plugins.registered("law")))
            raise click.UsageError(f"--law {name}: no such law; laws: {valid}, or module:Class")
    return tuple(dict.fromkeys(target for target in found.values() if target is not None))


def require_asked(options: dict[str, Any], config: Any, steps: Sequence[Any]) -> None:
    """Refuse to start code that only a stored run names, or motion that no stage asks for; import the rest.

    A run file may come from anybody: what is stored in it is shown and compared, never imported.

    Raises
    ------
    InputError
        Where it is refused, or a class cannot be found.
    """
    from projservo_cli.control import CODES
    from projservo_cli.robots.yours import METHODS

    servo = [step for step in steps if step.stage == "servo" and step.why]
    laws = [law_and_mode(step.law)[0] for step in servo]
    wanted = {("law", law): f"--law {law}" for law in laws if law not in CODES}
    if servo and config.plant.use is not None:
        wanted["plant", config.plant.use] = f"--set plant={config.plant.use}"
    named = None if options["config"] else _given(options)
    for (kind, target), flag in wanted.items():
        if named is not None and (kind, target) not in named:
            raise InputError(
                f"{kind} {target} is named by the stored run alone, which starts no code: give the "
                f"configuration again with -c, or {flag}"
            )
    for kind, target in wanted:
        plugins.find(kind, target, METHODS if kind == "plant" else ("__call__",))


def require_named(config: Any, steps: Sequence[Any], names: Sequence[str]) -> None:
    """Refuse to move a robot that is not simulated unless the stage that does so is named."""
    if config.plant.use is None or "servo" in names:
        return
    for step in steps:
        if step.stage == "servo" and step.why:
            raise InputError(
                f"{names[-1]} needs a run of {step.law} ({step.why}), which moves {config.plant.use}: "
                "run projservo servo first"
            )


def _given(options: dict[str, Any]) -> set[tuple[str, str | None]]:
    """Robots and laws that the options name."""
    from projservo_cli.config import Override

    found: set[tuple[str, str | None]] = {("law", name) for name in law_names(options["laws"])}
    for override in map(Override.parse, options["sets"]):
        kind = {"plant": "plant", "control": "law"}.get(str(override.path[0]))
        if kind is not None:
            found |= {(kind, plugins.target_of(kind, text)) for text in _texts(override.value)}
    return found


def _texts(value: Any) -> list[str]:
    if isinstance(value, str):
        return [value]
    inner = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return [text for item in inner for text in _texts(item)]


def require_terminal(options: dict[str, Any]) -> None:
    """Refuse ``--confirm`` where nobody can answer."""
    if options["confirm"] and not sys.stdin.isatty():
        raise click.UsageError(
            "--confirm: standard input is no terminal, so nobody can be asked; leave it out"
        )


def confirm(options: dict[str, Any], config: Any, what: str, console: Console) -> None:
    """Ask before the first motion, where ``--confirm`` is given.

    Raises
    ------
    KeyboardInterrupt
        Where the answer is not yes.
    """
    if not options["confirm"]:
        return
    console.finish()
    robot = config.plant.use or "the simulated robot"
    try:
        agreed = click.confirm(
            f"{what} will move {robot}, speeds times {config.plant.speed_scale:g}. Go?", err=True
        )
    except click.Abort:
        agreed = False
    if not agreed:
        console.say("not confirmed: nothing was moved")
        raise KeyboardInterrupt
