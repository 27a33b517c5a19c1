"""Dependencies of stages: which results are up to date, and which must be made first.

Every result carries a key: a hash of the configuration its stage depends on and of the key of the
stage before it. Keys follow from the configuration alone, so what is to be done is known before
anything is done.
"""

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from projservo_cli import provenance
from projservo_cli.config import Config, digest, to_yaml
from projservo_cli.config.models import FAULTS
from projservo_cli.laws import law_and_mode, names_of
from projservo_cli.records import InputError
from projservo_cli.report.report_data import CLAIMS_FILE, PAGE_FILE
from projservo_cli.robots.source import source_hash
from projservo_cli.store import SERVO, Result, Run

STAGES = ("calibrate", "plan", "servo", "report")
# What of the configuration each stage depends on, beside the stage before it.
_WORLD = ("robot", "rig", "markers")
_TASK = ("seed", *_WORLD, "noise.servo_px", "noise.shown_frames", "task")
_PACE = (
    "control.joint_speed_limit_deg_s",
    "control.prismatic_speed_limit_m_s",
    "control.joint_acceleration_limit_deg_s2",
    "control.prismatic_acceleration_limit_m_s2",
)
# Of trial motions that a simulated robot with faults, or before rendered cameras, is driven through.
_DRIVEN = (
    "control.period_s",
    "control.joint_speed_limit_deg_s",
    "control.prismatic_speed_limit_m_s",
    *(
        "plant.frames",
        "plant.settle_s",
        "plant.lag_s",
        "plant.sag_deg",
        "plant.lead_deg",
        "plant.joint_limits",
    ),
)
_DEPENDS_ON: dict[str, tuple[str, ...]] = {
    "calibrate": (
        *("seed", *_WORLD, "noise.calibration_px", "calibration", "data", "task.start"),
        *(f"disturbance.{name}" for name in FAULTS),
    ),
    "plan": (*_TASK, "trajectory", "control.observation", "plant.use", *_PACE),
    "servo": (*_TASK, "trajectory.delta", "control", "plant", "disturbance", "stop"),
    "report": ("report", "control.must_converge"),
}
# Where a file lies does not matter, only what it says. Which laws are run, in which modes, and which of
# them must converge, changes the run of none of them.
_NOT_HASHED: dict[str, tuple[str, ...]] = {
    "calibrate": ("data.table", "calibration.init", "robot.mjcf"),
    "plan": ("data.table", "robot.mjcf"),
    "servo": ("data.table", "robot.mjcf", "control.laws", "control.mode", "control.must_converge"),
    "report": ("data.table",),
}
# What files that are read hold.
_EXPECTED = {
    "table": "a table",
    "init": "JSON with screws, cameras and markers",
    "mjcf": "a model of MuJoCo",
}


@dataclass(frozen=True)
class Step:
    """One result that is needed."""

    stage: str  # name of the stage
    law: str  # name of the run of a law for ``servo``, such as ``exact`` or ``exact_track``, else empty
    key: str  # what the key of the result will be
    inputs: Mapping[str, str]  # files read and their hashes, and the hash of the source of a law of one's own
    why: str = ""  # why it has to be made; empty where the stored one is up to date
    note: str = ""  # what changed that does not outdate it, in words
    unkeyed: bool = False  # whether nothing tells what its law is, so that it is never up to date

    @property
    def name(self) -> str:
        """Name of the result in the run file."""
        return f"{SERVO}{self.law}" if self.law else self.stage

    @property
    def standing(self) -> str:
        """How a result stands that need not be made."""
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

    run : what is stored so far; possibly nothing.
    laws : instead of ``control.laws``.
    force : make the named stages even where they are up to date, and replace a recorded calibration.
    recording : why the table has to be recorded first; keys of what rests on it are not known until then.
    """
    stages = STAGES[: max(map(STAGES.index, named)) + 1]
    inputs = {} if recording else _file_hashes(config, run)

    def planned(stages: Sequence[str], laws: Sequence[str]) -> list[Step]:
        steps: list[Step] = []
        sources = _sources(laws, config, run) if "servo" in stages else {}
        for step in _needed(config, inputs, sources, stages):
            remade = bool(recording) or any(before.why for before in steps if before.stage != step.stage)
            steps.append(replace(step, why=_reason(step, run, force and step.stage in named, remade)))
        return steps

    steps = planned(stages, laws or config.control.laws)
    if not config.has_task and set(named) <= {"calibrate", "report"}:
        # Of a robot without a model a report tells the runs that are up to date, and asks for no others.
        lacking = {law_and_mode(step.law)[0] for step in steps if step.law and step.why}
        made = {law_and_mode(step.law)[0]: None for step in steps if step.law}.keys() - lacking
        kept = [law for law in laws or config.control.laws if law in made]
        steps = planned(stages if kept else [s for s in stages if s in ("calibrate", "report")], kept)
    stored = run.calibration.source if "calibrate" in run.results else ""
    if steps[0].why and not force and stored == "recorded" and not config.recorded:
        raise InputError(
            f"{run.path}: its calibration comes from recorded data and would be replaced by a simulated one; "
            "choose another folder with -o, give the table with --data, or use --force"
        )
    return steps


def key_of(config: Config, stage: str, **before: Any) -> str:
    """Hash of what a stage depends on: of the configuration, and of JSON values on what it is made from."""
    if config.plant.rendered is not None and stage in ("calibrate", "plan"):
        before["options"] = config.plant.rendered.model_dump()  # by which images look
    driven = stage == "calibrate" and not config.recorded and config.plant.simulated and not config.is_ideal
    parts = (*_DEPENDS_ON[stage], *(_DRIVEN if driven else ()))
    return digest(config, parts, without=_NOT_HASHED[stage], extra=before)


def affects(key: str, stage: str) -> bool:
    """Whether a stage depends on a key of the configuration."""
    parts = [f"{part}." for part in _DEPENDS_ON[stage]]
    return any(part.startswith(f"{key}.") or f"{key}.".startswith(part) for part in parts)


class _Read(NamedTuple):
    """What is read for a result beside the configuration and what it is made from."""

    inputs: Mapping[str, str]  # files and their hashes, and hashes of sources of laws and robots of one's own
    hashed: Mapping[str, str] = {}  # those of them that the key is of
    note: str = ""  # what of it changed that does not outdate the result, in words
    unkeyed: bool = False  # whether the law is of a notebook or a script, whose source is in no module


def _sources(laws: Sequence[str], config: Config, run: Run) -> dict[str, _Read]:
    """What is read for the run of each law, by its name: sources of the law and the robot that are one's own.

    Where the source of a law is gone since, the stored hash stands. Another source of a robot outdates
    nothing: what it did cannot be done again.
    """
    plant = "" if config.plant.simulated else config.plant.use or ""
    robot = f"source of {plant}"
    found: dict[str, _Read] = {}
    for law in names_of(laws, config.control.mode):
        name, stored = law_and_mode(law)[0], run.results.get(f"{SERVO}{law}")
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


def _needed(
    config: Config, inputs: dict[str, str], laws: Mapping[str, _Read], stages: Sequence[str]
) -> Iterator[Step]:
    """Every result of the stages with its key, each made from those before."""
    before: list[str | None] = [inputs.get(f"{name}_sha256") for name in ("table", "init")]
    before += [inputs["mjcf_sha256"]] if "mjcf" in inputs else []
    for stage in stages:
        keys = []
        of_files = {"": _Read(inputs if stage == "calibrate" else {})}
        for law, read in (laws if stage == "servo" else of_files).items():
            own = {"source": read.hashed} if read.hashed else {}
            keys.append(key_of(config, stage, before=before, law=law, **own))
            yield Step(stage, law, keys[-1], read.inputs, note=read.note, unkeyed=read.unkeyed)
        before = [*keys]


def _file_hashes(config: Config, run: Run) -> dict[str, str]:
    """Hashes of the files that are read; the stored one where that very file is gone since."""
    files = {"table": config.data.table if config.data is not None else None, "init": config.calibration.init}
    if config.plant.rendered is not None and config.arm is not None:
        files["mjcf"] = config.arm.mjcf
    stored = run.results["calibrate"].inputs if "calibrate" in run.results else {}
    found: dict[str, str] = {}
    for name, given in files.items():
        if given is None:
            continue
        digested = f"{name}_sha256"
        if stored.get(name) == given and not Path(given).exists():
            found |= {name: given, digested: stored[digested]}
            continue
        try:
            found |= {name: given, digested: hashlib.sha256(Path(given).read_bytes()).hexdigest()}
        except OSError as error:
            what = f"cannot be read: {error.strerror or error}; expected {_EXPECTED[name]}"
            raise InputError(f"{given}: {what}") from error
    return found


def _reason(step: Step, run: Run, forced: bool, remade: bool) -> str:
    stored = run.results.get(step.name)
    if stored is None:
        return "none yet"
    if stored.key != step.key:
        law = f"source of {law_and_mode(step.law)[0]}"
        other = step.law and stored.inputs.get(law) != step.inputs.get(law)
        return "the source of its law changed" if other else "outdated"
    if step.law and stored.records[""].verdict == "failed":
        return "failed before"
    if remade:
        return "what it is made from is made anew"
    if step.unkeyed:
        return "nothing tells whether its law is the same"
    if step.stage == "report" and missing(run):
        return "a file of it is missing"
    return "asked for by --force" if forced else ""


def missing(run: Run) -> bool:
    """Whether a file that the stored report wrote is not there any more."""
    figures = run.results["report"].records[""].figures
    return not all((run.path.parent / name).is_file() for name in (*figures, CLAIMS_FILE, PAGE_FILE))


def result_of(step: Step, config: Config, *made: Any) -> Result:
    """The result that consists of what its stage made."""
    labels = ("observation", "calibration", "cross_validation") if step.stage == "calibrate" else ("",)
    records = {label: record for label, record in zip(labels, made, strict=True) if record is not None}
    return Result(step.key, to_yaml(config), provenance.collect(seed=config.seed), step.inputs, records)
