"""An experiment from configuration to report: order, resume, saving and results of its stages.

A chain stops at the first failure and keeps finished results; results that are up to date stay.
"""

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from projservo_cli.config import Config, load_config, shipped, stored_yaml
from projservo_cli.config.inputs import joints_of, trajectory_of
from projservo_cli.display import Printed
from projservo_cli.files import working_in
from projservo_cli.geometry.jit import CACHE_FOLDER
from projservo_cli.image_size import image_sizes
from projservo_cli.laws import CODES, law_and_mode, mode_in
from projservo_cli.progress import Bar
from projservo_cli.records import Calibration, CrossValidation, InputError, Observation, Report, WorkFailed
from projservo_cli.results import ImageModel, MotionPlan, RunTrace, Scene
from projservo_cli.robots import plugins
from projservo_cli.stages import Progress, silent
from projservo_cli.stages.given import PlanInputs
from projservo_cli.steps import STAGES, Step, given_to, result_of, steps_for
from projservo_cli.store import SERVO, Result, Run, load, run_path, save

# Options of the command line in messages, and what takes their place in Python.
_IN_PYTHON = {
    " with -o": "",
    "with --force": "with force=True",
    "use --force": "use force=True",
    "with --data": "with data.table",
    "without --lens": "without lens",
    "omit --init": "omit init",
    "check --joints": "check joint_types",
}
FIGURES = "figures"  # folder of a run in which a killed report may have left something


class Listener(Protocol):
    """Who follows a chain, and may be asked before something moves."""

    def say(self, text: str) -> None:
        """Take note of a message."""

    def detail(self, text: str) -> None:
        """Take note of a message that few want to read."""

    def progress(self, what: str, done: int, total: int) -> None:
        """Show how far the work is."""

    def confirm(self, command: str, plant: Any) -> None:
        """Ask before the first motion of a plant; raises KeyboardInterrupt where the answer is not yes."""


@dataclass(frozen=True)
class _Caller:
    """A caller in Python, who is shown progress and messages, and confirms every call."""

    progress: Progress
    bar: Bar

    def say(self, text: str) -> None:
        """Print a message on standard error."""
        self.bar.say(text)

    def detail(self, text: str) -> None:
        """Leave a message unread that few want to read."""

    def confirm(self, command: str, plant: Any) -> None:
        """Agree."""


@contextmanager
def listening(progress: Progress | bool) -> Iterator[_Caller]:
    """Who follows work that is called from Python: a function, or for True a bar in a terminal."""
    bar = Bar()
    try:
        yield _Caller(progress if callable(progress) else silent if progress is False else bar, bar)
    except (InputError, WorkFailed) as error:
        text = str(error)
        for option, argument in _IN_PYTHON.items():
            text = text.replace(option, argument)
        error.args = (text,)
        raise
    finally:
        bar.close()


@dataclass
class Chain:
    """Stages that were asked for, the steps that they take, and what became of them."""

    listener: Listener
    names: Sequence[str]  # of the stages
    config: Config
    run: Run  # the stored run, with results made since
    steps: Sequence[Step]
    recording: Any = None  # the recording before the calibration, if any
    confirm: bool = False  # whether to ask before the first motion
    in_memory: bool = False  # whether results stay in memory
    blind: bool = False  # whether a robot may move although cameras show nothing
    laws: tuple[str, ...] = field(init=False)  # names of the runs of laws that the steps make or need
    failed: str = ""  # name of the step that failed
    reason: str = ""  # why
    laws_done: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        self.laws = tuple(step.law for step in self.steps if step.law)

    @property
    def pending(self) -> bool:
        """Whether a result is to be made, or the configuration to be stored."""
        return self.run.configuration != stored_yaml(self.config) or any(step.why for step in self.steps)

    def lacks(self, stage: str) -> bool:
        """Whether a stage was not completed."""
        order = [step.stage for step in self.steps]
        return bool(self.failed) and order.index(stage) >= order.index(self.failed.split("/")[0])

    def moves_unasked(self) -> Step | None:
        """The first run that would move a robot of somebody's though the stage servo was not asked for."""
        moving = not self.config.plant.simulated and "servo" not in self.names
        return next((step for step in self.steps if step.law and step.why), None) if moving else None

    def replayed(self) -> list[dict[str, Any]]:
        """Runs of a robot of somebody's that are shown as they were stored: law, plant, and date."""
        if self.config.plant.simulated or "servo" in self.names:
            return []
        stored = [(step.law, self.run.results[step.name]) for step in self.steps if step.law and not step.why]
        plant = plugins.short_name(self.config.plant.use or "")
        return [{"law": law, "plant": plant, "date": one.provenance.get("date")} for law, one in stored]

    def code(self) -> list[tuple[str, str]]:
        """Kind and ``module:Class`` of the imports of the steps, of laws and of a robot."""
        servo = [law_and_mode(step.law)[0] for step in self.steps if step.law and step.why]
        found = dict.fromkeys(("law", law) for law in servo if law not in CODES)
        records = any(step.stage == "record" and step.why for step in self.steps)
        if (servo or records) and not self.config.plant.simulated:
            assert self.config.plant.use is not None
            found["plant", self.config.plant.use] = None
        return list(found)

    def make(self) -> None:
        """Make the outdated results, stop at the first failure, keep finished results."""
        if self.failed:
            return
        for one in self.replayed():
            self.listener.say("{law}: the stored run of {plant}, recorded {date}".format_map(one))
        self._say_compilation()
        with self._compiling():
            self._make_steps()

    def reported(self, run: Run | None = None) -> Run:
        """Return the results that a report of the named runs of laws needs.

        run : one that is not stored yet.
        """
        run = run or self.run
        made = ["plan", *(SERVO + law for law in self.laws)] if self.laws else []
        return replace(run, results={name: run.results[name] for name in ["calibrate", *made]})

    def _make_steps(self) -> None:
        motion = next((step for step in self.steps if step.law and step.why), None)
        steps = [step for step in self.steps if step.stage != "record"]
        for done, step in enumerate(steps):
            self.listener.progress("results", done, len(steps))
            if step is motion and self.confirm:
                self.listener.confirm("servo", self.config.plant)
            if step.why:
                self.listener.detail(f"{step.name}: making it")
                try:
                    dropped = self._make_result(step)
                except WorkFailed as error:
                    self.failed, self.reason = step.name, " ".join(str(error).split())
                    if error.refutes:
                        self._keep(replace(self.run, refuted=self.reason))
                    return
                if dropped:
                    self.listener.say(f"{', '.join(dropped)}: dropped, their inputs were replaced")
            if step.law:
                self.laws_done += (step.law,)
                trace = self.run.traces[step.law]
                if trace.verdict == "failed":  # nor is what failed driven by the next law
                    self.failed, self.reason = step.name, trace.reason
                    return
        text = stored_yaml(self.config)
        if self.run.configuration != text:  # overrides are stored also where nothing had to be made
            self._keep(replace(self.run, configuration=text))

    def _keep(self, run: Run) -> None:
        self.run = run if self.in_memory else save(run)

    def _make_result(self, step: Step) -> list[str]:
        """Make one result from those before it; which others that made outdated and dropped."""
        run = replace(self.run, configuration=stored_yaml(self.config))
        result = result_of(step, self.config, *self._made(step, run))
        place = STAGES.index(step.stage)
        after = [name for name in run.results if STAGES.index(name.split("/")[0]) > place]
        results = {name: stored for name, stored in run.results.items() if name not in after}
        refuted = run.refuted
        if step.stage == "calibrate":
            refuted = ""
        elif step.law and not self.config.plant.simulated:
            trace = result.records[""]
            refuted = trace.reason if trace.verdict == "fault detected" else ""
        self._keep(replace(run, results={**results, step.name: result}, refuted=refuted))
        return after

    def _made(self, step: Step, run: Run) -> tuple[Any, ...]:
        """Return the result of a stage from its inputs; import its module on demand."""
        given, progress = step.given or given_to(step.stage, self.config), self.listener.progress
        if step.stage == "calibrate":
            from projservo_cli.stages import calibrate

            require_simulated(self.config)
            return calibrate.run(given, progress=progress)
        if step.stage == "plan":
            from projservo_cli.stages import plan

            return (plan.run(_bounded(given, run), run.calibration),)
        if step.stage == "servo":
            from projservo_cli.stages import servo

            asked = [servo.Given(blind=True)] if self.blind else []
            bounded = replace(given, plan=_bounded(given.plan, run))
            return (servo.run(bounded, run.calibration, run.plan, step.law, *asked),)
        from projservo_cli.stages import report

        return (report.run(given, self.reported(run), run.path.parent, progress=progress),)

    def _compiling(self) -> AbstractContextManager[None]:
        """Return the background compilation for runs that follow a calibration."""
        made = [step.stage for step in self.steps if step.why]
        if "calibrate" not in made or "servo" not in made:
            return nullcontext()
        from projservo_cli.loop.jit_warmup import compiling_in_background

        return compiling_in_background()

    def _say_compilation(self) -> None:
        """The first run on a machine is slower by the time of compilation; say so."""
        if any(step.why for step in self.steps) and (told := compilation()):
            self.listener.say(told)


def require_simulated(config: Config) -> None:
    """Refuse to simulate the trials of a robot that is not a simulated one, with an InputError."""
    if not config.recorded and not config.plant.simulated:
        raise InputError(
            f"plant {config.plant.use} is calibrated from a table: record it, projservo record calibrate, or "
            "name one with --data"
        )


def compilation() -> str:
    """Whether kernels will have to be compiled, in words; empty where they are there or are not used."""
    if os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0"):
        return ""
    if CACHE_FOLDER is None:
        return "compiling kernels (in every run: no cache folder can be written)"
    return "" if any(CACHE_FOLDER.rglob("*.nbi")) else "compiling kernels, once"


class Experiment(Printed):
    """An experiment in a folder or in memory: its stages are made in order, each once, and resumed.

    Parameters
    ----------
    config : a ``Config``, the path of a YAML file, or the name of a shipped configuration.
    path : folder of the run; None keeps all in memory, where no report can be made.
    progress : called as ``progress(what, done, total)``; True for a bar in a terminal, False for none.

    Raises
    ------
    InputError
        When the configuration or the run in the folder cannot be read.
    """

    def __init__(
        self,
        config: "Config | str | Path",
        path: "str | Path | None" = None,
        *,
        progress: Progress | bool = True,
    ) -> None:
        self._config: Config | None = config if isinstance(config, Config) else load_config(shipped(config))
        self._run, self._in_memory = _stored(path), path is None
        self._progress, self._may_import = progress, True

    @classmethod
    def of(cls, run: Run) -> "Experiment":
        """The experiment that a stored run is of; no code that it names is ever started by it alone."""
        made = cls.__new__(cls)
        made._config = None
        made._run, made._in_memory, made._progress, made._may_import = run, False, True, False
        return made

    def make(
        self, *stages: str, laws: Sequence[str] = (), force: bool = False, blind: bool = False
    ) -> "Experiment":
        """Make stages, and those before them that they need; results that are up to date stay.

        A robot that is not simulated is driven again wherever ``servo`` is named.

        Parameters
        ----------
        *stages : of ``calibrate``, ``plan``, ``servo`` and ``report``, in their order.
        laws : instead of ``control.laws``: names or ``module:Class``.
        force : whether named stages are made even if they are up to date.
        blind : whether a robot may move although cameras show no marker of the calibration.

        Returns
        -------
        This experiment.

        Raises
        ------
        InputError
            If there is no such stage or law, or the configuration lacks a key of a stage.
        WorkFailed
            If a stage failed; finished results are kept. A verdict, or a calibration that is not usable,
            raises nothing.
        """
        if wrong := [stage for stage in stages if stage not in STAGES]:
            raise InputError(f"make: {wrong[0]!r}: no such stage; stages: {', '.join(STAGES)}")
        if not stages:
            raise InputError(f"make: name the stages to make: {', '.join(STAGES)}")
        if self._in_memory and "report" in stages:
            raise InputError("make: a report is written into a folder: give Experiment a path")
        with listening(self._progress) as listener:
            if self._in_memory:
                return self._make(stages, _targets(laws), listener, force=force, blind=blind)
            with working_in(self._run.path.parent, FIGURES):
                self._run = _stored(self._run.path)  # another process may have written it until now
                return self._make(stages, _targets(laws), listener, force=force, blind=blind)

    def _make(
        self, stages: Sequence[str], laws: Sequence[str], listener: Listener, *, force: bool, blind: bool
    ) -> "Experiment":
        steps = steps_for(self.config, self._run, stages, laws=laws, force=force)
        memory = self._in_memory
        chain = Chain(listener, stages, self.config, self._run, steps, in_memory=memory, blind=blind)
        if moving := chain.moves_unasked():
            raise InputError(
                f"make: {moving.name} moves {self.config.plant.use}: name the stage servo as well"
            )
        for kind, target in chain.code():
            if not self._may_import:
                raise InputError(
                    f"make: {kind} {target} is named by the stored run alone, which starts no code: make an "
                    "Experiment of the configuration instead"
                )
            plugins.find(kind, target)
        try:
            chain.make()
        finally:
            self._run = chain.run
        if chain.failed:
            raise WorkFailed(f"{chain.failed}: {chain.reason}")
        return self

    @property
    def config(self) -> Config:
        """The configuration; of a stored run that which it was last made with."""
        if self._config is None:
            self._config = load_config(self._run.path, text=self._run.configuration)
        return self._config

    @property
    def path(self) -> Path | None:
        """The run file; None in memory."""
        return None if self._in_memory else self._run.path

    @property
    def configuration(self) -> str:
        """The configuration of the last stored result, as YAML."""
        return self._run.configuration

    @property
    def results(self) -> Mapping[str, Result]:
        """All results with their keys and provenance, by name."""
        return self._run.results

    @property
    def observation(self) -> Observation:
        """Observations of the calibration."""
        self._require("calibrate")
        return self._run.observation

    @property
    def calibration(self) -> ImageModel:
        """The calibration, with functions that predict images."""
        self._require("calibrate")
        calibration = self._run.calibration
        return ImageModel.of(calibration, self._run.cross_validation, self._run.observation)

    @property
    def cross_validation(self) -> CrossValidation | None:
        """Held-out errors of the calibration; None where they were not asked for."""
        return self._run.cross_validation

    @property
    def plan(self) -> MotionPlan:
        """The plan."""
        self._require("plan")
        plan, config = self._run.plan, self._readable()
        return MotionPlan.of(plan, None if config is None else scene_of(config, self._run.calibration))

    @property
    def traces(self) -> dict[str, RunTrace]:
        """Traces of the runs of laws, by name."""
        config = self._readable()
        face = config.face_numbers if self._run.traces and config is not None else ()
        return {name: RunTrace.of(trace, face) for name, trace in self._run.traces.items()}

    @property
    def report(self) -> Report:
        """Claims and figures of the report."""
        self._require("report")
        found: Report = self._run.results["report"].records[""]
        return found

    def _require(self, stage: str) -> None:
        """Raise InputError for a missing result."""
        if stage not in self._run.results:
            place = "the experiment" if self._in_memory else self._run.path
            raise InputError(f"{place}: holds no result of {stage}; make it first: make({stage!r})")

    def _readable(self) -> Config | None:
        """The configuration; None for a stored one that is not read any more, whose results still are."""
        try:
            return self.config
        except InputError:
            return None

    def summary(self) -> dict[str, str]:
        """Return a summary in words, by name."""
        place = "in memory" if self._in_memory else str(self._run.path)
        return {"path": place, "results": ", ".join(self._run.results) or "nothing made yet"}


def scene_of(config: Config, calibration: Calibration) -> Scene:
    """Return the scene of plans of a configuration."""
    joints = joints_of(config).joints(calibration.joint_types, calibration)
    size = config.image_size_px
    return Scene(
        calibration.model(),
        joints.limits,
        None if size is None else image_sizes(size),
        trajectory_of(config),
    )


def _bounded(inputs: PlanInputs, run: Run) -> PlanInputs:
    """Return the inputs of a plan with the border of images of an unknown size: what the recording shows."""
    if inputs.image_size is not None:
        return inputs
    (left, right) = np.ceil(np.nanmax(run.observation.images, axis=(0, 2)) + 0.5).astype(int).tolist()
    return replace(inputs, seen_px=(tuple(left), tuple(right)))


def _stored(path: "str | Path | None") -> Run:
    """The run in a folder, empty where none is; for None one that is never saved."""
    if path is None:
        return Run(Path("memory", "run.h5"))
    file = run_path(path)
    return load(file) if file.exists() else Run(file)


def _targets(laws: Sequence[str]) -> tuple[str, ...]:
    """Laws each once, registered names as the classes they stand for; an InputError where there is none."""
    given = [laws] if isinstance(laws, str) or not np.iterable(laws) else laws
    for law in given:
        if not isinstance(law, str):
            named = f", such as {plugins.name_of(law)!r}" if callable(law) else ""
            raise InputError(f"make: law {law!r:.60}: give the name of a law, or module:Class{named}")
    return tuple(dict.fromkeys(map(law_target, given)))


def law_target(name: str) -> str:
    """The law of a name: built in, or ``module:Class``; an InputError that lists them where there is none."""
    target = name if name in CODES else plugins.target_of("law", name)
    if target is None:
        if remedy := mode_in(name):
            raise InputError(f"law {name}: {remedy}")
        valid = ", ".join((*CODES, *plugins.registered("law")))
        raise InputError(f"law {name}: no such law; laws: {valid}, or module:Class")
    return target
