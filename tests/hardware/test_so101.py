"""Arms of bus servos, driven on emulated ones: packets, faults, order of commands, beginners' mistakes."""

import contextlib
import itertools
import math
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from projservo_cli.findings import Subject
from projservo_cli.hardware import feetech, so101
from projservo_cli.hardware.so101 import COUNT, MIDDLE, SO101
from projservo_cli.records import InputError, JointLimits, WorkFailed
from tests.emulated.arm import Arm, Clock, Mechanics
from tests.emulated.servos import Bus, Faults

PERIOD_S = 0.04
TORQUE, GOAL, STORED = 40, 42, 40  # addresses; those below are stored


def limits_of(low=-120.0, high=120.0, speed=90.0):
    ends = (np.full(5, math.radians(x)) for x in (low, high, speed))
    return JointLimits(*ends, acceleration=np.full(5, 9.0))


@pytest.fixture
def rig(tmp_path, monkeypatch):
    """A function that makes an emulated arm with its bus; locks go into a folder of the test."""
    monkeypatch.setattr(so101.tempfile, "gettempdir", lambda: str(tmp_path))
    made = []

    def make(faults=None, mechanics=None, q_deg=(0, 10, -25, 15, 0), **more):
        made.append(Bus(Arm(Clock(), q_deg, mechanics), faults, **more).__enter__())
        return made[-1]

    yield make
    for bus in made:
        bus.__exit__()


@pytest.fixture
def opened(rig):
    """A function that opens a driver on an emulated bus."""
    arms = []

    def open_on(bus=None, **options):
        bus = bus or rig()
        arms.append(SO101(bus.port, limits=options.pop("limits", limits_of()), **options))
        arms[-1].open()
        return bus, arms[-1]

    yield open_on
    for arm in arms:
        arm.close()


def angles(bus):
    """Joint readings (n,) as the emulated servos have them, rad."""
    return np.array([(bus.servos[i].present - MIDDLE) * COUNT for i in range(1, 6)])


def drive(arm, way, periods=12):
    """Move by a way (n,), rad, and read in each period; returns the readings and the set-points."""
    q = begun = arm.joints()[0]
    readings, sent = [], []
    for k in range(1, periods + 1):
        sent.append(begun + way * k / periods)
        arm.command(sent[-1], way / periods / PERIOD_S, arm.now() + PERIOD_S)
        arm.sleep(PERIOD_S)
        q, _ = arm.joints()
        readings.append(q)
    return np.array(readings), np.array(sent)


def test_the_emulated_bus_answers_the_sdk_of_the_maker(rig):
    sdk = pytest.importorskip("scservo_sdk")
    bus = rig()
    port = sdk.PortHandler(bus.port)
    assert port.openPort()
    assert port.setBaudRate(feetech.BAUD)
    handler = sdk.PacketHandler(0)

    def often(call, *given):
        """What the SDK says in ten seconds: its time-outs are short, and after one it may fail."""
        begun = time.monotonic()
        while time.monotonic() - begun < 10.0:
            with contextlib.suppress(IndexError):
                yield call(port, *given)

    assert all(any(answer[1] == 0 for answer in often(handler.ping, i)) for i in bus.servos)
    assert all(answer[1] != 0 for answer in itertools.islice(often(handler.ping, 7), 8))
    assert bus.servos[2].present in [answer[0] for answer in often(handler.read2ByteTxRx, 2, 56)]
    group = sdk.GroupSyncRead(port, handler, 56, 2)
    for i in bus.servos:
        group.addParam(i)
    assert 0 in often(lambda _: group.txRxPacket())
    assert [group.getData(i, 56, 2) for i in bus.servos] == [s.present for s in bus.servos.values()]
    port.closePort()


def test_the_arm_follows_and_holds_where_it_is_sent(opened, capsys):
    bus, arm = opened()
    way = np.radians([20.0, -15, 15, 10, 30])
    begun = angles(bus)
    drive(arm, way, 20)
    time.sleep(0.4)
    off = np.degrees(angles(bus) - begun - way)
    assert np.abs(off).max() < 3.0  # sag and hysteresis
    arm.close()
    assert bus.arm.torque_on.all()
    assert "torque is on" in capsys.readouterr().err


def test_torque_comes_on_where_the_arm_stands_and_nothing_is_stored(opened):
    bus, arm = opened()
    counts = {i: bus.servos[i].present for i in bus.servos}
    arm.command(arm.joints()[0], np.zeros(5), arm.now() + PERIOD_S)
    first = {}
    for _, number, address, values in bus.writes:
        assert address >= STORED
        first.setdefault(number, []).append((address, values))
    for number, writes in first.items():
        assert writes[0][0] == GOAL
        assert int.from_bytes(writes[0][1][:2], "little") == counts[number]
        assert int.from_bytes(writes[0][1][4:6], "little") > 0  # 0 stands for full speed
        assert (TORQUE, b"\1") in writes
    assert all(values[0] in (0, 1) for _, _, address, values in bus.writes if address == TORQUE)
    assert all(bus.servos[i].on for i in bus.servos)  # the gripper too


def test_without_limits_nothing_moves(opened):
    bus, arm = opened(limits=None)
    q, _ = arm.joints()
    with pytest.raises(InputError, match="nothing was moved: the arm has no limits: projservo limits"):
        arm.command(q, np.zeros(5), arm.now())
    assert not bus.writes


@pytest.mark.parametrize(
    ("address", "value", "limits", "told"),
    [
        (33, 1, limits_of(), r"joint 2 \(servo 2\): its mode \(register 33\) is 1: set 0"),
        (18, 0x1C, limits_of(), "it counts several turns .register 18 is 28.: set 12"),
        (9, 1500, limits_of(), r"go beyond those that it keeps itself, -48.2° to 179.9°"),
        (33, 0, limits_of(low=-181.0), r"joint 1 .*-181.0° to 120.0°, go beyond .* -180.0° to 179.9°"),
    ],
)
def test_an_arm_that_would_not_stand_where_it_is_sent_is_refused(rig, address, value, limits, told):
    bus = rig()
    bus.servos[2].put(address, 2 if address == 9 else 1, value)
    arm = SO101(bus.port, limits=limits)
    with pytest.raises(InputError, match=told):
        arm.open()
    arm.close()
    assert not bus.writes


def test_readings_and_commands_stand_a_bad_cable(opened, rig):
    bus = rig(Faults(altered=0.01, dropped=0.01, late=0.01, silent=0.001))
    bus, arm = opened(bus)
    readings, sent = drive(arm, np.radians([10.0, -10, 10, -10, 10]), 80)
    counts = {round(MIDDLE + q / COUNT) for q in np.ravel(sent)} | {
        int.from_bytes(values[:2], "little") for _, _, address, values in bus.writes[:6] if address == GOAL
    }
    goals = {goal for servo in bus.servos.values() if servo.joint is not None for _, goal in servo.moments}
    assert goals <= counts  # no set-point is another one
    assert np.degrees(np.abs(np.diff(readings, axis=0))).max() < 3.0  # nor is a reading


def test_numbers_that_no_servo_read_are_caught_by_the_speed_of_joints(opened, rig):
    bus = rig()
    bus, arm = opened(bus)
    bus.faults.lies = 0.02
    arm.command(arm.joints()[0], np.zeros(5), arm.now() + PERIOD_S)
    held = np.array([arm.joints()[0] for _ in range(100)])
    assert np.degrees(np.abs(held - angles(bus))).max() < 2.0


def test_a_joint_that_leaps_is_named(opened):
    bus, arm = opened()
    arm.joints()
    bus.servos[3].zero += 900
    with pytest.raises(WorkFailed, match=r"joint 3 \(servo 3\) reads .*: no joint turns so fast"):
        arm.joints()


def silent_wire(bus):
    bus.servos[4].memory[5] = 44
    bus.faults.missing = (4,)


FAULTS = {
    "voltage": (lambda bus: bus.servos[2].put(62, 1, 121), "servo_supply", 2),
    "heat": (lambda bus: bus.servos[3].put(63, 1, 75), "servo_heat", 3),
    "a cable": (silent_wire, "silent_servos", 4),
    "supply": (lambda bus: bus.cut_supply(), "silent_arm", 1),
    "USB": (lambda bus: bus.cut_usb(), "lost_port", 1),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_what_fails_is_named_in_time_and_written_to_no_more(opened, fault):
    bus, arm = opened()
    strike, code, number = FAULTS[fault]
    drive(arm, np.radians([5.0] * 5), 3)
    strike(bus)
    begun = time.monotonic()
    with pytest.raises(WorkFailed) as caught:
        drive(arm, np.radians([5.0] * 5), 100)
    (found,) = caught.value.findings
    assert found.code == code
    if code.startswith("servo"):
        assert found.subject == Subject(joints=(number,), name=f"servo {number}")
    assert time.monotonic() - begun < 2.0
    written = len(bus.writes)
    with contextlib.suppress(WorkFailed):
        arm.stop()
    assert number not in {row[1] for row in bus.writes[written:]}


def test_an_arm_that_presses_against_a_stop_is_named(opened, rig):
    bus = rig(mechanics=Mechanics(stops_deg={0: (-15.0, 15.0)}))
    bus, arm = opened(bus)
    with pytest.raises(WorkFailed, match=r"joint 1 \(servo 1\) is overloaded, .*: free it from"):
        drive(arm, np.radians([60.0, 0, 0, 0, 0]), 120)


def test_release_and_hold_do_not_leap(opened):
    bus, arm = opened()
    q, _ = arm.joints()
    arm.command(q, np.zeros(5), arm.now() + PERIOD_S)
    arm.release()
    assert not bus.arm.torque_on.any()
    assert bus.servos[6].on  # the gripper holds
    bus.arm.put((30, 0, -10, 0, 20), 200.0)
    time.sleep(0.5)
    there, _ = arm.joints()
    arm.command(there, np.zeros(5), arm.now())  # a released arm is sent nothing
    assert not bus.arm.torque_on.any()
    arm.hold()
    assert bus.arm.torque_on.all()
    time.sleep(0.3)
    assert np.degrees(np.abs(arm.joints()[0] - there)).max() < 3.0


def test_an_arm_beyond_its_limits_is_not_moved(opened):
    _, arm = opened(limits=limits_of(low=-20.0, high=20.0))
    q, _ = arm.joints()
    with pytest.raises(
        WorkFailed, match=r"nothing was moved: joint 2 .*beyond its limits .* the leader's port"
    ):
        arm.command(q, np.zeros(5), arm.now())


MISTAKES = {
    "supply off": (Faults(supply=False), "no servo answers: switch the supply on"),
    "missing": (
        Faults(missing=(4, 5, 6)),
        r"servos \[4, 5, 6\] do not answer, \[1, 2, 3\] do: look at the cable",
    ),
    "two arms": (Faults(twice=(1, 2, 3, 4, 5, 6)), "every reply is garbled: two arms share this bus"),
    "two pairs": (Faults(twice=(2, 5)), r"answers of servo 2 are garbled, answers of \[1, 3, 4, 6\]"),
    "twice": (Faults(twice=(3,)), "answers of servo 3 are garbled.*two servos have this id"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_servos_that_are_not_as_they_should_be_are_named(rig, mistake):
    faults, told = MISTAKES[mistake]
    with pytest.raises(InputError, match=told):
        SO101(rig(faults).port).open()


def test_the_port_of_the_leader_is_told_from_that_of_the_arm(rig, opened, monkeypatch):
    arm, leader, other = rig(), rig(), rig(Faults(supply=False))
    monkeypatch.setattr(so101, "candidate_ports", lambda: [other.port, arm.port])
    opened(arm)[1].close()
    found = SO101(limits=limits_of())
    found.open()
    assert found._servos.bus.port == arm.port
    found.close()
    monkeypatch.setattr(so101, "candidate_ports", lambda: [leader.port, arm.port])
    with pytest.raises(
        InputError, match=r"arms answer on .* and .*: one may be the leader: set plant.options.port"
    ):
        SO101().open()
    monkeypatch.setattr(so101, "candidate_ports", lambda: [other.port, "/nowhere"])
    with pytest.raises(InputError, match=r"all answer on none of 2 ports.*do not answer; .*no such port"):
        SO101().open()
    monkeypatch.setattr(so101, "candidate_ports", lambda: [other.port])
    with pytest.raises(InputError, match="no servo answers: switch the supply on"):
        SO101().open()
    monkeypatch.setattr(so101, "candidate_ports", list)
    with pytest.raises(InputError, match="no serial port on USB"):
        SO101().open()


DRIVEN = """
import sys, time, numpy as np
from projservo_cli.hardware.so101 import SO101
from tests.hardware.test_so101 import limits_of
arm = SO101(sys.argv[1], limits=limits_of())
arm.open()
q, _ = arm.joints()
for k in range(1000):
    arm.command(q + np.radians(0.5 * min(k, 60)), np.zeros(5), arm.now())
    print("sent", flush=True)
    time.sleep(0.04)
"""


def test_after_a_kill_the_next_start_says_so_and_goes_on_from_the_reading(rig, opened, tmp_path, capsys):
    bus = rig()
    process = subprocess.Popen(
        [sys.executable, "-c", DRIVEN, bus.port],
        stdout=subprocess.PIPE,
        env={**os.environ, "TMPDIR": str(tmp_path)},
        text=True,
    )
    for _ in range(20):
        process.stdout.readline()
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    time.sleep(0.3)
    written = len(bus.writes)
    time.sleep(0.2)
    assert len(bus.writes) == written
    assert bus.arm.torque_on.all()
    _, arm = opened(bus)
    assert f"process {process.pid} was ended while it moved this arm" in capsys.readouterr().err
    q, _ = arm.joints()
    arm.command(q, np.zeros(5), arm.now())
    goals = [int.from_bytes(v[:2], "little") for _, i, a, v in bus.writes[written:] if a == GOAL and i == 1]
    assert abs(goals[0] - round(MIDDLE + q[0] / COUNT)) <= 1


def test_two_processes_do_not_drive_one_arm(opened):
    bus, _ = opened()
    with pytest.raises(InputError, match=r"another program has it|another projservo drives this arm"):
        SO101(bus.port).open()


def test_an_overload_of_before_ends_with_the_first_set_point(opened):
    bus, arm = opened()
    arm.hold()
    arm.close()
    bus.servos[2].overload = True
    again = opened(bus)[1]
    again.joints()
    again.hold()
    assert not bus.servos[2].overload
    bus.servos[2].overload = True
    with pytest.raises(WorkFailed, match=r"joint 2 .* is overloaded"):
        again.joints()


def test_the_gripper_closes_on_a_part_and_pushes_on_whatever_ends(opened, rig):
    bus, arm = opened(rig(), gripper_counts=(1200, 2600))
    gripper = bus.servos[6]
    gripper.between = 1500
    assert arm.act("gripper", 1.0) == pytest.approx(1100 * COUNT / math.radians(60.0) + 0.3, abs=0.05)
    drive(arm, np.zeros(5))
    time.sleep(1.7)
    assert gripper.present == 2600
    arm.act("gripper", 0.0)
    time.sleep(1.7)
    assert gripper.present == 1500
    assert arm.holding("gripper") is True
    assert gripper.get(42) == 1200
    gripper.overload = True  # which is no fault of a grip
    drive(arm, np.zeros(5))
    arm.stop()
    arm.release()
    assert gripper.on
    assert gripper.get(42) == 1200
    gripper.between = None  # the part was taken away
    time.sleep(0.6)
    assert arm.holding("gripper") is False


def test_what_the_gripper_cannot_do_is_named(opened, rig):
    for value, told, options in (
        (0.5, "how far it opens is not stored .* plant.options.gripper_counts", {}),
        (1.5, "give a share, from 0, closed, to 1, open", {"gripper_counts": (1200, 2600)}),
        (0.5, "the arm has no gripper", {"gripper": None}),
    ):
        bus, arm = opened(rig(), **options)
        with pytest.raises(InputError, match=told):
            arm.act("gripper", value)
        arm.close()
    with pytest.raises(InputError, match="give two counts from 0 to 4095"):
        SO101(bus.port, gripper_counts=(1, 5000))


def test_a_gripper_that_holds_keeps_its_grip(opened, rig):
    bus = rig()
    bus.servos[6].write(GOAL, (1000).to_bytes(2, "little"))
    time.sleep(0.3)  # until it has closed: no joint may seem to leap
    arm = opened(bus)[1]
    before = len(bus.servos[6].moments)
    arm.hold()
    assert len(bus.servos[6].moments) == before
    assert len(bus.servos[5].moments) == 1
