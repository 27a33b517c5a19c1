"""The stages: what is to be done, doing it, and saying what came out."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import click

from projservo_cli.cli.foreign import confirm, law_names, require_asked, require_named, require_terminal
from projservo_cli.cli.output import Console, print_json
from projservo_cli.records import WorkFailed, name_of

FIGURES = "figures"  # folder of a run in which a killed report may have left something


@dataclass
class _Call:
    """One call of stages: what was asked for and what became of it."""

    names: list[str]
    laws: tuple[str, ...]
    config: Any
    run: Any
    steps: Sequence[Any]
    console: Console
    reason: str = ""
    failed: str = ""
    laws_done: tuple[str, ...] = ()
    suggested: dict[str, Any] = field(default_factory=dict)
    extras: dict[str, Any] = field(default_factory=dict)


def run(names: list[str], rest: list[str], options: dict[str, Any]) -> int:
    """Make the named stages and what they lack; the exit code."""
    del rest  # stages take no arguments
    if options["threads"] is not None:  # read by the compiler's runtime when it is first imported
        os.environ["NUMBA_NUM_THREADS"] = str(options["threads"])
    require_terminal(options)
    given = law_names(options["laws"])
    from projservo_cli.cli.extras import wanted_of
    from projservo_cli.config import to_yaml
    from projservo_cli.files import tidy, working_in

    console = Console(quiet=options["quiet"], verbose=options["verbose"])
    call = _asked(names, given, options, console)
    if options["dry_run"]:
        return _dry(call, as_json=options["json"])
    nothing = not any(step.why for step in call.steps) and call.run.configuration == to_yaml(call.config)
    if nothing and not wanted_of(options):
        tidy(call.run.path.parent, FIGURES)
        return _done(call, options)
    with working_in(call.run.path.parent, FIGURES):
        # Anew, since another process may have written the run until now.
        return _done(_asked(names, given, options, console), options)


def _done(call: _Call, options: dict[str, Any]) -> int:
    """Make what has to be made, and tell what came out; the exit code."""
    from projservo_cli.cli.extras import made_extras, wanted_of
    from projservo_cli.cli.words import suggested

    try:
        _say_compilation(call)
        _work(call, options)
        if options["suggest"] is not None and not _lacking(call, "calibrate"):
            call.suggested = suggested(call.config, call.run, options["suggest"])
        if (wanted := wanted_of(options)) and not _lacking(call, "report"):
            call.extras = made_extras(call.config, call.run, call.laws, wanted, call.console)
    finally:
        call.console.finish()
    return _tell(call, as_json=options["json"])


def _asked(names: list[str], given: Sequence[str], options: dict[str, Any], console: Console) -> _Call:
    """What is to be done, by the configuration and what the run holds; refused where it must not be."""
    from projservo_cli.cli.configuration import resolve
    from projservo_cli.cli.extras import require
    from projservo_cli.cli.words import require_covariance
    from projservo_cli.files import require_writable
    from projservo_cli.stages.chain import steps_for

    config, stored = resolve(options)
    if options["suggest"] is not None:
        require_covariance(config)
    require(config, options)
    steps = steps_for(config, stored, names, laws=given, force=options["force"])
    laws = tuple(step.law for step in steps if step.law)
    if not options["dry_run"]:
        require_named(config, steps, names)
        require_asked(options, config, steps)
        if any(step.why for step in steps):
            require_writable(stored.path)
    return _Call(names, laws, config, stored, steps, console)


def _dry(call: _Call, *, as_json: bool) -> int:
    if as_json:
        steps = [
            {"stage": step.stage, "law": step.law or None, "why": step.why or None} for step in call.steps
        ]
        print_json({"run": call.run.path.resolve(), "dry_run": True, "steps": steps})
    for step in () if as_json else call.steps:
        call.console.show(f"{step.name}: {f'would be made ({step.why})' if step.why else 'up to date'}")
    return 0


def _work(call: _Call, options: dict[str, Any]) -> None:
    """Make what has to be made, stop at the first failure, keep what was made until then."""
    from projservo_cli.stages.chain import make

    motion = next((step for step in call.steps if step.law and step.why), None)
    for done, step in enumerate(call.steps):
        call.console.progress("results", done, len(call.steps))
        if not step.why:
            tell = call.console.say if step.stage in call.names else call.console.detail
            tell(f"{step.name}: up to date")
        else:
            needed = "" if step.stage in call.names else f", needed by {call.names[-1]}"
            if step is motion:
                confirm(options, call.config, "servo", call.console)
            call.console.say(f"{step.name}: making it ({step.why}{needed})")
            try:
                call.run, dropped = make(step, call.config, call.run, call.laws, call.console.progress)
            except WorkFailed as error:
                call.failed, call.reason = step.name, " ".join(str(error).split())
                return
            if dropped:
                call.console.say(f"{', '.join(dropped)}: dropped, made from what was replaced")
        if step.law:
            call.laws_done += (step.law,)
            trace = call.run.traces[step.law]
            if trace.verdict == "failed":  # nor is what failed driven by the next law
                call.failed, call.reason = step.name, trace.reason
                return
    _keep_configuration(call)


def _keep_configuration(call: _Call) -> None:
    """Overrides are part of the stored configuration, also where nothing had to be made."""
    from projservo_cli.config import to_yaml
    from projservo_cli.store import save

    text = to_yaml(call.config)
    if call.run.configuration != text:
        call.run = replace(call.run, configuration=text)
        save(call.run)


def _say_compilation(call: _Call) -> None:
    """The first run on a machine is slower by the time of compilation; say so."""
    if not any(step.why for step in call.steps) or os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0"):
        return
    from projservo_cli.geometry.jit import CACHE_FOLDER

    if CACHE_FOLDER is None:
        call.console.say("compiling kernels (in every run: no cache folder can be written)")
    elif not any(CACHE_FOLDER.rglob("*.nbi")):
        call.console.say("compiling kernels, once")


def _tell(call: _Call, *, as_json: bool) -> int:
    from projservo_cli.cli.words import summary
    from projservo_cli.report.values import failed_object, stage_object

    values = {}
    for name in call.names:
        if _lacking(call, name):
            values[name] = failed_object(name, call.run, call.reason, call.failed, call.laws_done)
        else:
            values[name] = stage_object(name, call.run, call.config, call.laws)
            values[name] |= {"calibrate": call.suggested, "report": call.extras}.get(name, {})
    if as_json:
        print_json(values if len(call.names) > 1 else values[call.names[0]])
    else:
        for name, value in values.items():
            call.console.show(summary(name, value))
        if call.run.results:
            call.console.show(f"run: {call.run.path}")
    return _verdict(call)


def _lacking(call: _Call, name: str) -> bool:
    """Whether a stage was not completed by the call."""
    if not call.failed:
        return False
    order = [step.stage for step in call.steps]
    return order.index(name) >= order.index(call.failed.split("/")[0])


def _verdict(call: _Call) -> int:
    """Exit code 1 when a stage failed or what it made is not what was asked for.

    That is a calibration that is not usable, a plan that keeps not all its constraints, or a law that
    must converge and did not.
    """
    if call.failed:
        click.echo(f"projservo: {call.failed}: {call.reason}", err=True)
        return 1
    missed_calibration = _unusable(call)
    if call.suggested.get("suggestions") == []:
        click.echo(f"projservo: calibrate: {call.suggested['suggestions_reason']}", err=True)
        missed_calibration = True
    must = call.config.control.must_converge
    ends = [call.run.traces[law] for law in call.laws_done]
    missed = [
        trace
        for trace in ends
        if trace.verdict == "disturbed" or (trace.law in must and trace.verdict != "converged")
    ]
    for trace in missed:
        reason = f": {trace.reason}" if trace.reason else ""
        must_converge = " must converge, but" if trace.law in must else ""
        click.echo(
            f"projservo: {name_of(trace.law, trace.mode)}{must_converge} ended in {trace.verdict}{reason}",
            err=True,
        )
    infeasible = _infeasible(call)
    return 1 if missed or missed_calibration or infeasible else 0


def _infeasible(call: _Call) -> bool:
    """Say that no motion keeps the constraints asked for; True where the call was to plan one."""
    if "plan" not in call.run.results or call.run.plan.profile != "constrained":
        return False
    plan = call.run.plan
    if not plan.feasible:
        click.echo(f"projservo: plan: {plan.reason}", err=True)
    return not plan.feasible and "plan" in call.names


def _unusable(call: _Call) -> bool:
    """Say that a calibration cannot support control; True where the call was to make it usable."""
    if "calibrate" not in call.run.results or call.run.calibration.usable:
        return False
    reason = " ".join(call.run.calibration.reason.split())
    click.echo(f"projservo: calibrate: the calibration is not usable: {reason}", err=True)
    return "calibrate" in call.names
