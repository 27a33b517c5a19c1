"""One sweep made here without interruption, with which those that are ended in every way are compared."""

import pytest

from projservo_cli.config import load_sweep
from projservo_cli.sweeps.design import read_design
from tests.sweeps.cases import make
from tests.sweeps.processes import written


@pytest.fixture(scope="session")
def whole(made_once):
    """Configuration and folder of a sweep."""
    folder = made_once("whole", lambda folder: make(read_design(load_sweep(written(folder))), folder / "out"))
    return folder / "small.yaml", folder / "out"
