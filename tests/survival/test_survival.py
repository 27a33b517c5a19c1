"""A few of the studies of this folder: damaged run files, mistaken input, and calls that are killed."""

import os
from dataclasses import replace

import pytest

from projservo_cli.store import load
from tests.store.sound import sound_file
from tests.survival.calls import call
from tests.survival.inputs import SAMPLE, SECONDS, examine
from tests.survival.kills import Study
from tests.survival.mutations import KINDS, mutate, wrong

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="calls are forked here")


@pytest.mark.parametrize("first", range(0, len(KINDS), 13))
def test_damaged_run_files_end_in_one_line(tmp_path, first):
    """Memory is that of this process too, and left to the study."""
    path = tmp_path / "run.h5"
    for number in range(first, first + 13):
        mutate(number, path)
        ending = call("show", str(path), "--json")
        assert wrong(number, replace(ending, megabytes=0.0)) == ""
        assert [found.name for found in tmp_path.iterdir()] == ["run.h5"]


def test_a_sound_file_is_shown(tmp_path):
    path = tmp_path / "run.h5"
    path.write_bytes(sound_file())
    ending = call("show", str(path), "--json")
    assert (ending.code, ending.err) == (0, "")
    assert wrong(0, ending) != ""


@pytest.mark.parametrize("first", range(0, 200, 100))
def test_mistaken_configurations_and_tables_end_in_messages(tmp_path, first):
    run = tmp_path / "run.h5"
    run.write_bytes(sound_file())
    for number in range(first, first + 100):
        command = run if number % SAMPLE == 0 else None
        _, _, _, found = examine(number, tmp_path, command, 3.0 * SECONDS)  # the machine may be busy
        assert found == ""


@pytest.mark.volume
def test_a_killed_call_leaves_whole_files_and_is_finished_by_the_next(tmp_path):
    kills = Study(tmp_path, "stages")
    for share in (0.3, 0.8):
        _, found = kills.kill(share * kills.seconds)
        assert found == []
    assert load(tmp_path / "killed").traces.keys() == {"direct_three", "stacked"}
