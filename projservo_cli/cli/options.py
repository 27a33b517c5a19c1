"""Options and commands: what there is, what belongs together, what help says."""

import textwrap
from dataclasses import dataclass

import click

OPTIONS: dict[str, click.Option] = {
    option.name or "": option
    for option in (
        click.Option(
            ["-c", "--config"],
            metavar="FILE",
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
            help="Folder of the run, or its run.h5. Default: results/<configuration name>.",
        ),
        click.Option(
            ["--data"],
            metavar="TABLE",
            help="Observation table (CSV): calibrate from it, or validate with it.",
        ),
        click.Option(
            ["--joints"],
            metavar="RRPRRR",
            help="Type of each joint of the table, R or P. Default: all R.",
        ),
        click.Option(
            ["--noise-px"], metavar="S", help="Pixel noise of the table, per coordinate. Default: estimated."
        ),
        click.Option(
            ["laws", "--law"],
            metavar="NAME",
            multiple=True,
            help="On servo: this law instead of control.laws. Repeatable.",
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

_EVERYWHERE = ("json", "quiet", "verbose", "help")
_OF_STAGES = ("config", "sets", "output", "data", "joints", "noise_px", "force", "dry_run", "threads")


@dataclass(frozen=True)
class Command:
    """A word of the command line: what it takes and what help says about it."""

    summary: str
    about: str
    options: tuple[str, ...]
    argument: str = ""
    stage: bool = False


COMMANDS = {
    "calibrate": Command(
        "Learn the projective kinematics from trial motions.",
        "Estimates both cameras and all joint operators from images alone, simulated from the configuration "
        "or recorded in an observation table (--data).",
        _OF_STAGES,
        stage=True,
    ),
    "plan": Command(
        "Plan the task as a translation and two rotations.",
        "Partitions the task by the start and goal images and lays a path on which both cameras keep seeing "
        "the face. Calibrates first where needed.",
        _OF_STAGES,
        stage=True,
    ),
    "servo": Command(
        "Run the control laws in closed loop.",
        "Runs each law of control.laws (or of --law) to its verdict. Calibrates and plans first where "
        "needed. Exit code 1 when a law of control.must_converge does not converge.",
        (*_OF_STAGES, "laws"),
        stage=True,
    ),
    "report": Command(
        "Draw the figures and check the paper's claims.",
        "Writes the figures and the table of claims into the folder of the run. Makes every stage before "
        "it where needed.",
        _OF_STAGES,
        stage=True,
    ),
    "validate": Command(
        "Predict held-out images with a calibration.",
        "Compares the pixels of an observation table (--data) with those the calibration of a run predicts "
        "at the table's joint readings.",
        ("output", "data"),
        "RUN",
    ),
    "show": Command(
        "Show what a run holds and how it was made.",
        "Lists the results in a run, whether each is up to date, and what it was made with.",
        ("output",),
        "[RUN]",
    ),
    "equations": Command(
        "List the equations of the paper and the code of each.",
        "Prints number, title, function, test and erratum of every equation.",
        (),
    ),
}


def allowed(names: list[str]) -> set[str]:
    """Options that at least one of the named commands uses."""
    return {option for name in names for option in (*COMMANDS[name].options, *_EVERYWHERE)}


def help_text(names: list[str]) -> str:
    """Help on the named commands, or on all of them where none is named."""
    formatter = click.HelpFormatter(width=80, max_width=80)
    if not names:
        formatter.write_usage("projservo", "[OPTIONS] COMMAND ...")
        formatter.write_paragraph()
        formatter.write_text(
            "Uncalibrated stereo visual servoing in projective space. The stages calibrate, plan, servo and "
            "report chain in one call; each first makes what it lacks. Options may stand anywhere."
        )
        for title, stage in (("Stages", True), ("Other commands", False)):
            with formatter.section(title):
                formatter.write_dl([(n, c.summary) for n, c in COMMANDS.items() if c.stage is stage])
        shown = list(OPTIONS)
    else:
        command = COMMANDS[names[0]]
        words = " ".join([*names, *([command.argument] if command.argument else [])])
        formatter.write_usage("projservo", f"{words} [OPTIONS]")
        for name in names:
            formatter.write_paragraph()
            formatter.write_text(COMMANDS[name].about)
        shown = [name for name in OPTIONS if name in allowed(names)]
    context = click.Context(click.Command("projservo"))
    with formatter.section("Options"):
        formatter.write_dl([record for n in shown if (record := OPTIONS[n].get_help_record(context))])
    return formatter.getvalue().rstrip("\n")


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
