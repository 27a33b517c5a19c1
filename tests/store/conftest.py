"""A sound run file."""

import pytest

from tests.store.sound import sound_file


@pytest.fixture
def path(tmp_path):
    found = tmp_path / "run.h5"
    found.write_bytes(sound_file())
    return found
