"""The run file of the first release, for tests that read, damage or rewrite one."""

import pytest

from tests.store.first_release import first_release


@pytest.fixture
def run(tmp_path):
    path = tmp_path / "run.h5"
    path.write_bytes(first_release())
    return path
