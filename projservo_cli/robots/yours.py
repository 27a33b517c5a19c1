"""A robot of somebody else: every call timed and checked, stopped on every way out."""

import queue
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, Protocol

import numpy as np

from projservo_cli.calibration import WINDOW, Innovation
from projservo_cli.geometry.algebra import as_array
from projservo_cli.geometry.kinematics import forward
from projservo_cli.records import FloatArray, IntArray, WorkFailed
from projservo_cli.robots.plugins import what_failed
from projservo_cli.robots.simulated import Plant, observe

# Time a robot has to come to rest, s; until then not even Ctrl-C ends the waiting.
STOP_S = 10.0


class Robot(Protocol):
    """What a robot with its two cameras does; see README, "Your own robot in the loop"."""

    def joints(self) -> FloatArray:
        """Joint readings (n,), rad or m."""

    def observe(self) -> FloatArray:
        """Pixels (2, m, 2) of all markers in both views, NaN where unseen."""

    def command(self, step: FloatArray, period: float) -> None:
        """Move by the joint step (n,), rad or m; returns when the period, s, is over."""

    def stop(self) -> None:
        """Come to rest; the last call, from any thread, perhaps while another call still waits."""


class ForeignRobot:
    """A robot whose answers are awaited for a time and checked.

    robot : what is driven.
    name : of it, for messages.
    joints, markers : how many it has to report.
    timeout_s : most time an answer may take, s; of a command beyond its period.
    All methods raise ``WorkFailed`` where the robot fails, is late or answers nonsense. Calls are made
    in one thread of their own, so that the loop goes on where one never returns.
    """

    def __init__(self, robot: Robot, name: str, joints: int, markers: int, timeout_s: float) -> None:
        self.robot, self.name = robot, name
        self.shapes = {"joints": (joints,), "observe": (2, markers, 2)}
        self.timeout_s = timeout_s
        self._orders: queue.SimpleQueue[Callable[[], Any] | None] = queue.SimpleQueue()
        self._answers: queue.SimpleQueue[tuple[Any, BaseException | None]] = queue.SimpleQueue()
        self._stopped = False
        # A daemon: a call that never returns must not keep the process alive.
        threading.Thread(target=self._serve, daemon=True, name=name).start()

    def joints(self) -> FloatArray:
        """Joint readings (n,), rad or m."""
        q = self._array("joints", self._ask("joints", self.robot.joints, self.timeout_s))
        if not np.isfinite(q).all():
            raise WorkFailed(f"{self.name}: joints() gave {q}: readings must be finite numbers")
        return q

    def observe(self) -> FloatArray:
        """Pixels (2, m, 2) of all markers, NaN in both coordinates where unseen."""
        s = self._array("observe", self._ask("observe", self.robot.observe, self.timeout_s))
        if np.isinf(s).any():
            raise WorkFailed(f"{self.name}: observe() gave an infinite pixel: NaN stands for unseen")
        s[np.isnan(s).any(axis=2)] = np.nan
        return s

    def command(self, step: FloatArray, period: float) -> None:
        """Move by the joint step (n,), rad or m, within one period, s."""
        if not np.isfinite(step).all():  # whoever computed it, a robot must never be sent it
            raise WorkFailed(f"{self.name}: a step of {step} was not sent: it is not finite")
        given = step.copy()
        self._ask("command", lambda: self.robot.command(given, period), period + self.timeout_s)

    def stop(self) -> None:
        """Bring the robot to rest, once; an impatient Ctrl-C does not cut it short."""
        if self._stopped:
            return
        self._stopped = True
        ended: queue.SimpleQueue[BaseException | None] = queue.SimpleQueue()
        threading.Thread(target=self._bring_to_rest, args=(ended,), daemon=True).start()
        end = time.monotonic() + STOP_S
        what = f"did not return within {STOP_S:g} s"
        while time.monotonic() < end:
            with suppress(KeyboardInterrupt, queue.Empty):
                error = ended.get(timeout=max(0.0, end - time.monotonic()))
                self._orders.put(None)
                if error is None:
                    return
                what = f"failed: {what_failed(error)}"
                break
        raise WorkFailed(f"{self.name}: stop() {what}; see to it that the robot is at rest")

    def _bring_to_rest(self, ended: "queue.SimpleQueue[BaseException | None]") -> None:
        try:
            self.robot.stop()
            ended.put(None)
        except BaseException as error:
            ended.put(error)

    def _serve(self) -> None:
        while (call := self._orders.get()) is not None:
            try:
                self._answers.put((call(), None))
            except BaseException as error:
                self._answers.put((None, error))

    def _ask(self, what: str, call: Callable[[], Any], seconds: float) -> Any:
        self._orders.put(call)
        try:
            answer, error = self._answers.get(timeout=seconds)
        except queue.Empty:
            raise WorkFailed(
                f"{self.name}: {what}() did not return within {seconds:g} s: look what it waits for, or "
                "raise plant.timeout_s"
            ) from None
        if isinstance(error, KeyboardInterrupt):
            raise error
        if error is not None:
            raise WorkFailed(f"{self.name}: {what}() failed: {what_failed(error)}") from error
        return answer

    def _array(self, what: str, answer: Any) -> FloatArray:
        """The answer as new numbers of the right shape."""
        shape = self.shapes[what]
        try:
            found = np.asarray(answer)
        except ValueError:
            found = np.empty(0, dtype=object)
        if found.dtype.kind not in "fiu":
            raise WorkFailed(
                f"{self.name}: {what}() gave {type(answer).__name__}: expected numbers of shape {shape}"
            )
        if found.shape != shape:
            raise WorkFailed(f"{self.name}: {what}() gave numbers of shape {found.shape}, expected {shape}")
        return np.array(found, dtype=np.float64)


@contextmanager
def at_rest_after(robot: Any) -> Iterator[None]:
    """Stop a robot on every way out: the end, an exception, Ctrl-C, SIGTERM and a lost terminal."""
    with _signals_interrupt():
        try:
            yield
        except BaseException as error:
            try:
                robot.stop()
            except WorkFailed as failure:
                raise WorkFailed(f"{_line(error)}; and {failure}") from error
            raise
        else:
            robot.stop()


def _line(error: BaseException) -> str:
    if isinstance(error, KeyboardInterrupt):
        return "interrupted"
    return " ".join(str(error).split()) or type(error).__name__


@contextmanager
def _signals_interrupt() -> Iterator[None]:
    """Treat a termination as Ctrl-C, which unwinds; only the main thread may set this up."""

    def interrupt(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    names = ("SIGTERM", "SIGHUP") if threading.current_thread() is threading.main_thread() else ()
    before = {}
    for number in (getattr(signal, name) for name in names if hasattr(signal, name)):
        handler = signal.getsignal(number)
        if handler not in (signal.SIG_IGN, None):  # nohup has its reasons
            before[number] = handler
            signal.signal(number, interrupt)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class DrivenRobot:
    """A robot with its cameras beside the plant that the calibration takes it for.

    robot : what is driven.
    plant : calibrated model and face; image size and joint limits.
    shown : (k,) indices of the markers that the loop is shown among those that the robot observes, the face
        first.
    order : (m,) index there of each marker of the calibration, −1 where it is not observed.
    innovation : test of the images against the calibration; None tests nothing.
    ``q``: (n,) joint readings when last asked for, rad or m. ``H, hidden``: displacement of the face and
    self-occlusion as the calibration has them there. ``in_front``: a camera sees nothing behind it.
    ``disturbance``: why the images no longer agree with the calibration, or what failed; else empty.
    """

    in_front = True
    takes_parts = True

    def __init__(
        self,
        robot: ForeignRobot,
        plant: Plant,
        shown: IntArray,
        order: IntArray,
        innovation: Innovation | None,
    ) -> None:
        self.robot, self.plant = robot, plant
        self.shown, self.order = shown, order
        self.markers = len(shown)
        self.innovation = innovation
        self.q = np.zeros(len(plant.lower))
        self.H = np.eye(4)
        self.hidden = np.zeros(2)
        self.disturbance = ""

    def joints(self) -> FloatArray:
        """Joint readings (n,), rad or m."""
        self.q = self.robot.joints()
        H = forward(self.plant.model, self.q)
        self.H = as_array(H)
        M = np.zeros_like(self.plant.M)
        observe(self.plant, H, M, np.zeros((2, len(M), 2)), self.hidden)
        return self.q.copy()

    def observe(self) -> FloatArray:
        """Pixels (2, k, 2) of the markers shown, NaN where unseen; all markers are tested."""
        s = self.robot.observe()
        if self.innovation is not None:
            known = np.where((self.order < 0)[:, None], np.nan, s[:, self.order])
            at_once, at_rest, certain = np.stack([self.q, self.q]), np.zeros_like(self.q), np.zeros(2)
            self.disturbance = self.innovation.disturbed(
                at_once, at_rest, certain, known, np.ones(2, dtype=np.bool_)
            )
        return np.ascontiguousarray(s[:, self.shown])

    def fits(self) -> str:
        """What is wrong with the images where the robot stands; empty where nothing is."""
        for _ in range(WINDOW):
            self.joints()
            self.observe()
        return self.disturbance

    def distance(self) -> float:
        """No distance is known without a metric: nothing ever recedes."""
        return 0.0

    def command(self, step: FloatArray, period: float) -> None:
        """Move by the joint step (n,), rad or m, within one period, s."""
        self.robot.command(step, period)

    def stop(self) -> None:
        """Come to rest."""
        self.robot.stop()
