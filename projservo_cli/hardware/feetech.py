"""Bus of serial servos by Feetech (STS and SMS series), protocol 0: requests, replies, retries.

A reply names neither its request nor its time. So the input is cleared before each request, and after one
that came to nothing the next ones read another number of bytes: a late reply has a wrong length.

Source: Feetech, "Communication Protocol User Manual", and the memory map of the STS3215.
"""

import errno
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from projservo_cli.records import InputError, WorkFailed

BAUD = 1_000_000
# Bytes of memory that can be read.
_MEMORY = 86
# Fewest bytes that a request reads, and how many lengths there are, one after the other: for as many
# failed requests take 0.14 s, and no reply is later.
_SHORTEST, _LENGTHS = 15, 12
_HEAD = 4  # bytes of a reply before its status: fewer may be noise of an undriven line
# Time within which replies come, s, at first and at most: the bytes of six servos and their delays take 3 ms,
# adapters and busy machines more.
_REPLY_S, _SLOW_S = 0.012, 0.1
# Time for which a servo that does not answer is asked again, s: longer than a bus that is silent for 0.2 s.
_PATIENCE_S = 0.8
# Pause between checks of the input, and before a written value is read back, s.
_PAUSE_S, _WRITTEN_S = 0.0002, 0.005
# How often a write is repeated that a servo does not take.
_WRITES = 5
# Instructions, and the number that addresses all servos.
_SYNC_READ, _SYNC_WRITE, _ALL = 0x82, 0x83, 0xFE


class _Reply(NamedTuple):
    """Reply of a servo."""

    status: int  # bits of its faults
    values: bytes


class ServoSilent(WorkFailed):
    """Servos that do not answer, or, if ``garbled``, whose bytes are no reply."""

    def __init__(self, silent: Sequence[int], garbled: Sequence[int] = ()) -> None:
        self.silent, self.garbled = tuple(silent), tuple(garbled)
        super().__init__(
            f"replies of servos {', '.join(map(str, garbled))} are garbled: a cable is loose, or two servos "
            "answer at once: look at the cables, or unplug the other arm, or the servo that has the same id"
            if garbled
            else f"servos {', '.join(map(str, silent))} do not answer"
        )


class PortLost(WorkFailed):
    """A port that is gone."""


class FeetechBus:
    """A port with servos; an InputError if it cannot be opened. ``now``, ``sleep``: the clock, s."""

    def __init__(self, port: str, now: Any = time.monotonic, sleep: Any = time.sleep) -> None:
        self.port, self.now, self.sleep = port, now, sleep
        self._lock, self._failed, self._reply_s = threading.RLock(), 0, _REPLY_S
        self.read_at = now()  # middle of the last request, s
        self._serial = _opened(port)

    def close(self) -> None:
        """Let go of the port."""
        self._serial.close()

    def read(
        self, ids: Sequence[int], address: int, size: int, *, together: bool = False
    ) -> dict[int, _Reply]:
        """Return a number of bytes, 15 at most, of the memory of each servo; silent ones are asked again.

        together : all are asked again, so that all replies are of ``read_at``.
        Raises ServoSilent, or PortLost.
        """
        answered: dict[int, _Reply] = {}
        garbled: set[int] = set()
        end = self.now() + _PATIENCE_S
        while missing := [i for i in ids if i not in answered]:
            if self.now() > end:
                raise ServoSilent(missing, sorted(garbled.intersection(missing)))
            replies, broken = self._asked([*ids] if together else missing, address, size)
            answered = replies if together else answered | replies
            garbled |= broken
        return {i: answered[i] for i in ids}

    def write(self, address: int, values: Mapping[int, bytes]) -> None:
        """Write as many bytes into the memory of each servo at once; none answers."""
        if values:
            size = len(next(iter(values.values())))
            rows = b"".join(bytes([number]) + row for number, row in values.items())
            self._send(_SYNC_WRITE, bytes([address, size]) + rows)

    def store(self, address: int, values: Mapping[int, bytes]) -> None:
        """Write bytes until they are read back; WorkFailed if a servo does not take them."""
        for _ in range(_WRITES):
            if not values:
                return
            self.write(address, values)
            self.sleep(_WRITTEN_S)
            back = self.read([*values], address, len(next(iter(values.values()))))
            values = {number: row for number, row in values.items() if back[number].values != row}
        if values:
            raise WorkFailed(
                f"servo {min(values)} refuses the value written to its register {address}: switch the supply "
                "off and on, then run the command again"
            )

    def _asked(self, ids: Sequence[int], address: int, size: int) -> tuple[dict[int, _Reply], set[int]]:
        """Replies to one request by servo, and servos that sent only bytes that are no reply."""
        with self._lock:
            longer = _SHORTEST + self._failed % _LENGTHS
            start = min(address, _MEMORY - longer)
            self._checked(self._serial.reset_input_buffer)
            sent = self._send(_SYNC_READ, bytes([start, longer, *ids]))
            answered: dict[int, _Reply] = {}
            before = self.now()
            heard, end, timed_out = b"", before + self._reply_s, False
            while len(answered) < len(ids) and not timed_out:
                timed_out = self.now() >= end  # then once more: on a busy machine replies wait to be read
                heard += self._received()
                for number, status, values in _packets(heard):
                    if number in ids and len(values) == longer:
                        answered[number] = _Reply(status, values[address - start :][:size])
            self.read_at = 0.5 * (before + self.now())
            missing = {*ids} - {*answered}
            self._failed += bool(missing)
            slower = 2.0 if missing else 0.5
            self._reply_s = min(max(slower * self._reply_s, _REPLY_S), _SLOW_S)
            garbled = len(heard.removeprefix(sent)) >= _HEAD and not answered  # some adapters echo requests
            return answered, missing if garbled else set()

    def _send(self, instruction: int, parameters: bytes) -> bytes:
        body = bytes([_ALL, len(parameters) + 2, instruction]) + parameters
        packet = b"\xff\xff" + body + _checksum(body)
        with self._lock:
            self._checked(self._serial.write, packet)
        return packet

    def _received(self) -> bytes:
        if waiting := self._checked(lambda: self._serial.in_waiting):
            return bytes(self._checked(self._serial.read, waiting))
        self.sleep(_PAUSE_S)
        return b""

    def _checked(self, call: Callable[..., Any], *arguments: Any) -> Any:
        """Call the port; PortLost if it is gone."""
        try:
            return call(*arguments)
        except Exception as error:  # another class on each system
            raise PortLost(f"port {self.port} is gone: look at its USB cable ({error})") from error


def _checksum(body: bytes) -> bytes:
    return bytes([~sum(body) & 0xFF])


def _packets(heard: bytes) -> Iterator[tuple[int, int, bytes]]:
    """Number, status and values of each whole reply in some bytes whose checksum is right."""
    at = heard.find(b"\xff\xff")
    while 0 <= at <= len(heard) - 6:
        number, length = heard[at + 2 : at + 4]
        end = at + 4 + length
        body = heard[at + 2 : end - 1]
        whole = number != 0xFF and length >= 2 and end <= len(heard)
        if whole and heard[end - 1 : end] == _checksum(body):
            yield number, body[2], body[3:]
            at = heard.find(b"\xff\xff", end)
        else:
            at = heard.find(b"\xff\xff", at + 1)


_WHY = {
    errno.EACCES: "you may not open it: sudo usermod -aG dialout $USER, then log in again",
    errno.ENOENT: "there is no such port: look at the cable, and at plant.options.port",
    errno.EBUSY: "another program has it: end that one",
}


def _opened(port: str) -> Any:
    """Open a port; an InputError names the obstacle."""
    try:
        import serial
    except ImportError as error:
        raise InputError("pyserial is missing: pip install '.[so101]'") from error
    try:
        return serial.Serial(port, BAUD, timeout=0, write_timeout=_PATIENCE_S, exclusive=True)
    except (OSError, ValueError) as error:
        number = getattr(error, "errno", None)
        why = _WHY[errno.EBUSY] if "lock" in str(error) else _WHY.get(number or 0, str(error))
        raise InputError(f"port {port}: {why}") from error
