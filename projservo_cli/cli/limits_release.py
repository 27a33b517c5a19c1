"""Commands for arms of bus servos: ``limits`` and ``release``."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

from projservo_cli.cli import options as option
from projservo_cli.cli.output import Console
from projservo_cli.cli.program import main

if TYPE_CHECKING:
    from projservo_cli.hardware.so101 import Servos


_MAX_BYTES = 1_000_000  # maximum size of a configuration


@main.command("limits", epilog="Example: projservo limits -c arm.yaml")
@option.configuration(
    help="Configuration (YAML) of the arm, into which the limits are written.", required=True
)
@click.option(
    "--shift",
    metavar="JOINT",
    type=int,
    multiple=True,
    help="Let the servo of a joint store an offset if its range crosses the end of its turn. Repeatable.",
)
@option.explained
def _limits(console: Console, *, config: str, shift: tuple[int, ...]) -> None:
    """Find joint limits by hand and write them.

    Lets go of an arm of bus servos. The user moves each joint through its allowed range, ten seconds per
    joint, and presses Enter. The limits go into the file under robot.limits; its comments and other keys
    stay. Nothing is ever moved beyond them.
    """
    from projservo_cli.config.editing import with_limits
    from projservo_cli.hardware import taught_limits
    from projservo_cli.store.files_and_locks import text_of, write_whole

    path = Path(config).resolve()  # the file itself if the name is a link
    text = text_of(Path(config), "a configuration", _MAX_BYTES)
    with_limits(text, [], config)  # before the user moves the arm for it
    with _servos(console, config, text) as servos:
        taught_limits.require_known(shift, len(servos.ids))
        console.wait("take hold of the arm: it will be released")
        servos.release()
        moved = taught_limits.watch(
            servos, _entered(console, "move joint after joint through all that is allowed, ten seconds each")
        )
        limits = taught_limits.limits_deg(servos, moved, shift)
    written = with_limits(text, limits, config)
    _require_limits(written, limits, config)
    write_whole(path, written)
    words = [f"limits: joint {k} {low:g} to {high:g} deg" for k, (low, high) in enumerate(limits, 1)]
    value = {"configuration": path, "limits_deg": limits, "shifted": sorted(shift)}
    console.report(value, [*words, f"written to {config}: robot.limits"])


def _require_limits(text: str, limits_deg: list[tuple[float, float]], config: str) -> None:
    """Raise InputError if an edited configuration does not have these limits, with the lines to write."""
    from projservo_cli.config import load_config
    from projservo_cli.records import InputError

    pairs = [[low, high] for low, high in limits_deg]
    try:
        robot = load_config(config, text=text, teaching=True).robot
        limits = robot.limits.joints if robot is not None and robot.limits is not None else None
        wrong = "" if [*map(list, limits or ())] == pairs else config
    except InputError as error:
        wrong = str(error)
    if wrong:
        raise InputError(
            f"{wrong}: the limits were found and not written: put them under robot yourself, limits: "
            f"{{joints: {pairs}, unit: deg}}"
        )


@main.command("release", epilog="Example: projservo release -c arm.yaml")
@option.configuration(help="Configuration (YAML) of the arm.", required=True)
@option.explained
def _release(console: Console, *, config: str) -> None:
    """Let go of an arm of bus servos.

    Switches the torque of all its servos off, the gripper's too. The arm falls unless someone holds it.
    """
    from projservo_cli.findings import REFUSES, Finding
    from projservo_cli.messages import failed
    from projservo_cli.store.files_and_locks import text_of

    text = text_of(Path(config), "a configuration", _MAX_BYTES)
    with _servos(console, config, text, whole=False) as servos:
        console.wait("take hold of the arm, and of the object in its gripper: they will be released")
        servos.release(all_of_them=True)
        lost = tuple(map(servos.finding, sorted(servos.lost)))
    console.report({"released": servos.alive}, ["release: done" if not lost else "release: not of all"])
    if lost:
        raise failed([Finding("unreleased_servos", REFUSES, others=lost)], stage="release")


@contextmanager
def _servos(console: Console, config: str, text: str, *, whole: bool = True) -> Iterator["Servos"]:
    """Connect to the servos of a configuration, and report at the end whether their torque is on.

    whole : whether all servos must answer.
    """
    from projservo_cli import plugins
    from projservo_cli.config.editing import named_plant
    from projservo_cli.hardware.so101 import SO101, connected, torque_reported
    from projservo_cli.messages import sentence_and_remedy
    from projservo_cli.records import InputError

    use, options = named_plant(text, config)
    if (name := plugins.short_name(use)) != "so101":
        raise InputError(f"plant {name}: is no arm of bus servos: set plant: so101")
    arm = plugins.called("plant", name, SO101, (), options)
    with connected(arm, whole=whole) as servos:
        try:
            yield servos
        finally:
            console.say(sentence_and_remedy(torque_reported(servos)[0]))


def _entered(console: Console, what: str) -> Callable[[], bool]:
    """Ask the user to act; return a function that reports whether Enter came since."""
    came, obstacles = threading.Event(), list[BaseException]()

    def ask() -> None:
        try:
            console.wait(what)
        except BaseException as error:  # raised where the program waits for Enter
            obstacles.append(error)
        came.set()

    def done() -> bool:
        if obstacles:
            raise obstacles[0]
        return came.is_set()

    threading.Thread(target=ask, daemon=True).start()
    return done
