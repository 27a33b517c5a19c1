"""What is compiled beside the first calibration is what runs call: for other types it would serve nobody."""

from numba import typeof

from projservo_cli.control.law import ERRORS, State, new_state
from projservo_cli.loop.jit_warmup import calls
from projservo_cli.loop.verdicts import Log, new_log
from projservo_cli.records import Model
from projservo_cli.simulation.analytic_plant import Ends, Plant
from projservo_cli.task.face import Task
from tests.known import configured, known_scenario


def test_records_are_of_the_types_of_a_run():
    scenario = known_scenario(configured("paper"))
    real = {
        Model: scenario.model,
        Task: scenario.ends.task(scenario.model),
        Plant: scenario.plant_of("exact"),
        State: new_state(6, scenario.m),
        Log: new_log(6, scenario.m, 3, len(ERRORS)),
        Ends: scenario.true_ends,
    }
    met = set()
    for _, arguments in calls():
        for argument in arguments:
            if type(argument) in real:
                assert typeof(argument) == typeof(real[type(argument)])
                met.add(type(argument))
    assert met == set(real)
