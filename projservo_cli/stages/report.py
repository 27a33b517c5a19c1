"""Stage report: figures after the paper's, and its claims against what the runs measure."""

import json
import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from projservo_cli import provenance
from projservo_cli.config import load_config
from projservo_cli.files import replacing, require_inside
from projservo_cli.records import FloatArray, InputError, Report, Trace, WorkFailed
from projservo_cli.report import animation as film
from projservo_cli.report import style
from projservo_cli.report.claims import claims_of
from projservo_cli.report.figures import FIGURES, FigureSpec
from projservo_cli.report.figures.drift import converged, drift_rows, table
from projservo_cli.report.material import DIRECT, Data, Fit, Material, Studies
from projservo_cli.report.page import write_page
from projservo_cli.report.values import ANIMATION_FILE, PAGE_FILE, VIEW_FILE
from projservo_cli.report.view import motion, plotly, write_view
from projservo_cli.stages import Progress, silent
from projservo_cli.stages.chain import has_task
from projservo_cli.stages.noisy import DRAWS, NOISE_PX, noisy_runs
from projservo_cli.stages.scenario import Truth, plant_of, truth_of
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
from projservo_cli.tables import to_csv
from projservo_cli.task.face import cyclic_order

if TYPE_CHECKING:
    from projservo_cli.config import Config
    from projservo_cli.store import Run

FOLDER = "figures"
NUMBERS = "csv"  # what is drawn, beside each figure
Process = subprocess.Popen[bytes]


class Drawing(NamedTuple):
    """One figure to draw.

    Attributes
    ----------
    name : of the figure.
    data : what it shows.
    folder : it is written to.
    formats : it is written in.
    """

    name: str
    data: Data
    folder: Path
    formats: tuple[str, ...]


@contextmanager
def drawing_beside() -> Iterator[Process | None]:
    """A second process that waits for drawings, at most as long as the block lasts.

    None where there is only one processor to draw on.
    """
    if _processors() < 2:
        yield None
        return
    command = [sys.executable, "-P", "-m", __name__, str(os.getpid())]
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        yield process
    finally:
        process.terminate()
        process.communicate()


def _processors() -> int:
    """Processors this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def draw_all(
    material: Fit,
    directory: Path,
    formats: tuple[str, ...],
    left_out: list[dict[str, str]],
    progress: Progress = silent,
    beside: Process | None = None,
) -> list[str]:
    """Draw every figure that the material supports, in all formats; the others are named with the reason.

    Files of figures that are left out now, from an earlier report, are removed.

    Parameters
    ----------
    beside : process from ``drawing_beside``, which draws every other figure and ends.

    Returns
    -------
    Files written, relative to the folder.
    """
    require_inside(directory / FOLDER, directory)
    drawings = _prepare(material, directory / FOLDER, formats, left_out)
    theirs = drawings[1::2] if beside is not None else []
    mine = drawings[::2] if beside is not None else drawings
    if beside is not None:
        _send(beside, theirs)
    _draw(mine, progress, len(drawings))
    if beside is not None and beside.wait() != 0:
        _draw(theirs, progress, len(drawings))  # here what is wrong can be told
    progress("figures", len(drawings), len(drawings))
    return [f"{FOLDER}/{drawing.name}.{kind}" for drawing in drawings for kind in formats]


def _prepare(
    material: Fit, folder: Path, formats: tuple[str, ...], left_out: list[dict[str, str]]
) -> list[Drawing]:
    """What can be drawn; files that will not be written again are removed."""
    drawings = []
    for spec in FIGURES:
        reason, partial = lacking(spec, material), partly(spec, material)
        if reason:
            left_out.append({"what": spec.name, "reason": reason})
        elif partial:
            left_out.append({"what": f"{spec.name}, in part", "reason": partial})
        kinds = () if reason else (*formats, NUMBERS)
        for kind in {*style.FORMATS, NUMBERS} - {*kinds}:
            (folder / f"{spec.name}.{kind}").unlink(missing_ok=True)
        if not reason:
            drawings.append(Drawing(spec.name, spec.data(material), folder, formats))
    return drawings


def _send(process: Process, drawings: Sequence[Drawing]) -> None:
    assert process.stdin is not None
    try:
        with process.stdin as stream:
            pickle.dump(drawings, stream)
    except BrokenPipeError:
        pass  # it has ended; its return code tells


def _draw(drawings: Sequence[Drawing], progress: Progress, total: int, parent: int | None = None) -> None:
    with style.styled():
        for done, drawing in enumerate(drawings):
            if parent is not None and os.getppid() != parent:
                return  # it was killed, and another process may work in the folder
            progress("figures", total - len(drawings) + done, total)
            draw(drawing)


def draw(drawing: Drawing) -> None:
    """Write one figure in the formats asked for, with its numbers.

    Raises
    ------
    InputError
        If a file cannot be written.
    """
    spec = next(spec for spec in FIGURES if spec.name == drawing.name)
    with replacing(drawing.folder / f"{spec.name}.{NUMBERS}") as path:
        path.write_text(to_csv(drawing.data), encoding="utf-8")
    figure = style.new_figure(spec.height)
    spec.draw(drawing.data, figure)
    style.arrange(figure)
    for kind, content in style.contents(figure, drawing.formats).items():
        with replacing(drawing.folder / f"{spec.name}.{kind}") as path:
            path.write_bytes(content)


def lacking(spec: FigureSpec, material: Fit) -> str:
    """Why a figure cannot be drawn; empty where it can."""
    if not spec.task:
        return ""
    if not isinstance(material, Material):
        return "the run holds a calibration and no task: set robot, rig, markers and task"
    missing = _without_run(spec, material)
    if missing and (not spec.any_law or len(missing) == len(spec.laws)):
        return f"no run of {', '.join(missing)} with a step to show; make it: projservo servo report"
    if spec.studies and material.studies is None:
        return f"the extra runs could not be made: {material.no_studies}"
    if spec.modes and not material.compared():
        return "no run follows the plan: set control.mode, such as [replan, track], and run servo report"
    if spec.noisy and not material.noisy:
        return "the runs with noise could not be made"
    if spec.goal and not _goal_known(material):
        return "the pose of the goal is unknown, only its images are"
    return ""


def partly(spec: FigureSpec, material: Fit) -> str:
    """What a figure that can be drawn is without; empty where it is whole."""
    missing = _without_run(spec, material) if isinstance(material, Material) else []
    return f"without {', '.join(missing)}: no run of it with a step to show" if missing else ""


def _without_run(spec: FigureSpec, material: Material) -> list[str]:
    return [law for law in spec.laws if law not in material.traces or material.traces[law].steps < 1]


def _goal_known(material: Material) -> bool:
    studies = material.studies
    traces = [*material.traces.values(), *(studies.own.values() if studies is not None else ())]
    return bool(traces) and all(np.isfinite(trace.goal_pose).all() for trace in traces)


def _stop(number: int, frame: Any) -> None:
    """End in a way that removes temporary files."""
    del number, frame
    raise SystemExit(1)


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process that waits decides
    signal.signal(signal.SIGTERM, _stop)
    _draw(pickle.load(sys.stdin.buffer), silent, 0, int(sys.argv[1]))


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


FRAME_MS, LAST_MS = 80, 2000
COLORS = 128


def require_metric(config: "Config") -> Truth:
    """Robot, rig and markers in metres.

    Raises
    ------
    InputError
        If the configuration lacks a part of them, saying what there is instead.
    """
    try:
        return truth_of(config)
    except InputError as error:
        raise InputError(
            "--view: images alone give a robot only up to a projective frame, which has no metres to draw; "
            f"{error}, or use --animation, which shows what the cameras saw"
        ) from error


def require(config: "Config", wanted: Sequence[str]) -> None:
    """Make sure, before any work, that ``view`` and ``animation`` can be made where they are wanted.

    Raises
    ------
    InputError
        If plotly is not installed, the robot is not known in metres, or there is no task.
    """
    if config.task is None:
        raise InputError(
            f"--{wanted[0]}: shows runs of laws, which need a task: set task.start and task.goal"
        )
    if "view" in wanted:
        plotly()
        require_metric(config)


def view(run: "Run", progress: Progress = silent) -> Path:
    """Write the 3D view of a run into its folder.

    Raises
    ------
    InputError
        If plotly is not installed, the robot is not known in metres, or the file cannot be written.
    WorkFailed
        If no run of a law has a step to show.
    """
    config = load_config(run.path, text=run.configuration)
    truth = require_metric(config)
    plant = plant_of(config, truth, run.plan.q_start)
    joints = "simulated joints" if config.plant.use is None else "joints that the robot itself reported"
    known = f"Robot, rig and face as the configuration describes them, moved by the {joints}."
    path = run.path.parent / VIEW_FILE
    progress("view", 0, 2)
    scene = motion(truth.robot, plant, truth.M, run.plan, _moved(run))
    progress("view", 1, 2)
    write_view(scene, path, config.name, known, PAGE_FILE)
    progress("view", 2, 2)
    return path


def animation(run: "Run", progress: Progress = silent) -> Path:
    """Write the film of both camera images into the folder of a run, as GIF.

    Raises
    ------
    InputError
        If the file cannot be written.
    WorkFailed
        If no run of a law has a step to show.
    """
    from PIL import Image

    traces = _moved(run)
    columns = film.strips(traces, cyclic_order(run.plan.A))
    at = film.times(columns, [traces[name].verdict == "converged" for name in film.shown(traces)])
    images = []
    with style.styled():
        for pixels in film.frames(columns, _image_size(run, traces), at):
            images.append(Image.fromarray(pixels))
            progress("animation", len(images), len(at))
    # The last frame has all colours; one palette for all keeps what does not move the same.
    palette = images[-1].quantize(COLORS, method=Image.Quantize.MAXCOVERAGE)
    first, *others = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    path = run.path.parent / ANIMATION_FILE
    with replacing(path) as temporary:
        durations = [*[FRAME_MS] * len(others), LAST_MS]
        first.save(temporary, "GIF", save_all=True, append_images=others, duration=durations, loop=0)
    return path


def _moved(run: "Run") -> dict[str, Trace]:
    moved = {name: trace for name, trace in run.traces.items() if trace.steps > 0}
    if not moved:
        raise WorkFailed("no run of a law has a step to show; make one: projservo servo")
    return moved


def _image_size(run: "Run", traces: dict[str, Trace]) -> FloatArray:
    """Size of the images, px; where it is not known, what reaches around all that was seen."""
    config = load_config(run.path, text=run.configuration)
    given = config.rig.image_size_px if config.rig is not None else config.data and config.data.image_size_px
    if given:
        return np.array(given, dtype=np.float64)
    seen = np.concatenate([trace.s.reshape(-1, 2) for trace in traces.values()])
    return np.asarray(np.nanmax(seen, axis=0) + 1.0)
