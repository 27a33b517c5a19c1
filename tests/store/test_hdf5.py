"""HDF5 files with a checksum behind their data: whole, changed, damaged, and what is never read."""

import dataclasses
import shutil
import subprocess
import sys

import h5py
import numpy as np
import pytest

from projservo_cli import quarantine, store
from projservo_cli import store as hdf5
from projservo_cli.records import InputError
from tests.store.first_release import first_release
from tests.survival.mutations import EDITS, mutate

SEAL_SIZE = 83  # bytes of the line behind the data


def refused(path):
    with pytest.raises(InputError) as caught:
        store.load(path)
    message = str(caught.value)
    assert str(path) in message
    assert "\n" not in message
    return message


def test_the_checksum_is_that_of_the_data_and_xarray_passes_it_over(run):
    data = run.read_bytes()
    line = data[-SEAL_SIZE:].decode()
    (run.parent / "data").write_bytes(data[:-SEAL_SIZE])
    assert line == f"\nprojservo sha256 {hdf5.digest_of(run.parent / 'data')}\n"
    xarray = pytest.importorskip("xarray")
    pytest.importorskip("h5netcdf")
    with xarray.open_dataset(run, group="plan") as plan:  # found out by its first bytes
        assert plan.sizes["sample"] == 6


def test_every_array_of_the_file_has_a_checksum_of_its_own(run):
    without = []

    def look(name, found):
        if isinstance(found, h5py.Dataset) and found.size and not found.fletcher32:
            without.append(name)

    with h5py.File(run) as file:
        file.visititems(look)
    assert without == []


@pytest.mark.parametrize("place", [0, 12, 30, 100, 50_000, 200_000, -SEAL_SIZE + 5, -20, -1])
def test_a_single_bit_anywhere_is_noticed(run, place):
    data = bytearray(run.read_bytes())
    data[place] ^= 1
    run.write_bytes(data)
    refused(run)


@pytest.mark.parametrize("keep", [1, 100, -1, -40, -SEAL_SIZE + 1, -SEAL_SIZE - 1])
def test_a_file_cut_short_is_noticed_before_it_is_read(run, keep, monkeypatch):
    monkeypatch.setattr(h5py, "File", None)
    run.write_bytes(run.read_bytes()[:keep])
    refused(run)


def test_a_file_that_another_program_changed_is_read_by_a_process_of_its_own(run, monkeypatch):
    with h5py.File(run, "a") as file:
        file.attrs["note"] = "mine"
    assert not hdf5.sealed(run, "")
    calls = []
    read = quarantine.copied
    monkeypatch.setattr(store, "copied", lambda *paths: calls.append(paths) or read(*paths))
    found = store.load(run)
    assert len(calls) == 1
    assert found.path == run
    assert found.plan.sigma.shape == (6,)
    store.save(dataclasses.replace(found, path=run.parent / "again.h5"))
    assert store.load(run.parent / "again.h5").calibration.rms_px == found.calibration.rms_px
    assert len(calls) == 1


@pytest.mark.parametrize(
    ("script", "what"),
    [
        ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", "SIGSEGV"),
        ("raise SystemExit(3)", "too little memory"),
        ("raise RuntimeError('oh')", "exit code 1"),
        ("print('here: is wrong'); raise SystemExit(2)", "here: is wrong"),
    ],
)
def test_a_crash_of_that_process_is_told_in_one_line(run, monkeypatch, script, what):
    with h5py.File(run, "a") as file:
        file.attrs["note"] = "mine"
    process = subprocess.run
    monkeypatch.setattr(
        quarantine.subprocess, "run", lambda _, **given: process([sys.executable, "-c", script], **given)
    )
    with pytest.raises(InputError, match=what) as caught:
        store.load(run)
    assert "\n" not in str(caught.value)


@pytest.mark.skipif(sys.platform != "linux", reason="memory is bounded where the system can")
def test_that_process_cannot_take_more_memory_than_it_is_given():
    script = (
        "from projservo_cli.quarantine import _limit; import numpy as np\n"
        "_limit(1000); np.ones(10_000_000)\n"
        "try: np.ones(100_000_000)\n"
        "except MemoryError: print('bounded')"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout == "bounded\n"


@pytest.mark.parametrize("kind", EDITS)
def test_what_deceives_is_refused_with_the_checksum_and_without(run, kind):
    run.write_bytes(first_release())
    with h5py.File(run, "a", locking=False) as file:
        EDITS[kind](file, np.random.default_rng(5))
    with pytest.raises(InputError):
        store.read(run)
    shutil.copy(run, run.parent / "sealed.h5")
    hdf5.seal(run.parent / "sealed.h5")
    refused(run.parent / "sealed.h5")


def test_mutations_depend_on_their_number_alone(tmp_path):
    paths = [tmp_path / "a.h5", tmp_path / "b.h5"]
    for number in (0, 2, 3, 5):
        kinds = [mutate(number, path) for path in paths]
        assert kinds[0] == kinds[1]
        assert paths[0].read_bytes() == paths[1].read_bytes()


def test_data_larger_than_the_disk_are_not_begun(tmp_path):
    with pytest.raises(InputError, match="cannot be written"), hdf5.new_file(tmp_path / "x.h5", 10**18):
        pass
    assert list(tmp_path.iterdir()) == []
