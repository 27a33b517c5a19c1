"""The table of a sweep: parts put together, texts that open as texts, traces, what is refused."""

import numpy as np
import pytest

from projservo_cli.records import InputError, Trace
from projservo_cli.store.sweep_table import Failure, SweepTable, assemble, write_part
from tests.fake_records import fake

HEADINGS = [("run", "i8", "1", "number"), ("law", "S7", "1", "text"), ("error", "f8", "px", "of the image")]
LAWS = np.array([b"exact", b"stacked", "dé".encode()])


@pytest.fixture
def parts(tmp_path):
    found = []
    for first, last in ((0, 30_000), (30_000, 30_001), (30_001, 30_005)):
        run = np.arange(first, last)
        columns = {"run": run, "law": LAWS[run % 3].astype("S9"), "error": 0.5 * run}
        traces = {first: fake(Trace, first)} if first else {}
        found.append(tmp_path / f"{first}.part.h5")
        failures = {"exact": Failure(2, first + 3, f"reason {first}")} if first != 30_000 else {}
        write_part(found[-1], columns, traces, failures)
    return found


@pytest.fixture
def table(parts, tmp_path):
    path = tmp_path / "sweep.h5"
    assemble(path, parts, HEADINGS, {"columns": [name for name, *_ in HEADINGS], "total": 5})
    return path


def test_what_was_in_the_parts_is_in_the_table(table):
    found = SweepTable(table)
    assert (found.names, found.rows, found.attributes["total"]) == (("run", "law", "error"), 30_005, 5)
    np.testing.assert_array_equal(found.column("error"), 0.5 * np.arange(30_005))
    law = found.column("law")
    assert (law.dtype, law[:3].tolist(), law[-1]) == (np.dtype("U7"), ["exact", "stacked", "dé"], "stacked")
    np.testing.assert_array_equal(found.trace(30_001).q, fake(Trace, 30_001).q)
    with pytest.raises(InputError, match="trace of run 7 was not kept"):
        found.trace(7)


def test_a_part_that_changed_costs_no_table(table, parts):
    before = table.read_bytes()
    parts[1].write_bytes(parts[1].read_bytes()[:-1])
    with pytest.raises(InputError, match="move it elsewhere and run the sweep again"):
        assemble(table, parts, HEADINGS, {})
    assert table.read_bytes() == before
    table.write_bytes(before[:-1])
    with pytest.raises(InputError, match="cut short or changed"):
        SweepTable(table)
    with pytest.raises(InputError, match="not the table of a sweep"):
        SweepTable(parts[0])
