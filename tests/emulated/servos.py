"""Servos of the kind STS3215 on a pseudo-terminal, as slow as a real bus, with faults on request.

What is known of their registers comes from the memory map of their maker, and from no table of the driver.
"""

import contextlib
import math
import os
import select
import threading
import tty
from collections import deque
from dataclasses import dataclass

import numpy as np

from tests.emulated.arm import FULL_SPEED, STALL_NM

BYTE_S, USB_S, DELAY_UNIT_S = 10e-6, 1e-3, 2e-6  # a byte at 1 Mbaud, a USB frame, a unit of register 7
TURN = 4096
# Memory of a servo as it comes: address, bytes (1 or 2), value.
_FACTORY = (
    *((0, 1, 3), (1, 1, 10), (3, 2, 777), (5, 1, 1), (6, 1, 0), (7, 1, 0), (8, 1, 1), (9, 2, 0)),
    *((11, 2, 4095), (13, 1, 70), (14, 1, 80), (15, 1, 40), (16, 2, 1000), (18, 1, 12), (19, 1, 44)),
    *((21, 1, 32), (22, 1, 32)),
    *((24, 2, 16), (26, 1, 1), (27, 1, 1), (28, 2, 500), (30, 1, 1), (34, 1, 20), (35, 1, 200), (36, 1, 80)),
    *((48, 2, 1000), (55, 1, 1), (62, 1, 74), (63, 1, 31)),
)
_STORED = 40  # addresses below are kept where the supply is off, and locked


@dataclass
class Faults:
    """How often the bus fails, as shares of packets, and what else is wrong with it."""

    altered: float = 0.0  # a byte of a reply or of a request is another one
    dropped: float = 0.0  # a byte of it is missing
    late: float = 0.0  # a reply comes after 20 to 60 ms
    silent: float = 0.0  # the bus is silent for 0.2 s
    lies: float = 0.0  # a reading is any number, and its checksum right
    twice: tuple = ()  # ids that two servos have
    missing: tuple = ()  # ids that do not answer
    supply: bool = True
    seed: int = 1


class Servo:
    """One servo: its memory, and the joint of the arm that it turns; None for the gripper.

    zero : angle of its shaft, counts, where the joint is at 0; sign : 1, or −1 where it turns the other way.
    """

    def __init__(self, number, arm, joint, zero, sign):
        self.number, self.arm, self.joint, self.zero, self.sign = number, arm, joint, zero, sign
        self.memory, self.overload, self._held = bytearray(86), False, float(zero)
        self._between = None
        for address, size, value in _FACTORY:
            self.put(address, size, value)
        self.memory[5] = number
        self.moments = []  # when it was sent where
        self.reads = deque(maxlen=200)  # when it was read, and the angle in its reply

    def get(self, address, size=2):
        return int.from_bytes(self.memory[address : address + size], "little")

    def put(self, address, size, value):
        self.memory[address : address + size] = int(value).to_bytes(size, "little")

    @property
    def shaft(self):
        """Counts of the shaft, which go on over whole turns."""
        if self.joint is None:
            return self._gripper()
        return self.zero + self.sign * self.arm.q[self.joint] * TURN / (2 * math.pi)

    @property
    def between(self):
        """Counts of the shaft at which a part stops the gripper; None without a part."""
        return self._between

    @between.setter
    def between(self, counts):
        if counts != self._between:  # it turns on from where it stands
            self._held, goal = self._gripper(), self.moments[-1][1] if self.moments else None
            if goal is not None:
                self.moments.append((self.arm.clock.now(), goal))
            self._between = counts

    def _gripper(self):
        """Counts of the shaft of a gripper, which turns towards its goal until a part stops it."""
        if not self.moments or not self.on:
            return self._held
        (since, goal), speed = self.moments[-1], (self.get(46) & 0x7FFF) or TURN
        way = speed * (self.arm.clock.now() - since)
        there = self._held + np.clip(goal - self._held, -way, way)
        return there if self.between is None else max(there, self.between)

    @property
    def present(self):
        offset = self.get(31)
        offset = -(offset & 0x7FF) if offset & 0x800 else offset
        return (round(self.shaft) - offset) % TURN

    @property
    def on(self):
        return self.memory[40] == 1

    def refresh(self):
        """Bring the registers of what is measured up to date."""
        self.put(56, 2, self.present)
        self.reads.append((self.arm.clock.now(), self.get(56)))
        if self.joint is None:
            return
        if self.on and self.arm.overloaded_s[self.joint] > 0.01 * self.memory[35]:
            self.overload, self.arm.share[self.joint] = True, 0.01 * self.memory[34]
        load = -self.sign * self.arm.torque[self.joint] / STALL_NM * 1000
        self.put(60, 2, round(min(abs(load), 1000)) | (0x400 if load < 0 else 0))

    @property
    def status(self):
        volts, heat = self.memory[62], self.memory[63]
        wrong = volts > self.memory[14] or volts < self.memory[15]
        return wrong * 0x01 | (heat > self.memory[13]) * 0x04 | self.overload * 0x20

    def write(self, address, values):
        """Take what is written, as a servo does: stored registers only where they are unlocked."""
        for i, value in enumerate(values):
            if address + i >= _STORED or not self.memory[55]:
                self.memory[address + i] = value
        touched = range(address, address + len(values))
        if 40 in touched and self.memory[40] == 128:
            self._store_offset()
        if 42 in touched:
            self._go()
        if 40 in touched or 42 in touched:
            self._switch()

    def _go(self):
        """Turn to a goal, the long way round rather than over 4095; torque comes on by itself."""
        low, high = self.get(9), self.get(11)
        goal = min(max(self.get(42), low), high)
        if self.joint is None:
            self._held = self._gripper()
        self.moments.append((self.arm.clock.now(), goal))
        self.overload, self.memory[40] = False, 1
        if self.joint is None:
            return
        self.arm.share[self.joint] = 1.0
        way = (goal - self.present) * self.sign * 2 * math.pi / TURN
        speed = self.get(46) & 0x7FFF
        self.arm.goal[self.joint] = self.arm.q[self.joint] + way
        self.arm.speed[self.joint] = min(speed * 2 * math.pi / TURN, FULL_SPEED) if speed else FULL_SPEED

    def _switch(self):
        if self.joint is None:
            return
        was = bool(self.arm.torque_on[self.joint])
        self.arm.torque_on[self.joint] = self.on
        if self.on and not was and not self.moments:
            self._go()  # to a goal from before

    def _store_offset(self):
        offset = round(self.shaft) % TURN - TURN // 2
        self.put(31, 2, abs(offset) | (0x800 if offset < 0 else 0))
        self.memory[40] = 0


class Bus:
    """A port with servos 1 to 6, the last of which is the gripper; ``port`` names it.

    ``writes`` lists instructions that write: when, to which id, address, values.
    """

    def __init__(self, arm, faults=None, zeros=(2048, 1800, 2300, 1900, 2100), signs=(1, -1, 1, -1, 1)):
        self.arm, self.faults, self.clock = arm, faults or Faults(), arm.clock
        joints = zip(range(arm.n), zeros, signs, strict=True)
        self.servos = {j + 1: Servo(j + 1, arm, j, zero, sign) for j, zero, sign in joints}
        self.servos[arm.n + 1] = Servo(arm.n + 1, arm, None, 1500, 1)
        self.writes, self._random = [], np.random.default_rng(self.faults.seed)
        self._silent_until, self._stopping = -math.inf, threading.Event()

    def __enter__(self):
        self._ours, self._theirs = os.openpty()
        tty.setraw(self._theirs)
        self.port = os.ttyname(self._theirs)
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_):
        self.cut_usb()

    def cut_usb(self):
        """Draw the cable: the port is gone. Its numbers may be those of another file afterwards."""
        if not self._stopping.is_set():
            self._stopping.set()
            self._thread.join(5.0)
            os.close(self._ours)
            os.close(self._theirs)

    def cut_supply(self):
        """Switch the supply off: no servo answers, and none holds."""
        with self.arm.lock:
            self.faults.supply, self.arm.hand = False, None
            self.arm.advance()
            self.arm.torque_on[:] = False

    def _serve(self):
        kept = b""
        while not self._stopping.is_set():
            if not select.select([self._ours], [], [], 0.02)[0]:
                self.arm.advance()
                continue
            try:
                kept += os.read(self._ours, 4096)
            except OSError:
                return
            while (packet := self._packet(kept)) is not None:
                whole, kept = packet
                if whole:
                    self._answer(whole)

    def _packet(self, kept):
        """The first whole packet of some bytes, empty where its checksum is wrong, and what follows it."""
        begin = kept.find(b"\xff\xff")
        if begin < 0 or len(kept) < begin + 4:
            return None
        end = begin + 4 + kept[begin + 3]
        if kept[begin + 2] == 0xFF or kept[begin + 3] < 2:
            return b"", kept[begin + 1 :]
        if len(kept) < end:
            # A length that was altered must not keep what follows waiting.
            again = kept.find(b"\xff\xff", begin + 2)
            return (b"", kept[again:]) if again > 0 else None
        whole = kept[begin:end]
        right = (~sum(whole[2:-1])) & 0xFF == whole[-1]
        return (whole, kept[end:]) if right else (b"", kept[begin + 2 :])

    def _answer(self, packet):
        packet = self._spoilt(packet)
        if packet is None or not self.faults.supply or self.clock.now() < self._silent_until:
            return
        number, instruction, given = packet[2], packet[4], packet[5:-1]
        taken = len(packet) * BYTE_S + USB_S
        with self.arm.lock:
            self.arm.advance()
            replies = list(self._carried_out(number, instruction, given))
        whole = b""
        for servo, values in replies:
            reply = self._reply(servo, values)
            if servo.number in self.faults.twice:  # two at once: what arrives is neither
                noise = self._random.integers(0, 256, len(reply)).tolist()
                reply = bytes(x & y for x, y in zip(reply, noise, strict=True))
            taken += servo.memory[7] * DELAY_UNIT_S + len(reply) * BYTE_S
            whole += self._garbled(reply)
        if whole:
            self.clock.sleep(taken)
            self._write_out(whole)

    def _carried_out(self, number, instruction, given):
        """Do what is asked; yield each servo that answers, and its values."""
        known = {i: servo for i, servo in self.servos.items() if i not in self.faults.missing}
        if instruction in (0x82, 0x83):
            address, size = given[:2]
            rows = given[2:] if instruction == 0x82 else [*range(2, len(given), size + 1)]
            for row in rows:
                servo = known.get(row if instruction == 0x82 else given[row])
                if servo is None:
                    continue
                if instruction == 0x82:
                    servo.refresh()
                    yield servo, bytes(servo.memory[address : address + size])
                else:
                    self._write(servo, address, given[row + 1 : row + 1 + size])
            return
        servo = known.get(number)
        if servo is None:
            return
        servo.refresh()
        if instruction == 0x02:
            yield servo, bytes(servo.memory[given[0] : given[0] + given[1]])
        elif instruction == 0x01:
            yield servo, b""
        elif instruction == 0x03:
            self._write(servo, given[0], given[1:])
            if servo.memory[8]:
                yield servo, b""

    def _write(self, servo, address, values):
        self.writes.append((self.clock.now(), servo.number, address, bytes(values)))
        servo.write(address, values)

    def _reply(self, servo, values):
        if len(values) >= 2 and self._random.random() < self.faults.lies:
            values = bytes(self._random.integers(0, 256, len(values)).tolist())
        body = bytes([servo.number, len(values) + 2, servo.status]) + values
        return b"\xff\xff" + body + bytes([~sum(body) & 0xFF])

    def _spoilt(self, packet):
        """A packet as it arrives at the servos; None where it does not."""
        drawn, faults = self._random.random(), self.faults
        if drawn < faults.silent:
            self._silent_until = self.clock.now() + 0.2
            return None
        return None if drawn < faults.silent + (faults.altered + faults.dropped) / 2 else packet

    def _garbled(self, reply):
        """A reply as it arrives at the port; nothing where it is late and sent by itself."""
        faults, drawn = self.faults, self._random.random()
        place = int(self._random.integers(len(reply)))
        if drawn < faults.altered / 2:
            other = bytes([reply[place] ^ int(self._random.integers(1, 256))])
            reply = reply[:place] + other + reply[place + 1 :]
        elif drawn < (faults.altered + faults.dropped) / 2:
            reply = reply[:place] + reply[place + 1 :]
        if self._random.random() < faults.late:
            wait = float(self._random.uniform(0.02, 0.06)) / self.clock.rate
            timer = threading.Timer(wait, self._write_out, (reply,))
            timer.daemon = True
            timer.start()
            return b""
        return reply

    def _write_out(self, reply):
        with contextlib.suppress(OSError):
            os.write(self._ours, reply)
