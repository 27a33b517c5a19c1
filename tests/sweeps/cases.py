"""Small sweeps of a robot with few trial motions, quick enough to be made many times."""

from projservo_cli.config.sweep import SweepConfig
from projservo_cli.store.sweep_table import SweepTable
from projservo_cli.sweeps.design import read_design
from projservo_cli.sweeps.folder import Folder, run_sweep
from projservo_cli.sweeps.workers import Engine
from tests.conftest import ROOT

QUICK = {"stop.max_steps": 60, "noise.servo_px": 0.3, "calibration.frames_per_joint": 6}


def design(**given):
    """A sweep of the UR5, by default one cell of each of two laws."""
    base = given.pop("base", "ur5")
    bases = [base] if isinstance(base, str) else base
    values = {
        "name": "small",
        "base": [str(ROOT / "configs" / f"{name}.yaml") for name in bases],
        "runs": 4,
        "set": QUICK | given.pop("set", {}),
        "grid": {"law": ["direct_two", "stacked"]},
    }
    return read_design(SweepConfig.model_validate(values | given))


def make(found, path, workers=1, progress=lambda *_: None, **options):
    """Run a sweep into a folder; its status."""
    return run_sweep(found, Folder(path), Engine(workers), progress, lambda _: None, **options)


def columns(path):
    """All columns of the table in a folder."""
    table = SweepTable(Folder(path).table)
    return {name: table.column(name) for name in table.names}
