"""``projservo equations``: the equations of the paper and the code of each."""

import dataclasses
from typing import Any

from projservo_cli.cli.options import wrapped
from projservo_cli.cli.output import Console, print_json
from projservo_cli.equations import REGISTER


def run(names: list[str], rest: list[str], options: dict[str, Any]) -> int:
    """Print the register of equations; the exit code."""
    del names, rest
    if options["json"]:
        print_json({"equations": [dataclasses.asdict(entry) for entry in REGISTER]})
        return 0
    console = Console(quiet=options["quiet"], verbose=options["verbose"])
    for entry in REGISTER:
        console.show(wrapped(f"({entry.number}) {entry.title}"))
        for function in entry.functions:
            console.show(f"    {function}")
        for test in entry.tests:
            console.show(f"    tested by {test}")
        if entry.erratum:
            console.show(wrapped(f"erratum: {entry.erratum}", "    "))
    return 0
