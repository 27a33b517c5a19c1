"""The run file: round trips, names and units in it, whole or not at all, and what is refused."""

import dataclasses
import hashlib
from pathlib import Path

import h5py
import numpy as np
import pytest

from projservo_cli.findings import usable
from projservo_cli.messages import with_findings
from projservo_cli.messages.verdict_causes import arrived
from projservo_cli.records import InputError, Plan, Trace, changed, flat_fields
from projservo_cli.results import RunTrace
from projservo_cli.store import run_file
from projservo_cli.store.run_file import save_record
from tests.fake_records import fake
from tests.store.deceit import EDITS, HEADS, edited, head, resealed
from tests.store.sound import result, sound_file, sound_run

SEAL_SIZE = 83  # bytes of the line behind the data
LONG = "name: ä\n" * 30_000  # 240 kB: beyond what an HDF5 object header holds


@pytest.fixture
def path(tmp_path):
    found = tmp_path / "run.h5"
    found.write_bytes(sound_file())
    return found


def assert_same(a, b):
    assert type(a) is type(b)
    for field in flat_fields(type(a)):
        x, y = getattr(a, field.name), getattr(b, field.name)
        assert type(x) is type(y), field.name
        if isinstance(x, np.ndarray):
            assert x.dtype == y.dtype, field.name
            np.testing.assert_array_equal(x, y, err_msg=field.name)
        else:
            assert x == y, field.name


def refused(path):
    with pytest.raises(InputError) as caught:
        run_file.load(path)
    message = str(caught.value)
    assert str(path) in message
    assert "\n" not in message
    assert len(message) < 500
    return message


def test_a_calibration_of_an_earlier_version_has_its_sentences_as_findings(path):
    before = run_file.load(path).calibration
    edited(path, head("calibrate/calibration", "findings", None))
    calibration = run_file.load(path).calibration
    assert (calibration.reason, calibration.advice) == (before.reason, before.advice)
    told = [one.subject.name for one in calibration.findings if one.code == "told"]
    assert told == [before.reason, *before.advice]
    assert usable(calibration.findings) == before.usable
    assert with_findings(calibration, ()).reason == before.reason  # as a refit judges it once more


@pytest.mark.parametrize("group", ["plan", "servo/direct_three"])
def test_a_plan_and_a_run_of_an_earlier_version_have_their_reason_as_a_finding(path, group):
    (before,) = run_file.load(path).results[group].records.values()
    edited(path, head(group, "findings", None))
    (after,) = run_file.load(path).results[group].records.values()
    (one,) = after.findings
    assert (one.code, one.subject.name) == ("told", before.reason)
    assert usable(after.findings) == (before.feasible if group == "plan" else arrived(before.verdict))


def test_everything_comes_back(tmp_path):
    run = dataclasses.replace(sound_run(tmp_path / "run.h5"), configuration=LONG)
    run_file.save(run)
    back = run_file.load(tmp_path)
    assert (back.path, back.configuration, list(back.results)) == (run.path, LONG, list(run.results))
    for name, stored in run.results.items():
        loaded = back.results[name]
        for label, record in stored.records.items():
            assert_same(record, loaded.records[label])
        assert dataclasses.replace(loaded, records={}) == dataclasses.replace(stored, records={})
    assert_same(back.calibration, run.calibration)
    assert_same(back.plan, run.plan)
    assert back.cross_validation.rms_px == 0.5
    assert list(back.traces) == ["stacked", "direct_three"]


@pytest.mark.parametrize("names", [("hand",), ("top", "left", "door")])
def test_plans_and_runs_of_any_views_come_back_with_counts_by_name(tmp_path, names):
    trace = fake(Trace, 1, view=names)
    made = {"plan": result(**{"": fake(Plan, 2, view=names)}), "servo/exact": result(**{"": trace})}
    run_file.save(run_file.Run(tmp_path / "run.h5", "", made))
    back = run_file.load(tmp_path)
    assert_same(back.plan, made["plan"].records[""])
    assert_same(back.traces["exact"], trace)
    with h5py.File(tmp_path / "run.h5") as file:
        attributes = file["servo/exact"].attrs
        stored = {name: attributes[f"self_occluded_steps_{name}"].item() for name in names}
    assert stored == {name: getattr(trace, f"self_occluded_steps_{name}") for name in names}
    assert [*stored.values()] == [*trace.self_occluded_steps]
    with pytest.raises(AttributeError, match="Trace has no self_occluded_steps_roof"):
        getattr(trace, "self_occluded_steps_roof")  # noqa: B009
    xarray = pytest.importorskip("xarray")
    labelled = RunTrace.of(back.traces["exact"]).to_xarray()
    assert labelled["view"].values.tolist() == [*names]
    xarray.testing.assert_equal(labelled["s"].sel(view=names[-1]), labelled["s"][:, -1])


def test_names_and_arrays_of_views_must_be_as_many(tmp_path):
    trace = changed(fake(Trace), view=("left",), self_occluded_steps=(1,))
    run_file.save(run_file.Run(tmp_path / "run.h5", "", {"servo/exact": result(**{"": trace})}))
    assert "arrays of 2 views, named left" in refused(tmp_path)


def test_xarray_shows_dimensions_units_and_coordinates(path):
    xarray, plan = pytest.importorskip("xarray"), run_file.load(path).plan
    with xarray.open_datatree(path, engine="h5netcdf") as tree:
        calibration = tree["calibrate/calibration"]
        assert calibration["P"].dims == ("view", "image_row", "coordinate")
        assert calibration["P"].attrs["units"] == "px"
        assert calibration["q_reference"].attrs["units"] == "rad or m"
        assert "marker" in calibration.coords
        assert calibration["poorly_observable"].dtype == bool
        assert tree["servo/direct_three"].sizes["step"] == 0
        assert tree["servo/direct_three"].attrs["law"] == "ä"
        np.testing.assert_array_equal(tree["plan"]["H_d"], plan.H_d)
        unnamed = [
            f"{node.path}/{name}"
            for node in tree.subtree
            for name, data in node.data_vars.items()
            if not data.attrs.get("units") or any(str(dim).startswith("phony") for dim in data.dims)
        ]
        assert unnamed == []
    with xarray.open_dataset(path, group="plan") as data:  # found out by its first bytes
        assert "sample" in data.sizes


def test_the_checksum_is_that_of_the_data_and_every_array_has_one_of_its_own(path):
    data = path.read_bytes()
    digest = hashlib.sha256(data[:-SEAL_SIZE]).hexdigest()
    assert data[-SEAL_SIZE:].decode() == f"\nprojservo sha256 {digest}\n"
    without = []

    def look(name, found):
        if isinstance(found, h5py.Dataset) and "units" in found.attrs and found.size and not found.fletcher32:
            without.append(name)

    with h5py.File(path) as file:
        file.visititems(look)
    assert without == []


def test_same_records_make_the_same_bytes(path):
    run_file.save(dataclasses.replace(run_file.load(path), path=path.parent / "other.h5"))
    assert path.read_bytes() == (path.parent / "other.h5").read_bytes()


def test_what_is_added_to_and_what_is_written_as_a_whole_hold_the_same(tmp_path, monkeypatch):
    made = sound_run(tmp_path / "run.h5").results
    stored = []
    monkeypatch.setattr(
        run_file, "save_record", lambda group, record: stored.append(group.name) or save_record(group, record)
    )
    run = run_file.Run(tmp_path / "run.h5")
    for name in made:
        run = run_file.save(dataclasses.replace(run, results={**run.results, name: made[name]}))
    assert len(stored) == len(set(stored)) == 7  # each record once
    for refuted in ("a camera moved", ""):  # said, and taken back
        run = run_file.save(dataclasses.replace(run, refuted=refuted))
        assert run_file.load(run.path).refuted == refuted
    replaced = {**made, "plan": result(**{"": fake(Plan, 8)})}
    for results in (made, replaced):
        run = run_file.save(dataclasses.replace(run, results=results))
        back = run_file.load(run.path).results
        assert list(back) == list(results)
        for name, one in results.items():
            for label, record in one.records.items():
                assert_same(back[name].records[label], record)


def test_a_failing_save_leaves_the_old_file_and_no_debris(path, monkeypatch):
    run = run_file.load(path)
    monkeypatch.setattr(Path, "replace", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left")))
    with pytest.raises(InputError, match="No space left"):
        run_file.save(run)
    assert path.read_bytes() == sound_file()
    assert [found.name for found in path.parent.iterdir()] == ["run.h5"]


def test_a_change_anywhere_is_noticed_before_it_is_read(path, monkeypatch):
    monkeypatch.setattr(h5py, "File", None)
    whole = path.read_bytes()
    for place in (0, 12, 100, 50_000, 100_000, -SEAL_SIZE + 5, -20, -1):
        data = bytearray(whole)
        data[place] ^= 1
        path.write_bytes(data)
        refused(path)
    for keep in (0, 1, 10, 5_000, -1, -40, -SEAL_SIZE + 1, -SEAL_SIZE, -SEAL_SIZE - 1):
        path.write_bytes(whole[:keep])
        message = refused(path)
        assert "cut short or changed since it was written" in message
        assert "restore it, or make it again in another folder" in message


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"schema_version": 4}, "schema 4, this projservo reads 3: upgrade: pip install --upgrade projservo"),
        (
            {"schema_version": 2},
            "schema 2, this projservo reads 3: make it again in another folder: projserv",
        ),
        ({"schema": "something else"}, "not a run file of projservo"),
    ],
)
def test_another_schema_says_what_to_do(path, change, message):
    with h5py.File(path, "a") as file:
        file.attrs.update(change)
    resealed(path)
    assert message in refused(path)


@pytest.mark.parametrize("kind", EDITS)
def test_what_deceives_with_a_checksum_is_refused(path, kind):
    for seed in range(2):
        edited(path, EDITS[kind], seed)
        refused(path)


def test_every_attribute_that_deceives_is_refused(path):
    for wrong in HEADS:
        edited(path, head(*wrong))
        assert refused(path), wrong
