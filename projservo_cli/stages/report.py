"""Stage report: figures after the paper's, and its claims against what the runs measure."""

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from projservo_cli import provenance
from projservo_cli.config import load_config
from projservo_cli.figures.drift import converged, drift_rows, table
from projservo_cli.figures.material import DIRECT, Fit, Material, Studies
from projservo_cli.files import replacing
from projservo_cli.page import ANIMATION_FILE, PAGE_FILE, VIEW_FILE, write_page
from projservo_cli.records import Report, WorkFailed
from projservo_cli.stages import Progress, silent
from projservo_cli.stages.chain import has_task
from projservo_cli.stages.claims import claims_of
from projservo_cli.stages.drawing import draw_all, drawing_beside
from projservo_cli.stages.noisy import DRAWS, NOISE_PX, noisy_runs
from projservo_cli.stages.studies import (
    LAMBDAS,
    STEP_LIMIT_DEG,
    Bench,
    bench_of,
    composition_error,
    metric_plan,
    run_studies,
)
from projservo_cli.store import Result

if TYPE_CHECKING:
    from projservo_cli.config import Config
    from projservo_cli.store import Run

DEPENDS_ON = ("report",)
CLAIMS_FILE = "claims.json"


def run(run: "Run", directory: Path, *, progress: Progress = silent) -> Report:
    """Make the extra runs, draw the figures, measure the claims and write the page that tells all.

    Parameters
    ----------
    run : with calibration, plan and traces; where there is no task, with the calibration.
    directory : folder of the run; receives ``figures/``, ``claims.json`` and ``report.html``.
    progress : told how far it is.

    Raises
    ------
    InputError
        If the run lacks what the stage needs, or a file cannot be written.
    """
    config = load_config(run.path, text=run.configuration)
    left_out: list[dict[str, str]] = []
    formats = config.report.formats
    if not has_task(config):
        fit = Fit(run.calibration, run.observation, held_out=run.cross_validation)
        written = draw_all(fit, directory, formats, left_out, progress)
        return _told(_record(None, None, tuple(written), tuple(left_out), ()), run, directory)
    with drawing_beside() as beside:
        bench = bench_of(config, run.calibration.model(), run.plan)
        material = material_of(run, bench, left_out, progress)
        written = draw_all(material, directory, formats, left_out, progress, beside)
    eq22 = _composition(bench, config, left_out)
    claims = tuple(claim.row() for claim in claims_of(material, eq22))
    return _told(_record(material.studies, eq22, tuple(written), tuple(left_out), claims), run, directory)


def _told(report: Report, run: "Run", directory: Path) -> Report:
    """The report, after writing its claims and its page beside the figures."""
    _write_claims(report, directory / CLAIMS_FILE)
    for name in (VIEW_FILE, ANIMATION_FILE):  # of other runs than those that are reported on now
        (directory / name).unlink(missing_ok=True)
    config = load_config(run.path, text=run.configuration)
    made = Result("", run.configuration, provenance.collect(seed=config.seed), {}, {"": report})
    write_page(replace(run, results={**run.results, "report": made}))
    return report


def missing(run: "Run") -> bool:
    """Whether a file that the stored report wrote is not there any more."""
    figures = run.results["report"].records[""].figures
    return not all((run.path.parent / name).is_file() for name in (*figures, CLAIMS_FILE, PAGE_FILE))


def material_of(run: "Run", bench: Bench, left_out: list[dict[str, str]], progress: Progress) -> Material:
    """All that the figures may show; extra runs that fail are named in ``left_out``."""
    truth, studies, reason = bench.truth, None, ""
    try:
        studies = run_studies(bench, progress=progress)
    except WorkFailed as error:
        reason = " ".join(str(error).split())
        left_out.append({"what": "studies", "reason": reason})
    numbers = tuple(truth.number[i] for i in truth.face)
    calibrated = bench.models["calibrated"]
    material = Material(
        run.calibration,
        run.observation,
        calibrated,
        truth.robot,
        bench.plant,
        run.plan,
        numbers,
        run.traces,
        studies,
        reason,
        held_out=run.cross_validation,
    )
    if material.compared():
        material = _with_noise(material, run, bench, left_out)
    return material


def _with_noise(material: Material, run: "Run", bench: Bench, left_out: list[dict[str, str]]) -> Material:
    """The material with the noisy runs that compare the modes; named in ``left_out`` where they fail."""
    config = load_config(run.path, text=run.configuration)
    sigma = config.noise.servo_px or NOISE_PX
    try:
        noisy = noisy_runs(bench, config, run.calibration, run.plan, material.compared(), sigma)
    except WorkFailed as error:
        left_out.append({"what": "runs with noise", "reason": " ".join(str(error).split())})
        return material
    for name, runs in noisy.items():
        if len(runs) < DRAWS:
            reason = f"{DRAWS - len(runs)} of {DRAWS} with {sigma:g} px of noise ended early"
            left_out.append({"what": f"runs with noise of {name}", "reason": reason})
    noisy = {name: runs for name, runs in noisy.items() if len(runs) > 1}
    return replace(material, noisy=noisy, noise_px=sigma)


def _composition(
    bench: Bench, config: "Config", left_out: list[dict[str, str]]
) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]] | None:
    try:
        distance, _ = composition_error(metric_plan(bench, config.trajectory.delta))
    except WorkFailed as error:
        left_out.append({"what": "equation (22)", "reason": " ".join(str(error).split())})
        return None
    return np.array(LAMBDAS), distance


def _record(
    studies: Studies | None,
    eq22: tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]] | None,
    figures: tuple[str, ...],
    left_out: tuple[dict[str, str], ...],
    claims: tuple[dict[str, Any], ...],
) -> Report:
    nothing = np.zeros((len(DIRECT), 2, 2, 0))
    share, distance = eq22 if eq22 is not None else (np.zeros(0), np.zeros(0))
    period_drift = np.zeros((len(DIRECT), 0))
    if studies is not None:
        rows = [
            [studies.rate[law, period].center_deviation_mm for period in studies.periods] for law in DIRECT
        ]
        period_drift = np.array(rows, dtype=np.float64)
    return Report(
        figures=figures,
        left_out=left_out,
        claims=claims,
        step_limit_deg=STEP_LIMIT_DEG,
        gain_per_step=np.array(studies.gains if studies is not None else ()),
        drift_mm=nothing if studies is None else table(studies),
        drift_at_samples_mm=nothing if studies is None else table(studies, at_samples=True),
        drift_converged=nothing.astype(np.bool_) if studies is None else converged(studies),
        period=np.array(studies.periods if studies is not None else ()),
        period_drift_mm=period_drift,
        share=share,
        composition_mm=1e3 * distance,
    )


def _write_claims(report: Report, path: Path) -> None:
    """Claims and drift table as strict JSON."""
    content = {"claims": report.claims, "drift": drift_rows(report), "left_out": report.left_out}
    text = json.dumps(content, ensure_ascii=False, allow_nan=False, indent=2)
    with replacing(path) as temporary:
        temporary.write_text(f"{text}\n", encoding="utf-8")
