"""Whether the tests notice a mistake: 200 changes of one operator or number, each put to the nearest tests.

    pip install cosmic-ray
    nice -n 15 python -m tests.studies.mutants [--processes 2] [--check] [-o mutants_study.csv]

Operators are those of Cosmic Ray that leave Python that runs: a sum for a difference, ``<`` for ``<=``, a
number one higher or lower, a loop that is passed over. Lines are drawn from functions of the mathematics.
Each process has a copy of the tree; there run the tests nearest to the mutated module, without the compiler,
until the first fails. A mutant that takes longer than the limit is killed too.

The share killed that is stored beside this file is what a change of the code is compared with: ``--check``
exits with code 1 where a new run kills less. Code that moved draws other mutants by the same seed, so that
shares are compared and not mutants. ``-o tests/studies/mutants.csv`` stores a new one.
"""

import argparse
import ast
import csv
import os
import resource
import shutil
import subprocess
import sys
import tempfile
from collections import Counter, defaultdict
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tests.studies.common import in_two_processes, written

ROOT = Path(__file__).parents[2]
STORED = Path(__file__).with_suffix(".csv")
MODULES = (
    *(
        "geometry/displacements",
        "geometry/kinematics",
        "geometry/mechanisms",
        "task/partition",
        "task/target",
    ),
    *("control/direct", "control/law", "planning/motion_margins", "planning/joint_constraints"),
    *("calibration/bundle_adjustment", "calibration/initial/triangulation", "calibration/initial/epipolar"),
    "monitoring/innovation_tests",
)
# Tests of modules that are tested by what they are for.
TESTS_OF = {"camera_resection": "test_views"}
BINARY = ("Add_Sub", "Sub_Add", "Mul_Div", "Div_Mul", "Pow_Mul")
ORDER = ("Lt_LtE", "LtE_Lt", "Gt_GtE", "GtE_Gt", "Lt_Gt", "Gt_Lt", "LtE_Gt", "GtE_Lt", "Eq_NotEq", "NotEq_Eq")
OPERATORS = (
    *(f"core/ReplaceBinaryOperator_{name}" for name in BINARY),
    *(f"core/ReplaceComparisonOperator_{name}" for name in ORDER),
    *("core/ReplaceUnaryOperator_Delete_USub", "core/ReplaceUnaryOperator_Delete_Not", "core/AddNot"),
    *("core/ReplaceAndWithOr", "core/ReplaceOrWithAnd", "core/NumberReplacer", "core/ZeroIterationForLoop"),
)
SEED, DRAWS = 49, 200
# Least CPU time for the tests of a mutant, s; where they take longer unchanged, twice that.
LEAST_S = 20.0
# Most CPU time for the tests of a module unchanged, s.
MOST_S = 600.0
# By how much the share may fall, percentage points; its standard error at 200 draws and 59 % is 3.5.
FALL = 6.0
COLUMNS = ("number", "module", "function", "operator", "outcome")


class Mutant(NamedTuple):
    """A place of a module, and what is changed there."""

    module: str
    function: str
    line: int
    operator: str
    occurrence: int


def functions_in(node: ast.AST, within: str = "") -> dict[int, str]:
    """Names of the innermost function by the lines of its body, which move with the function."""
    found: dict[int, str] = {}
    for part in ast.iter_child_nodes(node):
        if isinstance(part, ast.FunctionDef | ast.ClassDef):
            name = f"{within}{part.name}"
            if isinstance(part, ast.FunctionDef):
                found |= dict.fromkeys(range(part.body[0].lineno, part.end_lineno + 1), name)
            found |= functions_in(part, f"{name}.")
    return found


def places(module: Path) -> list[Mutant]:
    """Every place in the bodies of the functions of a module at which an operator applies, once for each."""
    from cosmic_ray.ast import ast_nodes, get_ast
    from cosmic_ray.plugins import get_operator

    source = module.read_text(encoding="utf-8")
    functions = functions_in(ast.parse(source))
    nodes, found = list(ast_nodes(get_ast(source))), []
    for name in OPERATORS:
        operator = get_operator(name)()
        lines = [start[0] for node in nodes for start, _ in operator.mutation_positions(node)]
        first = {line: occurrence for occurrence, line in reversed(list(enumerate(lines)))}
        found += [
            Mutant(str(module.relative_to(ROOT)), functions[line], line, name, first[line])
            for line in sorted(first.keys() & functions.keys())
        ]
    return found


def drawn() -> list[Mutant]:
    """Mutants by the seed: lines of the modules, and one place of each."""
    lines = defaultdict(list)
    for name in MODULES:
        for place in places(ROOT / "projservo_cli" / f"{name}.py"):
            lines[place.module, place.line].append(place)
    rng = np.random.default_rng(SEED)
    chosen = [list(lines.values())[i] for i in rng.choice(len(lines), DRAWS, replace=False)]
    return [here[rng.integers(len(here))] for here in chosen]


def importing(files: Iterable[Path], module: Path) -> list[Path]:
    """Those of some files that import a module of the package."""
    name = ".".join(module.parts)
    words = (name, f"from {name.rpartition('.')[0]} import {module.name}")
    return [path for path in files if any(text in path.read_text(encoding="utf-8") for text in words)]


def nearest(tree: Path, module: str) -> list[str]:
    """Test file of the name of a module; else those of its part that import it, or of its importers."""
    package = Path(module).with_suffix("")
    files = sorted((tree / "tests" / package.parts[1]).glob("test_*.py"))
    files = [path for path in files if path.stem != "test_jit"]
    chosen = [path for path in files if path.stem == f"test_{package.name}"] or importing(files, package)
    users = importing((tree / Path(*package.parts[:2])).rglob("*.py"), package)
    through = {TESTS_OF.get(user.stem, f"test_{user.stem}") for user in users}
    chosen = chosen or [path for path in files if path.stem in through] or files
    return [str(path.relative_to(tree)) for path in chosen]


def own_tree(scratch: str) -> Path:
    """The copy of the tree of this process, made on its first use."""
    tree = Path(scratch) / str(os.getpid())
    if not tree.exists():
        ignored = shutil.ignore_patterns(".*", "results", "build", "*.pyc", "*_study.csv")
        shutil.copytree(ROOT, tree, ignore=ignored)
    return tree


def tested(tree: Path, module: str, limit: float) -> tuple[str, str, float]:
    """Outcome of the nearest tests of a module in a copy of the tree, what failed, and CPU seconds."""
    options = ("-x", "-q", "-m", "not volume", "-p", "no:cacheprovider", "--hypothesis-seed=0")
    command = [sys.executable, "-m", "pytest", *options, *nearest(tree, module)]
    environment = {"OPENBLAS_NUM_THREADS": "1", "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": str(tree)}
    seconds = (int(limit), int(limit) + 1)
    before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    done = subprocess.run(
        command,
        cwd=tree,
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, seconds),
    )
    spent = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before
    failed = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    outcome = "survived" if done.returncode == 0 else "killed" if done.returncode > 0 else "timed out"
    return outcome, failed[0] if failed else "", spent


def unchanged(job: tuple[str, str]) -> tuple[str, str, float]:
    """Outcome of the nearest tests of a module that is not mutated."""
    scratch, module = job
    return tested(own_tree(scratch), module, MOST_S)


def mutated(job: tuple[str, int, Mutant, float]) -> list[dict[str, object]]:
    """The row of a mutant."""
    from cosmic_ray.mutating import mutate_code
    from cosmic_ray.plugins import get_operator

    scratch, number, mutant, limit = job
    path = own_tree(scratch) / mutant.module
    source = (ROOT / mutant.module).read_text(encoding="utf-8")
    changed = mutate_code(source, get_operator(mutant.operator)(), mutant.occurrence)
    path.write_text(changed, encoding="utf-8")
    outcome, by, _ = tested(own_tree(scratch), mutant.module, limit)
    path.write_text(source, encoding="utf-8")
    line = changed.splitlines()[mutant.line - 1].strip()
    print(f"{number:3} {outcome:9} {mutant.module}:{mutant.line}: {line}  {by}", flush=True)
    told = (number, mutant.module, mutant.function, mutant.operator, outcome)
    return [dict(zip(COLUMNS, told, strict=True))]


def share(rows: list[dict[str, object]]) -> tuple[float, str]:
    """Percentage of mutants that did not survive, and the line that says it."""
    counted = Counter(row["outcome"] for row in rows)
    percent = 100 * (1 - counted["survived"] / len(rows))
    outcomes = ", ".join(f"{name} {counted[name]}" for name in ("killed", "timed out", "survived"))
    return percent, f"{outcomes}: {percent:.1f} % of {len(rows)} do not survive"


def main() -> None:
    """Draw the mutants, test them, print the outcome of each, write the list, and compare shares."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--check", action="store_true", help=f"fail if the share falls over {FALL:g} points")
    parser.add_argument("-o", "--output", type=Path, default=Path("mutants_study.csv"))
    asked = parser.parse_args()
    mutants = drawn()
    modules = sorted({mutant.module for mutant in mutants})
    limits = {}
    with tempfile.TemporaryDirectory() as scratch:
        (Path(scratch) / "shared").symlink_to(ROOT.parent / "shared")
        jobs = [(scratch, module) for module in modules]
        tests = in_two_processes(unchanged, jobs, "unchanged", asked.processes)
        for module, (outcome, by, seconds) in zip(modules, tests, strict=True):
            print(f"{module}: {seconds:.1f} s unchanged", flush=True)
            if outcome != "survived":
                sys.exit(f"unchanged, {module}: {outcome} {by}; the tests must pass in time first")
            limits[module] = max(LEAST_S, 2 * seconds)
        drawn_jobs = [
            (scratch, number, mutant, limits[mutant.module]) for number, mutant in enumerate(mutants)
        ]
        rows = written(
            asked.output, COLUMNS, in_two_processes(mutated, drawn_jobs, "mutants", asked.processes)
        )
    percent, told = share(rows)
    print(told)
    if asked.check:
        with open(STORED, encoding="utf-8", newline="") as file:
            stored, told = share([*csv.DictReader(file)])
        print(f"stored: {told}")
        sys.exit(int(percent < stored - FALL))


if __name__ == "__main__":
    main()
