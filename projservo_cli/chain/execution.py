"""A chain of stages: their order and permission, results made and saved, and findings of a call."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import KW_ONLY, InitVar, dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from projservo_cli import plugins
from projservo_cli.chain.outdated import STAGES, Step, inputs_of, key_of_calibration, result_of, steps_for
from projservo_cli.chain.progress import Listener
from projservo_cli.chain.recordings import recording_made
from projservo_cli.chain.task_steps import Steps
from projservo_cli.config import Config, load_config, stored_yaml
from projservo_cli.config.inputs import about_of, scenery_of, suggestion_inputs
from projservo_cli.findings import Finding
from projservo_cli.laws import CODES, codes_of, fault_fails, law_and_mode, must_converge, run_name
from projservo_cli.loop.jit_notice import compilation
from projservo_cli.messages import failed, sentence_and_remedy
from projservo_cli.messages.verdict_causes import arrived, meaning
from projservo_cli.observations import Observations
from projservo_cli.records import InputError, Plan, Trace, WorkFailed
from projservo_cli.result_hashes import digest
from projservo_cli.stages.stage_inputs import PlanInputs, Table
from projservo_cli.store.run_file import SERVO, Run, save

FIGURES = "figures"  # folder of a run in which a killed report may have left something


class Failure(NamedTuple):
    """The step that failed, and why."""

    step: str = ""  # its name; empty for none
    reason: str = ""
    evidence: tuple[Finding, ...] = ()  # the reason as data


class _Shortfall(NamedTuple):
    """A failure in words, and whether a call fails by it."""

    text: str
    fatal: bool


@dataclass
class Chain:
    """Stages that were asked for, the steps that they take, and their outcome."""

    listener: Listener
    names: Sequence[str]  # names of the stages
    config: Config
    run: Run  # the stored run, with results made since
    wanted: InitVar[Sequence[str]] = ()  # laws instead of ``control.laws``
    _: KW_ONLY
    force: InitVar[bool] = False  # whether to make the stages even if they are up to date
    recording: Any = None  # the recording before the calibration, if any
    confirm: bool = False  # whether to ask before the first motion
    in_memory: bool = False  # whether results stay in memory
    blind: bool = False  # whether a robot may move although cameras show nothing
    steps: list[Step] = field(init=False)
    laws: tuple[str, ...] = field(init=False)  # names of the runs of laws that the steps make or need
    failure: Failure = field(default_factory=Failure)
    laws_done: tuple[str, ...] = ()
    robot: Steps = field(init=False)  # on which steps of the task are made
    table: Observations | None = None  # of the calibration to be made, once it is read

    def __post_init__(self, wanted: Sequence[str], force: bool) -> None:
        stages = [name for name in self.names if name != "record"]
        why = "" if self.recording is None else self.recording.why
        given, self.config = self.config, _with_refits(self.config, self.run)
        self.robot = Steps(self.config)
        self.steps = steps_for(self.config, self.run, stages, laws=wanted, force=force, recording=why)
        if self.config is not given:
            note = "the configuration names no calibration.refits, and the refits of the run stay"
            self.steps = [replace(one, note=note) if one.stage == STAGES[0] else one for one in self.steps]
        if self.recording is not None:
            self.steps.insert(0, Step("record", "", "", {}, why))
        self.laws = tuple(step.name.removeprefix(SERVO) for step in self.steps if step.law)

    @property
    def pending(self) -> bool:
        """Whether a result is to be made, or the configuration to be stored."""
        return self.run.configuration != stored_yaml(self.config) or bool(self._outdated)

    @property
    def _outdated(self) -> list[Step]:
        """The steps whose results are to be made."""
        return [step for step in self.steps if step.why]

    def lacks(self, stage: str) -> bool:
        """Whether a stage was not completed."""
        order = [step.stage for step in self.steps]
        return bool(self.failure.step) and order.index(stage) >= order.index(self.failure.step.split("/")[0])

    def require_permitted(self, named: Collection[str]) -> None:
        """Refuse to move a robot that no stage asks for, or to start code that only a stored run names.

        A run file may come from anybody: its contents are shown and compared, never imported. Classes that
        are named are imported, so that a missing class is known before any work.

        named : kinds of code, ``law`` and ``plant``, that the caller names.
        Raises InputError.
        """
        moving = None
        if not self.config.plant.simulated and "servo" not in self.names:
            moving = next((step for step in self._outdated if step.stage == "servo"), None)
        if moving is not None:
            raise InputError(
                f"{self.names[-1]} needs a run of {moving.law or moving.part} ({moving.why}), which moves "
                f"{self.config.plant.use}: run projservo servo first, or name the stage servo as well"
            )
        code = self.code()
        for kind, target in code:
            if kind not in named:
                flag = {"law": f"--law {target}", "plant": f"--set plant={target}"}[kind]
                raise InputError(
                    f"{kind} {target} is named by the stored run alone, which starts no code: give the "
                    f"configuration again (-c), or {flag}; in Python, make an Experiment of it"
                )
        for kind, target in code:
            plugins.find(kind, target)

    def replayed(self) -> list[dict[str, Any]]:
        """Runs of a user's robot that are shown as they were stored: law, plant, and date."""
        if self.config.plant.simulated or "servo" in self.names:
            return []
        stored = [
            (step.name.removeprefix(SERVO), self.run.results[step.name])
            for step in self.steps
            if step.law and not step.why
        ]
        plant = plugins.short_name(self.config.plant.target)
        return [{"law": law, "plant": plant, "date": one.provenance.get("date")} for law, one in stored]

    def code(self) -> list[tuple[str, str]]:
        """Kind and ``module:Class`` of the imports of the steps, of laws and of a robot."""
        servo = [law_and_mode(step.law)[0] for step in self._outdated if step.law]
        found = dict.fromkeys(("law", law) for law in servo if law not in CODES)
        here = self.config.task is not None and self.config.task.start_joints is None
        reads = [one for one in self.steps if one.stage in ("record", "plan") and one.why]
        observes = any(_drives(step) or here for step in reads)
        if (servo or observes) and (target := self.config.plant.target):
            found["plant", target] = None
        return list(found)

    def read(self) -> None:
        """Read the table of a calibration that is to be made: what is wrong with it comes before all work."""
        for step in self._outdated:
            if step.stage == "calibrate" and self.config.recorded:
                from projservo_cli.stages.calibrate import known_cameras, recorded

                inputs = step.record or inputs_of("calibrate", self.config)
                if isinstance(source := getattr(inputs, "source", None), Table):
                    with suppress(WorkFailed):  # which making it reports
                        self.table = recorded(source)
                        known_cameras(self.table, inputs.estimation)

    def make(self) -> None:
        """Make the outdated results, stop at the first failure, keep finished results."""
        if self.failure.step:
            return
        for one in self.replayed():
            self.listener.say("{law}: the stored run of {plant}, recorded {date}".format_map(one))
        if self._outdated and (notice := compilation(step.law for step in self._outdated)):
            self.listener.say(notice)  # the first run on a machine is slower by that
        steps = [step for step in self.steps if step.stage != "record"]
        try:
            with self._compiling(), self.robot.connection():
                self._make_steps(steps)
        except WorkFailed as error:  # the robot may not be at rest
            self._fail(steps[-1], error)
        if self.failure.step:
            return
        text = stored_yaml(self.config)
        if self.run.configuration != text:  # overrides are stored also if nothing had to be made
            self._keep(replace(self.run, configuration=text))

    def _make_steps(self, steps: Sequence[Step]) -> None:
        """Make the outdated results of steps, until one fails."""
        motion = next((step for step in steps if step.stage == "servo" and step.why), None)
        for done, step in enumerate(steps):
            self.listener.progress("results", done, len(steps))
            if step is motion and not self._may_move(step, steps):
                return
            if step is motion and step.part and not self.config.plant.simulated:
                self.robot.opened(self.run.calibration)
            try:
                if step.why:
                    self._make_result(step)
            except (KeyboardInterrupt, InputError) as error:
                if step.part and step.stage == "servo":
                    what = "refused" if isinstance(error, InputError) else "interrupted"
                    self.listener.say(f"{step.name}: {what}{self.robot.left_behind(step.part)}")
                raise
            if step.law and not self.failure.step:
                name = step.name.removeprefix(SERVO)
                self.laws_done += (name,)
                trace = self.run.traces[name]
                if _ends_all(trace) and not step.part:  # nor is it driven by the next law
                    self._fail(step, trace.reason)
                elif not arrived(trace.verdict) and step.part:  # nor are the next steps made
                    self._fail(step, f"ended in {trace.verdict}: {trace.reason}")
                elif self.robot.session is not None and (lost := self.robot.session.lost):
                    self._fail(step, failed([lost]))
            if self.failure.step:
                return

    def _may_move(self, motion: Step, steps: Sequence[Step]) -> bool:
        """Tell where objects of carried goals are, and whether a robot may go there, perhaps after asking.

        Simulated or not: if one has moved too far and the user is not asked, the robot does not move.
        """
        for step in steps:
            for far in self._far(step) if step.stage == "plan" else ():
                if not self.confirm:
                    self._fail(motion, failed([far]))
                    return False
                self.listener.say(sentence_and_remedy(far))
        if self.confirm:
            if self.config.steps:
                self.listener.say(f"servo: one after the other: {', '.join(self.config.steps)}")
            self.listener.confirm("servo", self.config.plant)
        return True

    def _far(self, step: Step) -> Iterator[Finding]:
        """Tell where the objects of a plan are, and yield those that have moved too far."""
        from projservo_cli.stages.carried_goals import too_far

        inputs = step.record or inputs_of("plan", self.config.at_step(step.part))
        for carried, carrier in zip(
            self.run.results[step.name].records[""].carried, inputs.carriers, strict=True
        ):
            self.listener.say(carried.object_words)
            if carried.object_shift_mm is None:
                self.listener.say(
                    "objects.max_displacement_m is not compared, since no length on the tool is known: set "
                    "markers.positions_m, markers.tag_size_m or markers.board.size_m"
                )
            if (far := too_far(carried, carrier)) is not None:
                yield far

    def _fail(self, step: Step, why: str | WorkFailed) -> None:
        """Note the failure of a step, of a sequence with the states that stay as sent."""
        after = self.robot.left_behind(step.part) if step.part and step.stage == "servo" else ""
        evidence = why.findings if isinstance(why, WorkFailed) else ()
        self.failure = Failure(step.name, " ".join(str(why).split()) + after, evidence)

    def reported(self, run: Run | None = None) -> Run:
        """Return the results that a report of the named runs of laws needs.

        run : one that is not stored yet.
        """
        run = run or self.run
        made = [step.name for step in self.steps if self.laws and step.stage in ("plan", "servo")]
        return replace(run, results={name: run.results[name] for name in ["calibrate", *made]})

    def record(self) -> bool:
        """Record the pending poses first; return whether they are all there."""
        if self.recording.why:
            self.listener.say(f"record: making ({self.recording.why})")
        if why := recording_made(self.listener, self.config, self.recording, confirm=self.confirm):
            self.failure = Failure("record", str(why), why.findings)
            return False
        if self.run.refuted:  # by the recording that the new one has replaced
            save(replace(self.run, refuted=""))
        return True

    def suggestions(self, count: int) -> dict[str, Any]:
        """Further poses for the calibration, as JSON values; their list is written next to the run."""
        from projservo_cli.stages.calibrate import suggest_motions

        calibration, inputs = self.run.calibration, suggestion_inputs(self.config)
        path = self.run.path.parent / "suggestions.csv"
        try:
            found = suggest_motions(inputs, self.run.observation, calibration, count, path)
        except WorkFailed as error:
            return {"suggestions": [], "suggestions_reason": str(error)}
        keys = ("q", "from_pose", "delta", "variance_before", "variance_after")
        limits = inputs.joints.joints(calibration.joint_types).limits
        return {
            "suggestions": [{key: getattr(one, key) for key in keys} for one in found],
            "suggestions_file": path.resolve(),
            "suggestions_unit": inputs.unit,
            "suggestions_limited": bool(np.isfinite(limits.lower).any()),
        }

    def optional_files(self, wanted: Sequence[str]) -> dict[str, Path]:
        """Write the ``view`` or ``animation``, and the page with links to them; return the paths by name."""
        from projservo_cli.report.page import write_page
        from projservo_cli.stages import report

        explained, config, made = self.reported(), self.config, {}
        for name in wanted:
            self.listener.detail(f"report: making the {name}")
            if name == "view":
                path = report.view(scenery_of(config), explained, self.listener.progress)
            else:
                path = report.animation(config.image_size_px, explained, self.listener.progress)
            made[name] = path.resolve()
        explained = replace(explained, results={**explained.results, "report": self.run.results["report"]})
        write_page(explained, about_of(config))
        return made

    def findings(self, of_calibration: Mapping[str, Any]) -> Iterator[_Shortfall]:
        """Yield the failures of the chain, and whether they end the call with exit code 1.

        of_calibration : whether joint types were assumed, and the results of suggestions.
        """
        if self.failure.step:
            yield from self._of_runs()
            yield _Shortfall(f"{self.failure.step}: {self.failure.reason}", fatal=True)
            return
        results = self.run.results
        if "calibrate" in results and not self.run.calibration.usable:
            reason = " ".join(self.run.calibration.reason.split())
            text = f"calibrate: the calibration is not usable: {reason}"
            yield _Shortfall(text, fatal="calibrate" in self.names)
        if of_calibration.get("joint_types_assumed"):
            text = "calibrate: joint types are not given: all are taken as revolute (--joints)"
            yield _Shortfall(text, fatal=False)
        if of_calibration.get("suggestions") == []:
            yield _Shortfall(f"calibrate: {of_calibration['suggestions_reason']}", fatal=True)
        yield from self._of_runs()
        # Other profiles follow the paper; their margins are only measured.
        for step in self.steps:
            plan = results[step.name].records[""] if step.stage == "plan" else None
            if plan is not None and plan.profile in ("constrained", "joint_space") and not plan.feasible:
                yield _Shortfall(f"{step.name}: {plan.reason}", fatal="plan" in self.names)

    def _of_runs(self) -> Iterator[_Shortfall]:
        """A line on each run that did not converge or missed periods, and whether the call fails by it."""
        required = self.config.control.must_converge
        failed = self.failure.step.removeprefix(SERVO)  # is printed last
        for trace in (self.run.traces[law] for law in self.laws_done if law != failed):
            must, converged = must_converge(trace.law, required), arrived(trace.verdict)
            if _ends_all(trace) or (converged and not trace.overruns):
                continue
            but = " must converge, but" if must and not converged else ""
            reason = " ".join(trace.reason.split())
            ended = "converged" if converged else f"{but} ended in {trace.verdict}".lstrip()
            text = f"{run_name(trace.law, trace.mode)} {ended}{reason and f': {reason}'}"
            if trace.overruns:
                text += (
                    f"; {trace.overruns} of {trace.steps} periods took longer than {trace.period:g} s: where "
                    "many do, raise control.period_s, or find fewer markers"
                )
            disturbed = meaning(trace.verdict).refutes and fault_fails(trace.law)
            yield _Shortfall(text, fatal=not converged and (must or disturbed))

    def _keep(self, run: Run) -> None:
        self.run = run if self.in_memory else save(run)

    def _make_result(self, step: Step) -> None:
        """Make one result from those before it, and drop those that it made outdated; or note its failure."""
        self.listener.detail(f"{step.name}: making it")
        run = replace(self.run, configuration=stored_yaml(self.config))
        try:
            result = result_of(step, self.config, *self._made(step, run))
        except WorkFailed as error:
            self._fail(step, error)
            if error.refutes:
                self._keep(replace(self.run, refuted=self.failure.reason))
            return
        place, run = STAGES.index(step.stage), replace(self.run, configuration=run.configuration)
        after = [name for name in run.results if STAGES.index(name.split("/")[0]) > place]
        after += self._of_other_tasks(step, run)
        if why := self._would_lose(step, result, after):
            self._fail(step, why)
            return
        results = {name: stored for name, stored in run.results.items() if name not in after}
        refuted = run.refuted
        if step.stage == "calibrate":
            refuted = ""
        elif step.law and not self.config.plant.simulated:
            trace = result.records[""]
            refuted = trace.reason if meaning(trace.verdict).refutes else ""
        self._keep(replace(run, results={**results, step.name: result}, refuted=refuted))
        if after:
            self.listener.say(f"{', '.join(after)}: dropped, their inputs were replaced")
        if step.law and result.records[""].verdict == "interrupted":
            raise KeyboardInterrupt

    def _would_lose(self, step: Step, result: Any, after: Sequence[str]) -> str:
        """Say which runs of the user's robot a plan that cannot be followed would drop."""
        driven = [name for name in after if name.startswith(SERVO)]
        if step.stage != "plan" or "servo" in self.names or self.config.plant.simulated or not driven:
            return ""
        plan = result.records[""]
        if plan.feasible or plan.profile not in ("constrained", "joint_space"):
            return ""
        return (
            f"{plan.reason}; not stored, since a robot was driven for {', '.join(driven)}, which would be "
            "dropped: give another -o to keep both"
        )

    def _of_other_tasks(self, step: Step, run: Run) -> list[str]:
        """Names of plans that are not of this task, and of results of steps that are to come."""
        names = [one.name for one in self.steps]
        if step.stage == "plan":
            plans = [name for name in run.results if name.split("/")[0] == "plan"]
            return [name for name in plans if name not in names or names.index(name) > names.index(step.name)]
        if not step.part or step.stage != "servo":
            return []
        done = names[: names.index(step.name) + 1]
        return [name for name in run.results if name.startswith(SERVO) and name not in done]

    def _made(self, step: Step, run: Run) -> tuple[Any, ...]:
        """Return the result of a stage from its inputs; import its module on demand."""
        if step.part and step.stage == "servo" and not step.law:
            return (self.robot.acted(self.config.steps[step.part], self.run.calibration),)
        config, progress = self.config.at_step(step.part), self.listener.progress
        inputs = step.record or inputs_of(step.stage, config)
        if step.stage == "calibrate":
            from projservo_cli.stages import calibrate

            require_simulated(self.config)
            stored, known = run.results.get("calibrate"), getattr(inputs, "before", None)
            before = None
            if stored is not None and known is not None and stored.key == key_of_calibration(known):
                before = run.observation, run.calibration, run.cross_validation
            return calibrate.run(inputs, before, self.table, progress=progress)
        if step.stage == "plan":
            from projservo_cli.stages import plan

            bounded = replace(_bounded(inputs, run), q_current=self.robot.expected(step.part, run))
            return (plan.run(bounded, run.calibration, session=self.robot.session),)
        if step.stage == "servo":
            from projservo_cli.stages import servo

            followed = (run.at_step(step.part) if step.part else run).plan
            given = replace(inputs, plan=_bounded(inputs.plan, run))
            if step.part and config.task is not None and config.task.start_joints is None:
                given, followed = self.robot.from_here(step, run, given, followed)
                self._follow(f"plan/{step.part}", followed)
            brought = {"blind": self.blind, "session": self.robot.session}
            return (servo.run(given, run.calibration, followed, step.law, **brought),)
        from projservo_cli.stages import report

        return (report.run(inputs, self.reported(run), run.path.parent, progress=progress),)

    def _follow(self, name: str, plan: Plan) -> None:
        """Replace the plan of a name by a plan from the present joints, unless it is the same."""
        stored = self.run.results[name]
        if plan is not stored.records[""]:
            taken = replace(stored, records={"": plan})
            self.run = replace(self.run, results={**self.run.results, name: taken})

    def _compiling(self) -> AbstractContextManager[None]:
        """Return the background compilation for runs that follow a calibration."""
        if not {"calibrate", "servo"} <= {step.stage for step in self._outdated}:
            return nullcontext()
        from projservo_cli.loop.jit_warmup import compiling_in_background

        return compiling_in_background(codes_of(step.law for step in self._outdated))


def _with_refits(config: Config, run: Run) -> Config:
    """The configuration with the refits of a run, which belong to its table, if it names none itself."""
    stored = run.results.get("calibrate")
    if stored is None or config.calibration.refits or run.calibration.refits is None:
        return config
    before = load_config(run.path, text=stored.configuration)
    table = None if config.data is None else Path(config.data.table)
    known = stored.inputs.get("table_sha256")
    if table is not None and table.is_file() and digest(table.read_bytes()) != known:
        return config
    values = before.model_dump(mode="json", include={"calibration": {"refits"}, "data": True})
    return config.replace(values if config.data is None else {"calibration": values["calibration"]})


def _drives(step: Step) -> bool:
    """Whether a step reads a robot: a recording, and a plan to a goal on an object that lies anywhere."""
    return step.stage == "record" or bool(step.record is not None and step.record.carriers)


def require_simulated(config: Config) -> None:
    """Refuse to simulate the trials of a robot that is not a simulated one, with an InputError."""
    if not config.recorded and not config.plant.simulated:
        raise InputError(
            f"plant {config.plant.use} is calibrated from a table: record it, projservo record calibrate, or "
            "name one: data.table, --data"
        )


def _bounded(inputs: PlanInputs, run: Run) -> PlanInputs:
    """Return the inputs of a plan with the border of images of an unknown size, as the recording shows."""
    if inputs.image_size is not None:
        return inputs
    seen = np.ceil(np.nanmax(run.observation.images, axis=(0, 2)) + 0.5).astype(int).tolist()
    return replace(inputs, seen_px=tuple((width, height) for width, height in seen))


def _ends_all(trace: Trace) -> bool:
    """Whether no other law is driven after a run; a part that is followed may be pushed in any of them."""
    pushed = trace.of_goal is not None and trace.verdict == "object moved"
    return meaning(trace.verdict).ends and not pushed
