"""A sweep ended in every way and gone on with is the sweep that was not; its table is what readers expect."""

import json
import signal
import threading

import numpy as np
import pytest

from projservo_cli.records import InputError, WorkFailed
from projservo_cli.store import SweepTable
from projservo_cli.sweep import driver, engine
from projservo_cli.sweep.driver import Folder, read_manifest, shares_settings, status_of
from projservo_cli.sweep.runs import columns_of
from tests.sweep.cases import columns, design, make
from tests.sweep.processes import differences, finish, kill_group, parts, start, wait_for_parts, written

pytestmark = pytest.mark.volume

RUNS = 300  # a law: some seconds of work, on a busy machine long after its first parts are seen


@pytest.fixture(scope="module")
def long(tmp_path_factory):
    """Configuration and folder of a sweep of two laws, which takes long enough to be ended in its midst."""
    folder = tmp_path_factory.mktemp("long")
    config = written(folder, RUNS)
    code, _, err = finish(start(config, folder / "out"))
    assert code == 0, err
    return config, folder / "out"


def test_killed_and_run_again_equals_the_uninterrupted_one(long, tmp_path):
    """Ten kills at random moments are made by ``python -m tests.sweep.processes 10``."""
    config, reference = long
    for stored in (1, 4):
        process = start(config, tmp_path)
        wait_for_parts(process, tmp_path, stored)
        kill_group(process)
    left = {path.name: path.stat().st_mtime_ns for path in parts(tmp_path)}
    assert left
    assert not (tmp_path / "sweep.h5").exists()
    code, _, err = finish(start(config, tmp_path, "-j", "2"))
    assert code == 0
    assert f"{2 * len(left)} of {2 * RUNS} runs are stored already" in err
    assert not differences(tmp_path, reference)
    assert not parts(tmp_path)


def test_interrupted_it_leaves_a_table_of_what_was_done(long, tmp_path):
    config, reference = long
    process = start(config, tmp_path, "-j", "2")
    wait_for_parts(process, tmp_path, 2)
    process.send_signal(signal.SIGINT)
    code, _, err = finish(process)
    assert code == 130, err
    assert "Traceback" not in err
    table, full = SweepTable(tmp_path / "sweep.h5"), SweepTable(reference / "sweep.h5")
    rows = table.column("run")
    assert 4 <= len(rows) < 2 * RUNS
    for name in table.names:
        assert table.column(name).tobytes() == full.column(name)[rows].tobytes()
    code, out, _ = finish(start(config, tmp_path, "--json"))
    told = json.loads(out)
    assert (code, told["complete"], told["runs"], told["done"], told["cells"]) == (
        0,
        True,
        2 * RUNS,
        2 * RUNS,
        2,
    )
    assert not differences(tmp_path, reference)


def test_the_table_opens_in_xarray_and_pandas(long):
    xarray = pytest.importorskip("xarray", reason="xarray is not installed")
    pytest.importorskip("h5netcdf", reason="h5netcdf is not installed")
    pytest.importorskip("pandas", reason="pandas is not installed")
    _, folder = long
    ours = columns(folder)
    with xarray.open_dataset(folder / "sweep.h5") as data:
        assert dict(data.sizes) == {"run": 2 * RUNS}
        frame = data.to_dataframe()
        assert data["position_error_mm"].attrs["units"] == "mm"
    assert frame.index.tolist() == list(range(2 * RUNS))
    assert set(frame.columns) == set(ours) - {"run"}
    for name, values in ours.items():
        if name != "run":
            assert frame[name].tolist() == pytest.approx(values.tolist(), nan_ok=True, abs=0)
    assert frame.groupby("law")["steps"].count().to_dict() == {"direct_two": RUNS, "stacked": RUNS}
    with xarray.open_dataset(folder / "sweep.h5", group=f"traces/{RUNS}") as trace:
        assert trace.sizes["instant"] == ours["steps"][RUNS] + 1
        assert trace.attrs["law"] == "stacked"


def test_another_configuration_is_refused_unless_forced(tmp_path):
    first, second = design(runs=1, chunk=1), design(runs=1, chunk=1, seed=2)
    make(first, tmp_path)
    before = columns(tmp_path)
    assert make(first, tmp_path).complete
    with pytest.raises(InputError, match=r"of another configuration.*--force"):
        make(second, tmp_path)
    assert all(np.array_equal(columns(tmp_path)[name], before[name]) for name in ("run", "seed"))
    make(second, tmp_path, force=True)
    assert columns(tmp_path)["seed"].tolist() != before["seed"].tolist()


def test_other_versions_do_not_go_on_with_a_sweep(tmp_path):
    found, folder = design(runs=1, chunk=1), Folder(tmp_path)
    make(found, tmp_path)
    manifest = read_manifest(folder)
    manifest["provenance"]["numba"] = "0.1"
    folder.manifest.write_text(json.dumps(manifest), encoding="utf-8")
    with pytest.raises(InputError, match=r"made with numba 0\.1, now"):
        status_of(found, folder, force=False)
    folder.manifest.write_text("{", encoding="utf-8")
    with pytest.raises(InputError, match="damaged"):
        status_of(found, folder, force=False)


def test_a_damaged_part_is_named(tmp_path):
    found, folder = design(runs=1, chunk=1, traces=[0]), Folder(tmp_path)

    def interrupt(what, done, total):
        if what == "runs" and done == 1:
            raise KeyboardInterrupt

    from projservo_cli.sweep.driver import run

    with pytest.raises(KeyboardInterrupt):
        run(found, folder, engine.LocalEngine(1), interrupt, lambda _: None)
    (part,) = folder.stored()
    assert status_of(found, folder, force=False).done == 1
    assert SweepTable(folder.table).rows == 1
    assert len(columns(tmp_path)) == len(columns_of(found))
    part.write_bytes(part.read_bytes()[:1000])
    with pytest.raises(InputError, match=f"{part.name}.*cut short or changed"):
        make(found, tmp_path)


def test_threads_give_the_same_and_are_left_in_order(tmp_path):
    """Runs that differ in their seeds alone are threads; an interrupt waits for those at work."""
    found = design(runs=30, chunk=5, calibrations=2)
    assert shares_settings(found)
    assert make(found, tmp_path / "one").complete
    reference = columns(tmp_path / "one")

    def interrupt(what, done, total):
        if what == "runs" and done >= 10:
            raise KeyboardInterrupt

    two, say = Folder(tmp_path / "two"), [].append
    with pytest.raises(KeyboardInterrupt):
        driver.run(found, two, engine.LocalEngine(2), interrupt, say)
    assert not [thread for thread in threading.enumerate() if "ThreadPool" in thread.name]
    rows = columns(two.path)["run"]
    assert 10 <= len(rows) < 60
    assert make(found, two.path, workers=2).complete
    for name, values in columns(two.path).items():
        assert values.tobytes() == reference[name].tobytes(), name


@pytest.mark.parametrize(
    "given",
    [
        {"random": {"control.gain_t": {"uniform": [1, 3]}}},
        {"tasks": {"random": 100}, "runs": 100},
        {"calibrations": 4, "runs": 3},
        {"grid": {"law": ["exact", "exact_track"]}},
        {"between_samples": True},
    ],
)
def test_runs_that_share_little_are_not_threads(given):
    assert not shares_settings(design(**given))


def test_killed_before_its_parts_were_put_together_or_removed(tmp_path, monkeypatch):
    """All runs are done, but there is no table; or there is, and its parts still are."""

    def killed(*_):
        raise SystemExit

    found, folder = design(runs=2, chunk=2), Folder(tmp_path)
    for name in ("assembled", "shutil.rmtree"):
        with monkeypatch.context() as patched:
            patched.setattr(f"projservo_cli.sweep.driver.{name}", killed)
            with pytest.raises(SystemExit):
                make(found, tmp_path)
        status = status_of(found, folder, force=False)
        assert (status.done, status.total, status.complete) == (4, 4, False)
    assert make(found, tmp_path).complete
    assert status_of(found, folder, force=False).complete
    assert not parts(tmp_path)
    assert columns(tmp_path)["run"].tolist() == [0, 1, 2, 3]


def slow_or_dead(job):
    """A job that ends its process the first time it is made."""
    number, marker = job
    if number == 3 and not marker.exists():
        marker.touch()
        import os

        os._exit(9)
    return number


def test_jobs_of_a_lost_process_are_made_again(tmp_path):
    found = engine.LocalEngine(2)
    jobs = [(number, tmp_path / "died") for number in range(12)]
    try:
        assert sorted(engine.completed(found, slow_or_dead, jobs)) == list(range(12))
    finally:
        found.close()
    assert (tmp_path / "died").exists()


def always_dead(job):
    """A job that no process survives."""
    import os

    os._exit(9)


def test_processes_that_die_again_and_again_end_in_words(monkeypatch):
    monkeypatch.setattr(engine, "MOST_LOSSES", 1)
    found = engine.LocalEngine(2)
    with pytest.raises(WorkFailed, match="lost 2 times in a row"):
        list(engine.completed(found, always_dead, [1]))
    found.close()
