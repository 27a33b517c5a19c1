"""Plant ``so101``: an arm of bus servos STS3215, such as the SO-100 and SO-101, or any other by its ids.

Joint readings are counts from the middle of the turn of each servo, in rad. Zeros and signs may be any:
calibration finds their meaning, and registers that change it are stored with a recording.

Source: Feetech, memory map of the STS3215.
"""

import math
import os
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from projservo_cli.findings import LIMITS, REFUSES, Finding, Subject, from_text
from projservo_cli.hardware.feetech import FeetechBus, PortLost, ServoSilent
from projservo_cli.messages import failed, sentence_and_remedy
from projservo_cli.messages.placeholders import servo_name
from projservo_cli.records import FloatArray, InputError, JointLimits, WorkFailed

TURN = 4096  # counts of a servo in a turn
MIDDLE = 2048  # count that is read as 0 rad
COUNT = 2.0 * math.pi / TURN  # rad
# Addresses of registers.
_MODEL, _LOWEST, _OFFSET, _TORQUE, _GOAL, _LOCK, _PRESENT = 3, 9, 31, 40, 42, 55, 56
_STS3215 = 777  # register 3
_MULTI_TURN = 0x10  # bit of register 18
_OFFSET_SIGN = 0x800  # bit of register 31
_OVERLOADED = 0x20  # bit of the status, until a servo gets another set-point
# Codes of the bits of the status of a servo.
_FAULTS = {
    0x01: "servo_supply",
    0x02: "servo_sensor",
    0x04: "servo_heat",
    0x08: "servo_current",
    _OVERLOADED: "servo_overload",
}
# Maximum speed of a joint turned by hand or servo, rad/s, and scatter of readings, rad; more is no
# reading.
_FASTEST, _SCATTER = math.radians(720.0), math.radians(1.0)
# Factor by which a servo may outrun set-points, so that it catches up; and speed limit of the gripper, rad/s.
_CATCHES_UP, _GRIPPER = 1.5, math.radians(60.0)
_GRIPS_S = 0.3  # after which a gripper has closed or opened, s
# Repetitions of a reading that cannot be true, or reports a fault.
_REPEATS = 4
# How far a joint may turn while its torque comes on, be beyond a limit, or lag at rest, rad.
_LEAP = math.radians(3.0)
_SWITCH_S = 0.1  # after which torque has come on


class _Measured(NamedTuple):
    """Measurements of one servo."""

    at: int  # counts
    volts: float
    heat: int  # °C
    status: int  # bits of its faults

    @property
    def angle(self) -> float:
        """Joint reading, rad."""
        return (self.at - MIDDLE) * COUNT


class Registers(NamedTuple):
    """Stored registers of a servo on which the meaning of its readings hangs."""

    lowest: int
    highest: int
    phase: int
    offset: int
    mode: int


class Servos:
    """The servos of an arm on a port: measurements, registers, torque, set-points.

    port : its name; ``auto`` for the only one on which all of them answer.
    ids : of the joints, base to tool; others : of further servos, such as a gripper.
    whole : whether all must answer; otherwise some may be lost.
    Raises InputError if the port cannot be opened, servos are missing, or are of another kind.
    """

    def __init__(
        self, port: str, ids: Sequence[int], others: Sequence[int] = (), *, whole: bool = True, **clock: Any
    ) -> None:
        self.ids, self.all = (*ids,), (*ids, *others)
        if len({*self.all}) < len(self.all) or not all(0 < i < 254 for i in self.all):
            raise InputError(f"plant.options: ids {[*self.all]} must be numbers from 1 to 253, each once")
        self.bus = FeetechBus(_port_of(self.all, **clock) if port == "auto" else port, **clock)
        self.lost: set[int] = set()  # servos that get no further writes
        try:
            found = {i: reply.values for i, reply in self._first(whole).items()}
        except BaseException:
            self.bus.close()
            raise
        self.volts = {i: (0.1 * values[12], 0.1 * values[11]) for i, values in found.items()}

    def _first(self, whole: bool) -> Mapping[int, Any]:
        """Read the first registers of all servos; an InputError for missing, double and other ones."""
        where = f"port {self.bus.port}:"
        try:
            replies = self.bus.read(self.alive, _MODEL, 13)
        except ServoSilent as error:
            there = [i for i in self.alive if i not in error.silent]
            if there and not whole:
                self.lost |= {*error.silent}
                return self._first(whole)
            if error.garbled and there:
                raise InputError(
                    f"{where} answers of servo {error.garbled[0]} are garbled, answers of {there} are not: "
                    "two servos have this id, or its cable is loose: look at it, or unplug one and set its id"
                ) from error
            if error.garbled:
                raise InputError(
                    f"{where} servos answer, but every reply is garbled: two arms share this bus, such as "
                    "leader and follower, or all servos have one id, or a cable is loose: unplug one arm, "
                    "set each id alone, or look at the cable"
                ) from error
            if there:
                raise InputError(
                    f"{where} servos {[*error.silent]} do not answer, {there} do: look at the cable to "
                    "the first of them, and at its id"
                ) from error
            raise InputError(
                f"{where} no servo answers: switch the supply on, look at the cable to the first servo, and "
                "whether this is the port of the arm"
            ) from error
        for i, reply in replies.items():
            if (model := _number(reply.values)) != _STS3215:
                raise InputError(f"{where} servo {i} is of model {model}, no STS3215 ({_STS3215})")
        return replies

    @property
    def alive(self) -> list[int]:
        """Numbers of servos that are written to."""
        return [i for i in self.all if i not in self.lost]

    def name(self, number: int) -> str:
        """Name of a servo by its joint, for messages."""
        return servo_name(self.subject(number))

    def subject(self, number: int) -> Subject:
        """Subject of findings on a servo."""
        joints = (self.ids.index(number) + 1,) if number in self.ids else ()
        return Subject(joints=joints, name=f"servo {number}")

    def measured(self) -> dict[int, _Measured]:
        """Return the measurements of each servo that is not lost."""
        replies = self.bus.read(self.alive, _PRESENT, 8, together=True).items()
        return {i: _Measured(_number(x), 0.1 * x[6], x[7], status) for i, (status, x) in replies}

    def registers(self) -> dict[int, Registers]:
        """Return the registers of each servo."""
        first, last = self.bus.read(self.all, _LOWEST, 10), self.bus.read(self.all, _OFFSET, 3)
        stored = {}
        for i in self.all:
            a, b = first[i].values, last[i].values
            stored[i] = Registers(_number(a), _number(a[2:]), a[9], _signed(_number(b)), b[2])
        return stored

    def torque(self) -> dict[int, bool]:
        """Whether each servo holds, by its number."""
        return {i: reply.values == b"\1" for i, reply in self.bus.read(self.alive, _TORQUE, 1).items()}

    def release(self, *, all_of_them: bool = False) -> None:
        """Release the joints, on request other servos too."""
        servos = [i for i in self.alive if all_of_them or i in self.ids]
        self.bus.store(_TORQUE, dict.fromkeys(servos, b"\0"))

    def send(self, counts: Mapping[int, int], speed: Mapping[int, int]) -> None:
        """Send set-points, counts, with the highest speed towards them, counts/s."""
        self.bus.write(_GOAL, _goals({i: x for i, x in counts.items() if i not in self.lost}, speed))

    def enable(self, counts: Mapping[int, int], speed: Mapping[int, int]) -> None:
        """Have servos hold their position, at these counts.

        The set-point is sent before torque comes on, since a servo else leaps to its last one.
        """
        self.bus.store(_GOAL, _goals(counts, speed))
        self.bus.store(_TORQUE, dict.fromkeys(counts, b"\1"))

    def shift(self, number: int, by: int) -> None:
        """Store an offset by which a servo reads ``by`` counts less; its torque must be off."""
        offset = max((self.registers()[number].offset + by + MIDDLE) % TURN - MIDDLE, 1 - MIDDLE)
        self.bus.store(_LOCK, {number: b"\0"})
        try:
            self.bus.store(_OFFSET, {number: _two(abs(offset) | (_OFFSET_SIGN if offset < 0 else 0))})
        finally:
            self.bus.store(_LOCK, {number: b"\1"})

    def failure(self, error: WorkFailed) -> Finding:
        """Tell which joints may fall if the bus fails; nothing more is written to them."""
        lost = from_text(str(error), REFUSES)
        if not isinstance(error, ServoSilent):
            return replace(lost, code="lost_port")
        silent = tuple(map(self.finding, error.silent))
        everything = {*error.silent} >= {*self.alive}
        self.lost |= {*error.silent}
        if error.garbled:
            return lost
        return Finding("silent_arm" if everything else "silent_servos", REFUSES, others=silent)

    def finding(self, number: int) -> Finding:
        """Return a part of a finding on several servos."""
        return Finding("servo", subject=self.subject(number))


class SO101:
    """An arm of bus servos, driven by the contract of robots; its images come from ``cameras``.

    port : of the arm, such as /dev/ttyACM0; ``auto`` takes the only one on which all servos answer.
    ids : of the servos of the joints, base to tool.
    gripper : servo of the gripper, which is held; None for an arm without.
    gripper_counts : its readings closed and open; None for the limits that its servo keeps.
    limits : of its joints, rad and rad/s; without them the arm does not move.
    """

    now = staticmethod(time.monotonic)  # its clock, s
    sleep = staticmethod(time.sleep)
    _servos: Servos
    _lease: "_Lease"

    def __init__(
        self,
        port: str = "auto",
        ids: Sequence[int] = (1, 2, 3, 4, 5),
        gripper: int | None = 6,
        limits: JointLimits | None = None,
        gripper_counts: Sequence[int] | None = None,
    ) -> None:
        numbers = () if isinstance(ids, str) or not np.iterable(ids) else tuple(ids)
        if not numbers or not all(isinstance(i, int) for i in numbers):
            raise InputError(f"plant.options.ids {ids!r}: give the ids of the servos, such as [1, 2, 3]")
        if gripper is not None and not isinstance(gripper, int):
            raise InputError(f"plant.options.gripper {gripper!r}: give the id of its servo, or null")
        ends = None if gripper_counts is None else tuple(gripper_counts)
        if ends is not None and not (len(ends) == 2 and all(isinstance(x, int) for x in ends)):
            raise InputError(f"plant.options.gripper_counts {ends!r}: give two counts, closed and open")
        if ends is not None and not (0 <= min(ends) < max(ends) < TURN):
            raise InputError(f"plant.options.gripper_counts {ends!r}: give two counts from 0 to {TURN - 1}")
        self._gripper_counts = ends
        self._grip: tuple[int, float] | None = None  # where it was sent last, counts and share
        self._port, self._ids = port, numbers
        self._others = () if gripper is None else (gripper,)
        known = limits is not None and bool(np.isfinite([limits.lower, limits.upper]).all())
        self._limits = limits if known else None
        self._opened = self._on = self._released = False
        self._before: dict[int, _Measured] = {}  # the last reading
        self._read_at, self._agreed = -math.inf, False  # when that was, and whether a second one agreed
        self._sent: dict[int, int] = {}  # set-points, counts
        self.registers: dict[int, Registers] = {}

    def connect(self, *, whole: bool = True) -> Servos:
        """Connect to the servos, which no other process may have; ``whole`` if all must answer."""
        self._servos = Servos(
            self._port, self._ids, self._others, whole=whole, now=self.now, sleep=self.sleep
        )
        try:
            self._lease = _Lease(self._servos.bus.port)
        except BaseException:
            self._servos.bus.close()
            raise
        if self._lease.before:
            _say(
                f"process {self._lease.before} was ended while it moved this arm: servos went on to their "
                "last set-points; going on from the present position"
            )
        return self._servos

    def open(self) -> None:
        """Connect to the servos, and refuse servos that would not reach their set-points."""
        self.connect()
        self._opened = True
        self.registers = self._servos.registers()
        for i in self._ids:
            self._require_fit(i, self.registers[i])
        self._read()

    def identity(self) -> str:
        """Registers on which the meaning of readings hangs: a recording holds as long as they do."""
        return ";".join(
            f"servo{i}:{registers.lowest}..{registers.highest}/phase{registers.phase}/offset{registers.offset}/mode{registers.mode}"
            for i, registers in ((i, self.registers[i]) for i in self._ids)
        )

    def health(self) -> dict[str, float | str]:
        """Return the voltage and temperature of the servo that is worst off."""
        servos = self._read().values()
        volts = min(servo.volts for servo in servos)
        return {"supply_v": round(volts, 1), "hottest_c": max(servo.heat for servo in servos)}

    def joints(self) -> tuple[FloatArray, float]:
        """Joint readings (n,), rad, and when they were read, s."""
        servos = self._read()
        return np.array([servos[i].angle for i in self._ids]), self._servos.bus.read_at

    def command(self, target: FloatArray, speed: FloatArray, due: float) -> None:
        """Send the set-points; at the first, torque comes on. A released arm is sent nothing."""
        if self._released:
            return
        if not self._on:
            self.hold()
        counts = {i: round(MIDDLE + float(q) / COUNT) for i, q in zip(self._ids, target, strict=True)}
        for i, count in counts.items():
            low_count, high_count = self._keeps(i)
            if not low_count <= count <= high_count:
                kept = (Finding("range", amount=low_count, limit=high_count, unit="1"),)
                raise self._failed("set_point_beyond", i, count, unit="1", others=kept)
        self._servos.send(counts, self._speeds())
        self._sent |= counts

    def hold(self) -> None:
        """Hold the arm in its position; a gripper that holds keeps its grip."""
        self._require_limits()
        self._lease.moving()
        grips = {i for i, on in self._servos.torque().items() if on and i in self._others}
        self._sent = {i: servo.at for i, servo in self._read().items() if i not in grips}
        self._servos.enable(self._sent, self._speeds())
        self._on, self._released = True, False
        self.sleep(_SWITCH_S)
        there = self._read()
        for i, sent in self._sent.items():
            turned = abs(there[i].at - sent) * COUNT
            if turned > _LEAP:
                raise self._failed("torque_leap", i, turned, limit=_LEAP, unit="rad")

    def _failed(self, code: str, number: int, amount: float, **more: Any) -> WorkFailed:
        return failed([Finding(code, REFUSES, self._servos.subject(number), amount, **more)])

    def act(self, name: str, value: float) -> float:
        """Open the gripper by a share, from 0, closed, to 1, and return how long that takes, s.

        It keeps pushing on the object between its jaws, also when the arm is stopped or released.
        """
        if name != "gripper" or not self._others:
            raise InputError(f"the arm has no {name}: give gripper, and its servo in plant.options.gripper")
        if not 0.0 <= value <= 1.0:
            raise InputError(f"gripper {value:g}: give a share, from 0, closed, to 1, open")
        (i,) = self._others
        closed, opened = self._gripper_counts or self._keeps(i)
        if self._gripper_counts is None and opened - closed >= TURN - 1:
            raise InputError(
                f"gripper (servo {i}): how far it opens is not stored (registers 9 and 11): set "
                "plant.options.gripper_counts to its readings closed and open"
            )
        count = round(closed + value * (opened - closed))
        travel = abs(count - self._read()[i].at) * COUNT
        self._sent.pop(i, None)
        self._servos.enable({i: count}, self._speeds())
        self._grip = count, value
        return travel / _GRIPPER + _GRIPS_S

    def holding(self, name: str) -> bool | None:
        """Whether something keeps the gripper from where it was sent; None if it was not closed fully."""
        if name != "gripper" or not self._others or self._grip is None:
            return None
        (i,) = self._others
        away = abs(self._read()[i].at - self._grip[0]) * COUNT
        return True if away > _LEAP else False if self._grip[1] == 0.0 else None

    def release(self) -> None:
        """Let go of the arm; the gripper stays as it is."""
        self._released, self._on = True, False
        self._servos.release()

    def stop(self) -> None:
        """Come to rest: joints that are on their way are sent where they are."""
        if not self._on:
            return
        failure = WorkFailed("")
        for _ in self._servos.all:  # a servo that fails is left out of the next reading
            try:
                there = {i: servo.at for i, servo in self._read().items()}
                sent = {i: at for i, at in self._sent.items() if i in there}
                moving = {i: there[i] for i, at in sent.items() if abs(there[i] - at) * COUNT > _LEAP}
                self._servos.send(moving, self._speeds())
                return
            except WorkFailed as error:
                failure = error
        raise failure

    def close(self) -> None:
        """Release the port, and report whether the arm holds."""
        if self._opened:
            self._opened = False
            torque, all_answer = torque_reported(self._servos)
            _say(sentence_and_remedy(torque))
            self._servos.bus.close()
            self._lease.end(moves=self._on and not all_answer)

    def _keeps(self, number: int) -> tuple[int, int]:
        """Least and most counts that a servo goes to; over 4095 it goes the long way round."""
        return self.registers[number].lowest, min(self.registers[number].highest, TURN - 1)

    def _speeds(self) -> dict[int, int]:
        """Highest speed of each servo, counts/s, never 0, which means full speed."""
        rates = dict.fromkeys(self._servos.all, _GRIPPER)
        if self._limits is not None:
            rates |= zip(self._ids, np.minimum(_CATCHES_UP * self._limits.speed, _FASTEST), strict=True)
        return {i: max(1, math.ceil(rate / COUNT)) for i, rate in rates.items()}

    def _require_limits(self) -> None:
        """Refuse to move an arm without limits, or one beyond them."""
        if self._limits is None:
            raise InputError("nothing was moved: the arm has no limits: projservo limits -c FILE finds them")
        servos = self._read()
        for i, low, high in zip(self._ids, self._limits.lower, self._limits.upper, strict=True):
            q = servos[i].angle
            if max(low - q, q - high) > _LEAP:
                limits = (Finding("range", amount=float(low), limit=float(high), unit="rad"),)
                raise self._failed("stands_beyond", i, q, unit="rad", others=limits)

    def _require_fit(self, number: int, stored: Registers) -> None:
        """Refuse a servo whose joint would miss its set-points, with an InputError."""
        name = self._servos.name(number)
        if stored.mode != 0:
            raise InputError(
                f"{name}: its mode (register 33) is {stored.mode}: set 0, position, by the tool of its maker"
            )
        if stored.phase & _MULTI_TURN:
            wanted = stored.phase & ~_MULTI_TURN
            raise InputError(f"{name}: it counts several turns (register 18 is {stored.phase}): set {wanted}")
        if self._limits is None:
            return
        k, (low_count, high_count) = self._ids.index(number), self._keeps(number)
        low, high = self._limits.lower[k], self._limits.upper[k]
        if not low_count <= round(MIDDLE + low / COUNT) < round(MIDDLE + high / COUNT) <= high_count:
            kept = " to ".join(_deg((x - MIDDLE) * COUNT) for x in (low_count, high_count))
            raise InputError(
                f"{name}: its limits, {_deg(low)} to {_deg(high)}, go beyond those that it keeps itself, "
                f"{kept} (registers 9 and 11): run projservo limits again"
            )

    def _read(self) -> dict[int, _Measured]:
        """Return the measurements of all servos; repeat an impossible reading, or one with a fault.

        The first one counts if a second agrees with it.
        """
        servos, wrong = dict[int, _Measured](), list[Finding]()
        for _ in range(_REPEATS):
            try:
                servos = self._servos.measured()
            except (ServoSilent, PortLost) as error:
                raise failed([self._servos.failure(error)]) from error
            now = self.now()
            wrong = [*self._leapt(servos, now - self._read_at), *self._faulty(servos)][:1]
            agreed = not wrong and bool(self._before)
            if agreed or not self._agreed:
                self._before, self._read_at, self._agreed = servos, now, agreed
            if agreed:
                return servos
        self._servos.lost |= {i for i, servo in servos.items() if servo.status}
        raise failed(wrong)

    def _leapt(self, servos: Mapping[int, _Measured], seconds: float) -> Iterator[Finding]:
        """Yield the joints whose reading is impossible since the last one."""
        high_count = _FASTEST * seconds + _SCATTER
        if self._on and self._limits is not None:
            fastest = 2.0 * _CATCHES_UP * max(_GRIPPER, float(self._limits.speed.max()))
            high_count = min(_FASTEST, fastest) * seconds + _SCATTER
        for i, servo in servos.items():
            before = self._before.get(i)
            if servo.at >= TURN or (before is not None and abs(servo.at - before.at) * COUNT > high_count):
                last = () if before is None else (Finding("last", amount=before.angle, unit="rad"),)
                subject = self._servos.subject(i)
                yield Finding("impossible_reading", REFUSES, subject, servo.angle, unit="rad", others=last)

    def _faulty(self, servos: Mapping[int, _Measured]) -> Iterator[Finding]:
        """Yield the faults that servos report."""
        for i, servo in servos.items():
            amounts = {"servo_supply": (servo.volts, "V"), "servo_heat": (servo.heat, "°C")}
            low_count, high_count = self._servos.volts[i]
            supply = (Finding("range", amount=low_count, limit=high_count, unit="V"),)
            for bit, code in _FAULTS.items():
                # The first set-point ends an overload of before.
                pushes = bit == _OVERLOADED and (i in self._others or not self._on)  # as a grip does
                if servo.status & bit and not pushes:
                    amount, unit = amounts.get(code, (math.nan, ""))
                    subject = self._servos.subject(i)
                    yield Finding(code, REFUSES, subject, amount, unit=unit, others=supply)


@contextmanager
def connected(arm: SO101, *, whole: bool = True) -> Iterator[Servos]:
    """Connect to the servos of an arm alone, which is not driven; ``whole`` if all must answer."""
    servos = arm.connect(whole=whole)
    try:
        yield servos
    finally:
        servos.bus.close()
        arm._lease.end()


def torque_reported(servos: Servos) -> tuple[Finding, bool]:
    """Report whether torque is on, at the end of work with an arm, and whether that is known."""
    try:
        on = servos.torque()
    except (ServoSilent, PortLost):
        return Finding("torque_unknown", LIMITS), False
    holding, all_answer = [i for i in servos.ids if on.get(i)], not servos.lost
    if not holding:
        return Finding("torque_off"), all_answer
    if len(holding) < len(servos.ids):
        return Finding("torque_in_part", LIMITS, others=tuple(map(servos.finding, holding))), all_answer
    return Finding("torque_on"), all_answer


class _Lease:
    """The port of an arm, which one process has; and a note that outlives it if it ends in motion.

    ``before``: number of a process that was ended while it moved the arm; empty for none.
    """

    def __init__(self, port: str) -> None:
        from filelock import FileLock, Timeout

        name = "projservo" + str(Path(port).resolve()).replace(os.sep, "-")
        self._note = Path(tempfile.gettempdir(), f"{name}.moving")
        self._lock = FileLock(self._note.with_suffix(".lock"), timeout=0)
        try:
            self._lock.acquire()
        except Timeout as error:
            raise InputError(f"port {port}: another projservo drives this arm: wait for its end") from error
        except PermissionError as error:
            raise self._of_another(Path(self._lock.lock_file), error) from error
        self.before = ""
        with suppress(OSError):
            self.before = self._note.read_text(encoding="ascii").strip()

    @staticmethod
    def _of_another(file: Path, error: PermissionError) -> InputError:
        return InputError(
            f"{file}: {error.strerror or error}: another user, such as root, drove this arm: remove the file"
        )

    def moving(self) -> None:
        """Note that this process moves the arm."""
        try:
            self._note.write_text(f"{os.getpid()}\n", encoding="ascii")
        except PermissionError as error:
            raise self._of_another(self._note, error) from error

    def end(self, *, moves: bool = False) -> None:
        """End the lease, and the note, except where the arm may still move."""
        if not moves:
            with suppress(OSError):
                self._note.unlink(missing_ok=True)
        self._lock.release()


def _port_of(ids: Sequence[int], **clock: Any) -> str:
    """Return the only port on which all servos answer; an InputError lists the ports, each with its obstacle.

    A single port is taken: errors of its servos are found later.
    """
    ports, fitting, obstacles = candidate_ports(), [], []
    if len(ports) == 1:
        return ports[0]
    for port in ports:
        try:
            bus = FeetechBus(port, **clock)
        except InputError as error:
            obstacles.append(str(error))
            continue
        try:
            bus.read(ids, _MODEL, 2)
            fitting.append(port)
        except WorkFailed as error:
            obstacles.append(f"port {port}: {error}")
        finally:
            bus.close()
    if len(fitting) == 1:
        return fitting[0]
    remedy = "set plant.options.port"
    if fitting:
        raise InputError(
            f"arms answer on {' and '.join(fitting)}: one may be the leader: {remedy} to the other"
        )
    if ports:
        raise InputError(
            f"servos {[*ids]} all answer on none of {len(ports)} ports: switch the supply on, or {remedy} to "
            f"the port of the arm; {'; '.join(obstacles)}"
        )
    raise InputError(f"there is no serial port on USB: plug the arm in, or {remedy}")


def candidate_ports() -> list[str]:
    """Return serial ports that may be an arm's."""
    try:
        from serial.tools import list_ports
    except ImportError as error:
        raise InputError("pyserial is missing: pip install '.[so101]'") from error
    return sorted(port.device for port in list_ports.comports() if port.vid is not None)


def _say(what: str) -> None:
    print(f"so101: {what}", file=sys.stderr)


def _deg(angle: float) -> str:
    return f"{math.degrees(angle):.1f}°"


def _goals(counts: Mapping[int, int], speed: Mapping[int, int]) -> dict[int, bytes]:
    """Values of registers 42 to 47: set-point, time, which is of another mode, and speed."""
    return {i: _two(count) + _two(0) + _two(speed[i]) for i, count in counts.items()}


def _number(values: bytes) -> int:
    """Number in the first two of some bytes."""
    return int.from_bytes(values[:2], "little")


def _two(number: int) -> bytes:
    return number.to_bytes(2, "little")


def _signed(offset: int) -> int:
    """Offset of register 31, of which bit 11 is the sign."""
    return -(offset & (_OFFSET_SIGN - 1)) if offset & _OFFSET_SIGN else offset
