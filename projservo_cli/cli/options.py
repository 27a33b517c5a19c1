"""Options of all commands, and text in lines."""

import re
import textwrap

import click

_UNSEEN = re.compile("[\x00-\x09\x0b-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069]")
LEFT_OUT = {"--suggest": "5"}  # what an option means whose value is left out


def _laws(context: click.Context, parameter: click.Parameter, incomplete: str) -> list[str]:
    """Laws for the completion of a shell."""
    del context, parameter

    from projservo_cli.control import LAWS

    return [law for law in LAWS if law.startswith(incomplete)]


OPTIONS: dict[str, click.Option] = {
    option.name or "": option
    for option in (
        click.Option(
            ["-c", "--config"],
            metavar="FILE",
            type=click.Path(),
            help="Configuration (YAML). Default: the one stored in the run that -o names, else paper.yaml.",
        ),
        click.Option(
            ["sets", "--set"],
            metavar="A.B=V",
            multiple=True,
            help="Override a value of the configuration; V is YAML. Repeatable.",
        ),
        click.Option(
            ["-o", "--output"],
            metavar="DIR",
            type=click.Path(),
            help="Folder of the run, or its run.h5. Default: results/<configuration name>.",
        ),
        click.Option(
            ["--data"],
            metavar="TABLE",
            type=click.Path(),
            help="Observation table (CSV): calibrate from it, or validate with it.",
        ),
        click.Option(
            ["--joints"],
            metavar="RRPRRR",
            help="Type of each joint of the table, R or P. Default: all R.",
        ),
        click.Option(
            ["--joint-unit"],
            type=click.Choice(["deg", "rad"]),
            help="Unit of the table's revolute joints. Default: rad; of validate that of the run.",
        ),
        click.Option(
            ["--noise-px"], metavar="S", help="Pixel noise of the table, per coordinate. Default: estimated."
        ),
        click.Option(
            ["--cross-validate"],
            metavar="K",
            help="On calibrate: predict the poses in K parts, each from a fit to the others.",
        ),
        click.Option(
            ["--init"],
            metavar="FILE",
            type=click.Path(),
            help="On calibrate: try this robot and rig (JSON: screws, cameras, markers) first as a start.",
        ),
        click.Option(
            ["--suggest"],
            metavar="[N]",
            type=click.IntRange(1, 100),
            help="On calibrate: suggest N further poses to record, the most telling first; 5 without N.",
        ),
        click.Option(
            ["--lens"],
            is_flag=True,
            help="Estimate radial lens distortion, two coefficients a camera. Default: none.",
        ),
        click.Option(
            ["--image-size"],
            metavar="WxH",
            help="Size of the table's images, px. Default: that of rig, else from where markers were seen.",
        ),
        click.Option(
            ["--motions"],
            metavar="CSV",
            type=click.Path(),
            help="On record: further poses after the trial motions, a row each of q1 ... qN.",
        ),
        click.Option(
            ["--joints-csv"],
            metavar="CSV",
            type=click.Path(),
            help="On detect: joint readings q1 ... qN, a row a pose, perhaps with pose or left and right.",
        ),
        click.Option(
            ["--dictionary"],
            metavar="NAME",
            default="4X4_50",
            show_default=True,
            help="On detect: the tags, such as 4X4_50, ARUCO_ORIGINAL, APRILTAG_36H11.",
        ),
        click.Option(
            ["--points"],
            type=click.Choice(["corners", "centers"]),
            default="corners",
            show_default=True,
            help="On detect: four markers a tag, or one.",
        ),
        click.Option(
            ["laws", "--law"],
            metavar="NAME",
            multiple=True,
            shell_complete=_laws,
            help="On servo: this law, or law of yours (module:Class), instead of control.laws. Repeatable.",
        ),
        click.Option(
            ["--speed-scale"],
            metavar="S",
            help="On servo and record: scale every command by S, above 0 and at most 1.",
        ),
        click.Option(
            ["--confirm"],
            is_flag=True,
            help="On servo and record: ask on the terminal before the first motion.",
        ),
        click.Option(
            ["origin", "--from"],
            metavar="SWEEP:INDEX",
            help="On servo: the run of that number of a sweep, made anew as a run of its own.",
        ),
        click.Option(
            ["--view"],
            is_flag=True,
            help="On report: a 3D view of robot, rig and paths with a time slider, view.html.",
        ),
        click.Option(
            ["--animation"],
            is_flag=True,
            help="On report: both camera images under several laws over time, animation.gif.",
        ),
        click.Option(
            ["--scheduler"],
            metavar="ADDRESS",
            help="On sweep: the Dask scheduler whose workers do the work, such as tcp://host:8786.",
        ),
        click.Option(
            ["--to"],
            type=click.Choice(["csv"]),
            default="csv",
            help="On export: the kind of file, of which there is one.",
        ),
        click.Option(["--force"], is_flag=True, help="Make the named stages even where they are up to date."),
        click.Option(["-n", "--dry-run"], is_flag=True, help="Say what would be done, do nothing."),
        click.Option(
            ["-j", "--threads"],
            metavar="N",
            type=click.IntRange(1, 256),
            help="Threads. Default: all processors.",
        ),
        click.Option(["--json"], is_flag=True, help="Print one JSON object on standard output."),
        click.Option(
            ["-q", "--quiet"], is_flag=True, help="Print nothing but errors and what --json prints."
        ),
        click.Option(["-v", "--verbose"], is_flag=True, help="Say more; show tracebacks."),
        click.Option(["--version"], is_flag=True, help="Print the version and exit."),
        click.Option(["-h", "--help"], is_flag=True, help="Print this help and exit."),
    )
}


def wrapped(text: str, indent: str = "") -> str:
    """Text in lines of at most 80 columns; words longer than that stay whole."""
    return textwrap.fill(
        text,
        80,
        initial_indent=indent,
        subsequent_indent=indent,
        break_long_words=False,
        break_on_hyphens=False,
    )


def visible(text: str) -> str:
    """Text whose control characters and changes of direction are written out, line ends apart.

    Texts come from files of others too; a terminal that is sent them must not obey them.
    """
    return _UNSEEN.sub(lambda found: f"\\u{ord(found[0]):04x}", text)
