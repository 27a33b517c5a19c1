"""Commands for hardware of people: ``tags``."""

from pathlib import Path

import click

from projservo_cli.cli import options as option
from projservo_cli.cli.group import main
from projservo_cli.cli.output import Console

_SIZE_MM = 30.0  # of tags: what webcams at arm's length see with 25 px and more
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
    type=click.FloatRange(5.0, 190.0),
    default=_SIZE_MM,
    show_default=True,
    help="Side of the black square of each tag.",
)
@click.option(
    "--dictionary",
    metavar="NAME",
    default="4X4_50",
    show_default=True,
    help="The tags, such as APRILTAG_36H11.",
)
@click.option(
    "--numbers", metavar="N,...", help="Single tags to print, such as 0-4,7. Default: as many as fit."
)
@click.option(
    "--paper", type=click.Choice(["a4", "letter"]), default="a4", show_default=True, help="Its size."
)
@option.force(help="Replace the file if there is one.")
@option.told
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

    from projservo_cli.config.markers import GROUND, Markers
    from projservo_cli.detection import TagFinder
    from projservo_cli.files import write_whole
    from projservo_cli.hardware import tags as sheets

    if numbers is not None and kind != "single":
        raise click.UsageError(
            f"--numbers: is for --kind single; a {kind} has the tags of markers.tags: {kind}"
        )
    output = output or Path("tags.pdf")
    option.require_new(output, force=force)
    finder, margin = TagFinder(dictionary), GROUND * size_mm
    size_m = round(1e-3 * size_mm, 6)
    own = "" if dictionary == "4X4_50" else f", dictionary: {dictionary}"
    if kind == "single":
        wanted = None if numbers is None else list(sheets.numbers_of(numbers))
        net = sheets.single(wanted, finder.known, margin, paper)
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
    console.tell(value, words)


_INSTRUCTIONS = {
    "single": ("Cut along the lines; leave the white margin. Glue each on a stiff, flat plate on the tool.",),
    "plate": ("Cut along the line; leave the white margin. Glue it on a stiff, flat plate on the tool.",),
    "roof": (
        "Cut along full lines. Fold back (print outside) along dashed lines. Glue flaps “glue” behind the",
        "tag next to it. Fold the flaps “base” inwards and glue them on a plate on the tool.",
        "Tag 0, in the middle, looks forward.",
    ),
}
