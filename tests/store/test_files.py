"""Writing files: what killed processes leave is removed, links do not lead out, a full disk is told."""

import contextlib
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from projservo_cli.records import InputError
from projservo_cli.store.files_and_locks import lies_inside, require_inside, working_in
from projservo_cli.store.observation_tables import write_table
from projservo_cli.store.run_file import save
from tests.configured import compared
from tests.conftest import ROOT
from tests.store.sound import sound_run

unix = pytest.mark.skipif(sys.platform == "win32", reason="processes and links as Unix knows them")
HOLD = """
import sys
from pathlib import Path
from projservo_cli.store.files_and_locks import replacing, working_in
with {what}(Path(sys.argv[1])) as path:
    print(path, flush=True)
    sys.stdin.read()
"""


@contextlib.contextmanager
def held(what, path):
    """A process that writes a file or works in a folder, and what it says."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD.format(what=what), str(path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        text=True,
    )
    try:
        yield process, process.stdout.readline().strip()
    finally:
        process.kill()
        process.communicate()


@unix
def test_what_a_killed_process_left_is_removed_and_nothing_else(tmp_path):
    (tmp_path / ".mine.part").touch()
    with held("replacing", tmp_path / "run.h5") as (process, name):
        gone = Path(name)
        mine = tmp_path / gone.name.replace(str(process.pid), str(os.getpid()))
        mine.touch()
        with working_in(tmp_path):
            assert gone.exists()  # its process runs
    with working_in(tmp_path):
        assert not gone.exists()
        assert mine.exists()
        assert (tmp_path / ".mine.part").exists()


@unix
def test_links_that_lead_out_are_refused(tmp_path):
    out, elsewhere = tmp_path / "out", tmp_path / "elsewhere"
    out.mkdir()
    elsewhere.mkdir()
    (out / "figures").symlink_to(elsewhere)
    (out / "circle").symlink_to(out / "circle")
    (out / "within").symlink_to(out)
    (tmp_path / "link").symlink_to(out)
    assert lies_inside(out / "within", out)
    assert lies_inside(tmp_path / "link" / "x", tmp_path / "link")  # the folder itself may be a link
    assert not lies_inside(out / ".." / "elsewhere", out)
    for name in ("figures", "circle"):
        with pytest.raises(InputError, match="symbolic link"):
            require_inside(out / name, out)


def test_a_folder_is_worked_in_by_one_process_and_free_when_that_is_killed(tmp_path):
    with held("working_in", tmp_path) as (process, _):
        with pytest.raises(InputError, match=f"process {process.pid} is at work there"), working_in(tmp_path):
            pass
        process.kill()
        process.wait()
        with working_in(tmp_path):
            assert [*tmp_path.iterdir()] != []
    assert [*tmp_path.iterdir()] == []


@pytest.fixture
def little_disk(tmp_path):
    """A disk of 256 kB."""
    mounted = (
        subprocess.run(
            ["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", str(tmp_path)],
            capture_output=True,
            check=False,
        )
        if Path("/proc/mounts").exists() and os.geteuid() == 0
        else None
    )
    if mounted is None or mounted.returncode != 0:
        pytest.skip("no file system can be mounted here")
    yield tmp_path
    subprocess.run(["umount", str(tmp_path)], check=True)


def test_a_full_disk_is_told_and_the_old_file_stays(little_disk):
    run = sound_run("run.h5", pose=200)  # larger than that disk
    path = little_disk / "file"
    path.write_bytes(b"old")
    (little_disk / "filling").write_bytes(bytes(240_000))
    writers = [
        lambda: save(replace(run, path=path)),
        lambda: compared([run, run], path),
        lambda: write_table(run.observation, path),
    ]
    for write in writers:
        with pytest.raises(InputError, match=": cannot be written: No space left on device"):
            write()
    assert path.read_bytes() == b"old"
    assert {found.name for found in little_disk.iterdir()} <= {"file", "filling"}
