"""The commands compare, export, init, schema and doctor."""

import csv
import json
from pathlib import Path

import numpy as np

from projservo_cli.config import load_config
from projservo_cli.config.schema import json_schema
from projservo_cli.records import CarriedByObject, Plan, changed, flat_fields
from projservo_cli.store.run_file import Result, Run, load, save
from tests.fake_records import fake
from tests.report.conftest import read, words


def test_an_export_has_a_table_of_each_object_of_a_goal(projservo, tmp_path):
    objects = tuple(fake(CarriedByObject, object_name=name) for name in ("block", "box"))
    plan = changed(fake(Plan), carried=objects)
    save(Run(tmp_path / "out" / "run.h5", "", {"plan": Result("", "", {}, {}, {"": plan})}))
    answer = projservo("export", str(tmp_path / "out"), "--json")
    assert answer.code == 0, answer.err
    assert {Path(file).name for file in answer.json["files"]} >= {"plan.csv", "plan_carried_2.csv"}
    with (tmp_path / "out" / "csv" / "fields.csv").open(newline="") as file:
        named = [row["value"] for row in csv.DictReader(file) if row["field"] == "object_name"]
    assert named == ["block", "box"]


def test_an_export_holds_every_array_and_says_what_it_is(projservo, reported, tmp_path):
    answer = projservo("export", "out", "--json")
    assert answer.code == 0, answer.err
    folder = tmp_path / "out" / "csv"
    assert {Path(file).parent for file in answer.json["files"]} == {folder}
    with (folder / "fields.csv").open(newline="") as file:
        about = {(row["file"], row["field"]): row for row in csv.DictReader(file)}
    results = load("out").results.items()
    records = {(name, part): record for name, result in results for part, record in result.records.items()}
    for (name, part), record in records.items():
        table = "_".join(filter(None, (*name.split("/"), part))) + ".csv"
        every = {field.name: getattr(record, field.name) for field in flat_fields(type(record))}
        values = {field: value for field, value in every.items() if value is not None}
        counts = dict.fromkeys(values, 0)
        with (folder / table).open(newline="") as file:
            for heading, *cells in zip(*csv.reader(file), strict=True):
                column = np.atleast_1d(eval(heading, values.copy())).astype(float)
                counts[heading.partition("[")[0]] += column.size
                shown = [float(cell) for cell in cells[: column.size]]
                np.testing.assert_array_equal(shown, column, err_msg=f"{table} {heading}")
        for field, value in values.items():
            row = about[table, field]
            if isinstance(value, np.ndarray):
                assert (counts[field], len(row["dimensions"].split())) == (value.size, value.ndim)
                assert row["unit"]
            elif isinstance(value, str):
                assert row["value"] == value
    again = projservo("export", "out/run.h5")
    assert again.code == 2
    assert "--force" in again.err
    assert projservo("export", "out", "--force").code == 0
    assert projservo("export", "out", "-o", "there", "-q").out == ""
    assert (tmp_path / "there/fields.csv").read_bytes() == (folder / "fields.csv").read_bytes()


def test_runs_of_different_settings_are_compared(projservo, stages, tmp_path):
    assert projservo("servo", "-c", "tiny.yaml", "-o", "out", "-q").code == 0
    changed = ["--set", "control.gain_t=1.25"]
    assert projservo("servo", "-c", "tiny.yaml", "-o", "other", *changed, "-q").code == 0
    answer = projservo("compare", "out", "other", "--json")
    assert answer.code == 0, answer.err
    assert answer.json["runs"] == [str(tmp_path / name / "run.h5") for name in ("out", "other")]
    told = words(read(tmp_path / "compare.html").text)
    assert "control.gain_t 2.5 1.25" in told
    assert "tiny (out) tiny (other)" in told
    assert projservo("compare", "out", "other").code == 2
    assert projservo("compare", "out", "other", "other", "--force").code == 0


def test_init_writes_what_loads_and_its_schema(projservo, stages, tmp_path):
    answer = projservo("init", "mine.yaml", "--json")
    assert answer.json == {
        "configuration": str(tmp_path / "mine.yaml"),
        "schema": str(tmp_path / "projservo.schema.json"),
    }
    first = (tmp_path / "mine.yaml").read_text(encoding="utf-8").splitlines()[0]
    assert first.endswith("$schema=projservo.schema.json")
    assert json.loads((tmp_path / "projservo.schema.json").read_text(encoding="utf-8")) == json_schema()
    assert load_config(tmp_path / "mine.yaml").name == "mine"
    (tmp_path / "mine.yaml").write_text("name: changed")
    assert "--force" in projservo("init", "mine.yaml").err
    assert (tmp_path / "mine.yaml").read_text() == "name: changed"
    assert projservo("init", "mine.yaml", "--force").code == 0
    assert projservo("plan", "-c", "mine.yaml", "-n").code == 0
    assert projservo("init", "-q").code == 0
    assert (tmp_path / "projservo.yaml").is_file()


def test_doctor_tells_versions_extras_kernels_and_results(projservo, stages, tmp_path):
    value = projservo("doctor", "--json").json
    assert value["missing"] == []
    assert value["results"] == {"folder": str(tmp_path / "results"), "writable": True}
    assert set(value["kernels"]) == {"jit", "cache", "compiled"}
    text = projservo("doctor").out
    assert max(map(len, text.splitlines())) <= 80 or str(tmp_path) in text
    for word in ("python", "packages", "kernels", "results"):
        assert word in text
