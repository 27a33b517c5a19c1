"""``projservo detect``: find tags in images and write an observation table."""

from pathlib import Path
from typing import Any

import click

from projservo_cli.cli.output import Console, print_json


def run(names: list[str], rest: list[str], options: dict[str, Any]) -> int:
    """Find the tags in two sets of images; the exit code."""
    del names
    if len(rest) != 2:
        raise click.UsageError("detect needs two folders of images: projservo detect LEFT RIGHT …")
    if options["joints_csv"] is None:
        raise click.UsageError("detect needs joint readings: --joints-csv CSV")
    if options["output"] is None:
        raise click.UsageError("detect needs a table to write: --output TABLE")
    from projservo_cli.detection import observe, pair_images
    from projservo_cli.detection.tags import TagFinder
    from projservo_cli.records import InputError
    from projservo_cli.tables import read_joints, write_table

    path = Path(options["output"])
    if path.exists() and not options["force"]:
        raise InputError(f"{path}: exists already; choose another --output, or replace it with --force")
    finder = TagFinder(options["dictionary"])
    joints = read_joints(options["joints_csv"], joint_unit="as is")
    pairs = pair_images(rest[0], rest[1], joints, options["joints_csv"])
    console = Console(quiet=options["quiet"], verbose=options["verbose"])
    try:
        observation, found = observe(pairs, joints.q, finder, options["points"], console.progress)
    finally:
        console.finish()
    write_table(observation, path)
    _tell(path, observation, found, console, as_json=options["json"])
    return 0


def _tell(path: Path, observation: Any, found: Any, console: Console, *, as_json: bool) -> None:
    import numpy as np

    left, right = np.moveaxis(np.isfinite(observation.images[..., 0]), 1, 0)
    value = {
        "table": path.resolve(),
        "poses": len(observation.pose),
        "tags": found.tags,
        "markers": len(observation.marker),
        "both": int((left & right).sum()),
        "left_only": int((left & ~right).sum()),
        "right_only": int((~left & right).sum()),
        "unseen": int((~left & ~right).sum()),
        "ambiguous": found.ambiguous,
        "unrefined": found.unrefined,
        "empty_images": found.empty,
    }
    if as_json:
        print_json(value)
        return
    console.show(f"detect: {value['poses']} poses, {len(found.tags)} tags, {value['markers']} markers")
    console.show(
        "  markers seen by both cameras {both}, left only {left_only}, right only {right_only}, by none "
        "{unseen}".format_map(value)
    )
    console.show(
        "  left out: {ambiguous} tags twice in an image, {unrefined} points without clean edges; "
        "images without a tag: {empty_images}".format_map(value)
    )
    console.show(f"table: {path}")
