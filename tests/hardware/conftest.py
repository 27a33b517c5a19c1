"""Fixtures of the tests of hardware."""

from tests.cli.conftest import projservo

__all__ = ["projservo"]
