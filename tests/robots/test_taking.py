"""The object that a tool takes with an action at its goal: there before, held after, and its own again."""

from types import SimpleNamespace

import numpy as np
import pytest

from projservo_cli.records import WorkFailed
from projservo_cli.robots.contract import Reading
from projservo_cli.robots.object_watch import ObjectWatch
from projservo_cli.robots.session import Session

AT = 100.0 + 10.0 * np.arange(16.0).reshape(2, 4, 2)  # px, of four markers in two views
UNKNOWN = np.full((2, 4), np.nan), np.full((2, 4, 2, 6), np.nan)  # their deviations, and how they move


class Gripping(Session):
    """A session with a robot that holds its arm, sees an object ``off`` by so many px, and may hold it."""

    def __init__(self, off=0.0, holds=True):
        super().__init__()
        self.off, self.holds, self.sent = off, holds, []
        self.robot = SimpleNamespace(act=self._acts, holding=lambda name: self.holds, now=lambda: 0.0)
        self.steered = SimpleNamespace(observe=self._look, hold=self._look)
        self._random = np.random.default_rng(0)

    def _acts(self, name, value):
        self.sent.append(value)
        return 0.0

    def _look(self):
        s = AT + self.off + 0.05 * self._random.standard_normal(AT.shape)
        return Reading(np.zeros(1), s[:, :0], 0.0, np.full(2, np.nan), None, s_objects=s)

    def arrive(self):
        self.at = ObjectWatch("part", range(40, 44), np.arange(4), AT, *UNKNOWN)


def test_what_was_taken_belongs_to_the_tool_until_the_next_action_of_that_name():
    session = Gripping()
    session.act("gripper", 1.0)
    assert session.held == {}
    session.arrive()
    session.act("gripper", 0.0)
    assert session.held == {"gripper": "part"}
    session.act("light", 1.0)
    assert session.held == {"gripper": "part"}
    session.holds = False
    assert (session.lost.code, session.lost.subject.name) == ("dropped", "gripper")
    session.act("gripper", 1.0)
    assert (session.held, session.lost) == ({}, None)


@pytest.mark.parametrize(
    ("off", "holds", "sent", "said"),
    [
        (8.0, True, [], "nothing was taken: the object part, markers 40 to 43, has moved"),
        (np.nan, True, [], "nothing was taken: no image shows the object part where it is to be"),
        (0.0, False, [0.0], "the gripper holds nothing, and should hold the object part"),
    ],
    ids=["pushed", "gone", "slipped"],
)
def test_an_object_that_is_not_there_is_not_gripped_at(off, holds, sent, said):
    session = Gripping(off, holds)
    session.arrive()
    with pytest.raises(WorkFailed, match=said):
        session.act("gripper", 0.0)
    assert session.sent == sent


def test_a_robot_that_cannot_tell_is_believed():
    session = Gripping(holds=None)
    session.arrive()
    session.act("gripper", 0.0)
    assert (session.held, session.lost) == ({"gripper": "part"}, None)
