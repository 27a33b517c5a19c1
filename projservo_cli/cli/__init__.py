"""The command ``projservo``: options in any order, messages, exit codes; no mathematics.

Importing it imports click alone: commands are functions of the modules below, with their own imports
when they run.
"""

from projservo_cli.cli import stages  # isort: skip  # first in the help
from projservo_cli.cli import data, hardware, inspection, installation, servos, sweep_command
from projservo_cli.cli.program import main, run

__all__ = [
    "data",
    "hardware",
    "inspection",
    "installation",
    "main",
    "run",
    "servos",
    "stages",
    "sweep_command",
]
