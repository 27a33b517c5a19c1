"""A law bound to its model, task and gains, for control loops written in Python.

Handing some forty arrays over to compiled code takes longer than a control step. They are handed over
once and kept in a structure of the compiler; a call then passes the pixels and the joints alone.
"""

from typing import TYPE_CHECKING, Any, NamedTuple

from numba import types
from numba.experimental import structref

from projservo_cli.control import command
from projservo_cli.control.law import Gains, State
from projservo_cli.geometry.jit import COMPILED, allocating
from projservo_cli.records import FloatArray, Model
from projservo_cli.task.face import Task

FIELDS = ("code", "model", "task", "gains", "state")

if TYPE_CHECKING or not COMPILED:

    class Bound(NamedTuple):
        """What a law works on."""

        code: int
        model: Model
        task: Task
        gains: Gains
        state: State

else:

    @structref.register
    class BoundType(types.StructRef):
        """The compiler's type of what a law works on."""

    class Bound(structref.StructRefProxy):
        """What a law works on, held by compiled code."""

    structref.define_proxy(Bound, BoundType, FIELDS)


@allocating
def bind(code: int, model: Model, task: Task, gains: Gains, state: State) -> Any:
    """What the law of a code works on; changes of its arrays are seen, here and there."""
    return Bound(code, model, task, gains, state)


@allocating
def bound_command(bound: Any, s: FloatArray, q: FloatArray) -> int:
    """One command of the bound law, as of ``command``: the status, the rest is written to the state."""
    return command(bound.code, bound.model, bound.task, bound.gains, s, q, bound.state)
