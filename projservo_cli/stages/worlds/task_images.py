"""Images of the ends of a task, and of an object, wherever they are from."""

import math
from collections.abc import Callable, Sequence
from itertools import chain

import numpy as np

from projservo_cli.records import (
    FloatArray,
    InputError,
)
from projservo_cli.settings.task import GoalImages, TaskSettings
from projservo_cli.task.incidences import Flat
from projservo_cli.task.stand_off import StandOff
from projservo_cli.task.target import TargetGoal, TaskImages


def task_images(
    task: TaskSettings,
    types: str,
    numbers: tuple[Sequence[int], Sequence[int]],
    how: tuple[int, tuple[str, ...]],
    images: Callable[[FloatArray, str], FloatArray],
    turn: Callable[[FloatArray], FloatArray],
    *,
    q_current: FloatArray | None,
) -> tuple[TaskImages, FloatArray | None]:
    """Start and goal of a task, and the joints (n,) at the goal, None for a goal by images alone.

    numbers : of the markers of the face and of the pins.
    how : position of the centre marker within the face, or ``MIDPOINT``; names of the views.
    images : pixels (V, b, 2) at the joints (n,) of a key of the configuration.
    turn : joints (n,) of a goal that is a turn from the joints (n,) of the start.
    q_current : (n,) present joints of the arm, if known.
    """
    pins, given, (center, view) = len(numbers[1]), task.goal.joints, how
    q_start = q_from = _joints_at_start(task, q_current, types)
    if task.start_offset is not None:
        q_start = q_from + task.start_offset.values(types)
    s_start = images(q_start, "task.start" if task.start_offset is None else "task.start_offset")
    if task.goal.images is not None:
        pixels = task.goal.images.pixels(numbers[0], view)
        s_star = np.array([pixels.get(number, unseen(len(s_start))) for number in (*numbers[0], *numbers[1])])
        s_star = np.ascontiguousarray(np.swapaxes(s_star, 0, 1))
        return TaskImages(q_start, s_start, TargetGoal.at(s_star), center, pins), None
    if task.goal.of_start:
        return TaskImages(q_start, s_start, TargetGoal.at(s_start), center, pins), q_start
    q_goal = turn(q_from) if given is None else given.values(types)
    return TaskImages(q_start, s_start, TargetGoal.at(images(q_goal, "task.goal")), center, pins), q_goal


def _joints_at_start(task: TaskSettings, q_current: FloatArray | None, types: str) -> FloatArray:
    """Joints (n,) at the start, rad or m. Raises InputError if required present joints are unknown."""
    if task.start_joints is not None:
        return task.start_joints.values(types)
    if q_current is None:
        raise InputError("task.start: current is where the arm stands: give joints, or run projservo servo")
    return q_current


def unseen(views: int) -> tuple[tuple[float, float], ...]:
    """Pixels of a marker that no camera sees."""
    return ((math.nan, math.nan),) * views


def given_pixels(
    images: GoalImages, numbers: Sequence[int], face: Sequence[int], view: Sequence[str]
) -> tuple[FloatArray, FloatArray]:
    """Images (V, k, 2) that are given of some markers, and their deviations (V, k), px; NaN if not given.

    face : numbers of the markers that images without numbers are of.
    """
    pixels, none = images.pixels(face, view), unseen(len(view))
    s = np.array([pixels.get(number, none) for number in numbers]).swapaxes(0, 1)
    stated_numbers = [number for number in numbers if number in pixels]
    sigma = np.full(s.shape[:2], np.nan)
    known = [number in pixels for number in numbers]
    sigma[:, known] = np.array(images.deviations(stated_numbers, face, view)).reshape(len(s), -1)
    return s, sigma


def positioned(asked: StandOff, numbers: Sequence[int]) -> StandOff:
    """Displacement by positions in the body instead of numbers of markers; raises as ``in_body``."""
    return asked._replace(along=in_body(asked.along, numbers, f"task.goal.displaced: {asked.name}"))


def in_body(points: Flat, numbers: Sequence[int], name: str) -> Flat:
    """Points that span a feature, by positions in the body instead of numbers of markers.

    name : of their use, as a message begins. Raises InputError for a marker that the body lacks.
    """
    for number in chain.from_iterable(points):
        if number not in numbers:
            raise InputError(
                f"{name} needs marker {number}, and the body has {', '.join(map(str, numbers))}: name these, "
                "or calibrate with it"
            )
    return tuple(tuple(map(numbers.index, point)) for point in points)
