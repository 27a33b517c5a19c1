"""Commands on data of robots and cameras: ``teach``, ``detect`` and ``validate``."""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import click

from projservo_cli.cli import options as option
from projservo_cli.cli.output import Console, wrapped
from projservo_cli.cli.program import main

# Squared error over its covariance that reveals another robot, or other units.
_FAR = 20.0
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


@main.command(
    "detect", epilog="Example: projservo detect images/left images/right --readings q.csv --output tags.csv"
)
@click.argument("images", nargs=-1, required=True, metavar="LEFT RIGHT | NAME=IMAGES...")
@option.output(metavar="TABLE", help="Observation table to write (CSV).", required=True)
@click.option(
    "--readings",
    metavar="CSV",
    type=click.Path(),
    required=True,
    help="Joint readings, one row per pose: columns q1 ... qN, perhaps pose or left, right.",
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
    readings: str,
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
    """
    import numpy as np

    from projservo_cli.detection import Board, finder_of, hidden_images, observe_tags, pair_images
    from projservo_cli.store.observation_tables import read_joint_list, write_table

    option.require_new(output, force=force)
    if board is not None and points == "centers":
        raise click.UsageError("--points centers: is of tags; a board has corners: leave out one of both")
    finder = finder_of(None if board is None else Board.of(board), dictionary)
    sources = _sources(images)
    # Readings as they are, whatever their unit.
    joints = read_joint_list(readings, joint_unit="rad", view=tuple(sources))
    pairs = pair_images(sources, joints, readings)
    hidden = [file for side in sources.values() for file in hidden_images(side)]
    if hidden:
        console.say(
            f"detect: {len(hidden)} hidden files such as {hidden[0]} are no images, and were left out"
        )
    observation, found = observe_tags(pairs, tuple(sources), joints.q, finder, points, console.progress)
    write_table(observation, output)
    seen, whole = np.isfinite(observation.images[..., 0]), "both" if len(sources) == 2 else "all"
    alone = {name: int((seen[:, v] & (seen.sum(axis=1) == 1)).sum()) for v, name in enumerate(sources)}
    unseen = int((~seen.any(axis=1)).sum())
    value = {
        "table": output.resolve(),
        "poses": len(observation.pose),
        "board": board,
        "tags": found.tags if board is None else [],
        "markers": len(observation.marker),
        whole: int(seen.all(axis=1).sum()),
        **{f"{name}_only": count for name, count in alone.items()},
        "unseen": unseen,
        "ambiguous": found.ambiguous,
        "unrefined": found.unrefined,
        "empty_images": found.empty,
        "hidden_files": len(hidden),
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


@main.command("validate", epilog="Example: projservo validate results/mine --data validation.csv")
@click.argument("run", required=False, type=option.PATH)
@option.output(metavar="DIR", help="The run, instead of an argument.")
@click.option("--data", metavar="TABLE", type=option.PATH, help="Observation table (CSV).")
@click.option(
    "--readings",
    metavar="TABLE",
    type=option.PATH,
    help="Joints, or poses of the flange (CSV), where --data lists detections: pose, camera, marker, u, v.",
)
@click.option(
    "--metric",
    metavar="TABLE",
    type=option.PATH,
    help="Positions of a point of the tool (CSV): pose, q1 ... qN, x, y, z in m, perhaps sigma.",
)
@click.option(
    "--fit",
    metavar="TABLE",
    type=option.PATH,
    help="Other positions, for scale, pose and point. Default: the rest of --metric, in five parts.",
)
@click.option(
    "--arm-std-mm",
    metavar="MM",
    type=option.NumberRange(0.0, 1000.0),
    default=0.0,
    help="Additional standard deviation of positions that the images do not cover, per coordinate.",
)
@option.joint_unit(help="Unit of the table's revolute joints. Default: the unit of the run.")
@option.explained
def _validate(
    console: Console,
    *,
    run: Path | None,
    output: Path | None,
    data: Path | None,
    readings: Path | None,
    metric: Path | None,
    fit: Path | None,
    arm_std_mm: float,
    joint_unit: str | None,
) -> None:
    """Predict held-out images, or positions, with a calibration.

    Compares the pixels of an observation table (--data) with those the calibration of a run predicts at the
    table's joint readings. Ends in exit code 1 if their median distance passes three times the stated
    error and the noise of the images together, or if the images of one camera show that it was moved. A table
    of one posture is judged as doctor judges an arm at rest; of several, changes are reported with the
    medians.

    With --metric it compares positions that another instrument measured, such as a laser tracker. Its scale,
    its pose and the place of its point on the tool are fitted to --fit.
    """
    target = option.one_run("validate", run, output)
    if target is None:
        raise click.UsageError("validate needs a run: projservo validate RUN --data TABLE")
    if metric is None and (fit is not None or arm_std_mm):
        raise click.UsageError("--fit and --arm-std-mm are for --metric, which is not given")
    if data is None and metric is None:
        raise click.UsageError("validate needs --data TABLE, or --metric TABLE")
    if readings is not None and data is None:
        raise click.UsageError("--readings are the joints for --data, which is not given")
    if data is not None and metric is not None:
        raise click.UsageError("--data and --metric: validate takes one of them; leave the other out")
    from projservo_cli.calibration.checks.validation import median_limit
    from projservo_cli.config import load_config
    from projservo_cli.findings import REFUSES
    from projservo_cli.messages import failed, order_advice, sentence, setup_of
    from projservo_cli.stages.validate import compared
    from projservo_cli.store.observation_tables import read_detections, read_table
    from projservo_cli.store.run_file import load

    found = load(target)
    calibration = found.calibration
    config = load_config(found.path, text=found.results["calibrate"].configuration)
    if joint_unit is None:
        joint_unit = config.data.joint_unit if config.data is not None else None
    if data is None:
        value = _position_errors(calibration, (metric, fit), joint_unit, arm_std_mm)
        lines = (
            "validate: {count} positions",
            "  error mm: rms {rms_mm:.3g}, median {median_mm:.3g}, largest {max_mm:.3g}",
            "  covariance: rms {predicted_rms_mm:.3g} mm, mean squared error over it {mahalanobis:.3g}",
            "  scale: markers {between[0]} and {between[1]} are {length_m:.5g} m apart by these positions",
        )
        if value["mahalanobis"] > _FAR:
            console.say(
                f"validate: squared errors are {value['mahalanobis']:.3g} times their covariance: are these "
                "the same robot and joint readings, and x, y, z in m? --arm-std-mm adds errors beyond images"
            )
        console.report({"run": found.path.resolve(), **value}, [text.format_map(value) for text in lines])
        return
    unit = calibration.joint_types, joint_unit
    observation = (
        read_table(data, *unit, like=calibration)
        if readings is None
        else read_detections(data, readings, *unit, like=calibration)
    )
    compared_with = compared(calibration, observation, config.image_size_px)
    value, setup = {"run": found.path.resolve(), **compared_with}, setup_of(calibration)
    for text in value.get("advice", ()):
        console.say(f"validate: {text}")
    skipped = ", ".join(f"{count} {why.replace('_', ' ')}" for why, count in value["skipped"].items())
    words = [wrapped(f"validate: {value['count']} marker-view pairs; skipped: {skipped}")]
    if value["count"]:
        words.append(
            "  residual px: rms {rms_px:.4g}, median {median_px:.4g}, p95 {p95_px:.4g}".format_map(value)
        )
    if value["limit_px"] is None:
        console.report(value, words)
        return
    words.append(wrapped(f"median {sentence(median_limit(value))}", "  "))
    refusing = [one for one in value["findings"] if one.severity == REFUSES]
    if refusing:
        of_view = "{view} camera: median {median_px:.3g} px of {count} pairs, {limit_px:.3g} px allowed"
        limited = (one for one in value["views"] if one["count"] and one["limit_px"] is not None)
        words += [wrapped(of_view.format_map(one), "  ") for one in limited]
    console.report(value, words)
    if not refusing:
        return
    one = refusing[0]
    if one.code == "contradicted_in_part":
        again = f"projservo calibrate {target} --refit {''.join(one.subject.views[:1])} --data {data}"
        one = replace(one, subject=replace(one.subject, name=again))
    left_open, n = order_advice(calibration), len(calibration.joint_types)
    order = calibration.undecided_order
    if order is not None and order.size == n * (n - 1):  # all reversed is the other mount
        left_open += "; no pose shows whether the cameras are on the tool (--mount) either"
    left_open = f"; {left_open}" if left_open else ""
    raise failed([one], setup, left_open, stage=str(data))


def _position_errors(
    calibration: Any, tables: tuple[Path | None, Path | None], joint_unit: str | None, arm_std_mm: float
) -> dict[str, Any]:
    """Statistics of the arm's positions against a table, and against a second one if it is fitted."""
    from projservo_cli.metric.position_error import position_errors
    from projservo_cli.results import ImageModel
    from projservo_cli.store.observation_tables import read_positions

    types = calibration.joint_types
    table, fit = (None if path is None else read_positions(path, types, joint_unit) for path in tables)
    assert table is not None
    # The instrument sets the scale, so any unit serves.
    unit: Any = "cameras" if len(calibration.view) > 1 else calibration.marker[:2]
    metric = ImageModel.of(calibration).metric(1.0, unit)
    return position_errors(metric, table, fit, arm_std_mm / 1e3)
