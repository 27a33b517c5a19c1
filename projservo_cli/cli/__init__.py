"""The command ``projservo``: options in any order, messages, exit codes; no mathematics.

Importing it imports click alone: commands are functions of the modules below, with their own imports
when they run.
"""

# The order of the commands in the help.
# isort: off
from projservo_cli.cli import stage_commands
from projservo_cli.cli import teach
from projservo_cli.cli import detect
from projservo_cli.cli import validate
from projservo_cli.cli import tags_doctor
from projservo_cli.cli import show_compare_export
from projservo_cli.cli import init_schema_bench
from projservo_cli.cli import limits_release
from projservo_cli.cli import sweep_command
from projservo_cli.cli.program import main, run

# isort: on

__all__ = [
    "detect",
    "init_schema_bench",
    "limits_release",
    "main",
    "run",
    "show_compare_export",
    "stage_commands",
    "sweep_command",
    "tags_doctor",
    "teach",
    "validate",
]
