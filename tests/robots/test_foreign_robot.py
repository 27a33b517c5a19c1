"""A robot of others answers late, wrongly or not at all; it comes to rest all the same."""

import os
import signal
import threading
import time
from contextlib import contextmanager

import numpy as np
import pytest

from projservo_cli.records import JointLimits, WorkFailed
from projservo_cli.robots import contract
from projservo_cli.robots.contract import Bounds, PluginRobot, at_rest_after
from projservo_cli.robots.pacing import Steered
from projservo_cli.stages.worlds.external_robot import path_to

PERIOD = 0.04
BOUNDS = Bounds(
    JointLimits(np.full(2, -1.0), *np.ones((3, 2))),
    np.full(2, 0.3),
    PERIOD,
    0.15,
    np.full(2, 1e-3),
    ("rad",) * 2,
)


class Scripted:
    """Answers as told; time passes in commands alone."""

    def __init__(self, answer=None):
        self.s = np.arange(12.0).reshape(2, 3, 2)
        self.answer = ((0.1, 0.2), self.s) if answer is None else answer
        self.sent, self.threads = [], {}
        self.stopped, self.closed = [], []
        self.released = threading.Event()
        self.time = 0.0

    def note(self, what):
        self.threads.setdefault(what, set()).add(threading.current_thread())

    def open(self):
        self.note("open")

    def read(self):
        self.note("read")
        return self.answer() if callable(self.answer) else self.answer

    def command(self, target, speed, due):
        self.note("command")
        self.sent.append((target, speed, due))
        self.time = max(self.time, due)

    def now(self):
        return self.time

    def stop(self):
        self.note("stop")
        self.stopped.append(threading.current_thread())

    def close(self):
        self.note("close")
        self.closed.append(threading.current_thread())


def guarded(robot, timeout_s=1.0):
    return PluginRobot(robot, "plant m:C", 3, BOUNDS, timeout_s, timeout_s)


@contextmanager
def opened(robot, timeout_s=1.0):
    foreign = guarded(robot, timeout_s)
    with at_rest_after(foreign):
        yield foreign


def test_sound_answers_are_copied_and_all_calls_come_from_one_thread():
    robot = Scripted(lambda: ([0, 0], robot.s, 1, None, 3.5, np.ones((2, 3))))
    robot.s[0, 1, 0] = np.nan
    with opened(robot) as foreign:
        q, s, t_q, t_view, sigma, *_ = foreign.read()
        assert (q.dtype, t_q, sigma.shape) == (np.float64, 1.0, (2, 3))
        np.testing.assert_array_equal(t_view, [np.nan, 3.5])
        assert np.isnan(s[0, 1]).all()  # a marker is seen or not
        assert robot.s[0, 1, 1] == 3.0
        target = np.full(2, 0.04)
        foreign.command(target, np.ones(2), PERIOD)
        target[:] = 7.0
        np.testing.assert_array_equal(robot.sent[0][0], np.full(2, 0.04))
        assert foreign.truth() is None
    (thread,) = set.union(*robot.threads.values())
    assert thread is not threading.current_thread()
    assert {*robot.threads} == {"open", "read", "command", "stop", "close"}


S = np.arange(12.0).reshape(2, 3, 2)


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (((1.0, 2.0, 3.0), S), r"plant m:C: read\(\) gave q of shape \(3,\), expected \(2,\)"),
        (((1.0, np.nan), S), r"gave q as \[ 1. nan\]: must be finite"),
        ((("1", "2"), S), r"gave q as tuple: expected numbers of shape \(2,\)"),
        (([[1.0], [1.0, 2.0]], S), r"gave q as list: expected numbers"),
        (([1j, 2.0], S), r"gave q as list"),
        ((1.0, 2.0), r"gave q of shape \(\)"),
        (np.zeros(2), r"gave ndarray: expected \(q, pixels\), perhaps with t_q, t_left"),
        ((np.zeros(2), S[:, :2]), r"gave pixels of shape \(2, 2, 2\), expected \(2, 3, 2\)"),
        ((np.zeros(2), S + np.inf), r"infinite pixel: NaN stands for unseen"),
        ((np.zeros(2), S, np.nan), r"gave t_q as nan: must be finite"),
        ((np.zeros(2), S, None, "now"), r"gave t_left as str"),
        ((np.zeros(2), S, None, None, None, np.zeros((2, 3))), r"a sigma_px that is no positive number"),
    ],
)
def test_nonsense_readings(answer, message):
    with pytest.raises(WorkFailed, match=message) as caught, opened(Scripted(answer)) as foreign:
        foreign.read()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("target", "speed", "code", "amount"),
    [
        ((0.0, np.nan), (0.0, 0.0), "not_finite_command", np.nan),
        ((0.1, 0.3), (0.0, 0.0), "set_point_far", 0.3),
        ((0.1, 0.2), (0.0, -1.1), "speed_passed", -1.1),
    ],
)
def test_what_must_not_be_sent_is_not(target, speed, code, amount):
    robot = Scripted()
    with opened(robot) as foreign:
        foreign.read()
        with pytest.raises(WorkFailed, match="a command was not sent: ") as caught:
            foreign.command(np.array(target), np.array(speed), PERIOD)
    (found,) = caught.value.findings
    assert found.code == code
    assert found.amount == pytest.approx(amount, nan_ok=True)
    assert robot.sent == []


@pytest.mark.parametrize(
    ("reads", "beyond"), [(0.4 + 2.0 * np.pi, "6.68319"), (-0.9 - 4.0 * np.pi, "-13.4664")]
)
def test_a_joint_that_was_homed_a_turn_off_is_named_before_it_turns_back(reads, beyond):
    """Images cannot show it."""
    robot = Scripted(((0.1, reads), S))
    with opened(robot) as foreign:
        said = (
            f"nothing was moved: joint 2 reads {beyond} rad, a whole turn beyond its limits -1 rad to 1 rad"
        )
        with pytest.raises(WorkFailed, match=said):
            next(path_to(Steered(foreign), np.zeros(2), 0.1, "test"))
        assert robot.sent == []
        robot.answer = (0.1, 1.4), S  # beyond its limits, and no turn off: it may return
        next(path_to(Steered(foreign), np.zeros(2), 0.1, "test"))
    assert robot.sent


def test_set_points_lead_the_reading_by_so_much_and_stay_within_limits():
    robot = Scripted(((0.1, 0.9), S))
    with opened(robot) as foreign:
        foreign.read()
        for k in range(1, 8):  # the robot does not move: seven steps of 0.04 lead by 0.28
            foreign.command(np.array([0.1 - 0.04 * k, 0.9]), np.zeros(2), PERIOD * k)
        ahead = r"joint 1, -12.6051°, leads the reading too far: allowed is -11.4592° to 22.9183°"
        with pytest.raises(WorkFailed, match=ahead):
            foreign.command(np.array([-0.22, 0.9]), np.zeros(2), 8 * PERIOD)
        for k in range(8, 10):
            foreign.command(np.array([-0.18, 0.9 + 0.04 * (k - 7)]), np.zeros(2), PERIOD * k)
        with pytest.raises(WorkFailed, match=r"joint 2, 58.4417°, is beyond its limits"):
            foreign.command(np.array([-0.18, 1.02]), np.zeros(2), 10 * PERIOD)
        # Back to the reading it may jump; after a pause it may not make up for the time.
        foreign.command(np.array([0.1, 0.9]), np.zeros(2), 10 * PERIOD)
        robot.time += 0.9
        foreign.read()
        with pytest.raises(WorkFailed, match="is too far from its last"):
            foreign.command(np.array([0.1, 0.75]), np.zeros(2), robot.time + PERIOD)


def test_a_reading_that_leaps_from_its_set_point_moves_nothing():
    # Degrees all at once, or a byte that was altered: no law, and no way back, may send the robot there.
    robot = Scripted(((0.1, 0.2), S))
    with opened(robot) as foreign:
        foreign.read()
        foreign.command(np.array([0.12, 0.2]), np.zeros(2), PERIOD)
        sent, robot.answer = list(robot.sent), ((5.7, 0.2), S)
        for code in ("reading_leapt", "reading_far"):
            foreign.read()
            for target in (5.7, 0.12, 3.0):
                with pytest.raises(WorkFailed) as caught:
                    foreign.command(np.array([target, 0.2]), np.zeros(2), 2 * PERIOD)
                assert [one.code for one in caught.value.findings] == [code]
    assert robot.sent == sent


def test_clocks_that_jump_or_stand_still_are_named():
    robot = Scripted()
    with opened(robot, 0.1) as foreign:
        foreign.read()
        assert not foreign.wait_until(0.0)
        with pytest.raises(WorkFailed, match=r"its clock stands still at 0 s, before 0.5 s: now"):
            foreign.wait_until(0.5)
        robot.time = 0.05
        assert foreign.wait_until(0.0)
        assert not foreign.wait_until(0.049)  # a simulator need not end its steps there
        assert not foreign.wait_until(0.051)
        robot.time = 3600.0
        with pytest.raises(WorkFailed, match=r"its clock jumped from 0.05 s to 3600 s"):
            foreign.now()
        robot.time = 0.04
        with pytest.raises(WorkFailed, match=r"its clock jumped from 0.05 s to 0.04 s"):
            foreign.now()
    robot = Scripted(lambda: ((0.1, 0.2), S, None, 5.0 - 3.0 * robot.time))
    with opened(robot) as foreign:
        foreign.read()
        robot.time = 0.5
        with pytest.raises(WorkFailed, match=r"t_left went back from 5 s to 3.5 s"):
            foreign.read()


def test_a_late_answer_ends_the_waiting_and_stop_is_called_meanwhile(capsys):
    robot = Scripted(lambda: robot.released.wait(20.0))
    start = time.monotonic()
    with (
        pytest.raises(WorkFailed, match=r"read\(\) did not return within 0.05 s: .* plant.timeout_s$"),
        opened(robot, 0.05) as foreign,
    ):
        foreign.read()
    assert time.monotonic() - start < 10.0
    assert len(robot.stopped) == 1
    assert robot.stopped[0] not in robot.threads["open"]
    said = capsys.readouterr().err.splitlines()
    assert said == [
        "plant m:C: its thread has not answered for 0.05 s, so stop() comes from another",
        "plant m:C: not closed, since its thread is not free",
    ]
    assert robot.closed == []
    robot.released.set()


def test_opening_has_time_of_its_own_and_is_closed_where_it_fails():
    robot = Scripted()
    robot.open = lambda: time.sleep(0.2)
    foreign = PluginRobot(robot, "plant m:C", 3, BOUNDS, 0.05, 5.0)
    with at_rest_after(foreign):
        pass
    assert len(robot.closed) == 1

    def fails():
        raise OSError("no arm")

    robot = Scripted()
    robot.open = robot.stop = fails
    with (
        pytest.raises(WorkFailed, match=r"^plant m:C: open\(\) failed: OSError: no arm \(\S+\)$"),
        opened(robot),
    ):
        pass
    assert len(robot.closed) == 1


def interrupt():
    raise KeyboardInterrupt


@pytest.mark.parametrize(
    "leave",
    [lambda: None, interrupt, lambda: [][0], lambda: os.kill(os.getpid(), signal.SIGTERM)],
    ids=["the end", "Ctrl-C", "an exception", "SIGTERM"],
)
def test_stop_and_close_are_called_once_on_every_way_out(leave):
    robot = Scripted()
    plant = guarded(robot)
    before = signal.getsignal(signal.SIGTERM)
    try:
        with at_rest_after(plant):
            leave()
            time.sleep(0.01)  # a signal is handled between two instructions
    except (KeyboardInterrupt, IndexError):
        pass
    plant.stop()
    assert len(robot.stopped) == len(robot.closed) == 1
    assert signal.getsignal(signal.SIGTERM) is before


def test_a_robot_that_does_not_come_to_rest_is_said_beside_the_failure(monkeypatch):
    monkeypatch.setattr(contract, "STOP_S", 0.05)
    robot = Scripted()

    def fails():
        raise OSError("no answer")

    robot.stop = fails
    with (
        pytest.raises(
            WorkFailed, match=r"^first; and plant m:C: stop\(\) failed: OSError: no answer .* at rest$"
        ),
        at_rest_after(guarded(robot)),
    ):
        raise WorkFailed("first")
    robot.stop = lambda: robot.released.wait(20.0)
    with (
        pytest.raises(WorkFailed, match=r"stop\(\) did not return within 0.05 s"),
        at_rest_after(guarded(robot, 0.05)),
    ):
        pass
    robot.released.set()


def test_an_impatient_ctrl_c_does_not_cut_stopping_short():
    robot, finished = Scripted(), []

    def slow():
        time.sleep(0.2)
        finished.append(True)

    robot.stop = slow
    plant = guarded(robot)
    plant.open()
    timer = threading.Timer(0.05, lambda: os.kill(os.getpid(), signal.SIGINT))
    timer.start()
    plant.stop()
    timer.join()
    plant.close()
    assert finished
