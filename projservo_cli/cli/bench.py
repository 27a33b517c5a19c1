"""``projservo bench``: how long a control step and a run take on this machine."""

from pathlib import Path
from typing import Any

from projservo_cli import provenance
from projservo_cli.cli.configuration import SHIPPED, shipped
from projservo_cli.cli.output import Console, print_json
from projservo_cli.config import load_config

MACHINE = ("projservo", "python", "numpy", "numba", "llvmlite", "system", "cpu", "cpu_count", "date", "jit")


def run(names: list[str], rest: list[str], options: dict[str, Any]) -> int:
    """Measure and print the table; the exit code."""
    del names, rest
    from projservo_cli.stages.bench import Case, measure

    console = Console(quiet=options["quiet"], verbose=options["verbose"])
    console.say("compiling kernels where they are not in the cache, then measuring: half a minute")
    path = Path(options["config"]) if options["config"] else shipped(SHIPPED)
    config = load_config(path, options["sets"])
    result = measure(Case(config))
    machine = provenance.collect(seed=config.seed)
    result["machine"] = {name: machine[name] for name in MACHINE}
    if options["json"]:
        print_json(result)
        return 0
    console.show(f"{'':32}   least µs  median µs   quartiles µs      of one SVD")
    for name, times in result["times_us"].items():
        spread = f"{times['lower']:.2f} to {times['upper']:.2f}"
        numbers = f"{times['least']:10.2f} {times['median']:10.2f}   {spread:16}"
        console.show(f"{name:32} {numbers} {times['over_svd']:10.3f}")
    console.show(f"{machine['cpu']}, {machine['system']}, numpy {machine['numpy']}, numba {machine['numba']}")
    return 0
