"""Statistics of sweeps against closed forms and published values, and the report as a whole."""

import csv
import json
import math

import numpy as np
import pytest

from projservo_cli.records import InputError
from projservo_cli.store import SweepTable, assemble, write_part
from projservo_cli.sweep.folder import Folder
from projservo_cli.sweep.runs import MEASURED, NUMBERED, Column
from projservo_cli.sweep.statistics import Rows, report, statistics, success_by, wilson
from tests.sweep.cases import design, make

AXES = [["noise.servo_px", [0, 1]], ["law", ["direct_two", "stacked"]]]


def table(folder, draws=40, seed=3):
    """A made-up table: laws differ in their chance to arrive, by noise and by angle."""
    rng = np.random.default_rng(seed)
    count = 4 * draws
    cell = np.repeat(np.arange(4), draws)
    law = np.where(cell % 2 == 0, b"direct_two", b"stacked")
    noise, angle = (cell // 2).astype(float), np.tile(rng.uniform(0, 180, draws), 4)
    good = rng.random(count) < np.where(law == b"direct_two", 0.95, 0.6)
    values = {column.name: np.zeros(count, dtype=column.dtype) for column in (*NUMBERED, *MEASURED)}
    values |= {
        "run": np.arange(count),
        "cell": cell,
        "draw": np.tile(np.arange(draws), 4),
        "verdict": np.where(good, b"converged", b"plateau").astype("S14"),
        "rotation_deg": angle,
        "distance_mm": np.full(count, 100.0),
        "path_length_mm": 100.0 + 10.0 * rng.random(count),
        "position_error_mm": np.where(good, 1.0, 50.0) * rng.lognormal(size=count),
        "first_outside_image": np.where(cell == 3, 5, -1),
        "noise.servo_px": noise,
        "law": law,
    }
    own = (Column("noise.servo_px", "f8", "1", ""), Column("law", "S10", "1", ""))
    headings = (*NUMBERED, *own, *MEASURED)
    write_part(folder / "part.h5", values, {})
    attributes = {"axes": AXES, "columns": [column.name for column in headings], "random": [], "total": count}
    assemble(folder / "sweep.h5", [folder / "part.h5"], headings, attributes)
    return Rows(SweepTable(folder / "sweep.h5")), values, good


def test_wilson_interval():
    """R. G. Newcombe, Statistics in Medicine 17 (1998), table I: 81 of 263, 15 of 148, 0 of 20, 1 of 29."""
    published = {
        (81, 263): (0.2553, 0.3662),
        (15, 148): (0.0624, 0.1605),
        (0, 20): (0.0, 0.1611),
        (1, 29): (0.0061, 0.1718),
    }
    for (successes, count), interval in published.items():
        assert wilson(successes, count) == pytest.approx(interval, abs=5e-5)
    assert wilson(20, 20)[1] == 1.0
    assert np.isnan(wilson(0, 0)).all()


def test_statistics_of_cells(tmp_path):
    rows, values, good = table(tmp_path)
    cells = statistics(rows)["cells"]
    assert [(cell["noise.servo_px"], cell["law"]) for cell in cells[1:3]] == [
        (0, "stacked"),
        (1, "direct_two"),
    ]
    for cell in cells:
        mine = values["cell"] == cell["cell"]
        assert cell["runs"] == 40
        assert cell["converged"] == good[mine].sum() == cell["verdicts"].get("converged", 0)
        assert sum(cell["verdicts"].values()) == 40
        assert cell["left_image_rate"] == (cell["cell"] == 3)
        ratio = 0.01 * values["path_length_mm"][mine & good]
        assert cell["quantiles"]["path_length_ratio"]["0.25"] == pytest.approx(np.quantile(ratio, 0.25))


def test_paired_comparison_counts_and_tests_on_the_same_draws(tmp_path):
    """The test of McNemar is that of the binomial: so few of one kind by halves, or of the other."""
    rows, values, good = table(tmp_path)
    first, second = statistics(rows)["paired"]
    assert [(pair["noise.servo_px"], pair["laws"]) for pair in (first, second)] == [
        (0, ["direct_two", "stacked"]),
        (1, ["direct_two", "stacked"]),
    ]
    a, b = good[values["cell"] == 0], good[values["cell"] == 1]
    only = [(a & ~b).sum(), (b & ~a).sum()]
    assert first["only"] == only
    assert first["both"] + sum(only) + first["neither"] == first["pairs"] == 40
    tail = sum(math.comb(sum(only), k) for k in range(min(only) + 1)) / 2.0 ** sum(only)
    assert first["p_success"] == pytest.approx(2 * tail)
    x = values["position_error_mm"]
    difference = (x[values["cell"] == 0] - x[values["cell"] == 1])[a & b]
    assert first["median_difference"]["position_error_mm"] == pytest.approx(np.median(difference))
    assert (first["median_difference"]["steps"], first["p_difference"]["steps"]) == (0.0, 1.0)


def test_success_over_a_value_and_within_edges(tmp_path):
    rows, values, good = table(tmp_path)
    over = success_by(rows, "noise.servo_px")
    assert over["stacked"]["x"].tolist() == [0, 1]
    assert over["stacked"]["rate"][1] == pytest.approx(good[values["cell"] == 3].mean())
    edges = success_by(rows, "rotation_deg", [0, 60, 120, 180])
    assert [edges[law]["runs"].sum() for law in edges] == [80, 80]
    low = (values["law"] == b"stacked") & (values["rotation_deg"] < 60)
    assert edges["stacked"]["rate"][0] == pytest.approx(good[low].mean())
    assert (edges["stacked"]["low"] < edges["stacked"]["rate"]).all()


@pytest.mark.volume
def test_the_report_of_a_sweep(tmp_path):
    """Over two start offsets, with one drawn: every figure there is but noise."""
    offset = "task.start_offset"
    found = design(
        runs=2,
        set={offset: {"joints": [0] * 6, "unit": "deg"}, "stop.max_steps": 20},
        grid={
            f"{offset}.joints.3": [-5, 5],
            f"{offset}.joints.4": [0, 3, 6],
            "law": ["direct_two", "stacked"],
        },
        random={f"{offset}.joints.5": {"uniform": [-2, 2]}},
    )
    make(found, tmp_path)
    told, files = report(Folder(tmp_path), ["png"], lambda *_: None)
    assert (told["runs"], len(told["cells"]), len(told["paired"])) == (24, 12, 6)
    written = json.loads((tmp_path / "statistics.json").read_text(encoding="utf-8"))
    assert written["cells"][3]["runs"] == 2
    names = {path.stem for path in files if path.suffix == ".png"}
    assert {"basin", "final_error", f"success_over_{offset}.joints.5"} <= names
    assert all(path.stat().st_size > 500 for path in files if path.suffix == ".png")
    with open(tmp_path / "basin.csv", encoding="utf-8", newline="") as file:
        lines = list(csv.DictReader(file))
    share = [float(line[name]) for line in lines for name in line if name.startswith("direct_two.share")]
    assert len(share) == 6
    rows = Rows(SweepTable(tmp_path / "sweep.h5"))
    assert np.nanmean(share) == pytest.approx(rows["success"][rows["law"] == "direct_two"].mean())


def test_a_report_of_nothing(tmp_path):
    with pytest.raises(InputError, match="no table of a sweep"):
        report(Folder(tmp_path), ["png"], lambda *_: None)
