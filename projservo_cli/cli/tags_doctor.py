"""Commands for hardware of people: ``tags``, and ``doctor`` for a robot with its cameras."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from projservo_cli.cli import options as option
from projservo_cli.cli.output import Console, wrapped
from projservo_cli.cli.program import FAILED, main

if TYPE_CHECKING:
    from projservo_cli.config import Config
    from projservo_cli.hardware.checks_at_rest import RobotAtRest
    from projservo_cli.records import FloatArray
    from projservo_cli.robots.contract import PluginRobot
    from projservo_cli.stages.doctor import Checked
    from projservo_cli.store.run_file import Run

_SIZE_MM = 30.0  # size of tags that webcams at arm's length see with 25 px or more
_BODIES = ("roof", "plate")


@main.command("tags", epilog="Example: projservo tags --kind roof --size-mm 30 -o tags.pdf")
@option.output(metavar="FILE", help="PDF to write. Default: tags.pdf.")
@click.option(
    "--kind",
    type=click.Choice(["single", *_BODIES]),
    default="single",
    show_default=True,
    help="Tags to cut out one by one; a plate of 2x2; a roof of five to fold and glue.",
)
@click.option(
    "--size-mm",
    metavar="S",
    type=option.NumberRange(5.0, 150.0),
    default=_SIZE_MM,
    show_default=True,
    help="Side of the black square of each tag.",
)
@option.dictionary(help="The tags, such as APRILTAG_36H11.")
@click.option(
    "--numbers", metavar="N,...", help="Single tags to print, such as 0-4,7. Default: as many as fit."
)
@click.option(
    "--paper", type=click.Choice(["a4", "letter"]), default="a4", show_default=True, help="Its size."
)
@option.force(help="Replace the file if there is one.")
@option.explained
def _tags(
    console: Console,
    *,
    output: Path | None,
    kind: str,
    size_mm: float,
    dictionary: str,
    numbers: str | None,
    paper: str,
    force: bool,
) -> None:
    """Write a sheet of tags in true scale.

    Print it in actual size (100 %) and hold a ruler against the one on it. With --kind roof the sheet is a
    net: cut along full lines, fold back along dashed ones, glue. Such a roof or plate needs no measured pose:
    the last line above the tags is its part of the configuration. Needs OpenCV: pip install '.[detect]'.
    """
    import numpy as np

    from projservo_cli.detection.finders import TagFinder
    from projservo_cli.hardware import tag_sheets as sheets
    from projservo_cli.settings.markers import GROUND, Markers
    from projservo_cli.store.files_and_locks import write_whole

    if numbers is not None and kind != "single":
        raise click.UsageError(
            f"--numbers: is for --kind single; a {kind} has the tags of markers.tags: {kind}"
        )
    output = output or Path("tags.pdf")
    if output.suffix.lower() != ".pdf":
        raise click.UsageError(f"{output}: name a PDF to write, such as {output.stem or 'tags'}.pdf")
    option.require_new(output, force=force)
    finder, margin = TagFinder(dictionary), GROUND * size_mm
    size_m = round(1e-3 * size_mm, 6)
    own = "" if dictionary == "4X4_50" else f", dictionary: {dictionary}"
    if kind == "single":
        wanted = None if numbers is None else sheets.numbers_of(numbers)
        net = sheets.single(wanted, finder.known, size_mm, margin, paper)
        corners = f"[{', '.join(str(4 * net.tags[0].number + k) for k in range(4))}, ...]"
        keys = f"markers: {{numbers: {corners}, tag_size_m: {size_m:g}{own}}}"
    else:
        described = Markers.model_validate({"tags": kind, "tag_size_m": size_m}).all_tags
        poses, known = np.array([tag.pose for tag in described]), [tag.number for tag in described]
        net = sheets.unfolded(known, poses) if kind == "roof" else sheets.plate(known, poses, margin)
        keys = f"markers: {{tags: {kind}, tag_size_m: {size_m:g}{own}}}"
    body = "" if kind == "single" else f"{kind} of "
    head = (
        f"projservo: {body}{dictionary} tags of {size_mm:g} mm",
        *_INSTRUCTIONS[kind],
        keys,
    )
    figure = sheets.sheet(net, finder, size_mm, paper, head)
    write_whole(output, sheets.pdf(figure))
    value = {
        "file": output.resolve(),
        "kind": kind,
        "tags": [tag.number for tag in net.tags],
        "size_m": size_m,
        "dictionary": dictionary,
        "paper": paper,
    }
    words = (
        f"tags: {len(net.tags)} of {size_mm:g} mm on {paper} in {output}",
        "print in actual size (100 %), hold a ruler against the one printed",
        f"configuration: {keys}",
    )
    console.report(value, words)


_INSTRUCTIONS = {
    "single": ("Cut along the lines; leave the white margin. Glue each on a stiff, flat plate on the tool.",),
    "plate": ("Cut along the line; leave the white margin. Glue it on a stiff, flat plate on the tool.",),
    "roof": (
        "Cut along full lines. Fold back (print outside) along dashed lines. Glue flaps “glue” behind the",
        "tag next to it. Fold the flaps “base” inwards and glue them on a plate on the tool.",
        "Tag 0, in the middle, looks forward.",
    ),
}


def doctor(
    console: Console,
    run: Path | None,
    config: str,
    options: Mapping[str, Any],
    output: Path,
) -> int:
    """Check the robot and cameras of a configuration, write the page, and return the exit code.

    options : sets, move and watch of ``doctor``.
    """
    from projservo_cli.config.inputs import preflight_inputs
    from projservo_cli.report.image_pages import preflight_page
    from projservo_cli.stages.doctor import check
    from projservo_cli.store.files_and_locks import write_whole, writing

    settings = option.configured(config, options, teaching=True)
    stored = option.calibrated_run(run, settings)
    move, watch = options["move"], options["watch"]
    with writing(output):
        checked = check(
            preflight_inputs(settings),
            None if stored is None else stored.calibration,
            confirmed=(lambda way: console.agreed(_QUESTION.format(way=way))) if move else None,
            watch=(lambda robot: _watch(console, settings, robot)) if watch else None,
            progress=console.progress,
        )
        pictures = {} if checked.seen is None else _pictures(settings, checked.seen)
        rows = checked.rows
        write_whole(output, preflight_page(settings.name, rows, pictures))
    refit = _refit(checked, stored, config, output)
    value = {
        "page": output.resolve(),
        "works": checked.works,
        "findings": rows,
        "refit": refit,
    }
    console.report(value, [*_table(rows), f"page: {output}", *(refit["commands"] if refit else ())])
    if stored is not None and checked.refuted is not None:
        _note_refuted(stored.path, checked.refuted)
    return 0 if checked.works else FAILED


def _refit(checked: "Checked", stored: "Run | None", config: str, output: Path) -> dict[str, Any] | None:
    """Write the poses from which a camera that moved is fitted again; their file and the commands."""
    from projservo_cli.store.files_and_locks import write_whole
    from projservo_cli.store.observation_tables import to_csv

    if checked.refit is None or stored is None:
        return None
    view, found = checked.refit
    path, run = output.with_name("refit_poses.csv"), stored.path.parent
    write_whole(path, to_csv({f"q{i}": column for i, column in enumerate(found.q.T, 1)}))
    alone = "--set calibration.frames_per_joint=0 --set calibration.random_poses=0"
    commands = [
        f"projservo record -c {config} {alone} --motions {path} --output refit.csv",
        f"projservo calibrate {run} --refit {view} --data refit.csv -o {run}_refit",
    ]
    return {"view": view, "poses": path.resolve(), "count": len(found.q), "commands": commands}


def _note_refuted(path: Path, refuted: str) -> None:
    """Store the contradiction of a run's recording, empty if none, if it has changed."""
    from projservo_cli.store.files_and_locks import working_in
    from projservo_cli.store.run_file import load, save

    with working_in(path.parent):
        run = load(path)
        if refuted != run.refuted:
            save(replace(run, refuted=refuted))


_QUESTION = (
    "doctor will move each joint by {way} to either side, one after the other. Is the arm free all around, "
    "with room to each limit?"
)


def _table(rows: Sequence[Mapping[str, str]]) -> Iterator[str]:
    width = max(len(row["where"]) for row in rows)
    for row in rows:
        head = f"{row['level']:8}{row['where']:{width + 2}}"
        yield head + wrapped(row["text"], " " * len(head))[len(head) :]
        if row["remedy"]:
            yield wrapped(row["remedy"], " " * len(head))
    faults = sum(row["level"] == "fault" for row in rows)
    mend = f"doctor: {faults} fault{'s' * (faults > 1)} to mend before recording"
    yield mend if faults else "doctor: ready to record"


def _goal_pixels(settings: "Config", view: Sequence[str]) -> "list[FloatArray]":
    """Pixels (g, 2) of the taught goal in the images of some views; none if there is none."""
    import numpy as np

    images = None if settings.task is None else settings.task.goal.images
    sides = [None if images is None else images.side(name) for name in view]
    return [np.array([at or (np.nan, np.nan) for at in side or ()]).reshape(-1, 2) for side in sides]


def _pictures(settings: "Config", seen: "RobotAtRest") -> dict[str, bytes]:
    from projservo_cli.report.image_pages import annotated

    names = [camera.name for camera in seen.cameras]
    each = zip(names, seen.views, seen.s, _goal_pixels(settings, names), strict=False)
    return {name: annotated(view.frame.grey, seen.marker, s, goal) for name, view, s, goal in each}


def _watch(console: Console, settings: "Config", robot: "PluginRobot") -> None:
    """Serve the images until Ctrl-C."""
    import time

    from projservo_cli.report.image_pages import LivePage, annotated

    live, goals = LivePage(settings.name, robot.view), _goal_pixels(settings, robot.view)
    assert settings.markers is not None
    console.say(f"watch: open {live.url} in a browser; Ctrl-C ends it")
    try:
        while True:
            s = robot.read().s
            frames = () if robot.frames is None else robot.frames
            for name, grey, pixels, goal in zip(robot.view, frames, s, goals, strict=False):
                live.pictures[name] = annotated(grey, settings.markers.known, pixels, goal)
            time.sleep(robot.bounds.period)
    except KeyboardInterrupt:
        console.say("watch: ended")
    finally:
        live.close()
