"""Keep every number of what projservo ships, and compare two such sets.

    OPENBLAS_NUM_THREADS=1 python -m tests.golden make FOLDER [--chains NAME ...]
    python -m tests.golden compare OLD NEW

``make`` runs each chain as a command of its own and stores its numbers in FOLDER/NAME.npz. Numbers agree to
the bit on one machine alone.
``compare`` ends with exit code 1 where a number is lost, or off by more than 1e-9.
"""

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import yaml

from tests.conftest import ROOT
from tests.golden.numbers import differences, of_file, of_json, plain

CONFIGS, DATA = ROOT / "configs", ROOT.parent / "shared" / "data"
FEW = 2  # values of an axis of a sweep, and runs and tasks of it
LISTED = 40  # names that are told of a kind
# Tables to calibrate from, the options, and a table to predict.
TABLES = {
    "data_ur5": ("ur5/trials_0.5px.csv", (), "ur5/validation.csv"),
    "data_stanford": ("stanford/trials_1.0px.csv", ("--joints", "RRPRRR"), "stanford/validation.csv"),
    "data_arm2": ("motoman/arm2_train.csv", (), "motoman/arm2_test.csv"),
    "data_leica": ("motoman/leica_train.csv", ("--set", "calibration.lens=true"), "motoman/leica_test.csv"),
}


def small_sweep(path: Path, folder: Path) -> Path:
    """Write a sweep of few runs, tasks and values beside its results; its file."""
    design = yaml.safe_load(path.read_text(encoding="utf-8"))
    bases = design["base"]
    design["base"] = (
        [str(CONFIGS / base) for base in bases] if isinstance(bases, list) else str(CONFIGS / bases)
    )
    design["runs"] = FEW
    if "tasks" in design:
        design["tasks"]["random"] = FEW
    if "calibrations" in design:
        design["calibrations"] = 1
    for name, axis in design.get("grid", {}).items():
        if isinstance(axis, list):
            design["grid"][name] = axis[:FEW]
        elif "values" in axis:
            axis["values"] = axis["values"][:FEW]
    made = folder / f"{path.stem}.yaml"
    made.write_text(yaml.safe_dump(design), encoding="utf-8")
    return made


def commands_of(name: str, folder: Path) -> list[list[str]]:
    """The commands of a chain."""
    output = ["-o", str(folder / name), "--json", "-q"]
    if name in TABLES:
        table, options, held_out = TABLES[name]
        return [
            ["calibrate", "--data", str(DATA / table), *options, *output],
            ["validate", str(folder / name), "--data", str(DATA / held_out), "--json"],
        ]
    path = CONFIGS / f"{name}.yaml"
    if "grid" in yaml.safe_load(path.read_text(encoding="utf-8")):
        return [["sweep", "-c", str(small_sweep(path, folder)), *output]]
    return [["calibrate", "plan", "servo", "report", "-c", str(path), *output]]


def chains() -> list[str]:
    """Names of all chains that can be run here."""
    shipped = sorted(path.stem for path in CONFIGS.glob("*.yaml"))
    return [*shipped, *(name for name, (table, *_) in TABLES.items() if (DATA / table).exists())]


def numbers_of(name: str, folder: Path) -> dict[str, Any]:
    """Run a chain and gather its numbers: files, JSON and exit codes."""
    found: dict[str, Any] = {}
    program = str(Path(sys.executable).with_name("projservo"))
    for i, command in enumerate(commands_of(name, folder)):
        done = subprocess.run([program, *command], capture_output=True, text=True, check=False)
        found[f"command{i}/exit_code"] = np.array(done.returncode)
        if not done.stdout:
            print(f"{name}: {done.stderr.strip()[-300:]}", file=sys.stderr)
            continue
        found |= of_json(json.loads(done.stdout), f"command{i}")
    for place, path in files_of(folder / name):
        found |= of_file(path, place)
    return {key: plain(value, folder) for key, value in found.items()}


def files_of(folder: Path) -> Iterator[tuple[str, Path]]:
    """Run files of a chain and their names; calibrations of sweeps, whose files keys name, are counted."""
    kept = sorted((folder / "calibrations").glob("*.h5"), key=calibrated)
    for path in sorted(folder.rglob("*.h5")):
        place = path.relative_to(folder).as_posix()
        yield f"calibrations/{kept.index(path)}" if path in kept else place, path


def calibrated(path: Path) -> str:
    """The configuration that a calibration was made with, less what hangs on the folder."""
    with h5py.File(path) as file:
        return str(file["calibrate"].attrs["configuration"]).replace(str(ROOT), "")


def make(folder: Path, names: list[str]) -> None:
    """Store the numbers of chains."""
    if os.environ.get("OPENBLAS_NUM_THREADS") != "1":
        sys.exit("set OPENBLAS_NUM_THREADS=1: sums of several threads differ in the last bits")
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        numbers = numbers_of(name, folder)
        np.savez_compressed(folder / f"{name}.npz", **numbers)
        print(f"{name}: {len(numbers)} numbers")


def compare(old: Path, new: Path) -> int:
    """Print how two folders differ; 1 where a number is lost or apart."""
    off = 0
    for path in sorted(old.glob("*.npz")):
        if not (new / path.name).exists():
            print(f"{path.stem}: not made")
            off = 1
            continue
        with np.load(path) as before, np.load(new / path.name) as after:
            told = differences(dict(before), dict(after))
        print(f"{path.stem}: " + ", ".join(f"{len(names)} {kind}" for kind, names in told.items()))
        for kind in ("apart", "lost", "new"):
            for line in told[kind][:LISTED]:
                print(f"  {kind}: {line}")
        off |= bool(told["apart"] or told["lost"])
    return off


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(prog="python -m tests.golden", description=__doc__.split("\n")[0])
    verbs = parser.add_subparsers(dest="verb", required=True)
    making = verbs.add_parser("make")
    making.add_argument("folder", type=Path)
    making.add_argument("--chains", nargs="+", choices=chains(), default=chains())
    comparing = verbs.add_parser("compare")
    comparing.add_argument("old", type=Path)
    comparing.add_argument("new", type=Path)
    given = parser.parse_args()
    if given.verb == "make":
        make(given.folder, given.chains)
        return
    sys.exit(compare(given.old, given.new))


if __name__ == "__main__":
    main()
