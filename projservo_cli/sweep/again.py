"""One run of a sweep made anew, as an ordinary run file."""

from dataclasses import replace
from pathlib import Path

from projservo_cli.config import Config
from projservo_cli.records import InputError, WorkFailed
from projservo_cli.stages.chain import steps_for
from projservo_cli.store import TABLE, Result, Run, load
from projservo_cli.sweep.driver import Folder, stored_design
from projservo_cli.sweep.preparation import REFUSED, calibration_path, read_tasks


def folder_of(target: Path | str) -> Folder:
    """The folder of a sweep, by its name or by that of its table."""
    path = Path(target)
    return Folder(path.parent if path.name == TABLE else path)


def run_of(target: str) -> tuple[Config, Result | None]:
    """Configuration of a run of a sweep, and the calibration it was made with.

    Parameters
    ----------
    target : SWEEP:INDEX, the folder of a sweep (or its table) and the number of the run.

    Returns
    -------
    The calibration is None where the sweep has not come to it yet.

    Raises
    ------
    InputError
        If there is no such sweep or run.
    WorkFailed
        If the calibration of the run was refused.
    """
    sweep, sign, index = target.rpartition(":")
    if not sign or not sweep or not index.isdecimal():
        raise InputError(f"--from {target}: expected SWEEP:INDEX, such as results/sweep_noise:17")
    folder = folder_of(sweep)
    design = stored_design(folder)
    at = design.numbers(int(index))
    base = design.base_of(at.cell)
    tasks = {}
    if design.sweep.tasks is not None:
        tasks[base] = read_tasks(folder.path / f"tasks_{design.bases[base][0]}.npz")
    config = design.config(at.run, tasks).model_copy(update={"name": f"{design.sweep.name}-{at.run}"})
    path = calibration_path(folder.path, design.calibration_key(at.cell, at.calibration))
    refused = path.with_suffix(REFUSED)
    if refused.exists():
        raise WorkFailed(f"run {at.run}: {refused.read_text(encoding='utf-8').strip()}")
    if not path.exists():
        return config, None
    (step,) = steps_for(config, Run(path), ["calibrate"])
    return config, replace(load(path).results["calibrate"], key=step.key)
