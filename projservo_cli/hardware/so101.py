"""Plant ``so101``: an arm of bus servos STS3215, such as the SO-100 and SO-101, or any other by its ids.

Joint readings are counts from the middle of the turn of each servo, in rad. Zeros and signs may be any:
calibration finds what they mean, and registers that change it are stored with a recording.

Source: Feetech, memory map of the STS3215.
"""

import math
import os
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from projservo_cli.hardware.feetech import FeetechBus, PortLost, ServoSilent
from projservo_cli.records import FloatArray, InputError, JointLimits, WorkFailed

TURN = 4096  # counts of a servo in a turn
MIDDLE = 2048  # count that is read as 0 rad
COUNT = 2.0 * math.pi / TURN  # rad

# Registers, and how many bytes each takes.
_MODEL, _LOWEST, _HIGHEST, _VOLTS, _PHASE = (3, 2), (9, 2), (11, 2), (14, 2), (18, 1)
_OFFSET, _MODE, _TORQUE, _GOAL, _LOCK, _PRESENT = (31, 2), (33, 1), (40, 1), (42, 6), (55, 1), (56, 8)
_STS3215 = 777  # register 3
_MULTI_TURN = 0x10  # bit of register 18
_OFFSET_SIGN = 0x800  # bit of register 31
# What each bit of the status of a servo says, with what becomes of the joint and the remedy.
_WRONG = {
    0x01: "its supply has {volts:.1f} V ({least:.1f} to {most:.1f} V): look at the supply",
    0x02: "its angle sensor fails: replace it",
    0x04: "it is too hot, {heat} °C: let it cool",
    0x08: "its current is too high: free what holds it",
    0x20: "it is overloaded and pushes with a fifth of its torque: free what it presses against, or lighten it",
}
# Fastest that somebody moves a joint by hand, or a servo turns, rad/s; more is no reading.
_FASTEST = math.radians(720.0)
# By how much a joint outruns its speed limit, and what readings scatter, rad.
_OUTRUNS, _SCATTER = 1.5, math.radians(1.0)
# How often a reading is repeated that cannot be true, or tells of a fault.
_REPEATS = 4
# How far a joint may turn while its torque is switched on, rad, and after how long it is read back, s.
_LEAP, _SWITCH_S = math.radians(3.0), 0.1
_STANDS = math.radians(2.0)  # how far short a joint may stay that stands, rad


class Measured(NamedTuple):
    """What one servo measures."""

    count: int
    volts: float
    heat: int  # °C
    status: int  # bits of what is wrong

    @property
    def angle(self) -> float:
        """Joint reading, rad."""
        return (self.count - MIDDLE) * COUNT


class Registers(NamedTuple):
    """Stored registers of a servo on which the meaning of its readings hangs."""

    lowest: int
    highest: int
    phase: int
    offset: int
    mode: int


class Servos:
    """The servos of an arm on a port: what they measure and store, torque, set-points.

    port : its name; ``auto`` for the only one on which all of them answer.
    ids : of the joints, base to tool; others : of further servos, such as a gripper.
    Raises InputError where the port cannot be opened, servos are missing, or are of another kind.
    """

    def __init__(self, port: str, ids: Sequence[int], others: Sequence[int] = (), **clock: Any) -> None:
        self.ids, self.all = (*ids,), (*ids, *others)
        if len({*self.all}) < len(self.all) or not all(0 < i < 254 for i in self.all):
            raise InputError(f"plant.options: ids {[*self.all]} must be numbers from 1 to 253, each once")
        self.bus = FeetechBus(_found(self.all, **clock) if port == "auto" else port, **clock)
        self.lost: set[int] = set()  # that nothing is written to any more
        try:
            self._require_all()
            found = self.bus.read(self.all, 3, 13)
        except BaseException:
            self.bus.close()
            raise
        self.volts = {i: (0.1 * reply.values[12], 0.1 * reply.values[11]) for i, reply in found.items()}
        for i, reply in found.items():
            if (model := _number(reply.values[:2])) != _STS3215:
                self.bus.close()
                raise InputError(
                    f"servo {i} on {self.bus.port} is of model {model}, not an STS3215 ({_STS3215})"
                )

    def name(self, number: int) -> str:
        """Name of a servo by its joint, for messages."""
        return (
            f"joint {self.ids.index(number) + 1} (servo {number})"
            if number in self.ids
            else f"servo {number}"
        )

    def _require_all(self) -> None:
        """Refuse a bus on which servos are missing or two have one number."""
        try:
            self.bus.read(self.all, 5, 1)
        except ServoSilent as error:
            there = [i for i in self.all if i not in error.silent]
            if error.garbled:
                raise InputError(
                    f"port {self.bus.port}: answers of servo {error.garbled[0]} are garbled, those of "
                    f"{there or 'no other'} are not: two servos have this number. Unplug one, and set its id"
                ) from error
            if there:
                raise InputError(
                    f"port {self.bus.port}: servos {[*error.silent]} do not answer, {there} do: look at the "
                    "cable to the first of them, and at its id"
                ) from error
            raise InputError(
                f"port {self.bus.port}: no servo answers: switch the supply on, look at the cable to the "
                "first servo, and whether this is the port of the arm"
            ) from error

    def measured(self) -> dict[int, Measured]:
        """Return what each servo measures that is not lost."""
        found = self.bus.read([i for i in self.all if i not in self.lost], *_PRESENT)
        return {
            i: Measured(_number(v[:2]), 0.1 * v[6], v[7], reply.status)
            for i, reply in found.items()
            if (v := reply.values)
        }

    def registers(self) -> dict[int, Registers]:
        """Return what is stored in each servo."""
        first, last = self.bus.read(self.all, 9, 10), self.bus.read(self.all, 31, 3)
        return {
            i: Registers(_number(a[:2]), _number(a[2:4]), a[9], _signed(_number(b[:2])), b[2])
            for i in self.all
            if (a := first[i].values) and (b := last[i].values)
        }

    def torque(self) -> dict[int, bool]:
        """Whether each servo holds, by its number."""
        found = self.bus.read([i for i in self.all if i not in self.lost], *_TORQUE)
        return {i: reply.values[0] == 1 for i, reply in found.items()}

    def release(self) -> None:
        """Let go of the joints; other servos go on as they do."""
        self.bus.store(_TORQUE[0], {i: b"\0" for i in self.ids if i not in self.lost})

    def send(self, counts: Mapping[int, int], speed: Mapping[int, int]) -> None:
        """Send set-points, counts, with the highest speed towards them, counts/s, at least 1."""
        rows = {i: _bytes(count) + b"\0\0" + _bytes(max(1, speed[i])) for i, count in counts.items()}
        self.bus.write(_GOAL[0], {i: row for i, row in rows.items() if i not in self.lost})

    def enable(self, speed: Mapping[int, int]) -> dict[int, int]:
        """Have all servos hold where they stand, and return these counts.

        The set-point is the reading before torque comes on, since a servo else leaps to its last one.
        Raises WorkFailed where a servo does not hold, or leaps.
        """
        before = {i: one.count for i, one in self.measured().items()}
        self.bus.store(
            _GOAL[0], {i: _bytes(c) + b"\0\0" + _bytes(max(1, speed[i])) for i, c in before.items()}
        )
        self.bus.store(_TORQUE[0], dict.fromkeys(before, b"\1"))
        self.bus.sleep(_SWITCH_S)
        for i, one in self.measured().items():
            if abs(one.count - before[i]) * COUNT > _LEAP:
                raise WorkFailed(
                    f"{self.name(i)} turned by {math.degrees(abs(one.count - before[i]) * COUNT):.1f}° when its "
                    f"torque came on ({math.degrees(_LEAP):g}° at most): look what pulls at it"
                )
        return before

    def shift(self, number: int, by: int) -> None:
        """Store an offset by which a servo reads so many counts less; its torque must be off."""
        offset = (self.registers()[number].offset + by + MIDDLE) % TURN - MIDDLE
        written = max(offset, 1 - MIDDLE)
        self.bus.store(_LOCK[0], {number: b"\0"})
        self.bus.store(_OFFSET[0], {number: _bytes(abs(written) | (_OFFSET_SIGN if written < 0 else 0))})
        self.bus.store(_LOCK[0], {number: b"\1"})


class SO101:
    """An arm of bus servos, driven by the contract of robots; its images are those of ``cameras``.

    port : of the arm, such as /dev/ttyACM0; ``auto`` takes the only one on which all servos answer.
    ids : of the servos of the joints, base to tool. gripper : that of the gripper, which is held; None for
        an arm without.
    limits : of its joints, rad; without, nothing is moved.
    """

    now = staticmethod(time.monotonic)  # its clock, s
    sleep = staticmethod(time.sleep)

    def __init__(
        self,
        port: str = "auto",
        ids: Sequence[int] = (1, 2, 3, 4, 5),
        gripper: int | None = 6,
        limits: JointLimits | None = None,
    ) -> None:
        self._port, self._ids, self._gripper = port, tuple(ids), gripper
        self._limits = (
            limits if limits is not None and np.isfinite(limits.lower + limits.upper).all() else None
        )
        self._servos: Servos | None = None
        self._lease: _Lease | None = None
        self._on = self._released = False
        self._before: dict[int, Measured] = {}
        self._read_at, self._agreed = -math.inf, False
        self._sent: dict[int, int] = {}
        self.registers: dict[int, Registers] = {}

    def open(self) -> None:
        """Connect to the servos, and refuse those with which the arm would not stand where it is sent."""
        others = () if self._gripper is None else (self._gripper,)
        self._servos = servos = Servos(self._port, self._ids, others, now=self.now, sleep=self.sleep)
        self._lease = _Lease(servos.bus.port)
        self.registers = servos.registers()
        for i in self._ids:
            if wrong := self._unfit(i, self.registers[i]):
                raise InputError(f"{servos.name(i)}: {wrong}")
        self._read()
        if killed := self._lease.killed:
            _say(
                f"process {killed}, which moved this arm, was ended amid its work: servos went on to their last "
                "set-points; going on from where the arm stands"
            )

    def identity(self) -> str:
        """Registers on which the meaning of readings hangs: a recording holds as long as they do."""
        return ";".join(f"{i}:" + "/".join(map(str, self.registers[i])) for i in self._ids)

    def joints(self) -> tuple[FloatArray, float]:
        """Joint readings (n,), rad, and when they were read, s."""
        before = self.now()
        found = self._read()
        return np.array([found[i].angle for i in self._ids]), 0.5 * (before + self.now())

    def command(self, target: FloatArray, speed: FloatArray, due: float) -> None:
        """Send the set-points; at the first, torque comes on. A released arm is sent nothing."""
        if self._released:
            return
        if not self._on:
            self.hold()
        counts = {i: round(MIDDLE + float(q) / COUNT) for i, q in zip(self._ids, target, strict=True)}
        for i, count in counts.items():
            low, high = self.registers[i].lowest, min(self.registers[i].highest, TURN - 1)
            if not low <= count <= high:
                raise WorkFailed(
                    f"{self._arm.name(i)}: count {count} is beyond what it keeps, {low} to {high}"
                )
        self._arm.send(counts, self._speeds())
        self._sent |= counts

    def hold(self) -> None:
        """Hold the arm where it stands."""
        self._require_limits()
        self._sent = self._arm.enable(self._speeds())
        self._on, self._released = True, False
        if self._lease is not None:
            self._lease.moving()

    def release(self) -> None:
        """Let go of the arm; the gripper stays as it is."""
        self._released, self._on = True, False
        self._arm.release()

    def stop(self) -> None:
        """Come to rest: joints that are on their way are sent where they are."""
        if not self._on or self._servos is None:
            return
        try:
            there = self._servos.measured()
            moving = {
                i: one.count for i, one in there.items() if abs(one.count - self._sent[i]) * COUNT > _STANDS
            }
            if moving:
                self._servos.send(moving, self._speeds())
        except (ServoSilent, PortLost) as error:
            raise WorkFailed(
                f"{self._told(error)}; servos that have power go on to their last set-points"
            ) from error

    def close(self) -> None:
        """Let go of the port; the arm goes on holding, or not, which is said."""
        servos, self._servos = self._servos, None
        if servos is None:
            return
        _say(torque_told(servos))
        servos.bus.close()
        if self._lease is not None:
            self._lease.end()

    @property
    def _arm(self) -> Servos:
        if self._servos is None:
            raise WorkFailed("the arm is not open")
        return self._servos

    def _speeds(self) -> dict[int, int]:
        """Highest speed of each servo, counts/s: above that of set-points, so that it catches up."""
        limits = self._limits
        fast = np.full(len(self._ids), math.radians(60.0)) if limits is None else limits.speed
        rates = dict(zip(self._ids, np.minimum(_OUTRUNS * fast, _FASTEST), strict=True))
        return {i: max(1, math.ceil(rates.get(i, math.radians(60.0)) / COUNT)) for i in self._arm.all}

    def _require_limits(self) -> None:
        """Refuse to move an arm without limits, or one that stands far beyond them."""
        if self._limits is None:
            raise InputError("nothing was moved: the arm has no limits: projservo limits -c FILE finds them")
        found, low, high = self._read(), self._limits.lower, self._limits.upper
        for k, i in enumerate(self._ids):
            q, least, most = (math.degrees(x) for x in (found[i].angle, low[k], high[k]))
            beyond = max(least - q, q - most)
            if beyond > math.degrees(_LEAP):
                raise WorkFailed(
                    f"nothing was moved: {self._arm.name(i)} stands at {q:.1f}°, {beyond:.1f}° beyond its limits "
                    f"{least:.1f}° to {most:.1f}°: move it there by hand; where all joints read otherwise, this "
                    "is another arm (the leader's port?), or was homed since: projservo limits"
                )

    def _unfit(self, number: int, stored: Registers) -> str:
        """Why a joint would not stand where it is sent, with the remedy; empty where it does."""
        if stored.mode != 0:
            return f"its mode (register 33) is {stored.mode}: set 0, position, with the tool of its maker"
        if stored.phase & _MULTI_TURN:
            return f"register 18 is {stored.phase}, with multi-turn on: clear bit 4 ({stored.phase & ~_MULTI_TURN})"
        if self._limits is not None:
            k = self._ids.index(number)
            low, high = (round(MIDDLE + x[k] / COUNT) for x in (self._limits.lower, self._limits.upper))
            least, most = max(stored.lowest, 0), min(stored.highest, TURN - 1)
            if not least <= low < high <= most:
                limits = [math.degrees((x - MIDDLE) * COUNT) for x in (low, high, least, most)]
                return (
                    "its limits, {:.1f}° to {:.1f}°, go beyond what it keeps, {:.1f}° to {:.1f}° (registers 9 "
                    "and 11): run projservo limits again"
                ).format(*limits)
        return ""

    def _read(self) -> dict[int, Measured]:
        """What all servos measure; a reading that cannot be true, or tells of a fault, is repeated.

        The first one counts where a second agrees with it.
        """
        for _ in range(_REPEATS):
            try:
                found = self._arm.measured()
            except (ServoSilent, PortLost) as error:
                raise WorkFailed(self._told(error)) from error
            now, agreed = self.now(), self._agreed
            told = self._leapt(found, now - self._read_at) or self._faulty(found)
            if not told or not agreed:
                self._before, self._read_at, self._agreed = found, now, not told and bool(self._before)
            if not told and self._agreed:
                return found
        self._arm.lost |= {i for i, one in found.items() if one.status}
        raise WorkFailed(told or "the servos give no reading twice")

    def _leapt(self, found: Mapping[int, Measured], seconds: float) -> str:
        """Which joint reads what it cannot have turned to since the last reading; empty for none."""
        for i, one in found.items():
            before = self._before.get(i)
            if one.count >= TURN:
                return f"{self._arm.name(i)} reads {one.count} counts, more than a turn"
            if before is None:
                continue
            fastest = _FASTEST
            if self._on and self._limits is not None and i in self._ids:
                fastest = min(fastest, 2.0 * _OUTRUNS * float(self._limits.speed[self._ids.index(i)]))
            most = fastest * seconds + _SCATTER
            if abs(one.count - before.count) * COUNT > most:
                return (
                    f"{self._arm.name(i)} reads {math.degrees(one.angle):.1f}°, and {1000 * seconds:.0f} ms before "
                    f"{math.degrees(before.angle):.1f}° ({math.degrees(most):.1f}° at most): look at its gear "
                    "and its cable"
                )
        return ""

    def _faulty(self, found: Mapping[int, Measured]) -> str:
        """Which servo says that something is wrong with it, with the remedy; empty for none."""
        for i, one in found.items():
            for bit, told in _WRONG.items():
                if one.status & bit:
                    least, most = self._arm.volts[i]
                    what = told.format(volts=one.volts, heat=one.heat, least=least, most=most)
                    return f"{self._arm.name(i)}: {what}; nothing more is written to it, and it may sink"
        return ""

    def _told(self, error: WorkFailed) -> str:
        """What a bus that fails means for the arm."""
        if not isinstance(error, ServoSilent):
            return f"{error}; servos hold their last set-points as long as they have power"
        self._arm.lost |= {*error.silent}
        if {*error.silent} >= {*self._arm.all}:
            return "no servo answers any more: look at the supply and its cable; all joints may fall: hold the arm"
        names = ", ".join(map(self._arm.name, error.silent))
        return f"{names}: no answer any more: look at the cable to it; it may fall, with what it carries"


def torque_told(servos: Servos) -> str:
    """Whether torque is on, in words, at the end of whatever was done with an arm."""
    try:
        on = servos.torque()
    except (ServoSilent, PortLost):
        return "whether torque is on is not known, since servos do not answer: hold the arm"
    holding = [i for i in servos.ids if on.get(i)]
    if not holding:
        return "torque is off: nothing holds the arm"
    if len(holding) < len(servos.ids):
        return f"torque is on in {', '.join(map(servos.name, holding))} alone: hold the arm"
    return "torque is on: the arm holds where it is; projservo release lets go of it"


class _Lease:
    """The port of an arm, which one process has; and a note that outlives it where it is killed.

    ``killed``: number of a process that was ended while it moved the arm; empty for none.
    """

    def __init__(self, port: str) -> None:
        from filelock import FileLock, Timeout

        stem = Path(tempfile.gettempdir(), "projservo" + str(Path(port).resolve()).replace("/", "-"))
        self._note, self._lock = stem.with_suffix(".moving"), FileLock(stem.with_suffix(".lock"), timeout=0)
        try:
            self._lock.acquire()
        except Timeout as error:
            raise InputError(f"port {port}: another projservo drives this arm: wait for its end") from error
        self.killed = ""
        with suppress(OSError):
            self.killed = self._note.read_text(encoding="ascii").strip()

    def moving(self) -> None:
        """Note that this process moves the arm."""
        self._note.write_text(f"{os.getpid()}\n", encoding="ascii")

    def end(self) -> None:
        """Forget it."""
        self._note.unlink(missing_ok=True)
        self._lock.release()


def _found(ids: Sequence[int], **clock: Any) -> str:
    """Return the only port on which all servos answer; an InputError lists what there is."""
    ports, fitting = candidate_ports(), []
    for port in ports:
        with suppress(InputError, WorkFailed):
            bus = FeetechBus(port, **clock)
            try:
                bus.read(ids, 5, 1)
                fitting.append(port)
            finally:
                bus.close()
    if len(fitting) == 1:
        return fitting[0]
    if fitting:
        raise InputError(
            f"arms answer on {' and '.join(fitting)}: one may be the leader: set plant.options.port to that of "
            "the arm that is to move"
        )
    if ports:
        raise InputError(
            f"on none of {', '.join(ports)} servos {[*ids]} answer: switch the supply on; projservo doctor, or "
            "plant.options.port with the port of the arm, says more"
        )
    raise InputError("there is no serial port: plug the arm in, or set plant.options.port")


def candidate_ports() -> list[str]:
    """Return serial ports that may be an arm's."""
    try:
        from serial.tools import list_ports
    except ImportError as error:
        raise InputError("pyserial is missing: pip install '.[so101]'") from error
    return sorted(port.device for port in list_ports.comports() if port.vid is not None)


def _say(what: str) -> None:
    print(f"so101: {what}", file=sys.stderr)


def _number(two: bytes) -> int:
    return int.from_bytes(two, "little")


def _bytes(number: int) -> bytes:
    return number.to_bytes(2, "little")


def _signed(offset: int) -> int:
    """Offset of register 31, whose bit 11 is the sign."""
    return -(offset & (_OFFSET_SIGN - 1)) if offset & _OFFSET_SIGN else offset
