"""Steps of a task on a robot: the arm's joints before each, its commands, and remaining states."""

from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from projservo_cli.chain.outdated import Step
from projservo_cli.config import Config
from projservo_cli.config.inputs import servo_inputs
from projservo_cli.messages import lines
from projservo_cli.records import Action, Calibration, FloatArray, InputError, Plan, WorkFailed
from projservo_cli.settings.task import TaskStep
from projservo_cli.stages.stage_inputs import ServoInputs
from projservo_cli.store.run_file import Run

if TYPE_CHECKING:
    from projservo_cli.robots.session import Session


@dataclass
class Steps:
    """The steps of a task, and the connection to the robot that they share."""

    config: Config
    session: "Session | None" = None  # while they are made

    def connection(self) -> AbstractContextManager[Any]:
        """Return the connection that steps share, or that reads the joints of the arm; otherwise None."""
        task = self.config.task
        if task is None or (not task.steps and task.start_joints is not None):
            return nullcontext()
        from projservo_cli.robots.session import Session

        self.session = Session()
        return self.session

    @property
    def motions(self) -> list[str]:
        """Names of the steps that move the arm."""
        return [name for name, step in self.config.steps.items() if step.moves]

    def opened(self, c: Calibration) -> FloatArray:
        """Open the user's robot, unless it is open, and return its joints (n,), rad or m."""
        from projservo_cli.stages.worlds.calibrated import observed_numbers
        from projservo_cli.stages.worlds.external_robot import opened_robot

        inputs = servo_inputs(self.config)
        assert self.session is not None
        joints = inputs.plan.joints.joints(c.joint_types, c)
        steered = opened_robot(
            self.session, inputs.required_contract.driven, joints, observed_numbers(inputs.plan, c), c.view
        )
        actions = {name for step in self.config.steps.values() for name in step.act or ()}
        self.session.require_acts(actions)  # refuses actions that the robot lacks
        return steered.robot.read().q

    def joints_before(self, c: Calibration) -> FloatArray:
        """Joints (n,) of the arm before any motion, rad or m."""
        if not self.config.plant.simulated:
            return self.opened(c)
        if self.config.calibration.reference is None:
            raise InputError(
                "task.start: current: a simulated robot starts at calibration.reference: set it, or joints"
            )
        return self.config.calibration.reference.values(self.config.joint_types or "")

    def expected(self, part: str, run: Run) -> FloatArray | None:
        """Return the joints of the arm before a step, by the plan before; None for a given start."""
        task = self.config.task
        if task is None:
            return None
        k = self.motions.index(part) if part else 0
        if k == 0:
            return None if task.start_joints is not None else self.joints_before(run.calibration)
        before = self.motions[k - 1]
        end: FloatArray = run.at_step(before).plan.q[-1]
        if not np.isfinite(end).all():
            why = f"since no joints follow the plan of {before}"
            raise WorkFailed(f"the joints of the arm then are open, {why}")
        return end

    def from_here(self, step: Step, run: Run, inputs: ServoInputs, plan: Plan) -> tuple[ServoInputs, Plan]:
        """Return the inputs of a step from the present joints, and a plan from there."""
        from projservo_cli.stages import plan as planning

        k, q = self.motions.index(step.part), plan.q_start
        if k and self.session is not None and (robot := self.session.robot) is not None:
            q = robot.read().q
        elif k:
            q = run.traces[f"{self.motions[k - 1]}/{step.law}"].q[-1]
        inputs = replace(inputs, plan=replace(inputs.plan, q_current=q))
        if (q != plan.q_start).any():
            plan = planning.run(inputs.plan, run.calibration, plan)
        return inputs, plan

    def acted(self, asked: TaskStep, c: Calibration) -> Action:
        """Have the robot act or wait."""
        assert self.session is not None
        if not self.config.plant.simulated:
            self.opened(c)
        if asked.wait_s is not None:
            self.session.hold(asked.wait_s)
            return Action("wait", f"{asked.wait_s:g} s", asked.wait_s)
        acts = asked.act or {}
        seconds = sum(self.session.act(name, value) for name, value in acts.items())
        said = ", ".join(f"{name} {value:g}" for name, value in acts.items())
        nothing = any(map(self.session.empty, acts))
        return Action("act", said + ", which holds nothing" * nothing, seconds)

    def left_behind(self, part: str) -> str:
        """Report the states that stay as sent, and which steps of the sequence were not begun."""
        names = list(self.config.steps)
        rest = names[names.index(part) + 1 :]
        kept = "" if self.session is None else ", ".join(lines(self.session.kept))
        begun = f"{', '.join(rest)} {'was' if len(rest) == 1 else 'were'} not begun" if rest else ""
        return "".join(
            f"; {text}" for text in (kept, begun, "the sequence begins again at its first step") if text
        )
