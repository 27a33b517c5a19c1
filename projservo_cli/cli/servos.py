"""Commands for arms of bus servos: ``limits`` and ``release``."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from projservo_cli.cli import options as option
from projservo_cli.cli.group import main
from projservo_cli.cli.output import Console

if TYPE_CHECKING:
    from projservo_cli.config import Config
    from projservo_cli.hardware.so101 import Servos


@main.command("limits", epilog="Example: projservo limits -c arm.yaml")
@option.configuration(
    help="Configuration (YAML) of the arm, into which the limits are written.", required=True
)
@click.option(
    "--shift",
    metavar="JOINT",
    type=int,
    multiple=True,
    help="Let the servo of a joint store an offset where its range crosses the end of its turn. Repeatable.",
)
@option.explained
def _limits(console: Console, *, config: str, shift: tuple[int, ...]) -> None:
    """Find joint limits by hand and write them.

    Lets go of an arm of bus servos. Somebody moves each joint through all that is allowed, ten seconds a
    joint, and presses Enter. The limits go into the file under robot.limits; its comments and other keys
    stay. Nothing is ever moved beyond them.
    """
    from projservo_cli.config import load_config
    from projservo_cli.config.editing import with_limits
    from projservo_cli.files import write_whole
    from projservo_cli.hardware import joint_limits

    path = Path(config)
    with _servos(console, load_config(path, teaching=True)) as servos:
        joint_limits.require_known(shift, len(servos.ids))
        console.wait("take hold of the arm: it will be released")
        servos.release()
        moved = joint_limits.watch(
            servos, _entered(console, "move joint after joint through all that is allowed, ten seconds each")
        )
        limits = joint_limits.limits_deg(servos, moved, shift)
    write_whole(path, with_limits(path.read_text(encoding="utf-8"), limits, config))
    words = [f"limits: joint {k} {low:g} to {high:g} deg" for k, (low, high) in enumerate(limits, 1)]
    value = {"configuration": path.resolve(), "limits_deg": limits, "shifted": sorted(shift)}
    console.report(value, [*words, f"written to {path}: robot.limits"])


@main.command("release", epilog="Example: projservo release -c arm.yaml")
@option.configuration(help="Configuration (YAML) of the arm.", required=True)
@option.explained
def _release(console: Console, *, config: str) -> None:
    """Let go of an arm of bus servos.

    Switches the torque of all its servos off, the gripper's too. The arm falls where nobody holds it.
    """
    from projservo_cli.config import load_config

    with _servos(console, load_config(config, teaching=True)) as servos:
        console.wait("take hold of the arm, and of what its gripper holds: they will be released")
        servos.release(all_of_them=True)
    console.report({"released": list(servos.all)}, ["release: done"])


@contextmanager
def _servos(console: Console, config: "Config") -> Iterator["Servos"]:
    """Connect to the servos of a configuration, and report at the end whether their torque is on."""
    from projservo_cli.hardware.so101 import SO101, connected, torque_reported
    from projservo_cli.records import InputError, WorkFailed
    from projservo_cli.robots import plugins

    name = plugins.short_name(config.plant.use or "")
    if name != "so101":
        raise InputError(f"plant {name or 'simulated'}: is no arm of bus servos: set plant: so101")
    options: dict[str, Any] = dict(config.plant.options)
    with connected(SO101(**options)) as servos:
        try:
            yield servos
        except WorkFailed as error:
            raise WorkFailed(f"{error}; nothing was written") from error
        finally:
            console.say(torque_reported(servos))


def _entered(console: Console, what: str) -> Callable[[], bool]:
    """Ask the user to act; return a function that tells whether Enter came since."""
    came = threading.Event()

    def ask() -> None:
        console.wait(what)
        came.set()

    threading.Thread(target=ask, daemon=True).start()
    return came.is_set
