"""Whether the tests notice a mistake: sixty changes of one operator or number, each put to the nearest tests.

    pip install cosmic-ray
    python -m tests.studies.mutants [--seed 49] [--draws 60] [--only 3 17 ...] [-o mutants.csv]

Operators are those of Cosmic Ray that leave Python that runs: a sum for a difference, ``<`` for ``<=``, a
number one higher or lower, a loop that is passed over. Lines are drawn from functions of the mathematics.
Each mutant stands in a copy of the tree; there run the tests nearest to the mutated module, without the
compiler, until the first fails. A mutant that takes longer than the limit is killed too.
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
from pathlib import Path
from typing import NamedTuple

import numpy as np

ROOT = Path(__file__).parents[2]
MODULES = (
    *("geometry/*", "task/*", "control/*", "planning/margins", "planning/constraints"),
    *(
        "calibration/bundle_adjustment",
        "calibration/triangulation",
        "calibration/epipolar",
        "monitoring/innovation_tests",
    ),
)
BINARY = ("Add_Sub", "Sub_Add", "Mul_Div", "Div_Mul", "Pow_Mul")
ORDER = ("Lt_LtE", "LtE_Lt", "Gt_GtE", "GtE_Gt", "Lt_Gt", "Gt_Lt", "LtE_Gt", "GtE_Lt", "Eq_NotEq", "NotEq_Eq")
OPERATORS = (
    *(f"core/ReplaceBinaryOperator_{name}" for name in BINARY),
    *(f"core/ReplaceComparisonOperator_{name}" for name in ORDER),
    *("core/ReplaceUnaryOperator_Delete_USub", "core/ReplaceUnaryOperator_Delete_Not", "core/AddNot"),
    *("core/ReplaceAndWithOr", "core/ReplaceOrWithAnd", "core/NumberReplacer", "core/ZeroIterationForLoop"),
)
# Least CPU time for the tests of a mutant, s; where they take longer unchanged, twice that.
LIMIT_S = 60.0


class Mutant(NamedTuple):
    """A place of a module, and what is changed there."""

    module: str
    line: int
    operator: str
    occurrence: int


def places(module: Path) -> list[Mutant]:
    """Every place in the bodies of the functions of a module at which an operator applies, once for each."""
    from cosmic_ray.ast import ast_nodes, get_ast
    from cosmic_ray.plugins import get_operator

    source = module.read_text(encoding="utf-8")
    functions = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.FunctionDef)]
    within = {line for node in functions for line in range(node.body[0].lineno, node.end_lineno + 1)}
    nodes, found = list(ast_nodes(get_ast(source))), []
    for name in OPERATORS:
        operator = get_operator(name)()
        lines = [start[0] for node in nodes for start, _ in operator.mutation_positions(node)]
        first = {line: occurrence for occurrence, line in reversed(list(enumerate(lines))) if line in within}
        found += [Mutant(str(module.relative_to(ROOT)), line, name, first[line]) for line in sorted(first)]
    return found


def nearest(tree: Path, module: str) -> list[str]:
    """Test file of the name of a module; where there is none, those of its folder that import it, or all."""
    package = Path(module).with_suffix("")
    folder = tree / "tests" / package.parent.name
    files = [path for path in sorted(folder.glob("test_*.py")) if path.stem != "test_jit"]
    name = ".".join(package.parts)
    words = (name, f"from {name.rpartition('.')[0]} import {package.name}")
    chosen = [path for path in files if path.stem == f"test_{package.name}"] or [
        path for path in files if any(text in path.read_text(encoding="utf-8") for text in words)
    ]
    return [str(path.relative_to(tree)) for path in chosen or files]


def tested(tree: Path, module: str, limit: float) -> tuple[str, str, float]:
    """Outcome of the nearest tests of a module in a copy of the tree, what failed, and CPU seconds."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-m", "not volume", "-p", "no:cacheprovider"]
    environment = {"OPENBLAS_NUM_THREADS": "1", "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": str(tree)}
    seconds = (int(limit), int(limit) + 1)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        [*command, *nearest(tree, module)],
        cwd=tree,
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, seconds),
    )
    spent = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before.ru_utime
    failed = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    outcome = "survived" if done.returncode == 0 else "killed" if done.returncode > 0 else "timed out"
    return outcome, failed[0] if failed else "", round(spent, 1)


def main() -> None:
    """Draw the mutants, test them one after the other, print what became of each, and write the list."""
    from cosmic_ray.mutating import mutate_code
    from cosmic_ray.plugins import get_operator

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seed", type=int, default=49)
    parser.add_argument("--draws", type=int, default=60)
    parser.add_argument("--only", type=int, nargs="*", help="numbers of the mutants to test again")
    parser.add_argument("-o", "--output", type=Path, default=Path("mutants_study.csv"))
    asked = parser.parse_args()
    lines = defaultdict(list)
    for name in MODULES:
        for path in sorted((ROOT / "projservo_cli").glob(f"{name}.py")):
            for place in places(path):
                lines[place.module, place.line].append(place)
    rng = np.random.default_rng(asked.seed)
    drawn = [list(lines.values())[i] for i in rng.choice(len(lines), asked.draws, replace=False)]
    mutants = [here[rng.integers(len(here))] for here in drawn]
    counted: Counter[str] = Counter()
    limits: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as scratch, open(asked.output, "w", encoding="utf-8") as file:
        (Path(scratch) / "shared").symlink_to(ROOT.parent / "shared")
        tree = Path(scratch) / "tree"
        shutil.copytree(ROOT, tree, ignore=shutil.ignore_patterns(".*", "results", "build", "*.pyc"))
        writer = csv.writer(file)
        writer.writerow(["number", *Mutant._fields, "outcome", "seconds", "by", "mutated line"])
        for number, mutant in enumerate(mutants):
            if asked.only and number not in asked.only:
                continue
            if mutant.module not in limits:
                outcome, by, seconds = tested(tree, mutant.module, 10 * LIMIT_S)
                if outcome != "survived":
                    sys.exit(f"unchanged, {mutant.module}: {outcome} {by}; the tests must pass in time first")
                limits[mutant.module] = max(LIMIT_S, 2 * seconds)
            source = (ROOT / mutant.module).read_text(encoding="utf-8")
            changed = mutate_code(source, get_operator(mutant.operator)(), mutant.occurrence)
            (tree / mutant.module).write_text(changed, encoding="utf-8")
            outcome, by, seconds = tested(tree, mutant.module, limits[mutant.module])
            (tree / mutant.module).write_text(source, encoding="utf-8")
            counted[outcome] += 1
            line = changed.splitlines()[mutant.line - 1].strip()
            writer.writerow([number, *mutant, outcome, seconds, by, line])
            file.flush()
            print(f"{number:3} {outcome:9} {mutant.module}:{mutant.line}: {line}", flush=True)
    print(f"killed {counted['killed']}, timed out {counted['timed out']}, survived {counted['survived']}")


if __name__ == "__main__":
    main()
