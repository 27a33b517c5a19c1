"""One connection to a robot for several runs: opened by the first, at rest and closed at the end of all."""

from collections.abc import Callable, Collection
from contextlib import ExitStack
from types import TracebackType
from typing import Any, NamedTuple, Self

from projservo_cli.findings import NOTE, REFUSES, Finding, Subject
from projservo_cli.messages import failed
from projservo_cli.records import InputError, WorkFailed
from projservo_cli.robots.contract import PluginRobot, at_rest_after
from projservo_cli.robots.object_watch import LOOKS, ObjectWatch
from projservo_cli.robots.pacing import Steered


class FollowedObject(NamedTuple):
    """The object at whose goal the arm is while it moves."""

    name: str
    go_on: Callable[[float], None]  # lets the arm go on following it for a time, s
    goal: Any  # as the last run followed it, so that a retreat starts from it


class Session:
    """A connection that is always stopped and closed at the end of its block; effects of actions stay.

    ``robot``: that was opened, None before. ``steered``: its set-points. ``acted``: values that actions of it
    were sent last, by their names. ``at``: the watch over the object at whose goal the arm is, None
    elsewhere. ``held``: names of objects that the tool took with an action, by the name of the action.
    ``followed``: the object at whose goal the arm is while it moves; None without one.
    """

    def __init__(self) -> None:
        self.robot: PluginRobot | None = None
        self.steered: Steered | None = None
        self.acted: dict[str, float] = {}
        self.at: ObjectWatch | None = None
        self.held: dict[str, str] = {}
        self.followed: FollowedObject | None = None
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

    def require_acts(self, names: Collection[str]) -> None:
        """Refuse a robot without actions that are asked for; an InputError before anything moves."""
        if names and self.robot is not None and not self.robot.acts:
            raise InputError(
                f"{self.robot.name}: has no act(), which task.steps need: leave "
                f"{', '.join(sorted(names))} out"
            )

    def act(self, name: str, value: float) -> float:
        """Have the robot act, and hold the arm for as long as that takes, s, which is returned.

        The first action at the goal of an object takes it, the next of its name lets go of it.
        """
        takes = None
        if name not in self.held and self.followed is not None:
            takes = self.followed.name
        elif name not in self.held and self.at is not None and self.steered is not None:
            _require_there(self.at, self.steered)
            takes = self.at.name
        seconds = 0.0 if self.robot is None else self.robot.act(name, value)
        self.acted[name] = value
        self.hold(seconds)
        self.held.pop(name, None)
        if takes is not None:
            self.held[name], self.at, self.followed = takes, None, None
        if (lost := self.lost) is not None:
            raise failed([lost])
        return seconds

    def empty(self, name: str) -> bool:
        """Whether a gripper closed by an action is empty, as far as the robot can tell."""
        return self.robot is not None and self.robot.holding(name) is False

    @property
    def lost(self) -> Finding | None:
        """The object that the tool should hold, by its actions, and does not; None for none."""
        for name, taken in self.held.items():
            if self.empty(name):
                part = Finding("object", subject=Subject(name=taken))
                return Finding("dropped", REFUSES, Subject(name=name), others=(part,))
        return None

    def hold(self, seconds: float) -> None:
        """Hold the set-point for a time, s, or go on following an object that moves."""
        if self.robot is None or self.steered is None:
            return
        if self.followed is not None:
            self.followed.go_on(seconds)
            return
        end = self.robot.now() + seconds
        self.steered.observe()
        while self.robot.now() < end:
            self.steered.hold()

    @property
    def kept(self) -> tuple[Finding, ...]:
        """States that stay as sent, such as a grip."""
        return tuple(Finding("stays", NOTE, Subject(name=name), at) for name, at in self.acted.items())


def _require_there(watch: ObjectWatch, steered: Steered) -> None:
    """Look whether the object that the arm is about to take lies where the motion was planned to."""
    for _ in range(LOOKS):
        watch.observe(steered.hold())
        if watch.moved:
            raise failed([watch.moved], stage="nothing was taken")
    if not watch.seen:
        raise WorkFailed(
            f"nothing was taken: no image shows the object {watch.name} where it is to be: look where it "
            "lies, and what hides it, then run again"
        )
