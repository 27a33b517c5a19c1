"""``projservo validate``: how well a calibration predicts images it has not seen."""

from typing import Any

import click

from projservo_cli.cli.options import wrapped
from projservo_cli.cli.output import Console, print_json

# Predictions so many times the noise away come from another robot, or from other units.
FAR = 20.0


def run(names: list[str], rest: list[str], options: dict[str, Any]) -> int:
    """Compare an observation table with the predictions of a run's calibration; the exit code."""
    del names
    if options["data"] is None:
        raise click.UsageError("validate needs an observation table: --data TABLE")
    if not rest and options["output"] is None:
        raise click.UsageError("validate needs a run: projservo validate RUN --data TABLE")
    if rest and options["output"] is not None:
        raise click.UsageError("validate takes one run, as an argument or with -o")
    from projservo_cli.config import load_config
    from projservo_cli.store import load
    from projservo_cli.tables import read_table

    found = load(rest[0] if rest else options["output"])
    calibration = found.calibration
    unit = options["joint_unit"]
    if unit is None:
        config = load_config(found.path, text=found.results["calibrate"].configuration)
        unit = config.data.joint_unit if config.data is not None else None
    observation = read_table(options["data"], calibration.joint_types, unit)
    from projservo_cli.calibration import residual_statistics

    statistics = residual_statistics(calibration, observation)
    value = {"run": found.path.resolve(), **statistics}
    console = Console(quiet=options["quiet"], verbose=options["verbose"])
    if value["count"] and value["median_px"] > FAR * calibration.sigma_px:
        console.say(
            f"validate: the median is {value['median_px'] / calibration.sigma_px:.3g} times the noise of "
            "the calibration: are these the same robot, rig and markers, with joints in the same units?"
        )
    if options["json"]:
        print_json(value)
        return 0
    skipped = ", ".join(f"{count} {why.replace('_', ' ')}" for why, count in value["skipped"].items())
    console.show(wrapped(f"validate: {value['count']} marker-view pairs; skipped: {skipped}"))
    if value["count"]:
        console.show(
            "  residual px: rms {rms_px:.4g}, median {median_px:.4g}, p95 {p95_px:.4g}".format_map(value)
        )
    return 0
