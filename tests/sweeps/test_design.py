"""What a run of a sweep is: cells, draws, seeds, refusals."""

import itertools
import math

import numpy as np
import pytest

from projservo_cli.config import load_sweep, to_yaml
from projservo_cli.config.sweep import SweepConfig
from projservo_cli.records import InputError
from projservo_cli.sweeps.design import Design, read_design
from tests.conftest import ROOT
from tests.known import configured
from tests.sweeps.cases import design


def test_the_grid_is_the_product_of_its_axes_and_the_last_runs_fastest():
    found = design(
        base=["paper", "ur5"],
        grid={
            "noise": {"keys": ["noise.calibration_px", "noise.servo_px"], "values": [0, 0.5]},
            "control.gain_t": [1.0, 2.5, 4.0],
        },
        set={"control.laws": ["exact", "stacked"]},
    )
    assert found.cells == 2 * 2 * 3 * 2
    assert found.total == 4 * found.cells
    expected = itertools.product(["paper", "ur5"], [0, 0.5], [1.0, 2.5, 4.0], ["exact", "stacked"])
    for cell, (base, noise, gain, law) in enumerate(expected):
        config = found.cell(cell)
        assert config.robot.name == {"paper": "PUMA 560", "ur5": "UR5"}[base]
        assert config.noise.calibration_px == config.noise.servo_px == noise
        assert config.control.gain_t == gain
        assert config.control.laws == (law,)
        assert found.values(cell) == {"base": base, "noise": noise, "control.gain_t": gain, "law": law}


def test_a_run_depends_on_its_number_alone_and_cells_share_their_draws():
    values = {
        "runs": 6,
        "calibrations": 4,
        "random": {"control.gain_t": {"uniform": [1, 3]}, "noise.calibration_px": {"log_uniform": [0.1, 1]}},
    }
    first, second = design(**values), design(**values)
    configs = [first.config(run) for run in range(first.total)]
    backwards = [second.config(run) for run in reversed(range(second.total))]
    assert configs == backwards[::-1]
    assert len({config.seed for config in configs}) == 6
    for draw in range(6):
        here, there = configs[draw], configs[draw + 6]
        assert (here.control.laws, there.control.laws) == (("direct_two",), ("stacked",))
        assert here.seed == there.seed
        assert here.control.gain_t == there.control.gain_t
    # What the calibration depends on is drawn for the calibration: run 0 and run 4 share theirs.
    assert configs[0].calibration == configs[4].calibration != configs[1].calibration
    assert configs[0].noise == configs[4].noise != configs[1].noise
    assert configs[0].control.gain_t != configs[4].control.gain_t
    keys = {first.calibration_key(cell, of) for cell, _, of, _ in map(first.numbers, range(12))}
    assert len(keys) == 4 == len(list(first.calibrations()))


def test_a_design_is_made_again_from_its_recipe_and_its_key_tells_what_matters():
    found = design()
    again = Design.made_of(found.recipe)
    assert again.key == found.key
    assert again.config(5) == found.config(5)
    assert design(chunk=2, name="other").key == found.key
    assert len({design(**other).key for other in ({}, {"seed": 1}, {"runs": 5}, {"traces": [1]})}) == 4


def test_distributions_keep_to_their_bounds_and_moments():
    given = {"uniform": [-1, 3], "log_uniform": [0.01, 100], "normal": [2, 0.5], "choice": ["a", "b"]}
    keys = dict(zip(("control.gain_t", "control.gain_r", "control.gain_p", "name"), given, strict=True))
    values = {"name": "n", "base": ("b",), "seed": 5, "runs": 4000, "grid": {"law": ["exact"]}}
    values["random"] = {key: {kind: given[kind]} for key, kind in keys.items()}
    found = Design(SweepConfig.model_validate(values), (("b", to_yaml(configured("paper"))),))
    drawn = [found.drawn(run) for run in range(4000)]
    draws = {kind: np.array([values[key] for values in drawn]) for key, kind in keys.items()}
    # Four standard errors of the mean of 4000 draws.
    assert abs(draws["uniform"].mean() - 1) < 4 * 4 / math.sqrt(12 * 4000)
    assert (draws["uniform"].min(), draws["uniform"].max()) > (-1, 2.9)
    assert abs(np.log(draws["log_uniform"]).mean()) < 4 * math.log(1e4) / math.sqrt(12 * 4000)
    assert abs(draws["normal"].mean() - 2) < 4 * 0.5 / math.sqrt(4000)
    assert abs(draws["normal"].std() / 0.5 - 1) < 4 / math.sqrt(2 * 4000)
    assert abs((draws["choice"] == "a").sum() - 2000) < 4 * math.sqrt(1000)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"grid": {"control.gain_q": [1]}}, r"grid\.control\.gain_q: control\.gain_q=1.*did you mean"),
        ({"grid": {"noise.servo_px": [0.5, -1]}}, r"noise\.servo_px=-1.*must be at least 0"),
        ({"set": {"plant.use": "my_robot:Robot"}}, r"leave plant\.use out"),
        ({"random": {"control.gain_t": {"uniform": [-2, -1]}}}, r"run 0: control\.gain_t.*greater than 0"),
        ({"traces": [8]}, "no run 8"),
        ({"tasks": {"listed": [{"gaol": 1}]}}, r"tasks\.listed\[0\]: task\.gaol: .*did you mean goal"),
        ({"set": {"task.steps": [{"to": "goal"}]}}, r"leave task\.steps out.*one by one in tasks\.listed"),
        ({"grid": {"law": {"exact": {"stop.steps": 5}}}}, r"grid\.law: stop\.steps=5.*did you mean"),
    ],
)
def test_what_no_run_can_be_made_of_is_refused_before_any_is(given, message):
    with pytest.raises(InputError, match=message):
        design(**given)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("base: nowhere.yaml\n", "nowhere.yaml: cannot be read"),
        ("base: paper.yaml\nrun: 5\n", "x.yaml:2:1: run: unknown key; did you mean runs"),
        ("runs: 5\n", "base: is missing"),
        ("base: paper.yaml\nrandom: {control.gain_t: {uniform: [3, 1]}}\n", "a minimum below the maximum"),
        ("base: paper.yaml\nrandom: {control.gain_t: {}}\n", "exactly one of uniform"),
        ("base: paper.yaml\ngrid: {law: []}\n", "grid.law"),
        ("base: paper.yaml\ngrid: {control.gain: [1, 1]}\n", "a value occurs there twice"),
        (
            "base: paper.yaml\ntasks: {random: 3}\ngrid: {task.goal.roll_deg: [1, 2]}\n",
            "task.goal.roll_deg has no effect, since tasks take its place: use tasks.listed",
        ),
        (
            "base: paper.yaml\ngrid: {control.gain: 0.5}\n",
            "grid.control.gain: must be a list of values, not 0.5",
        ),
        ("base: paper.yaml\ngrid: {law: {exact: 5}}\n", "grid.law.also.exact: must be a mapping"),
        (
            "base: paper.yaml\ngrid: {law: {keys: [law], values: [exact], also: {b: {}}}}\n",
            "grid.law.also.b: is none of the values",
        ),
        ("- 1\n", "expected keys and values"),
    ],
)
def test_mistakes_are_told_with_their_place(tmp_path, text, message):
    (tmp_path / "paper.yaml").write_bytes((ROOT / "configs" / "paper.yaml").read_bytes())
    path = tmp_path / "x.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError) as told:
        read_design(load_sweep(path))
    assert message in str(told.value)
    assert "\n" not in str(told.value)
