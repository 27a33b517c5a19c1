"""A sweep ended in every way and gone on with is the sweep that was not; its table is what readers expect."""

import json
import signal
import threading

import pytest

from projservo_cli.records import InputError, WorkFailed
from projservo_cli.store.sweep_table import SweepTable
from projservo_cli.sweeps import workers
from projservo_cli.sweeps.folder import Folder
from projservo_cli.sweeps.workers import Engine
from tests.sweeps import dying, processes
from tests.sweeps.cases import columns, design, make

pytestmark = pytest.mark.volume


def test_interrupted_then_killed_it_is_in_the_end_as_if_nothing_had_been(whole, tmp_path, projservo):
    config, reference = whole
    process = processes.start(config, tmp_path, "-j", "2")
    processes.wait_for_parts(process, tmp_path, 2)
    process.send_signal(signal.SIGINT)
    code, _, err = processes.finish(process)
    assert code == 130, err
    assert "Traceback" not in err
    table, full = SweepTable(tmp_path / "sweep.h5"), SweepTable(reference / "sweep.h5")
    rows = table.column("run")
    assert 2 * processes.CHUNK <= len(rows) < 2 * processes.RUNS
    for name in table.names:
        assert table.column(name).tobytes() == full.column(name)[rows].tobytes()
    stored = len(processes.parts(tmp_path))
    assert processes.CHUNK * stored == len(rows)
    process = processes.start(config, tmp_path, "-j", "1")
    processes.wait_for_parts(process, tmp_path, stored + 2)
    processes.kill_group(process)
    stored = len(processes.parts(tmp_path))
    assert processes.CHUNK * stored < 2 * processes.RUNS
    last = projservo("sweep", "-c", config, "-o", tmp_path, "-j", "1", "--json")
    assert last.code == 0, last.err
    assert f"{processes.CHUNK * stored} of {2 * processes.RUNS} runs are stored already" in last.err
    told = [last.json[name] for name in ("complete", "runs", "done", "cells")]
    assert told == [True, 2 * processes.RUNS, 2 * processes.RUNS, 2]
    assert not processes.differences(tmp_path, reference)
    assert not processes.parts(tmp_path)


def test_the_table_opens_in_xarray_and_pandas(whole):
    xarray = pytest.importorskip("xarray", reason="xarray is not installed")
    pytest.importorskip("pandas", reason="pandas is not installed")
    _, folder = whole
    ours = columns(folder)
    with xarray.open_dataset(folder / "sweep.h5") as data:
        assert dict(data.sizes) == {"run": 2 * processes.RUNS}
        frame = data.to_dataframe()
        assert data["position_error_mm"].attrs["units"] == "mm"
    assert frame.index.tolist() == list(range(2 * processes.RUNS))
    assert set(frame.columns) == set(ours) - {"run"}
    for name, values in ours.items():
        if name != "run":
            assert frame[name].tolist() == pytest.approx(values.tolist(), nan_ok=True, abs=0)
    assert set(frame.groupby("law")["steps"].count().to_dict().items()) == {
        (law, processes.RUNS) for law in ("direct_two", "stacked")
    }
    with xarray.open_dataset(folder / "sweep.h5", group=f"traces/{processes.RUNS}") as trace:
        assert trace.sizes["time"] == ours["steps"][processes.RUNS] + 1
        assert trace.attrs["law"] == "stacked"


def test_what_is_not_of_this_sweep_is_refused(tmp_path):
    """Another configuration unless forced, other versions, a damaged manifest, a table without one."""
    first, second, folder = design(runs=1), design(runs=1, seed=2), Folder(tmp_path)
    make(first, tmp_path)
    before = columns(tmp_path)["seed"].tolist()
    assert make(first, tmp_path).complete
    with pytest.raises(InputError, match=r"of another configuration.*--force"):
        make(second, tmp_path)
    assert columns(tmp_path)["seed"].tolist() == before
    make(second, tmp_path, force=True)
    assert columns(tmp_path)["seed"].tolist() != before
    manifest = json.loads(folder.manifest.read_text(encoding="utf-8"))
    manifest["provenance"]["numba"] = "0.1"
    folder.manifest.write_text(json.dumps(manifest), encoding="utf-8")
    with pytest.raises(InputError, match=r"made with numba 0\.1, now"):
        folder.status(second)
    folder.manifest.write_text("{", encoding="utf-8")
    with pytest.raises(InputError, match="damaged"):
        folder.status(second)
    folder.manifest.unlink()
    with pytest.raises(InputError, match="is missing; choose another folder"):
        folder.status(second)


def test_threads_give_the_same_and_are_left_in_order(tmp_path):
    """Runs that differ in their seeds alone are threads; an interrupt waits for those at work."""

    def threads():
        return [thread for thread in threading.enumerate() if "ThreadPool" in thread.name]

    def interrupt(what, done, total):
        if what == "runs" and done >= 4:
            assert threads()
            raise KeyboardInterrupt

    found = design(runs=12, chunk=2, calibrations=2)
    assert make(found, tmp_path / "one").complete
    reference = columns(tmp_path / "one")
    with pytest.raises(KeyboardInterrupt):
        make(found, tmp_path / "two", workers=2, progress=interrupt)
    assert not threads()
    assert 4 <= len(columns(tmp_path / "two")["run"]) < 24
    assert make(found, tmp_path / "two", workers=2).complete
    for name, values in columns(tmp_path / "two").items():
        assert values.tobytes() == reference[name].tobytes(), name


def test_jobs_of_a_lost_process_are_made_again_until_processes_die_again_and_again(tmp_path, monkeypatch):
    jobs = [(number, tmp_path / "died") for number in range(12)]
    assert sorted(Engine(2).completed(dying.once, jobs)) == list(range(12))
    assert (tmp_path / "died").exists()
    monkeypatch.setattr(workers, "MOST_LOSSES", 1)
    with pytest.raises(WorkFailed, match="lost 2 times in a row"):
        list(Engine(2).completed(dying.always, [1]))
