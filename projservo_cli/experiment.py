"""An experiment from configuration to report: its stages are made once, stored and resumed.

A chain stops at the first failure and keeps finished results; results that are up to date stay.
"""

import difflib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from projservo_cli import plugins
from projservo_cli.chain.execution import FIGURES, Chain
from projservo_cli.chain.outdated import STAGES
from projservo_cli.chain.progress import Listener
from projservo_cli.config import Config, load_config, overridden, shipped, to_goals
from projservo_cli.config.inputs import joints_of
from projservo_cli.image_size import image_sizes
from projservo_cli.laws import CODES, mode_in
from projservo_cli.records import Calibration, InputError, Observation, WorkFailed
from projservo_cli.results import HeldOutErrors, ImageModel, MotionPlan, PlanScene, RunTrace, WrittenReport
from projservo_cli.stages import Progress
from projservo_cli.store.display import Printed
from projservo_cli.store.files_and_locks import working_in
from projservo_cli.store.run_file import Result, Run, stored


class Experiment(Printed):
    """An experiment in a folder or in memory: its stages are made in order, each once, and resumed.

    Parameters
    ----------
    config : a ``Config``, the path of a YAML file, or the name of a shipped configuration.
    path : folder of the run; None keeps all in memory, if no report can be made.
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
        self._run = Run(Path("memory", "run.h5")) if path is None else stored(path)
        self._in_memory = path is None
        self._progress, self._may_import = progress, True

    @classmethod
    def of(cls, run: Run) -> "Experiment":
        """The experiment that a stored run is of; no code that it names is ever started by it alone."""
        made = cls.__new__(cls)
        made._config = None
        made._run, made._in_memory, made._progress, made._may_import = run, False, True, False
        return made

    def make(
        self,
        *stages: str,
        laws: Sequence[str | Callable[[Any], Any]] = (),
        force: bool = False,
        blind: bool = False,
    ) -> "Experiment":
        """Make stages, and those before them that they need; results that are up to date stay.

        A robot that is not simulated is driven again wherever ``servo`` is named.

        Parameters
        ----------
        *stages : of ``calibrate``, ``plan``, ``servo`` and ``report``, in their order.
        laws : instead of ``control.laws``: names, ``module:Class``, or values that ``servo`` takes, such as
            ``laws=["exact", MyLaw]``.
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
        with Listener(self._progress) as listener:
            if self._in_memory:
                return self._make(stages, _targets(laws), listener, force=force, blind=blind)
            with working_in(self._run.path.parent, FIGURES):
                self._run = stored(self._run.path)  # another process may have written it until now
                return self._make(stages, _targets(laws), listener, force=force, blind=blind)

    def servo(self, *goals: str, law: str = "", blind: bool = False) -> dict[str, RunTrace]:
        """Drive to goals one after the other, over one connection, instead of the steps of the task.

        Parameters
        ----------
        *goals : names of ``task.goals``, or of taught files ``NAME.yaml`` in the working folder.
        law : in whose one mode the arm is driven; by default the configured law.
        blind : as of ``make``.

        Returns
        -------
        Traces by step and law; of one goal by law.

        Raises
        ------
        InputError, WorkFailed
            As of ``make``; also if a step does not converge, at which a sequence stops.
        """
        if not goals:
            raise InputError("servo: name a goal or several, such as servo('above', 'grip')")
        changes = to_goals(f"servo: {', '.join(goals)}", goals)
        self._config = overridden(self.config, changes)
        return self.make("servo", laws=(law,) if law else (), blind=blind).traces

    def _make(
        self, stages: Sequence[str], laws: Sequence[str], listener: Listener, *, force: bool, blind: bool
    ) -> "Experiment":
        run, stays = self._run, self._in_memory
        chain = Chain(listener, stages, self.config, run, laws, force=force, in_memory=stays, blind=blind)
        chain.require_permitted(("law", "plant") if self._may_import else ())
        try:
            chain.make()
        finally:
            self._run = chain.run
        if chain.failure.step:
            raise WorkFailed(f"{chain.failure.step}: {chain.failure.reason}")
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
    def cross_validation(self) -> HeldOutErrors | None:
        """Held-out errors of the calibration; None if they were not asked for."""
        return self.calibration.cross_validation

    def at_step(self, name: str) -> "Experiment":
        """Return one step of a sequence as a separate experiment, with its ``plan`` and its ``traces``.

        Parameters
        ----------
        name : of the motion, as in ``traces``.

        Raises
        ------
        InputError
            If no motion of such a name was made.
        """
        names = [one.removeprefix("plan/") for one in self.results if one.startswith("plan/")]
        if name not in names:
            raise InputError(f"at_step: there is no motion {name}; motions: {', '.join(names) or 'none'}")
        found = Experiment.of(self._run.at_step(name))
        found._config = self._readable()
        return found

    @property
    def plan(self) -> MotionPlan:
        """The plan; of a sequence see ``at_step``."""
        self._require("plan")
        plan, config = self._run.plan, self._readable()
        return MotionPlan.of(plan, None if config is None else plan_scene_of(config, self._run.calibration))

    @property
    def traces(self) -> dict[str, RunTrace]:
        """Traces of the runs of laws, by name."""
        config = self._readable()
        face = config.face_numbers if self._run.traces and config is not None else ()
        return {name: RunTrace.of(trace, face) for name, trace in self._run.traces.items()}

    @property
    def report(self) -> WrittenReport:
        """Claims and figures of the report."""
        self._require("report")
        return WrittenReport.of(self._run.results["report"].records[""])

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


def plan_scene_of(config: Config, calibration: Calibration) -> PlanScene:
    """Return the scene of plans of a configuration."""
    joints = joints_of(config).joints(calibration.joint_types, calibration)
    size = config.image_size_px
    return PlanScene(
        calibration.model(),
        joints.limits,
        None if size is None else image_sizes(size, calibration.view),
        config.trajectory,
    )


def _targets(laws: Sequence[str | Callable[[Any], Any]]) -> tuple[str, ...]:
    """Laws each once, registered names replaced by classes; an InputError if there is none."""
    given = [laws] if isinstance(laws, str) or not np.iterable(laws) else laws
    for law in given:
        if not (isinstance(law, str) or callable(law)):
            raise InputError(f"make: law {law!r:.60}: give the name of a law, module:Class, or a class")
    targets = (law_target(law) if isinstance(law, str) else plugins.bring("law", law) for law in given)
    return tuple(dict.fromkeys(targets))


def law_target(name: str) -> str:
    """The law of a name: built in, or ``module:Class``; an InputError that lists them if there is none."""
    target = name if name in CODES else plugins.target_of("law", name)
    if target is None:
        if remedy := mode_in(name):
            raise InputError(f"law {name}: {remedy}")
        valid = (*CODES, *plugins.registered_names("law"))
        close = difflib.get_close_matches(name, valid, n=1)
        hint = f"did you mean {close[0]}? " if close else ""
        raise InputError(f"law {name}: no such law; {hint}laws: {', '.join(valid)}, or module:Class")
    return target
