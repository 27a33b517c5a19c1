"""What a report can have beside its page: the 3D view and the animation of a run."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from projservo_cli.config import load_config
from projservo_cli.figures import film, style
from projservo_cli.figures.motion import motion
from projservo_cli.files import replacing
from projservo_cli.page import ANIMATION_FILE, PAGE_FILE, VIEW_FILE
from projservo_cli.page.view import plotly, write_view
from projservo_cli.records import FloatArray, InputError, Trace, WorkFailed
from projservo_cli.stages import Progress, silent
from projservo_cli.stages.truth import Truth, plant_of, truth_of
from projservo_cli.task.face import cyclic_order

if TYPE_CHECKING:
    from projservo_cli.config import Config
    from projservo_cli.store import Run

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
