"""Stage report: figures after the paper's, and its claims against the measured runs."""

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from projservo_cli import provenance
from projservo_cli.files import replacing, require_inside, write_whole
from projservo_cli.image_size import ImageSize
from projservo_cli.records import VIEWS, Report, Trace, WorkFailed
from projservo_cli.report import style
from projservo_cli.report.animation import motion_of, write_animation, write_view
from projservo_cli.report.claims import claims_of
from projservo_cli.report.figures import FIGURES
from projservo_cli.report.figures.path_deviation import drift_rows, study_numbers
from projservo_cli.report.figures.scene import chosen_poses, metric_rows
from projservo_cli.report.page import write_page
from projservo_cli.report.report_data import (
    ANIMATION_FILE,
    CLAIMS_FILE,
    DIRECT,
    VIEW_FILE,
    Driven,
    Fit,
    ReportData,
    Studies,
)
from projservo_cli.simulation.workspace import plant_of
from projservo_cli.stages import Progress, silent
from projservo_cli.stages.carried_goals import in_metres
from projservo_cli.stages.stage_inputs import ReportInputs, Scenery
from projservo_cli.stages.studies import (
    STEP_LIMIT_DEG,
    Comparison,
    comparison_of,
    composition_of,
    metric_plan,
    run_studies,
)
from projservo_cli.store import Result
from projservo_cli.store.observation_tables import to_csv
from projservo_cli.task.face import cyclic_order

if TYPE_CHECKING:
    from projservo_cli.store import Run

FOLDER = "figures"
_OF_ONE = "figures and claims are of one motion, and the task is a sequence: name a goal, --goal NAME"
_NUMBERS = "csv"  # the numbers of each figure
# Reasons why a figure of extra runs is left out.
_WHY_NONE = "the extra runs could not be made: {}"
_NOT_ASKED = f"extra runs and claims are of {' and '.join(DIRECT)}: name both in control.laws"


def run(inputs: ReportInputs, run: "Run", directory: Path, *, progress: Progress = silent) -> Report:
    """Make the extra runs, draw the figures, measure the claims and write the page.

    run : with calibration, plan and traces; where there is no task, with the calibration. Of a robot without
        a model the page has plan and runs, and the figures that need no model.
    directory : folder of the run; receives ``figures/``, ``claims.json`` and ``report.html``.
    """
    left_out: list[dict[str, str]] = []
    report_data: Fit = Fit(run.calibration, run.observation.at_rest, held_out=run.cross_validation)
    metric, no_metric = in_metres(run.calibration, inputs.lengths)
    studies, composition, claims = None, None, []
    if inputs.extra is not None:
        bench = comparison_of(inputs.extra, run.calibration, run.plan)
        of_paper = set(DIRECT) <= run.traces.keys()
        if of_paper:
            with _unless_it_fails("studies", left_out):
                studies = run_studies(bench, progress=progress)
        report_data = _report_data(inputs, run, bench, studies, left_out)
        if of_paper:
            with _unless_it_fails("equation (22)", left_out):
                composition = composition_of(metric_plan(bench), bench.scenario.gains)
            claims = [claim._asdict() for claim in claims_of(report_data, composition)]
    elif run.traces:
        *_, last = run.traces
        part = last.split("/")[0] if "/" in last else ""
        plan, lacks = (run.at_step(part).plan, _OF_ONE) if part else (run.plan, Driven.lacks)
        known = run.calibration, run.observation.at_rest, plan, run.traces, lacks
        report_data = Driven(*known, held_out=run.cross_validation)
    report_data = replace(report_data, metric=metric, no_metric=no_metric)
    figures = _draw_all(report_data, directory, inputs.formats, left_out, progress)
    report = Report(
        figures=tuple(figures),
        omitted=tuple(left_out),
        claims=tuple(claims),
        metric=() if metric is None else tuple(metric_rows(metric, chosen_poses(metric, report_data))),
        step_limit_deg=STEP_LIMIT_DEG,
        share=np.zeros(0) if composition is None else composition.share,
        composition_mm=np.zeros(0) if composition is None else 1e3 * composition.distance,
        **study_numbers(studies),
    )
    content = {"claims": report.claims, "drift": drift_rows(report), "omitted": report.omitted}
    text = json.dumps(content, ensure_ascii=False, allow_nan=False, indent=2)
    write_whole(directory / CLAIMS_FILE, f"{text}\n")
    for name in (VIEW_FILE, ANIMATION_FILE):  # of other runs than those that are reported on now
        (directory / name).unlink(missing_ok=True)
    result = Result("", run.configuration, provenance.collect(seed=inputs.about.seed), {}, {"": report})
    write_page(replace(run, results={**run.results, "report": result}), inputs.about)
    return report


@contextmanager
def _unless_it_fails(what: str, left_out: list[dict[str, str]]) -> Iterator[None]:
    """Do something that a report can be without; where it fails, say why."""
    try:
        yield
    except WorkFailed as error:
        left_out.append({"what": what, "reason": " ".join(str(error).split())})


def _report_data(
    inputs: ReportInputs,
    run: "Run",
    bench: Comparison,
    studies: Studies | None,
    left_out: list[dict[str, str]],
) -> ReportData:
    """All that figures may show and claims be about."""
    truth = bench.truth
    return ReportData(
        calibration=run.calibration,
        observation=run.observation.at_rest,
        calibrated=bench.models["calibrated"],
        robot=truth.robot,
        plant=bench.scenario.plant_of("direct_three"),
        plan=run.plan,
        numbers=tuple(truth.number[i] for i in truth.face),
        traces=run.traces,
        studies=studies,
        no_studies=_WHY_NONE.format(left_out[-1]["reason"]) if left_out else "" if studies else _NOT_ASKED,
        stall_periods=bench.scenario.termination.stall_periods,
        held_out=run.cross_validation,
        trajectory=inputs.trajectory,
    )


def _draw_all(
    report_data: Fit,
    directory: Path,
    formats: Sequence[str],
    left_out: list[dict[str, str]],
    progress: Progress = silent,
) -> list[str]:
    """Draw every figure that the material supports, in all formats; the others are named with the reason.

    Files that an earlier report left of them, and formats that are not asked for now, are removed. Returns
    files written, relative to the folder.
    """
    folder = directory / FOLDER
    require_inside(folder, directory)
    written: list[str] = []
    for done, spec in enumerate(FIGURES):
        progress("figures", done, len(FIGURES))
        contents: dict[str, bytes] = {}
        if reason := spec.lacking(report_data):
            left_out += [] if spec.optional else [{"what": spec.name, "reason": reason}]
        else:
            if partial := spec.partly(report_data):
                left_out.append({"what": f"{spec.name}, in part", "reason": partial})
            data = spec.data(report_data)
            numbers = {name: array for name, array in data.items() if array.dtype != np.uint8}
            if tuple(data.get("view", VIEWS)) == VIEWS:  # which need no names
                numbers.pop("view", None)
            contents = {_NUMBERS: to_csv(numbers).encode(), **style.contents(spec.drawn(data), formats)}
        for kind in {*style.FORMATS, _NUMBERS} - {*contents}:
            (folder / f"{spec.name}.{kind}").unlink(missing_ok=True)
        for kind, content in contents.items():
            with replacing(folder / f"{spec.name}.{kind}", durable=False) as path:
                path.write_bytes(content)
        written += [f"{FOLDER}/{spec.name}.{kind}" for kind in contents if kind != _NUMBERS]
    progress("figures", len(FIGURES), len(FIGURES))
    return written


def view(scenery: Scenery, run: "Run", progress: Progress = silent) -> Path:
    """Write the 3D view of a run into its folder; a WorkFailed says that no run has a step to show."""
    truth, traces = scenery.truth, _moved(run)
    plant = plant_of(truth, run.plan.q_start, opaque=scenery.opaque)
    joints = "simulated joints" if scenery.simulated else "joints that the robot itself reported"
    known = f"Robot, rig and face as the configuration describes them, moved by the {joints}."
    path = run.path.parent / VIEW_FILE
    progress("view", 0, 1)
    motion = motion_of(truth.robot, plant, truth.M, run.plan, traces)
    write_view(path, motion, name=scenery.name, known=known)
    progress("view", 1, 1)
    return path


def animation(size: ImageSize | None, run: "Run", progress: Progress = silent) -> Path:
    """Write the film of both camera images into the folder of a run, as GIF; fails as ``view`` does.

    size : width and height, px, of both images or of one each, if known.
    """
    path, traces = run.path.parent / ANIMATION_FILE, _moved(run)
    write_animation(path, traces, cyclic_order(run.plan.A), size, progress)
    return path


def _moved(run: "Run") -> dict[str, Trace]:
    moved = {name: trace for name, trace in run.traces.items() if trace.steps > 0}
    if not moved:
        raise WorkFailed("no run of a law has a step to show; make one: projservo servo")
    return moved
