"""One sweep made here without interruption, with which those that are ended in every way are compared."""

import pytest

from projservo_cli.config import load_sweep
from projservo_cli.sweeps.design import read_design
from tests.sweeps.cases import make
from tests.sweeps.processes import written


@pytest.fixture(scope="session")
def whole(tmp_path_factory):
    """Configuration and folder of a sweep."""
    folder = tmp_path_factory.mktemp("whole")
    config = written(folder)
    make(read_design(load_sweep(config)), folder / "out")
    return config, folder / "out"
