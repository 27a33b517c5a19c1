"""The contract with a robot: called in one thread, awaited, checked, and always stopped and closed."""

import math
import queue
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, wait
from contextlib import contextmanager, suppress
from typing import Any, NamedTuple, Protocol

import numpy as np

from projservo_cli.calibration.time_offset import is_repeated_frame, time_unit
from projservo_cli.findings import REFUSES, Finding, Subject, from_text
from projservo_cli.image_size import ImageSize, image_sizes
from projservo_cli.messages import failed
from projservo_cli.plugins import what_failed
from projservo_cli.records import (
    VIEWS,
    ByteArray,
    FloatArray,
    InputError,
    IntArray,
    JointLimits,
    WorkFailed,
    in_unit,
)

# Time a robot has to come to rest, and then to be closed, s; until then not even Ctrl-C ends the waiting.
STOP_S = 10.0
# Share of a bound by which rounding may exceed it, and of a period by which an instant may be missed: the
# time steps of a simulator seldom end where a command is due.
_ROUND_OFF, _LATE = 1e-9, 0.1
# A joint that is driven goes from reading to reading at this multiple of its speed limit, plus a margin
# (rad or m), at most: a joint that falls or is pushed goes farther, or one whose reading is wrong.
_SURGE, _LEAP = 3.0, 0.05
_WHOLE = 8  # readings in a row whose stamps are whole seconds by chance, at most


_NO_OBJECTS = np.zeros((0, 0, 2))


class Reading(NamedTuple):
    """One look at a robot, checked."""

    q: FloatArray  # (n,) rad or m
    s: FloatArray  # (V, m, 2) px, NaN in both coordinates where unseen
    # when the joints were read, s: the robot's stamp, otherwise its clock just before it was asked
    t_q: float
    t_view: FloatArray  # (V,) stamps of the frames, s, by any clock; NaN if there are none
    sigma_px: FloatArray | None  # (V, m) standard deviation of each corner, px; None if none is stated
    view: tuple[str, ...] = VIEWS  # names of the views
    # (V, k, 2) px of the markers of objects, and (V, k) deviations of these if stated, likewise
    s_objects: FloatArray = _NO_OBJECTS
    sigma_objects: FloatArray | None = None

    @property
    def whole(self) -> "Reading":
        """The reading with the markers of objects after the markers of the tool."""
        if not self.s_objects.size:
            return self
        s, sigma = np.concatenate([self.s, self.s_objects], axis=1), None
        if self.sigma_px is not None and self.sigma_objects is not None:
            sigma = np.concatenate([self.sigma_px, self.sigma_objects], axis=1)
        return self._replace(s=s, sigma_px=sigma, s_objects=_NO_OBJECTS, sigma_objects=None)

    def new_views(self, before: "Reading | None") -> list[bool]:
        """Whether each view has another frame than in the reading before."""
        if before is None:
            return [True] * len(self.s)
        frames_of_views = zip(self.t_view, self.s, before.t_view, before.s, strict=True)
        return [not is_repeated_frame(*frames) for frames in frames_of_views]


class Bounds(NamedTuple):
    """Limits of every command, and bounds of the servos; (n,) each, rad or m.

    ``units`` are those in which messages give joints: deg, rad or m; empty where unknown.
    """

    limits: JointLimits  # speed limits with the factor of every command
    lead: FloatArray  # lead of a set-point before the last reading
    period: float  # period of the loop, s
    max_servo_lag_s: float  # time constant with which joints follow, s
    sag: FloatArray  # (n,) how far joints stay short under gravity
    units: tuple[str, ...] = ()

    def text(self, i: int, value: float, digits: int = 6) -> str:
        """Write a value of joint i, rad or m, in its unit."""
        return in_unit(value, self.units[i] if self.units else "rad or m", digits)

    def unit(self, i: int) -> str:
        """Return the unit of joint i in findings, rad or m."""
        return "m" if self.units[i : i + 1] == ("m",) else "rad"

    def allowed(
        self, q: FloatArray, sent: FloatArray, seconds: float
    ) -> dict[str, tuple[FloatArray, FloatArray]]:
        """Least and most (n,) that a set-point may be, by the code of a finding on others.

        q : reading (n,); sent : (n,) the set-point before; seconds : since that was due, s.
        """
        step, lead = self.limits.speed * seconds, self.lead
        return {
            "set_point_ahead": (q - lead, q + lead),
            # Back towards the reading it may jump, which shortens the path of the robot, by the distance that
            # a robot may be behind: a reading that is farther away is wrong.
            "set_point_far": (
                np.maximum(np.minimum(sent, q), sent - lead) - step,
                np.minimum(np.maximum(sent, q), sent + lead) + step,
            ),
            # One beyond a limit may return.
            "set_point_passed": (np.minimum(self.limits.lower, q), np.maximum(self.limits.upper, q)),
        }


class Robot(Protocol):
    """A robot with its cameras.

    A class whose cameras are others than left and right names them in ``view``, such as ``("top",)``.

    A class may also have ``now() -> float``, its clock, s, without which ``time.monotonic`` is taken;
    ``release()`` and ``hold()``, which let go of the arm, so that a user can move it for ``projservo
    teach``, and hold it again; ``identity() -> str``, without spaces, which changes where readings mean
    other positions, such as after homing, and without which no recording holds; ``remarks() -> list[str]``,
    faults of its last images, such as darkness; ``force() -> float``, the force on the tool, N, the greatest
    since it was last asked for, which ``stop.max_force_n`` limits; and, if it is a simulator, ``truth()``,
    the pose (4, 4) of the tool in its base frame, m, or its joints (n,), for results alone. A simulator's
    time passes in ``command`` alone, which moves it to ``due``. ``act(name, value)`` is an action, such as of
    a gripper: it returns at once, perhaps with the time that it takes, s, for which the arm is held;
    ``holding(name)`` tells whether it holds an object, None if that is unknown. And ``frames``, the images
    (V, height, width) of its last reading in grey, uint8, or None: a run keeps some, which the report shows.
    A class that takes an argument ``limits`` is given the limits of its joints, ``JointLimits``; one with an
    argument ``numbers`` the numbers of all markers, in the order of its pixels.
    """

    def open(self) -> None:
        """Connect to robot and cameras; the first call."""

    def read(self) -> tuple[Any, ...]:
        """Look once.

        Returns ``q, pixels``, perhaps ``t_q, t_left, t_right`` and ``sigma_px`` after them, each of which may
        be None: joints (n,), rad or m; pixels (V, m, 2) of all markers in each of V views, of the tool
        first, then of the objects that are configured, NaN where unseen;
        when the joints were read, s, by the robot's clock; a stamp of each of the V images, s, by any clock;
        standard deviations (V, m) of the pixels. Or ``q, pixels`` and perhaps ``t_q`` with a mapping from
        names of views to pixels (m, 2), or to a tuple of pixels, stamp and perhaps deviations (m,): a view
        that is missing there, or None, is lost in this reading.
        """

    def command(self, target: FloatArray, speed: FloatArray, due: float) -> None:
        """Be at the joints ``target`` (n,), rad or m, when the clock shows ``due``, s; return at once.

        ``speed`` (n,), per s, goes with it: a position servo needs the target, a velocity interface the speed
        and the target, a trajectory interface all three. With no new command two periods after one was due,
        hold.
        """

    def stop(self) -> None:
        """Come to rest; from another thread if a call has not returned in time."""

    def close(self) -> None:
        """Let go of robot and cameras; the last call."""


class PluginRobot:
    """The user's robot, whose answers have a timeout and are checked, as are its commands.

    robot : an object of the contract.
    name : of it, for messages.
    markers : how many it observes on the tool; objects : how many further ones, on objects.
    bounds : of its commands; they give the number of joints, too.
    timeout_s, open_s : most time an answer may take, s, and opening it.
    image_size : width and height of its frames, px; None for any.
    view : names of the views that readings are to have, in this order; None for the robot's.
    Raises InputError if the robot has none of such a name.
    All methods raise ``WorkFailed`` if the robot fails, is late or answers nonsense. Calls are made in one
    separate thread, so that the loop goes on if one never returns.
    """

    def __init__(
        self,
        robot: Robot,
        name: str,
        markers: int,
        bounds: Bounds,
        timeout_s: float,
        open_s: float,
        *,
        image_size: ImageSize | None = None,
        view: Sequence[str] | None = None,
        objects: int = 0,
    ) -> None:
        self.robot, self.name, self.bounds, self.image_size = robot, name, bounds, image_size
        # views in the order of its answers
        self._views: tuple[str, ...] = tuple(getattr(robot, "view", VIEWS))
        if isinstance(getattr(robot, "view", ()), str) or not 0 < len({*self._views}) == len(self._views):
            raise InputError(f"{name}: view is {getattr(robot, 'view', ())!r}: expected names, each once")
        self.view = self._views if view is None else tuple(view)
        if missing := [one for one in self.view if one not in self._views]:
            raise InputError(
                f"{name}: has the cameras {', '.join(self._views)}, and none named {missing[0]}, as in the "
                "recording: name them as there, or record again"
            )
        self._rows = [self._views.index(one) for one in self.view]
        self.timeout_s, self.open_s = timeout_s, open_s
        self._joints, self._tool, self._markers = len(bounds.limits.speed), markers, markers + objects
        self._now: Callable[[], Any] = getattr(robot, "now", time.monotonic)
        self._began = 0.0, 0.0  # first reading of its clock, and when, as below
        self._shown = -math.inf, 0.0  # last reading of its clock, and when by this machine's, s
        self._last: Reading | None = None
        # The clock and the stamps (1 + V,) first read, s, and how many readings in a row have whole ones.
        self._stamps: tuple[float, FloatArray, IntArray] | None = None
        self._earlier: Reading | None = None  # the one before the last
        self.frames: ByteArray | None = None  # (V, height, width) last seen, if the robot has them
        self._sent: FloatArray | None = None  # the last set-point (n,)
        self._due = -math.inf  # when it is to be there, s
        self._orders: queue.SimpleQueue[tuple[Callable[[], Any], Future[Any]] | None] = queue.SimpleQueue()
        self._runs_alone: bool | None = None  # whether its clock goes on by itself, once that was tried
        # begun, opened: whether opening it began, and ended; answers: whether its thread does
        self._begun = self._opened = self._stopped = False
        self._answers = True

    def open(self) -> None:
        """Open the robot in the thread in which it is driven from now on."""
        self._begun = True
        # A daemon: a call that never returns must not keep the process alive.
        threading.Thread(target=self._serve, daemon=True, name=self.name).start()
        self._ask("open", self.robot.open, self.open_s)
        self._opened = True

    def read(self) -> Reading:
        """Joints and pixels of one observation."""
        before, answer, frames = self._ask("read", self._reading)
        reading = self._checked(self._time(before), answer)
        self._earlier, self._last = self._last, reading
        if frames is not None and not (
            isinstance(frames, np.ndarray)
            and frames.dtype == np.uint8
            and frames.shape[:1] == (len(self._views),)
            and frames.ndim == 3
            and frames.size
        ):
            expected = f"({len(self._views)}, height, width)"
            raise WorkFailed(f"{self.name}: frames must be an array {expected} of uint8, or None")
        self.frames = None if frames is None else frames[self._rows]
        sizes = image_sizes(self.image_size, self._views)
        if frames is not None and np.isfinite(sizes).all() and (sizes != frames.shape[:0:-1]).any():
            frame_size = " x ".join(map(str, frames.shape[:0:-1]))
            asked = " and ".join(dict.fromkeys(f"{width:.0f} x {height:.0f}" for width, height in sizes))
            raise WorkFailed(
                f"{self.name}: the image size of its frames is {frame_size} px, not the {asked} of the "
                "configuration; set resolution and crop of the cameras as they were calibrated with"
            )
        return self._last

    def _reading(self) -> tuple[Any, Any, Any]:
        """Time of the clock, the observation, and its frames."""
        return self._now(), self.robot.read(), getattr(self.robot, "frames", None)

    def now(self) -> float:
        """Time of the clock of the robot, s; of this machine's clock if it has none."""
        return self._time(time.monotonic() if self._now is time.monotonic else self._ask("now", self._now))

    def truth(self) -> FloatArray | None:
        """True pose (4, 4) of the tool, m, or true joints (n,), rad or m; None where unknown."""
        method = getattr(self.robot, "truth", None)
        if method is None:
            return None
        answer = self._ask("truth", method)
        shape = (4, 4) if np.ndim(answer) == 2 else (self._joints,)
        return self._numbers("truth() gave numbers", answer, shape, finite=True)

    def force(self) -> float:
        """Force on the tool, N, as the robot reports it; raises InputError if it reports none."""
        if not callable(method := getattr(self.robot, "force", None)):
            raise InputError(f"stop.max_force_n: {self.name} has no force(): add it, or leave the key out")
        return float(self._numbers("force() gave numbers", self._ask("force", method), (), finite=True))

    def health(self) -> dict[str, float | str]:
        """Return the measurements of the robot on itself, such as its voltage, by name; may be empty."""
        return dict(self._optional("health", {}))

    def remarks(self) -> list[Finding]:
        """Return the faults of the last images that the robot finds; may be empty."""
        found = self._optional("remarks", ())
        return [one if isinstance(one, Finding) else from_text(str(one)) for one in found]

    def identity(self) -> str:
        """Return a text that changes with the meaning of the readings; may be empty."""
        return "".join(str(self._optional("identity", "")).split())

    @property
    def acts(self) -> bool:
        """Whether it has actions."""
        return callable(getattr(self.robot, "act", None))

    def act(self, name: str, value: float) -> float:
        """Have it act, if it can, and return how long that takes, s."""
        method = getattr(self.robot, "act", None)
        if not callable(method):
            return 0.0  # a simulated robot has no actions
        seconds = self._ask("act", lambda: method(name, value))
        return float(self._numbers("act() gave a time", 0.0 if seconds is None else seconds, (), finite=True))

    def holding(self, name: str) -> bool | None:
        """Whether the closed gripper of an action holds an object; None if the robot cannot tell."""
        is_holding = self._optional("holding", None, name)
        return None if is_holding is None else bool(is_holding)

    def _optional(self, name: str, default: Any, *given: Any) -> Any:
        """Return the answer of a method that a class may have; the default without it."""
        method = getattr(self.robot, name, None)
        return self._ask(name, lambda: method(*given)) if callable(method) else default

    def require_identity(self, recorded: str) -> None:
        """Refuse a robot whose readings mean something else than when they were recorded; a WorkFailed."""
        now = self.identity()
        if recorded and now != recorded:
            raise WorkFailed(
                f"{self.name}: nothing was moved: its readings mean something else than in the recording: "
                f"{_difference(recorded, now)}: was it homed or calibrated since? Record again: projservo "
                "record calibrate --force",
                refutes=True,
            )

    @property
    def lets_go(self) -> bool:
        """Whether the arm can be released, and held again."""
        return all(callable(getattr(self.robot, name, None)) for name in ("release", "hold"))

    def by_hand(self, what: str) -> None:
        """``release`` the arm, so that a user can move it, or ``hold`` it again where it is.

        Before and after ``hold`` the arm is sent to its joint readings: one whose servos are only
        switched on again would leap to its last set-point, from before it was released.
        """
        q = self.read().q if what == "hold" else None
        self._stay(q)
        self._ask(what, getattr(self.robot, what))
        self._stay(q)

    def _stay(self, q: FloatArray | None) -> None:
        """Send the last joint readings (n,) as its set-point, if there are any."""
        if q is not None:
            self._sent = None  # it was moved by hand since: no step leads there
            self.command(q, np.zeros_like(q), self.now() + self.bounds.period)

    def command(self, target: FloatArray, speed: FloatArray, due: float) -> None:
        """Send the set-point (n,), rad or m, with its speed (n,), per s, and when it is due, s."""
        if wrong := self._wrong(target, speed, due):
            raise failed([wrong], stage=f"{self.name}: a command was not sent")
        sent = target.copy(), speed.copy(), due
        self._ask("command", lambda: self.robot.command(*sent))
        self._sent, self._due = target.copy(), due

    def wait_until(self, due: float) -> bool:
        """Wait until the clock shows an instant, s, to a tenth of a period; whether that was past."""
        before, asleep = self.now(), time.monotonic()
        now, slack = before, _LATE * self.bounds.period
        while now < due - slack:
            time.sleep(min(due - now, self.bounds.period))
            now = self.now()
            if now == before and time.monotonic() > asleep + self.timeout_s:
                raise WorkFailed(
                    f"{self.name}: its clock stands still at {now:.6g} s, before {due:.6g} s: now() must go "
                    "on by itself, or command() move it to when it is due"
                )
        return before > due + slack

    def waits(self, seconds: float) -> bool:
        """Wait so long, s; False if the clock of the robot stops meanwhile, a simulator's."""
        if self._runs_alone is not False:
            before = self.now()
            time.sleep(seconds)
            self._runs_alone = self.now() > before
        return self._runs_alone

    def stop(self) -> None:
        """Bring the robot to rest, once: in its thread, and from another if that does not answer.

        An impatient Ctrl-C does not cut it short.
        """
        if not self._begun or self._stopped:
            return
        self._stopped = True
        orders = [self._order(self.robot.stop)]
        if _came(orders, self.timeout_s) is None:
            self._answers = False
            orders[0].cancel()
            self._say(f"its thread has not answered for {self.timeout_s:g} s, so stop() comes from another")
            orders = [*(order for order in orders if not order.cancelled()), Future()]
            threading.Thread(target=_serve, args=(self.robot.stop, orders[-1]), daemon=True).start()
        error = _came(orders, STOP_S)
        if self._opened and error != "":
            what = f"failed: {error}" if error else f"did not return within {STOP_S:g} s"
            raise WorkFailed(f"{self.name}: stop() {what}; make sure that the robot is at rest")

    def close(self) -> None:
        """Let go of the robot, once, in its thread, even if opening it failed, and report errors."""
        if not self._begun:
            return
        self._begun = False
        error = _came([self._order(self.robot.close)], STOP_S if self._answers else self.timeout_s)
        self._orders.put(None)
        if self._opened and error != "":
            self._say(f"close() failed: {error}" if error else "not closed, since its thread is not free")

    def _say(self, what: str) -> None:
        print(f"{self.name}: {what}", file=sys.stderr)

    def _serve(self) -> None:
        while (order := self._orders.get()) is not None:
            _serve(*order)

    def _order(self, call: Callable[[], Any]) -> "Future[Any]":
        order: Future[Any] = Future()
        self._orders.put((call, order))
        return order

    def _ask(self, what: str, call: Callable[[], Any], seconds: float | None = None) -> Any:
        order, key = self._order(call), "timeout_s" if seconds is None else "open_s"
        seconds = seconds or self.timeout_s
        try:
            error = order.exception(seconds)
        except TimeoutError:
            raise WorkFailed(
                f"{self.name}: {what}() did not return within {seconds:g} s: find out why it waits, or "
                f"raise plant.{key}"
            ) from None
        if isinstance(error, (KeyboardInterrupt, InputError)):
            raise error
        if isinstance(error, WorkFailed):  # the class words it
            raise WorkFailed(f"{self.name}: {error}", findings=error.findings) from error
        if error is not None:
            raise WorkFailed(f"{self.name}: {what}() failed: {what_failed(error)}") from error
        return order.result()

    def _time(self, answer: Any) -> float:
        """An instant that the clock showed, s; one that jumps is named."""
        now, here = float(self._numbers("now() gave a time", answer, (), finite=True)), time.monotonic()
        before, there = self._shown
        last = max(before + here - there, self._due) if self._shown[1] else math.inf
        if not before <= now <= last + self.timeout_s:
            began, then = self._began  # a clock that ran well until now was set, in any unit
            unit = time_unit(max(now - began, 1e-9) / max(here - then, 1e-6))
            raise WorkFailed(
                f"{self.name}: its clock jumped from {before:.6g} s to {now:.6g} s"
                + (f" in {here - there:.3g} s: now() must give s, and {unit}" if unit else "")
            )
        self._began = self._began if self._shown[1] else (now, here)
        self._shown = now, here
        return now

    def _checked(self, before: float, answer: Any) -> Reading:
        """Copy the answer of read(); ``before`` is the time of the clock then, s."""
        V, views = len(self._views), ", ".join(f"t_{view}" for view in self._views)
        by_name = isinstance(answer, tuple) and len(answer) > 1 and isinstance(answer[1], Mapping)
        if not isinstance(answer, tuple) or not 2 <= len(answer) <= (3 if by_name else 4 + V):
            after = "t_q" if by_name else f"t_q, {views} and sigma_px"
            raise WorkFailed(
                f"{self.name}: read() gave {type(answer).__name__}: expected (q, pixels), perhaps with "
                f"{after} after them"
            )
        q, pixels, *stamps, sigma = list(answer) + [None] * (4 + V - len(answer))
        if by_name:
            pixels, stamps[1:], sigma = self._by_name(pixels)
        q = self._numbers("read() gave q", q, (self._joints,), finite=True)
        s = self._numbers("read() gave pixels", pixels, (V, self._markers, 2))[self._rows]
        if np.isinf(s).any():
            raise WorkFailed(f"{self.name}: read() gave an infinite pixel: NaN stands for unseen")
        s[np.isnan(s).any(axis=2)] = np.nan
        stamps = [stamps[0], *(stamps[1 + view] for view in self._rows)]
        times = np.full(len(stamps), np.nan)
        for i, name in enumerate(("t_q", *(f"t_{view}" for view in self.view))):
            if stamps[i] is not None:
                times[i] = self._numbers(f"read() gave {name}", stamps[i], (), finite=True)
            last = -math.inf if self._last is None else (self._last.t_q, *self._last.t_view)[i]
            if times[i] < last - (i and self.timeout_s):  # exposures that jitter may overtake each other
                what = f"{name} went back from {last:.6g} s to {times[i]:.6g} s"
                raise WorkFailed(f"{self.name}: {what}: one clock must stamp all of them")
        self._require_seconds(before, times)
        if sigma is not None:
            sigma = self._numbers("read() gave sigma_px", sigma, (V, self._markers))[self._rows]
            stated = sigma[np.isfinite(s[..., 0])]
            if not ((stated > 0.0) & (stated < math.inf)).all():
                raise WorkFailed(f"{self.name}: read() gave a sigma_px that is no positive number")
        t_q = before if np.isnan(times[0]) else float(times[0])
        found, tool = Reading(q=q, s=s, t_q=t_q, t_view=times[1:], sigma_px=sigma, view=self.view), self._tool
        if tool == self._markers:
            return found
        parts = (None, None) if sigma is None else (sigma[:, :tool], sigma[:, tool:])
        return found._replace(s=s[:, :tool], sigma_px=parts[0], s_objects=s[:, tool:], sigma_objects=parts[1])

    def _by_name(self, views: Mapping[Any, Any]) -> tuple[list[Any], list[Any], list[Any] | None]:
        """Pixels (m, 2), stamps and deviations (m,) of all views, from a mapping; NaN of a lost one."""
        if unknown := [name for name in views if name not in self._views]:
            raise WorkFailed(
                f"{self.name}: read() gave a view {unknown[0]!r}, where its cameras are "
                f"{', '.join(self._views)}: name all of them in the class, view = {(*views,)}"
            )
        pixels, stamps, sigma, stated = [], list[Any](), [], list[bool]()
        for name in self._views:
            given: Any = views.get(name)
            # A tuple of pixels, stamp and deviations; one of rows u, v is pixels alone.
            several = isinstance(given, tuple) and 2 <= len(given) <= 3 and np.ndim(given[0]) != 1
            s, t, deviation = (*given, None)[:3] if several else (given, None, None)
            stamps.append(t)
            unseen = np.full((self._markers, 2), np.nan)
            shape = (self._markers, 2)
            pixels.append(unseen if s is None else self._numbers(f"read() gave {name} pixels", s, shape))
            if s is not None:
                stated.append(deviation is not None)
            what = f"read() gave sigma_px of {name}"
            known = None if deviation is None else self._numbers(what, deviation, shape[:1])
            sigma.append(unseen[:, 0] if known is None else known)
        if any(stated) and not all(stated):
            raise WorkFailed(f"{self.name}: read() gave deviations of some views: give those of all or none")
        return pixels, stamps, sigma if any(stated) else None

    def _require_seconds(self, clock: float, times: FloatArray) -> None:
        """Refuse stamps of joints and views that go on as in another unit than s, or in whole seconds."""
        if self._stamps is None:
            self._stamps = clock, times, np.ones(len(times), dtype=np.int64)
        begun, first, whole = self._stamps
        np.multiply(whole + 1, (times == np.rint(times)) & (times != 0.0), out=whole)
        names = "t_q", *(f"t_{view}" for view in self.view)
        for name, t, since, count in zip(names, times, first, whole, strict=True):
            # A separate clock may jump by a second or two, when it is set.
            unit = time_unit(max(t - since - 2.0, 1e-9) / (clock - begun)) if clock - begun > 2e-3 else ""
            if unit:
                raise WorkFailed(
                    f"{self.name}: {name} went on by {t - since:.6g} while its clock went on by "
                    f"{clock - begun:.3g} s: {unit}"
                )
            if count > _WHOLE and (clock - begun) % 1.0 and self.bounds.period % 1.0:
                raise WorkFailed(
                    f"{self.name}: {name} is a whole number in {count} readings, such as {t:.0f}: give s "
                    "with its fractions, else no latency can be estimated"
                )

    def seconds_to(self, due: float) -> float:
        """Return the time, s, from when the last command was due, at most a period ago, to another."""
        return max(0.0, due - max(self._due, self._shown[0] - self.bounds.period))

    def _wrong(self, target: FloatArray, speed: FloatArray, due: float) -> Finding | None:
        """Return the reason why a command must not be sent; None if it may."""
        bounds = self.bounds
        if self._last is None:
            return Finding("not_read", REFUSES)
        if not (np.isfinite(target).all() and np.isfinite(speed).all() and math.isfinite(due)):
            return Finding("not_finite_command", REFUSES)
        q = self._last.q
        sent = q if self._sent is None else self._sent
        # From the last set-point on, which after a pause was held: thinking took a period at most.
        if self._sent is not None and (leap := self._leap(self._earlier, self._last, self._sent)):
            return leap
        seconds = self.seconds_to(due)
        far = 2.0 * bounds.lead + bounds.limits.speed * seconds
        for i in np.flatnonzero(np.abs(q - sent) > far).tolist():
            return self._of_joint("reading_far", i, q[i], limit=sent[i])
        slack = _ROUND_OFF * (1.0 + np.abs(target))
        for code, (low, high) in bounds.allowed(q, sent, seconds).items():
            for i in np.flatnonzero((target < low - slack) | (target > high + slack)).tolist():
                ends = (Finding("range", amount=low[i], limit=high[i], unit=bounds.unit(i)),)
                return self._of_joint(code, i, target[i], others=ends)
        for i in np.flatnonzero(np.abs(speed) > bounds.limits.speed * (1.0 + _ROUND_OFF)).tolist():
            return self._of_joint("speed_passed", i, speed[i], limit=bounds.limits.speed[i])
        return None

    def _of_joint(self, code: str, i: int, amount: float, **more: Any) -> Finding:
        return Finding(code, REFUSES, Subject(joints=(i + 1,)), amount, unit=self.bounds.unit(i), **more)

    def _leap(self, before: Reading | None, now: Reading, sent: FloatArray) -> Finding | None:
        """Return the joint whose reading cannot have been reached since the reading before, or None.

        Towards the set-point (n,) it may leap: a reading that repeated for a while does.
        """
        if before is None:
            return None
        seconds = max(now.t_q - before.t_q, self.bounds.period)
        far = _SURGE * self.bounds.limits.speed * seconds + self.bounds.sag + _LEAP
        leaps = (np.abs(now.q - before.q) > far) & (np.abs(now.q - sent) > np.abs(before.q - sent))
        for i in np.flatnonzero(leaps).tolist():
            first = Finding("first", amount=before.q[i], limit=seconds, unit=self.bounds.unit(i))
            return self._of_joint("reading_leapt", i, now.q[i], others=(first,))
        return None

    def _numbers(self, what: str, answer: Any, shape: tuple[int, ...], *, finite: bool = False) -> FloatArray:
        """The answer as new numbers of the right shape."""
        try:
            numbers = np.asarray(answer)
        except ValueError:
            numbers = np.empty(0, dtype=object)
        if numbers.dtype.kind not in "fiu":
            raise WorkFailed(
                f"{self.name}: {what} as {type(answer).__name__}: expected numbers of shape {shape}"
            )
        if numbers.shape != shape:
            raise WorkFailed(f"{self.name}: {what} of shape {numbers.shape}, expected {shape}")
        if finite and not np.isfinite(numbers).all():
            raise WorkFailed(f"{self.name}: {what} as {numbers}: must be finite")
        return np.array(numbers, dtype=np.float64)


def _difference(before: str, now: str) -> str:
    """Tell the parts of two identities, divided by semicolons, that differ."""
    pairs = zip(before.split(";"), now.split(";"), strict=False)
    return ", ".join(f"{x} is now {y}" for x, y in pairs if x != y) or f"{before} is now {now}"


def _serve(call: Callable[[], Any], order: "Future[Any]") -> None:
    """Make a call, unless it was cancelled, and keep its result."""
    if order.set_running_or_notify_cancel():
        try:
            order.set_result(call())
        except BaseException as error:
            order.set_exception(error)


def _came(orders: "list[Future[Any]]", seconds: float) -> str | None:
    """Return the error of the first finished order; None for none yet.

    Whoever interrupts meanwhile is not heeded.
    """
    end = time.monotonic() + seconds
    while True:
        with suppress(KeyboardInterrupt):
            done, _ = wait(orders, max(0.0, end - time.monotonic()), return_when="FIRST_COMPLETED")
            if done:
                errors = [order.exception() for order in done]
                if None in errors:
                    return ""
                said = [str(error) for error in errors if isinstance(error, WorkFailed)]
                return said[0] if said else what_failed(errors[0] or RuntimeError())
            if time.monotonic() >= end:
                return None


@contextmanager
def at_rest_after(robot: PluginRobot) -> Iterator[None]:
    """Open a robot; always stop and close it, also on Ctrl-C, SIGTERM and a lost terminal.

    Raises WorkFailed if it may not be at rest, with the error that ended it.
    """
    with _signals_interrupt():
        try:
            robot.open()
            yield
        except BaseException as error:
            try:
                robot.stop()
            except WorkFailed as failure:
                found = *getattr(error, "findings", ()), *failure.findings
                raise WorkFailed(f"{_line(error)}; and {failure}", findings=found) from error
            raise
        else:
            robot.stop()
        finally:
            robot.close()


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
