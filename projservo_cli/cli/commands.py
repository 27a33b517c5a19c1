"""Commands: what there is, what belongs together, what help says."""

import copy
from collections.abc import Mapping
from dataclasses import dataclass, field

import click

from projservo_cli.cli.options import OPTIONS


def _variants(output: str = "TABLE", /, **helps: str) -> dict[str, click.Option]:
    """Options as above that mean something of their own, with what ``output`` names."""
    found = {name: copy.copy(OPTIONS[name]) for name in helps}
    for name, text in helps.items():
        found[name].help = text
    if "output" in found:
        found["output"].metavar = output
    return found


_EVERYWHERE = ("json", "quiet", "verbose", "help")
_OF_STAGES = (
    *("config", "sets", "output", "data", "joints", "joint_unit", "noise_px", "lens", "image_size"),
    *("force", "dry_run", "threads"),
)


@dataclass(frozen=True)
class Command:
    """A word of the command line: what it takes and what help says about it.

    ``options`` are the names of those it uses, ``variants`` say in help what they mean here,
    ``example`` is a call. The last of the ``arguments`` may stand for any number of them.
    """

    summary: str
    about: str
    options: tuple[str, ...]
    arguments: tuple[str, ...] = ()
    example: str = ""
    variants: Mapping[str, click.Option] = field(default_factory=dict)
    stage: bool = False

    @property
    def most(self) -> int | None:
        """Number of arguments it takes at most; None for any number."""
        return None if self.arguments and self.arguments[-1].endswith("...") else len(self.arguments)


COMMANDS = {
    "calibrate": Command(
        "Learn the projective kinematics from trial motions.",
        "Estimates both cameras and all joint operators from images alone, simulated from the configuration "
        "or recorded in an observation table (--data).\n\n"
        "--cross-validate and --init become part of the configuration of the run. --suggest works on the "
        "calibration as it is and writes suggestions.csv into the folder of the run, for record --motions.",
        (*_OF_STAGES, "cross_validate", "init", "suggest"),
        stage=True,
        example="projservo calibrate --data trials.csv --joints RRPRRR -o results/mine",
    ),
    "plan": Command(
        "Plan the task as a translation and two rotations.",
        "Partitions the task by the start and goal images and lays a path on which both cameras keep seeing "
        "the face. Calibrates first where needed.",
        _OF_STAGES,
        stage=True,
        example="projservo plan -c configs/ur5.yaml --set trajectory.profile=exponential",
    ),
    "servo": Command(
        "Run the control laws in closed loop.",
        "Runs each law of control.laws (or of --law) to its verdict. Calibrates and plans first where "
        "needed. Exit code 1 when a law of control.must_converge does not converge.\n\n"
        "With --set plant=module:Class (or plant in the configuration) a robot of yours takes the place of "
        "the simulated one. It is driven to the start of the task and from there by each law, and stopped on "
        "every way out.",
        (*_OF_STAGES, "laws", "speed_scale", "confirm", "origin"),
        stage=True,
        example="projservo servo -o results/ur5 --law direct_two --law stacked",
    ),
    "report": Command(
        "Draw the figures and check the paper's claims.",
        "Writes into the folder of the run: the figures, each with its numbers as CSV; the table of claims; "
        "and report.html, one page that tells it all and needs no other file. Makes every stage before it "
        "where needed.\n\n"
        "--view adds view.html, a 3D view of robot, rig, face and paths with a time slider, which needs no "
        "network; it needs pip install 'projservo[view]' and a robot described in metres. --animation adds "
        "animation.gif, what both cameras see under the direct and the classical laws. The page links to "
        "both; a report that is up to date is not made again for them.\n\n"
        "projservo report SWEEP, with the folder of a sweep, writes its statistics and figures instead: "
        "success with intervals, final errors, laws compared on the same tasks.",
        (*_OF_STAGES, "view", "animation"),
        stage=True,
        example="projservo calibrate plan servo report -c configs/ur5.yaml -o results/ur5 --view",
    ),
    "record": Command(
        "Drive the robot through trial motions and write a table.",
        "Drives the robot of a configuration, simulated or yours, through its trial motions (and --motions), "
        "in steps that the joint-speed limit allows, and writes what both cameras see into an observation "
        "table for calibrate --data.\n\n"
        "The table grows as the robot goes. After an interruption the same command continues it; a table of "
        "another configuration is refused, unless --force begins anew.",
        (
            *("config", "sets", "output", "motions", "joint_unit", "force", "dry_run"),
            *("speed_scale", "confirm"),
        ),
        variants=_variants(
            config="Configuration (YAML). Default: paper.yaml.",
            output="Observation table to write (CSV).",
            motions="Further poses after the trial motions, a row each, with columns q1 ... qN.",
            joint_unit="Unit of the revolute joints of --motions. Default: rad.",
            force="Begin anew, whatever stands in the table.",
        ),
        example="projservo record -c configs/stanford.yaml --output trials.csv",
    ),
    "detect": Command(
        "Find ArUco or AprilTag markers in images and write a table.",
        "Finds tags in the images of two folders (or quoted patterns such as 'left/*.png'), with corners to "
        "a fraction of a pixel, and writes an observation table for calibrate --data. Needs OpenCV: "
        "pip install 'projservo[detect]'.\n\n"
        "The list of joint readings (--joints-csv) says which images belong together. With columns left and "
        "right, these are the names of the two images. With a column pose, images are those whose name ends "
        "in that number. With neither, both folders are taken in the order of their names, one image a row; "
        "image_2 comes before image_10.\n\n"
        "With --points corners, corner k of tag t is marker 4 t + k, in the order of the dictionary: top "
        "left, top right, bottom right, bottom left. With --points centers, tag t is marker t, at the "
        "crossing of its diagonals. Readings are copied as they are: say --joint-unit deg on calibrate where "
        "they are degrees.",
        ("output", "joints_csv", "dictionary", "points", "force"),
        ("LEFT", "RIGHT"),
        variants=_variants(
            output="Observation table to write (CSV).",
            joints_csv="Joint readings, a row a pose: columns q1 ... qN, perhaps pose or left, right.",
            dictionary="The tags, such as 4X4_50, ARUCO_ORIGINAL, APRILTAG_36H11.",
            points="Four markers a tag, or one.",
            force="Replace the table if there is one.",
        ),
        example="projservo detect images/left images/right --joints-csv q.csv --output tags.csv",
    ),
    "sweep": Command(
        "Make many runs over a grid of values and random draws.",
        "Makes the runs of a sweep (configs/sweep_noise.yaml shows one) in parts that are stored as they are "
        "done, and assembles them to one table, sweep.h5, which xarray.open_dataset reads. Interrupted or "
        "killed, the same command goes on where it was. What a run does depends on its number alone: "
        "projservo servo --from SWEEP:INDEX makes any of them anew.\n\n"
        "projservo report SWEEP writes statistics and figures. With --scheduler the workers of a Dask "
        "cluster do the work; it needs pip install 'projservo[cluster]' here and there.",
        ("config", "sets", "output", "force", "dry_run", "threads", "scheduler"),
        variants=_variants(
            "DIR",
            config="Configuration of the sweep (YAML).",
            sets="Override a value of the sweep, such as runs=10.",
            output="Folder of the sweep. Default: results/<name of the sweep>.",
            force="Begin anew, whatever is in the folder.",
            threads="Processes. Default: all processors.",
        ),
        example="projservo sweep -c configs/sweep_noise.yaml -j 2",
    ),
    "validate": Command(
        "Predict held-out images with a calibration.",
        "Compares the pixels of an observation table (--data) with those the calibration of a run predicts "
        "at the table's joint readings.",
        ("output", "data", "joint_unit"),
        ("RUN",),
        example="projservo validate results/mine --data validation.csv",
    ),
    "show": Command(
        "Show what a run holds and how it was made.",
        "Lists the results in a run, whether each is up to date, and what it was made with.",
        ("output",),
        ("[RUN]",),
        example="projservo show results/ur5 --json",
    ),
    "compare": Command(
        "Show runs side by side on one page.",
        "Writes one page like report.html with the differences of the configurations, and calibrations, "
        "plans, laws, claims and figures beside each other.",
        ("output", "force"),
        ("RUN", "RUN ..."),
        example="projservo compare results/paper results/ur5 -o both.html",
        variants=_variants(
            "PAGE",
            output="Page to write. Default: compare.html.",
            force="Replace the page if there is one.",
        ),
    ),
    "export": Command(
        "Write all arrays of a run as CSV, MATLAB or NumPy files.",
        "--to csv writes a folder with a table for each result, a column for each index of an array, and "
        "fields.csv, which says what every array is, in which unit. --to mat and --to npz write one file, "
        "with servo.direct_two.q or a name such as servo/direct_two/q.",
        ("output", "to", "force"),
        ("RUN",),
        example="projservo export results/ur5 --to mat",
        variants=_variants(
            "PATH",
            output="Folder (csv) or file to write. Default: csv, run.mat or run.npz beside run.h5.",
            force="Replace what is there.",
        ),
    ),
    "bench": Command(
        "Measure the speed of a control step and of a run.",
        "Times a step of every law in 256 states of a noisy run, a call from Python, a traced run of 150 "
        "steps and runs in two threads, in turn with one numpy.linalg.svd of an 8x6 matrix.",
        ("config", "sets"),
        variants=_variants(config="Configuration (YAML) with a simulated task. Default: paper.yaml."),
        example="projservo bench --json",
    ),
    "cases": Command(
        "Run degenerate and adverse tasks and print what becomes of them.",
        "Calibrates the paper's arm once and runs exact, direct_two and direct_three on turns from 0 to 180 "
        "degrees about the roll axis and tilted ones, parallel, coplanar and opposite faces, tasks without "
        "translation or rotation, across a singularity and into a joint limit, and on the 180 degree turn "
        "with noise, lost markers, a bump, a slip, a frozen reading and late images. Prints a row a case: "
        "verdict, steps, final errors and self-occluded steps of each law; --json also says what each case "
        "sets in the configuration. A law that ends badly is a result, not a failure of the call.",
        ("sets", "output", "force"),
        variants=_variants(
            "TABLE",
            output="Table to write as well (CSV).",
            force="Replace the table if there is one.",
        ),
        example="projservo cases --set noise.servo_px=0.5 -o cases.csv",
    ),
    "equations": Command(
        "List the equations of the paper and the code of each.",
        "Prints number, title, function, test and erratum of every equation.",
        (),
        example="projservo equations --json",
    ),
    "init": Command(
        "Write a commented configuration to start from.",
        "Writes a configuration that runs as it is, with a comment on every key, and beside it the schema by "
        "which editors complete and check it.",
        ("force",),
        ("[FILE]",),
        example="projservo init mine.yaml",
        variants=_variants("", force="Replace the file if there is one."),
    ),
    "schema": Command(
        "Print the JSON Schema of the configuration.",
        "Editors that speak YAML complete and check a configuration whose first line names the schema: "
        "# yaml-language-server: $schema=FILE. That of sweeps is projservo schema sweep.",
        ("output",),
        ("[sweep]",),
        example="projservo schema -o schema.json",
        variants=_variants("FILE", output="File to write. Default: standard output."),
    ),
    "doctor": Command(
        "Say what is installed and where things go.",
        "Lists versions, extras, whether the kernels are compiled, and the folder of results. Exit code 1 "
        "when something is missing that every run needs.",
        (),
        example="projservo doctor --json",
    ),
}


def allowed(names: list[str]) -> set[str]:
    """Options that at least one of the named commands uses."""
    return {option for name in names for option in (*COMMANDS[name].options, *_EVERYWHERE)}


def help_text(names: list[str]) -> str:
    """Help on the named commands, or on all of them where none is named."""
    formatter = click.HelpFormatter(width=80, max_width=80)
    variants: Mapping[str, click.Option] = {}
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
        words = " ".join([*names, *command.arguments])
        formatter.write_usage("projservo", f"{words} [OPTIONS]")
        for text in "\n\n".join(COMMANDS[name].about for name in names).split("\n\n"):
            formatter.write_paragraph()
            formatter.write_text(text)
        shown = [name for name in OPTIONS if name in allowed(names)]
        variants = command.variants
        with formatter.section("Example"):
            formatter.write_text(command.example)
    context = click.Context(click.Command("projservo"))
    with formatter.section("Options"):
        options = [variants.get(name, OPTIONS[name]) for name in shown]
        formatter.write_dl([record for option in options if (record := option.get_help_record(context))])
    return formatter.getvalue().rstrip("\n")
