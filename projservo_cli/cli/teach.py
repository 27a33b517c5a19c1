"""The command ``teach``: images of the tool where it stands, into a goal or a start."""

import sys
from pathlib import Path
from typing import Any, Literal

import click

from projservo_cli.cli import options as option
from projservo_cli.cli.output import Console, wrapped
from projservo_cli.cli.program import main

_TAUGHT = "# Images of the cameras: projservo teach. Name this file under task.goal, or task.start.\n"


@main.command("teach", epilog="Example: projservo teach results/mine -c mine.yaml -o goal.yaml")
@click.argument("run", required=False, type=option.PATH)
@option.configuration(help="Configuration (YAML). Default: the one in RUN, otherwise paper.yaml.")
@option.override
@option.output(metavar="FILE", help="File to write (YAML). Default: goal.yaml, with --start start.yaml.")
@click.option("--start", is_flag=True, help="It is a start that is taught: task.start.")
@click.option(
    "--frames",
    metavar="N",
    type=click.IntRange(1, 1000),
    default=10,
    show_default=True,
    help="Images of each camera that are averaged.",
)
@click.option("--at", metavar="Q1,...,QN", help="Joints that a simulated robot is put to.")
@click.option(
    "--at-unit", type=click.Choice(["deg", "rad"]), default="rad", help="Unit of --at. Default: rad."
)
@option.force(help="Replace the file if there is one.")
@option.explained
def _teach(
    console: Console,
    *,
    run: Path | None,
    config: str | None,
    output: Path | None,
    start: bool,
    frames: int,
    at: str | None,
    at_unit: str,
    force: bool,
    **options: Any,
) -> None:
    """Write the images of the cameras as a goal or a start.

    Move the robot to the goal and take your hands away. Averages --frames images and writes
    their pixels, with their uncertainty and the joint readings: task.goal takes the file, task.start its
    joints. A robot that can let go of its arm does so first, if a user at the terminal can move it,
    and then holds it again. A simulated robot is put to --at.

    Checks it against the calibration in RUN, by default the run of the configuration's name in results, if
    there is one: reports markers that disagree. Exit code 1 if no joints reach the goal.
    """
    from projservo_cli.config import plain_yaml
    from projservo_cli.config.inputs import plan_inputs, teach_inputs
    from projservo_cli.messages import sentence_and_remedy
    from projservo_cli.messages.placeholders import sharing
    from projservo_cli.messages.rows_by_code import Setup
    from projservo_cli.records import InputError, WorkFailed
    from projservo_cli.settings.sections import JointVector
    from projservo_cli.stages import teach as stage
    from projservo_cli.store.files_and_locks import write_whole, writing

    output = output or Path("start.yaml" if start else "goal.yaml")
    option.require_new(output, force=force)
    settings = option.configured(config, options, run, teaching=True)
    option.say_unnamed(console)
    put = None
    if at is not None:
        try:
            joints = tuple(float(value) for value in at.split(","))
        except ValueError as error:
            raise InputError(f"--at {at}: expected a number for each joint, with commas") from error
        unit: Literal["deg", "rad"] = "deg" if at_unit == "deg" else "rad"
        put = JointVector.model_construct(joints=joints, unit=unit)  # checked against the robot
    calibrated = option.calibrated_run(run, settings)
    calibration = None if calibrated is None else calibrated.calibration
    asks = not settings.plant.simulated and sys.stdin.isatty()
    hidden = None
    with writing(output):
        try:
            taught = stage.teach(teach_inputs(settings), frames, put, console.wait if asks else None)
            if start:
                stage.require_start(taught)
            else:
                stage.require_face(settings.face_numbers, taught, settings.trajectory.min_views)
                several = settings.task is not None and bool(settings.task.goals)
                hidden = stage.require_objects(taught, one_goal=not several)
            check = None
            if calibration is not None and not start:
                check = stage.checked(plan_inputs(settings), calibration, taught)
        except WorkFailed as error:
            reason = " ".join(error.reason.split())
            value = {"file": output.resolve(), "failed": "teach", "reason": reason}
            value["findings"] = list(error.findings)
            console.report(value, ["teach: failed; no file was written"])
            raise WorkFailed(reason, stage="teach", findings=error.findings) from error
        write_whole(output, _TAUGHT + plain_yaml(taught.as_goal()))
    # Names are relative to the configuration, in the file and with --set.
    is_relative = config is not None and Path(config).resolve().parent == output.resolve().parent
    goals = {} if start or settings.task is None else settings.task.goals
    key = "start" if start else f"goals.{output.stem}" if goals else "goal"
    setting = f"set task.{key}: {output.name if is_relative else output.resolve()}"
    setting = f"goal {output.stem}: taught" if output.stem in goals else setting
    _print_taught(console, output, taught, check, setting)
    if start and taught.unseen:
        console.say(
            "teach: a recording starts with these markers unseen: turn the tool until "
            f"{sharing(taught.view)} all tags, and teach again with --force"
        )
    if hidden:
        console.say(f"teach: {sentence_and_remedy(hidden, Setup(view=taught.view))}")
    if check is not None and not check.reached:
        raise WorkFailed(f"{output}: by the calibration, {check.reason}", findings=check.findings)


def _print_taught(console: Console, path: Path, taught: Any, check: Any, setting: str) -> None:
    """Print the taught values, how they agree with the calibration, and the setting of the file."""
    import numpy as np

    value = {
        "file": path.resolve(),
        "markers": taught.marker,
        "joints": taught.q,
        "frames": taught.frames,
        "sigma_px": taught.sigma,
        "unseen": taught.unseen,
        "moved": taught.moved,
        "objects": {name: int(one.shared) for name, one in taught.objects.items()},
    }
    keys = "off_px", "far", "reached", "reason", "findings"
    value |= dict.fromkeys(keys) if check is None else check._asdict()
    certain = f", to {np.nanmax(taught.sigma):.3g} px" if np.isfinite(taught.sigma).any() else ""
    known, shared = len(taught.marker), taught.shared
    where = {1: "", 2: " in both views,"}.get(len(taught.view), " in two views,")
    count = f"{known} markers" if shared == known else f"{shared} of {known} markers{where}"
    images = [f"{frames} {name}" for frames, name in zip(taught.frames, taught.view, strict=True)]
    images[0] = f"{taught.frames[0]} images {taught.view[0]}"
    words = [f"teach: {count} from {' and '.join(images)}{certain}"]
    if taught.moved is not None:
        i = int(np.abs(taught.moved).argmax())
        words.append(
            f"  since it is held, joint {i + 1} moved by {taught.bounds.text(i, taught.moved[i], 3)}"
        )
    if unseen := ", ".join(f"{number} ({side})" for number, side in taught.unseen):
        words.append(wrapped(f"unseen: {unseen}", "  "))
    for name, one in taught.objects.items():
        words.append(f"  {name}: {one.shared} of {len(one.marker)} markers{where}".rstrip(","))
    if check is not None:
        far = ", ".join(f"{number} ({side}) by {px:.3g} px" for number, side, px in check.far)
        words.append(wrapped(check.reason, "  "))
        words.append(wrapped(f"markers that disagree with the calibration: {far or 'none'}", "  "))
    console.report(value, [*words, setting])
