"""One connection to a robot for several runs: opened by the first, at rest and closed at the end of all."""

from collections.abc import Collection
from contextlib import ExitStack
from types import TracebackType
from typing import Self

from projservo_cli.records import FloatArray, InputError
from projservo_cli.robots.contract import PluginRobot, at_rest_after
from projservo_cli.robots.pacing import Steered


class Session:
    """A connection that is stopped and closed on every way out of its block; what was acted stays.

    ``robot``: that was opened, None before. ``steered``: its set-points. ``acted``: values that actions of it
    were sent last, by their names.
    """

    def __init__(self) -> None:
        self.robot: PluginRobot | None = None
        self.steered: Steered | None = None
        self.acted: dict[str, float] = {}
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.__exit__(kind, error, trace)

    def opened(self, robot: PluginRobot) -> Steered:
        """Open a robot, which a session has one of, and return its set-points."""
        self._stack.enter_context(at_rest_after(robot))
        self.robot, self.steered = robot, Steered(robot)
        return self.steered

    def reading(self) -> FloatArray:
        """Joints (n,) where the robot stands, rad or m; nothing is moved."""
        assert self.robot is not None
        return self.robot.read().q

    def require_acts(self, names: Collection[str]) -> None:
        """Refuse a robot without actions that are asked for; an InputError before anything moves."""
        if names and self.robot is not None and not self.robot.acts:
            raise InputError(
                f"{self.robot.name}: has no act(), which task.steps need: leave "
                f"{', '.join(sorted(names))} out"
            )

    def act(self, name: str, value: float) -> float:
        """Have the robot act, and hold the arm for as long as that takes, s, which is returned."""
        seconds = 0.0 if self.robot is None else self.robot.act(name, value)
        self.acted[name] = value
        self.hold(seconds)
        return seconds

    def hold(self, seconds: float) -> None:
        """Hold the set-point for so long, s."""
        if self.robot is None or self.steered is None:
            return
        end = self.robot.now() + seconds
        self.steered.observe()
        while self.robot.now() < end:
            self.steered.hold()

    @property
    def kept(self) -> str:
        """Say what stays as it was sent, such as a grip; empty for nothing."""
        return ", ".join(f"the {name} stays at {value:g}" for name, value in self.acted.items())
