"""Worlds: what is true stays inside a simulated one."""

import ast
from dataclasses import fields, is_dataclass

import pytest

from projservo_cli.config import inputs as given
from projservo_cli.simulation.ground_truth import Truth
from projservo_cli.stages.scenario import world_of
from projservo_cli.stages.worlds.calibrated import CalibratedWorld
from projservo_cli.stages.worlds.simulated import RenderedWorld, SimulatedWorld
from tests.conftest import ROOT
from tests.known import configured

WORLDS = {"paper": SimulatedWorld, "seven": SimulatedWorld, "rendered": RenderedWorld}


def held(record):
    """All that a record holds, down to the leaves."""
    yield record
    if is_dataclass(record):
        parts = [getattr(record, field.name) for field in fields(record)]
    else:
        parts = record if isinstance(record, tuple) else ()
    for part in parts:
        yield from held(part)


@pytest.mark.parametrize("name", WORLDS)
def test_a_world_as_calibrated_holds_no_truth(name):
    config = configured(name)
    simulated = given.plan_inputs(config)
    believed = world_of(given.plan_inputs(config, predicted=True), simulated.described.truth.calibration)
    assert type(believed) is CalibratedWorld
    assert not [one for one in held(believed) if isinstance(one, Truth)]
    known = world_of(simulated, simulated.described.truth.calibration)
    assert type(known) is WORLDS[name]
    assert [one for one in held(known) if isinstance(one, Truth)]


@pytest.mark.parametrize(
    "name",
    [
        "plan",
        "plan_motion",
        "carried_goals",
        "servo",
        "runs/law_run",
        "runs/run_trace",
        "runs/robot_with_monitors",
        "worlds/calibrated",
    ],
)
def test_what_plans_and_drives_reads_no_truth(name):
    path = ROOT / "projservo_cli" / "stages" / f"{name}.py"
    nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
    assert not [node for node in nodes if isinstance(node, ast.Attribute) and node.attr == "truth"]
