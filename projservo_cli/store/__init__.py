"""Run files and tables of sweeps; nothing else opens HDF5."""

from projservo_cli.store.run_file import SERVO, Result, Run, load, run_path, save
from projservo_cli.store.sweep_table import TABLE, SweepTable, assemble, write_part

__all__ = [
    "SERVO",
    "TABLE",
    "Result",
    "Run",
    "SweepTable",
    "assemble",
    "load",
    "run_path",
    "save",
    "write_part",
]
