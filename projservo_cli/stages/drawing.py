"""The figures of a report as files, drawn in two processes where there are two processors.

Drawing is most of the time of a report and holds the interpreter's lock, so that threads would not
help. A second process starts while the first one prepares what is drawn; it gets every other figure.
"""

import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from projservo_cli.columns import to_csv
from projservo_cli.figures import FIGURES, FigureSpec, style
from projservo_cli.figures.material import Data, Fit, Material
from projservo_cli.files import replacing, require_inside
from projservo_cli.stages import Progress, silent

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
