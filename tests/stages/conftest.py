"""The command line, called in this process."""

from tests.cli.conftest import projservo

__all__ = ["projservo"]
