"""Outdated results: the dependencies of stages, and the stages to make first.

Every result carries a key: a hash of its stage's inputs, and of the keys of the results that it is made
from. Keys follow from the configuration and the files that it names, so the work is known before
anything is done.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from projservo_cli import provenance
from projservo_cli.config import Config, stored_yaml
from projservo_cli.config.inputs import (
    Files,
    calibration_inputs,
    files_of,
    plan_inputs,
    report_inputs,
    servo_inputs,
)
from projservo_cli.laws import BODY_LAWS, law_and_mode, run_names
from projservo_cli.messages.verdict_causes import meaning
from projservo_cli.records import InputError
from projservo_cli.report.figure_inputs import CLAIMS_FILE, PAGE_FILE
from projservo_cli.result_hashes import key_of, source_hash
from projservo_cli.settings.task import TaskStep
from projservo_cli.store.run_file import SERVO, Result, Run

# The stages in their order, and the maker of the record that each gets.
_INPUTS: dict[str, Callable[[Config, Files | None], Any]] = {
    "calibrate": calibration_inputs,
    "plan": plan_inputs,
    "servo": servo_inputs,
    "report": report_inputs,
}
STAGES = tuple(_INPUTS)
_HASH = "_sha256"  # behind the name of a file, of its hash


@dataclass(frozen=True)
class Step:
    """One result that is needed."""

    stage: str  # name of the stage
    law: str  # name of the run of a law for ``servo``, such as ``exact`` or ``exact_track``, otherwise empty
    key: str  # future key of the result
    inputs: Mapping[str, str]  # files read and their hashes, and the hash of the source of a user's law
    why: str = ""  # why it has to be made; empty if the stored one is up to date
    note: str = ""  # changes that do not outdate it, in words
    unkeyed: bool = False  # whether its law has no source, so that it is never up to date
    record: Any = None  # inputs of the stage; None if they cannot be made
    part: str = ""  # name of the step of a sequence, otherwise empty

    @property
    def name(self) -> str:
        """Name of the result in the run file."""
        return "/".join(filter(None, (self.stage, self.part, self.law)))

    @property
    def status(self) -> str:
        """State of a result that is not to be made."""
        return f"up to date, though {self.note}" if self.note else "up to date"


def steps_for(
    config: Config,
    run: Run,
    named: Sequence[str],
    *,
    laws: Sequence[str] = (),
    force: bool = False,
    recording: str = "",
) -> list[Step]:
    """All results that the named stages consist of or need, in the order of making.

    run : the stored run, which may be empty.
    laws : instead of ``control.laws``.
    force : make the named stages even if they are up to date, and replace a recorded calibration.
    recording : why the table has to be recorded first; keys of dependent results are unknown until then.
    """
    stages = STAGES[: max(map(STAGES.index, named)) + 1]
    inputs = _Inputs() if recording else _inputs(config, run, stages)

    def names_of(asked: Sequence[str]) -> Sequence[str]:
        # the laws of the call that drove it
        if config.steps and run.traces and not (laws or "servo" in named):
            return list(dict.fromkeys(name.split("/")[-1] for name in run.traces))
        return run_names(asked, config.control.mode)

    def planned(stages: Sequence[str], laws: Sequence[str]) -> list[Step]:
        steps: list[Step] = []
        sources = _sources(names_of(laws), config, run) if "servo" in stages else {}
        if config.steps and len(sources) > 1:
            raise InputError(
                f"task.steps: one law in one mode drives a sequence, and there are {', '.join(sources)}: "
                "name one, such as --law exact --set control.mode=[track] (control.laws, control.mode)"
            )
        if "servo" in stages:
            _require_followers(config, sources)
        own = "servo" in named and not config.plant.simulated
        for step in _needed(inputs, sources, stages, config.steps):
            before = [one for one in steps if one.stage != step.stage or step.part]
            remade = bool(recording) or any(one.why for one in before)
            why = _reason(step, run, force and step.stage in named, remade)
            if step.stage == "servo" and own:
                why = why or "a real robot moves in every call"
            observes = step.stage == "plan" and step.record is not None and step.record.carriers
            if observes and {"plan", "servo"} & {*named} and not config.plant.simulated:
                why = why or "its object may lie elsewhere now"
            if step.stage == "plan" and own and config.task and config.task.start_joints is None:
                why = why or "the arm may be elsewhere"
            steps.append(replace(step, why=why))
        if any(step.why for step in steps if step.part and step.stage == "servo"):
            amid = "a sequence is not resumed amid"
            steps = [
                replace(step, why=step.why or amid) if step.part and step.stage == "servo" else step
                for step in steps
            ]
        return steps

    steps = planned(stages, laws or config.control.laws)
    if not config.has_task and set(named) <= {"calibrate", "report"}:
        # For a robot without a model, a report shows the runs that are up to date, and needs no others.
        lacking = {law_and_mode(step.law)[0] for step in steps if step.law and step.why}
        made = {law_and_mode(step.law)[0]: None for step in steps if step.law}.keys() - lacking
        kept = [law for law in laws or config.control.laws if law in made]
        steps = planned(stages if kept else [s for s in stages if s in ("calibrate", "report")], kept)
    stored = run.calibration.source if "calibrate" in run.results else ""
    if steps[0].why and not force and stored == "recorded" and not config.recorded:
        raise InputError(
            f"{run.path}: its calibration comes from recorded data and would be replaced by a simulated one; "
            "choose another folder, name the table (data.table, --data), or use --force (force=True)"
        )
    return steps


class _Read(NamedTuple):
    """Files of a result, in addition to the configuration and its predecessors."""

    inputs: Mapping[str, str]  # files and their hashes, and hashes of sources of the user's laws and robots
    hashed: Mapping[str, str] = {}  # the subset in the key
    note: str = ""  # changes that do not outdate the result, in words
    unkeyed: bool = False  # whether the law is of a notebook or a script, whose source is in no module


def _require_followers(config: Config, names: Iterable[str]) -> None:
    """Refuse laws that cannot follow a goal which moves, by the names of their runs."""
    for law in (law_and_mode(name)[0] for name in names if config.followed):
        if law not in BODY_LAWS:
            raise InputError(
                f"control.laws: {law} cannot follow objects.{config.followed[0]}, as it measures without the "
                f"body: name some of {', '.join(BODY_LAWS)}, as --law exact, or leave follow out"
            )


def _sources(names: Sequence[str], config: Config, run: Run) -> dict[str, _Read]:
    """Return the files of each run of a law, by its name: sources of plug-in law and robot.

    If the source of a law is gone since, the stored hash holds. Another source of a robot outdates
    nothing: its motion cannot be repeated.
    """
    plant = config.plant.target
    robot = f"source of {plant}"
    found: dict[str, _Read] = {}
    for law in names:
        name = law_and_mode(law)[0]
        part = next((f"{part}/" for part, step in config.steps.items() if step.moves), "")
        stored = run.results.get(f"{SERVO}{part}{law}")
        before = {} if stored is None else stored.inputs
        own, note = source_hash(name) if ":" in name else "", ""
        hashed = {f"source of {name}": own} if own else {}
        if ":" in name and not own and stored is not None:
            hashed = {key: value for key, value in before.items() if key != robot}
            note = "the source of its law is gone"
        inputs = dict(hashed)
        if plant and (now := source_hash(plant)):
            inputs[robot] = now
        if robot in before and before[robot] != inputs.get(robot):
            note = f"the source of {plant} {'changed' if robot in inputs else 'is gone'}"
            inputs[robot] = before[robot]
        found[law] = _Read(inputs, hashed, note, name.startswith("__main__:"))
    return found


class _Inputs(NamedTuple):
    """Inputs of stages."""

    records: Mapping[str, Any] = {}  # by stage and step of a sequence; none if keys are missing
    files: Mapping[str, str] = {}  # hashes of the input files, by name


def _inputs(config: Config, run: Run, stages: Sequence[str]) -> _Inputs:
    """Return the inputs of each stage that the configuration determines; making others reports missing keys.

    An InputError if a file cannot be read. If a file is gone since, its stored hash holds.
    """
    stored = run.results["calibrate"].inputs if "calibrate" in run.results else {}
    gone = {
        stored[name]: digest for key, digest in stored.items() if (name := key.removesuffix(_HASH)) != key
    }
    files: dict[str, str] = {}
    read = files_of(config, gone)
    for name, file in read.items():
        files |= {name: file.path, name + _HASH: file.sha256}
    records: dict[str, Any] = {}
    for stage in stages:
        for part, step in _parts_of(stage, config.steps).items():
            with suppress(InputError):
                moves = step is None or step.moves
                records[f"{stage}/{part}"] = _INPUTS[stage](config.at_step(part), read) if moves else step
    return _Inputs(records, files)


def _parts_of(stage: str, steps: Mapping[str, TaskStep]) -> dict[str, TaskStep | None]:
    """Return the steps of a sequence that a stage makes results of; of no name if it makes one alone."""
    if not steps or stage not in ("plan", "servo"):
        return {"": None}
    return {name: step for name, step in steps.items() if step.moves or stage == "servo"}


def inputs_of(stage: str, config: Config) -> Any:
    """The record that a stage is given; an InputError if a part of the configuration is missing."""
    return _INPUTS[stage](config, None)


def key_of_calibration(record: Any) -> str:
    """Key of the calibration of some inputs."""
    return _key(key_of(record), (), "", {})


def _key(own: str, before: Sequence[str], law: str, source: Mapping[str, str]) -> str:
    """Key of a result, by the keys of its inputs and of the results before, and the hashes of its law."""
    return own and key_of(own, before=list(before), law=law, source=dict(source))


def _needed(
    inputs: _Inputs, laws: Mapping[str, _Read], stages: Sequence[str], steps: Mapping[str, TaskStep]
) -> Iterator[Step]:
    """Every result of the stages with its key, each made from those before, in a sequence of a stage."""
    before: list[str] = []
    for stage in stages:
        keys: list[str] = []
        of_files = {"": _Read(inputs.files if stage == "calibrate" else {})}
        for part, asked in _parts_of(stage, steps).items():
            record = inputs.records.get(f"{stage}/{part}")
            own = "" if record is None else key_of(record)
            moves = asked is None or asked.moves
            for law, read in (laws if stage == "servo" and moves else of_files).items():
                keys.append(_key(own, before + (keys if part else []), law, read.hashed))
                made = Step(stage, law, keys[-1], read.inputs, note=read.note, unkeyed=read.unkeyed)
                yield replace(made, record=record, part=part)
        before = keys


def _reason(step: Step, run: Run, forced: bool, remade: bool) -> str:
    stored = run.results.get(step.name)
    if stored is None:
        return "none yet"
    if stored.key != step.key:
        law = f"source of {law_and_mode(step.law)[0]}"
        other = step.law and stored.inputs.get(law) != step.inputs.get(law)
        return "the source of its law changed" if other else "outdated"
    if step.law and meaning(stored.records[""].verdict).retried:
        return "failed before"
    if remade:
        return "its inputs are made again"
    if step.unkeyed:
        return "its law has no source to compare"
    if step.stage == "report" and _missing(run):
        return "a file of it is missing"
    return "asked for by --force" if forced else ""


def _missing(run: Run) -> bool:
    """Whether a file that the stored report wrote is not there any more."""
    figures = run.results["report"].records[""].figures
    return not all((run.path.parent / name).is_file() for name in (*figures, CLAIMS_FILE, PAGE_FILE))


def result_of(step: Step, config: Config, *made: Any) -> Result:
    """The result from the records of its stage."""
    labels = ("observation", "calibration", "cross_validation") if step.stage == "calibrate" else ("",)
    labels = ("action",) if step.part and step.stage == "servo" and not step.law else labels
    records = {label: record for label, record in zip(labels, made, strict=True) if record is not None}
    return Result(step.key, stored_yaml(config), provenance.collect(seed=config.seed), step.inputs, records)
