"""The command ``detect``: markers in images, into a table."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from projservo_cli.cli import options as option
from projservo_cli.cli.output import Console
from projservo_cli.cli.program import main

if TYPE_CHECKING:
    from projservo_cli.detection.episodes import Episodes
    from projservo_cli.detection.finders import Finder
    from projservo_cli.detection.images import ImageSeries

# Poses at which a marker is seen, below which it says little: calibrate judges markers from eight poses on.
_SELDOM = 8


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
@click.option("--lerobot", metavar="FOLDER", type=option.PATH, help="Episodes of a LeRobot data set instead.")
@click.option("--episodes", metavar="LIST", help="With --lerobot: such as 0-3,7; by default all.")
@click.option(
    "--state-unit",
    type=click.Choice(["deg", "rad", "normalised"]),
    help="With --lerobot: of the joints, if the data set does not say it; normalised is -100 to 100.",
)
@click.option(
    "--calibration-file",
    metavar="JSON",
    type=option.PATH,
    help="With --lerobot: LeRobot's calibration of the arm, for normalised joints.",
)
@click.option(
    "--mount",
    type=click.Choice(["world", "tool"]),
    help="With --lerobot: where the cameras are; tags are then on the tool or in the scene. Default: world.",
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
@option.dictionary(help="The tags, such as 4X4_50, ARUCO_ORIGINAL, APRILTAG_36H11.")
@click.option(
    "--board",
    metavar="KIND:CxR",
    help="A board instead of tags: chessboard:9x7 (inner corners), charuco:11x8 (squares), and "
    "charuco:11x8:first=20 if its first tag is 20, circles:9x7, acircles:4x11.",
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
    lerobot: Path | None,
    episodes: str | None,
    state_unit: str | None,
    calibration_file: Path | None,
    mount: str | None,
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
    with one image of each camera; images in motion are kept for the delay of the cameras. The CameraInfo
    next to images becomes TABLE_NAME.yaml, for calibrate --intrinsics. Needs rosbags: pip install '.[bags]'.

    With --lerobot images and joints are those of episodes, at frames at which the arm hardly moves; joints
    are then in rad, and grippers are left out. Cameras are all of the data set, or NAME=KEY each. If a camera
    moved between episodes, the table has the longest stretch before or after, and TABLE_episodes_12-19.csv
    and so on the others. Needs pip install '.[lerobot]'.
    """
    import numpy as np

    from projservo_cli.detection.finders import Board, finder_of
    from projservo_cli.detection.observation import observe_tags
    from projservo_cli.store.observation_tables import write_table

    option.require_new(output, force=force)
    if board is not None and points == "centers":
        raise click.UsageError("--points centers: is of tags; a board has corners: leave out one of both")
    finder = finder_of(None if board is None else Board.of(board), dictionary)
    of_bag = {
        "images": topics,
        "readings-topic": readings_topic,
        "frames": frames,
        "joint-names": joint_names,
    }
    of_lerobot = {
        "episodes": episodes,
        "state-unit": state_unit,
        "calibration-file": calibration_file,
        "mount": mount,
    }
    for source, path, options in (("a --bag", bag, of_bag), ("--lerobot", lerobot, of_lerobot)):
        if path is None and any(options.values()):
            raise click.UsageError(f"{', '.join(f'--{name}' for name in options)}: are of {source}")
    if lerobot is not None:
        for name, given in {"readings": readings, "bag": bag}.items():
            if given is not None:
                raise click.UsageError(f"--lerobot: has its own readings; leave out --{name}")
        read = _of_episodes(lerobot, episodes, images, state_unit, calibration_file)
        _detect_episodes(console, read, finder, points, mount or "world", output, force)
        return
    if bag is None:
        series, extra = _of_files(console, images, readings)
    else:
        if readings is not None or readings_topic is None:
            raise click.UsageError("--bag: name the readings by --readings-topic, not by --readings")
        chosen = tuple(name for name in joint_names.split(",") if name)
        series, extra = _of_bag(
            console, bag, (*topics, *images), readings_topic, frames, chosen, (output, force)
        )
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
        raise click.UsageError("give images and '--readings', a '--bag', or '--lerobot'")
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
    near: tuple[Path, bool],
) -> tuple["ImageSeries", dict[str, Any]]:
    """Images and readings of a bag, open until the command ends, and a report; cameras near a table."""
    from projservo_cli.detection.bags import bag_series, open_bag
    from projservo_cli.store.camera_files import camera_info
    from projservo_cli.store.files_and_locks import write_whole

    if not topics:
        raise click.UsageError("--bag: name the topics of the images, --images NAME=TOPIC ...")
    bag = click.get_current_context().with_resource(open_bag(path))
    found = bag_series(bag, _sources(topics), readings, frames, joint_names, console.progress)
    counts = [
        f"{name}: {sum(fate.values())} images: " + ", ".join(f"{fate[word]} {word}" for word in sorted(fate))
        for name, fate in found.fate.items()
    ]
    files = {name: near[0].with_name(f"{near[0].stem}_{name}.yaml") for name in found.cameras}
    for path in files.values():
        option.require_new(path, force=near[1])
    for name, path in files.items():
        write_whole(path, camera_info(name, *found.cameras[name]))
    known = [f"CameraInfo of {name}: {path}, for calibrate --intrinsics" for name, path in files.items()]
    for note in [*found.notes, *counts, *known]:
        console.say(f"detect: {note}")
    moving = found.series.moving
    return found.series, {
        "poses_in_motion": 0 if moving is None else int((moving > 0).sum()),
        "images": found.fate,
        "intrinsics": {name: path.resolve() for name, path in files.items()},
    }


def _of_episodes(
    folder: Path, episodes: str | None, images: tuple[str, ...], unit: str | None, calibration: Path | None
) -> "Episodes":
    """Frames and joints of episodes of a LeRobot data set."""
    from projservo_cli.detection.episodes import numbers_in, read_episodes

    chosen = None if episodes is None else numbers_in(episodes)
    return read_episodes(folder, chosen, _sources(images, "KEY"), unit, calibration)


def _detect_episodes(
    console: Console,
    read: "Episodes",
    finder: "Finder",
    points: str,
    mount: str,
    output: Path,
    force: bool,
) -> None:
    """Find markers in frames of episodes, and cameras that moved; write a table of each stretch."""
    import numpy as np

    from projservo_cli.detection.episodes import episode_of
    from projservo_cli.detection.observation import observe_tags
    from projservo_cli.detection.stretches import stretches
    from projservo_cli.store.observation_tables import write_table

    observation, found = observe_tags(read.series, finder, points, console.progress)
    still = observation.at_rest
    episode, views = episode_of(still.pose), len(still.view)
    parts = stretches(still, episode, mount, console.progress)
    runs = sorted(parts.episodes, key=lambda run: -int(np.isin(episode, run).sum()))
    tables = [output, *(output.with_stem(f"{output.stem}_episodes_{run[0]}-{run[-1]}") for run in runs[1:])]
    for table in tables:
        option.require_new(table, force=force)
    for table, run in zip(tables, runs, strict=True):
        write_table(observation.rows(np.isin(episode_of(observation.pose), run)), table, mount=mount)
    count = np.isfinite(still.images[..., 0]).any(axis=1).sum(axis=0)
    value = {
        "tables": [table.resolve() for table in tables],
        "episodes": runs,
        "poses": len(still.pose),
        "moving": len(observation.pose) - len(still.pose),
        "markers": len(still.marker),
        "joints": read.joints,
        "unit": read.unit,
        "frames": read.frames,
        "slow": read.slow,
        "left_out": read.left_out,
        "no_slow_frame": read.empty,
        "moved": [one._asdict() for one in parts.moved],
        "untested": parts.untested,
        "moved_little_deg": read.little,
        "seldom_seen": still.marker[count < _SELDOM].tolist(),
        "ambiguous": found.ambiguous,
        "unrefined": found.unrefined,
        "empty_images": found.empty,
    }
    pairs = [(one.last, one.first) for one in parts.moved]
    shared = {pair for pair in pairs if pairs.count(pair) == views > 1}
    moved = [
        f"camera {one.view} moved by {one.by_px:.0f} px between episodes {one.last} and {one.first}"
        for one, pair in zip(parts.moved, pairs, strict=True)
        if pair not in shared
    ]
    moved += [
        f"images of all cameras moved between episodes {last} and {first}: the cameras, tags on the tool, or "
        "zeros of joints did"
        for last, first in sorted(shared)
    ]
    words = {
        "joints {}: " + read.unit: read.joints,
        "left out, as they do not move the flange: {}": read.left_out,
        "no slow frame in episodes {}": read.empty,
        "{}": moved,
        "whether a camera moved is not known: {}": [parts.untested] * bool(parts.untested),
        "not shown, joints that moved little: {}": [f"{name} {x:.1f}°" for name, x in read.little.items()],
        f"not shown, markers at fewer than {_SELDOM} poses: {{}}": value["seldom_seen"],
    }
    head = "detect: {poses} poses of {slow} slow frames of {frames}, {moving} in motion, {markers} markers"
    lines = [
        head.format_map(value),
        *(f"  {text.format(', '.join(map(str, of)))}" for text, of in words.items() if of),
    ]
    for table, run in zip(tables, runs, strict=True):
        lines.append(f"table: {table}, episodes {run[0]} to {run[-1]}")
    console.report(value, lines)


def _sources(images: tuple[str, ...], of: str = "IMAGES") -> dict[str, str]:
    """Folders or patterns of the images by the names of the cameras; a UsageError if these are none.

    of : kind of what is named; left and right have none only if it is images.
    """
    from projservo_cli.records import VIEWS
    from projservo_cli.settings.sections import is_view

    named = [image.partition("=")[::2] for image in images]
    if of == "IMAGES" and len(images) == 2 and not all(is_view(name) and rest for name, rest in named):
        return dict(zip(VIEWS, images, strict=True))
    for image, (name, rest) in zip(images, named, strict=True):
        if not (is_view(name) and rest):
            raise click.UsageError(
                f"{image}: give the images of left and right, or NAME={of} of each camera, such as "
                "top=images/top: names have small letters, digits, _ and single spaces"
            )
    if len({name for name, _ in named}) < len(named):
        raise click.UsageError("two cameras have one name: name each once")
    return dict(named)
