"""Statistics of sweeps against closed forms and published values, and the report as a whole."""

import csv
import json
import math

import numpy as np
import pytest

from projservo_cli.store.sweep_table import assemble, write_part
from projservo_cli.sweeps.folder import Folder
from projservo_cli.sweeps.runs import NUMBERED, measured_columns
from projservo_cli.sweeps.statistics import report
from tests.sweeps.cases import columns, design, make

AXES = [["noise.servo_px", [0, 1]], ["law", ["direct_two", "stacked"]]]
DRAWS = 40


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A made-up table, in which laws differ in their chance to arrive, and its report.

    Statistics as JSON values, the folder of the figures, the columns, and which runs succeeded: all but two
    of those that converged.
    """
    folder, rng = tmp_path_factory.mktemp("made"), np.random.default_rng(3)
    count = 4 * DRAWS
    cell = np.repeat(np.arange(4), DRAWS)
    law = np.where(cell % 2 == 0, b"direct_two", b"stacked")
    noise, angle = (cell // 2).astype(float), np.tile(rng.uniform(0, 180, DRAWS), 4)
    good = rng.random(count) < np.where(law == b"direct_two", 0.95, 0.6)
    arrived = good.copy()
    good[np.flatnonzero(good)[[3, 90]]] = False
    values = {column.name: np.zeros(count, dtype=column.dtype) for column in (*NUMBERED, *measured_columns())}
    values |= {
        "run": np.arange(count),
        "cell": cell,
        "draw": np.tile(np.arange(DRAWS), 4),
        "verdict": np.where(arrived, b"converged", b"no progress").astype("S14"),
        "success": good,
        "rotation_deg": angle,
        "distance_mm": np.full(count, 100.0),
        "path_length_mm": 100.0 + 10.0 * rng.random(count),
        "position_error_mm": np.where(good, 1.0, 50.0) * rng.lognormal(size=count),
        "first_outside_image": np.where(cell == 3, 5, -1),
        "noise.servo_px": noise,
        "law": law,
    }
    headings = (*NUMBERED, ("noise.servo_px", "f8", "1", ""), ("law", "S10", "1", ""), *measured_columns())
    write_part(folder / "part.h5", values, {})
    attributes = {"axes": AXES, "columns": [name for name, *_ in headings], "random": [], "total": count}
    assemble(folder / "sweep.h5", [folder / "part.h5"], headings, attributes)
    told, _ = report(folder / "sweep.h5", [], lambda *_: None)
    return told, folder, values, good


def table(path):
    """Columns of a CSV file of numbers; what is shorter ends with empty cells."""
    with open(path, encoding="utf-8", newline="") as file:
        lines = list(csv.DictReader(file))
    return {name: [float(line[name]) for line in lines if line[name]] for name in lines[0] if "." in name}


def test_statistics_of_cells(made):
    told, _, values, good = made
    cells = told["cells"]
    assert [(cell["noise.servo_px"], cell["law"]) for cell in cells[1:3]] == [
        (0, "stacked"),
        (1, "direct_two"),
    ]
    assert sum(cell["converged"] - cell["successes"] for cell in cells) == 2
    for cell in cells:
        mine = values["cell"] == cell["cell"]
        n, z = cell["runs"], 1.959964
        assert n == DRAWS
        assert cell["successes"] == good[mine].sum()
        assert cell["converged"] == cell["verdicts"].get("converged", 0)
        assert sum(cell["verdicts"].values()) == DRAWS
        assert cell["left_image_rate"] == (cell["cell"] == 3)
        ratio = 0.01 * values["path_length_mm"][mine & good]
        assert cell["quantiles"]["path_length_ratio"]["0.25"] == pytest.approx(np.quantile(ratio, 0.25))
        p = cell["success_rate"]  # the interval of Wilson in closed form
        middle, half = p + z**2 / (2 * n), z * math.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
        wilson = [(middle - half) / (1 + z**2 / n), (middle + half) / (1 + z**2 / n)]
        assert cell["success_interval"] == pytest.approx(wilson, abs=1e-6)


def test_paired_comparison_counts_and_tests_on_the_same_draws(made):
    """The test of McNemar is that of the binomial: so few of one kind by halves, or of the other."""
    told, _, values, good = made
    first, second = told["paired"]
    assert [(pair["noise.servo_px"], pair["laws"]) for pair in (first, second)] == [
        (0, ["direct_two", "stacked"]),
        (1, ["direct_two", "stacked"]),
    ]
    a, b = good[values["cell"] == 0], good[values["cell"] == 1]
    only = [(a & ~b).sum(), (b & ~a).sum()]
    assert first["only"] == only
    assert first["both"] + sum(only) + first["neither"] == first["pairs"] == DRAWS
    tail = sum(math.comb(sum(only), k) for k in range(min(only) + 1)) / 2.0 ** sum(only)
    assert first["p_success"] == pytest.approx(2 * tail)
    x = values["position_error_mm"]
    difference = (x[values["cell"] == 0] - x[values["cell"] == 1])[a & b]
    assert first["median_difference"]["position_error_mm"] == pytest.approx(np.median(difference))
    assert (first["median_difference"]["steps"], first["p_difference"]["steps"]) == (0.0, 1.0)


def test_success_over_a_value_and_within_edges(made):
    _, folder, values, good = made
    over = table(folder / "success_over_noise.servo_px.csv")
    assert over["stacked.x"] == [0, 1]
    assert over["stacked.rate"][1] == pytest.approx(good[values["cell"] == 3].mean())
    edges = table(folder / "success_over_rotation.csv")
    assert [sum(edges[f"{law}.runs"]) for law in ("direct_two", "stacked")] == [80, 80]
    low = (values["law"] == b"stacked") & (values["rotation_deg"] < 30)
    assert edges["stacked.x"][0] == 15
    assert edges["stacked.rate"][0] == pytest.approx(good[low].mean())
    assert (np.array(edges["stacked.low"]) < edges["stacked.rate"]).all()


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
    told, files = report(Folder(tmp_path).assembled(), ["png"], lambda *_: None)
    assert (told["runs"], len(told["cells"]), len(told["paired"])) == (24, 12, 6)
    written = json.loads((tmp_path / "statistics.json").read_text(encoding="utf-8"))
    assert written["cells"][3]["runs"] == 2
    names = {path.stem for path in files if path.suffix == ".png"}
    assert {"basin", "final_error", f"success_over_{offset}.joints.5"} <= names
    assert all(path.stat().st_size > 500 for path in files if path.suffix == ".png")
    basin = table(tmp_path / "basin.csv")
    share = [value for name in basin if name.startswith("direct_two.share") for value in basin[name]]
    assert len(share) == 6
    done = columns(tmp_path)
    assert np.nanmean(share) == pytest.approx(done["success"][done["law"] == "direct_two"].mean())
