"""Commands that read results: ``show``, ``compare``, ``export`` and ``equations``."""

import dataclasses
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click

from projservo_cli.cli import options as option
from projservo_cli.cli.output import Console, words_of, wrapped
from projservo_cli.cli.program import main


@main.command("show", epilog="Example: projservo show results/ur5 --json")
@click.argument("run", required=False, type=option.PATH)
@option.output(metavar="DIR", help="The run, instead of an argument.")
@option.explained
def _show(console: Console, *, run: Path | None, output: Path | None) -> None:
    """Show the contents and the provenance of a run.

    Lists the results in a run, by default of results/paper, with versions and inputs; -v with every
    claim, and the configuration.
    """
    target = option.one_run("show", run, output) or Path("results", "paper")
    from projservo_cli.config import load_config
    from projservo_cli.report.json_objects import stage_object
    from projservo_cli.store.run_file import load

    found = load(target)
    config = load_config(found.path, text=found.configuration)
    laws = list(found.traces)
    stages = list(dict.fromkeys(name.split("/")[0] for name in found.results))
    values = {stage: stage_object(stage, found, config.joint_names, laws) for stage in stages}

    def words() -> Iterator[str]:
        yield f"run: {found.path}"
        yield wrapped(f"configuration: {config.name}, {'recorded' if config.recorded else 'simulated'}")
        for stage, value in values.items():
            yield from words_of(stage, value, detailed=console.verbose)
            result = next(one for name, one in found.results.items() if name.split("/")[0] == stage)
            yield wrapped(_made(result.provenance), "  ")
        if console.verbose:
            yield found.configuration.rstrip()

    made = {name: {"key": result.key, **result.provenance} for name, result in found.results.items()}
    settings = config.model_dump(mode="json")
    value = {"run": found.path.resolve(), "configuration": settings, "made": made, **values}
    console.report(value, words())


def _made(provenance: Any) -> str:
    values = {name: str(value or "") for name, value in provenance.items()}
    commit = values.get("git_commit", "")[:10]
    source = f" at {commit}{' with changes' if values.get('git_dirty') else ''}" if commit else ""
    versions = ", ".join(f"{name} {values.get(name, '?')}" for name in ("python", "numpy", "numba"))
    return (
        f"made {values.get('date', '?')} on {values.get('host', '?')} "
        f"with projservo {values.get('projservo', '?')}{source}, {versions}"
    )


@main.command("compare", epilog="Example: projservo compare results/paper results/ur5 -o both.html")
@click.argument("runs", nargs=-1, required=True, type=option.PATH, metavar="RUN RUN ...")
@option.output(metavar="PAGE", help="Page to write.", default="compare.html", show_default=True)
@option.force(help="Replace the page if there is one.")
@option.explained
def _compare(console: Console, *, runs: tuple[Path, ...], output: Path, force: bool) -> None:
    """Show runs side by side on one page.

    Writes one page like report.html with the differences of the configurations, and calibrations, plans,
    laws, claims and figures side by side.
    """
    if len(runs) < 2:
        raise click.UsageError("compare needs two runs or more: projservo compare RUN RUN")
    from projservo_cli.config import load_config
    from projservo_cli.config.inputs import about_of
    from projservo_cli.report.page import write_comparison
    from projservo_cli.store.run_file import load

    if output.suffix != ".html":
        raise click.UsageError(f"{output}: name a page to write, such as {output.name or 'runs'}.html")
    option.require_new(output, force=force)
    found = [load(target) for target in runs]
    configs = [load_config(run.path, text=run.configuration) for run in found]
    abouts = [(run, about_of(config)) for run, config in zip(found, configs, strict=True)]
    write_comparison(
        abouts, [config.model_dump(mode="json", exclude_none=True) for config in configs], output
    )
    value = {"page": output.resolve(), "runs": [run.path.resolve() for run in found]}
    console.report(value, [f"compare: {len(runs)} runs: {output}"])


_KINDS = {"opencv": "cameras.yaml", "urdf": "robot.urdf", "json": "metric.json", "ros": "cameras.launch.xml"}


@main.command("export", epilog="Example: projservo export results/ur5 --metric 0.06 --between 0,1 --to urdf")
@click.argument("run", type=option.PATH)
@option.output(metavar="DIR", help="Folder to write. Default: the name of the kind, next to run.h5.")
@option.force(help="Replace existing files.")
@click.option("--to", type=click.Choice(["csv", *_KINDS]), default="csv", help="Kind of files.")
@click.option(
    "--metric",
    metavar="M",
    type=option.NUMBER,
    help="A known length, m, for all kinds but csv. See --between.",
)
@click.option(
    "--between",
    metavar="A,B",
    help="Ends of the length: two markers, or tags (their sides), or cameras. Default: a prismatic joint's.",
)
@click.option(
    "--metric-std",
    metavar="M",
    type=option.NUMBER,
    help="Standard deviation of the length, m. Without it, deviations of lengths leave it out.",
)
@click.option(
    "--nominal", metavar="URDF", type=option.PATH, help="Model of the arm, whose zeros and axes are compared."
)
@click.option(
    "--frames",
    type=click.Choice(["own", "model"]),
    default="own",
    show_default=True,
    help="Base and tool frame: by the joints and the face, or as --nominal.",
)
@click.option("--tip", metavar="LINK", help="Link of the model that carries the tool. Default: the last one.")
@option.explained
def _export(
    console: Console,
    *,
    run: Path,
    output: Path | None,
    force: bool,
    to: str,
    metric: float | None,
    between: str | None,
    metric_std: float | None,
    nominal: Path | None,
    frames: str,
    tip: str | None,
) -> None:
    """Write a run as tables, or its cameras and arm in metres.

    With --to csv, writes a table for each result, a column for each index of an array, and fields.csv, which
    gives meaning and unit of every array.

    The other kinds are in metres, by a known length: opencv the cameras for cv2.FileStorage, urdf the arm,
    ros static transforms of the cameras and camera_info of each, json all numbers with their covariances.
    Cameras on the tool come in the frame of the flange: the hand–eye transformation.

    With --nominal it lists the errors of zeros and axes of a model, by significance. With --frames
    model, the cameras are in the base of that model, such as a robot's own, and the tool is its tip. Cameras
    on the tool are in that tip. A model that does not describe the arm, as one in which a joint turns the
    other way, ends in exit code 1, and so does a known length that contradicts its links or a prismatic
    joint, or puts a camera beyond 20 m.
    """
    from projservo_cli.store.run_file import load

    found = load(run)
    folder = output or found.path.parent / to
    if to == "csv":
        if metric is not None or between or nominal is not None:
            raise click.UsageError("--metric, --between and --nominal are for --to opencv, urdf, json or ros")
        option.require_new(folder, force=force)
        files = list(_write_tables(found, folder))
        value = {"run": found.path.resolve(), "files": [file.resolve() for file in files]}
        console.report(value, [f"export: {len(files)} files: {folder}"])
        return
    from projservo_cli.store.files_and_locks import write_whole

    if frames == "model" and nominal is None:
        raise click.UsageError("--frames model needs the model: --nominal URDF")
    option.require_new(folder, force=force)
    model = None if nominal is None else (nominal, tip, frames == "model")
    contents, value, words = _in_metres(found, to, (metric, between, metric_std), model)
    files = [write_whole(folder / name, content) for name, content in contents.items()]
    value = {"run": found.path.resolve(), "files": [file.resolve() for file in files], **value}
    further = [f"  and {file.name}" for file in files[1:]]
    console.report(value, [f"export: {files[0]}", *further, *(wrapped(line, "  ") for line in words)])


def _in_metres(
    run: Any,
    to: str,
    length: tuple[float | None, str | None, float | None],
    model: tuple[Path, str | None, bool] | None,
) -> tuple[dict[str, str], dict[str, Any], list[str]]:
    """Return the texts of files in metres by their names, their JSON object, and a summary in words.

    model : a URDF, its tip, and whether its frames are taken.
    """
    import numpy as np

    from projservo_cli.config import load_config
    from projservo_cli.config.inputs import joints_of
    from projservo_cli.messages import failed, sentence
    from projservo_cli.metric.frame import MetricParameters
    from projservo_cli.metric.nominal_comparison import errors_found, length_contradictions
    from projservo_cli.metric.opencv import opencv_cameras
    from projservo_cli.records import TOOL
    from projservo_cli.results import ImageModel
    from projservo_cli.store import exports

    calibration, config = ImageModel.of(run.calibration), load_config(run.path, text=run.configuration)
    length_m, ends, std = length
    metric = calibration.metric(length_m, _ends(ends or "joint"), length_std_m=std or 0.0)
    value: dict[str, Any] = {"length_std_m": std}
    words = []
    if length_m is not None and std is None:
        words.append(
            f"known length {length_m:g} m ± ? (--metric-std): deviations of lengths leave its own out"
        )
    wrong = tuple(length_contradictions(metric, None, measured=std is not None))
    if model is not None and not wrong:
        errors = metric.errors_of(*model[:2])
        value["nominal"] = [error._asdict() for error in errors.joints]
        value |= {"length_error": errors.length, "length_error_std": errors.length_std}
        words += map(sentence, errors_found(errors, metric.joint_types))
        wrong = tuple(length_contradictions(metric, errors, measured=std is not None))
    if wrong:
        raise failed(wrong, stage="export")
    if model is not None and model[2]:
        metric = metric.in_frames_of(*model[:2])
    if metric.mount == TOOL or metric.by_flange:
        value["mount"] = metric.mount
        words += [f"{view} camera {metric.summary()[f'{view} camera']}" for view in metric.view]
    found = opencv_cameras(metric, calibration)
    if to in ("urdf", "ros"):  # poses of the cameras whose matrices opencv gets
        metric = dataclasses.replace(metric, bodies=MetricParameters(*(part[None] for part in found.body)))
    if to == "opencv":
        value |= {"delta_chi2": found.delta_chi2, "lens_rms_px": found.lens_rms_px}
        words.insert(0, f"cameras without skew cost Δχ² {found.skew_chi2:.3g} (2 on average)")
        if calibration.lens is not None:
            words[0] += f", OpenCV's lens {found.lens_chi2:.2g} ({found.lens_rms_px:.2g} px rms)"
        text = exports.opencv_yaml(found, config.image_size_px, metric.view, metric.mount)
        return {_KINDS[to]: text}, value, words
    if to == "urdf":
        names = [name or f"joint_{i}" for i, name in enumerate(config.joint_names, 1)]
        names += [f"joint_{i}" for i in range(len(names) + 1, len(metric.joint_types) + 1)]
        known = joints_of(config).joints(metric.joint_types, calibration).limits
        limits = np.stack([known.lower, known.upper], axis=1)
        if not np.isfinite(limits).all() and not metric.by_flange:
            words.append("where limits of joints are unknown, they are the readings of the trial motions")
        limits = np.where(np.isfinite(limits), limits, metric.range)
        return {_KINDS[to]: exports.urdf(metric, names, limits)}, value, words
    if to == "ros":
        link = model[1] if model is not None and model[2] else None
        launch = exports.static_transforms(metric, link or exports.FLANGE)
        infos = exports.camera_infos(found, config.image_size_px, metric.view)
        if not infos:
            words.append("camera_info needs the size of the images: calibrate with --image-size")
        return {_KINDS[to]: launch, **infos}, value, words
    return {_KINDS[to]: exports.to_json(metric, value)}, value, words


def _ends(between: str) -> Any:
    """Ends of a length as ``ImageModel.metric`` takes them."""
    try:
        return tuple(int(end) for end in between.split(","))
    except ValueError:
        return between


def _write_tables(run: Any, folder: Path) -> Iterator[Path]:
    """A table of the meanings of all fields, and one for each record."""
    import numpy as np

    from projservo_cli.findings import sparse
    from projservo_cli.records import flat_fields
    from projservo_cli.store.files_and_locks import write_whole
    from projservo_cli.store.observation_tables import to_csv
    from projservo_cli.store.run_file import further_parts

    rows, tables = [], {}
    records: dict[tuple[str, ...], Any] = {
        (name, label): record for name, one in run.results.items() for label, record in one.records.items()
    }
    for place, record in [*records.items()]:
        records |= {(*place, name): part for name, part in further_parts(record)}
    for place, record in records.items():
        # A name that a file can have anywhere.
        file = re.sub(r"\W", "_", "_".join(filter(None, place)), flags=re.ASCII) + ".csv"
        arrays = {}
        for field in flat_fields(type(record)):
            if (value := getattr(record, field.name)) is None:
                continue
            dims, values = field.metadata.get("dims"), ""
            if dims is not None and np.asarray(value).dtype == np.uint8:
                values = "left out: bytes"
            elif dims is not None:
                arrays[field.name] = np.asarray(value)
            elif isinstance(value, (str, float)):
                values = str(value)
            else:
                values = json.dumps(value, ensure_ascii=False, default=sparse)
            about = (field.metadata["units"], field.metadata["about"])
            rows.append((file, field.name, " ".join(dims or ()), *about, values))
        tables[file] = to_csv(arrays, down=0)
    names = ("file", "field", "dimensions", "unit", "about", "value")
    tables["fields.csv"] = to_csv(dict(zip(names, np.array(rows, dtype=object).T, strict=True)))
    for file, text in tables.items():
        yield write_whole(folder / file, text)


@main.command("equations", epilog="Example: projservo equations --json")
@option.explained
def _equations(console: Console) -> None:
    """List the equations of the paper and the code of each.

    Prints number, title, function, test and erratum of every equation.
    """
    from projservo_cli.cli.equations import REGISTER

    def words() -> Iterator[str]:
        for entry in REGISTER:
            yield wrapped(f"({entry.number}) {entry.title}")
            yield from (f"    {function}" for function in entry.functions)
            yield from (f"    tested by {test}" for test in entry.tests)
            if entry.erratum:
                yield wrapped(f"erratum: {entry.erratum}", "    ")

    console.report({"equations": [dataclasses.asdict(entry) for entry in REGISTER]}, words())
