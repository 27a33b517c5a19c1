"""``projservo record``: drive a robot through trial motions and write an observation table."""

from pathlib import Path
from typing import Any

import click

from projservo_cli.cli.foreign import confirm, require_terminal
from projservo_cli.cli.output import Console, print_json


def run(names: list[str], rest: list[str], options: dict[str, Any]) -> int:
    """Record what is still to be recorded; the exit code."""
    del names, rest
    if options["output"] is None:
        raise click.UsageError("record needs a table to write: --output TABLE")
    if options["joint_unit"] is not None and options["motions"] is None:
        raise click.UsageError("--joint-unit is that of --motions, which is not given")
    require_terminal(options)
    from projservo_cli.cli.configuration import SHIPPED, given_overrides, shipped
    from projservo_cli.config import load_config
    from projservo_cli.files import working_in
    from projservo_cli.stages.record import prepare, record
    from projservo_cli.tables import read_joints

    overrides = given_overrides({**options, "joint_unit": None})
    config = load_config(options["config"] or shipped(SHIPPED), overrides)
    motions = None
    if options["motions"] is not None:
        types = config.robot.joint_types if config.robot is not None else None
        motions = read_joints(options["motions"], types, options["joint_unit"])
    path = Path(options["output"])
    console = Console(quiet=options["quiet"], verbose=options["verbose"])
    recording = prepare(config, path, motions=motions, force=options["force"])
    if options["dry_run"]:
        _tell(recording, console, options)
        return 0
    with working_in(path.parent, name=f".{path.name}.lock"):
        recording = prepare(config, path, motions=motions, force=options["force"])
        if recording.pending:
            confirm(options, config, "record", console)
        if recording.found and recording.pending:
            console.say(f"{path}: continued after {recording.found} of {len(recording.targets)} poses")
        try:
            record(config, recording, progress=console.progress)
        except KeyboardInterrupt:
            console.finish()
            console.say(
                f"{path}: {len(recording.q)} of {len(recording.targets)} poses; run again to continue"
            )
            raise
        finally:
            console.finish()
        _tell(recording, console, options)
    return 0


def _tell(recording: Any, console: Console, options: dict[str, Any]) -> None:
    done = len(recording.q)
    value = {
        "table": recording.path.resolve(),
        "poses": len(recording.targets),
        "recorded": done - recording.found,
        "found": recording.found,
        "pending": len(recording.pending),
        "markers": len(recording.marker),
        "unseen": recording.unseen,
        "commands": recording.commands,
    }
    if options["json"]:
        print_json(value)
        return
    console.show(
        "record: {recorded} poses recorded, {found} there before, {pending} to be recorded; "
        "{markers} markers".format_map(value)
    )
    console.show("  unseen: {unseen} marker-view pairs; {commands} commands sent".format_map(value))
    console.show(f"table: {recording.path}")
