"""Making the results of stages, one after the other, each from those before it."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from projservo_cli.config import Config, to_yaml
from projservo_cli.stages import Progress
from projservo_cli.stages.steps import STAGES, Step, result_of
from projservo_cli.stages.world import has_task
from projservo_cli.store import SERVO, Run, save


def make_result(
    step: Step, config: Config, run: Run, laws: Sequence[str], progress: Progress
) -> tuple[Run, list[str]]:
    """Make one result from those before it, and put it into the run file.

    laws : names of the runs a report is about; others may be stored, of other settings perhaps.
    Returns the run with it, and the names of results dropped because they were made from older ones. Raises
    InputError, WorkFailed as the stage does; the run file is then as it was.
    """
    run = replace(run, configuration=to_yaml(config))
    result = result_of(step, config, *_made(step, config, run, laws, progress))
    place = STAGES.index(step.stage)
    after = [name for name in run.results if STAGES.index(name.split("/")[0]) > place]
    results = {name: stored for name, stored in run.results.items() if name not in after}
    return save(replace(run, results={**results, step.name: result})), after


def _made(step: Step, config: Config, run: Run, laws: Sequence[str], progress: Progress) -> tuple[Any, ...]:
    """What a stage makes; its module is imported when it is needed."""
    if step.stage == "calibrate":
        from projservo_cli.stages import calibrate

        return calibrate.run(config, progress=progress)
    if step.stage == "plan":
        from projservo_cli.stages import plan

        return (plan.run(config, run.calibration),)
    if step.stage == "servo":
        from projservo_cli.stages import servo

        return (servo.run(config, run.calibration, run.plan, step.law),)
    from projservo_cli.stages import report

    return (report.run(reported(config, run, laws), run.path.parent, progress=progress),)


def reported(config: Config, run: Run, laws: Sequence[str]) -> Run:
    """What a report is about: of the results before it those that the named runs of laws rest on."""
    names = ["calibrate", *(["plan", *(SERVO + law for law in laws)] if has_task(config) else [])]
    return replace(run, results={name: run.results[name] for name in names})
