"""The run file: round trips, names and units in it, whole or not at all, refusals."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import pytest

from projservo_cli import records, store
from projservo_cli.records import Calibration, InputError, Observation, Plan, Trace, array, scalar
from tests import fake_records

LONG = "name: ä\n" * 30_000  # 240 kB: beyond what an HDF5 object header holds


def result(**named):
    return store.Result("key", LONG, {"date": "today", "seed": 1}, {"table": "t.csv"}, named)


@pytest.fixture
def run(tmp_path):
    return store.Run(
        tmp_path / "run.h5",
        "name: test\n",
        {
            "calibrate": result(
                observation=fake_records.fake(Observation, 1),
                calibration=fake_records.fake(Calibration, 2, advice=("a", "é")),
            ),
            "plan": result(**{"": fake_records.fake(Plan, 3)}),
            "servo/stacked": result(**{"": fake_records.fake(Trace, 4, position_error_mm=0.25)}),
            "servo/direct_three": result(
                **{"": fake_records.fake(Trace, 5, sizes={"step": 0, "instant": 1})}
            ),
        },
    )


def assert_same(a, b):
    assert type(a) is type(b)
    for field in dataclasses.fields(a):
        x, y = getattr(a, field.name), getattr(b, field.name)
        assert type(x) is type(y), field.name
        if isinstance(x, np.ndarray):
            assert x.dtype == y.dtype, field.name
            np.testing.assert_array_equal(x, y, err_msg=field.name)
        else:
            assert x == y, field.name


def test_everything_comes_back(run):
    store.save(run)
    back = store.load(run.path.parent)
    assert (back.path, back.configuration, list(back.results)) == (
        run.path,
        run.configuration,
        list(run.results),
    )
    for name, stored in run.results.items():
        loaded = back.results[name]
        assert (loaded.key, loaded.configuration) == (stored.key, stored.configuration)
        assert (loaded.provenance, loaded.inputs) == (stored.provenance, stored.inputs)
        for label, record in stored.records.items():
            assert_same(record, loaded.records[label])
    assert_same(back.calibration, run.calibration)
    assert_same(back.observation, run.observation)
    assert_same(back.plan, run.plan)
    assert list(back.traces) == ["stacked", "direct_three"]


@dataclass(frozen=True, eq=False)
class Odd:
    counts: records.IntArray = array("thing", about="counts")  # noqa: RUF009 (a field)
    yes: records.BoolArray = array("thing", "thing_", about="flags")  # noqa: RUF009 (a field)
    absent: records.FloatArray | None = array("nothing", about="not there")  # noqa: RUF009 (a field)
    there: records.FloatArray | None = array("there", "side", units="px", about="named as a dimension")  # noqa: RUF009 (a field)
    number: float | None = scalar()
    missing: str | None = scalar()
    flag: bool = scalar()
    rows: tuple[dict[str, int], ...] = scalar()
    infinite: float = scalar()


def test_optional_nested_and_special_values_come_back(tmp_path, monkeypatch):
    monkeypatch.setattr(records, "Odd", Odd, raising=False)
    monkeypatch.setitem(store.RECORDS, "report", {"": Odd})
    odd = Odd(
        np.array([3, -1]),
        np.array([[True, False], [False, False]]),
        None,
        np.array([[np.nan, np.inf]]),
        1.25,
        None,
        False,
        ({"pose": 3, "marker": 1},),
        float("-inf"),
    )
    store.save(store.Run(tmp_path / "run.h5", "", {"report": result(**{"": odd})}))
    assert_same(store.load(tmp_path).results["report"].records[""], odd)


def test_xarray_shows_dimensions_units_and_coordinates(run):
    xarray = pytest.importorskip("xarray")
    pytest.importorskip("h5netcdf")
    store.save(run)
    with xarray.open_datatree(run.path, engine="h5netcdf") as tree:
        calibration = tree["calibrate/calibration"]
        assert calibration["P"].dims == ("view", "image_row", "coordinate")
        assert calibration["P"].attrs["units"] == "px"
        assert calibration["q_reference"].attrs["units"] == "rad or m"
        assert "marker" in calibration.coords
        assert calibration["weak"].dtype == bool
        assert tree["servo/direct_three"].sizes["step"] == 0
        np.testing.assert_array_equal(tree["plan"]["H_d"], run.plan.H_d)
        unnamed = [
            f"{node.path}/{name}"
            for node in tree.subtree
            for name, data in node.data_vars.items()
            if not data.attrs.get("units") or any(str(dim).startswith("phony") for dim in data.dims)
        ]
        assert unnamed == []


def test_same_records_make_the_same_bytes(run, tmp_path):
    store.save(run)
    other = dataclasses.replace(run, path=tmp_path / "other.h5")
    store.save(other)
    assert run.path.read_bytes() == other.path.read_bytes()


def test_a_failing_save_leaves_the_old_file_and_no_debris(run, monkeypatch):
    store.save(run)
    before = run.path.read_bytes()
    wrong = dataclasses.replace(run.plan, sigma=np.zeros((2, 2)))  # two dimensions where one is declared
    results = {**run.results, "plan": result(**{"": wrong})}
    with pytest.raises(ValueError, match="sigma"):
        store.save(dataclasses.replace(run, results=results))
    monkeypatch.setattr(Path, "replace", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left")))
    with pytest.raises(InputError, match="No space left"):
        store.save(run)
    assert run.path.read_bytes() == before
    assert [path.name for path in run.path.parent.iterdir()] == ["run.h5"]


def test_sizes_that_disagree_are_not_stored(run):
    wrong = dataclasses.replace(run.calibration, weak=np.zeros(5, dtype=bool))
    with pytest.raises(ValueError, match="joint"):
        store.save(dataclasses.replace(run, results={"calibrate": result(calibration=wrong)}))


def test_a_folder_or_the_file_names_a_run(run):
    store.save(run)
    assert store.run_path(run.path) == run.path
    assert store.run_path(run.path.parent) == run.path
    assert store.run_path("nowhere/else.h5") == Path("nowhere/else.h5")


@pytest.mark.parametrize("keep", [0, 10, 512, 5_000, -1])
def test_a_file_cut_short_is_refused_in_one_line(run, keep):
    store.save(run)
    run.path.write_bytes(run.path.read_bytes()[:keep])
    with pytest.raises(InputError) as caught:
        store.load(run.path)
    assert str(run.path) in str(caught.value)
    assert "\n" not in str(caught.value)


def damaged(file, what):
    if what == "schema":
        file.attrs["schema"] = "something else"
    elif what == "version":
        file.attrs["schema_version"] = store.SCHEMA_VERSION + 1
    elif what == "no order":
        del file.attrs["order"]
    elif what == "no array":
        del file["plan/sigma"]
    elif what == "no scalar":
        del file["plan"].attrs["tau"]
    elif what == "rank":
        del file["plan/sigma"]
        file["plan/sigma"] = np.zeros((2, 2))
    elif what == "record":
        file["plan"].attrs["record"] = "Path"
    elif what == "group":
        del file["calibrate/observation"]
    elif what == "json":
        file["plan"].attrs["provenance"] = "{"


@pytest.mark.parametrize(
    "what", ["schema", "version", "no order", "no array", "no scalar", "rank", "record", "group", "json"]
)
def test_an_alien_or_damaged_file_is_refused_in_one_line(run, what):
    store.save(run)
    with h5py.File(run.path, "a") as file:
        damaged(file, what)
    with pytest.raises(InputError) as caught:
        store.load(run.path)
    assert str(run.path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_what_a_run_lacks_is_named(tmp_path):
    with pytest.raises(InputError, match="there is no run file"):
        store.load(tmp_path)
    with pytest.raises(InputError, match="holds no calibration"):
        _ = store.Run(tmp_path / "run.h5").calibration
