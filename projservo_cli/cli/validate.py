"""The command ``validate``: predict new images, or positions of the tool."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from projservo_cli.cli import options as option
from projservo_cli.cli.output import Console, wrapped
from projservo_cli.cli.program import main

# Squared error over its covariance that reveals another robot, or other units.
_FAR = 20.0


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
