"""Studies are run by name; that they can be is all that is tested of them."""

from importlib import import_module

import pytest


@pytest.mark.parametrize("name", ["disturbed", "keep_out", "oracle", "success", "time"])
def test_a_study_can_be_run(name):
    assert callable(import_module(f"tests.studies.planning_{name}").main)
