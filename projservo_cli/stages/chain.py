"""Making the results of stages, one after the other, each from those before it."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from projservo_cli import provenance
from projservo_cli.config import Config, to_yaml
from projservo_cli.stages import Progress
from projservo_cli.stages.steps import STAGES, Step
from projservo_cli.stages.world import has_task
from projservo_cli.store import SERVO, Result, Run, save


def stage_module(stage: str) -> Any:
    """The module that does the work of a stage, imported when it is needed."""
    if stage == "calibrate":
        from projservo_cli.stages import calibrate

        return calibrate
    if stage == "plan":
        from projservo_cli.stages import plan

        return plan
    if stage == "servo":
        from projservo_cli.stages import servo

        return servo
    from projservo_cli.stages import report

    return report


def make(
    step: Step, config: Config, run: Run, laws: Sequence[str], progress: Progress
) -> tuple[Run, list[str]]:
    """Make one result and put it into the run file.

    laws : names of the runs a report is about; others may be stored, of other settings perhaps.
    Returns the run with it, and the names of results dropped because they were made from older ones. Raises
    InputError, WorkFailed as the stage does; the run file is then as it was.
    """
    run = replace(run, configuration=to_yaml(config))
    records = _records(step, config, run, laws, progress)
    result = Result(step.key, run.configuration, provenance.collect(seed=config.seed), step.inputs, records)
    place = STAGES.index(step.stage)
    after = [name for name in run.results if STAGES.index(name.split("/")[0]) > place]
    results = {name: stored for name, stored in run.results.items() if name not in after}
    return save(replace(run, results={**results, step.name: result})), after


def _records(step: Step, config: Config, run: Run, laws: Sequence[str], progress: Progress) -> dict[str, Any]:
    module = stage_module(step.stage)
    if step.stage == "calibrate":
        observation, calibration, held_out = module.run(config, progress=progress)
        records = {"observation": observation, "calibration": calibration}
        return records if held_out is None else records | {"cross_validation": held_out}
    if step.stage == "plan":
        return {"": module.run(config, run.calibration)}
    if step.stage == "servo":
        return {"": module.run(config, run.calibration, run.plan, step.law, progress=progress)}
    return {"": module.run(reported(config, run, laws), run.path.parent, progress=progress)}


def reported(config: Config, run: Run, laws: Sequence[str]) -> Run:
    """What a report is about: of the results before it those that the named runs of laws rest on."""
    names = ["calibrate", *(["plan", *(SERVO + law for law in laws)] if has_task(config) else [])]
    return replace(run, results={name: run.results[name] for name in names})
