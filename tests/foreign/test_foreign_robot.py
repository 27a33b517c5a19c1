"""A robot of others answers late, wrongly or not at all; it comes to rest all the same."""

import os
import signal
import threading
import time

import numpy as np
import pytest

from projservo_cli.records import WorkFailed
from projservo_cli.robots import yours as foreign
from projservo_cli.robots.yours import ForeignRobot, at_rest_after


class Scripted:
    """Answers as told."""

    def __init__(self, q=(0.1, 0.2), s=None):
        self.q, self.s = q, np.zeros((2, 3, 2)) if s is None else s
        self.steps, self.stopped = [], []
        self.released = threading.Event()

    def joints(self):
        return self.q() if callable(self.q) else self.q

    def observe(self):
        return self.s

    def command(self, step, period):
        self.steps.append((step, period))

    def stop(self):
        self.stopped.append(threading.current_thread())


def guarded(robot, timeout_s=1.0):
    return ForeignRobot(robot, "plant m:C", 2, 3, timeout_s)


def test_sound_answers_are_copied():
    robot = Scripted(q=[1, 2])
    robot.s[0, 1, 0] = np.nan
    plant = guarded(robot)
    q, s, step = plant.joints(), plant.observe(), np.ones(2)
    assert q.dtype == np.float64
    assert np.isnan(s[0, 1]).all()  # a marker is seen or not
    assert robot.s[0, 1, 1] == 0.0
    plant.command(step, 0.04)
    step[:] = 7.0
    np.testing.assert_array_equal(robot.steps[0][0], np.ones(2))


@pytest.mark.parametrize(
    ("q", "message"),
    [
        ((1.0, 2.0, 3.0), r"plant m:C: joints\(\) gave numbers of shape \(3,\), expected \(2,\)"),
        ((1.0, np.nan), r"joints\(\) gave \[ 1. nan\]: readings must be finite"),
        (("1", "2"), r"joints\(\) gave tuple: expected numbers of shape \(2,\)"),
        ([[1.0], [1.0, 2.0]], r"joints\(\) gave list: expected numbers"),
        ([1j, 2.0], r"joints\(\) gave list"),
    ],
)
def test_nonsense_readings(q, message):
    with pytest.raises(WorkFailed, match=message) as caught:
        guarded(Scripted(q=q)).joints()
    assert "\n" not in str(caught.value)


def test_nonsense_images():
    with pytest.raises(WorkFailed, match=r"shape \(2, 2, 2\), expected \(2, 3, 2\)"):
        guarded(Scripted(s=np.zeros((2, 2, 2)))).observe()
    with pytest.raises(WorkFailed, match="infinite pixel: NaN stands for unseen"):
        guarded(Scripted(s=np.full((2, 3, 2), np.inf))).observe()


def test_a_step_that_is_not_finite_is_never_sent():
    robot = Scripted()
    with pytest.raises(WorkFailed, match="was not sent"):
        guarded(robot).command(np.array([0.0, np.nan]), 0.04)
    assert robot.steps == []


def test_a_late_answer_ends_the_waiting_and_stop_is_called_meanwhile():
    robot = Scripted()
    robot.q = lambda: robot.released.wait(20.0)
    plant = guarded(robot, timeout_s=0.05)
    start = time.monotonic()
    with (
        pytest.raises(WorkFailed, match=r"joints\(\) did not return within 0.05 s: .* plant.timeout_s"),
        at_rest_after(plant),
    ):
        plant.joints()
    assert time.monotonic() - start < 10.0
    assert len(robot.stopped) == 1
    robot.released.set()


def test_a_failure_says_where_it_was_raised():
    def fails():
        raise OSError("bus\nerror")

    with pytest.raises(
        WorkFailed, match=r"joints\(\) failed: OSError: bus error \(test_foreign_robot.py:\d+\)$"
    ):
        guarded(Scripted(q=fails)).joints()


def interrupt():
    raise KeyboardInterrupt


@pytest.mark.parametrize(
    "leave",
    [lambda: None, interrupt, lambda: [][0], lambda: os.kill(os.getpid(), signal.SIGTERM)],
    ids=["the end", "Ctrl-C", "an exception", "SIGTERM"],
)
def test_stop_is_called_once_on_every_way_out(leave):
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
    assert len(robot.stopped) == 1
    assert signal.getsignal(signal.SIGTERM) is before


def test_signals_that_are_ignored_stay_ignored():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with at_rest_after(guarded(Scripted())):
            os.kill(os.getpid(), signal.SIGHUP)
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_robot_that_does_not_come_to_rest_is_said_beside_the_failure(monkeypatch):
    monkeypatch.setattr(foreign, "STOP_S", 0.05)
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
        at_rest_after(guarded(robot)),
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
    timer = threading.Timer(0.05, lambda: os.kill(os.getpid(), signal.SIGINT))
    timer.start()
    plant.stop()
    timer.join()
    assert finished
