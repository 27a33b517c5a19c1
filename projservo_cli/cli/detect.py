"""The command ``detect``: markers in images, into a table."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from projservo_cli.cli import options as option
from projservo_cli.cli.output import Console
from projservo_cli.cli.program import main

if TYPE_CHECKING:
    from projservo_cli.detection.images import ImageSeries


@main.command(
    "detect", epilog="Example: projservo detect images/left images/right --readings q.csv --output tags.csv"
)
@click.argument("images", nargs=-1, metavar="LEFT RIGHT | NAME=IMAGES...")
@option.output(metavar="TABLE", help="Observation table to write (CSV).", required=True)
@click.option(
    "--readings",
    metavar="CSV",
    type=click.Path(),
    help="Readings, a row per pose: q1 ... qN or a pose of the flange, perhaps pose or left, right.",
)
@click.option(
    "--bag",
    metavar="FILE",
    type=option.PATH,
    help="A bag with images and readings instead: .bag, .mcap, or a folder of ROS 2.",
)
@click.option(
    "--images",
    "topics",
    metavar="NAME=TOPIC...",
    multiple=True,
    help="Topics of the images of a bag, each with the name of its camera.",
)
@click.option(
    "--readings-topic", metavar="TOPIC", help="Readings of a bag: a topic of JointState, PoseStamped or tf."
)
@click.option(
    "--frames", metavar="BASE FLANGE", nargs=2, help="Frames of tf: the flange, and the base it moves in."
)
@click.option(
    "--joint-names",
    metavar="NAME,...",
    default="",
    help="Joints of JointState that are q1 ... qN. Default: those of most messages, in their order.",
)
@click.option(
    "--dictionary",
    metavar="NAME",
    default="4X4_50",
    show_default=True,
    help="The tags, such as 4X4_50, ARUCO_ORIGINAL, APRILTAG_36H11.",
)
@click.option(
    "--board",
    metavar="KIND:CxR",
    help="A board instead of tags: chessboard:9x7 (inner corners) or charuco:11x8 (squares), and "
    "charuco:11x8:first=20 if its first tag is 20.",
)
@click.option(
    "--points",
    type=click.Choice(["corners", "centers"]),
    default="corners",
    show_default=True,
    help="Four markers a tag, or one.",
)
@option.force(help="Replace the table if there is one.")
@option.explained
def _detect(
    console: Console,
    *,
    images: tuple[str, ...],
    output: Path,
    readings: str | None,
    bag: Path | None,
    topics: tuple[str, ...],
    readings_topic: str | None,
    frames: tuple[str, str] | None,
    joint_names: str,
    dictionary: str,
    board: str | None,
    points: str,
    force: bool,
) -> None:
    """Find ArUco or AprilTag markers, or a board, in images and write a table.

    Finds tags in the images of two folders (or quoted patterns such as 'left/*.png'), with corners to a
    fraction of a pixel and how certain each is, and writes an observation table for calibrate --data. Needs
    OpenCV: pip install '.[detect]'.

    Other rigs name their cameras, one or more: top=images/top, or left=a right=b top=c.

    The list of joint readings (--readings) says which images belong together. With columns left and right
    (or other names), these are the names of the images. With a column pose, images are those whose name ends
    in that number. With neither, all folders are taken in the order of their names, one image per row;
    image_2 comes before image_10.

    With --points corners, corner k of tag t is marker 4 t + k, in the order of the dictionary: top left, top
    right, bottom right, bottom left. With --points centers, tag t is marker t, at the crossing of its
    diagonals. With --board the markers are its inner corners, numbered row by row as OpenCV does; a
    chessboard of two odd or two even sides looks the same turned by 180°, and calibrate turns its numbering
    right. Readings are copied as they are: say --joint-unit deg on calibrate if they are degrees.

    A bag of ROS 1 or 2 (--bag) brings images and readings along. The poses are the stops of the robot, each
    with one image of each camera; images in motion are kept for the delay of the cameras. Needs rosbags: pip
    install '.[bags]'.
    """
    import numpy as np

    from projservo_cli.detection.finders import Board, finder_of
    from projservo_cli.detection.observation import observe_tags
    from projservo_cli.store.observation_tables import write_table

    option.require_new(output, force=force)
    if board is not None and points == "centers":
        raise click.UsageError("--points centers: is of tags; a board has corners: leave out one of both")
    finder = finder_of(None if board is None else Board.of(board), dictionary)
    if bag is None:
        if topics or readings_topic or frames or joint_names:
            raise click.UsageError("--images, --readings-topic, --frames, --joint-names: are of a --bag")
        series, extra = _of_files(console, images, readings)
    else:
        if readings is not None or readings_topic is None:
            raise click.UsageError("--bag: name the readings by --readings-topic, not by --readings")
        chosen = tuple(name for name in joint_names.split(",") if name)
        series, extra = _of_bag(console, bag, (*topics, *images), readings_topic, frames, chosen)
    observation, found = observe_tags(series, finder, points, console.progress)
    write_table(observation, output)
    rest, names = observation.at_rest, series.view
    seen, whole = np.isfinite(rest.images[..., 0]), "both" if len(names) == 2 else "all"
    alone = {name: int((seen[:, v] & (seen.sum(axis=1) == 1)).sum()) for v, name in enumerate(names)}
    unseen = int((~seen.any(axis=1)).sum())
    value = {
        "table": output.resolve(),
        "poses": len(rest.pose),
        "board": board,
        "tags": found.tags if board is None else [],
        "markers": len(observation.marker),
        whole: int(seen.all(axis=1).sum()),
        **{f"{name}_only": count for name, count in alone.items()},
        "unseen": unseen,
        "ambiguous": found.ambiguous,
        "unrefined": found.unrefined,
        "empty_images": found.empty,
        **extra,
    }
    only = ", ".join(f"{name} only {count}" for name, count in alone.items())
    words = (
        f"detect: {{poses}} poses, {board or f'{len(found.tags)} tags'}, {{markers}} markers",
        f"  markers seen by {whole} cameras {value[whole]}, {only}, by none {unseen}",
        "  {unrefined} points without clean edges: less certain, or rejected if occluded",
        "  rejected: {ambiguous} tags twice in an image; images without a tag: {empty_images}"
        if board is None
        else "  images without the board: {empty_images}",
    )
    console.report(value, [*(text.format_map(value) for text in words), f"table: {output}"])


def _of_files(
    console: Console, images: tuple[str, ...], readings: str | None
) -> tuple["ImageSeries", dict[str, Any]]:
    """Images of files with the readings of a table, and what else to report."""
    from projservo_cli.detection.images import hidden_images, pair_images
    from projservo_cli.store.observation_tables import read_joint_list

    if not images or readings is None:
        raise click.UsageError("give the images and '--readings', or a '--bag'")
    sources = _sources(images)
    # Readings as they are, whatever their unit.
    joints = read_joint_list(readings, joint_unit="rad", view=tuple(sources), flange=True)
    series = pair_images(sources, joints, readings)
    hidden = [file for side in sources.values() for file in hidden_images(side)]
    if hidden:
        console.say(
            f"detect: {len(hidden)} hidden files such as {hidden[0]} are no images, and were left out"
        )
    return series, {"hidden_files": len(hidden)}


def _of_bag(
    console: Console,
    path: Path,
    topics: tuple[str, ...],
    readings: str,
    frames: tuple[str, str] | None,
    joint_names: tuple[str, ...],
) -> tuple["ImageSeries", dict[str, Any]]:
    """Images and readings of a bag, which stays open until the command ends, and what else to report."""
    from projservo_cli.detection.bags import bag_series, open_bag

    if not topics:
        raise click.UsageError("--bag: name the topics of the images, --images NAME=TOPIC ...")
    bag = click.get_current_context().with_resource(open_bag(path))
    found = bag_series(bag, _sources(topics), readings, frames, joint_names, console.progress)
    counts = [
        f"{name}: {sum(fate.values())} images: " + ", ".join(f"{fate[word]} {word}" for word in sorted(fate))
        for name, fate in found.fate.items()
    ]
    for note in [*found.notes, *counts]:
        console.say(f"detect: {note}")
    moving = found.series.moving
    return found.series, {
        "poses_in_motion": 0 if moving is None else int((moving > 0).sum()),
        "images": found.fate,
    }


def _sources(images: tuple[str, ...]) -> dict[str, str]:
    """Folders or patterns of the images by the names of the cameras; a UsageError if these are none."""
    from projservo_cli.records import VIEWS
    from projservo_cli.settings.sections import is_view

    named = [image.partition("=")[::2] for image in images]
    if len(images) == 2 and not all(is_view(name) and rest for name, rest in named):
        return dict(zip(VIEWS, images, strict=True))
    for image, (name, rest) in zip(images, named, strict=True):
        if not (is_view(name) and rest):
            raise click.UsageError(
                f"{image}: give the images of left and right, or NAME=IMAGES of each camera, such as "
                "top=images/top: names have small letters, digits, _ and single spaces"
            )
    if len({name for name, _ in named}) < len(named):
        raise click.UsageError("two cameras have one name: name each once")
    return dict(named)
